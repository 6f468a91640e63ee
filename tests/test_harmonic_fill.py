"""Gaps of a periodic signal, filled by its harmonics."""

import numpy as np
import pytest

from jaxsat.errors import InputError
from jaxsat.saturation.harmonic_fill import fill_harmonic


def clipped(seconds=8.0, noise=0.02):
    """An amplitude-modulated oscillation of 6 Hz and its harmonic, cut off at ±0.7."""
    time = np.arange(int(seconds * 100)) / 100
    angle = 2 * np.pi * 6 * time + 0.5 * np.sin(time)
    true = (1 + 0.2 * np.sin(0.7 * time)) * np.sin(angle) + 0.1 * np.cos(2 * angle)
    true = true + noise * np.random.default_rng(6).normal(size=len(time))
    return true, np.clip(true, -0.7, 0.7), (true >= 0.7).astype(int) - (true <= -0.7).astype(int)


def test_a_fill_is_beyond_its_rail_near_the_truth_and_within_its_band():
    true, measured, sign = clipped()
    found = fill_harmonic(measured, sign)
    gap = sign != 0
    assert 0.3 < gap.mean() < 0.6
    assert (found.signal == measured)[~gap].all()
    assert (sign * found.signal >= 0.7)[gap].all()
    error = np.sqrt(np.mean((found.signal - true)[gap] ** 2))
    assert error < 0.04 < 0.15 * np.sqrt(np.mean((measured - true)[gap] ** 2)) + 0.02
    assert 0.85 < np.mean(np.abs(found.signal - true)[gap] < 1.96 * found.sd[gap]) <= 1
    # Units and offset do not matter.
    other = fill_harmonic(1e3 * measured - 5.0, sign)
    np.testing.assert_allclose(other.signal, 1e3 * found.signal - 5.0, rtol=1e-6)
    np.testing.assert_allclose(other.sd, 1e3 * found.sd, rtol=1e-5)


def test_a_fill_without_saturation_changes_nothing_and_with_too_much_is_refused():
    _, measured, sign = clipped(2.0)
    assert (fill_harmonic(measured, 0 * sign).signal == measured).all()
    with pytest.raises(InputError, match="too few"):
        fill_harmonic(measured, np.ones_like(sign))


def test_long_recordings_are_filled_where_they_saturate():
    """Two seconds of thirty saturate: some windows are left out, and the fill is as good."""
    true, cut, sign = clipped(30.0)
    time = np.arange(len(true)) / 100
    brief = (time > 12) & (time < 14)
    found = fill_harmonic(np.where(brief, cut, true), np.where(brief, sign, 0))
    gap = brief & (sign != 0)
    assert gap.sum() > 50 and (found.signal == true)[~gap].all()
    error = np.sqrt(np.mean((found.signal - true)[gap] ** 2))
    assert error < 0.15 * np.sqrt(np.mean((cut - true)[gap] ** 2)) + 0.02
    assert np.mean(np.abs(found.signal - true)[gap] < 1.96 * found.sd[gap]) > 0.8
