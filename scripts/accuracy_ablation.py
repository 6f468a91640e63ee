"""What holds the errors that are left: one thing at a time replaced by what is true, or left out.

    python scripts/accuracy_ablation.py ../shared/data [-o results/accuracy] [--only clipped saturated]

`clipped`: recordings clipped in software, of which the lost signal is known. The fills of `map` are replaced in part
by the truth, or another path's constants and rests are taken, and the path is made anew from that signal by the
standard smoother; its error is against the unclipped recording's own path. What makes it fall is what holds it.
`saturated`: the saturated PyShoe trials, against Vicon, by both methods, settings changed; for the sensor's path and
for that of the point that Vicon tracks.
Writes ablation.csv and ablation.md; what was not run again keeps its rows.
"""

import argparse
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from accuracy import IGNORANT, clip
from accuracy_tracked import pyshoe_point
from jaxtyping import Float
from orientation.board import markdown

from jaxsat.cli.shared import use_compilation_cache
from jaxsat.config import load_config
from jaxsat.inertial.rotations import quat_to_matrix
from jaxsat.pipeline import Estimate, estimate
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import find_segments
from jaxsat.studies.metrics import geometric_mean_ratio, load_pyshoe_truth, position_rmse

Signal = Float[np.ndarray, "N 6"]

CHANGED = {
    "as it is": {},
    "no bias of the accelerometer": {"smoother.acc_bias_sd": 0.0},
    "no lever": {"smoother.lever_sd": 0.0},
    "no offset of the gyroscope": {"smoother.gyr_offset": "none"},
    "a bias of the gyroscope": {"smoother.gyr_bias_sd": 1e-3},
    "no noise of changes": {"noise.change": 0.0},
    "rests of 1 cm/s": {"noise.rest_velocity_sd": 0.01},
    "rests of 4 cm/s": {"noise.rest_velocity_sd": 0.04},
    "heights free": {"height.mode": "off"},
}


def resting(recording: Recording, rest) -> Recording:
    return eqx.tree_at(lambda r: r.rest, recording, np.asarray(rest), is_leaf=lambda x: x is None)


def path(recording: Recording, signal: Signal, rest) -> Estimate:
    """By the standard smoother, which takes the signal as measured."""
    return estimate(resting(recording.with_signal(signal), rest), load_config(None, **IGNORANT))


def gaps_of(found: Estimate) -> Iterator[tuple[slice, int]]:
    gaps = found.gaps
    for channel, start, end in zip(gaps.channel, gaps.start, gaps.end, strict=True):
        yield slice(int(start), int(end)), int(channel)


def of_gaps(found: Estimate, from_gap) -> Signal:
    """The filled signal with the values of each gap replaced."""
    signal = found.filled.copy()
    for inside, channel in gaps_of(found):
        signal[inside, channel] = from_gap(inside, channel)
    return signal


def turned(found: Estimate, truth: Signal, vertical: bool) -> Signal:
    """The filled signal without what it turns too far over each motion, about the vertical or the horizontal axes."""
    attitude = np.asarray(jax.vmap(quat_to_matrix)(jnp.asarray(found.trajectory.q_nb)))
    away = np.where(found.saturated, found.filled - truth, 0.0)[:, :3]
    error = np.einsum("nij,nj->ni", attitude, away)
    wanted = np.array([not vertical, not vertical, vertical])
    signal, lost = found.filled.copy(), np.any(found.saturated[:, :3], axis=1)
    segments = find_segments(found.rest)
    for first, last in zip(np.maximum(segments.departure, 0), segments.arrival, strict=True):
        inside = np.flatnonzero(lost[first:last]) + first
        if len(inside):
            mean = np.where(wanted, error[inside].mean(axis=0), 0.0)
            signal[inside, :3] -= np.einsum("nji,j->ni", attitude[inside], mean)
    return signal


def clipped_cases(data: Path) -> Iterator[tuple[str, Recording, float]]:
    shoe = read(data / "openshoe" / "Measurement_100521_44.npz")
    yield from (("openshoe 44", shoe, rail) for rail in (350, 300))
    for side in ("left", "right"):
        walk = read(data / "gaitmap" / "imu_sample_not_rotated.csv", sensor=f"{side}_sensor")
        yield f"gaitmap {side}", walk, 300
    yield "xio", read(data / "xio" / "short_walk.csv"), 400
    for name in tomllib.loads((data / "pyshoe" / "splits.toml").read_text())["clip"]:
        walk = read(data / "pyshoe" / f"{name}.mat", rest_column="zv_shoe_opt")
        yield from ((name, walk, rail) for rail in (350, 250))


def refilled(found: Estimate, true: Signal, rest) -> dict[str, tuple[Signal, np.ndarray]]:
    """Signals and rests to make a path of; rest: of the unclipped recording."""
    filled = found.filled

    def sum_and_centroid(inside: slice, channel: int) -> np.ndarray:
        """The fill of a gap, with the part of its error that is a line taken off."""
        away, place = true[inside, channel] - filled[inside, channel], np.arange(inside.stop - inside.start)
        return filled[inside, channel] + np.polyval(np.polyfit(place, away, min(1, len(place) - 1)), place)

    def short(inside: slice, channel: int) -> float:
        """By how much the fill of a gap falls short of the truth, on average."""
        return float(np.mean(true[inside, channel] - filled[inside, channel]))

    signals = {
        "nothing filled": found.recording.signal,
        "as filled": filled,
        "sums of gaps true": of_gaps(found, lambda inside, c: filled[inside, c] + short(inside, c)),
        "sums and centroids of gaps true": of_gaps(found, sum_and_centroid),
        "shapes of gaps true": of_gaps(found, lambda inside, c: true[inside, c] - short(inside, c)),
        "turns about the vertical true": turned(found, true, vertical=True),
        "turns about the horizontal true": turned(found, true, vertical=False),
    }
    return {
        **{what: (signal, found.rest) for what, signal in signals.items()},
        "rests of the unclipped recording": (filled, rest),
        "all filled as it was": (np.where(found.saturated, true, filled), found.rest),
    }


def clipped(data: Path) -> list[dict]:
    rows = []
    for name, recording, rail in clipped_cases(data):
        whole = estimate(recording, load_config(None, method="standard"))
        found = estimate(clip(recording, gyr=rail), load_config(None, method="map"))
        variants = refilled(found, recording.signal, whole.rest)
        for what, (signal, rest) in variants.items():
            made = path(found.recording, signal, rest)
            error = position_rmse(made.trajectory.position, whole.trajectory.position, align=False)
            rows.append({"part": "clipped", "case": f"{name}, {rail} °/s", "variant": what, "error": error})
        print(rows[-1]["case"], *(f"{row['error']:.3f}" for row in rows[-len(variants) :]), flush=True)
    return rows


def saturated(data: Path) -> list[dict]:
    folder, rows = data / "pyshoe", []
    for name in tomllib.loads((folder / "splits.toml").read_text())["saturated"]:
        given = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        time, truth = load_pyshoe_truth(folder / f"{name}.mat", at=given.time)
        point = pyshoe_point(folder, name)
        variants = {what: (given, settings) for what, settings in CHANGED.items()}
        variants["own rests"] = read(folder / f"{name}.mat"), {}
        for what, (recording, settings) in variants.items():
            for method in ("standard", "map"):
                found = estimate(recording, load_config(None, method=method, **settings)).trajectory
                tracked = point.path(time, found.position, found.q_nb)
                errors = {
                    "error": position_rmse(found.position, truth),
                    "tracked": position_rmse(tracked, truth),
                }
                rows.append({"part": "saturated", "case": f"{name}: {method}", "variant": what} | errors)
        print(name, *(f"{row['error']:.3f}" for row in rows[-2 * len(variants) :]), flush=True)
    return rows


def page(table: pd.DataFrame) -> Iterator[str]:
    """The tables, errors in metres, and of the saturated trials what `map` leaves of the error of `standard`."""
    yield "# What holds the errors that are left"
    yield "Written by `python scripts/accuracy_ablation.py ../shared/data`, whose head says what is compared."
    for part, rows in table.groupby("part", sort=False):
        if part == "clipped":
            errors = rows.pivot(index="case", columns="variant", values="error")
            order = [list(dict.fromkeys(rows[name])) for name in ("case", "variant")]
            yield "## Clipped in software: RMS to the own unclipped path (m)"
            yield markdown(errors.loc[order[0], order[1]].reset_index())
        else:
            yield "## Saturated PyShoe trials: RMS to Vicon, aligned"
            yield markdown(pd.DataFrame(shares(rows, "error")))
            yield "## The same at the point that Vicon tracks, some 4 cm from the sensor"
            yield markdown(pd.DataFrame(shares(rows, "tracked")))


def shares(rows: pd.DataFrame, column: str) -> Iterator[dict]:
    for variant, mine in rows.groupby("variant", sort=False):
        standard, found = (
            mine.loc[mine["case"].str.endswith(f": {method}"), column].to_numpy()
            for method in ("standard", "map")
        )
        yield {
            "variant": variant,
            "mean of standard (m)": float(standard.mean()),
            "mean of map (m)": float(found.mean()),
            "map over standard (geometric mean)": geometric_mean_ratio(found, standard),
        }


PARTS = {"clipped": clipped, "saturated": saturated}


def main() -> int:
    parser = argparse.ArgumentParser(description="What holds the errors that are left")
    parser.add_argument("data", type=Path)
    parser.add_argument("-o", "--output", type=Path, default=Path("results/accuracy"))
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    arguments = parser.parse_args()
    use_compilation_cache()
    table = pd.DataFrame([row for part in arguments.only for row in PARTS[part](arguments.data)])
    path = arguments.output / "ablation.csv"
    if path.exists():
        before = pd.read_csv(path)
        kept = before.loc[~before["part"].isin(arguments.only)].to_dict("records")
        table = pd.DataFrame([*kept, *table.to_dict("records")])
    table = table.sort_values("part", kind="stable")
    arguments.output.mkdir(parents=True, exist_ok=True)
    table.to_csv(path, index=False, float_format="%.4g")
    (arguments.output / "ablation.md").write_text("\n\n".join(page(table)) + "\n")
    return 0


if __name__ == "__main__":
    sys.exit(main())
