"""Small random problems, and an oracle, that several test files share; shapes are few so that compilations are."""

import jax.numpy as jnp
import numpy as np

from jaxsat.inertial.rotations import quat_exp, quat_multiply, quat_rotate
from jaxsat.inertial.smoother import Rows
from jaxsat.inertial.strapdown import Interval, NavState, Samples

GRAVITY = jnp.asarray(9.81)


def samples(count: int = 60, seed: int = 0, isotropic: bool = False) -> Samples:
    """A lively random motion with noise that differs between samples (and between axes)."""
    rng = np.random.default_rng(seed)
    gyr = np.cumsum(rng.normal(size=(count, 3)), axis=0)
    acc = 3.0 * rng.normal(size=(count, 3)) + [0.0, 0.0, 9.81]
    spread = rng.uniform(1.0, 3.0, (count, 2 if isotropic else 6))
    spread = np.repeat(spread, 3, axis=1) if isotropic else spread
    return Samples(
        signal=jnp.asarray(np.concatenate([gyr, acc], axis=1)),
        period=jnp.asarray(rng.uniform(0.004, 0.006, count)),
        variance=jnp.asarray(spread * np.repeat([1e-4, 1e-2], 3)),
    )


def rows(rest: np.ndarray, height: np.ndarray | None = None) -> Rows:
    """A velocity of some cm/s in the body frame to 1 cm/s, height to 2 cm."""
    height = np.zeros_like(rest) if height is None else height
    everywhere = jnp.ones(len(rest))
    velocity = jnp.asarray(0.03 * np.random.default_rng(7).normal(size=(len(rest), 3)))
    return Rows(jnp.asarray(rest), 1e-4 * everywhere, jnp.asarray(height), 4e-4 * everywhere, velocity)


def departure(seed: int = 0) -> tuple[NavState, jnp.ndarray]:
    """A state with a full covariance."""
    rng = np.random.default_rng(100 + seed)
    root = 0.02 * rng.normal(size=(9, 9))
    state = NavState(quat_exp(jnp.asarray(rng.normal(size=3))), *jnp.asarray(0.1 * rng.normal(size=(2, 3))))
    return state, jnp.asarray(root @ root.T)


def compose(first: Interval, second: Interval) -> Interval:
    """Two neighbouring intervals as one; associative. The oracle of every faster way to join many."""
    velocity = quat_rotate(first.rotation, second.velocity)
    position = quat_rotate(first.rotation, second.position)
    return Interval(
        rotation=quat_multiply(first.rotation, second.rotation),
        velocity=first.velocity + velocity,
        position=first.position + first.velocity * second.duration + position,
        duration=first.duration + second.duration,
    )
