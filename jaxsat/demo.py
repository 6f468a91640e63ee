"""The demonstration: a real walk, clipped as a cheaper sensor would have, reconstructed and scored."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxsat.config import Config
from jaxsat.pipeline import Estimate, Progress, estimate
from jaxsat.present.folder import check_folder, write_results
from jaxsat.present.summary import warnings_of
from jaxsat.present.text import columns
from jaxsat.signals.readers import read
from jaxsat.signals.recording import CHANNELS, Recording
from jaxsat.studies.metrics import align_yaw_translation, position_rmse

SAMPLE = Path(__file__).parent / "sample"
RAIL_DPS = 300.0


def load_walk() -> tuple[Recording, Float[np.ndarray, "M"], Float[np.ndarray, "M 3"]]:
    """The bundled walk, and its motion capture: times (s) and positions (m)."""
    truth = pd.read_parquet(SAMPLE / "walk_truth.parquet")
    return (
        read(SAMPLE / "walk.parquet"),
        truth["time"].to_numpy(),
        truth[["pos_x", "pos_y", "pos_z"]].to_numpy(np.float64),
    )


def clip_gyroscope(recording: Recording, rail: float) -> Recording:
    """The recording as a gyroscope with that rail (rad/s) would have made it."""
    gyr = np.clip(recording.gyr, -rail, rail)
    clipped = recording.with_signal(np.concatenate([gyr, recording.acc], axis=1))
    return replace(clipped, name=f"{recording.name}, clipped at ±{np.rad2deg(rail):.0f} °/s")


def run_demo(folder: Path, progress: Progress | None = None) -> str:
    """Estimate the walk clipped and unclipped, write the clipped recording and the results; returns the story.

    Rests and rails are found in the clipped recording itself.
    """
    results = Path(folder) / "map"
    check_folder(results)
    walk, time, truth = load_walk()
    clipped = clip_gyroscope(walk, np.deg2rad(RAIL_DPS))
    unclipped = estimate(walk, Config(method="standard"), progress=progress)
    before = estimate(clipped, Config(method="standard"), progress=progress)
    after = estimate(clipped, Config(method="map"), progress=progress)

    scores = pd.DataFrame(
        {
            "horizontal RMS (m)": [_rms(e, time, truth, 2) for e in (before, after, unclipped)],
            "3D RMS (m)": [_rms(e, time, truth, 3) for e in (before, after, unclipped)],
        },
        index=pd.Index(
            ["before: standard smoother", "after: map", "never clipped"],
            name="error against motion capture",
        ),
    )
    at_truth = _at(after, time)
    beside = {
        "motion capture": (time, align_yaw_translation(truth, at_truth)),
        "standard": (before.trajectory.time, before.trajectory.position),
    }
    report = write_results(after, results, beside=beside, scores=scores)
    recording = Path(folder) / "walk_300dps.parquet"
    table = pd.DataFrame(clipped.signal, columns=list(CHANNELS))
    table.insert(0, "time", clipped.time)
    table.to_parquet(recording, index=False)
    return _story(after, scores, recording, report)


def _story(after: Estimate, scores: pd.DataFrame, recording: Path, report: Path) -> str:
    share = after.saturated.any(axis=1).mean()
    rows = [[scores.index.name, *scores.columns]]
    rows += [[name, *(f"{value:.3f}" for value in values)] for name, *values in scores.itertuples()]
    return "\n".join(
        [
            f"A 2 × 20 m walk, {after.recording.time[-1]:.1f} s of the left foot, as a ±300 °/s gyroscope would have",
            f"recorded it: {int(after.saturated.sum())} values in {len(after.gaps)} gaps saturated, "
            f"{share:.1%} of the samples.",
            "",
            columns(rows),
            "",
            *(f"please note: {warning}" for warning in warnings_of(after)),
            f"clipped recording: {recording}",
            f"report: {report}",
        ]
    )


def _at(found: Estimate, time: Float[np.ndarray, "M"]) -> Float[np.ndarray, "M 3"]:
    """Positions at other times, held at the ends."""
    trajectory = found.trajectory
    return np.stack([np.interp(time, trajectory.time, axis) for axis in trajectory.position.T], axis=1)


def _rms(found: Estimate, time: np.ndarray, truth: np.ndarray, axes) -> float:
    return position_rmse(_at(found, time), truth, axes=axes)
