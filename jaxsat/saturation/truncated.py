"""Mean and covariance of a Gaussian in many dimensions whose values have limits.

The mode of such a distribution says little of it: of a value that the Gaussian puts well below zero it is zero, and
the sum of many such values, as a path makes it, is too small. Expectation propagation finds the moments to a few per
cent in a few rounds (Cunningham, Hennig & Lacoste-Julien 2011, "Gaussian probabilities and expectation
propagation", arXiv:1111.6832): the limits of each value are stood in for by a Gaussian factor of it, chosen such that
its mean and variance are those with the limits themselves.
"""

import jax
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Bool, Float

from jaxsat.inertial.dense import inverse_root

# Sums over gaps of real recordings are then within 0.03 of their sd of what many rounds give; whole steps do not
# settle.
ROUNDS, STEP = 6, 0.7
# So many sd beyond a limit, and so many from one to the other.
DEEP, FLAT = 20.0, 1e-3


def truncated_moments(
    precision: Float[Array, "m m"],
    pull: Float[Array, "m"],
    upper: Float[Array, "m"],
    limited: Bool[Array, "m"],
) -> tuple[Float[Array, "m"], Float[Array, "m m"]]:
    """Of the density exp(−½ xᵀPx + hᵀx) where 0 ≤ x ≤ upper in the values that are limited.

    precision, pull: P, positive definite, and h; upper: finite. The other values may have any size and sign.
    """
    upper = jnp.where(limited, upper, 1.0)

    def gaussian(sites):
        weight, shift = sites
        root = inverse_root(precision + jnp.diag(weight))
        return root.T @ (root @ (pull + shift)), root

    def refine(_, sites):
        mean, root = gaussian(sites)
        # Of each value without its own factor, and then with its limits.
        certain = 1.0 / jnp.sum(root**2, axis=0)
        left = jnp.maximum(certain - sites[0], 1e-12 * certain)
        centre, share = limited_moments((certain * mean - sites[1]) / left, 1.0 / jnp.sqrt(left), upper)
        found = left / share - left, centre * left / share - (certain * mean - sites[1])
        return tuple(
            jnp.where(limited, old + STEP * (new - old), 0.0) for old, new in zip(sites, found, strict=True)
        )

    nothing = jnp.zeros_like(pull)
    mean, root = gaussian(jax.lax.fori_loop(0, ROUNDS, refine, (nothing, nothing)))
    return mean, root.T @ root


def limited_moments(
    centre: Float[Array, "m"], sd: Float[Array, "m"], upper: Float[Array, "m"]
) -> tuple[Float[Array, "m"], Float[Array, "m"]]:
    """Means of independent Gaussians between 0 and `upper`, and their variances as shares of sd²."""
    # Seen from the nearer limit, for tails are known to all digits on one side only.
    far = centre > 0.5 * upper
    near = jnp.where(far, upper - centre, centre)
    beyond = -near / sd
    low, high = jnp.minimum(beyond, DEEP), (upper - near) / sd
    log_low = norm.logsf(low)
    log_inside = log_low + jnp.log1p(-jnp.exp(norm.logsf(high) - log_low))
    at_low, at_high = (jnp.exp(norm.logpdf(x) - log_inside) for x in (low, high))
    moved = at_low - at_high
    # Between limits so near to each other all values are alike.
    flat = upper < FLAT * sd
    mean, share = near + sd * moved, 1.0 + low * at_low - high * at_high - moved**2
    mean, share = jnp.where(flat, 0.5 * upper, mean), jnp.where(flat, (upper / sd) ** 2 / 12.0, share)
    # Further out than that these are differences of large numbers; there a tail falls off like an exponential.
    fall = 1.0 / jnp.maximum(beyond, DEEP)
    mean = jnp.where(beyond > DEEP, sd * (fall - 2.0 * fall**3), mean)
    share = jnp.where(beyond > DEEP, fall**2 - 6.0 * fall**4 + 50.0 * fall**6, share)
    return jnp.where(far, upper - mean, mean), jnp.clip(share, 1e-60, 1.0)
