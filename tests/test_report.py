"""The report: offline, complete, small enough, and drawn from every extreme of the data."""

import re
from dataclasses import replace

import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest

from jaxsat.config import Config
from jaxsat.pipeline import Estimate, estimate
from jaxsat.present.plots import POINTS, height_figure, path_figure, signals_figure, thin
from jaxsat.present.report import render_report
from jaxsat.present.summary import summarise
from jaxsat.signals.rails import find_gaps
from jaxsat.signals.rests import find_segments
from jaxsat.studies.motions import Bar
from jaxsat.studies.simulate import Sensor, simulate


@pytest.fixture(scope="module")
def found() -> Estimate:
    sensor = Sensor(gyr_rail=7.5)
    recording, _ = simulate(Bar(), rate=100.0, duration=1.6, sensor=sensor, key=jax.random.key(1))
    return estimate(recording, Config(method="direct"))


def repeated(found: Estimate, times: int) -> Estimate:
    """The same motion again and again, as one long recording."""

    def tile(x):
        return np.tile(x, (times, *[1] * (x.ndim - 1)))

    time = found.recording.period * np.arange(len(found.recording) * times)
    recording, trajectory, fills = found.recording, found.trajectory, found.fills
    changes = {
        lambda e: (e.recording.time, e.trajectory.time): (time, time),
        lambda e: (e.recording.gyr, e.recording.acc): (tile(recording.gyr), tile(recording.acc)),
        lambda e: (e.recording.missing, e.rest): (tile(recording.missing), tile(found.rest)),
        lambda e: (e.trajectory.q_nb, e.trajectory.position): (
            tile(trajectory.q_nb),
            tile(trajectory.position),
        ),
        lambda e: (e.trajectory.velocity, e.fills.at_bound): (
            tile(trajectory.velocity),
            tile(fills.at_bound),
        ),
        lambda e: e.trajectory.covariance: tile(trajectory.covariance),
        lambda e: (e.sign, e.filled, e.signal_sd): (
            tile(found.sign),
            tile(found.filled),
            tile(found.signal_sd),
        ),
        lambda e: (e.segments, e.gaps): (find_segments(tile(found.rest)), find_gaps(tile(found.sign))),
    }
    for where, value in changes.items():
        found = eqx.tree_at(where, found, value)
    return found


def test_the_page_needs_no_network(found):
    page = render_report(found, summarise(found), {})
    assert "<script src" not in page and "<link" not in page and "@import" not in page
    assert page.count("Plotly.newPlot(") >= 4 and len(page) < 10e6
    for key in ("above", "side", "height", "signals"):
        assert f'id="{key}"' in page


def test_warnings_scores_and_names_are_on_the_page_as_text(found):
    odd = replace(found, recording=replace(found.recording, name="<b>walk & run</b>"))
    summary = summarise(odd) | {"warnings": ["the sensor was <upside> down"]}
    scores = pd.DataFrame({"RMS (m)": [1.25]}, index=pd.Index(["before"], name="error"))
    page = render_report(odd, summary, {}, scores)
    assert "&lt;b&gt;walk &amp; run&lt;/b&gt;" in page and "<b>walk" not in page
    assert "the sensor was &lt;upside&gt; down" in page
    assert re.search(r"<td>before</td>\s*<td>1.250</td>", page)


def test_a_report_of_the_standard_smoother_says_that_gaps_are_ignored(found):
    plain = replace(found, config=Config(method="standard"))
    assert "method standard ignores them" in render_report(plain, summarise(plain), {})


def test_without_saturation_all_six_channels_are_drawn(found):
    nothing = np.zeros_like(found.sign)
    clean = eqx.tree_at(lambda e: (e.sign, e.gaps), found, (nothing, find_gaps(nothing)))
    measured = [trace for trace in signals_figure(clean).data if trace.name == "measured"]
    assert len(measured) == 6
    assert "No channel saturates" in render_report(clean, summarise(clean), {})


def test_only_saturated_channels_are_drawn_with_their_fill(found):
    traces = {trace.name: trace for trace in signals_figure(found).data}
    assert sorted(traces) == ["filled", "gap", "measured", "± 1 sd"]
    assert np.nanmax(traces["filled"].y) == np.float32(found.filled[:, 1].max())
    saturated = found.recording.time[found.saturated[:, 1]]
    assert np.nanmin(traces["gap"].x) == np.float32(saturated[0])
    # The band never falls below what was measured.
    assert np.nanmin(traces["± 1 sd"].y) >= np.float32(found.recording.signal[found.saturated[:, 1], 1].min())


def test_figures_show_the_tracks_that_stand_beside(found):
    other = (found.trajectory.time, found.trajectory.position + 1.0)
    for figure in (
        path_figure(found, {"standard": other}, "above"),
        path_figure(found, {"standard": other}, "side"),
        height_figure(found, {"standard": other}),
    ):
        traces = {trace.name: trace for trace in figure.data}
        assert {"standard", "direct"} <= set(traces)
    np.testing.assert_allclose(traces["standard"].y - traces["direct"].y, 1.0, rtol=1e-5)


def test_thinning_keeps_every_extreme_and_leaves_short_signals_alone():
    x = np.random.default_rng(3).normal(size=5000)
    np.testing.assert_array_equal(thin(x, np.arange(5000), 5000), np.arange(5000))
    at = thin(x, np.arange(5000), 100)
    assert len(at) <= 100 and (np.diff(at) > 0).all()
    for part in x.reshape(50, 100):
        assert part.min() in x[at] and part.max() in x[at]


def test_half_an_hour_at_200_hz_stays_below_ten_megabytes(found):
    long = repeated(found, 2250)
    assert len(long.recording) == 360_000 and len(long.gaps) == 2250
    figure = signals_figure(long)
    assert all(len(trace.x) <= 6 * POINTS for trace in figure.data)
    beside = {"standard": (long.trajectory.time, long.trajectory.position)}
    page = render_report(long, summarise(found), beside)
    assert len(page) < 10e6
