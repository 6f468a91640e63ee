"""The search over the segments of a recording: what is passed side by side, and where a sweep begins."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsat.config import load_config
from jaxsat.inertial.programs import computing
from jaxsat.inertial.strapdown import Samples
from jaxsat.pipeline import estimate
from jaxsat.preparation import prepare
from jaxsat.saturation import arrival
from jaxsat.studies.motions import Walk
from jaxsat.studies.simulate import Sensor, simulate

WALK = {"rails.gyr": 6.0, "saturation.gyr_bound": 4.0}


@pytest.fixture(scope="module")
def walk():
    """Eight strides, and three seconds more of rest than between them."""
    motion = Walk(strides=8)
    duration = float(motion.moving[-1, 1]) + 3.0
    recording, truth = simulate(
        motion, rate=100.0, duration=duration, sensor=Sensor(gyr_rail=6.0), key=jax.random.key(1)
    )
    return eqx.tree_at(lambda r: r.rest, recording, truth.rest, is_leaf=lambda x: x is None)


def test_a_long_rest_is_passed_apart_and_says_what_it_says_alone(walk, monkeypatch):
    passed, several = [], arrival._arrivals

    def counted(trial, start, end, longest):
        passed.append(len(start) * int(longest))
        return several(trial, start, end, longest)

    monkeypatch.setattr(arrival, "_arrivals", counted)
    with computing():
        prepared = prepare(walk, load_config(None, **WALK))
        trial, segments = prepared.trial.calibrated(prepared.calibration), prepared.segments
        table = arrival.arrival_table(trial, segments)
        samples = Samples(*map(jnp.asarray, (trial.signal, trial.period, trial.variance)))
        alone = jax.jit(arrival.arrivals)
        lengths = segments.rest_end - segments.arrival
        assert len(lengths) == 8 and lengths[-1] > 5 * lengths[:-1].max()
        for i, length in enumerate(lengths):
            start = jnp.asarray(segments.arrival[i : i + 1])
            expected = np.asarray(alone(samples, trial.rows, start, start + length, length))[0]
            np.testing.assert_allclose(table[i], expected, rtol=1e-9, atol=1e-9 * np.abs(expected).max())
    assert sum(passed) < 0.5 * 8 * lengths[-1]


def test_a_sweep_begins_where_the_one_before_ended(walk):
    one, more = (
        estimate(walk, load_config(None, method="direct", **WALK, **{"saturation.sweeps": sweeps}))
        for sweeps in (1, 4)
    )
    busy = one.fills.status != 2
    assert busy.sum() == 8 and (one.fills.status[busy] == 0).all() and (more.fills.status[busy] == 0).all()
    assert more.fills.iterations[busy].max() <= 2 < one.fills.iterations[busy].max()
    assert more.cost < one.cost < one.cost_standard
