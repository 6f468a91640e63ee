"""Moments of truncated Gaussians: exact in one dimension, by sampling in several."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.stats import truncnorm

from jaxsat.saturation.truncated import limited_moments, truncated_moments

MOMENTS, LIMITED = jax.jit(truncated_moments), jax.jit(limited_moments)


UPPER = 3.0


def test_independent_values_are_those_of_scipy():
    """Within the limits, at them, and far beyond either; limits that do not matter, that alone do, and none."""
    centre = np.array([1.0, 0.0, 0.5, -2.0, -40.0, 3.0, 60.0, 1.0, -3.0])
    sd = np.array([0.1, 0.5, 2.0, 1.0, 2.0, 0.4, 2.0, 80.0, 1.0])
    limited = np.arange(9) < 8
    mean, covariance = MOMENTS(
        *map(jnp.asarray, (np.diag(sd**-2), centre / sd**2, np.full(9, UPPER), limited))
    )
    cut = truncnorm(-centre / sd, (UPPER - centre) / sd, centre, sd)
    np.testing.assert_allclose(mean, np.where(limited, cut.mean(), centre), rtol=2e-3)
    np.testing.assert_allclose(np.diagonal(covariance), np.where(limited, cut.var(), sd**2), rtol=5e-3)


def test_far_beyond_a_limit_a_value_lies_as_near_to_it_as_an_exponential():
    """Continuous where the formula changes, and right where the usual one has no digits left."""
    sd, upper = np.full(8, 0.1), np.full(8, 50.0)
    depth = np.array([19.9, 20.1, 1e3, 1e5, 19.9, 20.1, 1e3, 1e5])
    centre = np.where(np.arange(8) < 4, -depth * sd, upper + depth * sd)
    mean, share = (np.asarray(x) for x in LIMITED(*map(jnp.asarray, (centre, sd, upper))))
    inside = np.where(np.arange(8) < 4, mean, upper - mean)
    np.testing.assert_allclose(inside, sd * (1 / depth - 2 / depth**3 + 10 / depth**5), rtol=1e-4)
    np.testing.assert_allclose(share, 1 / depth**2 - 6 / depth**4 + 50 / depth**6, rtol=1e-4)


def test_between_limits_that_are_near_a_value_lies_anywhere():
    sd = np.array([900.0, 1100.0, 1e8, 1e20])
    mean, share = (np.asarray(x) for x in LIMITED(*map(jnp.asarray, (sd / 3, sd, np.ones(4)))))
    np.testing.assert_allclose(mean, 0.5, atol=1e-3)
    np.testing.assert_allclose(np.sqrt(share) * sd, 12**-0.5, rtol=1e-2)


@pytest.mark.parametrize("seed", range(3))
def test_values_that_go_together_are_those_of_a_sampler(seed):
    """Gibbs sampling of six values, of which three of a kind lie below their limit by themselves."""
    rng = np.random.default_rng(seed)
    root = rng.normal(size=(6, 6))
    precision = root @ root.T + 0.5 * np.eye(6)
    centre = np.array([-1.0, -0.5, -1.0, 1.0, 0.3, 2.0])
    pull, limited = precision @ centre, np.array([True] * 5 + [False])
    upper = np.array([9.0, 9.0, 9.0, 1.0, 1.0, 9.0])
    mean, covariance = MOMENTS(*map(jnp.asarray, (precision, pull, upper, limited)))
    chains, sweeps, burned = 2000, 300, 50
    x, total, square = np.abs(rng.normal(size=(chains, 6))), np.zeros(6), np.zeros((6, 6))
    for sweep in range(sweeps):
        for i in range(6):
            sd = precision[i, i] ** -0.5
            at = (pull[i] - x @ precision[i] + x[:, i] * precision[i, i]) * sd**2
            low, high = (-at / sd, (upper[i] - at) / sd) if limited[i] else (-np.inf, np.inf)
            x[:, i] = truncnorm.rvs(low, high, at, sd, size=chains, random_state=rng)
        if sweep >= burned:
            total, square = total + x.mean(axis=0), square + x.T @ x / chains
    true = total / (sweeps - burned)
    sd = np.sqrt(np.diagonal(square / (sweeps - burned) - np.outer(true, true)))
    assert np.abs((mean - true) / sd).max() < 0.1
    np.testing.assert_allclose(np.sqrt(np.diagonal(covariance)), sd, rtol=0.1)


def test_without_limits_it_is_the_gaussian():
    precision = jnp.asarray([[2.0, 0.5], [0.5, 1.0]])
    mean, covariance = MOMENTS(precision, jnp.asarray([-1.0, -2.0]), jnp.ones(2), jnp.zeros(2, bool))
    np.testing.assert_allclose(covariance, np.linalg.inv(precision), rtol=1e-12)
    np.testing.assert_allclose(mean, np.linalg.solve(precision, [-1.0, -2.0]), rtol=1e-12, atol=1e-12)
