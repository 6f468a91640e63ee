"""Strapdown integration on one composable type: the interval.

An interval is what the sensors say about a stretch of time, whatever the state at its start. A sample is an
interval, several samples are one too: `compose` joins neighbours and is associative, so prefixes can be taken
in any order. Navigation needs an interval only through `advance`.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

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
    """∫ specific force dt in b₀ (m/s)."""
    position: Float[Array, "*batch 3"]
    """∬ specific force dt² in b₀ (m)."""
    duration: Float[Array, "*batch"]
    """Length (s); zero makes the interval the identity of `compose`."""
    noise: Float[Array, "*batch 9 9"] | None = None
    """Covariance of the error [θ, r, v] gathered over the interval, in b₀; None where it is not asked for."""


class NavState(eqx.Module):
    """Attitude, velocity and position of the body in the navigation frame (z up, heading arbitrary)."""

    q_nb: Float[Array, "*batch 4"]
    velocity: Float[Array, "*batch 3"]
    position: Float[Array, "*batch 3"]


def sample_interval(
    gyr: Float[Array, "3"],
    acc: Float[Array, "3"],
    period: Float[Array, ""],
    variance: Float[Array, "6"] | None = None,
) -> Interval:
    """The interval of one sample that holds for one period.

    gyr (rad/s), acc (specific force, m/s²), period (s); variance: per-sample variances of the six channels,
    with which the interval carries its noise: G diag(variance) Gᵀ, of rank 6 (Eq. 9, first order).
    """
    half_turn = quat_exp(0.5 * period * gyr)
    force = quat_rotate(half_turn, acc)
    noise = None
    if variance is not None:
        R = quat_to_matrix(half_turn)
        gyr_cov = (R * variance[None, :3]) @ R.T * period**2
        acc_cov = (R * variance[None, 3:]) @ R.T * period**2
        zero = jnp.zeros_like(R)
        noise = jnp.block(
            [
                [gyr_cov, zero, zero],
                [zero, 0.25 * period**2 * acc_cov, 0.5 * period * acc_cov],
                [zero, 0.5 * period * acc_cov, acc_cov],
            ]
        )
    return Interval(
        rotation=quat_exp(period * gyr),
        velocity=force * period,
        position=0.5 * force * period**2,
        duration=period,
        noise=noise,
    )


def error_transition(q_nb: Float[Array, "4"], interval: Interval) -> Float[Array, "9 9"]:
    """Transition Φ of the navigation-frame error [θ, r, v] over an interval that starts at attitude q_nb.

    θ is a rotation vector: R_true = exp([θ×]) R̂. It equals the paper's body-frame model (Eq. 8-9) with
    q̄_e = ½ R_bn θ, but the attitude error does not rotate: Φ = [[I,0,0], [−[W×],I,τI], [−[V×],0,I]].
    """
    eye, zero = jnp.eye(3, dtype=q_nb.dtype), jnp.zeros((3, 3), q_nb.dtype)
    return jnp.block(
        [
            [eye, zero, zero],
            [-skew(quat_rotate(q_nb, interval.position)), eye, interval.duration * eye],
            [-skew(quat_rotate(q_nb, interval.velocity)), zero, eye],
        ]
    )


def rotate_noise(q: Float[Array, "4"], noise: Float[Array, "9 9"]) -> Float[Array, "9 9"]:
    """The same covariance of [θ, r, v] in a frame rotated by q."""
    R = quat_to_matrix(q)
    blocks = noise.reshape(3, 3, 3, 3)
    return jnp.einsum("ij,ajbk,lk->aibl", R, blocks, R).reshape(9, 9)


def navigation_noise(q_nb: Float[Array, "4"], interval: Interval) -> Float[Array, "9 9"]:
    """The interval's noise in the navigation frame, for an interval that carries it and starts at q_nb."""
    if interval.noise is None:
        raise ValueError("this interval carries no noise; give `variance` where it is made")
    return rotate_noise(q_nb, interval.noise)


def compose(first: Interval, second: Interval) -> Interval:
    """Two neighbouring intervals as one; associative."""
    second_velocity = quat_rotate(first.rotation, second.velocity)
    second_position = quat_rotate(first.rotation, second.position)
    noise = None
    if first.noise is not None and second.noise is not None:
        transition = error_transition(first.rotation, second)
        noise = transition @ first.noise @ transition.T + rotate_noise(first.rotation, second.noise)
    return Interval(
        rotation=quat_multiply(first.rotation, second.rotation),
        velocity=first.velocity + second_velocity,
        position=first.position + first.velocity * second.duration + second_position,
        duration=first.duration + second.duration,
        noise=noise,
    )


def prefixes(intervals: Interval) -> Interval:
    """For each of N intervals (leading axis), the composition of all up to and including it."""

    def step(total, interval):
        total = compose(total, interval)
        return total, total

    nothing = jax.tree.map(lambda x: jnp.zeros_like(x[0]), intervals)
    nothing = eqx.tree_at(lambda i: i.rotation, nothing, nothing.rotation.at[0].set(1.0))
    return jax.lax.scan(step, nothing, intervals)[1]


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


def sample_intervals(
    signal: Float[Array, "N 6"],
    period: Float[Array, "N"],
    variance: Float[Array, "N 6"] | None = None,
) -> Interval:
    """One interval a sample, from the six channels (rad/s, m/s²); a period of zero pads."""
    if variance is None:
        return jax.vmap(lambda s, T: sample_interval(s[:3], s[3:], T))(signal, period)
    return jax.vmap(lambda s, T, var: sample_interval(s[:3], s[3:], T, var))(signal, period, variance)


def input_effects(
    signal: Float[Array, "N 6"], period: Float[Array, "N"]
) -> tuple[Interval, Float[Array, "N 9 6"]]:
    """What N samples add up to, and how an error of each input shows at their end.

    Returns the interval without noise, and G: the error [θ, r, v] at the end, in the body frame at the start,
    per unit error of each channel of each sample. With the parts V_rem, W_rem, τ_rem that follow sample j
    its columns are T[I; −[W_rem×]; −[V_rem×]]R_j for the gyroscope and T[0; ½T + τ_rem; I]R_j for the
    accelerometer (R_j: attitude in mid-sample), all of them differences of prefix sums.
    """
    upto = prefixes(sample_intervals(signal, period))
    total = jax.tree.map(lambda x: x[-1], upto)

    def effect(rotation, velocity, position, duration, gyr, T):
        # The end attitude turned back by half a sample is the attitude in its middle.
        R = quat_to_matrix(quat_multiply(rotation, quat_exp(-0.5 * T * gyr)))
        remaining = total.duration - duration
        velocity_left = total.velocity - velocity
        position_left = total.position - position - velocity * remaining
        turn = jnp.concatenate([R, -skew(position_left) @ R, -skew(velocity_left) @ R])
        push = jnp.concatenate([jnp.zeros_like(R), (0.5 * T + remaining) * R, R])
        return T * jnp.concatenate([turn, push], axis=1)

    return total, jax.vmap(effect)(
        upto.rotation, upto.velocity, upto.position, upto.duration, signal[:, :3], period
    )


def collapse(
    signal: Float[Array, "N 6"], period: Float[Array, "N"], variance: Float[Array, "N 6"]
) -> Interval:
    """N samples as one interval with its noise: equal to composing them one by one, at the cost of prefix sums."""
    total, effects = input_effects(signal, period)
    spread = jnp.moveaxis(effects * jnp.sqrt(variance)[:, None, :], 1, 0).reshape(9, -1)
    return eqx.tree_at(lambda i: i.noise, total, spread @ spread.T, is_leaf=lambda x: x is None)


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
