"""Vectors, rotations and matrices of components against NumPy and SciPy."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.inertial.components import SMALL, Cholesky, Matrix, Quaternion, Vector

RNG = np.random.default_rng(0)
A, B = RNG.normal(size=(2, 5, 3))
P, Q = (Rotation.from_rotvec(v) for v in RNG.normal(size=(2, 5, 3)))
M, K = RNG.normal(size=(5, 3, 6)), RNG.normal(size=(5, 6, 2))


def vector(array) -> Vector:
    return Vector.of(jnp.asarray(array))


def matrix(array) -> Matrix:
    return Matrix.of(jnp.asarray(array))


def quaternion(rotation: Rotation) -> Quaternion:
    return Quaternion.of(jnp.asarray(rotation.as_quat(scalar_first=True)))


def same(found, expected):
    np.testing.assert_allclose(found, expected, rtol=1e-13, atol=1e-14)


def test_vectors_equal_numpy():
    a, b = vector(A), vector(B)
    same((a + b).stack(), A + B)
    same((a - b * 2.0).stack(), A - 2 * B)
    same(a.dot(b), np.sum(A * B, axis=1))
    same(a.cross(b).stack(), np.cross(A, B))
    same(a.outer(b).stack(), A[:, :, None] * B[:, None, :])
    same(Matrix.skew(a)(b).stack(), np.cross(A, B))


def test_rotations_equal_scipy():
    p, q = quaternion(P), quaternion(Q)
    same((p @ q).matrix().stack(), (P * Q).as_matrix())
    same(p.rotate(vector(A)).stack(), P.apply(A))
    same(p.matrix()(vector(A)).stack(), P.apply(A))
    same(p.conjugate().matrix().stack(), P.inv().as_matrix())


@pytest.mark.parametrize("angle", [0.0, 1e-9, *np.sqrt(SMALL) * (1 + np.array([-1e-6, 1e-6])), 0.7, 3.1])
def test_exponential_equals_scipy_on_both_sides_of_the_series(angle):
    phi = angle * np.array([2.0, -1.0, 2.0]) / 3.0
    expected = Rotation.from_rotvec(phi).as_quat(scalar_first=True)
    np.testing.assert_allclose(Quaternion.exp(vector(phi)).stack(), expected, rtol=4e-16, atol=4e-16)


def test_derivatives_of_the_exponential_at_zero_are_exact():
    """exp(φ) = [1 − |φ|²/8; φ/2] to second order."""

    def f(phi):
        return Quaternion.exp(Vector.of(phi)).stack()

    half = np.concatenate([np.zeros((1, 3)), 0.5 * np.eye(3)])
    second = np.concatenate([-0.25 * np.eye(3)[None], np.zeros((3, 3, 3))])
    same(jax.jit(jax.jacfwd(f))(jnp.zeros(3)), half)
    same(jax.jit(jax.jacrev(f))(jnp.zeros(3)), half)
    same(jax.jit(jax.jacfwd(jax.jacrev(f)))(jnp.zeros(3)), second)


def test_matrices_equal_numpy():
    m, k, square = matrix(M), matrix(K), matrix(M[:, :, :3])
    same((m @ k).stack(), M @ K)
    same(m.T.stack(), np.swapaxes(M, 1, 2))
    same((m - m * 3.0).stack(), -2 * M)
    same(square(vector(A)).stack(), (M[:, :, :3] @ A[:, :, None])[:, :, 0])
    same(square.trace(), np.trace(M[:, :, :3], axis1=1, axis2=2))
    same(m.part(slice(1, 3), slice(2, 5)).stack(), M[:, 1:3, 2:5])
    same(Matrix.block([[m], [m * 2.0]]).stack(), np.concatenate([M, 2 * M], axis=1))
    same(Matrix.block([[square, m]]).stack(), np.concatenate([M[:, :, :3], M], axis=2))
    same(Matrix.column(tuple(vector(A))).stack(), A[:, :, None])
    same(jnp.stack(m.entries(), axis=-1), M.reshape(5, 18))
    assert m[2, 4] is m.rows[2][4]


def test_mirrored_reads_the_upper_triangle_only():
    lower = np.tril(np.full((5, 3, 3), np.nan), -1)
    upper = np.triu(M[:, :, :3])
    expected = upper + np.swapaxes(np.triu(upper, 1), 1, 2)
    same(matrix(upper + lower).mirrored().stack(), expected)


def test_structural_zeros_cost_nothing_and_stack_as_zeros():
    def multiplications(f, *arguments):
        return str(jax.make_jaxpr(f)(*arguments)).count(" mul ")

    a, b = vector(A[0]), vector(B[0])
    # Two products on each diagonal element, one elsewhere.
    assert multiplications(lambda a, b: (Matrix.skew(a) @ Matrix.skew(b)).entries(), a, b) == 12
    assert multiplications(lambda a: Matrix.skew(a)(Vector(0.0, 0.0, 2.0)), a) == 2
    same((Matrix.skew(a) @ Matrix.skew(b)).stack(), np.cross(A[0], np.cross(B[0], np.eye(3))).T)
    nothing = Matrix.identity(3, 0.0) @ matrix(M)
    assert nothing.entries() == (0.0,) * 18
    same((matrix(M) + nothing).stack(), M)
    # A zero that is data is not structural: what it meets may be infinite.
    assert jnp.isnan(Vector(jnp.zeros(()), 0.0, 0.0).dot(Vector(jnp.asarray(jnp.inf), 0.0, 0.0)))
    same(Matrix.identity(3, jnp.arange(5.0)).stack(), np.arange(5.0)[:, None, None] * np.eye(3))


@pytest.mark.parametrize("size", [1, 3, 6])
def test_cholesky_equals_numpy(size):
    root = RNG.normal(size=(5, size, size))
    S, right = root @ np.swapaxes(root, 1, 2) + 0.1 * np.eye(size), K[:, :size]
    L = np.linalg.cholesky(S)
    factor, b = Cholesky(matrix(S)), matrix(right)
    for found, expected in (
        (factor.forward(b), np.linalg.solve(L, right)),
        (factor.backward(b), np.linalg.solve(np.swapaxes(L, 1, 2), right)),
        (factor.solve(b), np.linalg.solve(S, right)),
    ):
        np.testing.assert_allclose(found.stack(), expected, rtol=1e-10, atol=1e-10)


def test_cholesky_reads_the_lower_triangle_only():
    root = RNG.normal(size=(3, 3))
    S = root @ root.T + np.eye(3)
    hidden = jnp.asarray(np.tril(S) + np.triu(np.full((3, 3), np.nan), 1))
    same(Cholesky(Matrix.of(hidden)).solve(Matrix.identity(3)).stack(), np.linalg.inv(S))
