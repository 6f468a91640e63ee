"""The accuracy board's own parts: fills of its peers against what they minimise, and rows kept or replaced."""

import dataclasses
import importlib
import sys
from pathlib import Path
from types import SimpleNamespace

import jax
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from jaxsat import estimate, load_config, simulate
from jaxsat.present.tables import segments_table
from jaxsat.signals.recording import Recording
from jaxsat.studies.motions import Bar, Walk
from jaxsat.studies.tracked_point import TrackedPoint

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


@pytest.fixture(scope="module")
def board():
    sys.path.insert(0, str(SCRIPTS))
    try:
        yield importlib.import_module("accuracy")
    finally:
        sys.path.remove(str(SCRIPTS))


@pytest.fixture
def fills(board):
    return importlib.import_module("peers.fills")


def test_a_spline_finds_a_cubic_and_the_other_fill_a_line_and_the_least_bend(fills):
    t, lost = np.linspace(-1.0, 1.0, 40), np.zeros(40, bool)
    lost[8:12] = lost[20:27] = lost[28] = True
    cubic = 2.0 * t**3 - t**2 + 0.5
    np.testing.assert_allclose(fills.spline(np.where(lost, 0.0, cubic), lost), cubic, atol=1e-12)
    np.testing.assert_allclose(
        fills.second_difference(np.where(lost, 0.0, 3.0 * t), lost), 3.0 * t, atol=1e-12
    )
    bent = np.random.default_rng(0).normal(size=40)
    second = np.diff(np.eye(40), 2, axis=0)
    best = np.linalg.lstsq(second[:, lost], -second[:, ~lost] @ bent[~lost])[0]
    found = fills.second_difference(bent, lost)
    np.testing.assert_allclose(found[lost], best, atol=1e-10)
    np.testing.assert_array_equal(found[~lost], bent[~lost])


@pytest.mark.parametrize("name", ["spline", "second_difference"])
def test_what_is_filled_lies_beyond_its_rail_and_the_rest_is_as_measured(fills, name):
    n, T = 400, 0.005
    time = T * np.arange(n)
    signal = np.sin(2 * np.pi * np.array([1, 2, 3, 1, 2, 3]) * time[:, None]) + 0.1
    true, rail = signal.copy(), np.array([0.8, 9.0, 0.9, 0.7, 9.0, 9.0])
    signal = np.clip(signal, -rail, rail)
    sign = np.where(signal != true, np.sign(true), 0.0).astype(int)
    # A lone sample lower than both of its neighbours would be filled below its rail; an end has one neighbour.
    signal[150, 1], sign[150, 1] = 2.0, 1
    sign[:3, 4] = 1
    recording = Recording(time, signal[:, :3], signal[:, 3:], np.zeros((n, 6), bool))
    rest = np.arange(n) < 9
    found = fills.filled(recording, SimpleNamespace(sign=sign, rest=rest), name)
    assert np.all(sign * (found.signal - signal) >= 0.0)
    np.testing.assert_array_equal(found.signal[sign == 0], signal[sign == 0])
    np.testing.assert_array_equal(found.signal[:3, 4], signal[:3, 4])
    np.testing.assert_array_equal(found.rest, rest)
    assert found.signal[150, 1] == 2.0
    lost = sign[:, 0] != 0
    assert np.abs(found.signal - true)[lost, 0].max() < 0.5 * np.abs(signal - true)[lost, 0].max()


def test_rows_that_were_run_again_replace_the_former_and_keep_their_place(board):
    def rows(*names):
        return pd.DataFrame(
            [{**dict(zip(board.KEY, name, strict=True)), "rmse_3d": float(k)} for k, name in enumerate(names)]
        )

    before = rows(
        ("xio", "a", "500", "standard"),
        ("xio", "a", "500", "forgotten"),
        ("xio", "a", "500", "map"),
        ("xio", "a", "400", "standard"),
        ("gaitmap", "left", "8 g", "forgotten"),
    )
    new = rows(("xio", "a", "500", "spline"), ("xio", "a", "400", "map"), ("xio", "a", "500", "map"))
    table = board.merged(before, new, ["xio"], ["spline", "map"])
    assert [tuple(row) for row in table.to_numpy()] == [
        ("xio", "a", "500", "standard", 0.0),
        ("xio", "a", "500", "map", 2.0),
        ("xio", "a", "500", "spline", 0.0),
        ("xio", "a", "400", "standard", 3.0),
        ("xio", "a", "400", "map", 1.0),
        ("gaitmap", "left", "8 g", "forgotten", 4.0),
    ]


def test_intervals_that_are_right_hold_their_share_and_others_do_not(board):
    intervals = importlib.import_module("accuracy_intervals")
    rng, rows = np.random.default_rng(4), []
    for name, scale in (("a", 1.0), ("b", 1.0)):
        for what in intervals.WHAT:
            z = rng.normal(size=4000) * (3.0 if what == "peaks" else scale)
            rows += [{"trial": name, "sensor": "gyr", "what": what, "z": value} for value in z]
    table = intervals.summary(pd.DataFrame(rows))
    assert len(table) == 2 * len(intervals.WHAT) and (table["count"] == 4000).all()
    found = {row.metric: row for row in intervals.board(table)}
    for what, right in (("samples", True), ("impulses", True), ("peaks", False)):
        for share in (50, 90):
            row = found[f"interval_{share}_{what}"]
            assert (
                row.goal == pytest.approx(0.05)
                and (row.value < 0.02) is right
                and (row.value > 0.2) is not right
            )


def test_what_a_gap_lost_is_compared_with_the_recording_before_it_was_clipped(board):
    """The bar of the tests: its own numbers, from the estimate and the unclipped signal by hand."""
    from jaxsat import Sensor, estimate, load_config, simulate
    from jaxsat.studies.motions import Bar

    intervals = importlib.import_module("accuracy_intervals")
    whole, truth = simulate(Bar(), rate=100.0, duration=1.6, sensor=Sensor(), key=jax.random.key(0))
    whole = dataclasses.replace(whole, rest=truth.rest)
    settings = {"saturation.gyr_bound": 5.0, "smoother.gyr_offset": "none"}
    found = estimate(board.clip(whole, gyr=np.rad2deg(7.5)), load_config(None, **settings))
    rows = pd.DataFrame(intervals.held("bar", whole, found)).set_index("what")
    i, j = found.gaps.start[0], found.gaps.end[0]
    filled, true = found.filled[i:j, 1], whole.gyr[i:j, 1]
    samples = rows.loc["samples", "z"].to_numpy()
    np.testing.assert_allclose(samples, (filled - true) / found.signal_sd[i:j, 1])
    impulse = (filled - true).sum() / found.fills.gap_sd[i, 1]
    assert rows.loc["impulses", "z"] == pytest.approx(impulse)
    top = np.argmax(np.abs(filled))
    peak = (filled[top] - true[np.argmax(np.abs(true))]) / found.signal_sd[i + top, 1]
    assert rows.loc["peaks", "z"] == pytest.approx(peak) and len(rows) == j - i + 2


def test_a_stride_is_compared_with_that_of_the_sensor_not_of_the_marker(board):
    """Cameras that see a marker, in a frame of their own, walk 5 % further and climb 1 cm a stride more."""
    intervals = importlib.import_module("accuracy_intervals")
    motion = Walk(strides=5)
    recording, made = simulate(
        motion, rate=100.0, duration=float(motion.moving[-1, 1]) + 1.0, key=jax.random.key(1)
    )
    found = estimate(dataclasses.replace(recording, rest=made.rest), load_config(None, method="standard"))
    path, point = found.trajectory, TrackedPoint(np.array([0.02, 0.0, 0.08]), 0.0)
    strides = segments_table(found).dropna(subset=["length_sd"])
    lengths = strides["length"].to_numpy()
    times, steps = strides[["start", "end"]].to_numpy().ravel(), np.arange(2 * len(strides)) + 1
    climbing = 0.01 * np.interp(path.time, times, steps // 2)
    sensor = path.position * [1.05, 1.05, 1.0] + np.stack([0 * climbing, 0 * climbing, climbing], axis=1)
    marker = sensor + point.path(path.time, path.position, path.q_nb) - path.position
    turned = Rotation.from_euler("z", 1.0).apply(marker) + np.array([5.0, 1.0, 2.0])
    rows = pd.DataFrame(intervals.path_held("walk", found, turned, point)).set_index("what")
    away = rows.loc["lengths", "z"].to_numpy() * strides["length_sd"].to_numpy()
    assert len(away) == 5
    np.testing.assert_allclose(away, -0.05 * lengths, atol=2e-3)
    climbs = rows.loc["climbs", "z"].to_numpy() * strides["climb_sd"].to_numpy()
    np.testing.assert_allclose(climbs, -0.01, atol=1e-3)
    begins = found.segments.departure[found.segments.departure >= 0]
    place = path.position[begins] - path.position[begins[0]]
    sd = np.sqrt(path.covariance[begins, 5, 5])
    # The first is where heights and distances are counted from.
    heights = rows.loc["heights", "z"].to_numpy() * sd[1:]
    np.testing.assert_allclose(heights, -0.01 * np.arange(1, len(begins)), atol=1e-3)
    along = path.covariance[begins, 3, 3][1:] ** 0.5
    distances = rows.loc["distances", "z"].to_numpy() * along
    np.testing.assert_allclose(distances, -0.05 * place[1:, 0], atol=3e-3)


@pytest.mark.parametrize("vertical", [True, False])
def test_a_fill_without_its_turn_about_some_axes_keeps_that_about_the_others(board, vertical):
    ablation = importlib.import_module("accuracy_ablation")
    rng, n = np.random.default_rng(0), 60
    q = rng.normal(size=(n, 4))
    rest, saturated = np.zeros(n, bool), np.zeros((n, 6), bool)
    rest[:10] = rest[30:35] = rest[50:] = True
    saturated[15:20, 1] = saturated[17:22, 2] = saturated[40:45, 0] = saturated[41, 5] = True
    truth = rng.normal(size=(n, 6))
    found = SimpleNamespace(
        trajectory=SimpleNamespace(q_nb=q / np.linalg.norm(q, axis=1, keepdims=True)),
        saturated=saturated,
        filled=truth + np.where(saturated, rng.normal(size=(n, 6)), 0.0),
        rest=rest,
    )

    def turns(signal):
        at = Rotation.from_quat(found.trajectory.q_nb, scalar_first=True)
        away = at.apply((signal - truth)[:, :3])
        return np.array([away[10:30].sum(axis=0), away[35:50].sum(axis=0)])

    before, after = turns(found.filled), turns(ablation.turned(found, truth, vertical))
    expected = before * ([1, 1, 0] if vertical else [0, 0, 1])
    np.testing.assert_allclose(after, expected, atol=1e-12)
    assert (np.abs(before) > 0.1).all()


def test_the_path_of_a_signal_that_is_true_again_is_the_unclipped_one(board):
    ablation = importlib.import_module("accuracy_ablation")
    recording, truth = simulate(Bar(), rate=100.0, duration=1.6, key=jax.random.key(0))
    recording = ablation.resting(recording, truth.rest)
    whole = estimate(recording, load_config(None, method="standard"))
    found = estimate(board.clip(recording, gyr=430.0), load_config(None, method="standard"))
    assert found.saturated.sum() > 10
    again = np.where(found.saturated, recording.signal, found.recording.signal)
    made = ablation.path(found.recording, again, found.rest)
    np.testing.assert_allclose(made.trajectory.position, whole.trajectory.position, atol=1e-12)
    off = found.trajectory.position[-1] - whole.trajectory.position[-1]
    assert np.linalg.norm(off) > 0.1
    true = ablation.of_gaps(found, lambda inside, channel: recording.signal[inside, channel])
    np.testing.assert_array_equal(true, again)
    made = ablation.refilled(found, recording.signal, whole.rest)
    for what, true in (("sums of gaps true", np.sum), ("shapes of gaps true", np.diff)):
        signal = made[what][0]
        for inside, channel in ablation.gaps_of(found):
            np.testing.assert_allclose(true(signal[inside, channel]), true(recording.signal[inside, channel]))
        assert not np.allclose(signal, again)
    np.testing.assert_array_equal(made["all filled as it was"][0], again)
