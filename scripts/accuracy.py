"""The accuracy board: every method on real recordings, saturated by themselves or clipped in software.

    python scripts/accuracy.py ../shared/data [-o results/accuracy] [--only PART ...] [--methods NAME ...] [--gate]

Parts: `pyshoe` (really saturated, against Vicon, rests as given), `clipped` (PyShoe walks that do not saturate,
clipped at 350, 250 and 200 °/s), `gaitmap` (a walk against motion capture), `openshoe` and `xio` (against their own
unclipped path), `intervals` (how often those of `map` hold what was clipped off).
But for PyShoe, rests are found in the clipped recording itself; nothing is told of its rails.
Peers: fills (`peers/fills.py`) see the same saturated samples and rests; gaitmap's RtsKalman, on the recording as
measured and filled by the spline, takes part in `gaitmap` where it is installed. Writes board.json, env.json,
trials.csv, intervals.csv and figures; what was not run again keeps its rows.
"""

import argparse
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import accuracy_intervals
import accuracy_scores
import numpy as np
import pandas as pd
from accuracy_figures import draw_ratios, draw_trial
from accuracy_tracked import point_of, pyshoe_point
from jaxtyping import Float
from paper.drawing import STYLES
from peers import MissingPeer, import_peer
from peers.fills import FILLS, filled
from peers.gaitmap_rts import rts_kalman

from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.pipeline import Estimate, estimate
from jaxsat.preparation import prepare
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.studies.boards import read_board, worse, write_board
from jaxsat.studies.metrics import (
    load_gaitmap_truth,
    load_pyshoe_truth,
    position_rmse,
    pyshoe_error,
)
from jaxsat.studies.tracked_point import TrackedPoint

METHODS = {
    "standard": {"method": "standard"},
    "direct": {"method": "direct"},
    "map": {"method": "map"},
    "free": {"method": "standard", "height.mode": "off"},
}
"""Settings of each; `free` is `standard` that does not ask whether the ground is level."""
RTS = {"rts": None, "rts_spline": "spline"}
"""gaitmap's RtsKalman, and what fills its recording."""
EVERY = (*METHODS, *FILLS, *RTS)
# What was filled is not looked at again.
IGNORANT = {"method": "standard", "rails.gyr": "none", "rails.acc": "none"}
KEY = ["part", "trial", "kind", "method"]
GATE_TOLERANCE = 0.02


def clip(recording: Recording, gyr: float = np.inf, acc: float = np.inf) -> Recording:
    """As a sensor with these rails (°/s, g) would have recorded it."""
    limit = np.repeat([np.deg2rad(gyr), acc * 9.80665], 3)
    return recording.with_signal(np.clip(recording.signal, -limit, limit))


class Found(NamedTuple):
    """What a row of the table says of an estimate, ours or a peer's."""

    method: str
    time: Float[np.ndarray, "N"]
    position: Float[np.ndarray, "N 3"]
    q_nb: Float[np.ndarray, "N 4"] | None
    saturated: int
    gaps: int
    not_converged: int = 0
    same_as_standard: bool = True


class Truth(NamedTuple):
    """What an estimate is scored against."""

    time: Float[np.ndarray, "M"]
    position: Float[np.ndarray, "M 3"]
    point: TrackedPoint | None = None
    """Where on the sensor it was measured; None where that is the sensor itself."""


def run(recording: Recording, method: str) -> Found:
    if method not in METHODS:
        prepared = prepare(recording, load_config(None))
        lost, gaps = int((prepared.sign != 0).sum()), len(prepared.gaps)
        fill = RTS.get(method, method)
        mended = recording if fill is None else filled(recording, prepared, fill)
        if method in RTS:
            position, q_nb, same = rts_kalman(mended, prepared), None, False
        else:
            made = estimate(mended, load_config(None, **IGNORANT)).trajectory
            position, q_nb = made.position, made.q_nb
            same = bool((mended.signal == recording.signal).all())
        return Found(method, recording.time, position, q_nb, lost, gaps, same_as_standard=same)
    found = estimate(recording, load_config(None, **METHODS[method]))
    return Found(
        method,
        recording.time,
        found.trajectory.position,
        found.trajectory.q_nb,
        int(found.saturated.sum()),
        len(found.gaps),
        int((found.fills.status == 1).sum()),
        bool((found.trajectory.position == found.standard_position).all()),
    )


def runs(recording: Recording, methods: tuple[str, ...]) -> Iterator[Found]:
    for method in methods:
        yield run(recording, method)


def pyshoe(data: Path, methods: tuple[str, ...]) -> list[dict]:
    folder, rows = data / "pyshoe", []
    splits = tomllib.loads((folder / "splits.toml").read_text())
    for name in sorted(path.stem for path in folder.glob("*.mat")):
        recording = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        truth = Truth(
            *load_pyshoe_truth(folder / f"{name}.mat", at=recording.time), pyshoe_point(folder, name)
        )
        kind = "saturated" if name in splits["saturated"] else "other"
        # Without saturation a fill is the standard smoother.
        here = methods if kind == "saturated" else tuple(m for m in methods if m in METHODS)
        rows += [row("pyshoe", name, kind, found, truth) for found in runs(recording, here)]
        if kind == "saturated":
            own = read(folder / f"{name}.mat")
            here = tuple(m for m in methods if m in ("standard", "map"))
            rows += [row("pyshoe", name, "own rests", found, truth) for found in runs(own, here)]
    return rows


def clipped(data: Path, methods: tuple[str, ...]) -> list[dict]:
    folder, rows = data / "pyshoe", []
    for name in tomllib.loads((folder / "splits.toml").read_text())["clip"]:
        recording = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        truth = Truth(
            *load_pyshoe_truth(folder / f"{name}.mat", at=recording.time), pyshoe_point(folder, name)
        )
        if "standard" in methods:
            rows.append(row("clipped", name, "unclipped", run(recording, "standard"), truth))
        for rail in (350, 250, 200):
            found = runs(clip(recording, gyr=rail), methods)
            rows += [row("clipped", name, f"{rail} °/s", each, truth) for each in found]
    return rows


def gaitmap(data: Path, methods: tuple[str, ...]) -> list[dict]:
    rows = []
    for side in ("left", "right"):
        path = data / "gaitmap" / "imu_sample_not_rotated.csv"
        recording = read(path, sensor=f"{side}_sensor")
        markers = [f"{side[0].upper()}_{marker}" for marker in MARKERS]
        track = load_gaitmap_truth(data / "gaitmap" / "mocap_sample.csv", markers)
        truth = Truth(*track, point_of(recording, *track))
        for kind, rails in (("unclipped", {}), ("300 °/s", {"gyr": 300}), ("8 g", {"acc": 8})):
            found = runs(clip(recording, **rails), methods)
            rows += [row("gaitmap", side, kind, each, truth) for each in found]
    return rows


MARKERS = ("FCC", "TOE", "FM5")


def against_itself(part: str, path: Path, rails: tuple[int, ...], methods: tuple[str, ...]) -> list[dict]:
    recording, rows = read(path), []
    truth = Truth(recording.time, run(recording, "standard").position)
    for rail in rails:
        found = runs(clip(recording, gyr=rail), methods)
        rows += [row(part, path.stem, f"{rail} °/s", each, truth, align=False) for each in found]
    return rows


def row(part: str, trial: str, kind: str, found: Found, truth: Truth, align: bool = True) -> dict:
    time, there, point = truth

    def at_truth(path: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "M 3"]:
        return np.stack([np.interp(time, found.time, axis) for axis in path.T], axis=1)

    position = at_truth(found.position)
    scores = {
        "rmse_3d": position_rmse(position, there, align=align),
        "rmse_2d": position_rmse(position, there, axes=2, align=align),
        "rmse_z": rms_height(position, there),
        "pyshoe_3d": pyshoe_error(position, there, align=align),
    }
    if point is not None and found.q_nb is not None:
        tracked = at_truth(point.path(found.time, found.position, found.q_nb))
        scores["tracked_3d"] = position_rmse(tracked, there)
        scores["tracked_2d"] = position_rmse(tracked, there, axes=2)
    print(part, trial, kind, found.method, f"{scores['rmse_3d']:.3f}", flush=True)
    return {
        **dict(zip(KEY, (part, trial, kind, found.method), strict=True)),
        **scores,
        "saturated": found.saturated,
        "gaps": found.gaps,
        "not_converged": found.not_converged,
        "same_as_standard": found.same_as_standard,
        "path": (time, position, there),
    }


def rms_height(position, truth) -> float:
    away = position[:, 2] - truth[:, 2]
    return float(np.sqrt(np.mean((away - away.mean()) ** 2)))


PARTS = {
    "pyshoe": pyshoe,
    "clipped": clipped,
    "gaitmap": gaitmap,
    "openshoe": lambda data, methods: against_itself(
        "openshoe", data / "openshoe" / "Measurement_100521_44.npz", (350, 300), methods
    ),
    "xio": lambda data, methods: against_itself("xio", data / "xio" / "short_walk.csv", (500, 400), methods),
}


def intervals(data: Path) -> pd.DataFrame:
    """Of `map`: on walks clipped in software, where what each should have held is known, and paths by Vicon."""
    folder, scores = data / "pyshoe", []
    splits = tomllib.loads((folder / "splits.toml").read_text())
    walks = {name: (read(folder / f"{name}.mat", rest_column="zv_shoe_opt"), 250) for name in splits["clip"]}
    others = {}
    for side in ("left", "right"):
        walk = read(data / "gaitmap" / "imu_sample_not_rotated.csv", sensor=f"{side}_sensor")
        others[f"gaitmap {side}"] = walk, 300
    others["xio"] = read(data / "xio" / "short_walk.csv"), 400
    others["openshoe 44"] = read(data / "openshoe" / "Measurement_100521_44.npz"), 350
    for name, (recording, rail) in (walks | others).items():
        found = estimate(clip(recording, gyr=rail), load_config(None, method="map"))
        scores += accuracy_intervals.held(f"{name}, {rail} °/s", recording, found)
        if name in walks:
            scores += by_vicon(folder, name, f"{name}, {rail} °/s", found)
        print("intervals", name, flush=True)
    for name in splits["saturated"]:
        recording = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        scores += by_vicon(
            folder, name, name, estimate(recording, load_config(None, method="map")), "saturated "
        )
    return accuracy_intervals.summary(pd.DataFrame(scores))


def by_vicon(folder: Path, name: str, label: str, found: Estimate, which: str = "") -> Iterator[dict]:
    _, truth = load_pyshoe_truth(folder / f"{name}.mat", at=found.recording.time)
    return accuracy_intervals.path_held(label, found, truth, pyshoe_point(folder, name), which)


def merged(before: pd.DataFrame, table: pd.DataFrame, parts: list[str], methods: list[str]) -> pd.DataFrame:
    """Former rows but those that were run again, or are of methods that are no longer run; then the new ones."""
    again = before["method"].isin(methods) | ~before["method"].isin(EVERY)
    rows = before.loc[~(before["part"].isin(parts) & again)].to_dict("records") + table.to_dict("records")
    # A trial's methods stand together.
    trials = list(dict.fromkeys(tuple(row[c] for c in KEY[:3]) for row in rows))
    places = {method: k for k, method in enumerate(EVERY)}

    def place(row: dict) -> tuple[int, int]:
        return trials.index(tuple(row[c] for c in KEY[:3])), places.get(row["method"], len(EVERY))

    return pd.DataFrame(sorted(rows, key=place))


def draw(folder: Path, table: pd.DataFrame, paths: dict[tuple[str, str, str], tuple]) -> None:
    """The ratios of the saturated PyShoe trials, and the best, median and worst of `map` if they were run."""
    saturated = table[(table["part"] == "pyshoe") & (table["kind"] == "saturated")]
    errors = saturated.pivot(index="trial", columns="method", values="rmse_3d")
    if "map" not in errors:
        return
    shown = [method for method in EVERY[1:] if method in errors and method in STYLES]
    ratios = pd.DataFrame({method: errors[method] / errors["standard"] for method in shown}).sort_values(
        "map"
    )
    draw_ratios(folder / "ratios", ratios)
    for name, place in (("best", 0), ("median", len(ratios) // 2), ("worst", -1)):
        trial = str(ratios.index[place])
        drawn = {
            m: paths[trial, "saturated", m] for m in ("standard", "map") if (trial, "saturated", m) in paths
        }
        if len(drawn) == 2:
            time, _, truth = drawn["map"]
            tracks = {method: position for method, (_, position, _) in drawn.items()}
            title = f"PyShoe {trial}: {ratios.loc[trial, 'map']:.2f} of the error of standard"
            draw_trial(folder / name, time, truth, tracks, title)


def installed() -> list[str]:
    """Every method, but for those of a package that is not there."""
    try:
        import_peer("gaitmap")
    except MissingPeer as missing:
        print(missing, "Its rows stay as they are.", file=sys.stderr)
        return [method for method in EVERY if method not in RTS]
    return list(EVERY)


def main() -> int:
    parser = argparse.ArgumentParser(description="The accuracy board")
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/accuracy"))
    parser.add_argument("--only", nargs="+", choices=[*PARTS, "intervals"], default=[*PARTS, "intervals"])
    parser.add_argument("--methods", nargs="+", choices=EVERY, help="default: every one that is installed")
    parser.add_argument("--gate", action="store_true", help="exit with 1 where something got worse")
    arguments = parser.parse_args()
    path, trials = arguments.output / "board.json", arguments.output / "trials.csv"
    former = read_board(path) if path.exists() else []
    methods = arguments.methods or installed()
    found, parts = [], [part for part in arguments.only if part in PARTS]
    for part in parts:
        here = tuple(m for m in methods if part == "gaitmap" or m not in RTS)
        found += PARTS[part](arguments.data, here)
    paths = {tuple(row[c] for c in KEY[1:]): row.pop("path") for row in found}
    table = pd.DataFrame(found).round(6)
    if trials.exists():
        table = merged(pd.read_csv(trials), table, parts, methods) if parts else pd.read_csv(trials)
    for part in parts:
        if "standard" not in set(table.loc[table["part"] == part, "method"]):
            raise InputError(f"{part}: there is no row of standard to compare with; add it to --methods.")
    rows = {r.metric: r for r in former} | {r.metric: r for r in accuracy_scores.board(table, parts, EVERY)}
    held = intervals(arguments.data) if "intervals" in arguments.only else None
    if held is not None:
        rows |= {r.metric: r for r in accuracy_intervals.board(held)}
    sentences = worse(rows.values(), former, GATE_TOLERANCE) if arguments.gate else []
    for sentence in sentences:
        print(sentence, file=sys.stderr)
    if not sentences:
        arguments.output.mkdir(parents=True, exist_ok=True)
        table.to_csv(trials, index=False)
        if held is not None:
            held.to_csv(arguments.output / "intervals.csv", index=False, float_format="%.4g")
        write_board(path, rows.values(), load_config(None, method="map").model_dump())
        if "pyshoe" in arguments.only:
            draw(arguments.output, table, paths)
    return 1 if sentences else 0


if __name__ == "__main__":
    try:
        sys.exit(main())
    except (InputError, MissingPeer) as error:
        sys.exit(str(error))
