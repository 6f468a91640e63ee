"""Checks: every fault in one sentence, no complaint about healthy or merely clipped recordings."""

import equinox as eqx
import numpy as np
import pytest
from corruptions import CORRUPTIONS, healthy
from scipy.spatial.transform import Rotation

from jaxsat.errors import InputError
from jaxsat.signals.checks import attitudes, check, find_still, spurious_accelerations
from jaxsat.signals.readers import read
from jaxsat.signals.recording import CHANNELS, Recording

OPTIONS = {"--rests": "rest_column", "--gyr-unit": "gyr_unit", "--acc-unit": "acc_unit"}
FOOT = [
    *("xio/short_walk.csv", "openshoe/Measurement_100521_36.npz", "openshoe/Measurement_100521_44.npz"),
    *("ipyshoe/SensorConnectData_31_LLIO.mat", "ipyshoe/SensorConnectData_38_LLIO.mat"),
]


def arguments(extra: list[str]) -> dict[str, str | float]:
    pairs = zip(extra[::2], extra[1::2], strict=True)
    named = {OPTIONS.get(option, option.removeprefix("--")): value for option, value in pairs}
    return {name: float(value) if name == "rate" else value for name, value in named.items()}


def good() -> Recording:
    table = healthy()
    gyr, acc = table[[*CHANNELS[:3]]].to_numpy(), table[[*CHANNELS[3:]]].to_numpy()
    missing = np.zeros((len(gyr), 6), dtype=bool)
    return Recording(time=table.time.to_numpy(), gyr=gyr, acc=acc, missing=missing, name="good")


def foot(shared_data) -> list[Recording]:
    paths = [shared_data / name for name in FOOT] + sorted((shared_data / "pyshoe").glob("*.mat"))
    walk = shared_data / "gaitmap/imu_sample_not_rotated.csv"
    return [read(path) for path in paths] + [
        read(walk, sensor=f"{side}_sensor") for side in ("left", "right")
    ]


def changed(recording: Recording, gyr=None, acc=None, period=1.0) -> Recording:
    gyr, acc = recording.gyr if gyr is None else gyr, recording.acc if acc is None else acc
    return eqx.tree_at(lambda r: (r.gyr, r.acc, r.time), recording, (gyr, acc, recording.time * period))


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_each_corruption_is_told_in_one_sentence(name, tmp_path):
    path, extra = CORRUPTIONS[name](tmp_path)
    with pytest.raises(InputError) as caught:
        check(read(path, **arguments(extra)))
    message = str(caught.value)
    assert "\n" not in message and len(message) < 800
    assert message.endswith(".") and ". " not in message.replace("save(..., ", "")
    if name != "negative_rate":
        assert path.stem in message


SAYS = {
    "text_in_cell": ("line 202", "gyr_x", "overrun"),
    "infinite_cell": ("line 202", "gyr_x", "inf"),
    "ragged_line": ("line 301",),
    "time_empty": ("line 702",),
    "time_jumps_back": ("line 803", "4", "2.005"),
    "time_stands_still": ("line 3",),
    "missing_column": ("'acc_y'",),
    "misspelt_column": ("'gyr_z'", "'gyro_z'"),
    "repeated_column": ("'gyr_x'",),
    "semicolons": ("commas",),
    "no_header": ("line 1",),
    "absent_rest_column": ("'stance'", "'stand'"),
    "rest_not_a_flag": ("line 4", "'rest'"),
    "two_sensors_none_named": ("left, right", "--sensor"),
    "sensor_misspelt": ("'letf'", "'left'"),
    "rate_against_time": ("100 Hz", "200 Hz"),
    "wrong_rate_without_time": ("200 Hz than at 100 Hz",),
    "no_time_no_rate": ("--rate",),
    "time_in_milliseconds": ("0.2 Hz", "seconds"),
    "acc_in_g": ("--acc-unit g",),
    "acc_not_in_g": ("--acc-unit m/s^2",),
    "gyr_in_degrees": ("--gyr-unit deg/s",),
    "gyr_not_in_degrees": ("--gyr-unit rad/s",),
    "swapped_sensors": ("swap",),
    "gravity_removed": ("gravity",),
    "stuck_channel": ("gyr_x", "never changes"),
    "integer_overflow": ("gyr_y", "overflow"),
    "channel_missing": ("all of gyr_z",),
    "mostly_missing": ("67% of acc_x",),
    "missing_at_the_start": ("gyr_x", "0.025 s"),
}


@pytest.mark.parametrize("name", SAYS)
def test_the_sentence_names_place_and_remedy(name, tmp_path):
    path, extra = CORRUPTIONS[name](tmp_path)
    with pytest.raises(InputError) as caught:
        check(read(path, **arguments(extra)))
    for words in SAYS[name]:
        assert words in str(caught.value)


def test_a_healthy_recording_passes_without_a_word():
    assert check(good()) == []


def test_a_noiseless_recording_and_one_at_rest_pass():
    still = changed(good(), np.zeros((1600, 3)), np.tile([0.0, 0.0, 9.80665], (1600, 1)))
    assert check(still) == []


def test_warnings_for_missing_samples_and_for_gravity():
    recording = good()
    missing = recording.missing.copy()
    missing[500:507, 2] = True
    recording = eqx.tree_at(lambda r: (r.missing, r.acc), recording, (missing, recording.acc * 1.05))
    first, second = check(recording)
    assert "7 samples are missing" in first and "2.5 s" in first
    assert "5.0% off gravity" in second


def test_a_start_in_motion_is_a_warning():
    keep = good().time > 1.3
    cut = eqx.tree_at(lambda r: (r.time, r.gyr, r.acc, r.missing), good(), replace_fn=lambda x: x[keep])
    (warning,) = check(cut)
    assert "moves in the first 0.2 s" in warning and warning.endswith(".")


@pytest.mark.parametrize("place", [0, 1, 700, 1599])
def test_a_recording_made_by_hand_must_be_finite_and_uniform(place):
    acc = good().acc.copy()
    acc[place, 1] = np.nan
    with pytest.raises(InputError, match="acc_y"):
        check(changed(good(), acc=acc))
    time = good().time.copy()
    time[place] += 0.002
    with pytest.raises(InputError, match="uniform"):
        check(eqx.tree_at(lambda r: r.time, good(), time))


@pytest.mark.parametrize("count", [1, 2, 15, 16, 17, 1000])
def test_attitudes_equal_the_running_product(count):
    turns = np.random.default_rng(count).normal(size=(count, 3))
    expected, R = [], Rotation.identity()
    for turn in turns:
        expected.append(R.as_matrix())
        R = R * Rotation.from_rotvec(turn)
    for q, scale in zip(attitudes(np.stack([turns, 0.0 * turns])), (1.0, 0.0), strict=True):
        wanted = expected if scale else np.broadcast_to(np.eye(3), (count, 3, 3))
        np.testing.assert_allclose(Rotation.from_quat(q).as_matrix(), wanted, atol=1e-12)


def test_spurious_acceleration_vanishes_only_at_the_true_scale():
    recording = good()
    still = find_still(recording)
    scales = np.array([0.0, 0.5, 0.7, 1.0, 1.4, 2.0])
    sizes = spurious_accelerations(recording, still, scales)
    assert sizes is not None and sizes[scales == 1.0] < 0.15 and (sizes[scales != 1.0] > 0.8).all()


def test_without_two_still_phases_units_are_not_judged():
    recording = good()
    assert spurious_accelerations(recording, np.zeros(1600, dtype=bool), np.ones(1)) is None


@pytest.mark.parametrize("limit", [3.0, 4.5, 6.0])
def test_clipping_is_no_overflow(limit):
    gyr = good().gyr
    assert np.abs(gyr).max() > 6.2
    check(changed(good(), gyr=np.clip(gyr, -limit, limit)))


IMPACTS = {
    "ringing": [40.0, 80.0, -80.0, -60.0, 70.0, 20.0],
    "clipped at both ends": [60.0, 80.0, 80.0, -80.0, -80.0, -80.0, -80.0, 80.0, 80.0, 40.0],
    "a spike of one sample": [40.0, 80.0, -80.0, 78.0, 20.0],
}


@pytest.mark.parametrize("name", IMPACTS)
def test_an_impact_that_jumps_through_the_range_is_no_overflow(name):
    acc = good().acc.copy()
    acc[400 : 400 + len(IMPACTS[name]), 0] = IMPACTS[name]
    check(changed(good(), acc=acc))


def test_a_heavily_clipped_rotation_is_not_taken_for_degrees(shared_data):
    recording = read(shared_data / "broad/07_undisturbed_fast_rotation_B.npz")
    limit = np.abs(recording.gyr).max() / 2
    check(changed(recording, gyr=np.clip(recording.gyr, -limit, limit)))


def test_real_foot_recordings_pass(shared_data):
    for recording in foot(shared_data):
        warnings = check(recording)
        assert len(warnings) == (1 if recording.missing.any() else 0), warnings


def test_other_real_recordings_pass_unless_they_lack_a_gyroscope(shared_data):
    others = [*(shared_data / "broad").glob("*.npz"), *(shared_data / "robot_arm").glob("*.mat")]
    for path in [*others, shared_data / "xio/fusion_sensor_data.csv"]:
        check(read(path))
    for path in (shared_data / "tremor").glob("*.csv"):
        with pytest.raises(InputError, match="all of gyr_x"):
            check(read(path))


@pytest.mark.slow
def test_wrong_units_and_rates_of_real_foot_recordings_are_found(shared_data):
    rates_found = 0
    for recording in foot(shared_data):
        wrong = {
            "--gyr-unit deg/s": changed(recording, gyr=np.rad2deg(recording.gyr)),
            "--gyr-unit rad/s": changed(recording, gyr=np.deg2rad(recording.gyr)),
            "--acc-unit g": changed(recording, acc=recording.acc / 9.80665),
            "swap": changed(recording, recording.acc, recording.gyr),
        }
        for words, bad in wrong.items():
            with pytest.raises(InputError, match=words.replace("^", r"\^")):
                check(bad)
        try:
            check(changed(recording, period=2.0))
        except InputError as error:
            rates_found += "Hz than at" in str(error)
    assert rates_found >= 31  # of 33: the two slow crawls hardly turn


@pytest.mark.slow
def test_real_foot_recordings_clipped_in_software_still_pass(shared_data):
    for recording in foot(shared_data):
        top, bump = np.abs(recording.gyr).max(), np.abs(recording.acc).max()
        for share in (0.3, 0.5, 0.8):
            check(changed(recording, gyr=np.clip(recording.gyr, -share * top, share * top)))
            limit = max(share * bump, 19.6)  # no accelerometer has a range below 2 g
            check(changed(recording, acc=np.clip(recording.acc, -limit, limit)))
