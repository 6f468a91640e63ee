"""Tables 1 to 3 and Figures 6 to 15: one motion between two rests, simulated."""

from pathlib import Path

import numpy as np
import pandas as pd

from jaxsat.signals.recording import CHANNELS

from . import drawing
from .trials import METHODS, Settings, clipped, config_of, elements_of, estimates, score, summary

MEASURED = ("last", "norm", "path_rmse", "distance", "last_ratio", "norm_ratio", "distance_ratio")
COLUMNS = [*MEASURED, "fill_rmse_gyr", "fill_rmse_acc", "iterations", "at_bound"]


def values_of(chosen: Settings, rails: dict[str, list[float]], bound: list[float]) -> np.ndarray:
    """Rows of rails and bounds: one list varies, the others hold one value."""
    whole = config_of(chosen).saturation
    gyr, acc = (rails.get(sensor, [np.inf]) for sensor in ("gyr", "acc"))
    rows = np.broadcast_arrays(np.array(gyr), np.array(acc), np.array(bound), np.array([whole.acc_bound]))
    return np.stack(rows, axis=1).astype(float)


def table(chosen: Settings, out: Path) -> None:
    """A table of the paper: every method over the seeds, and the figures of one of them."""
    trials = elements_of(chosen)
    bound = config_of(chosen).saturation.gyr_bound
    rails = {sensor: [rail] for sensor, rail in chosen["rails"].items()}
    values = np.concatenate([values_of(chosen, each, [bound]) for each in (rails, {})])
    rows = summary(beside_unclipped(score(trials, values, chosen["chunk"])), [], COLUMNS)
    rows.to_csv(out / "table.csv", index=False, float_format="%.6g")
    if chosen["motion"]["kind"] == "planar":
        column, what, unit = "distance", "error of the start-stop distance", "mm"
    else:
        column, what, unit = "last", "last-position error", "m"
    drawing.errors(out / "errors", rows, column, chosen["paper"][column], what, unit)
    figures(chosen, out)


def beside_unclipped(found: pd.DataFrame) -> pd.DataFrame:
    """The clipped elements, and the standard smoother on what was never clipped as one more method."""
    whole = np.isinf(found["gyr_rail"]) & np.isinf(found["acc_rail"])
    clipped = found.loc[~whole]
    unclipped = (
        found.loc[whole & (found["method"] == "standard")].assign(method="unclipped").set_index("seed")
    )
    standard = clipped.loc[clipped["method"] == "standard"].set_index("seed")
    for column in ("last", "norm", "distance"):
        unclipped[f"{column}_ratio"] = unclipped[column] / standard[column]
    return pd.concat([clipped, unclipped.reset_index()], ignore_index=True)


def figures(chosen: Settings, out: Path) -> None:
    recording, truth, config = clipped(chosen, 0)
    found = estimates(recording, config, ("standard", *METHODS))
    tracks = {"truth": truth.position, **{m: e.trajectory.position for m, e in found.items()}}
    kind = chosen["motion"]["kind"]
    if kind == "bar":
        drawing.swing(out / "path", truth.time, tracks)
    elif kind == "line":
        drawing.travel(out / "path", truth.time, tracks)
    else:
        drawing.plan(out / "path", tracks)
    channel = CHANNELS.index(chosen["channel"])
    (sensor, rail), *_ = chosen["rails"].items()
    unit = "rad/s" if sensor == "gyr" else "m/s²"
    lost = np.flatnonzero(truth.saturated[:, channel])
    way = np.sign(truth.noisy[lost[0], channel])
    around = float(truth.time[lost[0]]) - 0.12, float(truth.time[lost[-1]]) + 0.12
    drawing.filled(
        out / "filled",
        truth.time,
        truth.noisy[:, channel],
        recording.signal[:, channel],
        {m: e.filled[:, channel] for m, e in found.items()},
        f"{chosen['channel']} ({unit})",
        way * rail,
        around,
    )


def span(chosen: Settings) -> list[float]:
    low, high, count = chosen["sweep"]
    return np.linspace(low, high, count).tolist()


def rail_sweep(chosen: Settings, out: Path) -> None:
    """Figures 9 and 10: the error against the rail."""
    bound = config_of(chosen).saturation.gyr_bound
    rows = _swept(chosen, values_of(chosen, {"gyr": span(chosen)}, [bound]), "gyr_rail", out)
    peak = chosen["peak"]
    marks = {"true peak": peak}
    if peak - bound > chosen["sweep"][0]:
        marks["true peak − δ_b"] = peak - bound
    drawing.bands(
        out / "errors",
        rows,
        "gyr_rail",
        "last",
        ("standard", *chosen["shown"]),
        "gyroscope rail (rad/s)",
        "last-position error (m)",
        marks,
    )


def bound_sweep(chosen: Settings, out: Path) -> None:
    """Figure 11: the error against δ_b."""
    rail = chosen["rails"]["gyr"]
    rows = _swept(chosen, values_of(chosen, {"gyr": [rail]}, span(chosen)), "gyr_bound", out)
    drawing.bands(
        out / "errors",
        rows,
        "gyr_bound",
        "last",
        ("standard", *chosen["shown"]),
        "δ_b (rad/s)",
        "last-position error (m)",
        {"what the peak needs": chosen["peak"] - rail},
    )


def _swept(chosen: Settings, values: np.ndarray, by: str, out: Path) -> pd.DataFrame:
    trials = elements_of(chosen)
    rows = summary(score(trials, values, chosen["chunk"]), [by], [*MEASURED, "fill_rmse_gyr", "at_bound"])
    rows.to_csv(out / "table.csv", index=False, float_format="%.6g")
    return rows
