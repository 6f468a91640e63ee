"""Linear filters with a known frequency response: what stands between a motion and the signal that is fitted."""

from collections.abc import Sequence
from typing import Any, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Complex, Float

from jaxsat.errors import InputError


class Filter(eqx.Module):
    """A linear filter as a cascade of second-order sections.

    Digital (`period` given): each row holds the coefficients of 1, z⁻¹, z⁻². Analogue (`period` is None), such as
    the one in a sensor before its converter: of 1, s, s² (s in rad/s). An analogue filter has a response only.
    """

    numerator: Float[Array | np.ndarray, "S 3"]
    denominator: Float[Array | np.ndarray, "S 3"]
    period: Float[Array | np.ndarray, ""] | float | None = None
    """Sampling period (s)."""


def butterworth(kind: str, order: int, cutoff: float, rate: float | None) -> Filter:
    """A Butterworth filter, `kind` "highpass" or "lowpass", cut-off in Hz; analogue where `rate` (Hz) is None.

    Raises `InputError` for an order below 1 or a cut-off that is not between 0 and half of the rate.
    """
    if order < 1:
        raise InputError(f"the {kind} filter has order {order}; give 1 or more.")
    if not (np.isfinite(cutoff) and cutoff > 0):
        raise InputError(f"the {kind} filter's cut-off is {cutoff} Hz; give a positive frequency.")
    if rate is None:
        return _analogue(
            *cast(Any, scipy.signal.butter(order, 2 * np.pi * cutoff, kind, analog=True, output="zpk"))
        )
    if cutoff >= rate / 2:
        raise InputError(
            f"the {kind} filter's cut-off of {cutoff:g} Hz is not below {rate / 2:g} Hz, half of the sampling "
            "rate; lower it, or check the rate."
        )
    sections = np.asarray(scipy.signal.butter(order, cutoff, kind, fs=rate, output="sos"))
    return Filter(sections[:, :3], sections[:, 3:], 1.0 / rate)


def _analogue(zeros: np.ndarray, poles: np.ndarray, gain: float) -> Filter:
    """Sections of ascending powers of s from zeros, poles and gain; conjugate poles share a section."""
    rows = []
    ordered = sorted(poles, key=lambda p: (abs(p.imag) < 1e-9 * abs(p), abs(p), abs(p.imag), p.imag))
    for i in range(0, len(ordered), 2):
        both = (zeros[i : i + 2], ordered[i : i + 2])
        rows.append([np.real(np.atleast_1d(np.poly(roots)))[::-1] for roots in both])
    padded = np.array([[np.pad(part, (0, 3 - len(part))) for part in row] for row in rows])
    padded[0, 0] *= gain
    return Filter(padded[:, 0], padded[:, 1])


def trapezoid(period: Float[Array, ""] | float) -> Filter:
    """Integration by the trapezoidal rule: y_k = y_{k-1} + T (x_k + x_{k-1})/2."""
    half = jnp.asarray(period, float) / 2
    top = jnp.stack([half, half, jnp.zeros_like(half)])
    return Filter(top[None, :], jnp.array([[1.0, -1.0, 0.0]]), period)


def response(chain: Sequence[Filter], frequency: Float[Array, "*F"]) -> Complex[Array, "*F"]:
    """Frequency response of filters in series: B(z)/A(z) at z = exp(jωT), or B(s)/A(s) at s = jω.

    frequency: Hz. Its modulus is the gain, its argument the phase that a sinusoid takes on.
    """
    jw = jax.lax.complex(jnp.zeros_like(frequency), 2 * jnp.pi * frequency)
    total = jnp.ones_like(jw)
    for stage in chain:
        x = jw if stage.period is None else jnp.exp(-jw * jnp.asarray(stage.period, jw.dtype))
        powers = jnp.stack([jnp.ones_like(x), x, x * x])
        top = jnp.tensordot(jnp.asarray(stage.numerator, jw.dtype), powers, 1)
        bottom = jnp.tensordot(jnp.asarray(stage.denominator, jw.dtype), powers, 1)
        total = total * jnp.prod(top / bottom, axis=0)
    return total


def apply(stage: Filter, x: Float[Array, "N"]) -> Float[Array, "N"]:
    """A digital filter run over a signal from rest (direct form II transposed, Oppenheim & Schafer 2010, 6.4.2)."""
    if stage.period is None:
        raise ValueError("an analogue filter has a response, but cannot be run over samples")
    for top, bottom in zip(jnp.asarray(stage.numerator), jnp.asarray(stage.denominator), strict=True):
        b, a = top / bottom[0], bottom / bottom[0]

        def step(state, value, b=b, a=a):
            y = b[0] * value + state[0]
            return jnp.stack([b[1] * value - a[1] * y + state[1], b[2] * value - a[2] * y]), y

        _, x = jax.lax.scan(step, jnp.zeros(2, x.dtype), x)
    return x
