"""Parameters by gradient: what lowers a loss is found; losses are those of the smoother and of a dense Gaussian."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsat.config import Config, Noise, Smoother, config_toml, load_config
from jaxsat.errors import InputError
from jaxsat.inertial.orientation import Gains, Start
from jaxsat.inertial.strapdown import error_transition, sample_intervals, sample_noise, strapdown
from jaxsat.pipeline import estimate
from jaxsat.signals.recording import Recording
from jaxsat.studies.metrics import position_rmse
from jaxsat.studies.motions import Walk
from jaxsat.studies.simulate import Sensor, simulate
from jaxsat.studies.tracked_point import TrackedPoint
from jaxsat.studies.tuning import (
    Trials,
    inclination_loss,
    noise_trial,
    position_loss,
    rest_misfit,
    tune_gains,
    tune_noise,
    value_and_gradient,
)

RATE, G = 100.0, 9.81
LEVEL = Start(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.asarray(G))
TRUE = Noise(gyr_density=2e-3, acc_density=2e-2, change=0.0, rest_velocity_sd=5e-3)
STANDARD = Config(method="standard")
KNOWN = Smoother(gyr_offset="none", acc_bias_sd=0.0, lever_sd=0.0)
"""Sensors without offsets, that rest where they are."""


def of(noise: Noise) -> jax.Array:
    return jnp.asarray([noise.gyr_density, noise.acc_density, noise.rest_velocity_sd])


def test_tuning_finds_what_lowers_the_loss_and_its_gradient_is_right(key):
    n = 1500
    signal = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, G], (n, 1))
    signal += np.repeat([0.002, 1.0], 3) * np.asarray(jax.random.normal(key, (n, 6)))
    signal[:, 0] += 0.01
    trials = Trials(
        jnp.asarray(signal)[None],
        jnp.full((1, n), 1 / RATE),
        jnp.ones((1, n, 2), bool),
        jax.tree.map(lambda x: x[None], LEVEL),
        jnp.tile(jnp.array([0.0, 0.0, 1.0]), (1, n, 1)),
        jnp.ones((1, n), bool),
    )
    first = Gains(0.02, 1e-3, 0.1)
    tuned = tune_gains(trials, first, steps=25, rate=0.4)
    assert inclination_loss(trials, tuned) < 0.3 * inclination_loss(trials, first)
    assert float(tuned.kp) > 0.1


@pytest.fixture(scope="module")
def walk():
    """A walk of 16 strides as the smoother's model has it: white noise of `TRUE`, and velocities of rests too."""
    key, rng = jax.random.key(3), np.random.default_rng(3)
    sensor = Sensor(gyr_density=TRUE.gyr_density, acc_density=TRUE.acc_density)
    recording, truth = simulate(Walk(strides=16), rate=RATE, duration=21.0, sensor=sensor, key=key)
    # Specific force that gives each resting state its own velocity, and takes it away again.
    velocity = TRUE.rest_velocity_sd * rng.normal(size=(len(recording), 3)) * truth.rest[:, None]
    force = np.diff(velocity, axis=0, append=0.0) * RATE
    shaken = recording.with_signal(recording.signal + np.concatenate([0.0 * force, force], axis=1))
    shaken = eqx.tree_at(lambda r: r.rest, shaken, truth.rest, is_leaf=lambda x: x is None)
    return shaken, (truth.time, truth.position)


def test_the_misfit_is_that_of_one_dense_gaussian():
    """Still but for noise, where the filter is linear: −log p of all velocities of the rests at once."""
    n, rng = 60, np.random.default_rng(0)
    axes = (1.0, 2.0, 0.5, 1.0, 3.0, 1.0)
    densities = {"gyr_density": 3e-5, "acc_density": 2e-4, "axes": axes, "change": 0.0}
    noise = Noise(**densities, rest_velocity_sd=1e-4, initial_tilt_sd=1e-5)
    rest = np.ones(n, bool)
    rest[10:30] = rest[40:55] = False
    sd = np.array(noise.densities) * np.sqrt(RATE)
    signal = [0.0, 0.0, 0.0, 0.0, 0.0, G] + sd * rng.normal(size=(n, 6))
    time, missing = np.arange(n) / RATE, np.zeros((n, 6), bool)
    recording = Recording(time, signal[:, :3], signal[:, 3:], missing, rest)
    trial = noise_trial(recording, Config(noise=noise, gravity=G, smoother=KNOWN))
    samples, _, prior, covariance, gravity = trial.problem(of(noise))
    np.testing.assert_allclose(samples.variance[:n], np.repeat(sd[None] ** 2, n, axis=0))
    reference = strapdown(samples.signal, samples.period, prior, gravity)
    at = reference.q_nb[:-1]
    intervals = sample_intervals(samples.signal, samples.period)
    transitions = jax.vmap(lambda q, i: error_transition(q, i).forth(jnp.eye(9)))(at, intervals)
    noises = jax.vmap(sample_noise)(at, samples.signal, samples.period, samples.variance)
    C = np.zeros((9 * n, 9 * n))
    C[:9, :9] = covariance
    for k in range(n - 1):
        here, there, past = slice(9 * k, 9 * k + 9), slice(9 * k + 9, 9 * k + 18), slice(0, 9 * k + 9)
        C[there, past] = transitions[k] @ C[here, past]
        C[past, there] = C[there, past].T
        C[there, there] = transitions[k] @ C[here, here] @ transitions[k].T + noises[k]
    seen = np.concatenate([9 * k + np.arange(6, 9) for k in np.flatnonzero(rest)])
    S = C[np.ix_(seen, seen)] + noise.rest_velocity_sd**2 * np.eye(len(seen))
    away = np.asarray(reference.velocity)[:n][rest].ravel()
    expected = 0.5 * away @ np.linalg.solve(S, away) + 0.5 * np.linalg.slogdet(S)[1]
    assert float(rest_misfit(trial, of(noise))) == pytest.approx(expected, rel=1e-5)


def test_the_position_loss_is_the_error_of_the_estimate_with_that_noise(walk):
    recording, truth = walk
    for noise in (STANDARD.noise, TRUE):
        config = STANDARD.model_copy(update={"noise": noise})
        trial, found = noise_trial(recording, config, truth), estimate(recording, config).trajectory
        # Cameras look at the sensor itself here; a simulated foot turns about one axis, which tells nothing along it.
        assert np.abs(trial.lever[[0, 2]]).max() < 1e-3
        seen = TrackedPoint(trial.lever, 0.0).path(recording.time, found.position, found.q_nb)
        expected = position_rmse(seen, trial.position[: len(recording)]) ** 2
        assert float(jax.jit(position_loss)(trial, of(noise))) == pytest.approx(expected, rel=1e-6)
        assert expected == pytest.approx(position_rmse(found.position, truth[1]) ** 2, rel=0.1)


def test_a_point_that_is_not_the_sensor_costs_nothing(walk):
    recording, _ = walk
    found, lever = estimate(recording, STANDARD).trajectory, np.array([0.02, 0.05, -0.04])
    point = TrackedPoint(lever, 0.0).path(recording.time, found.position, found.q_nb)
    trial = noise_trial(recording, STANDARD, (recording.time, point))
    np.testing.assert_allclose(trial.lever[[0, 2]], lever[[0, 2]], atol=1e-4)
    assert float(jax.jit(position_loss)(trial, of(STANDARD.noise))) < 1e-7


@pytest.mark.parametrize("loss", [rest_misfit, position_loss])
def test_gradients_are_those_of_finite_differences(walk, loss):
    recording, truth = walk
    trial = noise_trial(recording, STANDARD, truth)
    value = jax.jit(lambda logs: loss(trial, jnp.exp(logs)))
    logs, step = jnp.log(of(STANDARD.noise)), 1e-4
    found = jax.jit(value_and_gradient(value))(logs)
    assert float(found[0]) == pytest.approx(float(value(logs)), rel=1e-12)
    ways = step * jnp.eye(3)
    expected = [float(value(logs + way) - value(logs - way)) / (2 * step) for way in ways]
    np.testing.assert_allclose(found[1], expected, rtol=1e-4, atol=1e-6 * np.abs(expected).max())


def test_the_densities_of_a_simulated_recording_are_found(walk):
    recording, truth = walk
    start = Noise(gyr_density=1e-2, acc_density=4e-3, change=0.0, rest_velocity_sd=2e-2)
    trials = [noise_trial(recording, Config(method="standard", noise=start, smoother=KNOWN), truth)]
    tuned = tune_noise(trials, start, steps=40, rate=0.15)
    assert tuned.after < tuned.before
    np.testing.assert_allclose(of(tuned.noise) / of(TRUE), 1.0, atol=0.25)
    assert tuned.noise.initial_tilt_sd == start.initial_tilt_sd


def test_what_cannot_be_tuned_is_said(walk):
    recording, (time, position) = walk
    with pytest.raises(InputError, match="at least one recording"):
        tune_noise([], Noise())
    with pytest.raises(InputError, match="covers none of the recording's"):
        noise_trial(recording, STANDARD, (time + 100.0, position))


def test_a_configuration_survives_its_toml(tmp_path):
    config = load_config(
        None, **{"method": "direct", "noise.gyr_density": 1.5e-5, "periodic.band": (4.0, 12.5)}
    )
    (tmp_path / "a.toml").write_text(config_toml(config))
    assert load_config(tmp_path / "a.toml") == config
    assert "initial_tilt_sd = 0.005" in config_toml(Config())
