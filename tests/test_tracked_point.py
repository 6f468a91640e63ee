"""The point that motion capture tracks: known levers and lags come back, on a made swing and on a real shoe."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.pipeline import estimate
from jaxsat.signals.readers import read
from jaxsat.studies.metrics import load_pyshoe_truth, position_rmse
from jaxsat.studies.tracked_point import TrackedPoint, find_tracked_point

LEVER, LAG, YAW = np.array([0.03, -0.02, 0.05]), 0.012, 2.5


def swinging(axes) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Time, position and attitude of a sensor that goes ahead and turns to and fro about some of its axes."""
    time = np.arange(0.0, 20.0, 0.01)
    position = np.stack([1.2 * time, 0.2 * np.sin(time), 0.1 * np.cos(5.0 * time)], axis=1)
    angles = np.stack([np.sin(5.0 * time), 0.3 * np.sin(3.0 * time), 0.5 * np.sin(0.7 * time)], axis=1)
    return time, position, Rotation.from_rotvec(angles * np.asarray(axes)).as_quat(scalar_first=True)


def filmed(time, position, q_nb) -> np.ndarray:
    """What cameras of another heading, clock and origin say of the point LEVER away."""
    point = position + Rotation.from_quat(q_nb, scalar_first=True).apply(LEVER)
    late = np.stack([np.interp(time - LAG, time, axis) for axis in point.T], axis=1)
    return Rotation.from_euler("z", YAW).apply(late) + np.array([3.0, 1.0, -2.0])


def test_a_known_lever_and_lag_come_back_from_a_path_that_drifts_and_cameras_that_drop_out():
    time, position, q_nb = swinging([1.0, 1.0, 1.0])
    truth = filmed(time, position, q_nb)
    truth[500:520] = truth[499]
    truth[1200] += 0.5
    drifting = position + 0.01 * time[:, None]
    found = find_tracked_point(time, drifting, q_nb, truth)
    # Drift passes for up to 3 mm in each window.
    np.testing.assert_allclose(found.lever, LEVER, atol=1e-3)
    assert found.lag == pytest.approx(LAG, abs=1e-3)
    # Not in a dropout.
    shown = slice(0, 490)
    assert position_rmse(found.path(time, position, q_nb)[shown], truth[shown]) < 2e-3
    assert position_rmse(position[shown], truth[shown]) > 0.02


def test_what_the_turns_do_not_tell_stays_zero():
    time, position, q_nb = swinging([0.0, 1.0, 0.0])
    found = find_tracked_point(time, position, q_nb, filmed(time, position, q_nb))
    np.testing.assert_allclose(found.lever, [LEVER[0], 0.0, LEVER[2]], atol=1e-3)


def test_a_path_shorter_than_the_window_is_an_error():
    time, position, q_nb = (x[:20] for x in swinging([1.0, 1.0, 1.0]))
    with pytest.raises(InputError, match="longer recording"):
        find_tracked_point(time, position, q_nb, position)


def test_cameras_of_pyshoe_look_at_a_point_above_the_sensor(shared_data):
    """Three trials of one mounting agree to 1 cm on a point 4 to 5 cm above, where their paths fit better."""
    points = []
    for name in ("2017-11-22-11-23-25", "2017-11-22-11-26-46", "2017-11-22-11-48-35"):
        path = shared_data / f"pyshoe/{name}.mat"
        recording = read(path, rest_column="zv_shoe_opt")
        time, truth = load_pyshoe_truth(path, at=recording.time)
        found = estimate(recording, load_config(None, method="standard")).trajectory
        points.append(find_tracked_point(time, found.position, found.q_nb, truth))
        there = points[-1].path(time, found.position, found.q_nb)
        assert position_rmse(there, truth) < 0.8 * position_rmse(found.position, truth)
    levers = np.array([point.lever for point in points])
    assert np.abs(levers - levers.mean(axis=0)).max() < 0.01
    assert -0.05 < levers.mean(axis=0)[2] < -0.035
    assert all(0.0 < point.lag < 0.009 for point in points)


def test_a_point_at_the_sensor_is_its_own_path():
    time, position, q_nb = swinging([1.0, 1.0, 1.0])
    np.testing.assert_array_equal(TrackedPoint(np.zeros(3), 0.0).path(time, position, q_nb), position)
