"""Recordings of which the lost values are drawn from the signal prior: what intervals are calibrated for.

One motion says little about intervals: where the prior makes its peak a little too high, it does so at every seed.
Simulation-based calibration (Talts et al. 2018, arXiv:1804.06788) draws the truth from the prior instead.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.special import ndtr, ndtri

from jaxsat.config import Config
from jaxsat.inertial.rotations import quat_conjugate, quat_exp, quat_multiply, quat_rotate
from jaxsat.inertial.strapdown import NavState, strapdown
from jaxsat.signals.recording import Recording
from jaxsat.studies.simulate import GRAVITY, Truth

from .searches import problem_of
from .trials import Settings, clipped

# Of a Gibbs sampler over the values of a gap. The values of smooth movement go together, so it mixes slowly.
SWEEPS = 300
UP = np.array([0.0, 0.0, GRAVITY])


def drawn(chosen: Settings, seed: int) -> tuple[Recording, Truth, Config]:
    """A recording clipped at its rails, as `trials.clipped`, with other lost rates.

    They are drawn from what `map` expects of them. The acceleration in the navigation frame stays as it was, so the
    specific force is that which a sensor turned so would have read, and the rest comes at rest.
    """
    recording, truth, config = clipped(chosen, seed)
    _, problem = problem_of(recording, config, "map")
    known, bound = problem.segment.known, np.asarray(problem.segment.bound)
    assert known is not None, "the signal prior was gathered"
    real = bound > 0.0
    mean = -np.asarray(known.covariance @ known.slope)[real]
    covariance = np.asarray(known.believed)[real][:, real]
    delta = _draw(np.random.default_rng([chosen["seed"], seed]), mean, covariance, bound[real])
    noise, (sample, channel) = truth.noisy - truth.signal, np.nonzero(truth.saturated)
    assert len(sample) == len(delta) and (channel < 3).all(), "rates saturate"
    signal, noisy = truth.signal.copy(), truth.noisy.copy()
    way = np.sign(noisy[sample, channel])
    noisy[sample, channel] = recording.signal[sample, channel] + way * delta
    signal[sample, channel] = (noisy - noise)[sample, channel]

    period = 1.0 / chosen["rate"]
    start = NavState(*(jnp.asarray(x[0]) for x in (truth.q_nb, truth.velocity, truth.position)))
    before, after = (_middle_attitudes(rates, period, start) for rates in (truth.signal, signal))
    push = np.array(jax.vmap(quat_rotate)(before, jnp.asarray(truth.signal[:, 3:]))) - UP
    # Samples are the signal at the middle of their period: their sum is a little off.
    push[~truth.rest] -= push.sum(axis=0) / np.sum(~truth.rest)
    back = jax.vmap(quat_conjugate)(after)
    signal[:, 3:] = jax.vmap(quat_rotate)(back, jnp.asarray(push + UP))
    noisy[:, 3:] = signal[:, 3:] + noise[:, 3:]
    states = _states(signal, period, start)
    truth = eqx.tree_at(
        lambda t: (t.q_nb, t.position, t.velocity, t.signal, t.noisy),
        truth,
        (*(np.asarray(x)[:-1] for x in (states.q_nb, states.position, states.velocity)), signal, noisy),
    )
    whole = np.where(truth.saturated, recording.signal, noisy)
    return recording.with_signal(whole), truth, config


def _states(signal: Float[np.ndarray, "N 6"], period: float, start: NavState) -> NavState:
    return strapdown(jnp.asarray(signal), jnp.full(len(signal), period), start, jnp.asarray(GRAVITY))


def _middle_attitudes(signal: Float[np.ndarray, "N 6"], period: float, start: NavState):
    """At the middle of each sample, of the rates alone."""
    halves = jax.vmap(quat_exp)(0.5 * period * jnp.asarray(signal[:, :3]))
    return jax.vmap(quat_multiply)(_states(signal, period, start).q_nb[:-1], halves)


def _draw(
    rng: np.random.Generator,
    mean: Float[np.ndarray, "m"],
    covariance: Float[np.ndarray, "m m"],
    upper: Float[np.ndarray, "m"],
) -> Float[np.ndarray, "m"]:
    """Of a Gaussian within 0 and `upper`."""
    precision, drawn = np.linalg.inv(covariance), np.clip(mean, 1e-3 * upper, 0.999 * upper)
    for _ in range(SWEEPS):
        for i in range(len(drawn)):
            sd = 1.0 / np.sqrt(precision[i, i])
            middle = drawn[i] - precision[i] @ (drawn - mean) / precision[i, i]
            low, high = -middle / sd, (upper[i] - middle) / sd
            # In the tail where the distribution function still tells its values apart.
            side = -1.0 if low > 0.0 else 1.0
            ends = ndtr(side * low), ndtr(side * high)
            drawn[i] = middle + sd * side * ndtri(rng.uniform(*sorted(ends)))
    return drawn
