"""How often the intervals of `map` hold what real recordings clipped in software lost."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from scipy.stats import norm

from jaxsat.pipeline import Estimate
from jaxsat.present.tables import gaps_table
from jaxsat.signals.recording import CHANNELS, Recording
from jaxsat.studies.boards import Row

GOALS = {0.5: (0.45, 0.55), 0.9: (0.85, 0.95)}
WHAT = {"samples": "filled samples", "peaks": "peaks of gaps", "impulses": "impulses of gaps"}


def held(name: str, recording: Recording, found: Estimate) -> Iterator[dict]:
    """Of one clipped recording: errors over their sd of all that was filled, by what it is and its sensor.

    recording: as it was before it was clipped, where it is the truth but for its noise.
    """
    lost, truth = found.saturated, recording.signal
    away = (found.filled - truth)[lost] / found.signal_sd[lost]
    sensor = np.nonzero(lost)[1] // 3
    for z, which in zip(away, sensor, strict=True):
        yield {"trial": name, "sensor": ("gyr", "acc")[which], "what": "samples", "z": z}
    clipped, time = found.recording.signal, recording.time
    for gap in gaps_table(found).dropna(subset=["peak_sd"]).to_dict("records"):
        channel = CHANNELS.index(gap["channel"])
        inside = slice(*np.searchsorted(time, np.array([gap["start"], gap["end"]]) - 0.5 * recording.period))
        true = truth[inside, channel]
        peak = true[np.argmax(np.abs(true))]
        impulse = np.sum(true - clipped[inside, channel]) * recording.period
        one = {"trial": name, "sensor": ("gyr", "acc")[channel // 3]}
        yield {**one, "what": "peaks", "z": (gap["peak"] - peak) / gap["peak_sd"]}
        yield {**one, "what": "impulses", "z": (gap["impulse"] - impulse) / gap["impulse_sd"]}


def summary(scores: pd.DataFrame) -> pd.DataFrame:
    """Share of |z| within the central 50 % and 90 % of a Gaussian, by trial and sensor, and how many there were."""
    groups = scores.groupby(["trial", "sensor", "what"], sort=False)["z"]
    shares = {
        f"within_{share:.0%}".rstrip("%"): groups.apply(
            lambda z, share=share: float(np.mean(np.abs(z) <= norm.ppf(0.5 + share / 2)))
        )
        for share in GOALS
    }
    return pd.DataFrame({"count": groups.size(), **shares}).reset_index()


def board(table: pd.DataFrame) -> Iterator[Row]:
    """Shares over all trials, each gap or sample counting once; nearest to the nominal share is best."""
    for what, words in WHAT.items():
        rows = table[table["what"] == what]
        for share, (low, high) in GOALS.items():
            column = f"within_{share * 100:.0f}"
            value = float(np.average(rows[column], weights=rows["count"]))
            by_trial = [float(np.mean(part[column])) for _, part in rows.groupby("trial")]
            yield Row(
                f"interval_{share * 100:.0f}_{what}", abs(value - share), "1", "lower", high - share, None,
                f"{value:.0%} of {rows['count'].sum()} {words} lie in their {share:.0%} intervals (goal {low:.0%} to "
                f"{high:.0%}); trials {min(by_trial):.0%} to {max(by_trial):.0%}",
            )  # fmt: skip
