"""When the sensor stands still, and the segments of motion between its rests."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.ndimage import maximum_filter1d, minimum_filter1d, uniform_filter1d

from jaxsat.signals.recording import Recording

Detector = Literal["shoe", "ared", "amvd", "mag"]

# What one rad/s weighs in m/s² when the two are added: the ratio of the densities of common MEMS sensors.
ACC_PER_GYR = 10.0
# A sensor up to 0.1 m above its pivot that moves slower than 0.1 m/s turns slower than 1 rad/s; one that turns
# slower than 0.1 rad/s hardly moves. A foot that starts or stops within 0.3 s passes 0.1 m/s at 0.3 m/s².
QUIETEST_MOTION = {"shoe": 0.1, "ared": 0.1, "amvd": 0.3, "mag": 0.3}
LIVELIEST_REST = {"shoe": 1.0, "ared": 1.0, "amvd": 3.0, "mag": 3.0}
# A walker takes a stride in 1.0 to 1.4 s, a runner in 0.7 s; a swing is ten times livelier than a stance.
STRIDE, CONTRAST = 1.5, 10.0

# From rest to rest a stride takes no longer than this (s). A runner's stance is at least so long and no closer to the
# next (s), and at most so much livelier than other rests (as a mean square); before and after it the foot swings so
# much livelier than it stands, and at least half as lively as in other strides.
LONGEST_SWING, SHORTEST_STANCE, CLOSEST_STANCES, LIVELIER_STANCE, STANCE_CONTRAST = 1.2, 0.025, 0.3, 2.0, 50.0
# So many strides say how lively the others are.
FEWEST_STRIDES = 5

# A rest of at least this length (s) says what a gyroscope reads when nothing turns, and how sure that is by the means
# of blocks of about `BLOCK`: who wears a sensor sways and settles within half a second.
SHORTEST_OFFSET_REST, BLOCK = 1.0, 0.5
# sd of the offset of a calibrated MEMS gyroscope (rad/s); what exceeds the sway of the rests by `CLEAR` sd is taken
# as it is.
OFFSET_SD, CLEAR = 3e-3, 2.0


class Segments(eqx.Module):
    """Stretches of motion between rests, one row each; intervals are [start, end)."""

    departure: Int[np.ndarray, "S"]
    """Last rest sample before the motion; -1 where the recording starts in motion."""
    arrival: Int[np.ndarray, "S"]
    """First rest sample after the motion; N where the recording ends in motion."""
    rest_end: Int[np.ndarray, "S"]
    """End of the rest that begins at `arrival` (exclusive); N where there is none."""

    def __len__(self) -> int:
        return len(self.departure)


def runs(mask: Bool[np.ndarray, "N"]) -> tuple[Int[np.ndarray, "R"], Int[np.ndarray, "R"]]:
    """Starts and ends (exclusive) of the maximal runs of True."""
    edge = np.diff(np.concatenate([[False], mask, [False]]).astype(np.int8))
    return np.flatnonzero(edge == 1), np.flatnonzero(edge == -1)


def detector_statistic(
    name: Detector,
    gyr: Float[np.ndarray, "N 3"],
    acc: Float[np.ndarray, "N 3"],
    period: float,
    window: float = 0.04,
) -> Float[np.ndarray, "N"]:
    """How much the sensor moves around each sample: a mean square over a centred window (s).

    The zero-velocity detectors of Skog et al. (IEEE TBME 2010): `shoe` is the generalised likelihood ratio
    |ω|² + |a − g ā/|ā||² with specific force weighed by `ACC_PER_GYR`, and `ared` the angular rate energy
    |ω|², both in (rad/s)²; `amvd` is the moving variance |a − ā|² and `mag` the magnitude (|a| − g)², both in
    (m/s²)². g is |a| where the rate is lowest.
    """
    size = max(1, round(window / period)) | 1

    def mean(x: np.ndarray) -> np.ndarray:
        return uniform_filter1d(x, size, axis=0, mode="nearest")

    rate = mean(np.sum(gyr**2, axis=1))
    length = np.linalg.norm(mean(acc), axis=1)
    # Var a = E|a|² − |E a|², about the overall mean so that gravity does not cost digits.
    centred = acc - acc.mean(axis=0)
    variance = np.maximum(mean(np.sum(centred**2, axis=1)) - np.sum(mean(centred) ** 2, axis=1), 0.0)
    gravity = np.median(length[rate <= np.quantile(rate, 0.05)])
    match name:
        case "ared":
            return np.maximum(rate, 0.0)
        case "amvd":
            return variance
        case "mag":
            return mean((np.linalg.norm(acc, axis=1) - gravity) ** 2)
        case "shoe":
            # mean |a − g ā/|ā||² = variance + (|ā| − g)²
            return rate + (variance + (length - gravity) ** 2) / ACC_PER_GYR**2


def rest_threshold(statistic: Float[np.ndarray, "N"], period: float, name: Detector = "shoe") -> float:
    """The statistic that divides a recording into rest and motion, found in the recording.

    A foot moves in strides: each stretch of `STRIDE` around a swing holds a stance, and the threshold lies
    a third of the way, in logarithm, from the median stance (least) to the median swing (greatest value),
    but never beyond `LIVELIEST_REST`. Where a quarter of the stretches lack that contrast there are no strides
    to learn from, and only what is quieter than `QUIETEST_MOTION` rests.
    """
    low, high = (2 * np.log(limit[name]) for limit in (QUIETEST_MOTION, LIVELIEST_REST))
    x = np.log(np.maximum(statistic, 1e-12))
    size = max(1, round(STRIDE / period)) | 1
    least, greatest = minimum_filter1d(x, size), maximum_filter1d(x, size)
    swings = greatest >= np.log(max(statistic.mean(), 1e-12))
    least, greatest = least[swings], greatest[swings]
    if np.quantile(greatest - least, 0.25) < 2 * np.log(CONTRAST):
        return float(np.exp(low))
    return float(np.exp(np.clip((2 * np.median(least) + np.median(greatest)) / 3, low, high)))


def find_rests(
    recording: Recording,
    detector: Detector = "shoe",
    threshold: Literal["auto"] | float = "auto",
    window: float = 0.04,
    min_duration: float = 0.05,
    saturated: Bool[np.ndarray, "N"] | None = None,
) -> Bool[np.ndarray, "N"]:
    """Samples at which the sensor rests; flags that came with the recording pass through unchanged.

    `threshold` is on `detector_statistic`, "auto" takes `rest_threshold` and looks for the stances of a runner where
    it leaves motions that are too long for a stride; `window` and `min_duration` in s. Rests shorter than
    `min_duration` are dropped; saturated and unmeasured samples never rest.
    """
    if recording.rest is not None:
        return recording.rest
    period = recording.period
    statistic = detector_statistic(detector, recording.gyr, recording.acc, period, window)
    limit = rest_threshold(statistic, period, detector) if threshold == "auto" else threshold
    barred = np.all(recording.missing, axis=1)
    possible = ~(barred if saturated is None else barred | saturated)
    start, end = runs((statistic <= limit) & possible)
    long = end - start >= round(min_duration / period)
    change = np.zeros(len(possible) + 1, int)
    change[start[long]], change[end[long]] = 1, -1
    rest = np.cumsum(change[:-1]).astype(bool)
    # Walkers' thresholds are less than half of what rests may reach (PyShoe), runners' stances lie at it and beyond.
    liveliest = LIVELIEST_REST[detector] ** 2
    if threshold == "auto" and limit > 0.5 * liveliest:
        rest |= _running_stances(statistic, rest, possible, period, liveliest)
    return rest


def _running_stances(
    statistic: Float[np.ndarray, "N"],
    rest: Bool[np.ndarray, "N"],
    possible: Bool[np.ndarray, "N"],
    period: float,
    liveliest: float,
) -> Bool[np.ndarray, "N"]:
    """Stances within motions that are too long for a stride: a runner's foot stands for some hundredths of a second.

    liveliest: statistic of a rest at most. None where there are hardly any strides to compare with.
    """
    found, motions = np.zeros(len(rest), bool), find_segments(rest)
    spans = list(zip(np.maximum(motions.departure, 0).tolist(), motions.arrival.tolist(), strict=True))
    swings = [statistic[a:b].max() for a, b in spans if (b - a) * period <= LONGEST_SWING]
    if len(swings) < FEWEST_STRIDES:
        return found
    lively = 0.5 * np.median(swings)
    apart, swing = (round(x / period) for x in (CLOSEST_STANCES, 0.5 * LONGEST_SWING))
    for a, b in spans:
        if (b - a) * period <= LONGEST_SWING:
            continue
        x, last = statistic[a:b], 0
        starts, ends = runs((x <= LIVELIER_STANCE * liveliest) & possible[a:b])
        for start, end in zip(starts.tolist(), ends.tolist(), strict=True):
            middle = start + int(np.argmin(x[start:end]))
            before, after = (
                y.max(initial=0.0) for y in (x[max(last, start - swing) : start], x[end : end + swing])
            )
            # Its edges are livelier: what is about as quiet as its middle stands.
            first, stop = runs(x[start:end] <= max(liveliest, 1.5 * x[middle]))
            part = int(np.searchsorted(start + first, middle, side="right")) - 1
            if (
                start - last >= apart
                and len(x) - end >= apart
                and (stop - first)[part] * period >= SHORTEST_STANCE
                and min(before, after) >= max(lively, STANCE_CONTRAST * x[middle])
            ):
                last = end
                found[a + start + first[part] : a + start + stop[part]] = True
    return found


def find_segments(rest: Bool[np.ndarray, "N"]) -> Segments:
    """The stretches of motion between rests, in order."""
    start, end = runs(~rest)
    rest_start, rest_end = runs(rest)
    follows = np.searchsorted(rest_start, end)
    ends = np.concatenate([rest_end, [len(rest)]])
    return Segments(departure=start - 1, arrival=end, rest_end=ends[follows])


def resting_rate(
    gyr: Float[np.ndarray, "N 3"], rest: Bool[np.ndarray, "N"], period: float
) -> Float[np.ndarray, "2 3"]:
    """Offset of a gyroscope from its mean rates at rests, each axis by itself, and its sd (rad/s).

    A foot that stands turns by a degree, which within a second passes for a large offset. So each rest counts by
    the variance of its mean, from the means of its blocks, and an offset that is not clear of the sway is shrunk by
    what is expected of a calibrated sensor. Zero where no rest is long enough.
    """
    edge, weight, total = round(0.1 / period), np.zeros(3), np.zeros(3)
    for start, end in zip(*runs(rest), strict=True):
        if (end - start) * period < SHORTEST_OFFSET_REST:
            continue
        # The first and the last stir.
        inside = gyr[start + (edge if start > 0 else 0) : end - edge]
        count = max(3, int(len(inside) * period / BLOCK))
        means = np.stack([block.mean(axis=0) for block in np.array_split(inside, count)])
        precision = count / np.maximum(means.var(axis=0, ddof=1), 1e-8)
        weight, total = weight + precision, total + precision * inside.mean(axis=0)
    if not weight.any():
        return np.stack([total, np.full(3, OFFSET_SD)])
    mean, variance = total / weight, 1.0 / weight
    clear = np.abs(mean) > CLEAR * np.sqrt(variance)
    believed = np.where(clear, 1.0, OFFSET_SD**2 / (OFFSET_SD**2 + variance))
    return np.stack([believed * mean, np.sqrt(believed * variance)])
