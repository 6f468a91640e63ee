"""Least squares on a band: recursion, batch and normal equations, and whether its bands hold."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from shaking import FREQUENCY, RATE, TIME, sensed

from jaxsat.inertial.filters import butterworth, response
from jaxsat.inertial.harmonic import Spectrum, learn, least_squares, predict, recursive
from jaxsat.inertial.periodic import band, chain_response, latt_bmflc, references
from jaxsat.inertial.windows import Windows, harmonics, neighbours, periodogram


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("filtered", [False, True])
def test_least_squares_recovers_sinusoids_to_machine_precision(order, filtered):
    """Through an analogue filter in steady state, beside an offset, from the right frequencies among others."""
    _, truth = sensed(order, TIME)
    sensor = (butterworth("lowpass", 1, 50.0, None),) if filtered else ()
    gain = np.asarray(response(sensor, FREQUENCY))
    angle = TIME[:, None] * 2 * np.pi * np.asarray(FREQUENCY)
    read = 0.2 * (np.abs(gain) * np.sin(angle + np.angle(gain))).sum(axis=1) + 5.0
    frequency = jnp.asarray(band(10.0, 12.0, 0.5))
    x, z = references(frequency, jnp.asarray(TIME), chain_response(sensor, order, frequency))
    spectrum = Spectrum(jnp.full(x.shape[1], 1e4), jnp.asarray(1e-12))
    found, _ = predict(least_squares(jnp.asarray(read), jnp.ones(len(TIME)), x, spectrum), z)
    np.testing.assert_allclose(found, truth, atol=1e-10 * float(jnp.abs(truth).max()))


def problem(key, n=300):
    read, _ = sensed(2, TIME)
    noisy = read[:n] + 0.04 * jax.random.normal(key, (n,)) + 1.0
    x, z = references(FREQUENCY, jnp.asarray(TIME), chain_response((), 2, FREQUENCY))
    return noisy, x[:n], z[:n], Spectrum(jnp.full(x.shape[1], 4.0), jnp.asarray(0.04**2))


def test_the_recursion_ends_at_the_batch_and_at_the_normal_equations(key):
    s, x, z, spectrum = problem(key)
    weight = jnp.asarray(np.arange(len(s)) % 7 != 3, float)
    batch = least_squares(s, weight, x, spectrum)
    tracked = recursive(s, weight, x, z, spectrum, jnp.zeros(x.shape[1]))
    normal = np.asarray((x * weight[:, None]).T @ x) / 0.04**2 + np.eye(x.shape[1]) / 4
    np.testing.assert_allclose(
        batch.weights, np.linalg.solve(normal, x.T @ (weight * s) / 0.04**2), rtol=1e-9
    )
    np.testing.assert_allclose(batch.covariance, np.linalg.inv(normal), rtol=1e-7, atol=1e-14)
    np.testing.assert_allclose(tracked.fit.weights, batch.weights, rtol=1e-8)
    np.testing.assert_allclose(tracked.fit.covariance, batch.covariance, rtol=1e-6, atol=1e-12)
    mean, variance = predict(batch, z)
    assert float(tracked.motion[-1]) == pytest.approx(float(mean[-1]), rel=1e-6)
    assert float(tracked.variance[-1]) == pytest.approx(float(variance[-1]), rel=1e-5)


def test_vmap_equals_the_loop_and_gradients_exist(key):
    s, x, z, spectrum = problem(key)
    rows = jnp.stack([s, 2 * s, s[::-1]])
    ones = jnp.ones(len(s))

    def at_once(row):
        return predict(least_squares(row, ones, x, spectrum), z)[0]

    def paper(row):
        time = jnp.asarray(TIME[: len(s)])
        return latt_bmflc(row, time, FREQUENCY, 2, butterworth("highpass", 4, 5.0, RATE), (), 0.01).motion

    for function in (jax.jit(at_once), jax.jit(paper)):
        together = jax.vmap(function)(rows)
        np.testing.assert_allclose(together, jnp.stack([function(row) for row in rows]), atol=1e-12)

    def cost(noise):
        fit = least_squares(s, ones, x, Spectrum(spectrum.prior, noise))
        return 1e6 * jnp.sum(predict(fit, z)[0] ** 2) + 1e6 * jnp.sum(fit.weights**2)

    cost = jax.jit(cost)
    numeric = (cost(jnp.asarray(0.0016 + 1e-6)) - cost(jnp.asarray(0.0016 - 1e-6))) / 2e-6
    assert float(jax.grad(cost)(jnp.asarray(0.0016))) == pytest.approx(float(numeric), rel=1e-4)

    def gain_cost(mu):
        time = jnp.asarray(TIME[: len(s)])
        found = latt_bmflc(s, time, FREQUENCY, 2, butterworth("highpass", 4, 5.0, RATE), (), mu)
        return jnp.sum((1e3 * found.motion[100:]) ** 2)

    gain_cost = jax.jit(gain_cost)
    numeric = (gain_cost(jnp.asarray(0.01 + 1e-6)) - gain_cost(jnp.asarray(0.01 - 1e-6))) / 2e-6
    assert float(jax.grad(gain_cost)(jnp.asarray(0.01))) == pytest.approx(float(numeric), rel=1e-4)


def test_bands_cover_what_they_say(key):
    """Signals drawn from the model, spectrum learnt from them: 95 % bands hold 93 to 97 % of the motion."""
    rate, n, count = 50.0, 100, 40
    frequency = np.arange(1, 60) / (2 * n)
    density = np.exp(-0.5 * ((frequency * rate - 6) / 1.5) ** 2) + 1e-4
    x = harmonics(np.arange(n, dtype=float), frequency)
    keys = jax.random.split(key, 2)
    w = np.asarray(jax.random.normal(keys[0], (count, 2 * len(frequency)))) * np.sqrt(np.tile(density, 2))
    truth = w @ x[:, :-1].T
    s = truth + 0.7 * np.asarray(jax.random.normal(keys[1], truth.shape))
    power = periodogram(s, frequency)
    start = Spectrum(jnp.asarray(np.concatenate([power, power, [1e-6]])), jnp.asarray(1.0))
    group = jnp.asarray(neighbours(len(frequency), 2))
    ones = jnp.ones(s.shape)
    spectrum = jax.jit(learn, static_argnums=5)(jnp.asarray(s), ones, jnp.asarray(x), group, start, 20)
    assert float(spectrum.noise) == pytest.approx(0.49, rel=0.2)

    @jax.jit
    def band_of(row):
        return predict(least_squares(row, ones[0], jnp.asarray(x), spectrum), jnp.asarray(x))

    inside = []
    for row, true in zip(s, truth, strict=True):
        mean, variance = map(np.asarray, band_of(jnp.asarray(row)))
        inside.append(np.abs(mean - true) < 1.96 * np.sqrt(variance))
    assert 0.93 < np.mean(inside) < 0.97


def test_windows_blend_back_to_the_signal():
    x = np.sin(np.arange(1003.0))
    for length in (100, 777, 1003):
        windows = Windows.cut(len(x), length)
        assert windows.index.min() == 0 and windows.index.max() == 1002
        np.testing.assert_allclose(windows.joined(windows.of(x)), x, atol=1e-12)
