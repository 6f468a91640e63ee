"""Readers: round trips, units, time grids, and every real folder with its documented rate and length."""

import numpy as np
import pandas as pd
import pytest
import scipy.io
from corruptions import G, healthy, write_gaitmap

from jaxsat.errors import InputError
from jaxsat.signals.grid import find_grid, onto_grid
from jaxsat.signals.readers import FORMATS, read
from jaxsat.signals.recording import CHANNELS, Recording

TABLE = healthy()
SIGNAL = TABLE[[*CHANNELS]].to_numpy()
XIO = [f"Gyroscope {axis} (deg/s)" for axis in "XYZ"] + [f"Accelerometer {axis} (g)" for axis in "XYZ"]


def written(table: pd.DataFrame, path) -> Recording:
    table.to_csv(path, index=False) if path.suffix == ".csv" else table.to_parquet(path)
    return read(path)


# One signal through every format.
@pytest.mark.parametrize("suffix", ["csv", "parquet", "txt"])
def test_a_canonical_file_comes_back_as_it_was(tmp_path, suffix):
    path = tmp_path / f"walk.{suffix}"
    TABLE.to_csv(path, index=False) if suffix != "parquet" else TABLE.to_parquet(path)
    recording = read(path)
    np.testing.assert_allclose(recording.signal, SIGNAL, rtol=1e-14)
    np.testing.assert_allclose(recording.time, TABLE.time, atol=1e-12)
    assert recording.name == "walk" and recording.rest is None and recording.clipped is None
    assert recording.missing.shape == (1600, 6) and not recording.missing.any()


def save_pyshoe(path):
    imu = SIGNAL[:, [3, 4, 5, 0, 1, 2]]
    scipy.io.savemat(path, {"imu": imu, "ts": TABLE.time.to_numpy(), "zv": TABLE.index < 200})


def save_ipyshoe(path):
    scipy.io.savemat(path, {"imu_data": SIGNAL[:, [3, 4, 5, 0, 1, 2]], "timestamps": TABLE.time.to_numpy()})


def save_openshoe(path):
    np.savez(path, gyr_rad_s=SIGNAL[:, :3], acc_g=SIGNAL[:, 3:] / G)


def save_broad(path):
    np.savez(path, imu_gyr=SIGNAL[:, :3], imu_acc=SIGNAL[:, 3:], sampling_rate=[[200.0]])


def save_xio(path):
    scaled = SIGNAL * np.array([180 / np.pi] * 3 + [1 / G] * 3)
    pd.DataFrame(scaled, columns=XIO).assign(**{"Time (s)": TABLE.time}).to_csv(path, index=False)


def save_robot_arm(path):
    first = np.zeros((1, 6))
    scaled = np.concatenate([first, SIGNAL * np.array([180 / np.pi] * 3 + [1 / G] * 3)])
    time = np.concatenate([[-0.3], TABLE.time.to_numpy()])
    scipy.io.savemat(path, {"SENSgyro": scaled[:, :3].T, "SENSacc": scaled[:, 3:].T, "MATLABtime": time})


def save_tremor(path):
    ns = (1_254_165_405_654_372 + 5_000_000 * np.arange(1600)).astype(str)
    rows = [",".join([t, *map(str, acc), "3"]) for t, acc in zip(ns, SIGNAL[:, 3:], strict=True)]
    path.write_text("\n".join(rows) + "\n")


SAVERS = {
    "pyshoe": (save_pyshoe, 200.0),
    "ipyshoe": (save_ipyshoe, 200.0),
    "openshoe": (save_openshoe, 249.75),
    "broad": (save_broad, 200.0),
    "xio": (save_xio, 200.0),
    "gaitmap": (lambda path: write_gaitmap(path, TABLE), 204.8),
    "tremor": (save_tremor, 200.0),
}


@pytest.mark.parametrize("name", SAVERS)
@pytest.mark.parametrize("explicit", [False, True])
def test_the_same_signal_through_each_format_whatever_the_file_is_called(tmp_path, name, explicit):
    save, rate = SAVERS[name]
    suffix = {"pyshoe": ".mat", "ipyshoe": ".mat", "openshoe": ".npz", "broad": ".npz"}.get(name, ".csv")
    save(tmp_path / f"file{suffix}")
    path = (tmp_path / f"file{suffix}").rename(tmp_path / "recording.bin")
    recording = read(path, format=name if explicit else "auto", sensor="right" if name == "gaitmap" else None)
    first = 3 if name == "tremor" else 0
    np.testing.assert_allclose(recording.signal[:, first:], SIGNAL[:, first:], rtol=1e-12, atol=1e-14)
    assert recording.missing[:, :first].all() and not recording.missing[:, first:].any()
    assert 1 / recording.period == pytest.approx(rate, rel=1e-9)


def test_formats_lists_all_of_them():
    assert {*FORMATS} == {"canonical", "robot_arm", *SAVERS}


def test_a_robot_arm_recording_loses_its_placeholder_and_damaged_rates(tmp_path):
    save_robot_arm(tmp_path / "arm.mat")
    arrays = scipy.io.loadmat(tmp_path / "arm.mat")
    arrays["SENSgyro"][0, 501] = 1.7e22
    scipy.io.savemat(tmp_path / "arm.mat", {k: v for k, v in arrays.items() if not k.startswith("__")})
    recording = read(tmp_path / "arm.mat", rate=200.0)
    assert abs(recording.time[0]) < 1e-9 and np.argwhere(recording.missing).tolist() == [[500, 0]]
    assert recording.gyr[500, 0] == pytest.approx((SIGNAL[499, 0] + SIGNAL[501, 0]) / 2)
    assert 1 / read(tmp_path / "arm.mat").period == pytest.approx(100)


# Options.
def test_declared_units_and_sign(tmp_path):
    scaled = TABLE.copy()
    scaled[[*CHANNELS]] *= np.array([180 / np.pi] * 3 + [-1 / G] * 3)
    scaled.to_csv(tmp_path / "a.csv", index=False)
    recording = read(tmp_path / "a.csv", gyr_unit="deg/s", acc_unit="g", negate_acc=True)
    np.testing.assert_allclose(recording.signal, SIGNAL, rtol=1e-13)


@pytest.mark.parametrize("option", ["gyr_unit", "acc_unit", "format"])
def test_an_unknown_choice_is_told_with_the_known_ones(tmp_path, option):
    TABLE.to_csv(tmp_path / "a.csv", index=False)
    with pytest.raises(InputError, match=r"'furlong'.*(rad/s|m/s\^2|canonical)"):
        read(tmp_path / "a.csv", **{option: "furlong"})


def test_rests_and_device_flags_come_along(tmp_path):
    rest, clip = TABLE.index < 150, TABLE.index == 300
    table = TABLE.assign(rest=rest, stance=~rest, clip_gyr_y=clip.astype(int))
    table.to_csv(tmp_path / "a.csv", index=False)
    recording = read(tmp_path / "a.csv")
    assert recording.rest is not None and recording.clipped is not None
    np.testing.assert_array_equal(recording.rest, rest)
    assert np.argwhere(recording.clipped).tolist() == [[300, 1]]
    np.testing.assert_array_equal(read(tmp_path / "a.csv", rest_column="stance").rest, ~rest)
    save_pyshoe(tmp_path / "a.mat")
    assert read(tmp_path / "a.mat").rest is None
    np.testing.assert_array_equal(read(tmp_path / "a.mat", rest_column="zv").rest, TABLE.index < 200)


def test_a_file_without_time_takes_the_rate(tmp_path):
    TABLE.drop(columns="time").to_csv(tmp_path / "a.csv", index=False)
    recording = read(tmp_path / "a.csv", rate=100.0)
    np.testing.assert_allclose(recording.time, np.arange(1600) / 100)


def test_spreadsheet_habits_do_no_harm(tmp_path):
    text = TABLE.to_csv(index=False).replace(",", ", ").replace("\n", "\r\n")
    (tmp_path / "a.csv").write_bytes(b"\xef\xbb\xbf" + (text + "\r\n\r\n").encode())
    np.testing.assert_allclose(read(tmp_path / "a.csv").signal, SIGNAL, rtol=1e-14)


# Time.
def test_empty_cells_are_missing_and_interpolated(tmp_path):
    table = TABLE.copy()
    table.loc[500:502, "gyr_y"] = np.nan
    recording = written(table, tmp_path / "a.csv")
    assert np.argwhere(recording.missing).tolist() == [[500, 1], [501, 1], [502, 1]]
    line = np.interp([500, 501, 502], [499, 503], SIGNAL[[499, 503], 1])
    np.testing.assert_allclose(recording.gyr[500:503, 1], line)
    others = np.setdiff1d(np.arange(1600), [500, 501, 502])
    np.testing.assert_allclose(recording.signal[others], SIGNAL[others], rtol=1e-14)


@pytest.mark.parametrize("lost", [[700], [700, 701, 702], [3, 900, 901], [*range(100, 700)]])
def test_lost_rows_become_missing_samples_and_nothing_else_changes(tmp_path, lost):
    rest = TABLE.index > 650
    recording = written(TABLE.assign(rest=rest).drop(index=lost), tmp_path / "a.csv")
    there = np.setdiff1d(np.arange(1600), lost)
    assert len(recording) == 1600
    np.testing.assert_array_equal(
        recording.missing, np.isin(np.arange(1600), lost)[:, None].repeat(6, axis=1)
    )
    np.testing.assert_allclose(recording.signal[there], SIGNAL[there], rtol=1e-14)
    assert recording.rest is not None
    np.testing.assert_array_equal(recording.rest[there], rest[there])


def test_a_lost_sample_is_missing_and_not_clipped(tmp_path):
    table = TABLE.assign(clip_acc_x=(TABLE.index > 399) & (TABLE.index < 410)).drop(index=405)
    recording = written(table, tmp_path / "a.csv")
    assert recording.clipped is not None
    assert np.flatnonzero(recording.clipped[:, 3]).tolist() == [400, 401, 402, 403, 404, 406, 407, 408, 409]


def test_exact_repeats_are_dropped(tmp_path):
    doubled = TABLE.loc[np.sort(np.r_[np.arange(1600), [10, 10, 800, 1599]])]
    np.testing.assert_allclose(written(doubled, tmp_path / "a.csv").signal, SIGNAL, rtol=1e-14)


@pytest.mark.parametrize("jitter", [0.02, 0.2, 0.45])
@pytest.mark.parametrize("start", [0.0, 1.7e9])
def test_jittered_stamps_leave_the_samples_alone(tmp_path, jitter, start):
    shift = np.random.default_rng(1).uniform(-jitter, jitter, 1600) / 200
    recording = written(TABLE.assign(time=start + TABLE.time + shift), tmp_path / "a.parquet")
    np.testing.assert_array_equal(recording.signal, SIGNAL)
    assert 1 / recording.period == pytest.approx(200, rel=2e-4) and not recording.missing.any()
    assert recording.time[0] == pytest.approx(start, abs=0.0025)


def test_one_late_stamp_loses_and_invents_nothing(tmp_path):
    table = TABLE.copy()
    table.loc[800, "time"] += 0.7 / 200
    recording = written(table, tmp_path / "a.parquet")
    np.testing.assert_array_equal(recording.signal, SIGNAL)


def test_irregular_stamps_are_resampled_and_holes_flagged(tmp_path):
    rng = np.random.default_rng(3)
    time = np.cumsum(rng.uniform(0, 0.05, 2000))
    time[1000:] += 0.5
    truth = np.sin(2 * np.pi * 0.5 * time)
    table = pd.DataFrame({"time": time, **dict.fromkeys(CHANNELS, truth)})
    table.to_csv(tmp_path / "a.csv", index=False)
    for rate, used in ((None, 1999 / (time[-1] - time[0])), (50.0, 50.0)):
        recording = read(tmp_path / "a.csv", rate=rate)
        assert 1 / recording.period == pytest.approx(used)
        away = np.abs(recording.time[:, None] - time[None]).min(axis=1)
        np.testing.assert_array_equal(recording.missing[:, 0], away > 0.75 * recording.period)
        hole = (recording.time > time[999]) & (recording.time < time[1000])
        ripple = 0.05**2 / 8 * np.pi**2  # of linear interpolation over the longest regular step
        error = np.abs(recording.gyr[:, 0] - np.sin(2 * np.pi * 0.5 * recording.time))
        assert error[~hole].max() < 1.01 * ripple


def test_a_declared_rate_within_two_percent_resamples(tmp_path):
    TABLE.to_csv(tmp_path / "a.csv", index=False)
    recording = read(tmp_path / "a.csv", rate=201.0)
    assert 1 / recording.period == pytest.approx(201) and not recording.missing.any()
    expected = np.interp(recording.time, TABLE.time, SIGNAL[:, 5])
    np.testing.assert_allclose(recording.acc[:, 2], expected, atol=1e-9)
    np.testing.assert_allclose(read(tmp_path / "a.csv", rate=200.01).signal, SIGNAL, rtol=1e-14)
    with pytest.raises(InputError, match="205 Hz"):
        read(tmp_path / "a.csv", rate=205.0)


def test_a_slow_clock_is_followed():
    time = np.arange(20_000) / 199.7
    grid = find_grid(time, None, False, "clock")
    assert grid.period == pytest.approx(1 / 199.7) and len(grid.time) == 20_000


def test_a_channel_that_was_never_measured_is_zero_and_missing():
    grid = find_grid(np.arange(10) / 10, None, False, "grid")
    filled, missing = onto_grid(grid, np.array([np.arange(10.0), np.full(10, np.nan)]).T)
    np.testing.assert_allclose(filled, np.array([np.arange(10.0), np.zeros(10)]).T)
    assert missing[:, 1].all() and not missing[:, 0].any()


# Real recordings: rate (Hz), samples, missing rows.
REAL = {
    "xio/short_walk.csv": (398.31, 16578, 244),
    "xio/fusion_sensor_data.csv": (100.00, 13534, 20),
    "openshoe/Measurement_100521_36.npz": (249.75, 16748, 0),
    "openshoe/Measurement_100521_44.npz": (249.75, 12239, 0),
    "ipyshoe/SensorConnectData_31_LLIO.mat": (200.007, 8549, 0),
    "ipyshoe/SensorConnectData_38_LLIO.mat": (200.007, 12000, 0),
    "broad/16_undisturbed_fast_translation_B.npz": (285.714, 53392, 0),
    "robot_arm/V1500_Sequencia3_SENTRAL.mat": (100.0, 1444, 99),
    "robot_arm/V1500_Sequencia4_SENTRAL.mat": (100.0, 825, 60),
}


@pytest.mark.parametrize("name", REAL)
def test_real_recordings_have_their_documented_rate_length_and_units(shared_data, name):
    rate, count, missing = REAL[name]
    recording = read(shared_data / name)
    assert 1 / recording.period == pytest.approx(rate, rel=1e-4)
    assert (len(recording), recording.missing.any(axis=1).sum()) == (count, missing)
    start = recording.time < recording.time[0] + 0.3
    assert 9.4 < np.linalg.norm(recording.acc[start].mean(axis=0)) < 10.2
    assert np.linalg.norm(recording.gyr[start], axis=1).mean() < 0.05
    assert 2 < np.abs(recording.gyr).max() < 30


def test_every_pyshoe_trial_keeps_its_samples_exactly(shared_data):
    paths = sorted((shared_data / "pyshoe").glob("*.mat"))
    assert len(paths) == 26
    for path in paths:
        recording = read(path, rest_column="zv_shoe_opt")
        arrays = scipy.io.loadmat(path)
        np.testing.assert_array_equal(recording.signal, arrays["imu"][:, [3, 4, 5, 0, 1, 2]])
        np.testing.assert_array_equal(recording.rest, arrays["zv_shoe_opt"].ravel() == 1)
        assert 1 / recording.period == pytest.approx(200, rel=5e-5)
        assert np.abs(recording.time - arrays["ts"].ravel()).max() < 0.005


def test_both_feet_of_the_gaitmap_walk(shared_data):
    path = shared_data / "gaitmap/imu_sample_not_rotated.csv"
    for side in ("left", "right"):
        recording = read(path, sensor=f"{side}_sensor")
        assert len(recording) == 7928 and 1 / recording.period == pytest.approx(204.8)
        assert 9.4 < np.linalg.norm(recording.acc[:60].mean(axis=0)) < 10.2
        assert np.rad2deg(np.abs(recording.gyr).max()) < 750
        assert recording.name == f"imu_sample_not_rotated:{side}_sensor"
    with pytest.raises(InputError, match="left_sensor, right_sensor"):
        read(path)


def test_every_broad_and_tremor_file_reads(shared_data):
    for path in (shared_data / "broad").glob("*.npz"):
        assert 1 / read(path).period == pytest.approx(285.714, rel=1e-5)
    paths = [*(shared_data / "tremor").glob("*.csv")]
    assert len(paths) == 4
    for path in paths:
        recording = read(path)
        assert 1 / recording.period == pytest.approx(100, rel=1e-3)
        assert recording.missing[:, :3].all() and not recording.missing[:, 3:].any()
        # Gravity over the whole recording, as the hand moves from the start; in kinetic tremor it never rests.
        top = 11.0 if "KINETIC" in path.name else 10.2
        assert 9.4 < np.median(np.linalg.norm(recording.acc, axis=1)) < top
