"""Whether the ground is level: a real walk as it is, and made to climb by what an accelerometer would have felt."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.config import load_config
from jaxsat.demo import load_walk
from jaxsat.inertial.programs import computing
from jaxsat.pipeline import Estimate, estimate
from jaxsat.preparation import find_ground, prepare
from jaxsat.present.summary import summarise
from jaxsat.saturation.level_ground import ROW
from jaxsat.signals.recording import Recording
from jaxsat.studies.sweep import sweep

FREE = load_config(None, **{"method": "standard", "height.mode": "off"})
LEVEL = load_config(None, method="standard")


@pytest.fixture(scope="module")
def walk() -> Recording:
    return load_walk()[0]


@pytest.fixture(scope="module")
def free(walk) -> Estimate:
    return estimate(walk, FREE)


def climbing(walk: Recording, free: Estimate, rise: Callable[[float, int], float]) -> Recording:
    """The walk with so much climbed (m) in each stride: rise(its length, its number)."""
    segments, position, push = free.segments, free.trajectory.position, np.zeros(len(walk))
    strides = (segments.departure >= 0) & (segments.arrival < len(walk))
    ends = zip(segments.departure[strides], segments.arrival[strides], strict=True)
    for k, (start, stop) in enumerate(ends):
        u = (np.arange(stop - start) + 0.5) / (stop - start)
        length = float(np.linalg.norm(position[stop, :2] - position[start, :2]))
        # From rest to rest: the second derivative of 10 u³ − 15 u⁴ + 6 u⁵.
        bump = 60 * u - 180 * u**2 + 120 * u**3
        push[start:stop] += (bump - bump.mean()) * rise(length, k) / ((stop - start) * walk.period) ** 2
    up = np.stack([0 * push, 0 * push, push], axis=1)
    felt = Rotation.from_quat(free.trajectory.q_nb, scalar_first=True).inv().apply(up)
    return replace(walk, acc=walk.acc + felt, rest=free.rest)


def ground_of(recording: Recording) -> np.ndarray | None:
    with computing():
        return find_ground(prepare(recording, LEVEL), LEVEL)


def arrivals(found: Estimate) -> np.ndarray:
    at = found.segments.arrival
    return at[(at < len(found.recording)) & (found.segments.departure >= 0)]


def test_a_real_walk_is_found_level_and_keeps_its_height(walk, free):
    found = estimate(walk, LEVEL)
    heights, drift = (e.trajectory.position[arrivals(e), 2] for e in (found, free))
    assert found.level and not free.level
    assert heights.std() < 0.02 and np.ptp(heights) < 0.07 < 0.3 < np.ptp(drift)
    assert (summarise(found)["heights"], summarise(free)["heights"]) == ("level", "free")


CLIMBS = {
    "stairs": lambda length, k: 0.34,
    "up and down stairs": lambda length, k: 0.34 * (-1) ** (k // 4),
    "a slope of 2 %": lambda length, k: 0.02 * length,
    "a curb": lambda length, k: 0.17 * (k == 12),
    "a curb, and down again": lambda length, k: 0.17 * ((k == 12) - (k == 16) * 1.0),
}


@pytest.mark.parametrize("climb", CLIMBS)
def test_who_climbs_is_not_flattened(walk, free, climb):
    climber = climbing(walk, free, CLIMBS[climb])
    assert ground_of(climber) is None


def test_without_level_ground_nothing_changes(walk, free):
    climber = climbing(walk, free, CLIMBS["stairs"])
    assumed, told = (estimate(climber, config) for config in (LEVEL, FREE))
    np.testing.assert_array_equal(assumed.trajectory.position, told.trajectory.position)
    at = arrivals(told)
    climbed = told.trajectory.position[at, 2] - free.trajectory.position[at, 2]
    np.testing.assert_allclose(np.diff(climbed), 0.34, atol=0.02)


def test_few_rests_are_not_judged(walk):
    def first(seconds):
        part = walk.time < seconds
        return replace(
            walk, **{name: getattr(walk, name)[part] for name in ("time", "gyr", "acc", "missing")}
        )

    assert len(prepare(first(8.0), LEVEL).segments) < ROW
    assert ground_of(first(8.0)) is None


def test_a_sweep_tells_trials_of_one_program_apart(walk, free):
    climber = replace(climbing(walk, free, CLIMBS["stairs"]), name="climber")
    table = sweep([walk, climber], LEVEL, methods=["standard"])
    for recording in (walk, climber):
        end = table[table["trial"] == recording.name][["end_x", "end_y", "end_z"]].to_numpy(float)[0]
        alone = estimate(recording, LEVEL).trajectory.position
        np.testing.assert_allclose(end, alone[-1], atol=1e-6)
