"""The scores of the accuracy board, of the table of all estimates."""

from collections.abc import Iterator

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxsat.studies.boards import Direction, Row
from jaxsat.studies.metrics import geometric_mean_ratio

TRIALS = "12 saturated trials"
POINTS = (("rmse", "", ""), ("tracked", "tracked_", ", at the point that is tracked"))
"""Columns of a position error, and how its scores are named; goals are for the sensor's own path."""


def board(table: pd.DataFrame, parts: list[str], every: tuple[str, ...]) -> Iterator[Row]:
    """Scores of the parts that are named; every: names of methods in the order to list them."""

    def of(part, kind, method, column, trial=None) -> Float[np.ndarray, "N"]:
        at = (table["part"] == part) & (table["kind"] == kind) & (table["method"] == method)
        if trial is not None:
            at &= table["trial"] == trial
        return table.loc[at].set_index("trial")[column].sort_index().to_numpy()

    def methods(part, kind) -> list[str]:
        there = set(table.loc[(table["part"] == part) & (table["kind"] == kind), "method"])
        return [method for method in every if method in there]

    def row(metric, value, unit, goal, note, better: Direction = "lower") -> Row:
        goal = goal if metric.endswith("_map") and "tracked" not in metric else None
        return Row(metric, float(value), unit, better, goal, None, note)

    if "pyshoe" in parts:
        for column, point, where in POINTS:
            for kind, name in (("saturated", ""), ("own rests", "own_rests_")):
                what = f"{TRIALS}, {kind}{where}"
                for method in methods("pyshoe", kind)[1:]:
                    for axes in ("3d", "2d"):
                        mine, theirs = (
                            of("pyshoe", kind, m, f"{column}_{axes}") for m in (method, "standard")
                        )
                        of_both = {
                            "ratio": (
                                geometric_mean_ratio(mine, theirs),
                                0.70,
                                "geometric mean of the ratio to standard",
                            ),
                            "worst": ((mine / theirs).max(), 1.02, "worst of these ratios"),
                        }
                        for score, (value, goal, note) in of_both.items():
                            metric = f"pyshoe_{point}{score}_{axes}_{name}{method}"
                            yield row(metric, value, "1", goal, f"{what}: {note}")
            for method in methods("pyshoe", "saturated"):
                mean = of("pyshoe", "saturated", method, f"{column}_3d").mean()
                yield row(f"pyshoe_{point}mean_3d_{method}", mean, "m", None, f"{TRIALS}{where}: mean RMSE")
        for method, goal in (("standard", 0.050), ("free", None)):
            scores = np.concatenate([of("pyshoe", k, method, "pyshoe_3d") for k in ("saturated", "other")])
            note = "all 26 trials, PyShoe's metric; the best of its five published results per trial: 0.054"
            if len(scores):
                yield Row(f"pyshoe_metric_{method}", float(scores.mean()), "m", "lower", goal, None, note)
    if "clipped" in parts:
        for column, point, where in POINTS:
            whole = of("clipped", "unclipped", "standard", f"{column}_3d").mean()
            for rail, goal in ((350, 0.98), (250, 0.95), (200, 0.90)):
                kind = f"{rail} °/s"
                lost = of("clipped", kind, "standard", f"{column}_3d").mean()
                ends = f"unclipped {whole:.3f} m, ignored {lost:.3f} m"
                for method in methods("clipped", kind)[1:]:
                    share = 1 - (of("clipped", kind, method, f"{column}_3d").mean() - whole) / (lost - whole)
                    note = f"share of what clipping loses that comes back{where}; {ends}"
                    yield row(f"recovered_{point}{rail}_{method}", share, "1", goal, note, better="higher")
    for kind, column, name, goals in (
        ("300 °/s", "rmse_2d", "300dps_xy", {"left": 0.16, "right": 0.16}),
        ("8 g", "rmse_z", "8g_z", {"left": 0.31, "right": 0.22}),
        ("300 °/s", "tracked_2d", "300dps_tracked_xy", {"left": None, "right": None}),
    ):
        for side, goal in goals.items() if "gaitmap" in parts else ():
            without = of("gaitmap", "unclipped", "standard", column, side)[0]
            for method in methods("gaitmap", kind):
                value = of("gaitmap", kind, method, column, side)[0]
                if np.isfinite(value):
                    note = f"RMS to motion capture; unclipped {without:.3f} m"
                    yield row(f"gaitmap_{side}_{name}_{method}", value, "m", goal, note)
    for part, goals in (("openshoe", {350: 0.10, 300: 0.20}), ("xio", {500: 0.05, 400: 0.15})):
        for rail, goal in goals.items() if part in parts else ():
            for method in methods(part, f"{rail} °/s"):
                value = of(part, f"{rail} °/s", method, "rmse_3d")[0]
                yield row(f"{part}_{rail}_{method}", value, "m", goal, "RMS to its own unclipped path")
