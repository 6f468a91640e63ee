"""The smoother against the dense system, singular noise and rests in between included."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

from jaxsat.inertial.rotations import quat_to_matrix
from jaxsat.inertial.smoother import (
    HEIGHT,
    VELOCITY,
    Rows,
    closed_loop,
    displacement_covariance,
    smooth,
    smooth_about,
    smooth_nonnegative,
)
from jaxsat.inertial.strapdown import (
    NavState,
    add_error,
    advance,
    error_between,
    error_transition,
    sample_intervals,
    sample_noise,
    strapdown,
)

N = 60
REST = np.zeros(N, bool)
REST[:8] = REST[25:33] = REST[50:] = True
HEIGHTS = np.zeros(N, bool)
HEIGHTS[[25, 50]] = True
SAMPLES = problems.samples(N)
SMOOTH_ABOUT, SMOOTH = jax.jit(smooth_about), jax.jit(smooth)


def at(tree, k):
    return jax.tree.map(lambda x: x[k], tree)


def dense(reference, samples, rows, prior, prior_covariance, whole=False):
    """Means, covariances and J* of the joint Gaussian, from one dense conditioning (nothing is inverted but S).

    whole: the covariance of all states together in place of multipliers.
    """
    intervals = sample_intervals(samples.signal, samples.period)
    size = 9 * (N + 1)
    mean, root = np.zeros((N + 1, 9)), np.zeros((N + 1, 9, size))
    mean[0] = error_between(prior, at(reference, 0))
    values, vectors = np.linalg.eigh(prior_covariance)
    root[0, :, :9] = vectors * np.sqrt(np.maximum(values, 0.0))
    for k in range(N):
        start, interval = at(reference, k), at(intervals, k)
        Phi = np.asarray(error_transition(start.q_nb, interval).forth(jnp.eye(9)))
        offset = error_between(advance(start, interval, problems.GRAVITY), at(reference, k + 1))
        noise = sample_noise(start.q_nb, samples.signal[k], samples.period[k], samples.variance[k])
        values, vectors = np.linalg.eigh(noise)
        assert (values < 1e-12 * values[-1]).sum() >= 3, "the process noise is singular"
        mean[k + 1] = Phi @ mean[k] + offset
        root[k + 1] = Phi @ root[k]
        root[k + 1][:, 9 * (k + 1) : 9 * (k + 2)] = vectors * np.sqrt(np.maximum(values, 0.0))
    H, z, r = [], [], []
    for k in range(N):
        moves = np.zeros(3)
        if rows.velocity is not None:
            moves = np.asarray(quat_to_matrix(reference.q_nb[k]) @ rows.velocity[k])
        for axis, index in enumerate(VELOCITY):
            if rows.rest[k]:
                H.append(9 * k + index)
                z.append(moves[axis] - reference.velocity[k, axis])
                r.append(rows.velocity_variance[k])
        if rows.height[k]:
            H.append(9 * k + HEIGHT)
            z.append(-reference.position[k, 2])
            r.append(rows.height_variance[k])
    flat, L = mean.ravel(), root.reshape(size, size)
    C = L @ L.T
    S = C[np.ix_(H, H)] + np.diag(r)
    innovation = np.asarray(z) - flat[H]
    gain = np.linalg.solve(S, C[H]).T
    posterior = C - gain @ C[H]
    blocks = np.stack([posterior[9 * k : 9 * k + 9, 9 * k : 9 * k + 9] for k in range(N + 1)])
    return (
        (flat + gain @ innovation).reshape(N + 1, 9),
        blocks,
        0.5 * innovation @ np.linalg.solve(S, innovation),
        posterior if whole else np.linalg.solve(S, innovation),
    )


def test_without_heights_only_the_position_of_the_filter_changes():
    """What no row sees is left out of the filter; the smoother still knows all of it."""
    rows = problems.rows(REST)
    unused = Rows(rows.rest, rows.velocity_variance, None, rows.height_variance, rows.velocity)
    prior, covariance = problems.departure()
    full, small = (closed_loop(SAMPLES, r, prior, covariance, problems.GRAVITY) for r in (rows, unused))
    motion = np.array([0, 1, 2, 6, 7, 8])
    np.testing.assert_allclose(small[1], full[1][:, motion][:, :, motion], rtol=1e-9, atol=1e-16)
    np.testing.assert_allclose(small[0].q_nb, full[0].q_nb, atol=1e-12)
    np.testing.assert_allclose(small[0].velocity, full[0].velocity, atol=1e-12)
    full, small = (SMOOTH(SAMPLES, r, prior, covariance, problems.GRAVITY) for r in (rows, unused))
    np.testing.assert_allclose(small.state.position, full.state.position, atol=1e-9)
    np.testing.assert_allclose(small.covariance, full.covariance, rtol=1e-8, atol=1e-13)
    assert small.cost == pytest.approx(float(full.cost), rel=1e-9) and small.height_multiplier is None


@pytest.mark.parametrize("exact_start", [False, True])
def test_means_covariances_and_cost_equal_the_dense_system(exact_start):
    prior, covariance = problems.departure()
    if exact_start:  # heading and position are known exactly: a singular prior too
        covariance = jnp.diag(jnp.array([1e-5, 1e-5, 0, 0, 0, 0, 1e-4, 1e-4, 1e-4]))
    rows = problems.rows(REST, HEIGHTS)
    corrected = closed_loop(SAMPLES, rows, prior, covariance, problems.GRAVITY).state
    for reference in (strapdown(SAMPLES.signal, SAMPLES.period, prior, problems.GRAVITY), corrected):
        found = SMOOTH_ABOUT(reference, SAMPLES, rows, prior, covariance, problems.GRAVITY)
        mean, blocks, cost, _ = dense(reference, SAMPLES, rows, prior, covariance)
        expected = jax.vmap(add_error)(reference, jnp.asarray(mean))
        for a, b in zip(jax.tree.leaves(found.state), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=1e-9 * max(1.0, np.abs(b).max()))
        scale = np.sqrt(np.einsum("kii->ki", blocks).max(axis=0))
        difference = (found.covariance - blocks) / (scale[:, None] * scale[None, :])[None]
        assert np.abs(difference).max() < 1e-9
        np.testing.assert_allclose(found.cost, cost, rtol=1e-9)


def test_multipliers_of_height_rows_are_the_derivatives_of_the_cost():
    prior, covariance = problems.departure()
    rows = problems.rows(REST, HEIGHTS)
    reference = strapdown(SAMPLES.signal, SAMPLES.period, prior, problems.GRAVITY)
    found = SMOOTH_ABOUT(reference, SAMPLES, rows, prior, covariance, problems.GRAVITY)
    *_, multipliers = dense(reference, SAMPLES, rows, prior, covariance)
    # The dense list has the height row of a state behind its three velocity rows.
    position = 3 * np.cumsum(REST)[[25, 50]] + [0, 1]
    np.testing.assert_allclose(found.height_multiplier[jnp.array([25, 50])], multipliers[position], rtol=1e-8)
    assert not np.delete(found.height_multiplier, [25, 50]).any()


def almost_still(seed: int = 2):
    """Samples of a sensor that hardly moves, and a level prior: linearisation errors are small."""
    level, _ = problems.departure()
    level = eqx.tree_at(lambda s: s.q_nb, level, jnp.array([1.0, 0.0, 0.0, 0.0]))
    noise = np.random.default_rng(seed).normal(size=(N, 6)) * np.repeat([0.05, 0.3], 3)
    signal = jnp.asarray(noise + np.array([0.0, 0.0, 0.0, 0.0, 0.0, 9.81]))
    covariance = jnp.diag(jnp.array([1e-4, 1e-4, 0.0, 0.0, 0.0, 0.0, 1e-2, 1e-2, 1e-2]))
    return eqx.tree_at(lambda s: s.signal, SAMPLES, signal), level, covariance


def test_last_state_of_the_closed_loop_is_the_kalman_filter():
    """Filter and smoother agree at the end, where no row follows, but for linearisation."""
    samples, prior, covariance = almost_still()
    rows = eqx.tree_at(lambda r: r.velocity, problems.rows(REST), jnp.zeros((N, 3)))
    states, filtered, _ = closed_loop(samples, rows, prior, covariance, problems.GRAVITY)
    found = SMOOTH(samples, rows, prior, covariance, problems.GRAVITY, jnp.asarray(0))
    scale = np.sqrt(np.diag(filtered[-1]).clip(1e-12))
    assert (np.abs(filtered[-1] - found.covariance[-1]) < 2e-2 * np.outer(scale, scale)).all()
    np.testing.assert_allclose(states.velocity[-1], found.state.velocity[-1], atol=1e-4)


def test_relinearising_ends_at_a_stationary_point():
    samples, prior, covariance = almost_still()
    rows = problems.rows(REST)
    before = SMOOTH(samples, rows, prior, covariance, problems.GRAVITY, jnp.asarray(0))
    after = SMOOTH(samples, rows, prior, covariance, problems.GRAVITY, jnp.asarray(12))
    again = SMOOTH_ABOUT(after.state, samples, rows, prior, covariance, problems.GRAVITY)
    step = jax.vmap(error_between)(again.state, after.state)
    first_step = jax.vmap(error_between)(after.state, before.state)
    assert np.abs(step).max() < 1e-9 < np.abs(first_step).max()


def test_yaw_and_translation_only_move_the_map():
    prior, covariance = problems.departure()
    covariance = jnp.diag(jnp.diag(covariance).at[0].set(1e-4).at[1].set(1e-4).at[6:].set(1e-4))
    rows = problems.rows(REST)
    yaw = jnp.array([0.0, 0.0, 1.1, 5.0, -3.0, 2.0, 0.0, 0.0, 0.0])
    turned = add_error(prior, yaw)
    spin = jnp.array([[np.cos(1.1), -np.sin(1.1), 0], [np.sin(1.1), np.cos(1.1), 0], [0, 0, 1]])
    turned = NavState(turned.q_nb, spin @ prior.velocity, turned.position)
    a = SMOOTH(SAMPLES, rows, prior, covariance, problems.GRAVITY, jnp.asarray(1))
    b = SMOOTH(SAMPLES, rows, turned, covariance, problems.GRAVITY, jnp.asarray(1))
    moved = (a.state.position - prior.position[None]) @ spin.T + turned.position[None]
    np.testing.assert_allclose(b.state.position, moved, atol=1e-9)
    np.testing.assert_allclose(b.cost, a.cost, rtol=1e-9)


def test_padding_with_zero_periods_changes_nothing():
    prior, covariance = problems.departure()
    rows = problems.rows(REST)
    reference = strapdown(SAMPLES.signal, SAMPLES.period, prior, problems.GRAVITY)
    found = SMOOTH_ABOUT(reference, SAMPLES, rows, prior, covariance, problems.GRAVITY)
    longer = jax.tree.map(lambda x: jnp.concatenate([x, jnp.zeros((4, *x.shape[1:]))]), SAMPLES)
    quiet = problems.rows(np.concatenate([REST, np.zeros(4, bool)]))
    last = jax.tree.map(lambda x: jnp.concatenate([x, jnp.repeat(x[-1:], 4, axis=0)]), reference)
    padded = smooth_about(last, longer, quiet, prior, covariance, problems.GRAVITY)
    np.testing.assert_allclose(padded.cost, found.cost, rtol=1e-12)
    np.testing.assert_allclose(padded.state.position[: N + 1], found.state.position, atol=1e-12)


def test_height_inequality_is_the_solution_of_the_bounded_quadratic_problem():
    """KKT conditions, and the same cost as trying all four active sets."""
    prior, covariance = problems.departure()
    covariance = covariance.at[3:6, :].set(0.0).at[:, 3:6].set(0.0)
    prior = eqx.tree_at(lambda s: s.position, prior, jnp.zeros(3))
    rows = problems.rows(REST, HEIGHTS)
    solve = jax.jit(lambda samples: smooth_nonnegative(samples, rows, prior, covariance, problems.GRAVITY, 4))
    for lift in (-3.0, 0.0, 3.0):
        samples = eqx.tree_at(lambda s: s.signal, SAMPLES, SAMPLES.signal.at[10:20, 5].add(lift))
        found, floor = solve(samples)
        assert floor.converged
        heights = found.state.position[:-1, 2][HEIGHTS]
        multipliers = found.height_multiplier[HEIGHTS]
        assert (heights > -1e-8).all() and (multipliers >= 0).all()
        assert np.abs(heights * multipliers).max() < 1e-6
        costs = []
        for active in ([], [25], [50], [25, 50]):
            flags = np.zeros(N, bool)
            flags[active] = True
            exact = eqx.tree_at(lambda r: r.height_variance, problems.rows(REST, flags), jnp.zeros(len(REST)))
            tried = SMOOTH(samples, exact, prior, covariance, problems.GRAVITY, jnp.asarray(4))
            if (tried.state.position[:-1, 2][HEIGHTS] > -1e-8).all():
                costs.append(float(tried.cost))
        np.testing.assert_allclose(found.cost, min(costs), rtol=1e-6)
        assert int(floor.active.sum()) == int((multipliers > 0).sum())


def test_the_way_of_a_motion_is_as_well_known_as_the_dense_system_says():
    """r(arrival) − r(departure) of both motions, rows before and after them included."""
    prior, covariance = problems.departure()
    rows = Rows(jnp.asarray(REST), 1e-4 * jnp.ones(N), None, jnp.ones(N))
    samples = problems.samples(N)
    reference = strapdown(samples.signal, samples.period, prior, problems.GRAVITY)
    unseen = Rows(rows.rest, rows.velocity_variance, jnp.zeros(N, bool), rows.height_variance)
    _, _, _, joint = dense(reference, samples, unseen, prior, covariance, whole=True)
    found = SMOOTH_ABOUT(reference, samples, rows, prior, covariance, problems.GRAVITY)
    departure, arrival = jnp.array([7, 32]), jnp.array([25, 50])
    # Linearised about the same states as the dense system.
    start, known = jax.tree.map(lambda x: x[:-1], (reference, found.covariance))
    ways = jax.jit(displacement_covariance)(start, known, samples, rows, covariance, departure, arrival)
    for way, i, j in zip(ways, departure.tolist(), arrival.tolist(), strict=True):
        a, b = (slice(9 * k + 3, 9 * k + 6) for k in (i, j))
        expected = joint[b, b] + joint[a, a] - joint[a, b] - joint[b, a]
        np.testing.assert_allclose(way, expected, atol=1e-8 * np.abs(expected).max())
        # Better than positions apart, which share the error of where the motion began.
        assert np.trace(way) < np.trace(joint[a, a]) + np.trace(joint[b, b])
