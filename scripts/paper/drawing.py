"""Figures: one message each, told apart by line style too, so that they survive greyscale."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, cast

import matplotlib
import numpy as np
import pandas as pd
from jaxtyping import Float

matplotlib.use("Agg")
import matplotlib.pyplot as plt
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

LABELS = {
    "truth": "truth",
    "measured": "measured",
    "standard": "standard smoother",
    "direct": "method 1",
    "triangle": "method 2, triangle",
    "quadratic": "method 2, quadratic",
    "map": "map",
    "spline": "cubic spline",
    "second_difference": "least second difference",
    "unclipped": "never clipped",
}
# Okabe and Ito's colours, in steps of lightness too; a line style and a marker each.
STYLES: dict[str, dict[str, Any]] = {
    "truth": {"color": "black", "ls": "-", "lw": 4.0, "alpha": 0.3},
    "measured": {"color": "0.55", "ls": "-", "lw": 1.0},
    "standard": {"color": "0.35", "ls": (0, (1, 1)), "lw": 1.6},
    "direct": {"color": "#0072B2", "ls": "-", "lw": 1.5},
    "triangle": {"color": "#E69F00", "ls": (0, (5, 1.5)), "lw": 1.5},
    "quadratic": {"color": "#009E73", "ls": (0, (4, 1, 1, 1)), "lw": 1.5},
    "map": {"color": "#D55E00", "ls": (0, (2.5, 1)), "lw": 2.0},
    "spline": {"color": "#CC79A7", "ls": (0, (3, 1, 1, 1)), "lw": 1.5},
    "second_difference": {"color": "#56B4E9", "ls": (0, (1, 0.7)), "lw": 1.5},
    "unclipped": {"color": "black", "ls": ":", "lw": 1.2},
}
MARKERS = {
    "standard": "X",
    "direct": "o",
    "triangle": "^",
    "quadratic": "s",
    "map": "D",
    "spline": "v",
    "second_difference": "<",
    "unclipped": "P",
}

plt.rcParams.update(
    {
        "font.size": 9,
        "axes.spines.top": False,
        "axes.spines.right": False,
        "axes.grid": True,
        "grid.color": "0.9",
        "legend.frameon": False,
        "figure.constrained_layout.use": True,
        "svg.hashsalt": "jaxsat",
    }
)

Tracks = Mapping[str, Float[np.ndarray, "N 3"]]
"""Positions (m) by method or `truth`."""


def save(figure: Figure, path: Path) -> None:
    """As PNG and as SVG; the same numbers give the same files."""
    figure.savefig(path.with_suffix(".png"), dpi=140, metadata={"Software": None})
    figure.savefig(path.with_suffix(".svg"), metadata={"Date": None, "Creator": None})
    plt.close(figure)


def panels(rows: int, columns: int, width: float, height: float, **options) -> tuple[Figure, list[Axes]]:
    figure, axes = plt.subplots(rows, columns, figsize=(width, height), squeeze=False, **options)
    return figure, list(axes.ravel())


def plain_log(axis: Axis) -> None:
    """A logarithmic axis with 1 and 3 written out: 0.003, not 3 × 10⁻³."""
    axis.set_major_locator(LogLocator(subs=(1.0, 3.0)))
    axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    axis.set_minor_formatter(NullFormatter())


def line(panel: Axes, x, y, name: str, label: str | None = None, **changes) -> None:
    panel.plot(x, y, label=LABELS[name] if label is None else label, **{**STYLES[name], **changes})


def filled(
    path: Path,
    time: Float[np.ndarray, "N"],
    true: Float[np.ndarray, "N"],
    measured: Float[np.ndarray, "N"],
    found: Mapping[str, Float[np.ndarray, "N"]],
    quantity: str,
    rail: float,
    around: tuple[float, float],
) -> None:
    """Figures 6, 8 and 12: the true, the saturated and the filled signal; methods 1 and `map`, and method 2."""
    figure, axes = panels(1, 2, 9.0, 3.8, sharey=True)
    shown = (time >= around[0]) & (time <= around[1])
    lost = measured != true
    for panel, methods in zip(axes, (("direct", "map"), ("triangle", "quadratic")), strict=True):
        line(panel, time[shown], true[shown], "truth", "true, unclipped")
        line(panel, time[shown], measured[shown], "measured")
        for method in methods:
            wrong = float(np.sqrt(np.mean((found[method] - true)[lost] ** 2)))
            label = f"{LABELS[method]} (RMS error {wrong:.2g})"
            line(panel, time[shown], found[method][shown], method, label)
        panel.axhline(rail, color="0.2", lw=0.8, ls=":")
        panel.annotate("rail", (around[0], rail), fontsize=8, va="bottom", color="0.2")
        panel.set(xlabel="time (s)")
        panel.legend(loc="upper center", bbox_to_anchor=(0.5, -0.18), ncols=2, fontsize=8)
    axes[0].set(ylabel=quantity)
    save(figure, path)


def swing(path: Path, time: Float[np.ndarray, "N"], tracks: Tracks) -> None:
    """Figure 7: the path in three dimensions, and its distance from the truth over time."""
    figure = plt.figure(figsize=(9.5, 4.0))
    space: Any = figure.add_subplot(1, 2, 1, projection="3d")
    panel = figure.add_subplot(1, 2, 2)
    for name, track in tracks.items():
        space.plot(*track.T, label=LABELS[name], **STYLES[name])
        if name != "truth":
            line(panel, time, np.linalg.norm(track - tracks["truth"], axis=1), name)
    reach = max(np.ptp(tracks["truth"][:, i]) for i in range(3)) / 2
    for axis, centre in zip("xyz", (tracks["truth"].max(0) + tracks["truth"].min(0)) / 2, strict=True):
        getattr(space, f"set_{axis}lim")(centre - 1.2 * reach, centre + 1.2 * reach)
        getattr(space, f"set_{axis}label")(f"{axis} (m)")
    space.locator_params(nbins=4)
    space.view_init(elev=18, azim=-70)
    space.set_box_aspect((1, 1, 1), zoom=0.85)
    panel.set(xlabel="time (s)", ylabel="distance from the truth (m)", yscale="log", ylim=(1e-5, 2.0))
    handles, labels = space.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    save(figure, path)


def travel(path: Path, time: Float[np.ndarray, "N"], tracks: Tracks) -> None:
    """Figures 13 and 16: the distance along x over time, and what it is short of."""
    figure, (way, short) = panels(1, 2, 9.0, 3.2)
    for name, track in tracks.items():
        line(way, time, track[:, 0], name)
        if name != "truth":
            line(short, time, 1e3 * (track - tracks["truth"])[:, 0], name)
    way.set(xlabel="time (s)", ylabel="position x (m)")
    short.set(xlabel="time (s)", ylabel="error of x (mm)")
    way.legend(fontsize=8)
    save(figure, path)


def plan(path: Path, tracks: Tracks, title: str = "", size: tuple[float, float] = (7.0, 3.6)) -> None:
    """Figures 15 and 16: the path from above."""
    figure, (panel,) = panels(1, 1, *size)
    for name, track in tracks.items():
        line(panel, track[:, 0], track[:, 1], name)
        panel.plot(
            *track[-1, :2],
            marker=MARKERS.get(name, "*"),
            color=STYLES[name]["color"],
            ms=8 if name != "truth" else 14,
            alpha=STYLES[name].get("alpha", 1.0),
            # Hollow: they may lie on one another.
            mfc="none",
            mew=1.8,
            zorder=3,
        )
    panel.plot(*tracks["truth"][0, :2], marker="|", ms=14, mew=2, color="black")
    panel.set(xlabel="x (m)", ylabel="y (m)")
    # Limits give way, not the box: it keeps its place in the layout.
    panel.set_aspect("equal", adjustable="datalim")
    panel.set_title("\n".join(filter(None, [title, "bar: start, markers: last positions"])), fontsize=8)
    figure.legend(loc="outside lower center", ncols=3, fontsize=8)
    save(figure, path)


def errors(
    path: Path, rows: pd.DataFrame, column: str, paper: Mapping[str, float], what: str, unit: str
) -> None:
    """The errors of a table: ours with their spread over the seeds, the paper's beside them."""
    figure, (panel,) = panels(1, 1, 6.5, 2.6)
    methods = [m for m in LABELS if m in set(rows["method"])]
    scale = 1e3 if unit == "mm" else 1.0
    for place, method in enumerate(reversed(methods)):
        row = rows[rows["method"] == method].iloc[0]
        low, middle, high = (scale * row[f"{column}_{name}"] for name in ("low", "median", "high"))
        panel.plot([low, high], [place, place], lw=5, color=STYLES[method]["color"], alpha=0.45)
        panel.plot(middle, place, MARKERS[method], color=STYLES[method]["color"], ms=7)
        if method in paper:
            panel.plot(scale * paper[method], place, "k|", ms=16, mew=2)
    panel.plot([], [], "ko", label="ours, median")
    panel.plot([], [], "k-", lw=5, alpha=0.4, label="5 to 95 %")
    panel.plot([], [], "k|", ms=12, mew=2, label="the paper")
    panel.set_yticks(range(len(methods)), [LABELS[m] for m in reversed(methods)])
    panel.set(xscale="log", xlabel=f"{what} ({unit})", ylim=(-0.6, len(methods) - 0.4))
    plain_log(panel.xaxis)
    panel.legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=8)
    save(figure, path)


def bands(
    path: Path,
    rows: pd.DataFrame,
    x: str,
    column: str,
    methods: Sequence[str],
    xlabel: str,
    ylabel: str,
    marks: Mapping[str, float],
    title: str = "",
) -> None:
    """Figures 9 to 11: an error against a rail or bound; median over the seeds, and 5 to 95 % as a band."""
    figure, (panel,) = panels(1, 1, 6.5, 3.8)
    for method in methods:
        mine = rows.loc[rows["method"] == method].sort_values(x)
        line(panel, mine[x], mine[f"{column}_median"], method)
        panel.fill_between(
            mine[x],
            mine[f"{column}_low"],
            mine[f"{column}_high"],
            color=STYLES[method]["color"],
            alpha=0.2,
            lw=0,
        )
    for label, at in marks.items():
        panel.axvline(at, color="0.3", lw=0.8, ls=":")
        panel.annotate(
            label, (at, 1.01), xycoords=("data", "axes fraction"), fontsize=8, ha="center", va="bottom"
        )
    panel.set(xlabel=xlabel, ylabel=ylabel, yscale="log")
    plain_log(panel.yaxis)
    panel.set_title(title or "lines: median over the seeds; bands: 5 to 95 %", fontsize=8, pad=16)
    figure.legend(loc="outside lower center", ncols=4, fontsize=8)
    save(figure, path)


def orders(path: Path, table: pd.DataFrame) -> None:
    """Section 5: error and time of segments one after the other and in parallel, a point a seed."""
    figure, axes = panels(1, 2, 8.5, 2.8)
    for panel, column, label in zip(
        axes, ("last", "seconds"), ("last-position error (m)", "time for all segments (s)"), strict=True
    ):
        places = []
        for place, (key, rows) in enumerate(table.groupby(["order", "method"], sort=False)):
            order, method = cast(tuple[str, str], key)
            places.append(f"{LABELS[method]},\n{order}")
            face = STYLES[method]["color"] if order == "parallel" else "white"
            panel.plot(
                np.full(len(rows), place),
                rows[column],
                MARKERS[str(method)],
                mec=STYLES[str(method)]["color"],
                color=face,
                alpha=0.8,
            )
        panel.set_xticks(range(len(places)), places, fontsize=8)
        panel.set(ylabel=label, ylim=(0, None))
    save(figure, path)
