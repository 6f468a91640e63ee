"""Figure 16 and Section 5: walks with many rests, simulated, really saturated, and clipped in software."""

import tomllib
from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxsat.config import Config
from jaxsat.demo import clip_gyroscope, load_walk
from jaxsat.pipeline import Estimate
from jaxsat.signals.readers import read
from jaxsat.studies.metrics import (
    align_yaw_translation,
    last_position_error,
    load_pyshoe_truth,
    position_rmse,
)

from . import drawing
from .simulations import COLUMNS, beside_unclipped, values_of
from .trials import Settings, clipped, config_of, elements_of, estimates, score, summary

SHOWN = ("standard", "direct", "map")


def simulated(chosen: Settings, out: Path) -> None:
    """A simulated walk: every method over the seeds."""
    trials = elements_of(chosen)
    bound = config_of(chosen).saturation.gyr_bound
    rails = {"gyr": [chosen["rails"]["gyr"]]}
    values = np.concatenate([values_of(chosen, each, [bound]) for each in (rails, {})])
    rows = summary(beside_unclipped(score(trials, values, chosen["chunk"])), [], COLUMNS)
    rows.to_csv(out / "table.csv", index=False, float_format="%.6g")
    drawing.errors(out / "errors", rows, "last", chosen["paper"]["last"], "last-position error", "m")
    recording, truth, config = clipped(chosen, 0)
    found = estimates(recording, config, SHOWN)
    tracks = {"truth": truth.position, **{m: e.trajectory.position for m, e in found.items()}}
    drawing.travel(out / "path", truth.time, tracks)


def saturated(chosen: Settings, out: Path, data: Path) -> None:
    """Foot recordings that really saturated, against Vicon; rests and rails are found in them."""
    folder, rows = data / "pyshoe", []
    names = tomllib.loads((folder / "splits.toml").read_text())["saturated"][: chosen["trials"]]
    for name in names:
        recording = read(folder / f"{name}.mat")
        _, truth = load_pyshoe_truth(folder / f"{name}.mat", at=recording.time)
        found = estimates(recording, Config(**chosen["config"]), ("standard", *chosen["methods"]))
        positions = {m: e.trajectory.position for m, e in found.items()}
        rows += _scored(name, found, positions, truth)
        if name == chosen["drawn"]:
            _draw(out, positions, truth, f"PyShoe {name}, turned and shifted onto the truth")
    _against_standard(pd.DataFrame(rows)).to_csv(out / "table.csv", index=False, float_format="%.6g")


def software(chosen: Settings, out: Path) -> None:
    """The bundled walk against motion capture, clipped in software."""
    walk, time, truth = load_walk()
    rows, positions = [], {}
    for rail in chosen["rails_dps"]:
        recording = clip_gyroscope(walk, np.deg2rad(rail))
        found = estimates(recording, Config(**chosen["config"]), ("standard", *chosen["methods"]))
        positions = {m: _at(e, time) for m, e in found.items()}
        rows += _scored(f"{rail:g} °/s", found, positions, truth)
        if rail == chosen["drawn"]:
            _draw(out, positions, truth, f"clipped at ±{rail:g} °/s; turned and shifted onto motion capture")
    _against_standard(pd.DataFrame(rows)).to_csv(out / "table.csv", index=False, float_format="%.6g")


def _at(found: Estimate, time: Float[np.ndarray, "M"]) -> Float[np.ndarray, "M 3"]:
    moved = found.trajectory
    return np.stack([np.interp(time, moved.time, axis) for axis in moved.position.T], axis=1)


def _scored(name: str, found: dict[str, Estimate], positions: drawing.Tracks, truth) -> list[dict]:
    return [
        {
            "trial": name,
            "method": method,
            "saturated": int(found[method].saturated.sum()),
            "last": last_position_error(position, truth, align=True),
            "rmse": position_rmse(position, truth),
            "length": float(np.linalg.norm(np.diff(truth[:, :2], axis=0), axis=1).sum()),
        }
        for method, position in positions.items()
    ]


def _against_standard(table: pd.DataFrame) -> pd.DataFrame:
    standard = table[table["method"] == "standard"].set_index("trial")
    for column in ("last", "rmse"):
        table[f"{column}_ratio"] = table[column] / standard.loc[table["trial"], column].to_numpy()
    return table


def _draw(out: Path, positions: drawing.Tracks, truth: Float[np.ndarray, "N 3"], title: str) -> None:
    shown = {m: align_yaw_translation(positions[m], truth) for m in SHOWN if m in positions}
    drawing.plan(out / "path", {"truth": truth, **shown}, title, size=(6.0, 5.5))


def orders(chosen: Settings, out: Path) -> None:
    """Section 5: segments one after the other, as the paper has them, and in parallel, twice."""
    rows = []
    for order in ("sequential", "parallel"):
        for method in chosen["methods"]:
            # The first is for compiling.
            for seed in (0, *range(chosen["seeds"])):
                recording, truth, config = clipped(chosen, seed)
                segments = config.saturation.model_copy(update={"segments": order})
                config = config.model_copy(update={"saturation": segments})
                found = estimates(recording, config, (method,))[method]
                rows.append(
                    {
                        "order": order,
                        "method": method,
                        "seed": seed,
                        "last": last_position_error(found.trajectory.position, truth.position),
                        "rmse": position_rmse(found.trajectory.position, truth.position, align=False),
                        "cost": float(found.cost),
                        "segment_costs": float(found.fills.cost_after.sum()),
                        "seconds": found.seconds["compensation"],
                        "saturated": int(found.saturated.sum()),
                    }
                )
            rows.pop(-1 - chosen["seeds"])
    table = pd.DataFrame(rows)
    found = summary(table, ["order"], ["last", "rmse", "cost", "segment_costs", "seconds"])
    found.to_csv(out / "table.csv", index=False, float_format="%.6g")
    drawing.orders(out / "errors", table)
