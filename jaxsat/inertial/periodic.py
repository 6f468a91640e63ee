"""Drift-free position and angle of periodic motion by adaptive Fourier linear combiners.

The method of Latt, Veluvolu & Ang 2011 (Sensors 11, 5931-5949). Its equations are restated here from the
definitions that it builds on:

- WFLC, Riviere, Rader & Thakor 1998 (IEEE TBME 45, 839-846): least mean squares (LMS) on M harmonics of one
  frequency ω₀ (rad a sample) that is adapted too. With θ_k = Σ_{t≤k} ω₀ₜ, reference input
  x_k = [sin θ_k … sin Mθ_k, cos θ_k … cos Mθ_k] and error ε_k = s_k − w_kᵀx_k,
  ω₀,k+1 = ω₀k + 2μ₀ ε_k Σ_r r (w_rk x_{M+r,k} − w_{M+r,k} x_rk),  w_{k+1} = w_k + 2μ ε_k x_k.
- BMFLC, Veluvolu, Tan, Latt, Shee & Ang 2007 (IEEE EMBS, 2847-2850): the same LMS on a band of fixed
  frequencies, x_k = [sin ω₁k … sin ω_n k, cos ω₁k … cos ω_n k].
- Compensation, Latt et al. 2011, Section 2.2: where the input passed a chain of filters with gain g_r and phase φ_r
  at ω_r, the motion itself is w_kᵀx̂_k with x̂_k = [sin(ω_r k − φ_r)/g_r …, cos(ω_r k − φ_r)/g_r …].
- Analytical integration, Tan, Veluvolu, Latt, Shee, Riviere & Ang 2008 (IEEE Sensors J. 8, 1385-1388): the combiner
  runs on the acceleration, and its sines are integrated by division by −ω_r². In the terms above it is the
  compensation of a chain that differentiates twice; the sensor's filter is not part of it.

All of them are one statement: a motion Σ A_r exp(jω_r t) is seen as Σ G(ω_r) A_r exp(jω_r t), where G is the
response of everything in between, differentiation by motion and sensor included.
"""

from collections.abc import Sequence
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Complex, Float

from jaxsat.errors import InputError
from jaxsat.inertial.filters import Filter, apply, response, trapezoid


class Combined(eqx.Module):
    """What a linear combiner made of its input, a row each sample."""

    motion: Float[Array, "N"]
    """The compensated estimate w_kᵀx̂_k: position (m) or angle (rad)."""
    seen: Float[Array, "N"]
    """The estimate of the input itself, w_kᵀx_k: what is found without compensation."""
    weights: Float[Array, "N W"]
    """Before each sample's update."""
    frequency: Float[Array, "N F"]
    """Of the harmonics (Hz)."""


def band(low: float, high: float, spacing: float) -> Float[np.ndarray, "F"]:
    """Frequencies from `low` to `high` (Hz), `spacing` apart.

    Raises `InputError` where they are not 0 < low ≤ high with a positive spacing.
    """
    if not (0 < low <= high < np.inf and 0 < spacing < np.inf):
        raise InputError(
            f"the band {low:g} to {high:g} Hz with a spacing of {spacing:g} Hz is none; give 0 < low ≤ high."
        )
    return low + spacing * np.arange(int(np.floor((high - low) / spacing * (1 + 1e-9) + 1e-9)) + 1)


def chain_response(
    chain: Sequence[Filter], order: int, frequency: Float[Array, "*F"]
) -> Complex[Array, "*F"]:
    """G of a chain of filters behind a sensor that sees the `order`-th derivative of the motion, (jω)^order Π H.

    order: 2 for position by an accelerometer, 1 for an angle by a gyroscope; integrators are filters of the chain.
    """
    jw = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency)
    return jw**order * response(chain, frequency)


def compensated(
    phase: Float[Array, "*N F"], gain: Complex[Array, "F"] | Complex[Array, "*N F"]
) -> Float[Array, "*N W"]:
    """Reference input x̂ of the motion whose image through the gain G is [sin(phase), cos(phase)].

    sin(θ − arg G)/|G| and cos(θ − arg G)/|G|. With G = 1 it is the plain reference input x.
    """
    size, angle = (jnp.broadcast_to(part, phase.shape) for part in (jnp.abs(gain), jnp.angle(gain)))
    return jnp.concatenate([jnp.sin(phase - angle) / size, jnp.cos(phase - angle) / size], axis=-1)


def phases(frequency: Float[Array, "F"], time: Float[Array, "N"]) -> Float[Array, "N F"]:
    """ω_r t (rad)."""
    return 2 * jnp.pi * time[:, None] * frequency[None, :]


def references(
    frequency: Float[Array, "F"], time: Float[Array, "N"], gain: Complex[Array, "F"]
) -> tuple[Float[Array, "N W"], Float[Array, "N W"]]:
    """Reference inputs of a signal, x, and of the motion behind it, x̂, with a constant at their end.

    The constant takes up an offset of the signal, and is no motion.
    """
    angle, one = phases(frequency, time), jnp.ones((len(time), 1), time.dtype)
    x = jnp.concatenate([compensated(angle, jnp.ones_like(gain)), one], axis=1)
    return x, jnp.concatenate([compensated(angle, gain), 0 * one], axis=1)


def bmflc(
    signal: Float[Array, "N"],
    time: Float[Array, "N"],
    frequency: Float[Array, "F"],
    gain: Complex[Array, "F"],
    mu: Float[Array, ""] | float,
    bias: bool = False,
) -> Combined:
    """Band-limited multiple Fourier linear combiner (equations above), compensated by G at its frequencies.

    signal: in any unit; frequency: Hz; gain: `chain_response`, 1 for none; mu: LMS gain, stable below 1/F.
    bias: a constant reference beside the sines takes up an offset; it is no part of the estimates.
    """
    phase = phases(frequency, time)
    x = compensated(phase, jnp.ones_like(gain))
    z = compensated(phase, gain)
    extra = jnp.ones((len(signal), 1 if bias else 0), signal.dtype)

    def step(w, row):
        s, reference = row
        return w + 2 * mu * (s - w @ reference) * reference, w

    inputs = jnp.concatenate([x, extra], axis=1)
    _, w = jax.lax.scan(step, jnp.zeros(inputs.shape[1], signal.dtype), (signal, inputs))
    used = w[:, : x.shape[1]]
    rows = jnp.broadcast_to(frequency, phase.shape)
    return Combined(jnp.sum(used * z, axis=1), jnp.sum(used * x, axis=1), w, rows)


def wflc(
    signal: Float[Array, "N"],
    period: Float[Array, ""] | float,
    start: Float[Array, ""] | float,
    harmonics: int,
    chain: Sequence[Filter],
    order: int,
    mu: Float[Array, ""] | float,
    mu_frequency: Float[Array, ""] | float,
) -> Combined:
    """Weighted-frequency Fourier linear combiner (equations above), compensated by G at its present frequencies.

    start: first guess of the fundamental (Hz); harmonics: M; mu_frequency: μ₀, which scales with the inverse of the
    signal's power, so scale the signal to about 1. The fundamental is kept between 0 and half of the sampling rate.
    """
    r = jnp.arange(1, harmonics + 1, dtype=signal.dtype)
    rad = 2 * jnp.pi * period

    def step(carry, s):
        w, omega, theta = carry
        theta = theta + omega
        sine, cosine = jnp.sin(r * theta), jnp.cos(r * theta)
        x = jnp.concatenate([sine, cosine])
        error = s - w @ x
        slope = jnp.sum(r * (w[:harmonics] * cosine - w[harmonics:] * sine))
        after = jnp.clip(omega + 2 * mu_frequency * error * slope, 1e-6, jnp.pi / harmonics)
        # A multiple of 2π off the phase keeps its digits; the reference input does not change.
        carry = (w + 2 * mu * error * x, after, jnp.mod(theta, 2 * jnp.pi))
        return carry, (w, omega, r * theta)

    first = (jnp.zeros(2 * harmonics, signal.dtype), jnp.asarray(start * rad, signal.dtype))
    _, (w, omega, phase) = jax.lax.scan(step, (*first, jnp.zeros((), signal.dtype)), signal)
    frequency = omega[:, None] * r[None, :] / rad
    x = compensated(phase, jnp.ones_like(frequency, complex))
    z = compensated(phase, chain_response(chain, order, frequency))
    return Combined(jnp.sum(w * z, axis=1), jnp.sum(w * x, axis=1), w, frequency)


def integrated(
    signal: Float[Array, "N"], order: int, highpass: Filter, period: Float[Array, ""] | float
) -> tuple[Float[Array, "N"], tuple[Filter, ...]]:
    """A sensor's signal integrated `order` times and high-passed, and the chain of filters that did it.

    The first stage of Latt et al. 2011 (their block diagram of the position estimate).
    """
    chain = (*[trapezoid(period)] * order, highpass)
    for stage in chain:
        signal = apply(stage, signal)
    return signal, chain


@partial(jax.jit, static_argnames="order")
def latt_bmflc(
    signal: Float[Array, "N"],
    time: Float[Array, "N"],
    frequency: Float[Array, "F"],
    order: int,
    highpass: Filter,
    sensor: Sequence[Filter],
    mu: Float[Array, ""] | float,
) -> Combined:
    """Position (order 2) or angle (order 1) by the method of Latt et al. 2011 with the modified BMFLC.

    signal: specific force (m/s²) or angular rate (rad/s) as measured, offset included; sensor: its own filters.
    """
    period = time[1] - time[0]
    filtered, chain = integrated(signal, order, highpass, period)
    return bmflc(filtered, time, frequency, chain_response((*chain, *sensor), order, frequency), mu)


@partial(jax.jit, static_argnames="order")
def analytical(
    signal: Float[Array, "N"],
    time: Float[Array, "N"],
    frequency: Float[Array, "F"],
    order: int,
    mu: Float[Array, ""] | float,
) -> Combined:
    """Position or angle by analytical integration (Tan et al. 2008), the comparator of Latt et al. 2011.

    A BMFLC with a bias weight on the sensor's signal; knows nothing of the sensor's filter.
    """
    return bmflc(signal, time, frequency, chain_response((), order, frequency), mu, bias=True)
