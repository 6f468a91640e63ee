"""How sure a path says it is, on the bundled real walk: a rest tells a velocity once, not once a sample."""

import importlib
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from jaxsat.config import load_config
from jaxsat.demo import load_walk
from jaxsat.pipeline import estimate
from jaxsat.preparation import prepare, with_rests_in_doubt
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
    """With velocities of rests that are white, as the path has them, and that stay alike."""
    return [
        estimate(walk[0], load_config(None, method="standard", **{"noise.rest_steady": steady}))
        for steady in (0.0, 0.5)
    ]


@pytest.fixture(scope="module")
def intervals():
    sys.path.insert(0, str(SCRIPTS))
    try:
        yield importlib.import_module("accuracy_intervals")
    finally:
        sys.path.remove(str(SCRIPTS))


def test_claims_are_wider_and_paths_the_same(found):
    white, steady = found
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
        expected = min(end - start, most) * (0.02**2 + 0.1**2 * turning[start:end])
        np.testing.assert_allclose(doubted[start:end], expected, rtol=1e-12)


def test_strides_lie_in_their_intervals(walk, found, intervals):
    """Of 31 strides, by motion capture: 68 and 94 % of the lengths, 29 and 65 % if a rest tells its velocity anew
    with each sample."""
    recording, truth = walk
    path = found[1].trajectory
    point = find_tracked_point(recording.time, path.position, path.q_nb, truth)
    held = [
        intervals.summary(pd.DataFrame(intervals.strides_held("walk", one, truth, point))).set_index("what")
        for one in found
    ]
    white, steady = (one.loc["lengths"] for one in held)
    assert steady["count"] == 31
    assert steady["within_50"] > 0.45 and 0.85 < steady["within_90"] < 1.0
    assert white["within_50"] < 0.4 and white["within_90"] < 0.75
    assert held[1].loc["climbs", "within_90"] > 2 * held[0].loc["climbs", "within_90"]
