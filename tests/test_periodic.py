"""Adaptive combiners against their definitions and sinusoids."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shaking import FREQUENCY, RATE, TIME, sensed

from jaxsat.errors import InputError
from jaxsat.inertial.filters import apply, butterworth, response, trapezoid
from jaxsat.inertial.periodic import (
    analytical,
    band,
    bmflc,
    compensated,
    integrated,
    latt_bmflc,
    phases,
    wflc,
)


def test_a_compensated_reference_seen_through_the_filters_is_the_plain_one():
    """Steady state: the chain turns x̂ into x."""
    chain = (butterworth("highpass", 4, 5.0, RATE), butterworth("lowpass", 1, 50.0, RATE))
    time = jnp.asarray(np.arange(4000) / RATE)
    angle = phases(FREQUENCY, time)
    gain = response(chain, FREQUENCY)
    seen = compensated(angle, gain)
    for stage in chain:
        seen = jax.vmap(lambda x, s=stage: apply(s, x), in_axes=1, out_axes=1)(seen)
    plain = compensated(angle, jnp.ones_like(gain))
    np.testing.assert_allclose(seen[3000:], plain[3000:], atol=1e-9)


def test_the_method_of_the_paper_removes_drift_phase_and_gain():
    """Without noise, RMS within 0.5 % of the signal's; without compensation it is wrong by its size."""
    time = np.arange(4000) / RATE
    read, truth = sensed(2, time)
    stage = butterworth("lowpass", 1, 50.0, RATE)
    read = apply(stage, read + 5.0)
    highpass = butterworth("highpass", 4, 5.0, RATE)
    found = latt_bmflc(read, jnp.asarray(time), FREQUENCY, 2, highpass, (stage,), 0.02)
    late = time > 14

    def rms(x):
        return float(jnp.sqrt(jnp.mean(x[late] ** 2)))

    assert rms(found.motion - truth) < 5e-3 * rms(truth)
    assert rms(found.seen - truth) > 0.5 * rms(truth)
    # Analytical integration does not know of the sensor's filter.
    by_analysis = analytical(read, jnp.asarray(time), FREQUENCY, 2, 0.02).motion
    assert 0.1 < rms(by_analysis - truth) / rms(truth) < 0.3


def test_integration_is_a_filter_like_any_other():
    read, _ = sensed(1, TIME)
    highpass = butterworth("highpass", 4, 5.0, RATE)
    found, chain = integrated(read, 1, highpass, 1 / RATE)
    expected = np.concatenate([[read[0] / 2], read[0] / 2 + np.cumsum(read[1:] + read[:-1]) / 2]) / RATE
    np.testing.assert_allclose(apply(trapezoid(1 / RATE), read), expected, atol=1e-12)
    np.testing.assert_allclose(found, apply(highpass, jnp.asarray(expected)), atol=1e-12)
    assert len(chain) == 2


def test_the_wflc_converges_to_the_frequency():
    """From 9 Hz to 10.3 Hz, with its second harmonic, through the filters."""
    time = np.arange(5000) / RATE
    omega = 2 * np.pi * 10.3
    truth = np.sin(omega * time) + 0.3 * np.cos(2 * omega * time)
    stage = butterworth("highpass", 4, 5.0, RATE)
    found = wflc(apply(stage, jnp.asarray(truth)), 1 / RATE, 9.0, 2, (stage,), 0, 0.02, 5e-5)
    assert float(found.frequency[-1, 0]) == pytest.approx(10.3, abs=1e-3)
    np.testing.assert_allclose(found.motion[-200:], truth[-200:], atol=0.01)


def test_the_bmflc_follows_its_definition(key):
    """Three steps by hand."""
    s, time = jax.random.normal(key, (3,)), jnp.asarray(TIME[:3])
    found = bmflc(s, time, FREQUENCY, jnp.ones(3, complex), 0.01)
    w = np.zeros(6)
    for k in range(3):
        angle = 2 * np.pi * np.asarray(FREQUENCY) * k / RATE
        x = np.concatenate([np.sin(angle), np.cos(angle)])
        np.testing.assert_allclose(found.weights[k], w, atol=1e-15)
        assert float(found.motion[k]) == pytest.approx(w @ x, abs=1e-15)
        w = w + 0.02 * (float(s[k]) - w @ x) * x


def test_bands_and_filters_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="band"):
        band(5.0, 4.0, 0.5)
    with pytest.raises(InputError, match="order"):
        butterworth("highpass", 0, 5.0, 100.0)
