"""Strapdown integration on one composable type: the interval.

An interval is what the sensors say about a stretch of time, whatever the state at its start. A sample is an
interval, several samples are one too: neighbours join into one, so `prefixes` needs a running product and running
sums only. Navigation needs an interval only through `advance`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsat.inertial.components import Quaternion, Vector
from jaxsat.inertial.dense import product
from jaxsat.inertial.preintegration import attitude_prefixes
from jaxsat.inertial.rotations import (
    quat_conjugate,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_normalise,
    quat_rotate,
    quat_to_matrix,
    skew,
)


class Interval(eqx.Module):
    """Motion over a stretch of time, seen from the body frame b₀ at its start, gravity not removed."""

    rotation: Float[Array, "*batch 4"]
    """Attitude change: the body frame at the end in that at the start (quaternion)."""
    velocity: Float[Array, "*batch 3"]
    """V = ∫ specific force dt in b₀ (m/s)."""
    position: Float[Array, "*batch 3"]
    """W = ∬ specific force dt² in b₀ (m)."""
    duration: Float[Array, "*batch"]
    """τ (s); a sample of zero makes an interval that changes nothing."""


class Samples(eqx.Module):
    """What the sensors measured, sample by sample."""

    signal: Float[Array, "N 6"]
    """Angular rate and specific force (rad/s, m/s²)."""
    period: Float[Array, "N"]
    """How long each sample holds; zero pads (s)."""
    variance: Float[Array, "N 6"]
    """Noise variance of each value."""


class NavState(eqx.Module):
    """Attitude, velocity and position of the body in the navigation frame (z up, heading arbitrary)."""

    q_nb: Float[Array, "*batch 4"]
    velocity: Float[Array, "*batch 3"]
    position: Float[Array, "*batch 3"]


def sample_interval(signal: Float[Array, "6"], period: Float[Array, ""]) -> Interval:
    """The interval of one sample (rad/s, m/s²) that holds for one period (s)."""
    force = quat_rotate(quat_exp(0.5 * period * signal[:3]), signal[3:])
    return Interval(
        rotation=quat_exp(period * signal[:3]),
        velocity=force * period,
        position=0.5 * force * period**2,
        duration=period,
    )


def sample_intervals(signal: Float[Array, "N 6"], period: Float[Array, "N"]) -> Interval:
    """`sample_interval` of each of N samples."""
    return jax.vmap(sample_interval)(signal, period)


class ErrorTransition(eqx.Module):
    """Φ = [[I, 0, 0], [A, I, τI], [B, 0, I]] of [θ, r, v], or [[I, 0], [B, I]] of [θ, v], by what it does."""

    position: Float[Array, "3 3"]
    """A."""
    velocity: Float[Array, "3 3"]
    """B."""
    duration: Float[Array, ""]
    """τ (s)."""

    def forth(self, x: Float[Array, "s k"]) -> Float[Array, "s k"]:
        """Φ x."""
        moved = x[-3:] + product(self.velocity, x[:3])
        if len(x) == 6:
            return jnp.concatenate([x[:3], moved])
        return jnp.concatenate([x[:3], x[3:6] + product(self.position, x[:3]) + self.duration * x[6:], moved])

    def back(self, x: Float[Array, "s k"]) -> Float[Array, "s k"]:
        """Φᵀ x."""
        turned = x[:3] + product(self.velocity.T, x[-3:])
        if len(x) == 6:
            return jnp.concatenate([turned, x[3:]])
        return jnp.concatenate(
            [turned + product(self.position.T, x[3:6]), x[3:6], x[6:] + self.duration * x[3:6]]
        )


def error_transition(q_nb: Float[Array, "4"], interval: Interval) -> ErrorTransition:
    """Transition Φ of the navigation-frame error [θ, r, v] over an interval that starts at attitude q_nb.

    θ is a rotation vector: R_true = exp([θ×]) R̂. It equals the paper's body-frame model (Eq. 8-9) with
    q̄_e = ½ R_bn θ, but the attitude error does not rotate: Φ = [[I,0,0], [−[W×],I,τI], [−[V×],0,I]].
    """
    return ErrorTransition(
        position=-skew(quat_rotate(q_nb, interval.position)),
        velocity=-skew(quat_rotate(q_nb, interval.velocity)),
        duration=interval.duration,
    )


def sample_noise(
    q_nb: Float[Array, "4"],
    signal: Float[Array, "6"],
    period: Float[Array, ""],
    variance: Float[Array, "6"],
) -> Float[Array, "9 9"]:
    """Covariance of [θ, r, v] in the navigation frame after one sample, each axis with its own variance.

    First order in the paper's Eq. 9: a rate turns θ by T, a specific force moves v by T and r by ½T².
    """
    R = quat_to_matrix(quat_multiply(q_nb, quat_exp(0.5 * period * signal[:3]))) * period
    turned = product(R * variance[None, :3], R.T)
    pushed = product(R * variance[None, 3:], R.T)
    zero, half = jnp.zeros_like(turned), 0.5 * period
    return jnp.block(
        [
            [turned, zero, zero],
            [zero, half**2 * pushed, half * pushed],
            [zero, half * pushed, pushed],
        ]
    )


def prefixes(intervals: Interval) -> Interval:
    """For each of N intervals (leading axis), the composition of all up to and including it.

    Attitude is a running product, velocity and position are running sums.
    """

    def before(x):
        return jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])

    rotation = attitude_prefixes(Quaternion.of(intervals.rotation)).stack()
    start = Quaternion.of(before(rotation).at[0, 0].set(1.0))
    velocity = jnp.cumsum(start.rotate(Vector.of(intervals.velocity)).stack(), axis=0)
    step = start.rotate(Vector.of(intervals.position)).stack()
    return Interval(
        rotation=rotation,
        velocity=velocity,
        position=jnp.cumsum(step + before(velocity) * intervals.duration[:, None], axis=0),
        duration=jnp.cumsum(intervals.duration),
    )


def advance(state: NavState, interval: Interval, gravity: Float[Array, ""]) -> NavState:
    """The state at the end of an interval (paper A, Eq. 3); gravity is its magnitude (m/s²)."""
    tau = interval.duration
    fall = jnp.zeros(3, tau.dtype).at[2].set(gravity)
    return NavState(
        q_nb=quat_normalise(quat_multiply(state.q_nb, interval.rotation)),
        velocity=state.velocity + quat_rotate(state.q_nb, interval.velocity) - fall * tau,
        position=(
            state.position
            + state.velocity * tau
            + quat_rotate(state.q_nb, interval.position)
            - 0.5 * fall * tau**2
        ),
    )


def strapdown(
    signal: Float[Array, "N 6"],
    period: Float[Array, "N"],
    initial: NavState,
    gravity: Float[Array, ""],
) -> NavState:
    """Open-loop integration: the N+1 states at the sample boundaries, the first being `initial`."""
    totals = prefixes(sample_intervals(signal, period))
    later = jax.vmap(lambda total: advance(initial, total, gravity))(totals)
    return jax.tree.map(lambda x0, x: jnp.concatenate([x0[None], x]), initial, later)


def add_error(state: NavState, error: Float[Array, "9"]) -> NavState:
    """The state that differs from `state` by the error [θ, r, v] (paper A, Eq. 4 and 7)."""
    return NavState(
        q_nb=quat_normalise(quat_multiply(quat_exp(error[:3]), state.q_nb)),
        velocity=state.velocity + error[6:],
        position=state.position + error[3:6],
    )


def error_between(state: NavState, reference: NavState) -> Float[Array, "9"]:
    """The error [θ, r, v] that takes `reference` to `state`."""
    theta = quat_log(quat_multiply(state.q_nb, quat_conjugate(reference.q_nb)))
    return jnp.concatenate([theta, state.position - reference.position, state.velocity - reference.velocity])
