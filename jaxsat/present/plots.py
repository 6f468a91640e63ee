"""Figures of an estimate, for the report; drawn with few enough points for any length of recording."""

from collections.abc import Iterable, Mapping
from itertools import pairwise
from typing import Any, Literal

import numpy as np
import plotly.graph_objects as go
from jaxtyping import Bool, Float, Int
from plotly.subplots import make_subplots

from jaxsat.pipeline import Estimate
from jaxsat.signals.recording import CHANNELS
from jaxsat.signals.rests import runs

Track = tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K 3"]]
"""Times (s) and positions (m)."""

FILLED, MEASURED, RAIL = "#1d5fa6", "#8b98a5", "#b8372e"
BESIDE = {"standard": "#e08a1e", "motion capture": "#1f2933"}
_GAP_SHADE, _REST_SHADE, _BAND = "rgba(224,138,30,0.16)", "rgba(70,130,90,0.13)", "rgba(29,95,166,0.18)"
# A screen is some thousand pixels wide; zooming in by ten still shows every swing.
POINTS = 20_000


def thin(
    values: Float[np.ndarray, "N"], at: Int[np.ndarray, "K"], limit: int = POINTS
) -> Int[np.ndarray, "L"]:
    """Of the samples `at`, those to draw: all, or the lowest and the highest of each of `limit`/2 stretches."""
    if len(at) <= limit:
        return at
    edges = np.linspace(0, len(at), limit // 2 + 1).astype(int)
    parts = [at[i:j] for i, j in pairwise(edges)]
    return np.unique(
        [pick for part in parts for pick in (part[values[part].argmin()], part[values[part].argmax()])]
    )


def path_figure(estimate: Estimate, beside: Mapping[str, Track], view: Literal["above", "side"]) -> go.Figure:
    """The trajectory from above (x against y, to scale) or from the side (along its main direction, height)."""
    tracks = {**beside, estimate.config.method: (estimate.trajectory.time, estimate.trajectory.position)}
    figure = go.Figure()
    position = estimate.trajectory.position
    centred = position[:, :2] - position[:, :2].mean(axis=0)
    along = None
    if view == "side":
        along = np.linalg.svd(centred.T @ centred)[0][:, 0]
        # Forward is to the right: the direction has no sign of its own.
        along = along if (position.mean(axis=0) - position[0])[:2] @ along >= 0 else -along
    for name, (_, track) in tracks.items():
        step = max(1, len(track) // POINTS)
        x, y = (
            (track[::step, 0], track[::step, 1])
            if along is None
            else (track[::step, :2] @ along, track[::step, 2])
        )
        figure.add_scatter(x=_f4(x), y=_f4(y), name=name, mode="lines", line=_line(name))
    if along is None:
        start, end = position[0], position[-1]
        for label, point, symbol in (("start", start, "circle"), ("end", end, "square")):
            figure.add_scatter(
                x=[point[0]],
                y=[point[1]],
                name=label,
                mode="markers",
                marker={"symbol": symbol, "size": 9, "color": FILLED},
            )
        figure.update_yaxes(title="y (m)", scaleanchor="x")
        figure.update_xaxes(title="x (m)")
    else:
        figure.update_xaxes(title="along the main direction of travel (m)")
        figure.update_yaxes(title="height (m)")
    return _styled(figure, 460 if along is None else 280)


def height_figure(estimate: Estimate, beside: Mapping[str, Track]) -> go.Figure:
    """Height over time with its sd; rests are shaded."""
    trajectory = estimate.trajectory
    z, sd = trajectory.position[:, 2], np.sqrt(trajectory.covariance[:, 5, 5])
    shown = thin(z, np.arange(len(z)))
    tracks = {name: (time, position[:, 2]) for name, (time, position) in beside.items()}
    heights = [z - sd, z + sd, *(height for _, height in tracks.values())]
    low, high = min(h.min() for h in heights), max(h.max() for h in heights)
    figure = go.Figure()
    _add_shade(figure, _spans(estimate.rest, trajectory.time), low, high, "rest", _REST_SHADE)
    _add_band(figure, [(trajectory.time[shown], (z - sd)[shown], (z + sd)[shown])], "± 1 sd")
    for name, (time, height) in tracks.items():
        at = thin(height, np.arange(len(height)))
        figure.add_scatter(x=_f4(time[at]), y=_f4(height[at]), name=name, mode="lines", line=_line(name))
    name = estimate.config.method
    figure.add_scatter(
        x=_f4(trajectory.time[shown]), y=_f4(z[shown]), name=name, mode="lines", line=_line(name)
    )
    figure.update_xaxes(title="time (s)")
    figure.update_yaxes(title="height (m)")
    return _styled(figure, 300)


def signals_figure(estimate: Estimate) -> go.Figure:
    """Measured and filled signals, gaps shaded and rails drawn: the channels that saturate, or else all six."""
    recording = estimate.recording
    channels = np.flatnonzero(estimate.saturated.any(axis=0)).tolist() or list(range(6))
    figure = make_subplots(len(channels), 1, shared_xaxes=True, vertical_spacing=0.12 / len(channels))
    for row, j in enumerate(channels, start=1):
        place: dict[str, Any] = {"row": row, "col": 1}
        once = {"showlegend": row == 1}
        raw, saturated = recording.signal[:, j], estimate.saturated[:, j]
        lower, upper = _band(estimate, j)
        low, high = (
            min(raw.min(), lower[saturated].min(initial=0)),
            max(raw.max(), upper[saturated].max(initial=0)),
        )
        margin = 0.04 * (high - low)
        _add_shade(
            figure,
            _spans(saturated, recording.time),
            low - margin,
            high + margin,
            "gap",
            _GAP_SHADE,
            **place,
            **once,
        )
        for limit in (estimate.rails.low[j], estimate.rails.high[j]):
            if np.isfinite(limit):
                figure.add_hline(y=float(limit), line={"color": RAIL, "width": 1, "dash": "dot"}, **place)
        shown = thin(raw, np.arange(len(raw)))
        figure.add_scatter(
            x=_f4(recording.time[shown]),
            y=_f4(raw[shown]),
            name="measured",
            mode="lines",
            line={"color": MEASURED, "width": 1.2},
            **once,
            **place,
        )
        if estimate.config.method != "standard" and saturated.any():
            _add_filled(figure, estimate, j, **once, **place)
        figure.update_yaxes(title=f"{CHANNELS[j]} ({'rad/s' if j < 3 else 'm/s²'})", **place)
    figure.update_xaxes(title="time (s)", row=len(channels), col=1)
    return _styled(figure, 90 + 210 * len(channels))


def _add_filled(figure: go.Figure, estimate: Estimate, j: int, **options) -> None:
    """The filled values of one channel, each gap with the samples beside it, and their sd."""
    time, filled = estimate.recording.time, estimate.filled[:, j]
    saturated = estimate.saturated[:, j]
    near = saturated.copy()
    near[1:] |= saturated[:-1]
    near[:-1] |= saturated[1:]
    stretch = np.cumsum(np.diff(near, prepend=False))
    shown = thin(filled, np.flatnonzero(near))
    pieces = np.split(shown, np.flatnonzero(np.diff(stretch[shown])) + 1)
    x, y = (_joined(values[piece] for piece in pieces) for values in (time, filled))
    inside = [piece[saturated[piece]] for piece in pieces]
    lower, upper = _band(estimate, j)
    _add_band(figure, [(time[piece], lower[piece], upper[piece]) for piece in inside], "± 1 sd", **options)
    figure.add_scatter(x=x, y=y, name="filled", mode="lines", line={"color": FILLED, "width": 2}, **options)


def _band(estimate: Estimate, j: int) -> tuple[Float[np.ndarray, "N"], Float[np.ndarray, "N"]]:
    """One sd about a filled channel, but what was measured is a bound: the true value lies at it or beyond."""
    raw, sign = estimate.recording.signal[:, j], estimate.sign[:, j]
    filled, sd = estimate.filled[:, j], estimate.signal_sd[:, j]
    if estimate.config.method == "standard":
        return raw, raw
    lower = np.where(sign > 0, np.maximum(filled - sd, raw), filled - sd)
    return lower, np.where(sign < 0, np.minimum(filled + sd, raw), filled + sd)


def _spans(mask: Bool[np.ndarray, "N"], time: Float[np.ndarray, "N"]) -> list[tuple[float, float]]:
    """Runs of True as times; neighbours closer than the drawing resolves are one."""
    period = time[1] - time[0]
    starts, ends = runs(mask)
    spans: list[tuple[float, float]] = []
    for start, end in zip(time[starts], time[ends - 1] + period, strict=True):
        if spans and start - spans[-1][1] < (time[-1] - time[0]) / POINTS:
            spans[-1] = (spans[-1][0], float(end))
        else:
            spans.append((float(start), float(end)))
    return spans


def _add_shade(
    figure: go.Figure,
    spans: Iterable[tuple[float, float]],
    low: float,
    high: float,
    name: str,
    color: str,
    **options,
) -> None:
    """Rectangles from `low` to `high` as one trace: thousands of shapes would make a page slow."""
    corners = list(spans)
    x = _joined(np.array([a, a, b, b]) for a, b in corners)
    y = _joined(np.array([low, high, high, low]) for _ in corners)
    _add_area(figure, x, y, name, color, **options)


def _add_band(figure: go.Figure, pieces: Iterable[tuple[np.ndarray, ...]], name: str, **options) -> None:
    """Areas between a lower and an upper curve."""
    kept = [piece for piece in pieces if len(piece[0])]
    x = _joined(np.concatenate([time, time[::-1]]) for time, _, _ in kept)
    y = _joined(np.concatenate([lower, upper[::-1]]) for _, lower, upper in kept)
    _add_area(figure, x, y, name, _BAND, **options)


def _add_area(figure: go.Figure, x: np.ndarray, y: np.ndarray, name: str, color: str, **options) -> None:
    figure.add_scatter(
        x=x,
        y=y,
        name=name,
        mode="lines",
        fill="toself",
        fillcolor=color,
        line={"width": 0},
        hoverinfo="skip",
        **options,
    )


def _joined(parts: Iterable[np.ndarray]) -> np.ndarray:
    """One after the other with NaN between, where a curve is interrupted."""
    pieces = [np.append(part, np.nan) for part in parts]
    return _f4(np.concatenate(pieces)) if pieces else np.zeros(0, np.float32)


def _f4(x: np.ndarray) -> np.ndarray:
    """Enough digits to draw, in half of the space."""
    return np.asarray(x, np.float32)


def _line(name: str) -> dict:
    dash = {"standard": "solid", "motion capture": "dot"}.get(name, "solid")
    return {"color": BESIDE.get(name, FILLED), "width": 1.8, "dash": dash}


def _styled(figure: go.Figure, height: int) -> go.Figure:
    figure.update_layout(
        height=height,
        template="plotly_white",
        margin={"l": 64, "r": 16, "t": 36, "b": 48},
        font={"family": "system-ui, sans-serif", "size": 13, "color": "#1f2933"},
        legend={"orientation": "h", "yanchor": "bottom", "y": 1.0, "x": 0.0, "traceorder": "normal"},
        hovermode="closest",
    )
    return figure
