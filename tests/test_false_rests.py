"""A rest in the middle of a motion must not bend the trajectory; a true one must stay."""

from dataclasses import replace

import jax
import numpy as np
import pytest

from jaxsat import Sensor, estimate, load_config, simulate
from jaxsat.preparation import prepare
from jaxsat.studies.motions import Walk

CONFIG = load_config(None, method="standard")


@pytest.fixture(scope="module")
def walk():
    """Five strides with their true rests, and the truth; as long as the walks of test_pipeline, padded."""
    motion = Walk(strides=5)
    recording, truth = simulate(motion, rate=100.0, duration=7.3, sensor=Sensor(), key=jax.random.key(3))
    return replace(recording, rest=truth.rest), truth


def with_false(recording, *centres, length=10):
    rest = recording.rest.copy()
    for centre in centres:
        rest[centre - length // 2 : centre + length // 2] = True
    return replace(recording, rest=rest)


def swings(truth):
    """The middles of the motions."""
    edge = np.diff(truth.rest.astype(int))
    starts, ends = np.flatnonzero(edge == -1) + 1, np.flatnonzero(edge == 1) + 1
    return [(a + b) // 2 for a, b in zip(starts, ends[: len(starts)], strict=False)]


def rms(found, truth):
    return np.sqrt(np.mean(np.sum((found.trajectory.position - truth.position) ** 2, axis=1)))


def test_true_rests_stay(walk):
    recording, truth = walk
    prepared = prepare(recording, CONFIG)
    assert (prepared.rest == truth.rest).all() and not prepared.warnings


@pytest.mark.parametrize("which", [[2], [1, 3], [2, 3]])
def test_false_rests_do_not_bend_the_trajectory(walk, which):
    """They are left out with a warning each, so the path is that without them."""
    recording, truth = walk
    centres = [swings(truth)[i] for i in which]
    assert np.linalg.norm(truth.velocity[centres], axis=1).min() > 1.0
    marked = with_false(recording, *centres)
    found, clean = estimate(marked, CONFIG), estimate(recording, CONFIG)
    assert len(found.warnings) == len(which) and all("is left out" in w for w in found.warnings)
    assert f"{recording.time[centres[0] - 5]:.2f}" in found.warnings[0]
    np.testing.assert_array_equal(found.trajectory.position, clean.trajectory.position)
    assert rms(found, truth) < 0.05


def test_a_wrong_rate_is_not_taken_for_a_false_rest(walk):
    """A glitch contradicts all rests that follow, with and without any of them: none is left out."""
    recording, truth = walk
    gyr = recording.gyr.copy()
    middle = swings(truth)[2]
    gyr[middle : middle + 5, 1] += 10.0
    prepared = prepare(replace(recording, gyr=gyr), CONFIG)
    assert (prepared.rest == truth.rest).all()


def test_saturation_does_not_make_rests_false(walk):
    """What clips is free within its bounds: strides that lose most of their swing keep their rests."""
    recording, truth = walk
    clipped = replace(recording, gyr=np.clip(recording.gyr, -2.0, 2.0))
    prepared = prepare(clipped, load_config(None, **{"method": "standard", "rails.gyr": 2.0}))
    assert (prepared.rest == truth.rest).all() and (prepared.sign != 0).sum() > 100
