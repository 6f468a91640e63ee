"""The Good Gain method against loops whose response is known."""

import numpy as np
import pytest

from jaxsat.inertial.good_gain import STEP, good_gain

RATE = 100.0
REST = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, 9.81], (100, 1))


def test_good_gain_of_a_loop_with_a_low_pass_is_well_damped():
    """A pure integrator with a first-order lag: ζ = 1/√(2 kp tau), overshoot M = exp(-πζ/√(1-ζ²)), undershoot M²."""
    for tau in (0.5, 2.0):
        proposed = good_gain(REST, 1 / RATE, tau)
        k_gg = float(proposed.kp) / 0.8
        damping = 1 / np.sqrt(2 * k_gg * tau)
        overshoot = np.exp(-np.pi * damping / np.sqrt(1 - damping**2))
        assert 0.05 < overshoot < 0.09 and overshoot**2 == pytest.approx(0.005, rel=0.3)
        half_period = np.pi / np.sqrt(0.5 * k_gg / tau - 0.25 / tau**2)
        assert float(proposed.kp / proposed.ki) == pytest.approx(1.5 * half_period, rel=0.05)
    assert STEP < 0.2


def test_good_gain_without_a_low_pass_corrects_most_of_the_error_at_each_sample():
    proposed = good_gain(REST, 1 / RATE)
    assert 0.5 < 0.5 * float(proposed.kp) / RATE < 1.2
