"""Projected gradient on bounded quadratics with a known answer."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.optimize import lsq_linear

from jaxsat.saturation.solvers import Status, projected_gradient

RNG = np.random.default_rng(4)
A = RNG.normal(size=(12, 8)) * np.geomspace(1.0, 30.0, 8)
B = RNG.normal(size=12) * 20.0
UPPER = np.geomspace(2.0, 0.05, 8)
EXACT = lsq_linear(A, B, (np.zeros(8), UPPER), tol=1e-12).x


@jax.jit
def solve(scale, stretch, max_iterations=2000):
    """The same problem in variables that are `stretch` times smaller."""

    def fun(x):
        return 0.5 * jnp.sum((jnp.asarray(A) @ (x * stretch) - jnp.asarray(B)) ** 2)

    return projected_gradient(
        fun,
        jnp.zeros(8),
        jnp.zeros(8),
        jnp.asarray(UPPER) / stretch,
        scale / stretch,
        jnp.asarray(1e-6),
        max_iterations,
    )


SCALE = jnp.asarray(1.0 / np.sqrt(np.sum(A**2, axis=0)))


def test_finds_the_bounded_minimum_and_proves_it():
    found = solve(SCALE, jnp.ones(8))
    assert found.status == Status.CONVERGED and found.residual <= 1e-6
    np.testing.assert_allclose(found.x, EXACT, atol=1e-6)
    assert (EXACT == 0).any() or (np.isclose(EXACT, UPPER)).any(), "a bound is active in this problem"


def test_scaled_variables_make_the_result_independent_of_units():
    """Curvatures of 1e6 and more in raw variables: jaxopt alone stops far from the optimum there."""
    found = solve(SCALE, jnp.ones(8))
    other = solve(SCALE, jnp.geomspace(1e-4, 1e4, 8))
    np.testing.assert_allclose(other.x * jnp.geomspace(1e-4, 1e4, 8), found.x, atol=1e-8)


def test_running_out_of_iterations_is_said():
    def rosenbrock(x):
        return 100.0 * (x[1] - x[0] ** 2) ** 2 + (1.0 - x[0]) ** 2

    found = projected_gradient(
        rosenbrock,
        jnp.array([0.1, 0.9]),
        jnp.zeros(2),
        jnp.full(2, 2.0),
        jnp.full(2, 0.1),
        jnp.asarray(1e-9),
        1,
    )
    assert found.status == Status.MAX_ITERATIONS and found.residual > 1e-9


@pytest.mark.parametrize("held", [0, 5])
def test_a_variable_without_range_stays_where_it_is(held):
    upper = jnp.asarray(UPPER).at[held].set(0.0)

    def fun(x):
        return 0.5 * jnp.sum((jnp.asarray(A) @ x - jnp.asarray(B)) ** 2)

    found = projected_gradient(fun, jnp.zeros(8), jnp.zeros(8), upper, SCALE, jnp.asarray(1e-6), 2000)
    assert found.x[held] == 0.0 and found.status == Status.CONVERGED
