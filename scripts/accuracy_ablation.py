"""What holds the errors that are left: one thing at a time replaced by what is true, or left out.

    python scripts/accuracy_ablation.py ../shared/data [-o results/accuracy] [--only clipped saturated]

`clipped`: recordings clipped in software, of which the lost signal is known. The fills of `map` are replaced in part
by the truth, or another path's constants and rests are taken, and the path is made anew from that signal by the
standard smoother; its error is against the unclipped recording's own path. What makes it fall is what holds it.
`saturated`: the saturated PyShoe trials, against Vicon, by `standard` and `map`, with settings of the estimator left out.
Writes ablation.csv and ablation.md; what was not run again keeps its rows.
"""

import argparse
import sys
import tomllib
from collections.abc import Iterator
from pathlib import Path

import equinox as eqx
import numpy as np
import pandas as pd
from accuracy import IGNORANT, clip
from jaxtyping import Float

from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.pipeline import Estimate, estimate
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import find_segments
from jaxsat.studies.metrics import load_pyshoe_truth, position_rmse

Signal = Float[np.ndarray, "N 6"]

LEFT_OUT = {
    "as it is": {},
    "no bias of the accelerometer": {"smoother.acc_bias_sd": 0.0},
    "no lever": {"smoother.lever_sd": 0.0},
    "no offset of the gyroscope": {"smoother.gyr_offset": "none"},
    "a bias of the gyroscope": {"smoother.gyr_bias_sd": 1e-3},
    "no noise of changes": {"noise.change": 0.0},
    "rests of 1 cm/s": {"noise.rest_velocity_sd": 0.01},
    "rests of 4 cm/s": {"noise.rest_velocity_sd": 0.04},
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


def heading_errors(found: Estimate, truth: Signal) -> Float[np.ndarray, "N 3"]:
    """Rotation by which the fills differ from the truth, sample by sample, in the navigation frame (rad)."""
    w, x, y, z = found.trajectory.q_nb.T
    away = (found.filled - truth)[:, :3] * found.saturated[:, :3] * found.recording.period
    rows = np.stack(
        [
            np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1),
        ],
        axis=1,
    )
    return np.einsum("nij,nj->ni", rows, away), rows


def turned(found: Estimate, truth: Signal, wanted: tuple[bool, bool]) -> Signal:
    """The filled signal without what it errs by over each motion about the vertical (wanted[0]) or the horizontal axes."""
    errors, attitude = heading_errors(found, truth)
    signal = found.filled.copy()
    lost = np.any(found.saturated[:, :3], axis=1)
    segments = find_segments(found.rest)
    for first, last in zip(np.maximum(segments.departure, 0), segments.arrival, strict=True):
        inside = np.flatnonzero(lost[first:last]) + first
        if len(inside):
            total = errors[inside].sum(axis=0) * np.array([wanted[1], wanted[1], wanted[0]])
            share = total / len(inside) / found.recording.period
            signal[inside, :3] -= np.einsum("nji,j->ni", attitude[inside], share)
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


def clipped(data: Path) -> list[dict]:
    rows = []
    for name, recording, rail in clipped_cases(data):
        whole = estimate(recording, load_config(None, method="standard"))
        found = estimate(clip(recording, gyr=rail), load_config(None, method="map"))
        true, filled = recording.signal, found.filled
        variants = {
            "nothing filled": (found.recording.signal, found.rest),
            "as filled": (filled, found.rest),
            "sums of gaps true": (
                of_gaps(found, lambda g, c: filled[g, c] + np.mean(true[g, c] - filled[g, c])),  # noqa: B023
                found.rest,
            ),
            "shapes of gaps true": (
                of_gaps(found, lambda g, c: true[g, c] - np.mean(true[g, c] - filled[g, c])),  # noqa: B023
                found.rest,
            ),
            "turns about the vertical true": (turned(found, true, (True, False)), found.rest),
            "turns about the horizontal true": (turned(found, true, (False, True)), found.rest),
            "rests of the unclipped recording": (filled, whole.rest),
            "all filled as it was": (np.where(found.saturated, true, filled), found.rest),
        }
        for what, (signal, rest) in variants.items():
            made = path(found.recording, signal, rest)
            error = position_rmse(made.trajectory.position, whole.trajectory.position, align=False)
            rows.append({"part": "clipped", "case": f"{name}, {rail} °/s", "variant": what, "error": error})
        print(rows[-1]["case"], *(f"{row['error']:.3f}" for row in rows[-len(variants) :]), flush=True)
    return rows


def saturated(data: Path) -> list[dict]:
    folder, rows = data / "pyshoe", []
    for name in tomllib.loads((folder / "splits.toml").read_text())["saturated"]:
        _, truth = load_pyshoe_truth(folder / f"{name}.mat")
        for rests, column in (("given", "zv_shoe_opt"), ("own", None)):
            recording = read(folder / f"{name}.mat", **({} if column is None else {"rest_column": column}))
            _, truth = load_pyshoe_truth(folder / f"{name}.mat", at=recording.time)
            for what, settings in LEFT_OUT.items() if rests == "given" else [("own rests", {})]:
                for method in ("standard", "map"):
                    found = estimate(recording, load_config(None, method=method, **settings))
                    error = position_rmse(found.trajectory.position, truth)
                    rows.append({"part": "saturated", "case": name, "variant": f"{what}: {method}", "error": error})
            print(name, rests, *(f"{row['error']:.3f}" for row in rows[-2 * len(LEFT_OUT) :]), flush=True)
    return rows


PARTS = {"clipped": clipped, "saturated": saturated}
