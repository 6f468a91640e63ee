"""Figures of the accuracy board, in the style of the paper's."""

from pathlib import Path

import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.ticker import FuncFormatter, NullFormatter
from paper.drawing import LABELS, MARKERS, STYLES, Tracks, line, panels, save

from jaxsat.studies.metrics import align_yaw_translation

POINTS = 2000


def draw_trial(
    path: Path,
    time: Float[np.ndarray, "N"],
    truth: Float[np.ndarray, "N 3"],
    tracks: Tracks,
    title: str,
) -> None:
    """The path from above and the height over time, each estimate turned about z and shifted onto the truth."""
    figure, (above, height) = panels(1, 2, 9.5, 4.0)
    shown = {"truth": truth} | {name: align_yaw_translation(x, truth) for name, x in tracks.items()}
    step = max(1, len(time) // POINTS)
    for name, track in shown.items():
        x, y, z = track[::step].T
        # A walk crosses itself many times.
        thin = 0.65 * STYLES[name]["lw"]
        line(above, x, y, name, lw=thin)
        line(height, time[::step], z, name, lw=thin)
    above.set(xlabel="x (m)", ylabel="y (m)")
    above.set_aspect("equal", adjustable="datalim")
    height.set(xlabel="time (s)", ylabel="height (m)")
    figure.suptitle(title, fontsize=9)
    handles, labels = above.get_legend_handles_labels()
    figure.legend(handles, labels, loc="outside lower center", ncols=len(labels), fontsize=8)
    save(figure, path)


def draw_ratios(path: Path, ratios: pd.DataFrame) -> None:
    """Position RMSE of each method (a column) over that of the standard smoother, a row a trial."""
    figure, (panel,) = panels(1, 1, 8.0, 4.2)
    # A mark for each method beside the middle of its trial's row, so that equal ones do not hide each other.
    aside = np.linspace(-0.25, 0.25, len(ratios.columns))
    for method, shift in zip(ratios.columns, aside, strict=True):
        places = np.arange(len(ratios)) + shift
        style = {"color": STYLES[method]["color"], "marker": MARKERS[method], "ls": "none", "ms": 6}
        mean = np.exp(np.log(ratios[method]).mean())
        panel.plot(ratios[method], places, label=f"{LABELS[method]} ({mean:.2f})", **style)
    panel.axvline(1.0, color=STYLES["standard"]["color"], lw=1.2, ls=STYLES["standard"]["ls"])
    panel.set_yticks(range(len(ratios)), [str(trial) for trial in ratios.index], fontsize=8)
    low, high = ratios.to_numpy().min(), ratios.to_numpy().max()
    label = "position RMSE over that of the standard smoother (geometric means in brackets)"
    panel.set(xscale="log", xlabel=label)
    panel.xaxis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
    panel.xaxis.set_minor_formatter(NullFormatter())
    panel.set_xticks([0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 1.0, 1.2, 1.4, 1.6, 2.0, 3.0])
    panel.set_xlim(0.95 * min(low, 1.0), 1.05 * max(high, 1.0))
    panel.invert_yaxis()
    figure.legend(loc="outside lower center", ncols=len(ratios.columns), fontsize=8)
    save(figure, path)
