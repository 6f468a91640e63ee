"""Intervals: composition, preintegration and the error model against slower ways."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
from scipy.linalg import expm
from scipy.spatial.transform import Rotation

from jaxsat.inertial import preintegration as pre
from jaxsat.inertial.rotations import quat_log, quat_multiply, quat_to_matrix
from jaxsat.inertial.strapdown import (
    add_error,
    advance,
    between,
    compose,
    error_between,
    error_transition,
    noise_covariance,
    prefixes,
    rotate_noise,
    sample_interval,
    sample_intervals,
    sample_noise,
    strapdown,
)

SAMPLES = problems.samples(40, isotropic=True)
TWO = SAMPLES.variance[:, [0, 3]]


def same(a, b, tolerance=1e-12):
    for x, y in zip(jax.tree.leaves(a), jax.tree.leaves(b), strict=True):
        np.testing.assert_allclose(x, y, rtol=tolerance, atol=tolerance)


def row(tree, k):
    return jax.tree.map(lambda x: x[k], tree)


def one_by_one():
    intervals = sample_intervals(SAMPLES.signal, SAMPLES.period, TWO)
    total = row(intervals, 0)
    for k in range(1, 40):
        total = jax.jit(compose)(total, row(intervals, k))
    return intervals, total


def test_compose_is_associative_and_has_an_identity():
    intervals, _ = one_by_one()
    a, b, c = (row(intervals, k) for k in (3, 17, 29))
    same(compose(compose(a, b), c), compose(a, compose(b, c)))
    still = sample_interval(jnp.ones(6), jnp.asarray(0.0), jnp.ones(2))
    same(compose(a, still), a)
    same(compose(still, a), a)


def test_prefixes_collapse_and_stretches_equal_composing_one_by_one():
    intervals, total = one_by_one()
    bare = sample_intervals(SAMPLES.signal, SAMPLES.period)
    last = row(prefixes(bare), -1)
    same((last.rotation, last.velocity, last.position), (total.rotation, total.velocity, total.position))
    same(pre.collapse(SAMPLES.signal, SAMPLES.period, TWO), total)

    cut = jnp.array([5, 6, 20, 39, 40, 40])
    parts, noise = pre.stretches(SAMPLES.signal, SAMPLES.period, TWO, cut)
    stretch = row(intervals, 7)
    for k in range(8, 20):
        stretch = compose(stretch, row(intervals, k))
    same(row(parts, 2).velocity, stretch.velocity)
    same(row(noise, 2), stretch.noise)

    def pick(x):
        return jnp.concatenate([x, jnp.zeros((2, *x.shape[1:]))])[jnp.append(cut, 40)]

    upto, gathered = pre.alternate(parts, noise, pick(SAMPLES.signal), pick(SAMPLES.period), pick(TWO))
    same(row(upto, -1).position, total.position)
    same(gathered, total.noise)


def test_moments_and_per_axis_noise_agree_on_isotropic_sensors():
    state, _ = problems.departure()
    _, total = one_by_one()
    covariance = jnp.zeros((9, 9))
    states = strapdown(SAMPLES.signal, SAMPLES.period, state, problems.GRAVITY)
    intervals = sample_intervals(SAMPLES.signal, SAMPLES.period)
    for k in range(40):
        q = states.q_nb[k]
        transition = error_transition(q, row(intervals, k))
        noise = sample_noise(q, SAMPLES.signal[k], SAMPLES.period[k], SAMPLES.variance[k])
        covariance = transition @ covariance @ transition.T + noise
    same(rotate_noise(state.q_nb, noise_covariance(total.noise)), covariance)


def test_between_undoes_compose():
    intervals, _ = one_by_one()
    upto = prefixes(sample_intervals(SAMPLES.signal, SAMPLES.period))
    middle = between(row(upto, 10), row(upto, 11))
    same(middle.position, row(intervals, 11).position)


def test_strapdown_of_the_whole_equals_advancing_sample_by_sample():
    state, _ = problems.departure()
    states = strapdown(SAMPLES.signal, SAMPLES.period, state, problems.GRAVITY)
    bare = sample_intervals(SAMPLES.signal, SAMPLES.period)
    for k in range(40):
        state = advance(state, row(bare, k), problems.GRAVITY)
    same(row(states, -1), state)


def test_error_transition_is_the_jacobian_of_the_strapdown():
    state, _ = problems.departure()
    interval = row(sample_intervals(SAMPLES.signal, SAMPLES.period), 4)
    end = advance(state, interval, problems.GRAVITY)

    def moved(error):
        return error_between(advance(add_error(state, error), interval, problems.GRAVITY), end)

    same(jax.jacfwd(moved)(jnp.zeros(9)), error_transition(state.q_nb, interval))


def test_error_transition_is_the_papers_body_frame_model():
    """With q̄_e = ½ R_bn θ the transition is that of Eq. 8-9, its specific force taken in mid-sample."""
    state, _ = problems.departure()
    gyr, acc, T = SAMPLES.signal[3, :3], SAMPLES.signal[3, 3:], SAMPLES.period[3]
    interval = row(sample_intervals(SAMPLES.signal, SAMPLES.period), 3)
    Phi = error_transition(state.q_nb, interval)
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

    def f(x):
        end = row(prefixes(sample_intervals(x, SAMPLES.period)), -1)
        return end.position @ jnp.arange(3.0) + quat_log(quat_multiply(end.rotation, end.rotation))[1]

    reverse = jnp.sum(jax.grad(f)(SAMPLES.signal) * direction)
    forward = jax.jvp(f, (SAMPLES.signal,), (direction,))[1]
    step = 1e-6
    numeric = (f(SAMPLES.signal + step * direction) - f(SAMPLES.signal - step * direction)) / (2 * step)
    np.testing.assert_allclose(reverse, forward, rtol=1e-12)
    np.testing.assert_allclose(reverse, numeric, rtol=1e-7)
    assert jnp.isfinite(jax.grad(f)(jnp.zeros((40, 6)))).all()


def test_input_effects_are_derivatives_of_the_strapdown():
    state, _ = problems.departure()
    element, channel = jnp.array([3, 11, 30]), jnp.array([1, 4, 2])
    upto = prefixes(sample_intervals(SAMPLES.signal, SAMPLES.period))
    effects = pre.input_effects(pre.remainders(upto), SAMPLES.signal, SAMPLES.period, element, channel)
    end = row(strapdown(SAMPLES.signal, SAMPLES.period, state, problems.GRAVITY), -1)
    R = np.kron(np.eye(3), quat_to_matrix(state.q_nb))
    for k in range(3):

        def moved(x, k=k):
            signal = SAMPLES.signal.at[element[k], channel[k]].add(x)
            return error_between(row(strapdown(signal, SAMPLES.period, state, problems.GRAVITY), -1), end)

        exact = jax.jacfwd(moved)(jnp.asarray(0.0))
        # The half step of a rate's own sample and the turn within it are left out: O(T) of the whole.
        np.testing.assert_allclose(R @ effects[k], exact, atol=2e-2 * np.abs(exact).max())
