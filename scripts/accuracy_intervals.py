"""How often the intervals of `map` hold what real recordings clipped in software lost, and what Vicon saw."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from jaxtyping import Float
from scipy.stats import norm

from jaxsat.pipeline import Estimate
from jaxsat.present.tables import gaps_table, segments_table
from jaxsat.signals.recording import CHANNELS, Recording
from jaxsat.studies.boards import Row
from jaxsat.studies.metrics import align_yaw_translation
from jaxsat.studies.tracked_point import TrackedPoint

GOALS = {0.5: (0.45, 0.55), 0.9: (0.85, 0.95)}
WHAT = {
    "samples": "filled samples",
    "peaks": "peaks of gaps",
    "impulses": "impulses of gaps",
    "lengths": "lengths of clipped strides",
    "climbs": "climbs of clipped strides",
    "distances": "distances of rests of clipped walks from the start",
    "heights": "heights of rests of clipped walks",
    "saturated lengths": "lengths of strides of saturated trials",
    "saturated climbs": "climbs of strides of saturated trials",
    "saturated distances": "distances of rests of saturated trials from the start",
    "saturated heights": "heights of rests of saturated trials",
}
# Shorter ways are no strides, and cameras lose a foot whose stride they see that much longer or shorter (m).
STRIDE, LOST = 0.5, 0.3
# From so far on (m) a place has a distance from the start.
AWAY = 1.0


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


def path_held(
    name: str, found: Estimate, truth: Float[np.ndarray, "N 3"], point: TrackedPoint, which: str = ""
) -> Iterator[dict]:
    """Of a PyShoe trial: errors over their sd of what each stride is long and climbs, and of where it begins.

    truth (m): at its samples. Neither turns nor shifts change these.
    """
    time, path = found.recording.time, found.trajectory
    tracked = point.path(time, path.position, path.q_nb)
    late = TrackedPoint(np.zeros(3), point.lag).path(time, path.position, path.q_nb)
    # Where the sensor was, in the frame of the estimate.
    sensor = align_yaw_translation(truth, tracked) - (tracked - late)

    def seen(at):
        return np.stack([np.interp(at + point.lag, time, x) for x in sensor.T], axis=1)

    strides = segments_table(found).dropna(subset=["length_sd", "climb_sd"])
    start, end = strides["start"].to_numpy() - found.recording.period, strides["end"].to_numpy()
    way = seen(end) - seen(start)
    errors = {
        "lengths": strides["length"].to_numpy() - np.hypot(*way[:, :2].T),
        "climbs": strides["climb"].to_numpy() - way[:, 2],
    }
    used = (strides["length"].to_numpy() > STRIDE) & (np.abs([*errors.values()]).max(axis=0) < LOST)
    scores = {what: (error / strides[f"{what[:-1]}_sd"].to_numpy())[used] for what, error in errors.items()}
    begins = found.segments.departure[found.segments.departure >= 0]
    place, there = (x - x[0] for x in (path.position[begins], seen(time[begins])))
    covariance, distance = path.covariance[begins, 3:6, 3:6], np.hypot(*place[:, :2].T)
    away = distance > AWAY
    outward = place[away, :2] / distance[away, None]
    sd = np.sqrt(np.einsum("ni,nij,nj->n", outward, covariance[away, :2, :2], outward))
    scores["distances"] = (distance - np.hypot(*there[:, :2].T))[away] / sd
    scores["heights"] = (place - there)[away, 2] / np.sqrt(covariance[away, 2, 2])
    for what, errors_over_sd in scores.items():
        for z in errors_over_sd:
            yield {"trial": name, "sensor": "path", "what": f"{which}{what}", "z": float(z)}


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
            metric = f"interval_{share * 100:.0f}_{what.replace(' ', '_')}"
            yield Row(
                metric, abs(value - share), "1", "lower", high - share, None,
                f"{value:.0%} of {rows['count'].sum()} {words} lie in their {share:.0%} intervals (goal {low:.0%} to "
                f"{high:.0%}); trials {min(by_trial):.0%} to {max(by_trial):.0%}",
            )  # fmt: skip
