"""Time stamps: from what a logger wrote to one uniform grid, with every invented sample flagged."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.optimize import isotonic_regression

from jaxsat.errors import InputError


class Grid(NamedTuple):
    """A uniform grid, and where on it each measured sample lies (in periods)."""

    start: float
    period: float
    place: np.ndarray

    @property
    def time(self) -> Float[np.ndarray, "M"]:
        """Time of every grid point (s)."""
        count = int(np.floor(self.place[-1] + 1e-6)) + 1
        return self.start + self.period * np.arange(count)


def drop_repeats(
    time: Float[np.ndarray, "N"], values: Float[np.ndarray, "N C"], name: str, row: Callable[[Any], str]
) -> Int[np.ndarray, "M"]:
    """Indices of the rows to keep: rows that repeat the one before them exactly are dropped.

    Raises `InputError` where a time stamp is absent, goes back, or stands still while the values change.
    """
    absent = np.flatnonzero(np.isnan(time))
    if len(absent):
        raise InputError(f"{name}: {row(absent[0])} has no time stamp; fill it in or delete the line.")
    step = np.diff(time)
    back = np.flatnonzero(step < 0)
    if len(back):
        k = back[0]
        raise InputError(
            f"{name}: time jumps back from {time[k]:.6g} s to {time[k + 1]:.6g} s at {row(k + 1)}; "
            "sort the rows, or split the file there."
        )
    same = ((values[1:] == values[:-1]) | (np.isnan(values[1:]) & np.isnan(values[:-1]))).all(axis=1)
    stuck = np.flatnonzero((step == 0) & ~same)
    if len(stuck):
        k = stuck[0] + 1
        raise InputError(
            f"{name}: {row(k)} repeats the time stamp {time[k]:.6g} s of the row before with other values; "
            "export finer time stamps, or leave the time out and give --rate."
        )
    return np.flatnonzero(np.concatenate([[True], step > 0]))


def find_grid(time: Float[np.ndarray, "N"], rate: float | None, declared: bool, name: str) -> Grid:
    """The uniform grid of increasing time stamps (s).

    A sensor samples regularly and its logger stamps late, so each sample keeps its value and takes the grid
    slot nearest to its stamp, in order and one each (an isotonic regression of the stamps); slots left empty
    are lost samples. The period is the least-squares fit to the stamps. Where this fails, with more than 1 %
    of the stamps over half a period from their slot, or where another rate is asked for (so much that samples
    would move by half a period), samples are interpolated: at `rate`, or without one at their mean rate.

    Raises `InputError` if a declared rate differs by more than 2 % from that of regular stamps, and if the
    stamps would leave more than half of the grid empty.
    """
    since = time - time[0]
    fits = [_fit(since, slots) for slots in _guesses(since)]
    start, period, slots = min(fits, key=lambda fit: _misfit(since, fit).std())
    regular = np.mean(np.abs(_misfit(since, (start, period, slots))) > 0.5) < 0.01
    if regular and rate is not None:
        if declared and abs(rate * period - 1) > 0.02:
            raise InputError(
                f"{name}: the rate is given as {rate:g} Hz, but the time stamps say {1 / period:.4g} Hz; "
                "leave the rate out or correct the one that is wrong."
            )
        regular = abs(rate * period - 1) * slots[-1] < 0.5
    if not regular:
        period = 1 / rate if rate is not None else since[-1] / (len(since) - 1)
        start, slots = 0.0, since / period
    if slots[-1] + 1 > 2 * len(time):
        k = int(np.argmax(np.diff(time)))
        raise InputError(
            f"{name}: more than half of the samples are missing, the longest gap from {time[k]:.6g} s to "
            f"{time[k + 1]:.6g} s; cut the recording there, or check the unit of the time."
        )
    return Grid(float(time[0] + start), float(period), slots)


def _guesses(since: np.ndarray) -> list[np.ndarray]:
    """Slots if no sample was lost, and if every long step is a loss."""
    step = np.diff(since)
    lost = np.cumsum(np.maximum(1, np.round(step / np.median(step))))
    return [np.arange(len(since), dtype=np.float64), np.concatenate([[0.0], lost])]


def _fit(since: np.ndarray, slots: np.ndarray) -> tuple[float, float, np.ndarray]:
    """Start, period and slots that agree with each other, by turns from a first guess of the slots."""
    count = np.arange(len(since))
    start, period = 0.0, 1.0
    for _ in range(10):
        period, start = np.polyfit(slots, since, 1)
        new = count + np.round(isotonic_regression((since - start) / period - count).x)
        new -= new[0]
        if np.array_equal(new, slots):
            break
        slots = new
    return start, period, slots


def _misfit(since: np.ndarray, fit: tuple[float, float, np.ndarray]) -> np.ndarray:
    start, period, slots = fit
    return (since - start) / period - slots


def onto_grid(
    grid: Grid, values: Float[np.ndarray, "N C"]
) -> tuple[Float[np.ndarray, "M C"], Bool[np.ndarray, "M C"]]:
    """Values at every grid point, interpolated linearly per channel, and where they were not measured.

    A grid point counts as measured if a sample (NaN is none) lies within three quarters of a period: the
    middle of a hole of more than 1.5 periods is missing. A channel without any sample becomes zero.
    """
    points = np.arange(len(grid.time), dtype=np.float64)
    filled = np.zeros((len(points), values.shape[1]))
    missing = np.ones(filled.shape, dtype=bool)
    for channel in range(values.shape[1]):
        there = np.isfinite(values[:, channel])
        if there.any():
            place = grid.place[there]
            filled[:, channel] = np.interp(points, place, values[there, channel])
            missing[:, channel] = np.abs(place[_nearest(place, points)] - points) > 0.75
    return filled, missing


def flags_onto_grid(grid: Grid, flags: Bool[np.ndarray, "N *C"]) -> Bool[np.ndarray, "M *C"]:
    """Flags at every grid point: those of the nearest sample."""
    points = np.arange(len(grid.time), dtype=np.float64)
    return flags[_nearest(grid.place, points)]


def _nearest(place: np.ndarray, points: np.ndarray) -> np.ndarray:
    if len(place) == 1:
        return np.zeros(len(points), dtype=int)
    right = np.clip(np.searchsorted(place, points), 1, len(place) - 1)
    return right - (points - place[right - 1] <= place[right] - points)
