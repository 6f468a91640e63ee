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


class Moments(eqx.Module):
    """Noise of an interval as sums over its samples, for noise that is the same on all axes of a sensor.

    An error of sample j reaches the end of the interval through what follows it: V_j, W_j and τ_j, seen from
    the interval's start. Isotropic noise needs no more than the second moments of those.
    """

    gyr: Float[Array, "*batch 7 7"]
    """Σ c_j h_j h_jᵀ with h_j = [W_j; V_j; 1] and c_j the variance of a rate times T²."""
    acc: Float[Array, "*batch 2 2"]
    """Σ a_j s_j s_jᵀ with s_j = [½T + τ_j; 1] and a_j the variance of a specific force times T²."""


class Interval(eqx.Module):
    """Motion over a stretch of time, seen from the body frame b₀ at its start, gravity not removed."""

    rotation: Float[Array, "*batch 4"]
    """Attitude change: the body frame at the end in that at the start (quaternion)."""
    velocity: Float[Array, "*batch 3"]
    """V = ∫ specific force dt in b₀ (m/s)."""
    position: Float[Array, "*batch 3"]
    """W = ∬ specific force dt² in b₀ (m)."""
    duration: Float[Array, "*batch"]
    """τ (s); zero makes the interval the identity of `compose`."""
    noise: Moments | None = None
    """None where it is not asked for."""


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


def sample_interval(
    signal: Float[Array, "6"], period: Float[Array, ""], variance: Float[Array, "2"] | None = None
) -> Interval:
    """The interval of one sample (rad/s, m/s²) that holds for one period (s).

    variance: of a gyroscope and an accelerometer axis; with it the interval carries its noise.
    """
    force = quat_rotate(quat_exp(0.5 * period * signal[:3]), signal[3:])
    noise = None
    if variance is not None:
        s = jnp.stack([0.5 * period, jnp.ones_like(period)])
        noise = Moments(
            gyr=jnp.zeros((7, 7), signal.dtype).at[6, 6].set(variance[0] * period**2),
            acc=variance[1] * period**2 * jnp.outer(s, s),
        )
    return Interval(
        rotation=quat_exp(period * signal[:3]),
        velocity=force * period,
        position=0.5 * force * period**2,
        duration=period,
        noise=noise,
    )


def sample_intervals(
    signal: Float[Array, "N 6"], period: Float[Array, "N"], variance: Float[Array, "N 2"] | None = None
) -> Interval:
    """`sample_interval` of each of N samples."""
    if variance is None:
        return jax.vmap(sample_interval)(signal, period)
    return jax.vmap(sample_interval)(signal, period, variance)


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
    turned = (R * variance[None, :3]) @ R.T
    pushed = (R * variance[None, 3:]) @ R.T
    zero, half = jnp.zeros_like(turned), 0.5 * period
    return jnp.block(
        [
            [turned, zero, zero],
            [zero, half**2 * pushed, half * pushed],
            [zero, half * pushed, pushed],
        ]
    )


def _congruence(x: Float[Array, "n n"], g: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """x g xᵀ as sums, which fuse: many products of small matrices would be a library call each."""
    xg = jnp.sum(x[:, :, None] * g[None, :, :], axis=1)
    return jnp.sum(xg[:, None, :] * x[None, :, :], axis=2)


def shift_moments(q: Float[Array, "4"], noise: Moments, later: Interval) -> Moments:
    """Moments of an interval that starts at attitude q and is followed by `later`, seen from the frame of q's."""
    tau, R = later.duration, quat_to_matrix(q)
    zero, row, one = jnp.zeros_like(R), jnp.zeros((1, 3), R.dtype), jnp.ones((1, 1), R.dtype)
    h = jnp.block(
        [[R, tau * R, later.position[:, None]], [zero, R, later.velocity[:, None]], [row, row, one]]
    )
    s = jnp.eye(2, dtype=R.dtype).at[0, 1].set(tau)
    return Moments(gyr=_congruence(h, noise.gyr), acc=_congruence(s, noise.acc))


def compose(first: Interval, second: Interval) -> Interval:
    """Two neighbouring intervals as one; associative."""
    turned = Interval(
        rotation=second.rotation,
        velocity=quat_rotate(first.rotation, second.velocity),
        position=quat_rotate(first.rotation, second.position),
        duration=second.duration,
    )
    noise = None
    if first.noise is not None and second.noise is not None:
        identity = jnp.zeros_like(first.rotation).at[0].set(1.0)
        nothing = jax.tree.map(jnp.zeros_like, turned)
        noise = jax.tree.map(
            jnp.add,
            shift_moments(identity, first.noise, turned),
            shift_moments(first.rotation, second.noise, nothing),
        )
    return Interval(
        rotation=quat_multiply(first.rotation, second.rotation),
        velocity=first.velocity + turned.velocity,
        position=first.position + first.velocity * second.duration + turned.position,
        duration=first.duration + second.duration,
        noise=noise,
    )


def between(first: Interval, second: Interval) -> Interval:
    """What leads from one interval to a longer one with the same start: compose(first, result) = second."""
    back, duration = quat_conjugate(first.rotation), second.duration - first.duration
    return Interval(
        rotation=quat_multiply(back, second.rotation),
        velocity=quat_rotate(back, second.velocity - first.velocity),
        position=quat_rotate(back, second.position - first.position - first.velocity * duration),
        duration=duration,
    )


def noise_covariance(noise: Moments) -> Float[Array, "9 9"]:
    """Covariance of [θ, r, v] at the end, in the frame of the start: Σ c b bᵀ + Σ a d dᵀ with
    b = [I; −[W×]; −[V×]] and d = [0; sI; I]; [x×][y×]ᵀ = (x·y)I − y xᵀ."""
    eye = jnp.eye(3, dtype=noise.gyr.dtype)
    outer = noise.gyr[:6, :6].reshape(2, 3, 2, 3)
    lift, speed = -skew(noise.gyr[:3, 6]), -skew(noise.gyr[3:6, 6])

    def block(i, j):
        return (jnp.trace(outer[i, :, j]) + noise.acc[i, j]) * eye - outer[j, :, i]

    return jnp.block(
        [
            [noise.gyr[6, 6] * eye, lift.T, speed.T],
            [lift, block(0, 0), block(0, 1)],
            [speed, block(1, 0), block(1, 1)],
        ]
    )


@jax.custom_jvp
def rotation_prefixes(rotations: Float[Array, "N 4"]) -> Float[Array, "N 4"]:
    """q₀⊗…⊗q_j for each j."""

    def step(total, rotation):
        total = quat_multiply(total, rotation)
        return total, total

    identity = jnp.zeros_like(rotations[0]).at[0].set(1.0)
    return jax.lax.scan(step, identity, rotations)[1]


@rotation_prefixes.defjvp
def _rotation_prefixes_jvp(primals, tangents):
    # A right turn φ_i of factor i is a left turn R_i φ_i of every product from i on, so tangents add up.
    (rotations,), (rates,) = primals, tangents
    totals = rotation_prefixes(rotations)
    turn = 2.0 * jax.vmap(quat_multiply)(jax.vmap(quat_conjugate)(rotations), rates)[:, 1:]
    turned = jnp.cumsum(jax.vmap(quat_rotate)(totals, turn), axis=0)
    left = jnp.concatenate([jnp.zeros_like(turned[:, :1]), 0.5 * turned], axis=1)
    return totals, jax.vmap(quat_multiply)(left, totals)


def prefixes(intervals: Interval) -> Interval:
    """For each of N intervals (leading axis), the composition of all up to and including it, without noise.

    Attitude is a running product, velocity and position are running sums.
    """

    def before(x):
        return jnp.concatenate([jnp.zeros_like(x[:1]), x[:-1]])

    rotation = rotation_prefixes(intervals.rotation)
    start = before(rotation).at[0, 0].set(1.0)
    velocity = jnp.cumsum(jax.vmap(quat_rotate)(start, intervals.velocity), axis=0)
    step = jax.vmap(quat_rotate)(start, intervals.position)
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
