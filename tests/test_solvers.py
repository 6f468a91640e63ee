"""Both solvers on bounded problems with a known answer, and on a real recording with each other."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from jaxsat.config import load_config
from jaxsat.pipeline import estimate
from jaxsat.saturation.solvers import (
    Box,
    Status,
    box_step,
    dense_box_step,
    projected_gauss_newton,
    projected_gradient,
)

RNG = np.random.default_rng(4)
A = RNG.normal(size=(6, 8)) * np.geomspace(1.0, 30.0, 8)
B = RNG.normal(size=6) * 20.0
UPPER = np.geomspace(2.0, 0.05, 8)
OPTIMUM = lsq_linear(A, B, (np.zeros(8), UPPER), tol=1e-12)
SCALE = jnp.asarray(1.0 / np.sqrt(np.sum(A**2, axis=0)))
both = pytest.mark.parametrize("solver", [projected_gradient, projected_gauss_newton])


def least_squares(residual):
    """A problem as the solvers want it: value, gradient, and columns of the Gauss-Newton factor."""

    def linearise(x):
        r, J = residual(x), jax.jacfwd(residual)(x)
        return 0.5 * jnp.sum(r**2), J.T @ r, tuple(J)

    return linearise


def solve(solver, upper=UPPER, stretch=1.0, tolerance=1e-7, max_iterations=4000):
    """The same problem in variables that are `stretch` times smaller."""
    stretch = jnp.asarray(np.broadcast_to(stretch, 8))
    fun = least_squares(lambda x: jnp.asarray(A) @ (x * stretch) - jnp.asarray(B))
    limits = jnp.zeros(8), jnp.zeros(8), jnp.asarray(upper) / stretch
    box = Box(*limits, SCALE / stretch, jnp.asarray(tolerance), max_iterations)
    return jax.jit(lambda: solver(fun, box))()


@both
def test_finds_the_bounded_minimum_and_proves_it(solver):
    found = solve(solver)
    assert found.status == Status.CONVERGED and found.residual <= 1e-7
    assert np.isclose(OPTIMUM.x, 0, atol=1e-9).any() or np.isclose(OPTIMUM.x, UPPER).any(), (
        "a bound is active"
    )
    np.testing.assert_allclose(found.value, OPTIMUM.cost, rtol=1e-8)
    assert (found.x >= 0.0).all() and (found.x <= UPPER * (1 + 1e-12)).all()


@both
def test_scaled_variables_make_the_result_independent_of_units(solver):
    """Curvatures of 1e6 and more in raw variables: jaxopt alone stops far from the optimum there."""
    stretch = np.geomspace(1e-4, 1e4, 8)
    np.testing.assert_allclose(solve(solver, stretch=stretch).x * stretch, solve(solver).x, atol=1e-7)


@both
def test_running_out_of_iterations_is_said(solver):
    rosenbrock = least_squares(lambda x: jnp.stack([14.0 * (x[1] - x[0] ** 2), 1.4 * (1.0 - x[0])]))
    start, lower, upper, scale = jnp.array([0.1, 0.9]), jnp.zeros(2), jnp.full(2, 2.0), jnp.full(2, 0.1)
    found = solver(rosenbrock, Box(start, lower, upper, scale, jnp.asarray(1e-9), 1))
    assert found.status == Status.MAX_ITERATIONS and found.residual > 1e-9
    later = solver(rosenbrock, Box(start, lower, upper, scale, jnp.asarray(1e-6), 3000))
    assert later.status == Status.CONVERGED
    np.testing.assert_allclose(later.x, 1.0, atol=1e-4)


@both
@pytest.mark.parametrize("held", [0, 5])
def test_a_variable_without_range_stays_where_it_is(solver, held):
    upper = UPPER.copy()
    upper[held] = 0.0
    found = solve(solver, upper)
    assert found.x[held] == 0.0 and found.status == Status.CONVERGED


def test_gauss_newton_takes_the_shortest_of_the_steps_that_the_data_cannot_tell_apart():
    wide = np.full(8, 1e3)
    fun = least_squares(lambda x: jnp.asarray(A[:3]) @ x - jnp.asarray(A[:3] @ np.ones(8)))
    limits = jnp.zeros(8), jnp.full(8, -1e3), jnp.asarray(wide)
    found = projected_gauss_newton(fun, Box(*limits, jnp.ones(8), jnp.asarray(1e-8), 200))
    np.testing.assert_allclose(found.x, np.linalg.pinv(A[:3]) @ A[:3] @ np.ones(8), atol=1e-6)


def test_gauss_newton_traces_what_it_minimises_once():
    """Tracing a segment takes seconds."""
    traced = []
    fun = least_squares(lambda x: jnp.asarray(A[:3]) @ x)
    box = Box(jnp.ones(8), jnp.full(8, -1.0), jnp.ones(8), jnp.ones(8), jnp.asarray(1e-8), 200)

    def told(x):
        traced.append(x)
        return fun(x)

    jax.jit(lambda box: projected_gauss_newton(told, box).x)(box)
    assert len(traced) == 1


@pytest.mark.parametrize("damping", [1e-6, 1e-2, 10.0])
def test_box_step_is_the_solution_of_the_bounded_quadratic_problem(damping):
    gradient = A.T @ B
    low, high = -UPPER / 3.0, 2.0 * UPPER / 3.0
    d = box_step(
        jnp.asarray(gradient),
        tuple(jnp.asarray(A)),
        jnp.asarray(damping),
        jnp.asarray(low),
        jnp.asarray(high),
    )
    slope = gradient + A.T @ (A @ d) + damping * np.asarray(d)
    free = (d > low + 1e-12) & (d < high - 1e-12)
    np.testing.assert_allclose(slope[free], 0.0, atol=1e-6 * np.abs(gradient).max())
    assert (slope[np.asarray(d) <= low + 1e-12] >= 0).all() and (
        slope[np.asarray(d) >= high - 1e-12] <= 0
    ).all()


STEP = jax.jit(dense_box_step)


@pytest.mark.parametrize("width", [0.02, 0.3, 1e3])
@pytest.mark.parametrize("seed", range(5))
def test_dense_box_step_is_the_solution_of_the_bounded_quadratic_problem(seed, width):
    """From a box that holds almost everything to one that holds nothing; some variables have no range."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(12, 10)) * np.geomspace(0.1, 10.0, 10)
    hessian, wanted = root.T @ root, rng.normal(size=10) / np.geomspace(0.1, 10.0, 10)
    gradient = -hessian @ wanted
    low, high = -width * rng.uniform(0.1, 1.0, 10), width * rng.uniform(0.1, 1.0, 10)
    low[3] = high[3] = 0.01
    d = np.asarray(STEP(*map(jnp.asarray, (gradient, hessian, low, high))))
    assert (d >= low).all() and (d <= high).all()
    target = np.linalg.solve(root.T @ root, -gradient)
    value = gradient @ d + 0.5 * d @ hessian @ d
    free = np.arange(10) != 3
    # The same as least squares, the fixed variable taken out.
    rest = root @ target - root[:, 3] * low[3]
    oracle = lsq_linear(root[:, free], rest, (low[free], high[free]), method="bvls", tol=1e-14)
    expected = np.insert(oracle.x, 3, low[3])
    np.testing.assert_allclose(d, expected, atol=1e-6 * (1.0 + np.abs(expected).max()))
    assert value <= gradient @ expected + 0.5 * expected @ hessian @ expected + 1e-9 * np.abs(gradient).max()
    slope = gradient + hessian @ d
    inside = (d > low) & (d < high)
    assert inside.sum() == 9 if width == 1e3 else inside.sum() < 9
    tolerance = 1e-6 * np.abs(gradient).max()
    assert (np.abs(slope[inside]) < tolerance).all()
    assert (slope[(d == low) & free] > -tolerance).all() and (slope[(d == high) & free] < tolerance).all()


@pytest.mark.slow
def test_both_solvers_end_at_the_same_cost_on_a_recording_that_truly_saturated(pyshoe_trial):
    """Twelve segments side by side, of very unlike curvatures."""
    recording = pyshoe_trial("2017-11-22-11-35-59")
    settings = {"method": "direct", "saturation.sweeps": 1, "saturation.tolerance": 1e-6}
    newton, gradient = (
        estimate(
            recording,
            load_config(None, **settings, **{"saturation.solver": solver, "saturation.max_iterations": most}),
        ).fills
        for solver, most in (("gauss_newton", 100), ("projected_gradient", 20_000))
    )
    busy = newton.status != Status.NOTHING_TO_DO
    assert busy.sum() == 12
    assert (newton.status[busy] == Status.CONVERGED).all() and (gradient.status == newton.status).all()
    np.testing.assert_allclose(gradient.cost_after, newton.cost_after, rtol=1e-6)
