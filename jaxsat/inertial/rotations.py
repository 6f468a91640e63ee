"""Rotations as arrays: unit quaternions (Hamilton, scalar first) and rotation vectors, one example at a time.

`q_nb` takes body vectors to the navigation frame: v_n = q ⊗ v_b ⊗ q*. Every function is smooth at the zero
rotation, the common case of a sensor at rest, in value and in derivatives of any order. The mathematics is that of
`components`, except where a comment says why.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxsat.inertial.components import SMALL, Matrix, Quaternion, Vector


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Cross-product matrix: skew(v) @ w = v × w."""
    return Matrix.skew(Vector.of(v)).stack()


def quat_exp(phi: Float[Array, "3"]) -> Float[Array, "4"]:
    """Quaternion of the rotation vector φ (rad)."""
    return Quaternion.exp(Vector.of(phi)).stack()


def quat_log(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """Rotation vector (rad, |φ| ≤ π) of a unit quaternion of either sign."""
    q = jnp.where(q[0] < 0, -q, q)
    w, vector = q[0], q[1:]
    square = vector @ vector
    small = square < SMALL
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    # 2 asin(s)/s = 2 + s²/3 + 3 s⁴/20 near zero.
    factor = jnp.where(small, 2.0 + square / 3.0 + 0.15 * square**2, 2.0 * jnp.arctan2(sine, w) / sine)
    return factor * vector


def quat_multiply(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Hamilton product p ⊗ q: first q, then p."""
    return (Quaternion.of(p) @ Quaternion.of(q)).stack()


def quat_conjugate(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """The inverse rotation."""
    return Quaternion.of(q).conjugate().stack()


def quat_rotate(q: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotate a vector: q ⊗ v ⊗ q*."""
    # As arrays: inside a scan over samples the form of `components` makes the closed loop about 70 % slower.
    t = 2.0 * jnp.cross(q[1:], v)
    return v + q[0] * t + jnp.cross(q[1:], t)


def quat_normalise(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """The nearest unit quaternion."""
    return q / jnp.sqrt(q @ q)


def quat_to_matrix(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix R(q) with R(q) v = q ⊗ v ⊗ q*."""
    return Quaternion.of(q).matrix().stack()


def quat_between(a: Float[Array, "3"], b: Float[Array, "3"]) -> Float[Array, "4"]:
    """The smallest rotation that takes the direction of a to that of b."""
    a = a / jnp.sqrt(a @ a)
    b = b / jnp.sqrt(b @ b)
    # Opposite directions have no smallest rotation: turn half-way about any axis normal to a.
    opposite = 1.0 + a @ b < 1e-12
    axis = jnp.where(jnp.abs(a[0]) < 0.9, jnp.array([1.0, 0.0, 0.0]), jnp.array([0.0, 1.0, 0.0]))
    half_turn = jnp.concatenate([jnp.zeros(1), jnp.cross(a, axis)])
    direct = jnp.concatenate([(1.0 + a @ b)[None], jnp.cross(a, b)])
    return quat_normalise(jnp.where(opposite, half_turn, direct))
