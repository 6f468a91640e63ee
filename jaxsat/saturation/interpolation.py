"""Filling gaps from their neighbours alone, where no rest follows that could say more.

The samples of a sensor's channels around a gap are one draw of a Gaussian process with a Matérn-7/2 kernel: three
derivatives, because a limb has a finite jerk. Its size and length scale are those under which the measured samples
around the gaps are likeliest. A gap takes the mean given its neighbours, and never less than its rail.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int
from scipy.linalg import cho_factor, cho_solve
from scipy.optimize import minimize

from jaxsat.signals.rests import runs

REACH = 0.25
"""How far to either side of a gap samples are looked at (s)."""
_LEARN_FROM = 20
_MOST = 256
# A kernel matrix of close samples is singular to rounding: noise never counts as less than this share of the size.
_LEAST_NOISE = 1e-3


class Interpolated(NamedTuple):
    """Channels with their gaps filled."""

    signal: Float[np.ndarray, "N C"]
    variance: Float[np.ndarray, "N C"]
    """Of each filled value, 0 where measured; taken as independent, the values of a gap sum up to what its integral
    is uncertain by, which is what an angle sees of them."""


def interpolate_gaps(
    signal: Float[np.ndarray, "N C"],
    sign: Int[np.ndarray, "N C"],
    period: float,
    missing: Bool[np.ndarray, "N C"] | None = None,
) -> Interpolated:
    """The channels of one sensor with saturated values replaced by what their neighbours in time suggest.

    signal: in one unit; sign: direction of saturation of each value, 0 where there is none; period: s; missing:
    values that were not measured, which say nothing. Within gaps longer than the motion's own time scale the
    neighbours do not say how high a peak was, and the variance says so.
    """
    usable = (sign == 0) & (True if missing is None else ~missing)
    gaps = [
        (c, s, int(i), int(j))
        for c in range(signal.shape[1])
        for s in (-1, 1)
        for i, j in zip(*runs(sign[:, c] == s), strict=True)
    ]
    variance = np.zeros_like(signal)
    if not gaps:
        return Interpolated(signal, variance)
    reach = max(3, round(REACH / period))
    around = [_around(usable[:, c], i, j, reach) for c, _, i, j in gaps]
    noise = _noise(signal, usable)
    drawn = np.unique(np.linspace(0, len(gaps) - 1, _LEARN_FROM).astype(int))
    size, length = _learn([(around[k] * period, signal[around[k], gaps[k][0]]) for k in drawn], noise)
    filled = signal.copy()
    for (c, s, i, j), near in zip(gaps, around, strict=True):
        inside, beside = np.arange(i, j) * period, near * period
        # Of a gap of thousands of samples some do.
        some = inside[:: -(-(j - i) // _MOST)]
        total = _covariance(some, some, size, length).mean() * (j - i) ** 2
        if len(near):
            factor = cho_factor(_covariance(beside, beside, size, length, noise))
            across = _covariance(inside, beside, size, length)
            guess = across @ cho_solve(factor, signal[near, c])
            filled[i:j, c] = s * np.maximum(s * guess, s * signal[i:j, c])
            sums = across.sum(axis=0)
            total -= sums @ cho_solve(factor, sums)
        variance[i:j, c] = max(total, 0.0) / (j - i)
    return Interpolated(filled, variance)


def _around(usable: Bool[np.ndarray, "N"], i: int, j: int, reach: int) -> Int[np.ndarray, "n"]:
    """Samples beside the gap [i, j) that say something of it."""
    near = np.arange(max(0, i - reach), min(len(usable), j + reach))
    return near[usable[near]]


def _noise(signal: np.ndarray, usable: Bool[np.ndarray, "N C"]) -> float:
    """sd of white noise, from the quietest tenth of the second differences of usable samples."""
    clean: Bool[np.ndarray, "n C"] = usable[:-2] & usable[1:-1] & usable[2:]
    second = np.abs(np.diff(signal, 2, axis=0))[clean]
    # The 0.1 quantile of |z| is 0.126, and a second difference has √6 times the noise.
    return float(np.quantile(second, 0.1) / (0.126 * np.sqrt(6))) if len(second) else 0.0


def _covariance(t, u, size: float, length: float, noise: float | None = None) -> Float[np.ndarray, "n m"]:
    """Matérn-7/2 between times t and u; with noise, that of the measurements at t."""
    r = np.sqrt(7.0) / length * np.abs(t[:, None] - u[None])
    kernel = size**2 * (1.0 + r + 0.4 * r**2 + r**3 / 15.0) * np.exp(-r)
    if noise is not None:
        kernel[np.diag_indices(len(t))] += max(noise, _LEAST_NOISE * size) ** 2
    return kernel


def _learn(windows: list[tuple[np.ndarray, np.ndarray]], noise: float) -> tuple[float, float]:
    """Size and length scale (s) of greatest marginal likelihood over some windows of times and values."""
    windows = [(t, x) for t, x in windows if len(t) > 3]
    if not windows:
        return 1.0, REACH
    spread = float(np.sqrt(np.mean(np.concatenate([x for _, x in windows]) ** 2)))

    def cost(logs):
        size, length = np.exp(logs)
        total = 0.0
        for t, x in windows:
            factor = cho_factor(_covariance(t, t, size, length, noise), lower=True)
            total += 0.5 * x @ cho_solve(factor, x) + np.log(np.diag(factor[0])).sum()
        return total

    bounds = [(np.log(0.1 * spread), np.log(30.0 * spread)), (np.log(0.02 * REACH), np.log(4.0 * REACH))]
    found = minimize(cost, np.log([spread, 0.4 * REACH]), method="L-BFGS-B", bounds=bounds)
    return float(np.exp(found.x[0])), float(np.exp(found.x[1]))
