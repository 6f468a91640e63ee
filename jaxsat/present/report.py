"""One page for people: what was measured, what was filled in, and the trajectory that follows."""

import functools
from collections.abc import Mapping
from importlib.resources import files
from typing import Any

import jinja2
import numpy as np
import pandas as pd
import plotly.io
import plotly.offline

from jaxsat.pipeline import Estimate
from jaxsat.present.plots import Track, height_figure, path_figure, signals_figure
from jaxsat.present.text import plural
from jaxsat.signals.recording import CHANNELS


def render_report(
    estimate: Estimate,
    summary: Mapping[str, Any],
    beside: Mapping[str, Track],
    scores: pd.DataFrame | None = None,
) -> str:
    """The report as one HTML page that needs no network.

    `summary` is that of `summarise`; `beside` are further tracks in the estimate's frame, such as `standard`
    or `motion capture`; `scores` is a table to put first.
    """
    figures = {
        "above": path_figure(estimate, beside, "above"),
        "side": path_figure(estimate, beside, "side"),
        "height": height_figure(estimate, beside),
        "signals": signals_figure(estimate),
    }
    return _template().render(
        name=estimate.recording.name,
        summary=summary,
        facts=_facts(estimate, summary),
        channels=_channels(estimate, summary),
        scores=scores,
        figures={key: _html(key, figure) for key, figure in figures.items()},
        plotly=plotly.offline.get_plotlyjs(),
    )


@functools.cache
def _template() -> jinja2.Template:
    environment = jinja2.Environment(
        autoescape=True, undefined=jinja2.StrictUndefined, trim_blocks=True, lstrip_blocks=True
    )
    return environment.from_string(files("jaxsat.present").joinpath("report.html.jinja").read_text("utf-8"))


def _html(key: str, figure) -> str:
    return plotly.io.to_html(
        figure,
        full_html=False,
        include_plotlyjs=False,
        div_id=key,
        config={"displaylogo": False, "responsive": True, "modeBarButtonsToRemove": ["lasso2d", "select2d"]},
    )


def _facts(estimate: Estimate, summary: Mapping[str, Any]) -> list[tuple[str, str, str]]:
    """The key numbers: label, value, and what it is in a few words."""
    position = estimate.trajectory.position
    recorded, rests, segments = summary["input"], summary["rests"], summary["segments"]
    moved = float(np.linalg.norm(position[-1, :2] - position[0, :2]))
    sd = np.sqrt(np.trace(estimate.trajectory.covariance[-1, 3:5, 3:5]))
    before, after = summary["cost"]["before"], summary["cost"]["after"]
    facts = [
        (
            "Recording",
            f"{recorded['duration']:.1f} s",
            f"{recorded['samples']:,} samples at {recorded['rate']:.4g} Hz",
        ),
        (
            "Saturated values",
            f"{int(estimate.saturated.sum()):,}",
            f"in {plural(len(estimate.gaps), 'gap')}; {estimate.saturated.any(axis=1).mean():.1%} of the samples",
        ),
        (
            "Rests",
            f"{rests['count']:,}",
            f"{rests['share']:.0%} of the time, {rests['source']}{'; on level ground' if estimate.level else ''}",
        ),
        (
            "Start to end",
            f"{moved:.2f} m",
            f"horizontally, ± {sd:.2g} m (1 sd); height {position[-1, 2] - position[0, 2]:+.3f} m",
        ),
    ]
    if segments["searched"]:
        converged = segments["status"].get("converged", 0)
        facts.append(
            (
                "Segments filled",
                f"{converged} of {segments['searched']}",
                "searches that settled on a minimum",
            )
        )
        facts.append(("Misfit J*", _short(after), f"was {_short(before)} with saturation ignored"))
    else:
        facts.append(("Misfit J*", _short(after), "how far the data are from fitting the rests"))
    return facts


def _short(value: float) -> str:
    return f"{value:,.0f}" if value >= 100 else f"{value:.3g}"


def _channels(estimate: Estimate, summary: Mapping[str, Any]) -> list[dict[str, Any]]:
    """One row a channel and side that saturates."""
    rows = []
    for j, channel in enumerate(CHANNELS):
        for side, sign in (("low", -1), ("high", 1)):
            mine = estimate.sign[:, j] == sign
            if not mine.any():
                continue
            rail = summary["rails"][channel][side]
            highest = sign * (sign * estimate.filled[mine, j]).max()
            rows.append(
                {
                    "channel": channel,
                    "unit": "rad/s" if j < 3 else "m/s²",
                    "rail": rail["rail"],
                    "samples": int(mine.sum()),
                    "gaps": rail["gaps"],
                    "longest": rail["longest_gap"] * estimate.recording.period * 1e3,
                    "peak": float(highest),
                    "at_bound": int(estimate.fills.at_bound[mine, j].sum()),
                }
            )
    return rows
