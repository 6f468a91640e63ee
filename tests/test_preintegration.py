"""Stretches and passages against composing sample by sample, their noise against the filter's error model."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from problems import compose
from scipy.spatial.transform import Rotation

from jaxsat.inertial.components import Quaternion, Vector
from jaxsat.inertial.preintegration import Stretch, attitude_prefixes, passage, stretches
from jaxsat.inertial.strapdown import error_transition, sample_intervals, sample_noise

N = 40
SAMPLES = problems.samples(N, isotropic=True)
TWO = SAMPLES.variance[:, jnp.array([0, 3])]
# Neighbours, the first and the last sample among them.
CUTS = [[5, 6, 20, 39], [0, 1, 2, 3], [11, 12, 13, 30]]
# The strapdown's order is [θ, r, v].
POSITION_LAST = np.array([0, 1, 2, 6, 7, 8, 3, 4, 5])
both = pytest.mark.parametrize("position", [False, True])


def same(found, expected, tolerance=1e-12):
    scale = np.abs(np.asarray(expected)).max()
    np.testing.assert_allclose(found, expected, rtol=tolerance, atol=tolerance * scale)


def parts(signal, cut, position):
    """The stretch before each cut sample, and what follows the last one with a blank sample behind it."""
    is_cut = jnp.zeros(N, bool).at[cut].set(True)
    before, last = stretches(signal, SAMPLES.period, TWO, is_cut, position)
    picked = [jnp.concatenate([x[cut], jnp.zeros_like(x[:1])]) for x in (signal, SAMPLES.period, TWO)]
    return jax.tree.map(lambda x, end: jnp.append(x[cut], end), before, last), picked


def joined(stretch, picked):
    signal, period, variance = picked
    return passage(
        stretch, Vector.of(signal[:, :3]), Vector.of(signal[:, 3:]), period, (variance[:, 0], variance[:, 1])
    )


@jax.jit
def walked(signal):
    """Rotation, V, W and duration by composing sample by sample."""
    intervals = sample_intervals(signal, SAMPLES.period)
    first, rest = jax.tree.map(lambda x: x[0], intervals), jax.tree.map(lambda x: x[1:], intervals)
    return jax.lax.scan(lambda total, one: (compose(total, one), None), first, rest)[0]


@jax.jit
def propagated():
    """Covariance of [θ, r, v] by F P Fᵀ + Q from an exactly known start."""

    def step(carry, inputs):
        q, covariance = carry
        interval, signal, period, variance = inputs
        F = error_transition(q, interval).forth(jnp.eye(9))
        covariance = F @ covariance @ F.T + sample_noise(q, signal, period, variance)
        return ((Quaternion.of(q) @ Quaternion.of(interval.rotation)).stack(), covariance), None

    start = (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros((9, 9)))
    intervals = sample_intervals(SAMPLES.signal, SAMPLES.period)
    return jax.lax.scan(step, start, (intervals, SAMPLES.signal, SAMPLES.period, SAMPLES.variance))[0][1]


def _motion(signal, cut, position):
    motion = joined(*parts(signal, cut, position))
    levers = [lever.stack() for lever in motion.levers]
    return motion.rotation.stack(), levers, motion.duration, motion.noise_covariance().stack(), motion


MOTION = jax.jit(_motion, static_argnums=2)


@both
@pytest.mark.parametrize("cut", CUTS)
def test_motion_is_that_of_composing_sample_by_sample(cut, position):
    rotation, levers, duration, _, _ = MOTION(SAMPLES.signal, jnp.array(cut), position)
    total = walked(SAMPLES.signal)
    same(rotation, total.rotation)
    same(levers[0], total.velocity)
    assert len(levers) == 1 + position
    if position:
        same(levers[1], total.position)
    same(duration, np.sum(SAMPLES.period))


@both
@pytest.mark.parametrize("cut", CUTS)
def test_noise_is_that_of_the_error_model_sample_by_sample(cut, position):
    _, _, _, covariance, _ = MOTION(SAMPLES.signal, jnp.array(cut), position)
    kept = POSITION_LAST[: len(covariance)]
    assert len(kept) == (9 if position else 6)
    expected = propagated()[np.ix_(kept, kept)]
    # Each block in its own unit.
    spread = np.sqrt(np.diag(expected))
    same(covariance / np.outer(spread, spread), expected / np.outer(spread, spread))


@both
def test_levers_of_each_sample_are_what_follows_it(position):
    """Left out of the signal, the samples behind one leave the end short by its `after`."""
    cut = jnp.array(CUTS[0])
    _, _, _, _, motion = MOTION(SAMPLES.signal, cut, position)
    total = walked(SAMPLES.signal)
    for k, sample in enumerate(CUTS[0]):
        upto = walked(jnp.where((jnp.arange(N) <= sample)[:, None], SAMPLES.signal, 0.0))
        same(motion.after[0].stack()[k] + upto.velocity, total.velocity)
        if position:
            # `upto` goes on at the velocity reached.
            same(motion.after[1].stack()[k] + upto.position, total.position)
        same(motion.left[k] + np.sum(SAMPLES.period[: sample + 1]), total.duration)


@both
def test_noise_along_multipliers_is_the_quadratic_form_of_the_covariance(position):
    multipliers = jnp.asarray(np.random.default_rng(2).normal(size=(3, 3)))[: 2 + position]

    def evaluate(rows):
        turn, *pull = (Vector.of(row) for row in rows)
        stretch, picked = parts(SAMPLES.signal, jnp.array(CUTS[0]), position)
        motion = joined(stretch, picked)
        alone = jax.tree.map(lambda x: x[2], stretch.noise)
        return (
            (motion.noise_along(turn, tuple(pull)), motion.noise_covariance().stack()),
            (alone.along(turn, tuple(pull)), alone.covariance().stack()),
        )

    for value, covariance in jax.jit(evaluate)(multipliers):
        flat = multipliers.reshape(-1)
        same(value, flat @ covariance @ flat)
        assert value > 0.0


def test_gradients_are_those_of_composing_sample_by_sample():
    cut = jnp.array(CUTS[0])
    weight = jnp.asarray(np.random.default_rng(4).normal(size=(10,)))

    def fast(signal):
        rotation, levers, *_ = _motion(signal, cut, True)
        return jnp.concatenate([rotation, *levers]) @ weight

    def slow(signal):
        total = walked(signal)
        return jnp.concatenate([total.rotation, total.velocity, total.position]) @ weight

    same(jax.jit(jax.grad(fast))(SAMPLES.signal), jax.jit(jax.grad(slow))(SAMPLES.signal), 1e-11)


@both
def test_an_empty_stretch_is_the_identity(position):
    cut = jnp.array(CUTS[0])

    @jax.jit
    def run():
        stretch, picked = parts(SAMPLES.signal, cut, position)
        empty = Stretch.empty(position, SAMPLES.period[0])
        # One more in third place, with a blank sample behind it; and nothing but that.
        longer = jax.tree.map(lambda x, e: jnp.insert(x, 2, e), stretch, empty)
        blank = [jnp.insert(x, 2, 0.0, axis=0) for x in picked]
        alone = joined(jax.tree.map(lambda e: e[None], empty), [x[2:3] for x in blank])
        with_blank, without = joined(longer, blank), joined(stretch, picked)
        return [
            (m.rotation.stack(), [h.stack() for h in m.levers], m.duration, m.noise_covariance().stack())
            for m in (with_blank, without, alone)
        ]

    with_blank, without, alone = run()
    for found, expected in zip(jax.tree.leaves(with_blank), jax.tree.leaves(without), strict=True):
        same(found, expected, 1e-14)
    np.testing.assert_array_equal(alone[0], [1.0, 0.0, 0.0, 0.0])
    assert not any(np.any(x) for x in jax.tree.leaves(alone[1:]))


def test_noise_of_a_sensor_that_hangs_still_grows_as_the_textbook_says():
    """Sums over j < n of c, of c(gjT)² and of c(gj²T²/2)² to leading order; forces: of a and of a(jT + T/2)²."""
    g, T, c, a = 9.81, 0.005, 1e-4, 1e-2
    signal = jnp.tile(jnp.array([0.0, 0.0, 0.0, 0.0, 0.0, g]), (N, 1))
    period, variance = jnp.full(N, T), jnp.tile(jnp.array([c, a]), (N, 1))
    _, last = jax.jit(stretches, static_argnums=4)(signal, period, variance, jnp.zeros(N, bool), True)
    found = np.asarray(last.noise.covariance().stack())
    left = T * np.arange(N)
    gyr, acc = c * T**2, a * T**2
    same(found[0, 0], N * gyr)
    same(found[4, 0], -gyr * g * np.sum(left), 1e-12)
    same(found[3, 1], gyr * g * np.sum(left), 1e-12)
    same(found[3, 3], N * acc + gyr * g**2 * np.sum(left**2))
    same(found[5, 5], N * acc)
    same(found[6, 6], acc * np.sum((left + T / 2) ** 2) + gyr * (0.5 * g) ** 2 * np.sum(left**4))
    same(last.levers[1].stack(), [0.0, 0.0, 0.5 * g * (N * T) ** 2])


def _prefix_value(phi):
    total = attitude_prefixes(Quaternion.exp(Vector.of(phi)))
    return jnp.sum(total.stack() * jnp.asarray(np.random.default_rng(5).normal(size=(N, 4))))


def test_attitude_prefixes_equal_scipy_and_their_gradients_are_right():
    phi = jnp.asarray(np.random.default_rng(3).normal(size=(N, 3)))
    direction = jnp.asarray(np.random.default_rng(6).normal(size=(N, 3)))
    total, vectors = Rotation.identity(), np.array(phi)
    found = Rotation.from_quat(
        np.array(attitude_prefixes(Quaternion.exp(Vector.of(phi))).stack()), scalar_first=True
    )
    for k in range(N):
        total = total * Rotation.from_rotvec(vectors[k])
        same(found[k].as_matrix(), total.as_matrix())
    f = jax.jit(_prefix_value)
    reverse = jax.jit(jax.grad(_prefix_value))
    forward = jax.jvp(f, (phi,), (direction,))[1]
    step = 1e-6
    numeric = (f(phi + step * direction) - f(phi - step * direction)) / (2 * step)
    np.testing.assert_allclose(jnp.sum(reverse(phi) * direction), forward, rtol=1e-12)
    np.testing.assert_allclose(forward, numeric, rtol=1e-7)
    assert jnp.isfinite(reverse(jnp.zeros((N, 3)))).all()
