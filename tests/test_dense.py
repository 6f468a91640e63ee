"""Matrices of a batch on their own: the numbers of NumPy, and no batched LAPACK call in the program."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsat.inertial.dense import eigh, inverse_positive, solve_positive

ROOT = np.random.default_rng(0).normal(size=(3, 5, 5))
POSITIVE = ROOT @ np.swapaxes(ROOT, 1, 2) + np.eye(5)
RIGHT = np.random.default_rng(1).normal(size=(3, 5))


def test_a_batch_is_solved_as_by_numpy():
    found = jax.jit(jax.vmap(solve_positive))(jnp.asarray(POSITIVE), jnp.asarray(RIGHT))
    np.testing.assert_allclose(found, np.linalg.solve(POSITIVE, RIGHT[..., None])[..., 0], rtol=1e-10)
    found = jax.jit(jax.vmap(inverse_positive))(jnp.asarray(POSITIVE))
    np.testing.assert_allclose(found, np.linalg.inv(POSITIVE), rtol=1e-9, atol=1e-12)
    values, vectors = jax.jit(jax.vmap(eigh))(jnp.asarray(POSITIVE))
    np.testing.assert_allclose(values, np.linalg.eigvalsh(POSITIVE), rtol=1e-10)
    np.testing.assert_allclose(POSITIVE @ vectors, vectors * values[:, None], atol=1e-10)


@pytest.mark.parametrize(
    "function", [inverse_positive, eigh, lambda matrix: solve_positive(matrix, jnp.ones(5))]
)
def test_no_lapack_call_takes_a_batch(function):
    """Two that do so at a time may wait for each other for ever."""
    if jax.default_backend() != "cpu":
        pytest.skip("batches are one call on an accelerator")
    text = jax.jit(jax.vmap(function)).lower(jnp.asarray(POSITIVE)).as_text()
    calls = [line for line in text.splitlines() if "lapack_" in line or "blas_" in line]
    assert calls and not any("3x5x5xf64" in line for line in calls)
    plain = jax.jit(jax.vmap(jnp.linalg.inv)).lower(jnp.asarray(POSITIVE)).as_text()
    assert any("3x5x5xf64" in line for line in plain.splitlines() if "lapack_" in line)
