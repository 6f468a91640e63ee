"""How sure a path says it is, on the bundled real walk: a rest tells a velocity once, and nothing tells a heading."""

import importlib
import sys
from pathlib import Path

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.claims import Doubt, common_errors, with_rests_in_doubt
from jaxsat.config import load_config
from jaxsat.demo import load_walk
from jaxsat.inertial.calibration import Calibration
from jaxsat.inertial.programs import computing
from jaxsat.pipeline import _path, estimate
from jaxsat.preparation import prepare
from jaxsat.present.tables import segments_table
from jaxsat.signals.rests import runs
from jaxsat.studies.tracked_point import find_tracked_point

SCRIPTS = Path(__file__).resolve().parents[1] / "scripts"


@pytest.fixture(scope="module")
def walk():
    """The recording and, at its samples, the truth."""
    recording, time, truth = load_walk()
    return recording, np.stack([np.interp(recording.time, time, axis) for axis in truth.T], axis=1)


@pytest.fixture(scope="module")
def found(walk):
    """With velocities of rests that are white, as the path has them, as by default, and alike for half a second."""
    settings = {"noise.rest_steady": 0.0}, {}, {"noise.rest_steady": 0.5}
    return [estimate(walk[0], load_config(None, method="standard", **given)) for given in settings]


@pytest.fixture(scope="module")
def intervals():
    sys.path.insert(0, str(SCRIPTS))
    try:
        yield importlib.import_module("accuracy_intervals")
    finally:
        sys.path.remove(str(SCRIPTS))


def test_claims_are_wider_and_paths_the_same(found):
    white, _, steady = found
    np.testing.assert_array_equal(steady.trajectory.position, white.trajectory.position)
    np.testing.assert_array_equal(steady.trajectory.q_nb, white.trajectory.q_nb)
    np.testing.assert_array_equal(steady.calibration.constants, white.calibration.constants)
    lengths = np.median(white.segments.rest_end - white.segments.arrival)
    variances = np.median(steady.trajectory.covariance[:, 6, 6] / white.trajectory.covariance[:, 6, 6])
    # A rest of n samples tells a velocity once, not n times.
    assert 4.0 < variances < lengths
    sensed = white.calibration.sd > 0
    assert sensed.sum() == 6 and (steady.calibration.sd > white.calibration.sd)[sensed].all()


def test_a_rest_counts_once_in_each_time_that_its_velocity_stays_alike(walk):
    recording, _ = walk
    config = load_config(None, **{"noise.rest_steady": 0.2, "smoother.lever_sd": 0.1})
    trial = prepare(recording, config).trial
    doubted = np.asarray(with_rests_in_doubt(trial, config).rows.velocity_variance)
    turning = np.sum(trial.signal[:, :3] ** 2, axis=1)
    starts, ends = runs(np.asarray(trial.rows.rest))
    lengths, most = ends - starts, 0.2 / recording.period
    assert lengths.min() < most < lengths.max()
    for start, end in zip(starts, ends, strict=True):
        # Of a long rest so much that the way in it is as uncertain as in 0.2 s.
        times = end - start if end - start < most else most**2 / (end - start)
        expected = max(times, 1.0) * (0.02**2 + 0.1**2 * turning[start:end])
        np.testing.assert_allclose(doubted[start:end], expected, rtol=1e-12)


def errors_of(found, offset=0.0, lever=0.0, height=0.0):
    path, rates = found.trajectory, np.asarray(found.problem.signal)[: len(found.recording), :3]
    common = Doubt(*(np.broadcast_to(np.asarray(x, float), 3) for x in (offset, lever)), np.asarray(height))
    given = path.q_nb, path.position, path.velocity, rates, found.rest, found.recording.period
    return common_errors(*given, common)


def test_an_offset_turns_the_way_as_its_sd_says(walk):
    """Rates that are off by 1 mrad/s about one axis, estimated anew: what rests do not mend is what is predicted."""
    recording, _ = walk
    config = load_config(None, method="standard", **{"smoother.gyr_offset": "none", "height.mode": "off"})
    plain = estimate(recording, config)
    before = Rotation.from_quat(np.roll(plain.trajectory.q_nb, -1, axis=1))
    for axis in range(3):
        offset = 1e-3 * np.eye(3)[axis]
        off = estimate(recording.with_signal(recording.signal + np.append(offset, np.zeros(3))), config)
        turned = (Rotation.from_quat(np.roll(off.trajectory.q_nb, -1, axis=1)) * before.inv()).as_rotvec()
        error = errors_of(plain, offset)[:, :, axis]
        np.testing.assert_allclose(turned[:, 2], error[:, 2], atol=2e-4)
        moved = off.trajectory.position - plain.trajectory.position
        np.testing.assert_allclose(moved, error[:, 3:6], atol=0.01)
        # About the vertical they turn by far more.
        assert axis != 0 or (error[-1, 2] > 0.03 and np.abs(error[:, 3:5]).max() > 0.25)


def test_a_lever_that_is_wrong_moves_the_way_as_its_sd_says(walk):
    """Rests about a point 2 cm away from the one that was found, the path anew."""
    recording, _ = walk
    config = load_config(None, method="standard", **{"height.mode": "off", "smoother.acc_bias_sd": 0.0})
    found = estimate(recording, config)
    n, trial = len(recording), prepare(recording, config).trial
    for axis in range(3):
        constants = np.array(found.calibration.constants)
        constants[6 + axis] += 0.02
        with computing():
            other = trial.calibrated(Calibration(jnp.asarray(constants), jnp.zeros(9)))
            moved = np.asarray(_path(other, config).state.position)[:n] - found.trajectory.position
        predicted = errors_of(found, lever=0.02 * np.eye(3)[axis])[:, 3:6, 3 + axis]
        # Along the axis that moves most; a rest takes its velocity as known to 2 cm/s, not as exact.
        most = np.abs(predicted).max(axis=0).argmax()
        seen, said = -moved[:, most], predicted[:, most]
        assert np.vdot(seen, said) / np.vdot(said, said) == pytest.approx(1.0, abs=0.15)
        np.testing.assert_allclose(-moved, predicted, atol=0.02)
        assert np.abs(said).max() > 0.02


def test_what_is_wrong_all_through_is_in_the_covariance(found):
    steady = found[1]
    path, common = steady.trajectory, steady.doubt
    assert (common.gyr_offset > 0).all() and common.height == 0.01
    np.testing.assert_array_equal(common.lever, steady.calibration.sd[6:])
    errors = errors_of(steady, *common)
    # Any later rest is as much too high as the first was too low.
    assert not errors[0, :6].any() and (errors[len(errors) // 2 :, 5, 6] == 0.01).all()
    left = path.covariance - errors @ errors.swapaxes(1, 2)
    assert np.linalg.eigvalsh(left[::100]).min() > -1e-9
    # Of the heading's variance at the end the offset makes up most.
    assert path.covariance[-1, 2, 2] > 4 * left[-1, 2, 2] > 0
    lengths = [np.median(segments_table(one)["length_sd"]) for one in (steady, without_lever(steady))]
    assert lengths[0] > 1.02 * lengths[1]


def without_lever(found):
    """The same estimate, as sure of its lever as can be."""
    errors = errors_of(found, lever=found.doubt.lever)
    known = found.trajectory.covariance - errors @ errors.swapaxes(1, 2)
    given = known, np.zeros(3)
    return eqx.tree_at(lambda f: (f.trajectory.covariance, f.doubt.lever), found, given)


def test_an_offset_that_is_not_asked_for_is_not_in_doubt(walk):
    config = load_config(None, method="standard", **{"smoother.gyr_offset": "none"})
    assert not estimate(walk[0], config).doubt.gyr_offset.any()


def test_strides_lie_in_their_intervals(walk, found, intervals):
    """Of 31 strides, by motion capture: 58 and 90 % of the lengths, 29 and 65 % if a rest tells its velocity anew
    with each sample."""
    recording, truth = walk
    path = found[1].trajectory
    point = find_tracked_point(recording.time, path.position, path.q_nb, truth)
    held = [
        intervals.summary(pd.DataFrame(intervals.path_held("walk", one, truth, point))).set_index("what")
        for one in found
    ]
    white, steady, _ = (one.loc["lengths"] for one in held)
    assert steady["count"] == 31
    assert steady["within_50"] > 0.45 and 0.85 < steady["within_90"] < 1.0
    assert white["within_50"] < 0.4 and white["within_90"] < 0.75
    white, steady, half = (one.loc["climbs", "within_90"] for one in held)
    assert half > 2 * white and steady > white + 0.3
