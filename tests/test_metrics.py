"""Scores: known transforms, invariances, and the real files of motion capture."""

import numpy as np
import pandas as pd
import pytest
import scipy.io
from scipy.optimize import minimize
from scipy.spatial.transform import Rotation

from jaxsat.errors import InputError
from jaxsat.studies.metrics import (
    align_yaw_translation,
    attitude_errors,
    geometric_mean_ratio,
    last_position_error,
    load_broad_truth,
    load_gaitmap_truth,
    load_pyshoe_truth,
    load_truth,
    position_rmse,
    pyshoe_error,
)

TRIAL = "pyshoe/2017-11-22-11-36-45.mat"
YAWS = [-3.1, -1.0, 0.0, 0.5, 2.0, np.pi]


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(20140506)


@pytest.fixture
def walk(rng) -> np.ndarray:
    return np.cumsum(rng.normal(size=(200, 3)), axis=0)


def turned(positions: np.ndarray, yaw: float, shift=(3.0, -2.0, 0.7)) -> np.ndarray:
    return Rotation.from_rotvec([0.0, 0.0, yaw]).apply(positions) + shift


@pytest.mark.parametrize("yaw", YAWS)
def test_alignment_undoes_a_yaw_and_a_translation(walk, yaw):
    np.testing.assert_allclose(align_yaw_translation(turned(walk, yaw), walk), walk, atol=1e-12)
    assert position_rmse(turned(walk, yaw), walk) < 1e-12


def test_alignment_does_not_undo_a_tilt(walk):
    tilted = Rotation.from_rotvec([0.1, 0.0, 0.0]).apply(walk)
    assert position_rmse(tilted, walk) > 0.1


def test_alignment_is_the_least_squares_one(walk, rng):
    estimate = turned(walk, 1.0) + rng.normal(size=walk.shape)

    def cost(p: np.ndarray) -> float:
        return float(((turned(estimate, p[0], p[1:]) - walk) ** 2).sum(axis=1).mean())

    best = minimize(cost, [-0.9, 0.0, 0.0, 0.0], tol=1e-14)
    assert position_rmse(estimate, walk) ** 2 == pytest.approx(best.fun, rel=1e-9)


@pytest.mark.parametrize("score", [position_rmse, pyshoe_error])
@pytest.mark.parametrize("axes", [2, 3])
def test_aligned_scores_do_not_depend_on_heading_and_origin_of_either_side(walk, rng, score, axes):
    estimate = walk + rng.normal(size=walk.shape)
    reference = score(estimate, walk, axes=axes)
    for yaw in YAWS:
        assert score(turned(estimate, yaw), walk, axes=axes) == pytest.approx(reference, rel=1e-12)
        assert score(estimate, turned(walk, yaw), axes=axes) == pytest.approx(reference, rel=1e-12)
    assert score(estimate, walk, axes=axes, align=False) > reference


def test_scores_of_a_hand_made_error():
    truth = np.zeros((2, 3))
    estimate = np.array([[3.0, 4.0, 12.0], [0.0, 0.0, 0.0]])
    assert position_rmse(estimate, truth, align=False) == pytest.approx(13.0 / np.sqrt(2.0))
    assert position_rmse(estimate, truth, axes=2, align=False) == pytest.approx(5.0 / np.sqrt(2.0))
    assert pyshoe_error(estimate, truth, align=False) == pytest.approx(0.5 * 13.0 / np.sqrt(3.0))
    assert pyshoe_error(estimate, truth, axes=2, align=False) == pytest.approx(0.5 * 5.0 / np.sqrt(2.0))
    assert last_position_error(estimate, truth) == 0.0
    assert last_position_error(estimate[::-1], truth) == pytest.approx(13.0)
    assert last_position_error(estimate[::-1], truth, axes=2) == pytest.approx(5.0)


def test_pyshoe_error_is_at_most_the_rmse_per_axis(walk, rng):
    estimate = walk + rng.normal(size=walk.shape)
    assert pyshoe_error(estimate, walk) < position_rmse(estimate, walk) / np.sqrt(3.0)
    assert pyshoe_error(walk + 1.0, walk, align=False) == pytest.approx(1.0)


def test_geometric_mean_of_ratios():
    assert geometric_mean_ratio(np.array([0.5, 2.0]), np.array([1.0, 1.0])) == pytest.approx(1.0)
    assert geometric_mean_ratio(np.array([1.0, 8.0]), np.array([2.0, 4.0])) == pytest.approx(1.0)
    assert geometric_mean_ratio(np.array([0.8]), np.array([1.6])) == pytest.approx(0.5)
    for bad in (np.array([0.0, 1.0]), np.array([np.nan, 1.0])):
        with pytest.raises(InputError, match="positive"):
            geometric_mean_ratio(bad, np.array([1.0, 1.0]))


def test_pyshoe_truth_is_right_handed(shared_data):
    """With the flip, turns seen by the gyroscope (z down) and by Vicon agree; without it they mirror."""
    time, position = load_pyshoe_truth(shared_data / TRIAL)
    trial = scipy.io.loadmat(shared_data / TRIAL)
    assert position.shape == (len(time), 3) and np.all(np.diff(time) > 0)
    assert np.array_equal(position[:, [0, 2]], trial["gt"][:, [0, 2]])
    turning = {"gyroscope": -np.sum(trial["imu"][:, 5] * np.gradient(time))}
    still = trial["zv_vicon_opt"].ravel() > 0
    footholds = np.array(
        [
            position[run, :2].mean(axis=0)
            for run in np.split(np.arange(len(time)), np.flatnonzero(np.diff(still)) + 1)
            if still[run[0]]
        ]
    )
    steps = np.diff(footholds, axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > 0.4]
    heading = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    turning["vicon"] = heading[-1] - heading[0]
    assert abs(turning["gyroscope"]) > np.pi
    assert turning["vicon"] * turning["gyroscope"] > 0


def test_truth_is_interpolated_at_the_asked_times(shared_data):
    time, position = load_pyshoe_truth(shared_data / TRIAL)
    half = 0.5 * (time[:-1] + time[1:])
    at, between = load_pyshoe_truth(shared_data / TRIAL, half)
    assert np.array_equal(at, half)
    np.testing.assert_allclose(between, 0.5 * (position[:-1] + position[1:]), atol=1e-12)
    same = load_pyshoe_truth(shared_data / TRIAL, time)[1]
    np.testing.assert_allclose(same, position, atol=1e-12)
    with pytest.raises(InputError, match="does not cover"):
        load_pyshoe_truth(shared_data / TRIAL, np.array([0.0, time[-1] + 1.0]))


def test_gaitmap_truth_is_a_walk_of_metres_at_100_hertz(shared_data):
    path = shared_data / "gaitmap/mocap_sample.csv"
    time, heel = load_gaitmap_truth(path, ["L_FCC"])
    assert len(time) == 3870 and time[-1] == pytest.approx(38.69)
    # 2 × 20 m: far away, and back.
    distance = np.linalg.norm(heel - heel[0], axis=1)
    assert 18.0 < distance.max() < 22.0 and 0.0 < heel[:, 2].min() < 0.1 and heel[:, 2].max() < 0.5
    _, toe = load_gaitmap_truth(path, ["L_TOE"])
    _, mean = load_gaitmap_truth(path, ["L_FCC", "L_TOE"])
    np.testing.assert_allclose(mean, 0.5 * (heel + toe), atol=1e-12)
    at, positions = load_gaitmap_truth(path, ["L_FCC"], np.arange(7924) / 204.8)
    assert positions.shape == (7924, 3) and len(at) == 7924
    with pytest.raises(InputError, match="choose some of L_TOE"):
        load_gaitmap_truth(path, ["LEFT"])


def test_broad_truth_rotates_as_the_gyroscope_says(shared_data):
    path = shared_data / "broad/02_undisturbed_slow_rotation_B.npz"
    time, q_nb, position, valid = load_broad_truth(path)
    assert len(time) == len(q_nb) == len(position) == len(valid) and 0.9 < valid.mean() < 1.0
    np.testing.assert_allclose(np.linalg.norm(q_nb, axis=1), 1.0, rtol=1e-12)
    assert np.isfinite(position).all()
    # Over eight samples the noise of the differenced attitude is small against the rate.
    R_nb = Rotation.from_quat(q_nb, scalar_first=True)
    turned_by = (R_nb[:-8].inv() * R_nb[8:]).as_rotvec()
    angle = np.cumsum(np.load(path)["imu_gyr"].astype(float), axis=0) * (time[1] - time[0])
    both = valid[8:] & valid[:-8]
    np.testing.assert_allclose(
        turned_by[both].std(axis=0), (angle[8:] - angle[:-8])[both].std(axis=0), rtol=0.03
    )
    for axis in range(3):
        assert np.corrcoef(turned_by[both, axis], (angle[8:] - angle[:-8])[both, axis])[0, 1] > 0.99


def test_files_that_hold_no_truth_are_named(tmp_path):
    wrong = tmp_path / "wrong.mat"
    wrong.write_text("not a trial")
    empty = tmp_path / "empty.mat"
    scipy.io.savemat(empty, {"imu": np.zeros((2, 6))})
    for path in (wrong, empty, tmp_path / "absent.mat"):
        with pytest.raises(InputError, match=path.name):
            load_pyshoe_truth(path)
    for load in (load_broad_truth, lambda path: load_gaitmap_truth(path, ["L_FCC"])):
        for path in (wrong, tmp_path / "absent"):
            with pytest.raises(InputError, match=path.name):
                load(path)


@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
def test_the_truth_of_a_recording_lies_beside_it(tmp_path, walk, suffix):
    time, names = np.arange(len(walk)) / 50.0, ["pos_x", "pos_y", "pos_z"]
    table = pd.DataFrame(walk, columns=names).assign(time=time)
    # Untracked positions are left out.
    table.loc[20:29, "pos_y"] = np.nan
    path = tmp_path / f"walk_truth{suffix}"
    table.to_csv(path, index=False) if suffix == ".csv" else table.to_parquet(path)
    at, position = load_truth(tmp_path / "walk.csv")
    np.testing.assert_allclose(position, np.delete(walk, slice(20, 30), axis=0))
    np.testing.assert_allclose(at, np.delete(time, slice(20, 30)))


@pytest.mark.parametrize(
    ("text", "sentence"),
    [
        ("time,pos_x,pos_y\n0,1,2\n1,2,3\n", "no truth"),
        ("time,pos_x,pos_y,pos_z\n0,1,2,lost\n1,2,3,lost\n", "no truth"),
        ("time,pos_x,pos_y,pos_z\n0,1,2,3\n", "fewer than two"),
        ("time,pos_x,pos_y,pos_z\n1,1,2,3\n0,1,2,3\n", "time does not increase"),
        ("", "no truth"),
    ],
)
def test_a_truth_that_is_none_is_named(tmp_path, text, sentence):
    (tmp_path / "walk_truth.csv").write_text(text)
    with pytest.raises(InputError, match=f"walk_truth.csv: .*{sentence}"):
        load_truth(tmp_path / "walk.csv")
    with pytest.raises(InputError, match=r"run.csv: no truth beside it; .* run_truth.csv"):
        load_truth(tmp_path / "run.csv")


def test_attitude_errors_are_those_that_were_put_in():
    truth = Rotation.random(200, random_state=1)
    heading, inclination = 0.3, 0.05
    error = Rotation.from_rotvec([0, 0, heading]) * Rotation.from_rotvec([inclination, 0, 0])
    found = (error * truth).as_quat()[:, [3, 0, 1, 2]]
    expected = truth.as_quat()[:, [3, 0, 1, 2]]
    scored = np.ones(200, bool)
    raw = attitude_errors(found, expected, scored, align=False)
    assert raw.heading == pytest.approx(heading) and raw.inclination == pytest.approx(inclination)
    assert raw.total == pytest.approx(error.magnitude())
    aligned = attitude_errors(-found, expected, scored)
    assert aligned.heading == pytest.approx(0, abs=1e-9) and aligned.total == pytest.approx(inclination)
    scored[:100], found[:100] = False, [1.0, 0.0, 0.0, 0.0]
    assert attitude_errors(found, expected, scored, align=False).inclination == pytest.approx(inclination)
