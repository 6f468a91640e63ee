"""Does a recording make sense? Physics and plain bookkeeping, before anything is estimated from it."""

from collections.abc import Iterator
from itertools import pairwise

import numpy as np
from jaxtyping import Bool, Float, Shaped
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from jaxsat.errors import InputError
from jaxsat.signals.formats import GRAVITY
from jaxsat.signals.recording import CHANNELS, Recording
from jaxsat.signals.rests import runs

START = 0.2
"""A recording starts at rest if the sensor rests this long (s)."""
STILL_WINDOW = 0.15
"""Length of the windows whose stillness is judged (s): half of a short stance."""
TILT = np.deg2rad(2.0)
"""A sensor that turns by less than this over `START` is called at rest (rad)."""
COARSE = 0.02
"""Turns within so long are added up before units are compared (s): which fits twice as well shows all the same."""
UNIT_SCALES = {"deg/s": np.pi / 180, "rad/s": 180 / np.pi}
RATE_SCALES = 2.0 ** np.array([-2.0, -1.5, -1.0, -0.5, 0.5, 1.0, 1.5, 2.0])


def check(recording: Recording) -> list[str]:
    """Raise `InputError` for what would make an estimate meaningless; return warnings, a sentence each.

    Every threshold is a statement about physics, given where it is used. Units and rate are tested against
    gravity: see `spurious_accelerations`.
    """
    name = recording.name
    check_form(recording)
    warnings = [*_missing(recording)]
    check_wraps(recording)
    warnings += _check_gravity(recording)
    _check_stuck(recording)
    warnings += _check_units(recording)
    warnings += _check_start(recording)
    return [f"{name}: {warning}" for warning in warnings]


def check_form(recording: Recording) -> None:
    """The contract of a `Recording`: finite, uniform in time, long enough, at a rate that sensors have."""
    name, time = recording.name, recording.time
    if len(time) < 3 or time[-1] - time[0] < 0.5:
        raise InputError(f"{name}: only {len(time)} samples, less than 0.5 s; record for longer.")
    bad = np.argwhere(~np.isfinite(recording.signal))
    if len(bad):
        place = f"{CHANNELS[bad[0][1]]} at {time[bad[0][0]]:.6g} s"
        raise InputError(f"{name}: {place} is not finite; interpolate it and flag it as missing.")
    step = np.diff(time)
    uneven = np.flatnonzero(~(np.abs(step / recording.period - 1) < 0.01))
    if len(uneven):
        raise InputError(f"{name}: time is not uniform at {time[uneven[0]]:.6g} s; resample the recording.")
    if not 10 < 1 / recording.period < 20_000:
        raise InputError(
            f"{name}: the time says {1 / recording.period:.4g} Hz, which no inertial sensor for motion has; "
            "give the time in seconds, or correct --rate."
        )


def _missing(recording: Recording) -> Iterator[str]:
    """Missing samples: not at the start (nothing to interpolate from), at most half of a channel."""
    name, missing = recording.name, recording.missing
    share = missing.mean(axis=0)
    worst = int(share.argmax())
    if share[worst] > 0.5:
        how = "all" if share[worst] == 1 else f"{share[worst]:.0%}"
        raise InputError(
            f"{name}: {how} of {CHANNELS[worst]} is missing; record again with all six channels."
        )
    if missing[0].any():
        channel = int(missing[0].argmax())
        first = recording.time[int(missing[:, channel].argmin())]
        raise InputError(
            f"{name}: {CHANNELS[channel]} is missing at the start; cut the recording to begin at {first:.6g} s."
        )
    rows = np.logical_or.reduce(missing, axis=1)
    if rows.any():
        starts, ends = runs(rows)
        longest = int((ends - starts).argmax())
        length, at = ends[longest] - starts[longest], recording.time[starts[longest]]
        yield f"{rows.sum()} samples are missing, the longest gap has {length} at {at:.6g} s; they are interpolated."


def check_wraps(recording: Recording) -> None:
    """No channel leaves its range at one end and comes in again at the other.

    A 16-bit number that overflows jumps by the full range against its own slope, stays on the wrong side for
    a while, and jumps back, again against its slope. Impacts jump as far, but with their slope, and clipped
    signals have no slope there. Excursions of fewer than three samples show no slope and are left alone.
    """
    for channel, x in zip(CHANNELS, recording.signal.T, strict=True):
        step = np.diff(x)
        jumps = np.flatnonzero(np.abs(step) > 1.8 * np.abs(x).max())
        for out, back in pairwise(jumps[(jumps > 0) & (jumps < len(step) - 1)]):
            against = [step[k] * step[k + side] < 0 for k in (out, back) for side in (-1, 1)]
            away = x[out + 1 : back + 1] * x[out + 1] > 0
            if back - out >= 3 and step[out] * step[back] < 0 and all(against) and away.all():
                raise InputError(
                    f"{recording.name}: {channel} leaves its range and comes in at the other end at "
                    f"{recording.time[out]:.6g} s, an integer overflow; undo it in the export."
                )


def activity(recording: Recording) -> Float[np.ndarray, "N"]:
    """How much moves around each sample, in whatever units: the logarithm of the spread of the specific force
    times the size of the angular rate, both mean squares over `STILL_WINDOW`.
    """
    n = max(3, round(STILL_WINDOW / recording.period))
    mean = uniform_filter1d(recording.acc, n, axis=0)
    spread = (uniform_filter1d(recording.acc**2, n, axis=0) - mean**2).sum(axis=1)
    size = uniform_filter1d(recording.gyr**2, n, axis=0).sum(axis=1)
    # Without noise a rest has no spread at all; 1e-12 of the largest power is far below any sensor's noise.
    floors = [np.maximum(power, 1e-12 * power.max() + 1e-300) for power in (spread, size)]
    return np.log(floors[0]) + np.log(floors[1])


def find_still(recording: Recording) -> Bool[np.ndarray, "N"]:
    """Where a recording is quieter than usual: the lower of two classes of its activity.

    The threshold between the classes explains most of the variance (Otsu 1979, IEEE SMC 9). Relative by
    construction: it serves to compare units, not to find rests.
    """
    active = activity(recording)
    ordered = np.sort(active)
    low = np.arange(1, len(ordered))
    high = len(ordered) - low
    below = np.cumsum(ordered)[:-1]
    apart = (ordered.sum() - below) / high - below / low
    return active <= ordered[int(np.argmax(low * high * apart**2))]


def _check_gravity(recording: Recording) -> Iterator[str]:
    """A sensor at rest feels gravity: 9.81 m/s² to 0.3 % anywhere on Earth, to 2 % with its own errors.

    Judged over the quietest tenth of the recording; 20 % is more than any sensor errs, but not a wrong unit.
    """
    name, active = recording.name, activity(recording)
    quiet = active <= np.quantile(active, 0.1)
    gyr, acc = (float(np.median(np.linalg.norm(x[quiet], axis=1))) for x in (recording.gyr, recording.acc))
    off = abs(acc / GRAVITY - 1)
    if off <= 0.2:
        if off > 0.02:
            yield f"the specific force at rest is {acc:.2f} m/s², {off:.1%} off gravity; calibrate the sensor."
        return
    if acc < 0.5 * GRAVITY and abs(gyr / GRAVITY - 1) < 0.2:
        what = f"at rest the gyroscope reads {gyr:.2f} and the accelerometer {acc:.2f}; swap their columns."
    elif abs(acc - 1) < 0.2:
        what = f"the specific force at rest is {acc:.2f}, as if in g; give --acc-unit g."
    elif abs(acc / GRAVITY**2 - 1) < 0.2:
        what = f"the specific force at rest is {acc:.1f} m/s², g times too much; give --acc-unit m/s^2."
    elif acc < 0.2 * GRAVITY:
        what = f"the specific force at rest is {acc:.2f} m/s², without gravity; export it with gravity."
    else:
        what = f"the specific force at rest is {acc:.2f} m/s², not 9.81; correct the unit or calibrate the sensor."
    raise InputError(f"{name}: {what}")


def _check_stuck(recording: Recording) -> None:
    """No channel is constant while others change; in a noiseless simulation at rest all are."""
    signal = recording.signal
    alive = (np.diff(signal, axis=0) != 0).any(axis=1).mean() > 0.9
    stuck = np.flatnonzero(np.ptp(signal, axis=0) == 0)
    if alive and len(stuck):
        channels = ", ".join(CHANNELS[k] for k in stuck)
        value = signal[0, stuck[0]]
        raise InputError(
            f"{recording.name}: {channels} never changes from {value:g}; repair or replace the sensor."
        )


def spurious_accelerations(
    recording: Recording, still: Bool[np.ndarray, "N"], scales: Float[np.ndarray, "S"]
) -> Float[np.ndarray, "S"] | None:
    """Acceleration that appears between still phases if the angular rate is multiplied by each scale (m/s²).

    From each still phase to the next, the mean nav-frame acceleration must be zero, and is if angular rate,
    specific force and sampling period fit together. The median of its size over all moves; None without any.
    A wrong scale tilts gravity into it: `scales` compare units, and rates too, as an angle is rate × period.
    """
    size = max(1, int(COARSE / recording.period))
    still = np.asarray(_blocks(still, size).all(axis=1))
    turns = _blocks(recording.gyr * recording.period, size).sum(axis=1)
    acc = _blocks(recording.acc, size).mean(axis=1)
    n = max(3, round(STILL_WINDOW / (recording.period * size)))
    starts, ends = runs(still)
    long = ends - starts >= n
    leave, arrive = ends[long][:-1] - n // 2, starts[long][1:] + n // 2
    if not len(leave):
        return None
    calm = uniform_filter1d(acc, n, axis=0)[leave]

    def some(scales):
        attitude = attitudes(scales[:, None, None] * turns)
        total = np.zeros((len(scales), len(acc) + 1, 3))
        np.cumsum(_rotated(attitude, acc), axis=1, out=total[:, 1:])
        mean = (total[:, arrive] - total[:, leave]) / (arrive - leave)[:, None]
        return np.median(np.linalg.norm(mean - _rotated(attitude[:, leave], calm), axis=2), axis=1)

    # As many at once as a few MB hold.
    parts = -(-len(scales) * len(acc) // 2**15)
    return np.concatenate([some(part) for part in np.array_split(scales, min(parts, len(scales)))])


def _blocks(x: Shaped[np.ndarray, "N *k"], size: int) -> Shaped[np.ndarray, "B size *k"]:
    """So many samples side by side; what does not fill a block is left out."""
    count = len(x) // size
    return x[: count * size].reshape(count, size, *x.shape[1:])


def attitudes(turns: Float[np.ndarray, "S N 3"]) -> Float[np.ndarray, "S N 4"]:
    """Attitude at the start of each sample, relative to the first, from rotation vectors (rad): quaternions, w last.

    Prefix products in blocks of √N, so that Python loops only 2√N times.
    """
    count, n, _ = turns.shape
    side = int(np.ceil(np.sqrt(n + 1)))
    steps = np.zeros((side * side, count, 3))
    steps[1 : n + 1] = turns.swapaxes(0, 1)
    # The k-th of each block beside each other.
    steps = steps.reshape(side, side, count, 3).swapaxes(0, 1)
    x, y, z, w = Rotation.from_rotvec(steps.reshape(-1, 3)).as_quat().T.reshape(4, side, side, count)
    # A quaternion is a pair of complex numbers, a + b j.
    a, b = w + 1j * x, y + 1j * z

    def product(a, b, c, d):
        return a * c - b * d.conj(), a * d + b * c.conj()

    for k in range(1, side):
        a[k], b[k] = product(a[k - 1], b[k - 1], a[k], b[k])
    start = np.ones_like(a[0]), np.zeros_like(b[0])
    for k in range(1, side):
        start[0][k], start[1][k] = product(start[0][k - 1], start[1][k - 1], a[-1, k - 1], b[-1, k - 1])
    a, b = product(*start, a, b)
    q = np.stack([a.imag, b.real, b.imag, a.real], axis=-1)
    return q.swapaxes(0, 1).reshape(-1, count, 4)[:n].swapaxes(0, 1)


def _rotated(q: Float[np.ndarray, "S n 4"], vectors: Float[np.ndarray, "n 3"]) -> Float[np.ndarray, "S n 3"]:
    """The same vectors at each scale."""
    repeated = np.tile(vectors, (len(q), 1))
    return Rotation.from_quat(q.reshape(-1, 4)).apply(repeated).reshape(len(q), -1, 3)


def _check_units(recording: Recording) -> Iterator[str]:
    """No other unit or rate fits gravity twice as well as those that were read.

    Asked only if the fit is worse than a tilt of `TILT`; another fit counts if it is better than that, or
    twice better than no rotation at all (which is what a unit much too small amounts to). Too low a rate is
    an error; too high a rate looks like a gyroscope that clips and turns too little, and is a warning.
    """
    name, still, rate = recording.name, find_still(recording), 1 / recording.period
    found = spurious_accelerations(recording, still, np.ones(1))
    if found is None or found[0] < GRAVITY * TILT:
        return
    as_read, scales = found[0], np.array([*UNIT_SCALES.values(), *RATE_SCALES])
    others = spurious_accelerations(recording, still, np.append(scales, 0.0))
    assert others is not None, "there were moves before"
    *fits, no_rotation = others
    best = int(np.argmin(fits))
    if fits[best] > min(as_read, max(no_rotation, 2 * GRAVITY * TILT)) / 2:
        return
    if best < len(UNIT_SCALES):
        unit = [*UNIT_SCALES][best]
        raise InputError(f"{name}: the angular rate fits gravity only in {unit}; give --gyr-unit {unit}.")
    rates = f"{rate / scales[best]:.3g} Hz than at {rate:.3g} Hz"
    if scales[best] < 1:
        raise InputError(
            f"{name}: the angular rate fits gravity better at {rates}; correct --rate or the time."
        )
    yield f"the angular rate fits gravity better at {rates}: a wrong rate, or much clipping; check --rate."


def _check_start(recording: Recording) -> Iterator[str]:
    """At rest, the sensor turns less than `TILT` within `START`, and gravity in it is as steady."""
    n = max(3, round(START / recording.period))
    turned = np.linalg.norm(recording.gyr[:n], axis=1).sum() * recording.period
    shaken = np.sqrt(recording.acc[:n].var(axis=0).sum()) / GRAVITY
    if max(turned, shaken) > TILT:
        yield (
            f"the sensor moves in the first {START} s ({np.rad2deg(turned):.0f} deg, {shaken * GRAVITY:.2g} m/s²): "
            "its attitude there is found from what follows, less surely; start recordings at rest."
        )
