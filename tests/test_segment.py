"""f(δ) in closed form against the sample-by-sample filter, and its derivatives."""

import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest

from jaxsat.inertial.rotations import quat_conjugate, quat_to_matrix
from jaxsat.inertial.smoother import closed_loop, smooth_about
from jaxsat.inertial.strapdown import NavState, Samples, add_error, error_between, strapdown
from jaxsat.saturation.arrival import arrivals
from jaxsat.saturation.gap_shapes import Edges
from jaxsat.saturation.segment import Segment, condense, objective, value_gradient_root

MOVING, RESTING = 64, 40
N = MOVING + RESTING
CUT, ELEMENT, CHANNEL = [20, 21, 22, 40, 41], [0, 1, 1, 2, 3, 4], [1, 1, 5, 1, 2, 4]
SAMPLES = problems.samples(N, seed=5, isotropic=True)
REST = np.arange(N) >= MOVING


def arrival_table():
    return jax.jit(arrivals)(SAMPLES, problems.rows(REST), jnp.array([MOVING]), jnp.array([N]), RESTING)


def build(height: bool, departure=None) -> Segment:
    state, covariance = problems.departure() if departure is None else departure
    no_gap = jnp.zeros(1)
    return Segment(
        signal=SAMPLES.signal[:MOVING],
        period=SAMPLES.period[:MOVING],
        variance=SAMPLES.variance[:MOVING, jnp.array([0, 3])],
        cut=jnp.array([*CUT, MOVING, MOVING, MOVING]),
        element=jnp.array([*ELEMENT, 0, 0]),
        channel=jnp.array([*CHANNEL, 0, 0]),
        sign=jnp.array([1.0, 1.0, -1.0, -1.0, 1.0, 1.0, 0.0, 0.0]),
        bound=jnp.array([5.0] * 6 + [0.0] * 2),
        start=jnp.zeros(8),
        gap=jnp.zeros(8, int),
        edges=Edges(*[no_gap] * 7, sound=no_gap > 0),
        departure=state,
        departure_covariance=covariance,
        arrival=arrival_table()[0],
        height=jnp.asarray(True) if height else None,
        height_variance=jnp.asarray(4e-4),
    )


F = jax.jit(lambda delta, segment: objective(delta, condense(segment), problems.GRAVITY))
GRADIENT = jax.jit(jax.grad(F))
DELTA = jnp.asarray(np.random.default_rng(1).uniform(0.0, 2.0, 8))


def oracle(delta, height: bool, departure=None):
    """J* of the linear filter over moving and resting samples, about the open-loop strapdown."""
    state, covariance = problems.departure() if departure is None else departure
    segment = build(height, departure)
    sample = jnp.asarray(CUT)[segment.element[:6]]
    signal = SAMPLES.signal.at[sample, segment.channel[:6]].add(segment.sign[:6] * delta[:6])
    samples = Samples(signal, SAMPLES.period, SAMPLES.variance)
    reference = strapdown(signal, SAMPLES.period, state, problems.GRAVITY)
    first = np.arange(N) == MOVING
    rows = problems.rows(REST, first if height else None)
    return smooth_about(reference, samples, rows, state, covariance, problems.GRAVITY).cost


@pytest.mark.parametrize("height", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_objective_and_gradient_equal_the_sample_by_sample_filter(height):
    segment = build(height)
    value, gradient = jax.jit(jax.value_and_grad(lambda d: oracle(d, height)))(DELTA)
    np.testing.assert_allclose(F(DELTA, segment), value, rtol=1e-10)
    found = GRADIENT(DELTA, segment)
    np.testing.assert_allclose(found, gradient, atol=1e-10 * np.abs(gradient).max())


def test_gradient_equals_central_differences_and_forward_mode():
    segment = build(False)
    reverse = GRADIENT(DELTA, segment)
    forward = jax.jit(jax.jacfwd(F))(DELTA, segment)
    step = 1e-5
    numeric = [(F(DELTA + step * e, segment) - F(DELTA - step * e, segment)) / (2 * step) for e in np.eye(8)]
    scale = np.abs(reverse).max()
    np.testing.assert_allclose(reverse, forward, atol=1e-10 * scale)
    np.testing.assert_allclose(reverse, np.array(numeric), atol=1e-6 * scale)
    assert not reverse[6:].any(), "padded values have no influence"


SPREAD = jnp.diag(jnp.array([1e-4, 1e-4, 1e-4, 0, 0, 0, 1e-4, 1e-4, 1e-4]))


def heading_turned(state: NavState) -> NavState:
    """The same motion in a world that is turned about the vertical, and elsewhere."""
    angle = 0.8
    spin = jnp.array([[np.cos(angle), -np.sin(angle), 0], [np.sin(angle), np.cos(angle), 0], [0, 0, 1]])
    turned = add_error(state, jnp.array([0, 0, angle, 7.0, -2.0, 1.0, 0, 0, 0]))
    return NavState(turned.q_nb, spin @ state.velocity, turned.position)


def test_objective_does_not_depend_on_heading_or_position():
    state, _ = problems.departure()
    here, there = build(False, (state, SPREAD)), build(False, (heading_turned(state), SPREAD))
    np.testing.assert_allclose(F(DELTA, here), F(DELTA, there), rtol=1e-10)


@pytest.mark.parametrize("uncertain", [1.0, 1e6])
def test_gradient_keeps_its_digits_however_uncertain_the_departure(uncertain):
    """Turned, the same numbers are rounded otherwise: what differs is rounding."""
    state, _ = problems.departure()
    here = build(False, (state, uncertain * SPREAD))
    there = build(False, (heading_turned(state), uncertain * SPREAD))
    gradient = GRADIENT(DELTA, here)
    np.testing.assert_allclose(GRADIENT(DELTA, there), gradient, atol=1e-12 * np.abs(gradient).max())


def test_padding_changes_nothing():
    segment = build(False)

    def pad(x):
        return jnp.concatenate([x, jnp.zeros((64, *x.shape[1:]))])

    longer = Segment(
        **{
            **{f: getattr(segment, f) for f in segment.__dataclass_fields__},
            "signal": pad(segment.signal),
            "period": pad(segment.period),
            "variance": pad(segment.variance),
            "cut": jnp.array([*CUT, 128, 128, 128]),
        }
    )
    np.testing.assert_allclose(F(DELTA, longer), F(DELTA, segment), rtol=1e-12)


def test_gauss_newton_factor_is_the_sensitivity_of_the_arrival_in_the_metric_of_the_data():
    """A Aᵀ against derivatives of the strapdown, and the weight of the data by dense inverses."""
    segment = build(False)
    state, covariance = problems.departure()
    sample = jnp.asarray(CUT)[segment.element[:6]]

    def moved(delta):
        signal = SAMPLES.signal.at[sample, segment.channel[:6]].add(segment.sign[:6] * delta)
        path = strapdown(signal[:MOVING], SAMPLES.period[:MOVING], state, problems.GRAVITY)
        return jax.tree.map(lambda x: x[-1], path)

    end = moved(DELTA[:6])
    J = jax.jacfwd(lambda delta: error_between(moved(delta), end))(DELTA[:6])[np.array([0, 1, 2, 6, 7, 8])]
    # The covariance on arrival, by the filter.
    signal = SAMPLES.signal.at[sample, segment.channel[:6]].add(segment.sign[:6] * DELTA[:6])
    samples = jax.tree.map(lambda x: x[:MOVING], Samples(signal, SAMPLES.period, SAMPLES.variance))
    nowhere = problems.rows(np.zeros(MOVING, bool))
    P = closed_loop(samples, nowhere, state, covariance, problems.GRAVITY).covariance
    P = P[-1][np.ix_([0, 1, 2, 6, 7, 8], [0, 1, 2, 6, 7, 8])]
    R = quat_to_matrix(quat_conjugate(end.q_nb))
    D = np.kron(np.eye(2), R)
    information = np.asarray(segment.arrival)[:6, :6]
    weight = information @ np.linalg.inv(np.eye(6) + D @ P @ D.T @ information)
    expected = J.T @ D.T @ weight @ D @ J
    _, _, columns = value_gradient_root(DELTA, condense(segment), problems.GRAVITY)
    A = np.stack(columns, axis=1)
    assert not A[6:].any() and A[:6].any(axis=1).all(), "every saturated value counts, and no padding"
    np.testing.assert_allclose(A[:6] @ A[:6].T, expected, atol=2e-3 * np.abs(expected).max())


def test_no_rest_after_means_no_information():
    segment = build(False)
    blind = Segment(
        **{
            **{f: getattr(segment, f) for f in segment.__dataclass_fields__},
            "arrival": jnp.zeros((10, 10)),
        }
    )
    assert F(DELTA, blind) == 0.0
    assert not GRADIENT(DELTA, blind).any()
