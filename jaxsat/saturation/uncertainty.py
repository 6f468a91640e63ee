"""How well filled values are known: the posterior of δ where a signal prior and the rests meet.

About its mode the posterior is Gaussian with precision Ω + A Aᵀ: that of the prior, and that of the data in six
directions (attitude and velocity on arrival). A value lies beyond its rail and within its bound, so its own
distribution is that Gaussian's marginal, cut off there.
"""

import equinox as eqx
import jax.numpy as jnp
from jax.scipy.stats import norm
from jaxtyping import Array, Float

from jaxsat.inertial.dense import solve_positive
from jaxsat.saturation.segment import Segment

# A cut-off further than so many sd into the tail: what is left there behaves as at this one.
_FURTHEST = 6.0


class Uncertainty(eqx.Module):
    """Of the filled values of one segment; zeros where a value is padded."""

    sd: Float[Array, "m"]
    """Of each value (its unit)."""
    gap_sd: Float[Array, "m"]
    """Of the sum of δ over the gap that the value lies in (its unit; times the period that is the impulse's)."""
    identified: Float[Array, "m"]
    """Share of the prior's variance of that sum which the rests removed: 0 where the prior alone decides."""


def uncertainty(
    segment: Segment,
    delta: Float[Array, "m"],
    slope: Float[Array, "m"],
    columns: tuple[Float[Array, "m"], ...],
) -> Uncertainty:
    """At the mode δ of a segment that has a signal prior.

    slope: of f(δ) and the prior's energy there; columns: of A.
    """
    known = segment.known
    assert known is not None, "the signal prior was gathered"
    before = known.covariance
    A = jnp.stack(columns, axis=1)
    seen = before @ A
    inner = jnp.eye(A.shape[1]) + A.T @ seen
    after = before - seen @ solve_positive(inner, seen.T)

    real = segment.bound > 0.0
    together = (segment.gap[:, None] == segment.gap[None]) & real[:, None] & real[None]

    def of_gap(covariance):
        rows = jnp.sum(jnp.where(together, covariance, 0.0), axis=1)
        return jnp.zeros_like(rows).at[segment.gap].add(rows)[segment.gap]

    gap_before, gap_after = of_gap(before), of_gap(after)
    share = 1.0 - gap_after / jnp.where(gap_before > 0.0, gap_before, 1.0)
    gap_sd = jnp.sqrt(jnp.maximum(gap_after, 0.0))
    # Where a bound holds δ, the Gaussian's own centre lies beyond it.
    centre, sd = delta - after @ slope, jnp.sqrt(jnp.maximum(jnp.diagonal(after), 1e-300))
    sd = jnp.where(known.harmful, jnp.sqrt(known.variance), truncated_sd(centre, sd, segment.bound))
    return Uncertainty(
        sd=jnp.where(real, sd, 0.0),
        gap_sd=jnp.where(real, gap_sd, 0.0),
        identified=jnp.where(real, share, 0.0),
    )


def truncated_sd(
    centre: Float[Array, "m"], sd: Float[Array, "m"], upper: Float[Array, "m"]
) -> Float[Array, "m"]:
    """sd of Gaussians cut off below 0 and above `upper`."""
    low = jnp.minimum(-centre / sd, _FURTHEST)
    high = jnp.maximum((upper - centre) / sd, jnp.maximum(low + 1e-3, -_FURTHEST))
    low = jnp.minimum(low, high - 1e-3)
    inside = jnp.maximum(norm.cdf(high) - norm.cdf(low), 1e-300)
    at_low, at_high = norm.pdf(low) / inside, norm.pdf(high) / inside
    shrink = 1.0 + low * at_low - high * at_high - (at_low - at_high) ** 2
    return sd * jnp.sqrt(jnp.clip(shrink, 0.0, 1.0))
