"""Where motion capture looks on the sensors of the accuracy board: found on what does not saturate, by `standard`."""

import tomllib
from functools import cache
from pathlib import Path

import numpy as np
from jaxtyping import Float

from jaxsat.config import load_config
from jaxsat.pipeline import estimate
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.studies.metrics import load_pyshoe_truth
from jaxsat.studies.tracked_point import TrackedPoint, find_tracked_point


def point_of(
    recording: Recording, time: Float[np.ndarray, "M"], truth: Float[np.ndarray, "M 3"]
) -> TrackedPoint:
    """By a recording that does not saturate; it may go on before and after its truth (s, m)."""
    found = estimate(recording, load_config(None, method="standard")).trajectory
    covered = (recording.time >= time[0]) & (recording.time <= time[-1])
    at = recording.time[covered]
    there = np.stack([np.interp(at, time, axis) for axis in truth.T], axis=1)
    return find_tracked_point(at, found.position[covered], found.q_nb[covered], there)


@cache
def pyshoe_point(folder: Path, name: str) -> TrackedPoint:
    """Of a trial by itself; of one that saturates by the list `clip`, mounted alike but for December's trials."""
    splits = tomllib.loads((folder / "splits.toml").read_text())
    if name in splits["saturated"]:
        points = [pyshoe_point(folder, other) for other in splits["clip"]]
        lever = np.median([point.lever for point in points], axis=0)
        return TrackedPoint(lever, float(np.median([point.lag for point in points])))
    path = folder / f"{name}.mat"
    return point_of(read(path, rest_column="zv_shoe_opt"), *load_pyshoe_truth(path))
