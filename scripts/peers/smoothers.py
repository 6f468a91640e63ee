"""The linear smoother by general libraries in JAX, and as in a textbook."""

from functools import partial
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsat import Config, simulate
from jaxsat.inertial.dense import eigh
from jaxsat.inertial.smoother import VELOCITY, Rows
from jaxsat.inertial.strapdown import (
    NavState,
    Samples,
    error_transition,
    sample_intervals,
    sample_noise,
    strapdown,
)
from jaxsat.studies.motions import Walk
from jaxsat.studies.simulate import GRAVITY

from . import import_peer


class LinearModel(eqx.Module):
    """The smoother's quadratic problem of B trials about a reference: x' = F x + w, y = H x + e at rests.

    As in jaxsat, N samples lead to N+1 states [θ, r, v], and row k is one of state k; the last state has none.
    """

    F: Float[Array, "B N 9 9"]
    Q: Float[Array, "B N 9 9"]
    """cov(w), of rank 6."""
    root: Float[Array, "B N 9 6"]
    """Q = root rootᵀ."""
    H: Float[Array, "3 9"]
    R: Float[Array, "3 3"]
    """cov(e)."""
    y: Float[Array, "B N 3"]
    mask: Bool[Array, "B N"]
    """Where y was observed."""
    m0: Float[Array, "B 9"]
    P0: Float[Array, "B 9 9"]
    """May be singular."""


class WalkingTrials(eqx.Module):
    """B recordings of one walk, each with noise of its own, as `jaxsat.inertial.smoother` takes them."""

    samples: Samples
    reference: NavState
    """Open-loop strapdown."""
    rows: Rows
    prior: NavState
    prior_covariance: Float[Array, "9 9"]


def walking_trials(trials: int, count: int) -> WalkingTrials:
    """Foot-mounted recordings at 200 Hz, unsaturated; JAX must be in float64."""
    T, noise = 0.005, Config().noise
    motion = Walk(strides=max(1, int((count * T - 1.5) / 1.1)))
    _, truth = simulate(motion, rate=1 / T, duration=count * T, key=jax.random.key(0))
    variance = np.repeat([noise.gyr_density, noise.acc_density], 3) ** 2 / T
    errors = np.random.default_rng(0).normal(size=(trials, count, 6)) * np.sqrt(variance)
    samples = Samples(
        signal=jnp.asarray(truth.signal + errors),
        period=jnp.full((trials, count), T),
        variance=jnp.broadcast_to(jnp.asarray(variance), (trials, count, 6)),
    )
    start = NavState(jnp.asarray(truth.q_nb[0]), jnp.zeros(3), jnp.zeros(3))
    prior = jax.tree.map(lambda x: jnp.broadcast_to(x, (trials, *x.shape)), start)
    speed = jnp.asarray(noise.rest_velocity_sd**2)
    rest = jnp.broadcast_to(jnp.asarray(truth.rest), (trials, count))
    one = jnp.ones((trials, count))
    return WalkingTrials(
        samples=samples,
        reference=jax.jit(jax.vmap(partial(strapdown, gravity=jnp.asarray(GRAVITY))))(
            samples.signal, samples.period, prior
        ),
        rows=Rows(rest, speed * one, None, one),
        prior=prior,
        prior_covariance=jnp.diag(jnp.array([noise.initial_tilt_sd**2] * 2 + [0.0] * 4 + [speed] * 3)),
    )


def _root(matrix: Float[Array, "3 3"]) -> Float[Array, "3 3"]:
    """B with B Bᵀ = matrix."""
    values, vectors = eigh(matrix)
    return vectors * jnp.sqrt(jnp.maximum(values, 0.0))[None]


@jax.jit
def linear_model(trials: WalkingTrials) -> LinearModel:
    """The problem that `smooth_about` solves about the reference, in matrices."""

    def one(samples, reference, rest):
        start = jax.tree.map(lambda x: x[:-1], reference)
        intervals = sample_intervals(samples.signal, samples.period)
        Q = jax.vmap(sample_noise)(start.q_nb, samples.signal, samples.period, samples.variance)
        # cov(w) of a velocity and its position is one matrix V times [[¼T², ½T], [½T, 1]].
        turn, push = (jax.vmap(_root)(Q[:, part, part]) for part in (slice(0, 3), slice(6, 9)))
        half, zero = 0.5 * samples.period[:, None, None], jnp.zeros_like(turn)
        root = jnp.block([[turn, zero], [zero, half * push], [zero, push]])
        F = jax.vmap(lambda q, i: error_transition(q, i).forth(jnp.eye(9)))(start.q_nb, intervals)
        return F, Q, root, -start.velocity, rest

    F, Q, root, y, mask = jax.vmap(one)(trials.samples, trials.reference, trials.rows.rest)
    H = jnp.eye(9)[jnp.array(VELOCITY)]
    count = len(F)
    return LinearModel(
        F=F,
        Q=Q,
        root=root,
        H=H,
        R=trials.rows.velocity_variance[0, 0] * jnp.eye(3),
        y=y,
        mask=mask,
        m0=jnp.zeros((count, 9)),
        P0=jnp.broadcast_to(trials.prior_covariance, (count, 9, 9)),
    )


Variant = Literal["moments", "sequential", "parallel"]
Smoother = partial[tuple[Float[Array, "B N1 9"], Float[Array, "B N1 9 9"]]]
"""Means and covariances of the N+1 states of each trial; compiled by its first call. Its arguments lead with B."""


def _observed(model: LinearModel) -> tuple[Array, Array]:
    """H and y of the N+1 states; zeros where nothing was observed, which changes no estimate and is exact."""
    mask = jnp.pad(model.mask, ((0, 0), (0, 1)))[..., None]
    y = jnp.pad(model.y, ((0, 0), (0, 1), (0, 0)))
    return jnp.where(mask[..., None], model.H, 0.0), jnp.where(mask, y, 0.0)


def dynamax_smoother(model: LinearModel) -> Smoother:
    """`dynamax.lgssm_smoother`, vmapped.

    dynamax adds 1e-9 to the diagonal of each matrix that it solves with. In SI units that is more than a sample's
    position noise, so the model is handed over in units so small (1e-10 m, rad, m/s) that it does not matter.
    """
    ssm = import_peer("dynamax.linear_gaussian_ssm.inference")
    unit = 1e-10
    H, y = _observed(model)
    # In dynamax entry k + 1 leads from state k to k + 1, and entry 0 is not used.
    F, Q = (jnp.pad(x, ((0, 0), (1, 0), (0, 0), (0, 0))) for x in (model.F, model.Q / unit**2))
    inputs = (F, Q, H, y / unit, model.m0 / unit, model.P0 / unit**2)

    def one(F, Q, H, y, m0, P0):
        parameters = ssm.ParamsLGSSM(
            ssm.ParamsLGSSMInitial(m0, P0),
            ssm.ParamsLGSSMDynamics(F, None, None, Q),
            ssm.ParamsLGSSMEmissions(H, None, None, model.R / unit**2),
        )
        found = ssm.lgssm_smoother(parameters, y)
        return unit * found.smoothed_means, unit**2 * found.smoothed_covariances

    return partial(jax.jit(jax.vmap(one)), *jax.block_until_ready(inputs))


def cuthbert_smoother(model: LinearModel, variant: Variant = "moments") -> Smoother:
    """`cuthbert.filter` and `cuthbert.smoother` in square-root form, vmapped.

    variant: the filter of the linearised-moments family, the fastest on a CPU; the exact filter in sequence, which
    prepares each step for an associative scan; or that scan. The scan may block for ever on a CPU with few cores
    (seen with jaxlib 0.10.2 and two) unless XLA_FLAGS holds --xla_cpu_multi_thread_eigen=false.
    """
    cuthbert = import_peer("cuthbert")
    kalman = import_peer("cuthbert.gaussian.kalman")
    moments = import_peer("cuthbert.gaussian.moments")
    update = import_peer("cuthbertlib.kalman").filter_update
    H, y = _observed(model)
    values, vectors = jnp.linalg.eigh(model.P0)
    first = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[:, None, :]
    root = jnp.pad(model.root, ((0, 0), (0, 0), (0, 0), (0, 3)))
    noise_root, nothing = jnp.linalg.cholesky(model.R), jnp.zeros(3)

    def dynamics(inputs):
        return inputs[0], jnp.zeros(9), inputs[1]

    def observation(inputs):
        return inputs[2], nothing, noise_root, inputs[3]

    def dynamics_moments(state, inputs):
        return lambda x: (inputs[0] @ x, inputs[1]), state.mean

    def observation_moments(state, inputs):
        return lambda x: (inputs[2] @ x, noise_root), state.mean, inputs[3]

    def one(F, root, H, y, m0, first):
        # cuthbert observes nothing at state 0, so its row goes into the prior.
        (m0, first), _ = update(m0, first, H[0], nothing, noise_root, y[0])
        if variant == "moments":
            forward = moments.build_filter(m0, first, dynamics_moments, observation_moments)
        else:
            forward = kalman.build_filter(m0, first, dynamics, observation)
        inputs, parallel = (F, root, H[1:], y[1:]), variant == "parallel"
        states = cuthbert.filter(forward, inputs, forward.init_prepare(), parallel=parallel)
        found = cuthbert.smoother(kalman.build_smoother(dynamics), states, inputs, parallel=parallel)
        return found.mean, found.chol_cov @ jnp.swapaxes(found.chol_cov, -1, -2)

    inputs = (model.F, root, H, y, model.m0, first)
    return partial(jax.jit(jax.vmap(one)), *jax.block_until_ready(inputs))


def plain_smoother(model: LinearModel) -> tuple[np.ndarray, np.ndarray]:
    """Kalman filter and Rauch-Tung-Striebel smoother as in a textbook, in numpy; slow, to check the others."""
    F, Q, H, R, y, mask = (np.asarray(x) for x in (model.F, model.Q, model.H, model.R, model.y, model.mask))
    means, covariances = [], []
    for b in range(len(F)):
        m, P, filtered = np.asarray(model.m0[b]), np.asarray(model.P0[b]), []
        for k in range(len(F[b]) + 1):
            if k < len(F[b]) and mask[b, k]:
                gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
                # Joseph's form keeps P symmetric and positive.
                rest = np.eye(9) - gain @ H
                m, P = m + gain @ (y[b, k] - H @ m), rest @ P @ rest.T + gain @ R @ gain.T
            filtered.append((m, P))
            if k < len(F[b]):
                m, P = F[b, k] @ m, F[b, k] @ P @ F[b, k].T + Q[b, k]
        smoothed = [filtered[-1]]
        for k in reversed(range(len(F[b]))):
            (m, P), (later, spread) = filtered[k], smoothed[-1]
            predicted = F[b, k] @ P @ F[b, k].T + Q[b, k]
            gain = np.linalg.solve(predicted, F[b, k] @ P).T
            smoothed.append((m + gain @ (later - F[b, k] @ m), P + gain @ (spread - predicted) @ gain.T))
        means.append([m for m, _ in reversed(smoothed)])
        covariances.append([P for _, P in reversed(smoothed)])
    return np.array(means), np.array(covariances)
