"""Where each channel saturates: rails found in the recording itself, and the gaps that they leave."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int, Shaped

from jaxsat.errors import InputError
from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import runs

# A plateau is one value before the factory calibration and a band after it: misalignment adds a per cent or
# two of the other axes. Wider than 5 % of the rail is no longer a plateau.
DEPTHS = (0.0, 0.001, 0.0025, 0.005, 0.01, 0.02, 0.035, 0.05)
# Log-odds from which a rail is sure: a recording has twelve places to find one by chance.
EVIDENCE = np.log(12)

RailSetting = Literal["auto", "none"] | float


class Rails(eqx.Module):
    """From where on a channel counts as saturated; infinite where no rail was found."""

    low: Float[np.ndarray, "6"]
    """Samples at or below this are saturated downwards (rad/s and m/s²)."""
    high: Float[np.ndarray, "6"]
    """Samples at or above this are saturated upwards."""
    low_count: Int[np.ndarray, "6"]
    """Samples at or beyond the lower rail."""
    high_count: Int[np.ndarray, "6"]
    """Samples at or beyond the upper rail."""


class Gaps(eqx.Module):
    """Runs of saturated samples of one channel and one sign, one row each; intervals are [start, end)."""

    channel: Int[np.ndarray, "G"]
    sign: Int[np.ndarray, "G"]
    start: Int[np.ndarray, "G"]
    end: Int[np.ndarray, "G"]

    def __len__(self) -> int:
        return len(self.channel)


def find_rails(recording: Recording, gyr: RailSetting = "auto", acc: RailSetting = "auto") -> Rails:
    """Saturation limits per channel and sign: found ("auto"), absent ("none"), or one magnitude for three axes.

    A channel has a rail where its highest peaks are flatter, or end closer together, than parabolas through
    their flanks could; the rail is the lowest sample of these plateaus, so that one smeared by the calibration
    after clipping is covered. No limit is assumed and no unit matters. A motion that holds exactly one rate,
    entered and left within a sample, cannot be told from a rail. Raises `InputError` for a limit of 0 or less.
    """
    signal = recording.signal
    usable = ~recording.missing
    score, edge = np.full((2, 2, 6), np.inf)
    asked = [j for j in range(6) if (gyr if j < 3 else acc) == "auto"]
    score[:, asked], edge[:, asked] = _cut_off([signal[usable[:, j], j] for j in asked])
    for sensor, setting in ((slice(0, 3), gyr), (slice(3, 6), acc)):
        if setting == "auto":
            edge[:, sensor] = _sure(score[:, sensor], edge[:, sensor])
        elif setting != "none":
            if not float(setting) > 0:
                raise InputError(
                    f"a rail of {setting} is not a limit; give a positive magnitude, auto or none."
                )
            # A limit given in another unit may have been rounded on its way.
            edge[:, sensor] = float(setting) * (1 - 1e-6)
    low, high = -edge[0], edge[1]
    return Rails(
        low, high, np.sum(usable & (signal <= low), axis=0), np.sum(usable & (signal >= high), axis=0)
    )


def _sure(score: Float[np.ndarray, "2 3"], edge: Float[np.ndarray, "2 3"]) -> Float[np.ndarray, "2 3"]:
    """Plateau edges of the axes of one sensor, infinite where they may be none."""
    sure = (score >= EVIDENCE) & np.isfinite(edge)
    # The axes of a sensor share one full scale: beside a sure rail, being likelier than not is enough.
    if sure.any():
        beside = np.abs(edge[..., None] / edge[sure] - 1).min(axis=-1) < 0.1
        sure |= beside & (score > 0)
    return np.where(sure, edge, np.inf)


def _cut_off(channels: list[Float[np.ndarray, "_"]]) -> Float[np.ndarray, "2 2 C"]:
    """Log-odds that the highest peaks of each were cut off, downwards and upwards, and where their plateaus begin."""
    score, edge = np.full(2 * len(channels), -np.inf), np.full(2 * len(channels), np.inf)
    sides = _Sides(channels)
    if sides.count:
        tops = [_Tops(sides, depth) for depth in DEPTHS]
        scores = np.stack([t.flatness() + t.pairing() + t.levelling() for t in tops])
        best = scores.argmax(axis=0)
        highest, edges = scores.max(axis=0), np.full(sides.count, np.inf)
        for k, here in enumerate(tops):
            # Below the best depth, further plateaus count if they are flat by themselves.
            further = here.edge(below=sides.top - tops[k - 1].depth) if k else edges
            edges = np.minimum(edges, np.where(best == k, here.edge(), np.where(best < k, further, np.inf)))
        # A smeared plateau has next to no equal samples; where equality alone explains it, the rail is sharp.
        score[sides.which] = highest
        edge[sides.which] = np.where(scores[0] >= highest / 2, sides.top, edges)
    return np.stack([score, edge]).reshape(2, 2, len(channels))


class _Sides:
    """Channels downwards and upwards, one behind the other: what is asked of each is asked of all at once."""

    def __init__(self, channels: list[Float[np.ndarray, "_"]]):
        moving = {j: x for j, x in enumerate(channels) if len(x) >= 7 and np.ptp(x) > 0}
        known = {j: (_noise(x), _quantum(x)) for j, x in moving.items()}
        # Those that can have a rail at all, by their place among all.
        sides = {(i, j): sign * x for i, sign in enumerate((-1, 1)) for j, x in moving.items()}
        sides = {place: x for place, x in sides.items() if x.max() > 0}
        self.count, self.which = len(sides), [i * len(channels) + j for i, j in sides]
        lengths = np.array([len(x) for x in sides.values()], int)
        # Something between them ends each one's last run.
        self.x = np.concatenate([[], *(part for x in sides.values() for part in (x, [-np.inf]))])
        self.end = np.cumsum(lengths + 1) - 1
        self.start = self.end - lengths
        self.top = np.array([x.max() for x in sides.values()])
        self.noise, self.quantum = np.array([known[j] for _, j in sides]).reshape(-1, 2).T
        lowest = (1 - max(DEPTHS)) * self.top
        self.high = np.flatnonzero(self.x >= np.repeat(lowest, lengths + 1))
        peaks = [_peaks(x, least) for x, least in zip(sides.values(), lowest, strict=True)]
        self.peaks = np.concatenate([np.zeros((2, 0)), *peaks], axis=1)
        self.peak_side = np.repeat(np.arange(self.count), [each.shape[1] for each in peaks])

    def above(self, level: Float[np.ndarray, "S"]) -> tuple[Int[np.ndarray, "R"], ...]:
        """Runs of samples at or above each signal's level, with two samples on either side: side, start, end."""
        at = self.high[self.x[self.high] >= level[np.searchsorted(self.end, self.high)]]
        new = np.diff(at) > 1
        start, end = at[np.append(True, new)[: len(at)]], at[np.append(new, True)[: len(at)]] + 1
        side = np.searchsorted(self.end, start)
        inner = (start - self.start[side] > 1) & (self.end[side] - end > 1)
        return side[inner], start[inner], end[inner]

    def total(self, values: Shaped[np.ndarray, "R"], side: Int[np.ndarray, "R"]) -> Float[np.ndarray, "S"]:
        # Without any, NumPy counts in integers.
        return np.bincount(side, values, self.count).astype(float)

    def least(self, values: Float[np.ndarray, "R"], side: Int[np.ndarray, "R"]) -> Float[np.ndarray, "S"]:
        """Infinite for those without any."""
        found = np.full(self.count, np.inf)
        np.minimum.at(found, side, values)
        return found


class _Tops:
    """The runs of samples within `depth` (of the maximum) of the maximum of each signal, and what their shapes say.

    Each measure is a sum over runs of the log-odds of a cut against a parabola. A run that looks like a
    parabola counts -1 at worst: it speaks against the rail, but a low peak may touch the band by itself.
    """

    def __init__(self, sides: _Sides, depth: float):
        self.sides, self.depth = sides, depth * sides.top
        x = sides.x
        self.side, start, end = sides.above(sides.top - self.depth)
        self.n = end - start
        pieces = np.stack([start, end], axis=1).ravel()
        self.highest, self.lowest = (
            piece.reduceat(x, pieces)[::2] if len(pieces) else np.zeros(0)
            for piece in (np.maximum, np.minimum)
        )
        self.step = (x[start] - x[start - 1] + x[end - 1] - x[end]) / 2
        self.long = self.n > 2
        self.peak = np.where(x[start] >= x[end - 1], start, end - 1)
        self.short = ~self.long & ~_whole(x, self.peak)
        self.noise, self.quantum = sides.noise[self.side], sides.quantum[self.side]
        self.flat = np.where(self.long, self._flat(), 0.0)

    def _odds(self, rise: np.ndarray, spread: np.ndarray, step: np.ndarray, used: np.ndarray) -> np.ndarray:
        noise, quantum = self.noise[used], self.quantum[used]
        # Noise makes steps look steep, but never makes neighbours equal, unless the numbers are coarse.
        certain = (spread == 0) & (quantum == 0)
        steep = np.where(certain, step, step - 4 * noise)
        # Neighbours may agree by chance: no run counts as flatter than 2 % of its steps.
        seen = np.maximum(spread + 2 * quantum, 0.02 * step)
        with np.errstate(divide="ignore", invalid="ignore"):
            odds = np.log(np.maximum(rise * steep, 1e-3 * seen) / seen)
        return np.where(steep > 0, np.maximum(odds, -1.0), 0.0)

    def _flat(self) -> np.ndarray:
        """A parabola of n samples, entered and left with steps s on average, spreads over s(n-2)/4 or more.

        Beyond ten samples the rise no longer counts: a smooth motion may hold a rate that long.
        """
        rise = np.clip((self.n - 2) / 4, 0, 2)
        return self._odds(rise, self.highest - self.lowest, self.step, np.full(len(rise), True))

    def flatness(self) -> Float[np.ndarray, "S"]:
        return self.sides.total(self.flat, self.side)

    def pairing(self) -> Float[np.ndarray, "S"]:
        """Of a parabola, the two highest samples differ by anything up to half of the mean step around them.

        A quarter is the median; half of that keeps the mean of the log-odds of whole peaks below zero.
        """
        i, side, x = self.peak[self.short], self.side[self.short], self.sides.x
        j = np.where(x[i - 1] > x[i + 1], i - 1, i + 1)
        step = (x[i] - x[2 * i - j] + x[j] - x[2 * j - i]) / 2
        odds = self._odds(np.full(len(i), 1 / 8), x[i] - x[j], step, self.short)
        # Peaks of one sample, which are no pairs, do not speak against a common level.
        within = x[j] >= (self._top() - self.depth)[side]
        counted = np.maximum(np.where(within, odds, np.minimum(odds, 0.0)), -0.7)
        return np.maximum(0.0, self.sides.total(counted, side))

    def levelling(self) -> Float[np.ndarray, "S"]:
        """Peaks of one or two samples that end within `depth` of each other, rather than within s/4.

        Under a parabola of equal heights the fraction within d is √(4d/s); Chernoff's bound on the chance
        of so many, given those that end a little lower.
        """
        side, step, sides = self.side[self.short], self.step[self.short], self.sides
        # Peaks with the same flanks, to 2 %, are one peak seen again: a vibration, not a coincidence.
        flanks = np.round(np.log(np.maximum(step, 1e-300)) / 0.02)
        k = np.bincount(np.unique(np.stack([side, flanks]), axis=1)[0].astype(int), minlength=sides.count) - 1
        reach = np.sqrt(np.clip(4 * (self.depth[side] + 2 * self.quantum[self.short]) / step, 0.02, 1.0))
        level, above = sides.peaks
        most = (self._top() - self.depth)[sides.peak_side]
        lower = (level < most) & (level >= most + self.depth[sides.peak_side] - above)
        n = k + sides.total(lower, sides.peak_side)
        with np.errstate(divide="ignore", invalid="ignore"):
            p, q = sides.total(reach, side) / np.bincount(side, minlength=sides.count), k / n
            rest = np.where(k < n, (1 - q) * np.log((1 - q) / (1 - p)), 0.0)
            return np.where((k >= 1) & (q > p), n * (q * np.log(q / p) + rest), 0.0)

    def _top(self) -> Float[np.ndarray, "S"]:
        """The highest sample of each signal's runs."""
        return -self.sides.least(-self.highest, self.side)

    def edge(self, below: Float[np.ndarray, "S"] | None = None) -> Float[np.ndarray, "S"]:
        """The lowest sample of each signal's plateaus, or of those that lie `below` a level and are clearly flat."""
        used = (self.flat > 0) | self.short
        if below is not None:
            used = (self.flat > 1) & (self.highest < below[self.side])
        return self.sides.least(self.lowest[used], self.side[used])


def _noise(x: np.ndarray) -> float:
    """Standard deviation of white noise, from the quietest fifth of the second differences."""
    # The 0.2 quantile of |z| is 0.253, and a second difference has √6 times the noise.
    return float(np.quantile(np.abs(np.diff(x, 2)), 0.2) / (0.253 * np.sqrt(6)))


def _quantum(x: np.ndarray) -> float:
    """The step of the numbers themselves; 0 where small steps are not multiples of one."""
    steps = np.abs(np.diff(x))
    # Below one part in a million lies the rounding of numbers stored in float32.
    steps = steps[steps > 1e-6 * np.abs(x).max()]
    if len(steps) == 0:
        return 0.0
    quantum = steps.min()
    ratio = steps[steps < 20 * quantum] / quantum
    return float(quantum) if np.mean(np.abs(ratio - np.round(ratio)) < 0.1) > 0.9 else 0.0


def _peaks(x: np.ndarray, least: float) -> Float[np.ndarray, "2 P"]:
    """Of each local maximum that may have been cut, its sample and how far above it a parabola may reach; of those
    only that may reach so high.
    """
    i = 2 + np.flatnonzero((x[2:-2] >= x[1:-3]) & (x[2:-2] > x[3:-1]))
    peaks = np.stack([x[i], (2 * x[i] - x[i - 1] - x[i + 1]) / 8])
    high = peaks.sum(axis=0) >= least
    return peaks[:, high][:, ~_whole(x, i[high])]


def _whole(x: np.ndarray, i: np.ndarray) -> np.ndarray:
    """Peaks that a cubic through their four neighbours explains: sampled finely, and not cut at that sample."""
    cubic = (4 * (x[i - 1] + x[i + 1]) - (x[i - 2] + x[i + 2])) / 6
    return np.abs(cubic - x[i]) <= (2 * x[i] - x[i - 1] - x[i + 1]) / 8


def saturation_mask(
    recording: Recording, rails: Rails
) -> tuple[Bool[np.ndarray, "N 6"], Int[np.ndarray, "N 6"]]:
    """Which samples are saturated, and in which direction (-1, 0, +1) the true value lies: at or beyond them.

    Flags of the device are added, with the sign of the value; samples that were not measured have none.
    A sample beside a plateau that was clipped for a part of its period only is not flagged: it lacks less
    than half of what the signal rises within that part.
    """
    signal = recording.signal
    sign = (signal >= rails.high).astype(int) - (signal <= rails.low).astype(int)
    if recording.clipped is not None:
        sign = np.where(recording.clipped & (sign == 0), np.where(signal < 0, -1, 1), sign)
    sign = np.where(recording.missing, 0, sign)
    return sign != 0, sign


def find_gaps(sign: Int[np.ndarray, "N 6"]) -> Gaps:
    """Maximal runs of one channel and one sign, ordered by channel and start."""
    rows = []
    for j in range(sign.shape[1]):
        for s in (-1, 1):
            start, end = runs(sign[:, j] == s)
            rows.append(np.stack([np.full_like(start, j), np.full_like(start, s), start, end], axis=1))
    table = np.concatenate(rows)
    table = table[np.lexsort((table[:, 2], table[:, 0]))]
    return Gaps(*table.T)
