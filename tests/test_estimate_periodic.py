"""Periodic motion of whole recordings: a shaken sensor by every method, bands, and what cannot be done."""

import numpy as np
import pytest
from shaking import recording, shaken

from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.periodic import estimate_periodic


@pytest.mark.parametrize("method", ["least_squares", "recursive", "bmflc", "wflc"])
def test_a_shaken_sensor_without_gyroscope(method):
    position, _, acc, _ = shaken()
    options = {"periodic.method": method, "periodic.band": (5.0, 7.0)}
    if method in ("bmflc", "wflc"):
        options |= {"periodic.mu": 0.02}
    found = estimate_periodic(recording(acc), load_config(None, **options))
    late = slice(300, 570)
    error = np.sqrt(np.mean((found.motion[late, 3] - position[late]) ** 2))
    assert error < {"least_squares": 2e-5, "recursive": 5e-5, "wflc": 8e-5, "bmflc": 2e-4}[method]
    assert (found.motion[:, :3] == 0).all() and list(found.band) == ["acc"]
    assert (found.sd is None) == (method in ("bmflc", "wflc"))
    if found.sd is not None:
        # The sd is that of noise and spectrum: right to its order.
        assert 0.3 * error < np.median(found.sd[late, 3]) < 15 * error


def test_tilting_gravity_is_taken_off_where_there_is_a_gyroscope():
    position, angle, acc, gyr = shaken(tilt=0.02)
    config = load_config(None, **{"periodic.band": (5.0, 7.0)})
    both = estimate_periodic(recording(acc, gyr), config)
    alone = estimate_periodic(recording(acc), config)
    late = slice(100, 500)
    np.testing.assert_allclose(both.motion[late, 1], angle[late], atol=5e-4)
    np.testing.assert_allclose(both.motion[late, 3], position[late], atol=2e-4)
    assert np.sqrt(np.mean((alone.motion[late, 3] - position[late]) ** 2)) > 0.09e-3
    assert "no angle from a gyroscope" in alone.warnings[0] and not both.warnings


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"periodic.band": (5.0, 60.0)}, "half of its rate"),
        ({"periodic.band": (7.0, 5.0)}, "LOW < HIGH"),
        ({"periodic.band": (0.1, 7.0)}, "less than one period"),
        (
            {"periodic.band": (5.0, 7.0), "periodic.method": "bmflc", "periodic.highpass": 80.0},
            "half of the samp",
        ),
        ({"periodic.band": (5.0, 7.0), "periodic.method": "bmflc", "periodic.mu": 0.5}, "does not converge"),
        ({"periodic.band": (5.0, 7.0), "periodic.sensor_lowpass": -3.0}, "positive frequency"),
    ],
)
def test_what_cannot_be_is_one_sentence(options, words):
    _, _, acc, _ = shaken()
    with pytest.raises(InputError, match=words) as raised:
        estimate_periodic(recording(acc), load_config(None, **options))
    assert "\n" not in str(raised.value) and ";" in str(raised.value)


def test_a_fast_recording_is_fitted_in_blocks_as_well():
    """At 1000 Hz, seven samples a block, a lost one here and there: gain and phase of the means are accounted for."""
    position, _, acc, _ = shaken(rate=1000.0, seconds=4.0)
    measured = recording(acc, rate=1000.0, seconds=4.0)
    measured.missing[::50, 3:] = True
    measured.acc[::50] = 0.0
    found = estimate_periodic(measured, load_config(None, **{"periodic.band": (5.0, 7.0)}))
    late = slice(500, 3500)
    error = np.sqrt(np.mean((found.motion[late, 3] - position[late]) ** 2))
    assert error < 2e-5 and 0.3 * error < np.median(found.sd[late, 3]) < 15 * error
