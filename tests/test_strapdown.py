"""Intervals: composition, strapdown and the error model against slower ways."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
from problems import compose
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxsat.inertial.rotations import quat_log, quat_multiply, quat_to_matrix
from jaxsat.inertial.strapdown import (
    add_error,
    advance,
    error_between,
    error_transition,
    prefixes,
    sample_interval,
    sample_intervals,
    sample_noise,
    strapdown,
)

SAMPLES = problems.samples(40, isotropic=True)


def same(a, b, tolerance=1e-12):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def row(tree, k):
    return jax.tree.map(lambda x: x[k], tree)


INTERVALS = sample_intervals(SAMPLES.signal, SAMPLES.period)


def test_compose_is_associative_and_has_an_identity():
    a, b, c = (row(INTERVALS, k) for k in (3, 17, 29))
    same(compose(compose(a, b), c), compose(a, compose(b, c)))
    still = sample_interval(jnp.ones(6), jnp.asarray(0.0))
    same(compose(a, still), a)
    same(compose(still, a), a)


def test_prefixes_equal_composing_one_by_one():
    upto, join = prefixes(INTERVALS), jax.jit(compose)
    total = row(INTERVALS, 0)
    for k in range(1, 40):
        total = join(total, row(INTERVALS, k))
        same(row(upto, k), total)


def test_composed_samples_equal_rotating_and_adding_with_scipy():
    """Specific force turned by the attitude in mid-sample, velocity and position by Newton."""
    attitude, velocity, position = Rotation.identity(), np.zeros(3), np.zeros(3)
    for signal, T in zip(np.array(SAMPLES.signal), np.array(SAMPLES.period), strict=True):
        force = (attitude * Rotation.from_rotvec(0.5 * T * signal[:3])).apply(signal[3:])
        position = position + velocity * T + 0.5 * force * T**2
        velocity = velocity + force * T
        attitude = attitude * Rotation.from_rotvec(T * signal[:3])
    end = row(prefixes(INTERVALS), -1)
    same(quat_to_matrix(end.rotation), attitude.as_matrix())
    same((end.velocity, end.position, end.duration), (velocity, position, np.sum(SAMPLES.period)))


def test_sample_noise_is_the_jacobian_of_a_sample_at_each_axis():
    """What the values of one sample do to its end, by differentiation of the strapdown; first order in T."""
    state, _ = problems.departure()
    signal, T = SAMPLES.signal[7], SAMPLES.period[7]
    variance = jnp.array([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])
    end = advance(state, sample_interval(signal, T), problems.GRAVITY)

    def moved(x):
        return error_between(advance(state, sample_interval(x, T), problems.GRAVITY), end)

    # A rate also pushes v within its own sample, by half a period of what the specific force turns: left out.
    J = np.array(jax.jacfwd(moved)(signal))
    J[3:, :3] = 0.0
    expected = J @ np.diag(variance) @ J.T
    found = sample_noise(state.q_nb, signal, T, variance)
    for block in (slice(0, 3), slice(3, 6), slice(6, 9)):
        np.testing.assert_allclose(
            found[block, block], expected[block, block], atol=1e-3 * np.abs(expected[block, block]).max()
        )
    np.testing.assert_allclose(found[3:6, 6:], expected[3:6, 6:], atol=1e-3 * np.abs(expected[3:6, 6:]).max())


def test_strapdown_of_the_whole_equals_advancing_sample_by_sample():
    state, _ = problems.departure()
    states = strapdown(SAMPLES.signal, SAMPLES.period, state, problems.GRAVITY)
    step = jax.jit(advance)
    for k in range(40):
        state = step(state, row(INTERVALS, k), problems.GRAVITY)
    same(row(states, -1), state)


def test_error_transition_is_the_jacobian_of_the_strapdown():
    state, _ = problems.departure()
    interval = row(INTERVALS, 4)
    end = advance(state, interval, problems.GRAVITY)

    def moved(error):
        return error_between(advance(add_error(state, error), interval, problems.GRAVITY), end)

    transition, eye = error_transition(state.q_nb, interval), jnp.eye(9)
    same(jax.jacfwd(moved)(jnp.zeros(9)), transition.forth(eye))
    same(transition.back(eye), transition.forth(eye).T)
    # Without position, nothing else changes.
    here = np.r_[0:3, 6:9]
    same(transition.forth(jnp.eye(6)), transition.forth(eye)[here][:, here])
    same(transition.back(jnp.eye(6)), transition.back(eye)[here][:, here])


def test_error_transition_is_the_papers_body_frame_model():
    """With q̄_e = ½ R_bn θ the transition is that of Eq. 8-9, its specific force taken in mid-sample."""
    state, _ = problems.departure()
    gyr, acc, T = SAMPLES.signal[3, :3], SAMPLES.signal[3, 3:], SAMPLES.period[3]
    interval = row(INTERVALS, 3)
    Phi = error_transition(state.q_nb, interval).forth(jnp.eye(9))
    start = quat_to_matrix(state.q_nb)
    end = quat_to_matrix(advance(state, interval, problems.GRAVITY).q_nb)
    eye, zero = np.eye(3), np.zeros((3, 3))

    def to_paper(R):
        return np.block([[0.5 * R.T, zero, zero], [zero, eye, zero], [zero, zero, eye]])

    def cross(v):
        return np.cross(np.eye(3), v)

    force = Rotation.from_rotvec(np.array(0.5 * T * gyr)).apply(np.array(acc))
    lever = -2.0 * start @ cross(force)
    paper = np.block(
        [[expm(-cross(gyr) * T), zero, zero], [0.5 * T**2 * lever, eye, T * eye], [T * lever, zero, eye]]
    )
    same(to_paper(end) @ Phi @ np.linalg.inv(to_paper(start)), paper)


def test_prefix_gradients_equal_numeric_and_forward_mode():
    direction = jnp.asarray(np.random.default_rng(3).normal(size=(40, 6)))

    @jax.jit
    def f(x):
        end = row(prefixes(sample_intervals(x, SAMPLES.period)), -1)
        return end.position @ jnp.arange(3.0) + quat_log(quat_multiply(end.rotation, end.rotation))[1]

    gradient = jax.jit(jax.grad(f))
    reverse = jnp.sum(gradient(SAMPLES.signal) * direction)
    forward = jax.jvp(f, (SAMPLES.signal,), (direction,))[1]
    step = 1e-6
    numeric = (f(SAMPLES.signal + step * direction) - f(SAMPLES.signal - step * direction)) / (2 * step)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)
    np.testing.assert_allclose(reverse, numeric, rtol=1e-7)
    assert jnp.isfinite(gradient(jnp.zeros((40, 6)))).all()
