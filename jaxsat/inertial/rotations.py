"""Rotations: unit quaternions (Hamilton, scalar first) and rotation vectors, one example at a time.

`q_nb` takes body vectors to the navigation frame: v_n = q ⊗ v_b ⊗ q*. Every function is smooth at the zero
rotation, the common case of a sensor at rest, in value and in derivatives of any order.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float

# Below this squared angle (rad²) series replace trigonometric quotients; both agree to 1e-16 there.
_SMALL = 1e-6


def skew(v: Float[Array, "3"]) -> Float[Array, "3 3"]:
    """Cross-product matrix: skew(v) @ w = v × w."""
    x, y, z = v
    zero = jnp.zeros_like(x)
    return jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])


def _half_angle_factors(phi: Float[Array, "3"]) -> tuple[Float[Array, ""], Float[Array, ""]]:
    """cos(|φ|/2) and sin(|φ|/2)/|φ|."""
    square = phi @ phi
    small = square < _SMALL
    angle = jnp.sqrt(jnp.where(small, 1.0, square))
    cosine = jnp.where(small, 1.0 - square / 8.0 + square**2 / 384.0, jnp.cos(0.5 * angle))
    sine = jnp.where(small, 0.5 - square / 48.0 + square**2 / 3840.0, jnp.sin(0.5 * angle) / angle)
    return cosine, sine


def quat_exp(phi: Float[Array, "3"]) -> Float[Array, "4"]:
    """Quaternion of the rotation vector φ (rad)."""
    cosine, sine = _half_angle_factors(phi)
    return jnp.concatenate([cosine[None], sine * phi])


def quat_log(q: Float[Array, "4"]) -> Float[Array, "3"]:
    """Rotation vector (rad, |φ| ≤ π) of a unit quaternion of either sign."""
    q = jnp.where(q[0] < 0, -q, q)
    w, vector = q[0], q[1:]
    square = vector @ vector
    small = square < _SMALL
    sine = jnp.sqrt(jnp.where(small, 1.0, square))
    # 2 asin(s)/s = 2 + s²/3 + 3 s⁴/20 near zero.
    factor = jnp.where(small, 2.0 + square / 3.0 + 0.15 * square**2, 2.0 * jnp.arctan2(sine, w) / sine)
    return factor * vector


def quat_multiply(p: Float[Array, "4"], q: Float[Array, "4"]) -> Float[Array, "4"]:
    """Hamilton product p ⊗ q: first q, then p."""
    scalar = p[0] * q[0] - p[1:] @ q[1:]
    vector = p[0] * q[1:] + q[0] * p[1:] + jnp.cross(p[1:], q[1:])
    return jnp.concatenate([scalar[None], vector])


def quat_conjugate(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """The inverse rotation."""
    return jnp.concatenate([q[:1], -q[1:]])


def quat_rotate(q: Float[Array, "4"], v: Float[Array, "3"]) -> Float[Array, "3"]:
    """Rotate a vector: q ⊗ v ⊗ q*."""
    t = 2.0 * jnp.cross(q[1:], v)
    return v + q[0] * t + jnp.cross(q[1:], t)


def quat_normalise(q: Float[Array, "4"]) -> Float[Array, "4"]:
    """The nearest unit quaternion."""
    return q / jnp.sqrt(q @ q)


def quat_to_matrix(q: Float[Array, "4"]) -> Float[Array, "3 3"]:
    """Rotation matrix R(q) with R(q) v = q ⊗ v ⊗ q*."""
    w, x, y, z = q
    return jnp.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )


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
