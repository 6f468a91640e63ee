"""What a recording can be used for: a trajectory, a periodic motion, or an orientation."""

from dataclasses import dataclass

import numpy as np
import scipy
from jaxtyping import Bool, Float

from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import find_rests

CONTRAST = 4.0
"""How far a peak of the spectrum stands out of what lies half an octave and more beside it."""
SEGMENTS = 8
"""Overlapping stretches whose periodograms are averaged: with three axes, noise reaches 2 of `CONTRAST`."""
PERIODS = 4
"""A stretch must hold so many periods."""


@dataclass(frozen=True)
class Support:
    """What can be estimated, each with its reason in half a sentence."""

    trajectory: bool
    periodic: bool
    orientation: bool
    reasons: dict[str, str]

    def sentence(self) -> str:
        """'It supports …; not …', for messages."""
        able = [name for name in self.reasons if getattr(self, name)]
        unable = [name for name in self.reasons if not getattr(self, name)]
        first = " and ".join(f"{name} ({self.reasons[name]})" for name in able) or "nothing"
        return f"it supports {first}" + "".join(f"; no {name}: {self.reasons[name]}" for name in unable)


def measured_sensors(recording: Recording) -> dict[str, bool]:
    """Which sensors have measured at least half of the time on every axis, 'gyr' and 'acc'."""
    share = recording.missing.mean(axis=0)
    return {"gyr": bool((share[:3] <= 0.5).all()), "acc": bool((share[3:] <= 0.5).all())}


def find_band(x: Float[np.ndarray, "N C"], period: float) -> tuple[float, float, float] | None:
    """Lowest, dominant and highest frequency (Hz) of the motion that stands out of a signal; None without any.

    Of the Welch spectrum, summed over channels, the peak with the largest ratio to the louder one of its
    surroundings (1.4 to 2.2 times higher and lower; its own harmonic lies among them, but is one line of many,
    and medians count). The band ends where the spectrum falls to the geometric mean of peak and surroundings.
    """
    length = int(2 * len(x) / (SEGMENTS + 1))
    if length < 16:
        return None
    frequency, power = scipy.signal.welch(
        scipy.signal.detrend(x, axis=0), 1 / period, "hann", length, axis=0, detrend="linear"
    )
    power = np.maximum(power.sum(axis=1), 1e-30)
    best = None
    for k in np.flatnonzero((frequency >= PERIODS / (length * period)) & (frequency < 0.4 / period)):
        f = frequency[k]
        below = power[(frequency > f / 2.2) & (frequency < f / 1.4)]
        above = power[(frequency > f * 1.4) & (frequency < f * 2.2)]
        if not len(below) or not len(above):
            continue
        beside = max(np.median(below), np.median(above))
        if power[k] > CONTRAST * beside and (best is None or power[k] / beside > best[0]):
            best = (power[k] / beside, k, beside)
    if best is None:
        return None
    _, k, beside = best
    low = high = k
    floor = np.sqrt(power[k] * beside)
    while low > 1 and power[low - 1] > floor:
        low -= 1
    while high < len(power) - 2 and power[high + 1] > floor:
        high += 1
    step = frequency[1]
    return float(max(frequency[low] - step, step)), float(frequency[k]), float(frequency[high] + step)


def find_support(recording: Recording, rest: Bool[np.ndarray, "N"] | None = None) -> Support:
    """Which of trajectory, periodic motion and orientation a recording supports.

    A trajectory needs both sensors and a rest; a periodic motion one sensor and a frequency that stands out of its
    spectrum; an orientation both sensors. rest: as found before; None detects them.
    """
    there = measured_sensors(recording)
    reasons = {}
    rest = find_rests(recording) if rest is None else rest
    both = there["gyr"] and there["acc"]
    lacking = f"no {'gyroscope' if there['acc'] else 'accelerometer' if there['gyr'] else 'sensor'}"
    if not both:
        reasons["trajectory"] = lacking
    elif not rest.any():
        reasons["trajectory"] = "the sensor never rests"
    else:
        first = recording.time[np.argmax(rest)] - recording.time[0]
        reasons["trajectory"] = f"at rest for {rest.mean():.0%} of the time, first at {first:.3g} s"
    bands = {
        name: find_band(x, recording.period)
        for name, x in (("acc", recording.acc), ("gyr", recording.gyr))
        if there[name]
    }
    found = {name: band for name, band in bands.items() if band is not None}
    reasons["periodic"] = (
        ", ".join(f"{name} at {band[1]:.3g} Hz" for name, band in found.items())
        or "no frequency stands out of the spectrum"
    )
    reasons["orientation"] = "both sensors" if both else lacking
    return Support(both and bool(rest.any()), bool(found), both, reasons)
