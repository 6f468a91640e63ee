"""Tables, summary and result folders against what they are made of."""

import hashlib
import json

import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest

from jaxsat.config import Config, load_config
from jaxsat.errors import InputError
from jaxsat.pipeline import estimate
from jaxsat.present import folder as folder_module
from jaxsat.present.folder import check_folder, write_results
from jaxsat.present.summary import inspect, summarise, warnings_of
from jaxsat.present.tables import gaps_table, segments_table, signals_table, trajectory_table
from jaxsat.saturation.solvers import Status
from jaxsat.signals.rails import find_gaps
from jaxsat.signals.recording import CHANNELS
from jaxsat.studies.motions import Bar
from jaxsat.studies.simulate import Sensor, simulate

AXES = "xyz"
STILL = {"noise.rest_steady": 0.0, "smoother.lever_sd": 0.0}
TRAJECTORY = [
    "time",
    *("q_w", "q_x", "q_y", "q_z"),
    *(f"{what}_{axis}" for what in ("pos", "vel") for axis in AXES),
    *(f"{what}_{axis}_sd" for what in ("att", "pos", "vel") for axis in AXES),
    "rest",
    "segment",
]
SIGNALS = [
    "time",
    *CHANNELS,
    *(f"raw_{channel}" for channel in CHANNELS),
    *(f"sat_{channel}" for channel in CHANNELS),
    *(f"{channel}_sd" for channel in CHANNELS),
]
SEGMENTS = ["segment", "start", "end", "saturated", "length", "length_sd", "climb", "climb_sd"]
SEGMENTS += ["rank", "seen", "status"]
GAPS = ["channel", "start", "end", "rail", "peak", "peak_sd", "impulse", "impulse_sd", "identified", "status"]


@pytest.fixture(scope="module")
def simulated():
    """The paper's bar, 22 samples of gyr_y clipped at 7.5 rad/s."""
    sensor = Sensor(gyr_rail=7.5)
    return simulate(Bar(), rate=100.0, duration=1.6, sensor=sensor, key=jax.random.key(1))


@pytest.fixture(scope="module")
def found(simulated):
    # It rests on the spot, and does not roll.
    return estimate(simulated[0], load_config(None, method="direct", **STILL))


@pytest.fixture(scope="module")
def ignored(simulated):
    return estimate(simulated[0], Config(method="standard"))


def test_trajectory_has_the_documented_columns_and_the_states(found):
    table = trajectory_table(found)
    assert list(table.columns) == TRAJECTORY
    assert table["rest"].dtype == bool and table["segment"].dtype.kind == "i"
    np.testing.assert_array_equal(table[["pos_x", "pos_y", "pos_z"]], found.trajectory.position)
    np.testing.assert_array_equal(table[["q_w", "q_x", "q_y", "q_z"]], found.trajectory.q_nb)
    variance = table[[c for c in TRAJECTORY if c.endswith("_sd")]].to_numpy() ** 2
    for k in range(9):
        np.testing.assert_allclose(variance[:, k], found.trajectory.covariance[:, k, k], rtol=1e-14)


def test_segments_are_numbered_between_rests(found):
    table = trajectory_table(found)
    assert (table["rest"] == (table["segment"] == -1)).all()
    for number, arrival in enumerate(found.segments.arrival):
        inside = table.index[table["segment"] == number]
        np.testing.assert_array_equal(inside, np.arange(found.segments.departure[number] + 1, arrival))


def test_a_segment_has_the_way_between_its_rests(found, simulated):
    """The covariance behind its sd is compared with a dense system in test_smoother."""
    table = segments_table(found)
    assert list(table.columns) == SEGMENTS and len(table) == len(found.segments)
    row, truth = table.iloc[0], simulated[1].position
    i, j = int(found.segments.departure[0]), int(found.segments.arrival[0])
    assert row["start"] == found.recording.time[i + 1] and row["end"] == found.recording.time[j]
    assert row["saturated"] == found.saturated[i + 1 : j].sum() > 0 and row["status"] == "converged"
    way = found.trajectory.position[j] - found.trajectory.position[i]
    assert row["length"] == pytest.approx(np.hypot(*way[:2])) and row["climb"] == way[2]
    assert abs(row["length"] - np.hypot(*(truth[j] - truth[i])[:2])) < 4 * row["length_sd"] < 0.1
    # It is known better than where it ends: some of that is unknown from the rest before it on.
    sd = trajectory_table(found)["pos_z_sd"]
    assert 0.9 * sd[j] < row["climb_sd"] < sd[j]


def test_a_way_without_a_rest_at_both_ends_is_empty(found):
    n = len(found.recording)
    cut = eqx.tree_at(lambda e: (e.segments.arrival, e.segments.rest_end), found, (np.array([n]),) * 2)
    table = segments_table(cut)
    assert table[["length", "length_sd", "climb", "climb_sd"]].isna().all(axis=None)


def test_signals_have_the_documented_columns_and_change_only_where_saturated(found, simulated):
    table = signals_table(found)
    assert list(table.columns) == SIGNALS
    raw = table[[f"raw_{c}" for c in CHANNELS]].to_numpy()
    saturated = table[[f"sat_{c}" for c in CHANNELS]].to_numpy()
    np.testing.assert_array_equal(raw, simulated[0].signal)
    np.testing.assert_array_equal(saturated, simulated[1].saturated)
    assert saturated.dtype == bool
    np.testing.assert_array_equal((table[list(CHANNELS)].to_numpy() != raw) & ~saturated, False)


def test_the_gap_of_the_bar_has_the_impulse_that_clipping_took(found, simulated):
    table = gaps_table(found)
    recording, truth = simulated
    assert list(table.columns) == GAPS and len(table) == 1
    gap = table.iloc[0]
    lost = (truth.noisy - recording.signal)[:, 1].sum() * recording.period
    assert gap["channel"] == "gyr_y" and gap["status"] == "converged"
    assert gap["rail"] == pytest.approx(7.5, rel=1e-6)
    assert gap["impulse"] == pytest.approx(lost, rel=0.02)
    clipped = np.flatnonzero(truth.saturated[:, 1])
    assert gap["start"] == pytest.approx(recording.time[clipped[0]])
    assert gap["end"] == pytest.approx(recording.time[clipped[-1]] + recording.period)


def test_gaps_of_any_sign_and_channel_equal_a_count_by_hand(found):
    sign, filled = found.sign.copy(), found.filled.copy()
    raw = found.recording.signal
    sign[50:53, 5], filled[50:53, 5] = -1, raw[50:53, 5] - [1.0, 5.0, 2.0]
    sign[60, 3], filled[60, 3] = 1, raw[60, 3] + 4.0
    changed = eqx.tree_at(lambda e: (e.sign, e.filled, e.gaps), found, (sign, filled, find_gaps(sign)))
    table = gaps_table(changed)
    assert list(table["channel"]) == ["acc_z", "acc_x", "gyr_y"]
    np.testing.assert_allclose(table["impulse"][:2], [-0.08, 0.04])
    assert table["end"][0] - table["start"][0] == pytest.approx(0.03)
    # No rail was found on these channels: the extreme measured value stands for it.
    lowest = raw[50:53, 5][np.argmax(np.abs(raw[50:53, 5]))]
    np.testing.assert_allclose(table["rail"][:2], [lowest, raw[60, 3]])
    np.testing.assert_allclose(table["peak"][1], raw[60, 3] + 4.0)


def test_what_a_method_cannot_say_is_empty(found):
    table = gaps_table(found)
    assert table[["peak_sd", "impulse_sd", "identified"]].isna().all(axis=None)


def test_the_standard_smoother_leaves_gaps_as_they_were(ignored):
    table = gaps_table(ignored)
    assert list(table["status"]) == ["ignored"] and list(table["impulse"]) == [0.0]
    assert table["peak"][0] == table["rail"][0] == pytest.approx(7.5)


def test_a_recording_without_gaps_has_an_empty_table_of_the_same_types(found):
    nothing = np.zeros_like(found.sign)
    clean = eqx.tree_at(lambda e: (e.sign, e.gaps), found, (nothing, find_gaps(nothing)))
    assert list(gaps_table(clean).columns) == GAPS
    assert (gaps_table(clean).dtypes == gaps_table(found).dtypes).all()
    assert len(gaps_table(clean)) == 0


def test_summary_is_plain_json_and_repeats_the_run(found, tmp_path):
    path = tmp_path / "recording.csv"
    path.write_text("some bytes")
    summary = json.loads(json.dumps(summarise(found, path), allow_nan=False))
    assert Config.model_validate(summary["configuration"]) == found.config
    assert summary["input"]["sha256"] == hashlib.sha256(b"some bytes").hexdigest()
    assert summary["rails"]["gyr_y"]["high"] == {
        "rail": pytest.approx(7.5),
        "samples": 22,
        "gaps": 1,
        "longest_gap": 22,
    }
    assert summary["rails"]["acc_x"]["low"]["rail"] is None
    assert summary["segments"]["status"] == {"converged": 1}
    assert summary["cost"]["after"] < 1e-3 * summary["cost"]["before"]
    assert {"versions", "gravity", "gyr_offset", "floor", "seconds", "warnings", "at_bound"} <= set(summary)


def test_nothing_is_wrong_with_the_bar(found):
    assert warnings_of(found) == []


@pytest.mark.parametrize(
    ("where", "value", "word"),
    [
        (lambda e: e.fills.status, np.array([int(Status.MAX_ITERATIONS)]), "iterations"),
        (lambda e: e.fills.status, np.array([int(Status.NO_ARRIVAL)]), "no rest follows"),
        (lambda e: e.fills.at_bound, np.eye(160, 6, dtype=bool), "bound"),
    ],
)
def test_what_went_wrong_is_said(found, where, value, word):
    assert any(word in warning for warning in warnings_of(eqx.tree_at(where, found, value)))


def test_a_given_rail_that_nothing_reaches_is_a_warning(simulated):
    config = Config.model_validate({"method": "standard", "rails": {"gyr": 300.0}})
    warnings = warnings_of(estimate(simulated[0], config))
    assert len(warnings) == 1 and "300" in warnings[0] and "--gyr-unit" in warnings[0]


def test_inspection_counts_what_was_clipped(simulated):
    summary = inspect(simulated[0], Config())
    assert summary["saturated"] == {c: 22 if c == "gyr_y" else 0 for c in CHANNELS}
    assert summary["rests"]["count"] == 2 and summary["rests"]["source"] == "detected"
    assert summary["specific_force_at_rest"] == pytest.approx(9.80665, rel=0.005)
    json.dumps(summary, allow_nan=False)


def test_results_are_written_whole_and_replaced(found, ignored, tmp_path):
    out = tmp_path / "deep" / "out"
    assert write_results(found, out) == out / "report.html"
    assert {p.name for p in out.iterdir()} == {
        "trajectory.parquet",
        "signals.parquet",
        "gaps.parquet",
        "segments.parquet",
        "summary.json",
        "report.html",
    }
    pd.testing.assert_frame_equal(pd.read_parquet(out / "trajectory.parquet"), trajectory_table(found))
    pd.testing.assert_frame_equal(pd.read_parquet(out / "gaps.parquet"), gaps_table(found))

    write_results(ignored, out, csv=True)
    assert {p.suffix for p in out.iterdir()} == {".csv", ".json", ".html"}
    written = pd.read_csv(out / "signals.csv")
    pd.testing.assert_frame_equal(written, signals_table(ignored))
    assert [p.name for p in out.parent.iterdir()] == ["out"]


def test_a_failure_leaves_the_former_results_and_nothing_else(found, tmp_path, monkeypatch):
    out = tmp_path / "out"

    def fail(*_):
        raise RuntimeError("no space left")

    monkeypatch.setattr(folder_module, "render_report", fail)
    with pytest.raises(RuntimeError):
        write_results(found, out)
    assert list(tmp_path.iterdir()) == []
    monkeypatch.undo()
    write_results(found, out)
    before = (out / "summary.json").read_bytes()
    monkeypatch.setattr(folder_module, "render_report", fail)
    with pytest.raises(RuntimeError):
        write_results(found, out)
    assert (out / "summary.json").read_bytes() == before
    assert [p.name for p in tmp_path.iterdir()] == ["out"]


@pytest.mark.parametrize("present", [["notes.txt"], ["summary.json", "thesis.docx"], ["report.html"]])
def test_other_peoples_files_are_left_alone(present, tmp_path):
    for name in present:
        (tmp_path / name).write_text("mine")
    with pytest.raises(InputError, match="choose another folder"):
        check_folder(tmp_path)


def test_a_folder_that_cannot_be_made_is_told(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(InputError, match="not a folder"):
        check_folder(tmp_path / "file")
    with pytest.raises(InputError, match="not a folder"):
        check_folder(tmp_path / "file" / "below")
