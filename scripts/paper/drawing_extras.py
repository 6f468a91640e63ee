"""Figures that the paper does not have."""

from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.ticker import LogLocator

from .drawing import LABELS, MARKERS, STYLES, line, panels, plain_log, save


def coverage(path: Path, table: pd.DataFrame) -> None:
    """The error of the last position of each seed against the sd that is given for it."""
    figure, (panel,) = panels(1, 1, 5.5, 3.8)
    for method, rows in table.groupby("method", sort=False):
        name = str(method)
        held = rows["end"].mean()
        panel.plot(
            1e3 * rows["sd"],
            1e3 * rows["error"],
            MARKERS[name],
            color=STYLES[name]["color"],
            ms=4,
            alpha=0.7,
            label=f"{LABELS[name]}: 95 % intervals hold {held:.0%}",
        )
    ends = 1e3 * np.array([table["sd"].min() * 0.8, table["sd"].max() * 1.25])
    panel.plot(ends, ends, "k-", lw=0.8, label="error = sd")
    panel.set(
        xscale="log", yscale="log", xlabel="sd of the last position (mm)", ylabel="its error (mm)", xlim=ends
    )
    panel.legend(fontsize=8, loc="lower right")
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
