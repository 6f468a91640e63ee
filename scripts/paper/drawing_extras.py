"""Figures that the paper does not have."""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.ticker import LogLocator
from scipy.stats import chi

from .drawing import LABELS, MARKERS, STYLES, line, panels, plain_log, save


def coverage(path: Path, ends: Mapping[str, list[float]]) -> None:
    """How many coordinates of last positions lie within how many sd of the truth, and how many should."""
    figure, (panel,) = panels(1, 1, 5.5, 3.8)
    reach = np.linspace(0.0, 3.0, 200)
    panel.plot(reach, 100.0 * chi(1).cdf(reach), label="as many as should", **STYLES["truth"])
    for method, away in ends.items():
        line(panel, reach, [100.0 * np.mean(np.array(away) <= x) for x in reach], method)
    panel.axvline(1.96, color="0.3", lw=0.8, ls=":")
    panel.annotate("1.96 sd", (1.96, 2.0), fontsize=8, rotation=90, ha="right", va="bottom")
    panel.set(xlabel="half-width of the interval (sd)", ylabel="coordinates of the end inside (%)")
    panel.set(xlim=(0.0, 3.0), ylim=(0.0, 101.0))
    panel.legend(fontsize=8, loc="lower right", bbox_to_anchor=(1.0, 0.05))
    save(figure, path)


def descents(path: Path, table: pd.DataFrame) -> None:
    """The least J so far above the least of all, against evaluations of f."""
    methods = list(dict.fromkeys(table["method"]))
    figure, axes = panels(1, len(methods), 4.3 * len(methods), 3.2, sharey=True)
    looks = {
        "gauss_newton": {"color": "#0072B2", "ls": "-", "marker": "o", "ms": 3.5},
        "projected_gradient": {"color": "#D55E00", "ls": (0, (4, 1.5))},
    }
    for panel, method in zip(axes, methods, strict=True):
        mine = table[table["method"] == method]
        least = mine["cost"].min()
        for solver, look in looks.items():
            rows = mine[mine["solver"] == solver]
            above = np.maximum(rows["best"] - least, 1e-12)
            panel.plot(rows["evaluation"] + 1, above, label=solver.replace("_", " "), **look)
        panel.set(xlabel="evaluations of f(δ)", xscale="log", yscale="log")
        panel.set_title(LABELS[method], fontsize=9)
    axes[0].set(ylabel="least J so far, above its minimum")
    axes[0].legend(fontsize=8)
    save(figure, path)


def starts(path: Path, table: pd.DataFrame) -> None:
    """The last-position error that each start of δ leads to."""
    figure, (panel,) = panels(1, 1, 6.5, 3.2)
    names = list(dict.fromkeys(table["start"]))
    methods = list(dict.fromkeys(table["method"]))
    for shift, method in zip(np.linspace(-0.15, 0.15, len(methods)), methods, strict=True):
        for place, start in enumerate(names):
            found = table.loc[(table["method"] == method) & (table["start"] == start), "last"]
            low, middle, high = 1e3 * np.quantile(found, [0.05, 0.5, 0.95])
            look = {"color": STYLES[method]["color"]}
            panel.plot([place + shift] * 2, [low, high], lw=4, alpha=0.4, **look)
            label = LABELS[method] if place == 0 else None
            panel.plot(place + shift, middle, MARKERS[method], ms=6, label=label, **look)
    panel.set_xticks(range(len(names)), names)
    panel.set(xlabel="start of δ", ylabel="last-position error (mm)", yscale="log")
    panel.set_title("markers: median over the seeds; bars: 5 to 95 %", fontsize=8)
    panel.legend(fontsize=8)
    save(figure, path)


def peaks(path: Path, table: pd.DataFrame) -> None:
    """Eq. 21 as printed and corrected: how far off its peak is in time, against the gap that it must lie in."""
    figure, (panel,) = panels(1, 1, 6.5, 3.6)
    looks = {"corrected": ("direct", "Eq. 21 corrected"), "printed": ("triangle", "Eq. 21 as printed")}
    for formula, (style, label) in looks.items():
        rows = table[table["formula"] == formula]
        line(panel, rows["rail"], rows["off_median"], style, label)
        panel.fill_between(
            rows["rail"], rows["off_low"], rows["off_high"], color=STYLES[style]["color"], alpha=0.2, lw=0
        )
    rows = table.drop_duplicates("rail")
    line(panel, rows["rail"], rows["gap_median"] / 2, "unclipped", "half the gap: beyond lies outside of it")
    panel.set(xlabel="gyroscope rail (rad/s)", ylabel="peak, off the true one (samples)", yscale="log")
    plain_log(panel.yaxis)
    panel.yaxis.set_major_locator(LogLocator())
    panel.set_title("lines: median over the seeds; bands: 5 to 95 %", fontsize=8)
    panel.legend(fontsize=8)
    save(figure, path)
