"""Linear filters and their responses, against scipy and printed values."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy import signal

from jaxsat.inertial.filters import apply, butterworth, response

RATE = 250.0
FREQUENCY = jnp.array([10.0, 11.0, 11.5])


@pytest.mark.parametrize(("kind", "order", "cutoff"), [("highpass", 4, 5.0), ("lowpass", 1, 50.0)])
def test_digital_filters_are_those_of_scipy(kind, order, cutoff, key):
    x = jax.random.normal(key, (500,))
    sections = signal.butter(order, cutoff, kind, fs=RATE, output="sos")
    stage = butterworth(kind, order, cutoff, RATE)
    np.testing.assert_allclose(apply(stage, x), signal.sosfilt(sections, x), rtol=1e-9, atol=1e-12)
    expected = signal.sosfreqz(sections, np.asarray(FREQUENCY), fs=RATE)[1]
    np.testing.assert_allclose(response((stage,), FREQUENCY), expected, rtol=1e-12)


@pytest.mark.parametrize(("kind", "order"), [("lowpass", 1), ("lowpass", 4), ("highpass", 3)])
def test_analogue_responses_are_those_of_scipy(kind, order):
    polynomials = signal.butter(order, 2 * np.pi * 30, kind, analog=True)
    expected = signal.freqs(*polynomials, 2 * np.pi * np.asarray(FREQUENCY))[1]
    stage = butterworth(kind, order, 30.0, None)
    np.testing.assert_allclose(response((stage,), FREQUENCY), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="analogue"):
        apply(stage, jnp.ones(5))


def test_the_printed_gain_and_phase_of_the_low_pass_belong_to_250_hz():
    """Latt et al. 2011 print 0.9852 and −9.86° for its filter at 10 Hz, 0.9981 for the high-pass."""
    low = complex(response((butterworth("lowpass", 1, 50.0, RATE),), jnp.array(10.0)))
    assert abs(low) == pytest.approx(0.9852, abs=5e-5)
    assert np.rad2deg(np.angle(low)) == pytest.approx(-9.86, abs=5e-3)
    high = complex(response((butterworth("highpass", 4, 5.0, RATE),), jnp.array(10.0)))
    assert abs(high) == pytest.approx(0.9981, abs=5e-5)
