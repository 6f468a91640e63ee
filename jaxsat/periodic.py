"""Periodic motion of a recording: position by the accelerometer, angle by the gyroscope, without drift or rests."""

import time
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy
from jaxtyping import Array, Bool, Float, Int

from jaxsat.config import Config
from jaxsat.errors import InputError
from jaxsat.inertial.filters import Filter, butterworth
from jaxsat.inertial.harmonic import Spectrum, learn, least_squares, predict, recursive
from jaxsat.inertial.periodic import bmflc, chain_response, integrated, references, wflc
from jaxsat.inertial.programs import computing, make_room
from jaxsat.inertial.windows import Windows, neighbours, periodogram
from jaxsat.saturation.harmonic_fill import fill_harmonic
from jaxsat.signals.checks import check_form, check_wraps
from jaxsat.signals.formats import GRAVITY
from jaxsat.signals.rails import Gaps, Rails, find_gaps, find_rails, saturation_mask
from jaxsat.signals.recording import CHANNELS, Recording
from jaxsat.signals.support import find_band, find_support, measured_sensors

# Weights of a window: its length is what so many can describe up to the band's end.
MOST_WEIGHTS = 256
# Least squares sees means of blocks, so many a period of the highest frequency at least: what is faster is noise.
BLOCKS = 16
LEARNING_WINDOWS, LEARNING_ITERATIONS = 6, 8
# An angle beyond which the sensor's axes can no longer be called fixed (rad).
LARGE_ANGLE = 0.3
ORDER = {"gyr": 1, "acc": 2}
COLUMNS = {"gyr": slice(0, 3), "acc": slice(3, 6)}


class PeriodicEstimate(eqx.Module):
    """All that `estimate_periodic` found; columns in the order of `CHANNELS`."""

    recording: Recording
    config: Config = eqx.field(static=True)
    band: dict[str, tuple[float, float]] = eqx.field(static=True)
    """Lowest and highest frequency (Hz) by sensor, 'gyr' and 'acc', of those that were used."""
    motion: Float[np.ndarray, "N 6"]
    """Angle about (rad) and position along (m) the sensor's axes, about their mean; 0 for an unused sensor."""
    sd: Float[np.ndarray, "N 6"] | None
    """Of `motion`; None for the combiners of the paper, which do not know it."""
    rails: Rails
    gaps: Gaps
    sign: Int[np.ndarray, "N 6"]
    filled: Float[np.ndarray, "N 6"]
    """The six channels, saturated samples replaced (rad/s, m/s²)."""
    signal_sd: Float[np.ndarray, "N 6"]
    """sd of each filled value; 0 where nothing was filled."""
    warnings: list[str] = eqx.field(static=True)
    seconds: float = eqx.field(static=True)

    @property
    def saturated(self) -> Bool[np.ndarray, "N 6"]:
        return self.sign != 0


def estimate_periodic(recording: Recording, config: Config | None = None) -> PeriodicEstimate:
    """Position (m) and angle (rad) of the motion within a band of frequencies, along the sensor's own axes.

    Needs one sensor, no rests, and no attitude: offset and gravity are a constant of each axis. Where there is a
    gyroscope, gravity that small rotations bring into the axes is taken off first, a = f − f₀ + θ × f₀ with the
    angle θ found from the gyroscope; without one, tilt is seen as acceleration. Saturated samples are filled by
    `fill_harmonic`. Methods (`periodic.method`): `least_squares` in overlapping windows with the spectrum learnt
    from the recording, `recursive` (causal, a Kalman filter), `bmflc` and `wflc` (Latt et al. 2011).

    Computed in float64 whatever JAX's setting. Raises `InputError` where no band is given and none found, where
    band or filters do not fit the rate, or the recording is shorter than a period.
    """
    config = config or Config()
    make_room()
    with computing():
        return _estimate(recording, config)


def _estimate(recording: Recording, config: Config) -> PeriodicEstimate:
    started = time.perf_counter()
    check_form(recording)
    check_wraps(recording)
    there = measured_sensors(recording)
    if not any(there.values()):
        raise InputError(f"{recording.name}: more than half of both sensors is missing; record again.")
    warnings = _unit_warnings(recording, there)
    bands = _bands(recording, config, there)
    for low, _ in bands.values():
        _filters(config, recording.period, low)  # what does not fit is said before anything is computed
    rails = find_rails(recording, config.rails.gyr, config.rails.acc)
    _, sign = saturation_mask(recording, rails)
    sign[:, np.repeat([not there["gyr"], not there["acc"]], 3)] = 0
    filled, signal_sd = _fill(recording, sign, bands)
    motion = np.zeros((len(recording), 6))
    sd: np.ndarray | None = np.zeros((len(recording), 6))
    gravity = filled[:, 3:].mean(axis=0)
    for sensor, (low, high) in bands.items():  # the gyroscope first
        columns = COLUMNS[sensor]
        signal = filled[:, columns]
        if sensor == "acc" and "gyr" in bands:
            signal = signal + np.cross(motion[:, :3], gravity)
        noise = np.array([_noise_variance(axis, recording.period, high) for axis in signal.T])
        # Weight of each value beside a measured one: 0 where missing, less where filled.
        certainty = noise / (noise + signal_sd[:, columns] ** 2)
        certainty = np.where(recording.missing[:, columns], 0.0, certainty)
        motion[:, columns], spread = _fit(signal, certainty, recording, config, ORDER[sensor], low, high)
        if spread is None or sd is None:
            sd = None
        else:
            sd[:, columns] = spread
    largest = float(np.abs(motion[:, :3]).max())
    if largest > LARGE_ANGLE:
        warnings.append(
            f"the sensor turns by up to {largest:.2g} rad within the band: its axes are not fixed, and a position "
            "along them is a rough one."
        )
    if "gyr" not in bands and "acc" in bands:
        warnings.append(
            "there is no angle from a gyroscope: gravity that tilting moves is seen as acceleration."
        )
    found = (recording, config, bands, motion, sd, rails, find_gaps(sign), sign, filled, signal_sd)
    return PeriodicEstimate(*found, warnings, round(time.perf_counter() - started, 3))


def _unit_warnings(recording: Recording, there: dict[str, bool]) -> list[str]:
    mean = float(np.linalg.norm(recording.acc.mean(axis=0)))
    if there["acc"] and abs(mean - 1) < 0.1:
        return [f"the mean specific force is {mean:.2f}, as if in g; give --acc-unit g (9.8 times larger)."]
    if there["acc"] and mean > 3 * GRAVITY:
        return [f"the mean specific force is {mean:.3g} m/s²; check --acc-unit."]
    return []


def _bands(recording: Recording, config: Config, there: dict[str, bool]) -> dict[str, tuple[float, float]]:
    """The band of each sensor that has one; `InputError` where there is none at all or it does not fit."""
    name, given = recording.name, config.periodic.band
    nyquist, duration = 0.5 / recording.period, len(recording) * recording.period
    if given != "auto":
        low, high = given
        if not 0 < low < high:
            raise InputError(
                f"the band {low:g} to {high:g} Hz is none; give two frequencies, 0 < LOW < HIGH."
            )
        if high >= nyquist:
            raise InputError(
                f"{name}: the band ends at {high:g} Hz, but the recording holds nothing from {nyquist:g} Hz on, "
                "half of its rate; lower the band, or check the rate."
            )
        if duration * low < 1:
            raise InputError(
                f"{name}: the recording lasts {duration:.3g} s, less than one period of {low:g} Hz "
                f"({1 / low:.3g} s); record for longer or raise the band."
            )
        return {sensor: given for sensor in ("gyr", "acc") if there[sensor]}
    signals = {"gyr": recording.gyr, "acc": recording.acc}
    found = {sensor: find_band(signals[sensor], recording.period) for sensor in signals if there[sensor]}
    bands = {sensor: (band[0], min(band[2], 0.99 * nyquist)) for sensor, band in found.items() if band}
    if not bands:
        raise InputError(
            f"{name}: no band was given and no frequency stands out of the spectrum; give --band LOW HIGH if you "
            f"know it. As it is, {find_support(recording).sentence()}."
        )
    return bands


def _fill(
    recording: Recording, sign: np.ndarray, bands: dict[str, tuple[float, float]]
) -> tuple[np.ndarray, np.ndarray]:
    """The six channels with saturated samples filled, and the sd of what was filled."""
    filled, sd = recording.signal.copy(), np.zeros_like(recording.signal)
    for j in np.flatnonzero((sign != 0).any(axis=0)):
        if ("gyr" if j < 3 else "acc") not in bands:
            continue
        try:
            found = fill_harmonic(filled[:, j], sign[:, j], recording.missing[:, j])
        except InputError as error:
            raise InputError(f"{recording.name}: {CHANNELS[j]}: {error}") from None
        filled[:, j] = np.where(sign[:, j] != 0, found.signal, filled[:, j])
        sd[:, j] = np.where(sign[:, j] != 0, found.sd, 0.0)
    return filled, sd


def _filters(config: Config, period: float, low: float) -> tuple[tuple[Filter, ...], Filter]:
    """The sensor's own filter, if there is one, and the high-pass of the paper's combiners."""
    settings = config.periodic
    sensor: tuple[Filter, ...] = ()
    if settings.sensor_lowpass != "none":
        sensor = (butterworth("lowpass", 1, settings.sensor_lowpass, None),)
    cutoff = low / 2 if settings.highpass == "auto" else settings.highpass
    highpass = butterworth("highpass", settings.highpass_order, cutoff, 1 / period)
    if settings.method == "bmflc" and settings.mu * settings.frequencies >= 1:
        raise InputError(
            f"periodic.mu = {settings.mu:g} with {settings.frequencies} frequencies does not converge; "
            "lower either until their product is below 1."
        )
    return sensor, highpass


def _noise_variance(x: np.ndarray, period: float, high: float) -> float:
    """Variance of white noise as strong as what lies an octave and more above the band, or near the top."""
    frequency, power = scipy.signal.welch(x, 1 / period, nperseg=min(256, len(x)))
    above = power[frequency >= min(2 * high, 0.4 / period)]
    return max(float(np.median(above)) * 0.5 / period, 1e-8 * float(x.var()), 1e-300)


def _fit(
    signal: np.ndarray,
    weight: np.ndarray,
    recording: Recording,
    config: Config,
    order: int,
    low: float,
    high: float,
) -> tuple[np.ndarray, np.ndarray | None]:
    """Motion of the three axes of a sensor, and its sd."""
    settings, period = config.periodic, recording.period
    sensor, highpass = _filters(config, period, low)
    if settings.method == "least_squares":
        return _in_windows(signal, weight, period, order, sensor, low, high)
    if settings.method == "recursive":
        return _recursive(signal, weight, period, order, sensor, low, high, settings.frequencies)
    frequency = jnp.linspace(low, high, settings.frequencies)
    centred = jnp.asarray(signal - signal[:1])
    run = partial(
        _combine, time=jnp.asarray(recording.time - recording.time[0]), frequency=frequency, order=order,
        highpass=highpass, sensor=sensor, mu=settings.mu, mu_frequency=settings.mu_frequency,
        adaptive=settings.method == "wflc",
    )  # fmt: skip
    return np.stack([np.asarray(run(axis)) for axis in centred.T], axis=1), None


@partial(jax.jit, static_argnames=("order", "adaptive"))
def _combine(signal, time, frequency, order, highpass, sensor, mu, mu_frequency, adaptive):
    """One axis through the combiners of the paper."""
    period = time[1] - time[0]
    filtered, chain = integrated(signal, order, highpass, period)
    if not adaptive:
        return bmflc(
            filtered, time, frequency, chain_response((*chain, *sensor), order, frequency), mu
        ).motion
    # One harmonic: a band of less than an octave holds no second.
    scale = jnp.maximum(jnp.sqrt(2 * jnp.median(filtered**2)), 1e-30)
    start = (frequency[0] + frequency[-1]) / 2
    return scale * wflc(filtered / scale, period, start, 1, (*chain, *sensor), order, mu, mu_frequency).motion


def _in_windows(
    signal: np.ndarray, weight: np.ndarray, period: float, order: int, sensor: tuple[Filter, ...],
    low: float, high: float,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """Regularised least squares on every frequency from 0 to beyond the band; those below it are no motion."""
    top = min(1.25 * high, 0.49 / period)
    step = max(1, int(1 / (BLOCKS * top * period)))
    blocks = -(-len(signal) // step)
    length = min(blocks, int(MOST_WEIGHTS / (4 * top * step * period)))
    windows = Windows.cut(blocks, length)
    whole = Windows(windows.start * step, length * step, blocks * step)
    spacing = 1 / (2 * length * step * period)
    frequency = spacing * np.arange(1, int(top / spacing) + 1)
    inside = (frequency >= low - spacing / 2) & (frequency <= high + spacing / 2)
    time = np.arange(length * step) * period
    x, z, coarse_z = _references(
        jnp.asarray(frequency),
        jnp.asarray(inside),
        jnp.asarray(time),
        jnp.asarray(period),
        order,
        sensor,
        step,
    )
    group = jnp.asarray(neighbours(len(frequency), 2))
    few = np.unique(np.linspace(0, len(windows.start) - 1, LEARNING_WINDOWS).astype(int))
    motion, sd = np.zeros_like(signal), np.zeros_like(signal)
    for axis, (s, m) in enumerate(zip(signal.T, weight.T, strict=True)):
        if not m.any() or np.ptp(s) == 0:
            continue
        scale, offset = s.std(), s.mean()
        mean_of, share = _block_means((s - offset) / scale, m, step)
        rows, weights = windows.of(mean_of), windows.of(share)
        power = periodogram(rows, frequency * step * period)
        start = Spectrum(jnp.asarray(np.concatenate([power, power, [1.0]])), jnp.asarray(0.01))
        mean, variance = _windowed(
            jnp.asarray(rows), jnp.asarray(weights), jnp.asarray(few), x, z, coarse_z, group, start
        )
        motion[:, axis] = scale * whole.joined(np.asarray(mean))[: len(signal)]
        spread = np.repeat(windows.joined(np.sqrt(np.asarray(variance))), step)
        sd[:, axis] = scale * spread[: len(signal)]
    return motion, sd


def _block_means(
    signal: Float[np.ndarray, "N"], weight: Float[np.ndarray, "N"], step: int
) -> tuple[Float[np.ndarray, "B"], Float[np.ndarray, "B"]]:
    """Weighted means of blocks of `step` samples, and their mean weights; the last block may lack some."""
    extra = (0, -len(signal) % step)
    s, m = (np.pad(x, extra).reshape(-1, step) for x in (signal, weight))
    total = m.sum(axis=1)
    return (s * m).sum(axis=1) / np.where(total > 0, total, 1.0), total / step


@partial(jax.jit, static_argnames=("order", "step"))
def _references(
    frequency: Float[Array, "F"], inside: Bool[Array, "F"], time: Float[Array, "N"], period: Float[Array, ""],
    order: int, sensor: tuple[Filter, ...], step: int = 1,
) -> tuple[Float[Array, "B W"], Float[Array, "N W"], Float[Array, "B W"]]:  # fmt: skip
    """Reference inputs of block means, of the motion, and of the motion in the middle of each block.

    A sinusoid's mean over a block is its value in the middle times sin(πfDT)/(D sin(πfT)).
    """
    gain = chain_response(sensor, order, frequency)
    kept = jnp.concatenate([inside, inside, jnp.zeros(1, bool)]).astype(time.dtype)
    blur = jnp.sin(jnp.pi * frequency * step * period) / (step * jnp.sin(jnp.pi * frequency * period))
    middle = time[::step] + 0.5 * (step - 1) * period
    x, at_blocks = references(frequency, middle, gain)
    _, z = references(frequency, time, gain)
    blur = jnp.concatenate([blur, blur, jnp.ones(1)])
    return x * blur[None], z * kept[None], at_blocks * kept[None]


@jax.jit
def _windowed(rows, weights, few, x, z, coarse_z, group, start):
    spectrum = learn(rows[few], weights[few], x, group, start, LEARNING_ITERATIONS)

    def one(row):
        fit = least_squares(row[0], row[1], x, spectrum)
        return z @ fit.weights, predict(fit, coarse_z)[1]

    return jax.lax.map(one, (rows, weights))


def _recursive(
    signal: np.ndarray, weight: np.ndarray, period: float, order: int, sensor: tuple[Filter, ...],
    low: float, high: float, count: int,
) -> tuple[np.ndarray, np.ndarray]:  # fmt: skip
    """A Kalman filter on `count` frequencies in the band and as dense ones below it, of slowly changing weights."""
    spacing = (high - low) / max(count - 1, 1)  # a band has two ends: high > low
    below = np.arange(low - spacing, spacing / 2, -spacing)[::-1]
    frequency = np.concatenate([below, np.linspace(low, high, count)])
    inside = frequency >= low - 1e-9
    time = jnp.asarray(np.arange(len(signal)) * period)
    x, z, _ = _references(
        jnp.asarray(frequency), jnp.asarray(inside), time, jnp.asarray(period), order, sensor
    )
    motion, sd = np.zeros_like(signal), np.zeros_like(signal)
    for axis, (s, m) in enumerate(zip(signal.T, weight.T, strict=True)):
        if not m.any() or np.ptp(s) == 0:
            continue
        centred = (s - s[0]) / s.std()
        noise = _noise_variance(centred, period, high)
        # The power of the whole recording around each frequency; a constant of any size.
        length = min(len(s), round(1 / (spacing * period)))
        power = periodogram(Windows.cut(len(s), length).of(centred), frequency * period)
        power = power * 2 * length * spacing * period
        prior = np.concatenate([power, power, [10.0]])
        # Weights forget within the time that tells neighbouring frequencies apart.
        drift = prior * period * spacing
        spectrum = Spectrum(jnp.asarray(prior), jnp.asarray(noise))
        tracked = _track(jnp.asarray(centred), jnp.asarray(m), x, z, spectrum, jnp.asarray(drift))
        motion[:, axis] = s.std() * np.asarray(tracked.motion)
        # All variances by one factor leave the estimate as it is, and fit the errors of prediction.
        calibration = float(jnp.sum(tracked.surprise)) / max((m > 0).sum(), 1)
        sd[:, axis] = s.std() * np.sqrt(np.maximum(calibration * np.asarray(tracked.variance), 0.0))
    return motion, sd


_track = jax.jit(recursive)
