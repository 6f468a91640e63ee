"""Attitude from a gyroscope and an accelerometer by complementary filters, without a rest after the motion.

The estimates of J. A. Barraza-Madrigal et al., Rev. Mex. Ing. Biomed. 35(3), 2014, 241-252 (paper C), with its
misprints corrected: Eq. 2 and 4 need half angles and no factor ½, Eq. 7 is [1, α/2, φ/2, θ/2], and with the DCM of
Eq. 5 the angle φ of Eq. 16 is -asin(DCM₁₃). The paper's DCM takes navigation vectors to the body: it is R_bn.

One step turns the attitude by σ = σ_gyro + σ_accel. In the navigation frame the drift of Eq. 13, measured up f
against estimated up z, is f × z = (f_y, -f_x, 0): nothing of it is vertical, so no gain can ever hold the heading.
"""

from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsat.inertial.components import Quaternion, Vector
from jaxsat.inertial.rotations import (
    quat_between,
    quat_to_matrix,
)

Estimate = Literal["gyro", "accel", "gyro_accel", "pi"]
"""σ_gyro; σ_accel; both added; both with the PI controller."""
Update = Literal["exact", "comp", "imp"]
"""How σ turns the attitude: as a rotation vector, by `Q_comp` (Eq. 4) or by `Q_imp` (Eq. 8)."""
Direction = Literal["mean", "unit"]
"""What is called up: specific force over g, whose mean is gravity, or its direction (Eq. 11), whose mean is not."""

WEIGHT = 0.5
"""ω_σ of Eq. 15."""
OFFSET_TIME = 1.0
"""A resting gyroscope reads its own offset, averaged over about so long (s): the paper's first second."""
_UP = (0.0, 0.0, 1.0)


def _infinite() -> Array:
    return jnp.asarray(jnp.inf)


def _zero() -> Array:
    return jnp.asarray(0.0)


class Gains(eqx.Module):
    """The PI controller of Eq. 15, in units of time: the same gains mean the same at every sampling rate."""

    kp: Float[Array, "*batch"] = eqx.field(converter=jnp.asarray)
    """1/s; the paper's gain per sample is `kp` times the period."""
    ki: Float[Array, "*batch"] = eqx.field(converter=jnp.asarray)
    """1/s²"""
    tau: Float[Array, "*batch"] = eqx.field(default_factory=_zero, converter=jnp.asarray)
    """Time constant of a low-pass on the specific force in the navigation frame (s); the paper has none, 0."""
    gate: Float[Array, "*batch"] = eqx.field(default_factory=_infinite, converter=jnp.asarray)
    """How far |a| may be from g: samples weigh exp(-½ ((|a| - g)/gate)²) (m/s²); infinity trusts all."""
    limit: Float[Array, "*batch"] = eqx.field(default_factory=_infinite, converter=jnp.asarray)
    """Anti-windup: the integral stays within ± this on each axis (rad/s)."""


class Start(eqx.Module):
    """What a first second at rest says."""

    q_nb: Float[Array, "4"]
    """Level from the mean specific force, heading zero."""
    offset: Float[Array, "3"]
    """ω_off of Eq. 10 (rad/s)."""
    gravity: Float[Array, ""]
    """|mean specific force| (m/s²)."""


class Attitude(eqx.Module):
    """Attitude q_nb at the N+1 sample boundaries: the first is the start, row k+1 has seen sample k."""

    q_nb: Float[Array, "M 4"]
    integral: Float[Array, "M 3"]
    """Rate that the integral term adds (rad/s): minus the offset that it learnt."""


def start_at_rest(signal: Float[Array, "n 6"]) -> Start:
    """Attitude, gyroscope offset and gravity from samples of a resting sensor (rad/s, m/s²)."""
    mean = jnp.mean(signal, axis=0)
    gravity = jnp.sqrt(mean[3:] @ mean[3:])
    return Start(quat_between(mean[3:], jnp.asarray(_UP, mean.dtype)), mean[:3], gravity)


def turn(sigma: Vector, update: Update) -> Quaternion:
    """The quaternion of one step's angles σ = (α, φ, θ) (rad), not normalised for "imp"."""
    if update == "exact":
        return Quaternion.exp(sigma)
    half = sigma * 0.5
    if update == "imp":
        return Quaternion(jnp.ones_like(half.x), half.x, half.y, half.z)
    zero = jnp.zeros_like(half.x)
    about_x = Quaternion(jnp.cos(half.x), jnp.sin(half.x), zero, zero)
    about_y = Quaternion(jnp.cos(half.y), zero, jnp.sin(half.y), zero)
    about_z = Quaternion(jnp.cos(half.z), zero, zero, jnp.sin(half.z))
    return about_z @ about_y @ about_x


def orientation(
    signal: Float[Array, "N 6"],
    period: Float[Array, "N"],
    trusted: Bool[Array, "N 2"],
    start: Start,
    gains: Gains,
    *,
    rest: Bool[Array, "N"] | None = None,
    estimate: Estimate = "pi",
    update: Update = "exact",
    direction: Direction = "mean",
) -> Attitude:
    """Attitude over a recording by one of the four estimates of paper C (Eq. 6-15).

    signal: angular rate and specific force (rad/s, m/s²); period: of each sample (s), zero pads; trusted: whether
    the gyroscope and the accelerometer of a sample can be believed (measured, not saturated). Specific force that
    is not trusted corrects nothing, and while the gyroscope is not, the integral stands still. rest: where the
    sensor is known to rest; there the integral follows what the gyroscope reads instead of the drift, about the
    vertical too. Differentiable in the gains, the signal and the start; `vmap` over any of them.
    """
    rest = jnp.zeros(len(signal), bool) if rest is None else rest
    return _run(signal, period, trusted, rest, start, gains, estimate, update, direction)


def ending(found: Attitude, start: Start) -> Start:
    """What is known at the end of a recording: attitude, and the offset with what the integral learnt."""
    return Start(found.q_nb[-1], start.offset - found.integral[-1], start.gravity)


def backward(
    signal: Float[Array, "N 6"],
    period: Float[Array, "N"],
    trusted: Bool[Array, "N 2"],
    end: Start,
    gains: Gains,
    rest: Bool[Array, "N"] | None = None,
) -> Attitude:
    """The PI controller run from a known end towards the start; rows in the order of time, as of `orientation`."""
    rest = jnp.zeros(len(signal), bool) if rest is None else rest
    # In reversed time the sensor turns the other way, its offset included.
    mirror = jnp.concatenate([-signal[::-1, :3], signal[::-1, 3:]], axis=1)
    turned = Start(end.q_nb, -end.offset, end.gravity)
    found = _run(mirror, period[::-1], trusted[::-1], rest[::-1], turned, gains, "pi", "exact", "mean")
    return Attitude(found.q_nb[::-1], -found.integral[::-1])


def _run(signal, period, trusted, rest, start: Start, gains: Gains, estimate, update, direction) -> Attitude:
    def step(state, sample):
        q, force, learnt = state
        rate, specific, T, trust, still = sample
        weight = trust[1] * _gate(specific, start.gravity, gains.gate)
        # A low-pass in a frame that hardly turns: what moves about a place averages to gravity there.
        share = weight * T / jnp.where(T > 0.0, gains.tau + T, 1.0)
        measured = q.rotate(Vector.of(_up(specific, start.gravity, direction)))
        force = force + (measured - force) * share
        drift = q.conjugate().rotate(Vector(force.y, -force.x, jnp.zeros_like(force.x))) * weight
        turning = Vector.of(rate) - Vector.of(start.offset)
        sigma = turning * T
        if estimate == "accel":
            sigma = drift
        elif estimate == "gyro_accel":
            sigma = sigma + drift
        elif estimate == "pi":
            added = learnt + drift * (WEIGHT * gains.ki * T * trust[0])
            read = learnt - (turning + learnt) * (T / (OFFSET_TIME + T))
            chosen = (jnp.where(still & (trust[0] > 0.0), a, b) for a, b in zip(read, added, strict=True))
            learnt = Vector(*(jnp.clip(x, -gains.limit, gains.limit) for x in chosen))
            sigma = sigma + (drift * (WEIGHT * gains.kp) + learnt) * T
        q = q @ turn(sigma, update)
        norm = 1.0 / jnp.sqrt(q.w**2 + q.x**2 + q.y**2 + q.z**2)
        q = Quaternion(q.w * norm, q.x * norm, q.y * norm, q.z * norm)
        return (q, force, learnt), (q.stack(), learnt.stack())

    up = Vector(*(jnp.asarray(x, signal.dtype) for x in _UP))
    nothing = jnp.zeros(3, signal.dtype)
    initial = (Quaternion.of(start.q_nb), up, Vector.of(nothing))
    samples = (signal[:, :3], signal[:, 3:], period, trusted.astype(signal.dtype), rest)
    _, (q_nb, learnt) = jax.lax.scan(step, initial, samples)
    return Attitude(jnp.concatenate([start.q_nb[None], q_nb]), jnp.concatenate([nothing[None], learnt]))


def _length(v: Float[Array, "3"]) -> Float[Array, ""]:
    """|v|, with a derivative at zero."""
    square = v @ v
    return jnp.where(square > 0.0, jnp.sqrt(jnp.where(square > 0.0, square, 1.0)), 0.0)


def _gate(force: Float[Array, "3"], gravity: Float[Array, ""], gate: Float[Array, ""]) -> Float[Array, ""]:
    return jnp.exp(-0.5 * ((_length(force) - gravity) / gate) ** 2)


def _up(force: Float[Array, "3"], gravity: Float[Array, ""], direction: Direction) -> Float[Array, "3"]:
    length = gravity if direction == "mean" else _length(force)
    return force / jnp.where(length > 0.0, length, 1.0)


def dcm(q_nb: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """The paper's direction cosine matrix (Eq. 5): R_bn."""
    return quat_to_matrix(q_nb).T


def euler_angles(q_nb: Float[Array, "4"]) -> Float[Array, "3"]:
    """Angles (α, φ, θ) about x, y and z (rad), of Q = Q_z(θ) ⊗ Q_y(φ) ⊗ Q_x(α) (Eq. 16, the sign of φ corrected).

    At φ = ±90° only a sum or difference of α and θ is defined.
    """
    D = dcm(q_nb)
    # Rounding may leave the sine a little beyond one.
    sine = jnp.clip(-D[0, 2], -1.0, 1.0)
    return jnp.stack([jnp.arctan2(D[1, 2], D[2, 2]), jnp.arcsin(sine), jnp.arctan2(D[0, 1], D[0, 0])])


def up_in_body(q_nb: Float[Array, "4"]) -> Float[Array, "3"]:
    """The vertical seen from the body: v̂ of Eq. 12, all that an attitude says of inclination."""
    return dcm(q_nb)[:, 2]
