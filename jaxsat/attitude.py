"""The other way through the house: a recording and a configuration in, an attitude out, rests or not."""

from collections.abc import Iterator

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.config import Config
from jaxsat.errors import InputError
from jaxsat.inertial.bounded import ACC_DENSITY, GYR_DENSITY, ROW_EVERY, bounded_attitude
from jaxsat.inertial.good_gain import good_gain
from jaxsat.inertial.orientation import (
    Gains,
    Start,
    backward,
    ending,
    euler_angles,
    orientation,
    start_at_rest,
)
from jaxsat.inertial.programs import compiled, computing, make_room
from jaxsat.inertial.strapdown import Samples
from jaxsat.preparation import LEFT_OFFSET_SD, MOVING_START_SD, MOVING_START_TILT_SD, given_gains
from jaxsat.saturation.interpolation import interpolate_gaps
from jaxsat.signals.checks import TILT, check
from jaxsat.signals.formats import GRAVITY
from jaxsat.signals.rails import Gaps, Rails, find_gaps, find_rails, saturation_mask
from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import find_rests, runs

FIRST = 1.0
"""The offset of the gyroscope is its mean over so long a rest at the start (s)."""
LONG_GAP = 0.1
"""Neighbours say little of a gap that lasts longer (s): a hand or a foot changes its rate within such a time."""
STILL = 0.02
"""A sensor that turns slower for `FIRST` than this (rad/s) rests, and its gyroscope reads its own offset: a hand that
holds still moves more, an offset that warms with the device changes less from one rest to the next."""
LOST = 0.1
"""An inclination that is known no better than this (rad) is called lost."""
# Lengths are powers of two from here on: recordings of about the same length share compiled programs.
_SHORTEST = 1024


class Orientation(eqx.Module):
    """All that `orient` found; attitudes are at the start of each sample."""

    recording: Recording
    config: Config = eqx.field(static=True)
    q_nb: Float[np.ndarray, "N 4"]
    """Body to navigation frame (z up, heading arbitrary)."""
    after: Float[np.ndarray, "N 4"]
    """Attitude at the end of each sample: what a filter says that has seen it."""
    euler: Float[np.ndarray, "N 3"]
    """Angles about x, y and z (rad), Q_z ⊗ Q_y ⊗ Q_x."""
    bias: Float[np.ndarray, "N 3"]
    """Offset of the gyroscope, that of the first second with what the integral learnt (rad/s)."""
    sd: Float[np.ndarray, "N 2"] | None
    """Of inclination and heading (rad); None for the filters, which do not know it."""
    start: Start
    gains: Gains
    rails: Rails
    gaps: Gaps
    sign: Int[np.ndarray, "N 6"]
    """Direction of saturation of each value, 0 where there is none."""
    filled: Float[np.ndarray, "N 6"]
    warnings: list[str] = eqx.field(static=True)


def orient(recording: Recording, config: Config | None = None) -> Orientation:
    """The attitude of a recording by paper C, as `config.orientation` says.

    Needs no rest. A first second at rest gives the offset of the gyroscope and the level; without it the filter runs
    to the end and back before it begins, and a warning says so. Later rests correct the offset. Computed in float64
    whatever JAX's setting. Raises `InputError` where the accelerometer or the gyroscope is absent, the recording is
    shorter than its first second, or its units cannot be.
    """
    config = config or Config()
    _check_sensors(recording)
    warnings = check(recording)
    settings, period = config.orientation, recording.period
    rails = find_rails(recording, config.rails.gyr, config.rails.acc)
    saturated, sign = saturation_mask(recording, rails)
    first = _first_rest(recording)
    make_room()
    with computing():
        start = start_at_rest(jnp.asarray(recording.signal[:first]))
        moving = first < round(FIRST / period)
        if moving:
            # In motion neither is known; the level is a first guess.
            start = Start(start.q_nb, jnp.zeros(3), jnp.asarray(GRAVITY))
            warnings.append(
                f"{recording.name}: the sensor moves within its first second: level and gyroscope offset of its "
                "start are found from what follows."
            )
        if config.gravity != "auto":
            start = eqx.tree_at(lambda s: s.gravity, start, jnp.asarray(float(config.gravity)))
        gains = _gains(recording, config, first)
        filled, variance = _filled(recording, config, sign)
        trusted = ~np.any((saturated | recording.missing).reshape(-1, 2, 3), axis=2)
        rest = np.zeros(len(recording), bool)
        if settings.offset == "rests":
            rest = _rests(recording, np.asarray(start.offset), np.any(saturated, axis=1))
        padded = _padded(filled, period, trusted, rest)
        if moving:
            start = _start_in_motion(*padded, start, gains)
        smoothed = settings.estimate == "smoothed"
        estimate = "pi" if settings.estimate == "smoothed" else settings.estimate
        found = _filter(
            *padded[:3], start, gains, rest=padded[3], estimate=estimate, update=settings.update,
            direction=settings.direction,
        )  # fmt: skip
        q_nb, bias, sd = found.q_nb, start.offset[None] - found.integral, None
        if smoothed:
            rates = padded[0].at[:, :3].add(-bias[:-1])
            variance = jnp.asarray(np.pad(variance, ((0, len(rates) - len(variance)), (0, 0))))
            q_nb, sd = _smooth(Samples(rates, padded[1], variance), start, rest, config, moving)
        angles = _angles(q_nb)
    n, gaps = len(recording), find_gaps(sign)
    if settings.fill == "interpolate":
        warnings += _long_gaps(recording, gaps)
    if sd is not None:
        warnings += _lost(recording, sd)
    q_nb = np.asarray(q_nb)
    return Orientation(
        recording=recording,
        config=config,
        q_nb=q_nb[:n],
        after=q_nb[1 : n + 1],
        euler=np.asarray(angles)[:n],
        bias=np.asarray(bias)[:n],
        sd=sd,
        start=jax.tree.map(np.asarray, start),
        gains=jax.tree.map(np.asarray, gains),
        rails=rails,
        gaps=gaps,
        sign=sign,
        filled=filled,
        warnings=warnings,
    )


def _long_gaps(recording: Recording, gaps: Gaps) -> Iterator[str]:
    long = int(np.sum((gaps.end - gaps.start)[gaps.channel < 3] > LONG_GAP / recording.period))
    if long:
        yield (
            f"{recording.name}: {long} gaps in the rates last longer than {LONG_GAP:g} s: what fills them is a "
            "guess, and the attitude after them may be far off."
        )


def _lost(recording: Recording, sd: Float[np.ndarray, "N 2"]) -> Iterator[str]:
    lost, largest = float(np.mean(sd[:, 0] > LOST)), np.rad2deg(sd[:, 0].max())
    if lost > 0.0:
        yield (
            f"{recording.name}: for {lost:.0%} of the time the inclination is known no better than "
            f"{np.rad2deg(LOST):.0f} deg (largest sd {largest:.0f} deg): too much was lost to rely on it there."
        )


def _check_sensors(recording: Recording) -> None:
    name, missing = recording.name, recording.missing
    for what, channels in (("gyroscope", slice(0, 3)), ("accelerometer", slice(3, 6))):
        if missing[:, channels].all(axis=0).any():
            raise InputError(
                f"{name}: the {what} is missing, but orientation needs both sensors; add its three channels."
            )
    length = len(recording) * recording.period
    if length < FIRST:
        raise InputError(
            f"{name}: only {length:.2f} s, but the offset of the gyroscope needs a first second at rest; "
            "record for longer."
        )


def _first_rest(recording: Recording) -> int:
    """Samples of the first second, or of its first fifth (which a check saw at rest) if the sensor moves later.

    It rests if what it turns beside a constant offset, and what its specific force turns, stay within `TILT`.
    """
    n = round(FIRST / recording.period)
    rate, fifth = recording.gyr[:n], max(1, n // 5)
    wandered = np.abs(np.cumsum(rate - rate.mean(axis=0), axis=0)).max() * recording.period
    early, late = recording.acc[:fifth].mean(axis=0), recording.acc[n - fifth : n].mean(axis=0)
    tilted = np.linalg.norm(late - early) / np.linalg.norm(early)
    return n if max(wandered, tilted) <= TILT else fifth


def _gains(recording: Recording, config: Config, first: int) -> Gains:
    gains = given_gains(config)
    if config.orientation.gains == "given":
        return gains
    proposed = good_gain(recording.signal[:first], recording.period, float(gains.tau))
    return eqx.tree_at(lambda g: (g.kp, g.ki), gains, (proposed.kp, proposed.ki))


def _rests(
    recording: Recording, offset: Float[np.ndarray, "3"], saturated: Bool[np.ndarray, "N"]
) -> Bool[np.ndarray, "N"]:
    """Rests of at least `FIRST`. Flags that came with the recording may be stances, in which a foot still turns."""
    bare = Recording(recording.time, recording.gyr - offset, recording.acc, recording.missing)
    return find_rests(bare, threshold=STILL**2, min_duration=FIRST, saturated=saturated)


def _filled(
    recording: Recording, config: Config, sign: Int[np.ndarray, "N 6"]
) -> tuple[Float[np.ndarray, "N 6"], Float[np.ndarray, "N 6"]]:
    """The channels with saturated rates filled, and the noise variance of each value."""
    T, limits = recording.period, config.saturation
    density = np.repeat([GYR_DENSITY, ACC_DENSITY], 3) ** 2 / T
    # What was not measured may be anything that the channel did, what saturates anything within its bounds.
    variance = np.where(recording.missing, np.maximum(recording.signal.var(axis=0), density), density)
    bound = np.repeat([limits.gyr_bound, limits.acc_bound], 3)
    if config.orientation.fill == "none":
        return recording.signal, variance + np.where(sign != 0, bound**2 / 3, 0.0)
    variance[:, 3:] += np.where(sign[:, 3:] != 0, bound[3:] ** 2 / 3, 0.0)
    rates = interpolate_gaps(recording.gyr, sign[:, :3], T, recording.missing[:, :3])
    variance[:, :3] += rates.variance
    return np.concatenate([rates.signal, recording.acc], axis=1), variance


def _padded(
    signal: Float[np.ndarray, "N 6"], period: float, trusted, rest
) -> tuple[Array, Array, Array, Array]:
    size = max(_SHORTEST, 1 << (len(signal) - 1).bit_length())
    extra = (0, size - len(signal))
    rows = (extra, (0, 0))
    blank = (signal, rows), (np.full(len(signal), period), extra), (trusted, rows), (rest, extra)
    values, periods, trusted, rest = (jnp.asarray(np.pad(x, width)) for x, width in blank)
    return values, periods, trusted, rest


@compiled
def _start_in_motion(signal, period, trusted, rest, guess: Start, gains: Gains) -> Start:
    """Attitude and offset at the first sample from a run to the end and back: by then the guess is forgotten."""
    forward = orientation(signal, period, trusted, guess, gains, rest=rest)
    end = ending(forward, guess)
    back = backward(signal, period, trusted, end, gains, rest)
    return Start(back.q_nb[0], end.offset - back.integral[0], guess.gravity)


_filter = compiled(orientation)
_angles = jax.jit(jax.vmap(euler_angles))


def _smooth(
    samples: Samples, start: Start, rest: Bool[np.ndarray, "N"], config: Config, moving: bool
) -> tuple[Float[Array, "M 4"], Float[np.ndarray, "N 2"]]:
    """Attitude by `bounded_attitude`, and sd of inclination and heading at the start of each of N samples."""
    T = float(samples.period[0])
    tilt = MOVING_START_TILT_SD if moving else config.noise.initial_tilt_sd
    speed = MOVING_START_SD if moving else config.noise.rest_velocity_sd
    every = max(1, round(ROW_EVERY / T))
    numbers = (jnp.asarray(x) for x in (tilt, speed, every, config.smoother.relinearisations))
    q_nb, variance = _bounded(samples, start, *numbers)
    variance = np.array(variance)[: len(rest)]
    # The offset, known from a second at rest, is off by the same until the next rest.
    offset = LEFT_OFFSET_SD if moving else GYR_DENSITY / np.sqrt(FIRST)
    for i, j in zip(*runs(~rest), strict=True):
        variance[i:j, 1] += (offset * T * np.arange(j - i)) ** 2
        variance[j:, 1] += (offset * T * (j - i)) ** 2
    return q_nb, np.sqrt(variance)


@compiled
def _bounded(*problem):
    found = bounded_attitude(*problem)
    variance = jnp.diagonal(found.covariance, axis1=1, axis2=2)
    return found.state.q_nb, jnp.stack([variance[:, 0] + variance[:, 1], variance[:, 2]], axis=1)
