"""Saturated samples of a periodic signal, filled by the harmonics that its other samples have."""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.scipy.linalg import solve_triangular
from jax.scipy.special import log_ndtr
from jaxtyping import Array, Bool, Float, Int

from jaxsat.errors import InputError
from jaxsat.inertial.harmonic import Spectrum
from jaxsat.inertial.programs import computing
from jaxsat.inertial.windows import Windows, harmonics, neighbours, periodogram

SAMPLES = 256
"""Length of the stretches that are filled together; as many weights as samples."""
CLEAN = 8
ITERATIONS = 12
DAMPING = 0.7


class HarmonicFill(eqx.Module):
    """A signal with its saturated samples replaced."""

    signal: Float[np.ndarray, "N"]
    """As measured, and the posterior mean where saturated: never short of the measured value."""
    sd: Float[np.ndarray, "N"]
    """sd of each value; that of the noise where it was measured, 0 throughout if all were."""


class _Sites(eqx.Module):
    """Gaussian factors that stand for what saturated samples say (expectation propagation)."""

    precision: Float[Array, "V L"]
    shift: Float[Array, "V L"]


def fill_harmonic(
    signal: Float[np.ndarray, "N"],
    sign: Int[np.ndarray, "N"],
    missing: Bool[np.ndarray, "N"] | None = None,
) -> HarmonicFill:
    """Fill the saturated samples of one channel from the spectrum of the rest of it.

    signal: as measured, in any unit; sign: -1 or +1 where it saturates in that direction, else 0; missing: samples
    that were not measured at all, which are filled too, without a side.

    In stretches of `SAMPLES` the signal is a sum of sinusoids up to a quarter of the sampling rate, twice as dense
    as the stretch resolves, plus white noise. The variance of each frequency and of the noise are those that make
    the signal most probable (expectation-maximisation, common to all stretches up to a scale for each). A saturated
    sample says that the value lies at or beyond the measured one, on its side: a probit factor, taken into account
    by expectation propagation (Minka 2001; Rasmussen & Williams 2006, 3.6). Its fill and sd are those of the normal
    distribution that the neighbours leave, cut off at the rail. Raises `InputError` where less than a quarter of
    the signal was measured, or fewer than 16 samples.
    """
    measured = (sign == 0) & (True if missing is None else ~missing)
    if measured.sum() < max(16, len(signal) / 4):
        raise InputError(
            f"only {measured.sum()} of {len(signal)} samples are not saturated, too few to learn a spectrum from; "
            "record with a larger range."
        )
    if measured.all():
        return HarmonicFill(signal.copy(), np.zeros(len(signal)))
    with computing():
        return _fill(signal, sign, measured)


def _fill(signal: np.ndarray, sign: np.ndarray, measured: np.ndarray) -> HarmonicFill:
    index = np.arange(len(signal))
    offset, scale = signal[measured].mean(), max(signal[measured].std(), 1e-300)
    y = (signal - offset) / scale
    windows = _with_gaps(Windows.cut(len(y), min(SAMPLES, len(y))), measured)
    length = windows.length
    frequency = np.arange(1, length // 2) / (2 * length)
    x = harmonics(np.arange(length, dtype=float), frequency)
    # A first guess of the spectrum, from a straight line over each gap.
    power = periodogram(windows.of(np.interp(index, index[measured], y[measured])), frequency)
    start = Spectrum(
        jnp.asarray(np.concatenate([power, power, [1.0]])), jnp.asarray(max(np.median(power), 1e-6) * length)
    )
    mean, variance, noise = _propagate(
        jnp.asarray(windows.of(y)), jnp.asarray(windows.of(sign.astype(float))),
        jnp.asarray(windows.of(measured)), jnp.asarray(x), jnp.asarray(neighbours(len(frequency), 1)), start,
        ITERATIONS,
    )  # fmt: skip
    # Windows without gaps may be left out: there nothing is filled.
    filled = windows.joined(np.asarray(mean))
    sd = windows.joined(np.sqrt(np.asarray(variance)))
    # Rounding must not put a fill short of its rail.
    beyond = np.where(sign == 0, filled, sign * np.maximum(sign * filled, sign * y))
    return HarmonicFill(
        np.where(measured, signal, beyond * scale + offset),
        np.where(measured, float(np.sqrt(noise)), sd) * scale,
    )


def _with_gaps(windows: Windows, measured: Bool[np.ndarray, "N"]) -> Windows:
    """The windows with gaps, and at least `CLEAN` of the others, from which the spectrum is learnt too.

    In all a power of two where there are so many: channels and recordings then share compiled programs.
    """
    gaps = ~np.all(windows.of(measured), axis=1)
    count = min(len(gaps), 1 << int(gaps.sum() + CLEAN - 1).bit_length())
    clean = np.flatnonzero(~gaps)
    drawn = clean[np.linspace(0, len(clean) - 1, count - gaps.sum()).astype(int)] if len(clean) else clean
    used = np.sort(np.concatenate([np.flatnonzero(gaps), drawn]))
    return Windows(windows.start[used], windows.length, windows.samples)


@partial(jax.jit, static_argnames="iterations")
def _propagate(
    y: Float[Array, "V L"],
    sign: Float[Array, "V L"],
    measured: Bool[Array, "V L"],
    x: Float[Array, "L W"],
    group: Float[Array, "W W"],
    start: Spectrum,
    iterations: int,
) -> tuple[Float[Array, "V L"], Float[Array, "V L"], Float[Array, ""]]:
    """Mean and variance of what each sample should have read, and the noise variance."""

    def one(row, spectrum):
        y, sign, there, scale, precision, shift = row
        root = jnp.sqrt(spectrum.prior * scale)
        precision = jnp.where(there, 1 / spectrum.noise, precision)
        shift = jnp.where(there, y / spectrum.noise, shift)
        scaled = x * root[None, :]
        hessian = jnp.eye(x.shape[1], dtype=x.dtype) + scaled.T @ (scaled * precision[:, None])
        factor = jnp.linalg.cholesky(hessian)
        inverse = solve_triangular(factor, jnp.eye(x.shape[1], dtype=x.dtype), lower=True)
        half = inverse @ scaled.T
        mean, variance = half.T @ (half @ shift), jnp.sum(half**2, axis=0)
        weights = root * (inverse.T @ (half @ shift))
        power = weights**2 + root**2 * jnp.sum(inverse**2, axis=0)
        # The cavity: what all other samples say about this one.
        left = 1 / jnp.maximum(1 / variance - jnp.where(there, 0.0, precision), 1e-9 / variance)
        centre = left * (mean / variance - jnp.where(there, 0.0, shift))
        spread = jnp.sqrt(left + spectrum.noise)
        z = sign * (centre - y) / spread
        r = jnp.exp(-0.5 * z**2 - 0.5 * jnp.log(2 * jnp.pi) - log_ndtr(z))
        # Moments of the normal distribution beyond the rail: of the signal (tilted), and with noise (reading).
        shrink = r * (z + r)
        tilted = centre + sign * left * r / spread
        narrowed = left - left**2 / spread**2 * shrink
        new_precision = jnp.maximum(1 / narrowed - 1 / left, 0.0)
        new_shift = new_precision * tilted + (tilted - centre) / left
        reading = centre + sign * spread * r
        reading_variance = spread**2 * jnp.where(sign == 0, 1.0, jnp.maximum(1 - shrink, 1e-6))
        rest = jnp.sum(jnp.where(there, (y - mean) ** 2 + variance, 0.0))
        return new_precision, new_shift, reading, reading_variance, power, rest

    def step(_, state):
        spectrum, scale, sites, _, _ = state
        rows = (y, sign, measured, scale, sites.precision, sites.shift)
        precision, shift, reading, variance, power, rest = jax.lax.map(lambda row: one(row, spectrum), rows)
        sites = _Sites(
            jnp.where(sign == 0, 0.0, (1 - DAMPING) * sites.precision + DAMPING * precision),
            jnp.where(sign == 0, 0.0, (1 - DAMPING) * sites.shift + DAMPING * shift),
        )
        scale = jnp.mean(power / jnp.maximum(spectrum.prior, 1e-300)[None, :], axis=1)
        scale = jnp.clip(scale / jnp.exp(jnp.mean(jnp.log(scale))), 1e-3, 1e3)
        prior = group @ jnp.mean(power / scale[:, None], axis=0)
        # A signal without noise would make the Hessian singular: 1e-10 of its variance is far below any sensor's.
        noise = jnp.maximum(jnp.sum(rest) / jnp.sum(measured.astype(y.dtype)), 1e-10)
        return Spectrum(prior, noise), scale, sites, reading, variance

    nothing = _Sites(jnp.zeros_like(y), jnp.zeros_like(y))
    first = (start, jnp.ones(len(y), y.dtype), nothing, y, jnp.zeros_like(y))
    spectrum, _, _, reading, variance = jax.lax.fori_loop(0, iterations, step, first)
    return jnp.where(measured, y, reading), jnp.where(measured, spectrum.noise, variance), spectrum.noise
