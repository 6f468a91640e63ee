"""Attitude of whole recordings: offsets, starts, fills, and what cannot be done."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat import Recording, orient
from jaxsat.config import load_config
from jaxsat.errors import InputError

RATE, G = 100.0, 9.81


def recording(signal, **changes):
    n = len(signal)
    missing = changes.pop("missing", np.zeros((n, 6), bool))
    return Recording(np.arange(n) / RATE, signal[:, :3], signal[:, 3:], missing, name="trial", **changes)


def simulated(n=600, seed=0):
    """One second at rest, then a turn to and fro about x, noise everywhere."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE
    angle = np.where(t > 1.2, 0.8 * np.sin(2 * np.pi * (t - 1.2)) ** 3, 0.0)
    rate = np.diff(angle, append=0.0) * RATE
    force = Rotation.from_rotvec(np.outer(angle, [1, 0, 0])).inv().apply([0, 0, G])
    signal = np.concatenate([np.outer(rate, [1, 0, 0]), force], axis=1)
    return signal + rng.normal(size=(n, 6)) * np.repeat([1e-3, 1e-2], 3), angle


def test_orient_follows_a_recording_and_takes_its_offset_off():
    signal, angle = simulated()
    signal[:, :3] += [0.05, -0.02, 0.01]
    found = orient(recording(signal))
    np.testing.assert_allclose(found.euler[:, 0], angle, atol=0.02)
    np.testing.assert_allclose(found.start.offset, [0.05, -0.02, 0.01], atol=5e-4)
    assert found.warnings == [] and len(found.after) == len(found.q_nb) == 600


def test_flagged_saturation_of_the_rate_is_filled():
    signal, angle = simulated()
    clipped = np.zeros((600, 6), bool)
    clipped[:, 0] = np.abs(signal[:, 0]) > 4.5
    cut = signal.copy()
    cut[:, 0] = np.clip(cut[:, 0], -4.5, 4.5)
    errors = {}
    for fill in ("none", "interpolate"):
        found = orient(recording(cut, clipped=clipped), load_config(None, **{"orientation.fill": fill}))
        errors[fill] = np.abs(found.euler[:, 0] - angle).max()
        assert [w for w in found.warnings if "gaps in the rates" in w] == []
    assert errors["interpolate"] < 0.5 * errors["none"] and errors["none"] > 0.02


def test_gaps_too_long_to_be_filled_from_their_neighbours_are_said():
    signal, _ = simulated()
    clipped = np.zeros((600, 6), bool)
    clipped[:, 0] = np.abs(signal[:, 0]) > 0.7
    signal[:, 0] = np.clip(signal[:, 0], -0.7, 0.7)
    (warning,) = orient(recording(signal, clipped=clipped)).warnings
    assert "gaps in the rates last longer than 0.1 s" in warning


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda s: recording(s, missing=np.tile([0, 0, 0, 1, 1, 1], (len(s), 1)).astype(bool)),
            "accelerometer",
        ),
        (lambda s: recording(s, missing=np.tile([1, 1, 1, 0, 0, 0], (len(s), 1)).astype(bool)), "gyroscope"),
        (lambda s: recording(s[:90]), "first second"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_sentence(change, says):
    with pytest.raises(InputError, match=says) as error:
        orient(change(simulated()[0]))
    assert "\n" not in str(error.value) and "; " in str(error.value)


@pytest.mark.parametrize("key", ["kp", "ki", "tau", "limit", "gate"])
def test_negative_settings_are_refused(key):
    with pytest.raises(InputError, match=f"orientation.{key}"):
        load_config(None, **{f"orientation.{key}": -1.0})


@pytest.mark.parametrize("estimate", ["pi", "smoothed"])
def test_a_start_in_motion_is_said_and_found_from_what_follows(estimate):
    signal, angle = simulated(1000)
    found = orient(recording(signal[140:]), load_config(None, **{"orientation.estimate": estimate}))
    assert "first second" in found.warnings[-1]
    assert abs(angle[140]) > 0.01 and np.abs(found.euler[:, 0] - angle[140:]).max() < 0.1


def test_an_offset_that_warms_is_read_at_rests_and_is_not_where_it_may_not():
    n = 3000
    signal = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, G], (n, 1))
    signal += np.random.default_rng(4).normal(size=(n, 6)) * np.repeat([1e-3, 1e-2], 3)
    signal[:, :3] += 1e-4 * np.arange(n)[:, None] / RATE
    drift = {
        offset: np.abs(
            orient(recording(signal), load_config(None, **{"orientation.offset": offset})).euler[-1]
        )
        for offset in ("rests", "integral")
    }
    assert drift["rests"].max() < np.deg2rad(0.3) and drift["integral"][2] > np.deg2rad(2)


def test_lost_rates_are_said_where_they_spoil_the_inclination():
    """Gaps of 0.3 s in a fast turn: the sd rises in them, and a warning counts the time."""
    signal, _ = simulated(1000)
    clipped = np.zeros((1000, 6), bool)
    clipped[:, 0] = np.abs(signal[:, 0]) > 0.5
    cut = signal.copy()
    cut[:, 0] = np.clip(signal[:, 0], -0.5, 0.5)
    whole, lost = orient(recording(signal)), orient(recording(cut, clipped=clipped))
    assert lost.sd[300:, 0].mean() > 2 * whole.sd[300:, 0].mean()
    assert whole.sd[0, 1] < whole.sd[-1, 1] < lost.sd[-1, 1]
    assert orient(recording(signal), load_config(None, **{"orientation.estimate": "pi"})).sd is None
