"""Where each channel saturates: rails found in the recording itself, and the gaps that they leave."""

from typing import Literal

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float, Int

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
    edge = np.full((2, 6), np.inf)
    for sensor, setting in ((slice(0, 3), gyr), (slice(3, 6), acc)):
        if setting == "auto":
            edge[:, sensor] = _sensor_rails(signal[:, sensor], usable[:, sensor])
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


def _sensor_rails(signal: np.ndarray, usable: np.ndarray) -> np.ndarray:
    """Plateau edges of the three axes of one sensor, downwards and upwards (2, 3)."""
    found = np.array([_channel_rails(signal[usable[:, j], j]) for j in range(3)])
    score, edge = found[..., 0].T, found[..., 1].T
    sure = (score >= EVIDENCE) & np.isfinite(edge)
    # The axes of a sensor share one full scale: beside a sure rail, being likelier than not is enough.
    if sure.any():
        beside = np.abs(edge[..., None] / edge[sure] - 1).min(axis=-1) < 0.1
        sure |= beside & (score > 0)
    return np.where(sure, edge, np.inf)


def _channel_rails(x: Float[np.ndarray, "N"]) -> list[tuple[float, float]]:
    """Of one channel, downwards and upwards: log-odds that its peaks were cut off, and where their plateau begins."""
    if len(x) < 7 or x.max() == x.min():
        return [(-np.inf, np.inf)] * 2
    noise, quantum = _noise(x), _quantum(x)
    return [_upper_rail(sign * x, noise, quantum) for sign in (-1, 1)]


def _upper_rail(x: np.ndarray, noise: float, quantum: float) -> tuple[float, float]:
    top = x.max()
    if top <= 0:
        return -np.inf, np.inf
    peaks = _peaks(x)
    tops = [_Tops(x, depth * top, noise, quantum, peaks) for depth in DEPTHS]
    scores = [t.flatness() + t.pairing() + t.levelling() for t in tops]
    best = int(np.argmax(scores))
    # A smeared plateau has next to no equal samples; where equality alone explains it, the rail is sharp.
    if scores[0] >= scores[best] / 2:
        return scores[best], float(top)
    # Below the best depth, further plateaus count if they are flat by themselves.
    edges = [tops[best].edge()]
    for before, deeper in zip(tops[best:], tops[best + 1 :], strict=False):
        edges.append(deeper.edge(below=top - before.depth))
    return scores[best], min(edges)


class _Tops:
    """The runs of samples within `depth` of the maximum of one channel, and what their shapes say.

    Each measure is a sum over runs of the log-odds of a cut against a parabola. A run that looks like a
    parabola counts -1 at worst: it speaks against the rail, but a low peak may touch the band by itself.
    """

    def __init__(self, x: np.ndarray, depth: float, noise: float, quantum: float, peaks: np.ndarray):
        self.x, self.depth, self.noise, self.quantum, self.peaks = x, depth, noise, quantum, peaks
        start, end = runs(x >= x.max() - depth)
        # Two samples are needed on either side.
        inner = (start > 1) & (end < len(x) - 1)
        self.start, self.end = start[inner], end[inner]
        self.n = self.end - self.start
        pieces = np.stack([self.start, self.end], axis=1).ravel()
        self.highest = np.maximum.reduceat(x, pieces)[::2] if len(pieces) else np.zeros(0)
        self.lowest = np.minimum.reduceat(x, pieces)[::2] if len(pieces) else np.zeros(0)
        entry = x[self.start] - x[self.start - 1]
        leave = x[self.end - 1] - x[self.end]
        self.step = (entry + leave) / 2
        self.long = self.n > 2
        self.peak = np.where(x[self.start] >= x[self.end - 1], self.start, self.end - 1)
        self.short = ~self.long & ~_whole(x, self.peak)

    def _odds(self, rise: np.ndarray, spread: np.ndarray, step: np.ndarray) -> np.ndarray:
        # Noise makes steps look steep, but never makes neighbours equal, unless the numbers are coarse.
        certain = (spread == 0) & (self.quantum == 0)
        steep = np.where(certain, step, step - 4 * self.noise)
        # Neighbours may agree by chance: no run counts as flatter than 2 % of its steps.
        seen = np.maximum(spread + 2 * self.quantum, 0.02 * step)
        odds = np.log(np.maximum(rise * steep, 1e-3 * seen) / seen)
        return np.where(steep > 0, np.maximum(odds, -1.0), 0.0)

    def _flat(self) -> np.ndarray:
        """A parabola of n samples, entered and left with steps s on average, spreads over s(n-2)/4 or more.

        Beyond ten samples the rise no longer counts: a smooth motion may hold a rate that long.
        """
        with np.errstate(divide="ignore", invalid="ignore"):
            odds = self._odds(np.clip((self.n - 2) / 4, 0, 2), self.highest - self.lowest, self.step)
        return np.where(self.long, odds, 0.0)

    def flatness(self) -> float:
        return float(self._flat().sum())

    def pairing(self) -> float:
        """Of a parabola, the two highest samples differ by anything up to half of the mean step around them.

        A quarter is the median; half of that keeps the mean of the log-odds of whole peaks below zero.
        """
        i = self.peak[self.short]
        x = self.x
        j = np.where(x[i - 1] > x[i + 1], i - 1, i + 1)
        step = (x[i] - x[2 * i - j] + x[j] - x[2 * j - i]) / 2
        with np.errstate(divide="ignore", invalid="ignore"):
            odds = self._odds(np.full(len(i), 1 / 8), x[i] - x[j], step)
        # Peaks of one sample, which are no pairs, do not speak against a common level.
        within = x[j] >= self.highest.max(initial=-np.inf) - self.depth
        return max(0.0, float(np.maximum(np.where(within, odds, np.minimum(odds, 0.0)), -0.7).sum()))

    def levelling(self) -> float:
        """Peaks of one or two samples that end within `depth` of each other, rather than within s/4.

        Under a parabola of equal heights the fraction within d is √(4d/s); Chernoff's bound on the chance
        of so many, given those that end a little lower.
        """
        step = self.step[self.short]
        # Peaks with the same flanks, to 2 %, are one peak seen again: a vibration, not a coincidence.
        k = len(np.unique(np.round(np.log(np.maximum(step, 1e-300)) / 0.02))) - 1
        if k < 1:
            return 0.0
        p = np.sqrt(np.clip(4 * (self.depth + 2 * self.quantum) / step, 0.02, 1.0)).mean()
        top, (level, reach) = self.highest.max(), self.peaks
        n = k + int(np.sum((level < top - self.depth) & (level >= top - reach)))
        q = k / n
        if q <= p:
            return 0.0
        rest = (1 - q) * np.log((1 - q) / (1 - p)) if k < n else 0.0
        return float(n * (q * np.log(q / p) + rest))

    def edge(self, below: float = np.inf) -> float:
        """The lowest sample of the plateaus, or of those alone that lie `below` a level and are clearly flat."""
        odds = self._flat()
        used = (odds > 0) | self.short if below == np.inf else (odds > 1) & (self.highest < below)
        return float(self.lowest[used].min(initial=np.inf))


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


def _peaks(x: np.ndarray) -> Float[np.ndarray, "2 P"]:
    """Of each local maximum that may have been cut, its sample and how far above it a parabola may reach."""
    i = 2 + np.flatnonzero((x[2:-2] >= x[1:-3]) & (x[2:-2] > x[3:-1]))
    i = i[~_whole(x, i)]
    return np.stack([x[i], (2 * x[i] - x[i - 1] - x[i + 1]) / 8])


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
