"""Rotations against SciPy, and their derivatives at the zero rotation."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.inertial.rotations import (
    quat_between,
    quat_exp,
    quat_log,
    quat_multiply,
    quat_rotate,
    quat_to_matrix,
    skew,
)

VECTORS = [np.zeros(3), np.full(3, 1e-9), np.array([4e-4, -3e-4, 2e-4]), np.array([0.3, -0.2, 0.9])]


def scipy_rotation(q):
    return Rotation.from_quat(np.asarray(q), scalar_first=True)


@pytest.mark.parametrize("phi", VECTORS)
def test_exponential_equals_scipy_and_log_undoes_it(phi):
    q = quat_exp(jnp.asarray(phi))
    np.testing.assert_allclose(scipy_rotation(q).as_rotvec(), phi, atol=1e-15)
    np.testing.assert_allclose(quat_log(q), phi, atol=1e-15)
    np.testing.assert_allclose(quat_log(-q), phi, atol=1e-15)


def test_product_rotation_and_matrix_equal_scipy():
    p, q, v = quat_exp(jnp.asarray(VECTORS[3])), quat_exp(jnp.asarray([1.0, 2.0, -0.5])), jnp.arange(3.0)
    both = scipy_rotation(p) * scipy_rotation(q)
    np.testing.assert_allclose(quat_rotate(quat_multiply(p, q), v), both.apply(np.arange(3.0)), atol=1e-14)
    np.testing.assert_allclose(quat_to_matrix(p), scipy_rotation(p).as_matrix(), atol=1e-15)
    np.testing.assert_allclose(skew(v) @ jnp.ones(3), np.cross(v, np.ones(3)))


@pytest.mark.parametrize("phi", VECTORS)
def test_derivatives_are_finite_and_right_at_and_near_zero(phi):
    phi = jnp.asarray(phi)
    for f in (quat_exp, lambda x: quat_log(quat_exp(x))):
        forward, reverse = jax.jacfwd(f)(phi), jax.jacrev(f)(phi)
        np.testing.assert_allclose(forward, reverse, atol=1e-14)
        step = 1e-6
        numeric = np.stack([(f(phi + step * e) - f(phi - step * e)) / (2 * step) for e in np.eye(3)], axis=1)
        np.testing.assert_allclose(forward, numeric, atol=1e-9)
        assert np.isfinite(jax.jacfwd(jax.jacfwd(f))(phi)).all()


@pytest.mark.parametrize("to", [[0.0, 0.0, 2.0], [1.0, 2.0, -3.0], [-1.0, 0.0, 0.0]])
def test_quat_between_takes_one_direction_to_the_other(to):
    start = jnp.array([1.0, 0.0, 0.0])
    turned = quat_rotate(quat_between(start, jnp.asarray(to)), start)
    np.testing.assert_allclose(turned, np.asarray(to) / np.linalg.norm(to), atol=1e-12)
