"""Gaps filled from their neighbours: known motions, limits that hold, and what is not touched."""

from itertools import pairwise

import numpy as np
import pytest

from jaxsat.saturation.interpolation import interpolate_gaps

PERIOD = 0.005


def motion(seed=0, noise=1e-3):
    """A few sines that peak near 4, on two channels."""
    t = np.arange(1200) * PERIOD
    rng = np.random.default_rng(seed)
    x = np.stack(
        [3 * np.sin(2 * np.pi * 1.7 * t) + np.sin(2 * np.pi * 2.9 * t + 1), 3.5 * np.sin(8 * t)], axis=1
    )
    return x + noise * rng.normal(size=x.shape)


def clipped(x, rail):
    return np.clip(x, -rail, rail), np.where(np.abs(x) >= rail, np.sign(x), 0).astype(int)


@pytest.mark.parametrize("rail", [3.4, 2.5])
def test_peaks_of_a_smooth_motion_come_back(rail):
    x = motion()
    cut, sign = clipped(x, rail)
    filled = interpolate_gaps(cut, sign, PERIOD).signal
    gaps = sign != 0
    assert gaps.mean() > 0.05
    assert np.abs(filled - x)[gaps].max() < 0.15 * np.abs(cut - x)[gaps].max()


def test_measured_values_stay_and_filled_ones_lie_beyond_the_rail():
    cut, sign = clipped(motion(noise=0.05), 2.0)
    filled = interpolate_gaps(cut, sign, PERIOD).signal
    np.testing.assert_array_equal(filled[sign == 0], cut[sign == 0])
    assert np.all((filled * sign)[sign != 0] >= 2.0)


def test_nothing_saturated_is_the_identity_and_everything_is_left():
    x = motion()
    np.testing.assert_array_equal(interpolate_gaps(x, np.zeros(x.shape, int), PERIOD).signal, x)
    full = np.full((100, 1), 2.0)
    np.testing.assert_array_equal(interpolate_gaps(full, np.ones((100, 1), int), PERIOD).signal, full)


def test_gaps_at_the_ends_are_finite():
    cut, sign = clipped(motion(), 2.5)
    inside = np.flatnonzero(sign[:, 1])[3]
    filled = interpolate_gaps(cut[inside:], sign[inside:], PERIOD).signal
    assert sign[inside, 1] != 0 and np.isfinite(filled).all() and np.abs(filled).max() < 12


def test_units_do_not_matter():
    cut, sign = clipped(motion(), 2.5)
    scaled, plain = (interpolate_gaps(scale * cut, sign, PERIOD) for scale in (100, 1))
    np.testing.assert_allclose(scaled.signal, 100 * plain.signal, rtol=1e-3)
    np.testing.assert_allclose(scaled.variance, 1e4 * plain.variance, rtol=1e-2)


def test_the_variance_is_that_of_the_integral_of_a_gap():
    """Random motion of some octaves, not drawn from the process: errors are of the size that is said."""
    rng = np.random.default_rng(3)
    t = np.arange(6000) * PERIOD
    f, phase = rng.uniform(0.3, 4.0, (2, 40)), rng.uniform(0, 2 * np.pi, (2, 40))
    x = np.stack([np.sin(2 * np.pi * f[c] * t[:, None] + phase[c]).sum(axis=1) for c in range(2)], axis=1)
    cut, sign = clipped(x, 5.0)
    found = interpolate_gaps(cut, sign, PERIOD)
    assert np.all((found.variance > 0) == (sign != 0))
    score = []
    for c in range(2):
        edges = np.flatnonzero(np.diff(np.concatenate([[0], sign[:, c], [0]])))
        for i, j in pairwise(edges):
            if sign[i, c]:
                sd = np.sqrt(found.variance[i:j, c].sum())
                score.append((found.signal - x)[i:j, c].sum() / sd)
    assert len(score) > 30 and 0.1 < np.sqrt(np.mean(np.square(score))) < 1.5
