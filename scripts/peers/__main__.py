"""Does every peer compute what jaxsat computes, and how long does each take?"""

import argparse
from functools import partial

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxsat.inertial.smoother import Rows, smooth_about
from jaxsat.inertial.strapdown import Samples, error_between, strapdown
from jaxsat.studies.simulate import GRAVITY

from . import MissingPeer, shortest
from .paper_way import SegmentProblem, bar_problem, dense_objective, paper_way
from .smoothers import cuthbert_smoother, dynamax_smoother, linear_model, plain_smoother, walking_trials
from .strapdown import bare_trials, numba_strapdown


def whole_trial_cost(problem: SegmentProblem, delta: Float[np.ndarray, "m"]) -> float:
    """J*(δ) of `dense_objective` by jaxsat's smoother."""
    count = len(problem.signal)
    samples = Samples(
        signal=jnp.asarray(problem.filled(delta)),
        period=jnp.full(count, problem.period),
        variance=jnp.broadcast_to(jnp.asarray(problem.variance), (count, 6)),
    )
    no_height = jnp.zeros(count, bool)
    speed = jnp.full(count, problem.velocity_variance)
    rows = Rows(jnp.asarray(problem.rest), speed, no_height, jnp.ones(count))
    prior, gravity = jax.tree.map(jnp.asarray, problem.prior), jnp.asarray(problem.gravity)
    reference = strapdown(samples.signal, samples.period, prior, gravity)
    covariance = jnp.asarray(problem.prior_covariance)
    return float(jax.jit(smooth_about)(reference, samples, rows, prior, covariance, gravity).cost)


def _apart(found, expected) -> float:
    """Largest difference of means and covariances, relative to the largest mean and sd of each component."""
    (mean, covariance), (m, P) = (jax.tree.map(np.asarray, pair) for pair in (found, expected))
    sd = np.sqrt(np.einsum("bkii->bki", P)).max(axis=(0, 1))
    means = np.abs(mean - m).max(axis=(0, 1)) / np.abs(m).max(axis=(0, 1))
    return max(means.max(), (np.abs(covariance - P) / np.outer(sd, sd)).max())


def check_strapdown() -> None:
    """70 trials, which is no multiple of the lanes; all states and the last."""
    signal, initial = bare_trials(70, 120)
    signal[3] = 0.0
    period = jnp.full((70, 120), 0.01)
    expected = jax.vmap(partial(strapdown, gravity=jnp.asarray(GRAVITY)))(
        jnp.asarray(signal), period, jax.tree.map(jnp.asarray, initial)
    )
    for all_states in (True, False):
        found = numba_strapdown(signal, 0.01, initial, GRAVITY, all_states)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b if all_states else b[:, -1], atol=1e-10)
    # Almost one revolution in a sample, where the series are at their worst; one and a half is refused.
    fast = np.zeros((1, 2, 6))
    fast[0, :, 1] = 2.0 * np.pi - 1e-9
    first = jax.tree.map(lambda x: x[:1], initial)
    back = numba_strapdown(fast, 1.0, first, 0.0)
    np.testing.assert_allclose(back.q_nb, first.q_nb, atol=1e-8)
    try:
        numba_strapdown(1.5 * fast, 1.0, first, 0.0)
    except ValueError:
        return
    raise AssertionError("a sample of one and a half revolutions was not refused")


def check_paper() -> None:
    """The dense system and jaxsat's smoother agree on J*(δ)."""
    problem = bar_problem()
    objective = dense_objective(problem)
    zero = np.zeros(len(problem.sample))
    for delta in (zero, np.random.default_rng(0).uniform(0.0, problem.bound, len(zero))):
        np.testing.assert_allclose(objective(delta), whole_trial_cost(problem, delta), rtol=1e-10)


def check_smoothers() -> None:
    """dynamax, cuthbert and jaxsat against the textbook, singular noise and prior included."""
    trials = walking_trials(2, 300)
    model = linear_model(trials)
    np.testing.assert_allclose(model.root @ jnp.swapaxes(model.root, -1, -2), model.Q, atol=1e-20)
    expected = plain_smoother(model)

    def ours(reference, samples, rows, prior):
        found = smooth_about(reference, samples, rows, prior, trials.prior_covariance, jnp.asarray(GRAVITY))
        return jax.vmap(error_between)(found.state, reference), found.covariance

    found = jax.jit(jax.vmap(ours))(trials.reference, trials.samples, trials.rows, trials.prior)
    apart = {"jaxsat": _apart(found, expected), "dynamax": _apart(dynamax_smoother(model)(), expected)}
    for variant in ("moments", "sequential"):
        apart[f"cuthbert, {variant}"] = _apart(cuthbert_smoother(model, variant)(), expected)
    print({name: f"{value:.1e}" for name, value in apart.items()})
    assert max(apart.values()) < 1e-8, apart


def print_times() -> None:
    signal, initial = bare_trials(256, 512)
    for all_states in (False, True):
        run = partial(numba_strapdown, signal, 0.005, initial, GRAVITY, all_states)
        what = "all states" if all_states else "last state"
        print(
            f"numba strapdown, {what}: {1e6 * shortest(run, 50) / (256 * 512):.4f} µs per sample", flush=True
        )
    problem = bar_problem()
    run = partial(dense_objective(problem), np.zeros(len(problem.sample)))
    print(f"dense J*(δ): {1e3 * shortest(run):.1f} ms", flush=True)
    model = linear_model(walking_trials(64, 1000))
    print(f"dynamax: {shortest(dynamax_smoother(model)):.3f} s for 64 × 1,000 samples", flush=True)
    for variant in ("moments", "sequential"):
        seconds = shortest(cuthbert_smoother(model, variant))
        print(f"cuthbert, {variant}: {seconds:.3f} s for 64 × 1,000 samples", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(
        prog="python -m scripts.peers", description="What jaxsat's speed is compared with"
    )
    parser.add_argument("--check", action="store_true", help="does every peer compute what jaxsat computes?")
    parser.add_argument("--time", action="store_true", help="how long does each take?")
    parser.add_argument("--paper", action="store_true", help="solve one segment in the paper's way")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    try:
        if arguments.check:
            for check in (check_strapdown, check_paper, check_smoothers):
                check()
                print(f"{check.__name__}: agrees", flush=True)
        if arguments.time:
            print_times()
    except MissingPeer as missing:
        raise SystemExit(str(missing)) from None
    if arguments.paper:
        found = paper_way(bar_problem())
        print(
            f"J* {found.cost:.6f} in {found.seconds:.1f} s and {found.evaluations} evaluations: {found.message}"
        )


if __name__ == "__main__":
    main()
