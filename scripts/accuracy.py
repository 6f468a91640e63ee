"""The accuracy board: every method on real recordings, saturated by themselves or clipped in software.

    python scripts/accuracy.py ../shared/data [-o results/accuracy] [--only PART ...] [--gate]

Parts: `pyshoe` (really saturated, against Vicon, rests as given), `clipped` (PyShoe walks that do not saturate,
clipped at 350, 250 and 200 °/s), `gaitmap` (a walk against motion capture), `openshoe` and `xio` (against their own
unclipped path). But for PyShoe, rests are found in the clipped recording itself; nothing is told of its rails.
Writes board.json, env.json, trials.csv and README.md.
"""

import argparse
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pandas as pd

from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.pipeline import Estimate, estimate
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.studies.boards import Row, read_board, worse, write_board
from jaxsat.studies.metrics import (
    geometric_mean_ratio,
    load_gaitmap_truth,
    load_pyshoe_truth,
    position_rmse,
    pyshoe_error,
)

METHODS = ("standard", "direct", "map")
GATE_TOLERANCE = 0.02


def clip(recording: Recording, gyr: float = np.inf, acc: float = np.inf) -> Recording:
    """As a sensor with these rails (°/s, g) would have recorded it."""
    limit = np.repeat([np.deg2rad(gyr), acc * 9.80665], 3)
    return recording.with_signal(np.clip(recording.signal, -limit, limit))


def runs(recording: Recording, methods: tuple[str, ...] = METHODS) -> Iterator[tuple[str, Estimate]]:
    for method in methods:
        yield method, estimate(recording, load_config(None, method=method))


def pyshoe(data: Path) -> list[dict]:
    folder, rows = data / "pyshoe", []
    splits = tomllib.loads((folder / "splits.toml").read_text())
    for name in sorted(path.stem for path in folder.glob("*.mat")):
        recording = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        _, truth = load_pyshoe_truth(folder / f"{name}.mat", at=recording.time)
        kind = "saturated" if name in splits["saturated"] else "other"
        for method, found in runs(recording):
            rows.append(row("pyshoe", name, kind, method, found, found.trajectory.position, truth))
        if kind == "saturated":
            own = read(folder / f"{name}.mat")
            for method, found in runs(own, ("standard", "map")):
                rows.append(row("pyshoe", name, "own rests", method, found, found.trajectory.position, truth))
    return rows


def clipped(data: Path) -> list[dict]:
    folder, rows = data / "pyshoe", []
    for name in tomllib.loads((folder / "splits.toml").read_text())["clip"]:
        recording = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        _, truth = load_pyshoe_truth(folder / f"{name}.mat", at=recording.time)
        whole = estimate(recording, load_config(None, method="standard"))
        rows.append(row("clipped", name, "unclipped", "standard", whole, whole.trajectory.position, truth))
        for rail in (350, 250, 200):
            for method, found in runs(clip(recording, gyr=rail)):
                kind = f"{rail} °/s"
                rows.append(row("clipped", name, kind, method, found, found.trajectory.position, truth))
    return rows


def gaitmap(data: Path) -> list[dict]:
    rows = []
    for side in ("left", "right"):
        path = data / "gaitmap" / "imu_sample_not_rotated.csv"
        recording = read(path, sensor=f"{side}_sensor")
        markers = [f"{side[0].upper()}_{marker}" for marker in MARKERS]
        time, truth = load_gaitmap_truth(data / "gaitmap" / "mocap_sample.csv", markers)
        for kind, rails in (("unclipped", {}), ("300 °/s", {"gyr": 300}), ("8 g", {"acc": 8})):
            for method, found in runs(clip(recording, **rails)):
                moved = found.trajectory
                at = np.stack([np.interp(time, moved.time, axis) for axis in moved.position.T], axis=1)
                rows.append(row("gaitmap", side, kind, method, found, at, truth))
    return rows


MARKERS = ("FCC", "TOE", "FM5")


def against_itself(part: str, path: Path, rails: tuple[int, ...]) -> list[dict]:
    recording, rows = read(path), []
    truth = estimate(recording, load_config(None, method="standard")).trajectory.position
    for rail in rails:
        for method, found in runs(clip(recording, gyr=rail)):
            rows.append(
                row(part, path.stem, f"{rail} °/s", method, found, found.trajectory.position, truth, False)
            )
    return rows


def row(part, trial, kind, method, found: Estimate, position, truth, align: bool = True) -> dict:
    print(part, trial, kind, method, f"{position_rmse(position, truth, align=align):.3f}", flush=True)
    return {
        "part": part,
        "trial": trial,
        "kind": kind,
        "method": method,
        "rmse_3d": position_rmse(position, truth, align=align),
        "rmse_2d": position_rmse(position, truth, axes=2, align=align),
        "rmse_z": rms_height(position, truth),
        "pyshoe_3d": pyshoe_error(position, truth, align=align),
        "saturated": int(found.saturated.sum()),
        "gaps": len(found.gaps),
        "not_converged": int((found.fills.status == 1).sum()),
        "same_as_standard": bool((found.trajectory.position == found.standard_position).all()),
    }


def rms_height(position, truth) -> float:
    away = position[:, 2] - truth[:, 2]
    return float(np.sqrt(np.mean((away - away.mean()) ** 2)))


def board(table: pd.DataFrame) -> Iterator[Row]:
    def of(part, kind, method, column, trial=None) -> np.ndarray:
        at = (table["part"] == part) & (table["kind"] == kind) & (table["method"] == method)
        if trial is not None:
            at &= table["trial"] == trial
        return table.loc[at].set_index("trial")[column].sort_index().to_numpy()

    def lower(metric, value, unit, goal, note) -> Row:
        return Row(metric, float(value), unit, "lower", goal if metric.endswith("_map") else None, None, note)

    parts = set(table["part"])
    if "pyshoe" in parts:
        saturated = "12 saturated trials"
        for method in METHODS[1:]:
            kinds = (("saturated", ""), ("own rests", "own_rests_"))
            for kind, name in kinds if method == "map" else kinds[:1]:
                for column, axes in (("rmse_3d", "3d"), ("rmse_2d", "2d")):
                    mine, theirs = (of("pyshoe", kind, m, column) for m in (method, "standard"))
                    ratio, what = geometric_mean_ratio(mine, theirs), f"{saturated}, {kind}"
                    metric = f"pyshoe_ratio_{axes}_{name}{method}"
                    yield lower(metric, ratio, "1", 0.70, f"{what}: geometric mean of the ratio to standard")
                    metric = f"pyshoe_worst_{axes}_{name}{method}"
                    yield lower(metric, (mine / theirs).max(), "1", 1.02, f"{what}: worst of these ratios")
        for method in METHODS:
            mean = of("pyshoe", "saturated", method, "rmse_3d").mean()
            yield lower(f"pyshoe_mean_3d_{method}", mean, "m", None, f"{saturated}: mean RMSE")
        every = np.concatenate([of("pyshoe", k, "standard", "pyshoe_3d") for k in ("saturated", "other")])
        note = "all 26 trials, PyShoe's metric; the best of its five published results per trial: 0.054"
        yield Row("pyshoe_metric_standard", float(every.mean()), "m", "lower", 0.050, None, note)
    if "clipped" in parts:
        whole = of("clipped", "unclipped", "standard", "rmse_3d").mean()
        for rail, goal in ((350, 0.98), (250, 0.95), (200, 0.90)):
            lost = of("clipped", f"{rail} °/s", "standard", "rmse_3d").mean()
            note = (
                f"share of what clipping loses that comes back; unclipped {whole:.3f} m, ignored {lost:.3f} m"
            )
            for method in METHODS[1:]:
                share = 1 - (of("clipped", f"{rail} °/s", method, "rmse_3d").mean() - whole) / (lost - whole)
                goal_here = goal if method == "map" else None
                yield Row(f"recovered_{rail}_{method}", float(share), "1", "higher", goal_here, None, note)
    for kind, column, name, goals in (
        ("300 °/s", "rmse_2d", "300dps_xy", {"left": 0.16, "right": 0.16}),
        ("8 g", "rmse_z", "8g_z", {"left": 0.31, "right": 0.22}),
    ):
        for side, goal in goals.items() if "gaitmap" in parts else ():
            without = of("gaitmap", "unclipped", "standard", column, side)[0]
            for method in METHODS:
                value = of("gaitmap", kind, method, column, side)[0]
                note = f"RMS to motion capture; unclipped {without:.3f} m"
                yield lower(f"gaitmap_{side}_{name}_{method}", value, "m", goal, note)
    for part, goals in (("openshoe", {350: 0.10, 300: 0.20}), ("xio", {500: 0.05, 400: 0.15})):
        for rail, goal in goals.items() if part in parts else ():
            for method in METHODS:
                value = of(part, f"{rail} °/s", method, "rmse_3d")[0]
                yield lower(f"{part}_{rail}_{method}", value, "m", goal, "RMS to its own unclipped path")


PARTS = {
    "pyshoe": pyshoe,
    "clipped": clipped,
    "gaitmap": gaitmap,
    "openshoe": lambda data: against_itself(
        "openshoe", data / "openshoe" / "Measurement_100521_44.npz", (350, 300)
    ),
    "xio": lambda data: against_itself("xio", data / "xio" / "short_walk.csv", (500, 400)),
}


def main() -> int:
    parser = argparse.ArgumentParser(description="The accuracy board")
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/accuracy"))
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--gate", action="store_true", help="exit with 1 where something got worse")
    arguments = parser.parse_args()
    path = arguments.output / "board.json"
    former = read_board(path) if path.exists() else []
    table = pd.DataFrame([row for part in arguments.only for row in PARTS[part](arguments.data)])
    rows = {r.metric: r for r in former} | {r.metric: r for r in board(table)}
    found = worse(rows.values(), former, GATE_TOLERANCE) if arguments.gate else []
    for sentence in found:
        print(sentence, file=sys.stderr)
    if not found:
        arguments.output.mkdir(parents=True, exist_ok=True)
        trials = arguments.output / "trials.csv"
        if trials.exists():
            before = pd.read_csv(trials)
            table = pd.concat([before[~before["part"].isin(arguments.only)], table])
        table.round(6).to_csv(trials, index=False)
        write_board(path, rows.values(), load_config(None, method="map").model_dump())
    return 1 if found else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except InputError as error:
        sys.exit(str(error))
