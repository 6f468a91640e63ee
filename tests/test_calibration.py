"""Biases and the lever in the smoother's problem: the quadratic against the smoother's own cost, and the truth."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

from jaxsat.config import load_config
from jaxsat.inertial.calibration import Calibration, calibrate, constants_quadratic
from jaxsat.inertial.rotations import quat_to_matrix
from jaxsat.inertial.smoother import Rows, closed_loop, smooth
from jaxsat.inertial.strapdown import (
    NavState,
    Samples,
    advance,
    error_between,
    error_transition,
    sample_intervals,
    sample_noise,
)
from jaxsat.preparation import prepare
from jaxsat.studies.motions import Walk
from jaxsat.studies.simulate import Sensor, simulate

N = 60
REST = np.zeros(N, bool)
REST[:8] = REST[25:33] = REST[50:] = True
GYR_BIAS, ACC_BIAS = np.array([2e-3, -1e-3, 1.5e-3]), np.array([0.05, -0.03, 0.02])
CALIBRATE = jax.jit(calibrate)


@pytest.fixture(scope="module")
def problem():
    """A lively motion, and the corrected states of its filter to linearise about; heights are not observed."""
    rest = problems.rows(REST)
    rows = Rows(rest.rest, rest.velocity_variance, None, rest.height_variance, rest.velocity)
    prior, covariance = problems.departure()
    samples = problems.samples(N)
    reference = closed_loop(samples, rows, prior, covariance, problems.GRAVITY).state
    return reference, samples, rows, prior, covariance


def test_without_constants_the_quadratic_is_the_cost_of_the_filter(problem):
    _, samples, rows, prior, covariance = problem
    found = jax.jit(constants_quadratic)(samples, rows, prior, covariance, problems.GRAVITY)
    cost = closed_loop(samples, rows, prior, covariance, problems.GRAVITY).cost.sum()
    assert 0.5 * found[0, 0] == pytest.approx(float(cost), rel=1e-9)
    np.testing.assert_allclose(found, found.T, rtol=1e-12)


def dense_cost(reference, samples: Samples, rows: Rows, prior: NavState, covariance):
    """J of the offsets of all steps about a fixed reference, by one dense Gaussian of all states."""
    intervals = sample_intervals(samples.signal, samples.period)
    at = reference.q_nb[:-1]
    transitions = np.asarray(jax.vmap(lambda q, i: error_transition(q, i).forth(jnp.eye(9)))(at, intervals))
    noises = np.asarray(jax.vmap(sample_noise)(at, samples.signal, samples.period, samples.variance))
    C = np.zeros((9 * (N + 1), 9 * (N + 1)))
    C[:9, :9] = covariance
    for k in range(N):
        here, there, past = slice(9 * k, 9 * k + 9), slice(9 * k + 9, 9 * k + 18), slice(0, 9 * k + 9)
        C[there, past] = transitions[k] @ C[here, past]
        C[past, there] = C[there, past].T
        C[there, there] = transitions[k] @ C[here, here] @ transitions[k].T + noises[k]
    rest = np.flatnonzero(rows.rest)
    H = np.concatenate([9 * k + np.arange(6, 9) for k in rest])
    S = C[np.ix_(H, H)] + float(rows.velocity_variance[0]) * np.eye(len(H))
    # Rows are linearised about what the filter predicts.
    predicted = jax.vmap(lambda a, i: advance(a, i, problems.GRAVITY).q_nb)(
        jax.tree.map(lambda x: x[:-2], reference), jax.tree.map(lambda x: x[:-1], intervals)
    )
    R = jax.vmap(quat_to_matrix)(jnp.concatenate([prior.q_nb[None], predicted]))
    first = error_between(prior, jax.tree.map(lambda x: x[0], reference))
    turning = samples.signal[:, :3]

    def cost(offsets, lever) -> float:
        moves = np.einsum("kij,kj->ki", R, rows.velocity + np.cross(lever, turning))
        measured = (moves - np.asarray(reference.velocity)[:-1])[rest].ravel()
        mean = np.zeros((N + 1, 9))
        mean[0] = first
        for k in range(N):
            mean[k + 1] = transitions[k] @ mean[k] + offsets[k]
        innovation = measured - mean.ravel()[H]
        return 0.5 * innovation @ np.linalg.solve(S, innovation)

    return cost


def test_gradient_and_hessian_equal_differences_of_a_dense_cost(problem):
    """The effect of a bias on each step is taken from the strapdown itself, by central differences."""
    reference, samples, rows, prior, covariance = problem
    found = np.asarray(jax.jit(constants_quadratic)(samples, rows, prior, covariance, problems.GRAVITY))
    start, end = (jax.tree.map(lambda x, s=s: x[s], reference) for s in (slice(None, -1), slice(1, None)))

    @jax.jit
    def offsets(bias):
        intervals = sample_intervals(samples.signal - bias[None], samples.period)
        return jax.vmap(lambda a, i, b: error_between(advance(a, i, problems.GRAVITY), b))(
            start, intervals, end
        )

    zero, h = jnp.zeros(6), 1e-4
    effect = np.stack([(offsets(h * e) - offsets(-h * e)) / (2 * h) for e in np.eye(6)], axis=-1)
    of_offsets, unbiased = dense_cost(reference, samples, rows, prior, covariance), np.asarray(offsets(zero))

    def cost(constants):
        return of_offsets(unbiased + effect @ constants[:6], constants[6:])

    unit = np.repeat([1e-2, 1e-1, 1e-2], 3)
    E = np.diag(unit)
    gradient = np.array([(cost(e) - cost(-e)) / 2 for e in E])
    hessian = np.array([[(cost(a + b) - cost(a - b) - cost(b - a) + cost(-a - b)) / 4 for b in E] for a in E])
    tolerance = 2e-3  # the step's own linearisation at the middle of a sample
    np.testing.assert_allclose(found[0, 1:] * unit, gradient, atol=tolerance * np.abs(gradient).max())
    expected = found[1:, 1:] * np.outer(unit, unit)
    np.testing.assert_allclose(expected, hessian, atol=tolerance * np.abs(hessian).max())


@pytest.fixture(scope="module")
def biased_walk():
    motion = Walk(strides=6)
    sensor = Sensor(gyr_bias=GYR_BIAS, acc_bias=ACC_BIAS)
    duration = float(motion.moving[-1, 1]) + 1.0
    recording, truth = simulate(motion, rate=100.0, duration=duration, sensor=sensor, key=jax.random.key(2))
    recording = eqx.tree_at(lambda r: r.rest, recording, truth.rest, is_leaf=lambda x: x is None)
    noise = {"gyr_density": sensor.gyr_density, "acc_density": sensor.acc_density, "rest_velocity_sd": 0.01}
    settings = {f"noise.{name}": value for name, value in noise.items()}
    settings |= {"smoother.gyr_offset": "none", "gravity": 9.80665, "rails.gyr": "none", "rails.acc": "none"}
    settings |= {"noise.change": 0.0}
    return jax.tree.map(jnp.asarray, prepare(recording, load_config(None, **settings)).trial)


def found_on(trial, sd, steps=3):
    samples = Samples(trial.signal, trial.period, trial.variance)
    prior = NavState(*jax.tree.leaves(trial.prior))
    given = (samples, trial.rows, prior, trial.prior_covariance, trial.gravity, jnp.asarray(sd))
    return stepped(given, steps)


def stepped(given, steps):
    """Gauss-Newton steps from no calibration."""
    found = Calibration.none()
    for _ in range(steps):
        found = CALIBRATE(*given, found)
    return found


def test_biases_of_a_simulated_walk_are_found_within_their_own_sd(biased_walk):
    prior_sd = np.repeat([5e-3, 0.1, 0.0], 3)
    found = found_on(biased_walk, prior_sd)
    truth = np.concatenate([GYR_BIAS, ACC_BIAS])
    sd = np.asarray(found.sd)[:6]
    assert (np.abs(found.constants[:6] - truth) < 4.0 * sd).all()
    # They are learned, not only allowed: horizontal rates and the vertical force far better than the prior knew.
    assert (sd <= prior_sd[:6] * (1 + 1e-9)).all() and (sd < 0.2 * prior_sd[:6]).sum() >= 3
    np.testing.assert_allclose(found.constants[5], truth[5], atol=0.01)
    # What is not wanted stays away, to the last bit.
    assert not found.constants[6:].any() and not found.sd[6:].any()


def rolling(lever: np.ndarray, angle: float = 0.5):
    """A sensor on a foot: it rests about a point of the ground, and rolls there by `angle` in a second.

    Between two rests it moves to and fro without turning. Signals follow from position and attitude as functions of
    time: with the point at p(t), the sensor is at r = p − R ℓ, and f = Rᵀ(r̈ + g).
    """
    T, n = 0.01, 700
    t = np.arange(n) * T
    # Rests of a second with a roll, one second of motion between them.
    rest = (np.floor(t) % 2) == 0

    def roll(t):
        phase = t % 2.0
        smooth = jnp.where(phase < 1.0, phase - jnp.sin(2 * jnp.pi * phase) / (2 * jnp.pi), 1.0)
        back = jnp.where(phase > 1.0, (phase - 1) - jnp.sin(2 * jnp.pi * (phase - 1)) / (2 * jnp.pi), 0.0)
        return angle * (smooth - back)

    def point(t):
        phase = jnp.maximum(t % 2.0 - 1.0, 0.0)
        moved = phase - jnp.sin(2 * jnp.pi * phase) / (2 * jnp.pi)
        return jnp.array([1.0, 0.2, 0.0]) * (jnp.floor(t / 2.0) + moved)

    def R(t):
        c, s = jnp.cos(roll(t)), jnp.sin(roll(t))
        return jnp.array([[c, 0.0, s], [0.0, 1.0, 0.0], [-s, 0.0, c]])

    def place(t):
        return point(t) - R(t) @ jnp.asarray(lever)

    middle = jnp.asarray(t + 0.5 * T)
    force = jax.vmap(lambda t: R(t).T @ (jax.jacfwd(jax.jacfwd(place))(t) + jnp.array([0, 0, 9.81])))(middle)
    rate = jnp.zeros((n, 3)).at[:, 1].set(jax.vmap(jax.grad(roll))(middle))
    return rest, jnp.concatenate([rate, force], axis=1), np.asarray(jax.vmap(place)(jnp.asarray(t)))


def test_the_lever_of_a_foot_that_rolls_is_found_and_its_path_mended():
    lever = np.array([0.08, 0.0, -0.05])
    rest, signal, path = rolling(lever)
    n = len(rest)
    variance = jnp.broadcast_to(jnp.repeat(jnp.array([1e-6, 1e-4]), 3), (n, 6))
    samples = Samples(signal, jnp.full(n, 0.01), variance)
    rows = Rows(jnp.asarray(rest), jnp.full(n, 1e-4), None, jnp.ones(n), jnp.zeros((n, 3)))
    prior = NavState(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.zeros(3))
    known = (prior, jnp.diag(jnp.array([1e-5, 1e-5, 0, 0, 0, 0, 1e-4, 1e-4, 1e-4])), jnp.asarray(9.81))
    sd = jnp.repeat(jnp.array([0.0, 0.0, 0.1]), 3)
    found = stepped((samples, rows, *known, sd), 2)
    np.testing.assert_allclose(found.constants[6:9:2], lever[::2], atol=5e-3)
    # Nothing turns about y's own axis: only the prior speaks of the lever along it.
    assert abs(found.constants[7]) < 1e-3 and found.sd[7] == pytest.approx(0.1, rel=0.01)
    run = jax.jit(smooth)
    errors = []
    for calibration in (Calibration.none(), found):
        smoothed = run(*calibration.applied(samples, rows), *known)
        moved = np.asarray(smoothed.state.position)[:-1] - np.asarray(smoothed.state.position)[0]
        errors.append(np.sqrt(np.mean(np.sum((moved - (path - path[0])) ** 2, axis=1))))
    assert errors[1] < 0.2 * errors[0]
