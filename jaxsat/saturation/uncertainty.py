"""How well filled values are known: the posterior of δ where a signal prior and the rests meet.

About its mode the posterior is Gaussian with precision Ω + A Aᵀ: that of the prior, and that of the data in six
directions (attitude and velocity on arrival). Each value lies beyond its rail and within its bound: what is reported
is the mean of that Gaussian cut off there (`jaxsat.saturation.truncated`), and the sd about it.

The noise of the data is that of the sensor; what scale errors of the sensor, its mounting or a foot that rolls do to
attitude and velocity on arrival is not in it. It shows in what the data leave unexplained at the mode, and their
variance is scaled by as much: the a posteriori variance factor of geodesy. It is twice what f(δ) exceeds the rest's
own misfit, over the directions that δ did not take up (MacKay 1992, "Bayesian interpolation": the noise level by the
evidence).
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsat.inertial.dense import eigh, inverse_positive, solve_positive
from jaxsat.saturation.arrival import own_misfit
from jaxsat.saturation.experience import Heard
from jaxsat.saturation.segment import Segment
from jaxsat.saturation.truncated import truncated_moments

# As if in so many directions more as much had been left as expected: one motion alone says little about its scale.
CREDIT = 3.0
# Share of the prior's variance along a direction of δ that must be removed for it to count.
LEAST_SEEN = 0.01
# Share of the variance of what a gap lost that the rests must remove for others to learn from it.
LEAST_HEARD = 0.5


class Uncertainty(eqx.Module):
    """Of the filled values of one segment; zeros where a value is padded."""

    mean: Float[Array, "m"]
    """Of δ, within its limits; where a gap is not to be filled, δ as it is."""
    sd: Float[Array, "m"]
    """Of each value (its unit)."""
    gap_sd: Float[Array, "m"]
    """Of the sum of δ over the gap that the value lies in (its unit; times the period that is the impulse's)."""
    identified: Float[Array, "m"]
    """Share of the prior's variance of that sum which the rests removed: 0 where the prior alone decides."""
    heard: Heard
    """For the next search."""
    asked: Float[Array, ""]
    """By what the data ask for their variance to be scaled, be it less than one; NaN where no rest follows, a
    bound holds δ or a gap is not to be filled."""
    rank: Int[Array, ""]
    """In how many directions of δ the rests say anything, six at most and 0 where no rest follows: eigenvalues of the
    data's Hessian in the prior's metric above `LEAST_SEEN`."""
    arrival: Float[Array, "6"]
    """Root of the variance of [θ, v] on arrival (rad, m/s) under the prior that the rests removed."""


def uncertainty(
    segment: Segment,
    delta: Float[Array, "m"],
    value: Float[Array, ""],
    slope: Float[Array, "m"],
    columns: tuple[Float[Array, "m"], ...],
    effects: tuple[Float[Array, "m"], ...],
) -> Uncertainty:
    """At the mode δ of a segment that has a signal prior.

    value, slope: of f(δ) + ½ δᵀΩδ + bᵀδ there; columns: of A; effects: what each δ does to [θ, v] on
    arrival, wherever the search began.
    """
    known = segment.known
    assert known is not None, "the signal prior was gathered"
    A, one = jnp.stack(columns, axis=1), jnp.eye(len(columns))
    real = segment.bound > 0.0
    together = (segment.gap[:, None] == segment.gap[None]) & real[:, None] & real[None]

    def of_gap(values):
        return jnp.zeros_like(values).at[segment.gap].add(jnp.where(real, values, 0.0))[segment.gap]

    def variance(covariance):
        return of_gap(jnp.sum(jnp.where(together, covariance, 0.0), axis=1))

    # The centre of the Gaussian that was searched: where a limit holds δ, it lies beyond it.
    seen = known.covariance @ A
    strength = A.T @ seen
    held = variance(known.covariance - seen @ solve_positive(one + strength, seen.T))
    free = jnp.trace(solve_positive(one + strength, one))

    left = value - delta @ (known.slope + 0.5 * known.precision @ delta) - own_misfit(segment.arrival)
    asked = (2.0 * left + CREDIT) / (free + CREDIT)
    factor = jnp.maximum(asked, 1.0)
    # What δ is kept from explaining is no noise.
    kept = jnp.any(real & ((delta >= segment.bound * (1.0 - 1e-9)) | known.harmful))
    before = known.believed
    seen = before @ A
    after = before - seen @ solve_positive(factor * one + A.T @ seen, seen.T)

    # The posterior of the sum is the product of two Gaussians: where the rests tell most of it, what they say is what
    # the prior lacks.
    wide = variance(known.covariance)
    told = 1.0 - held / jnp.where(wide > 0.0, wide, 1.0)
    clear = real & (told > LEAST_HEARD) & ~known.harmful
    told = jnp.where(clear, told, 1.0)
    heard = Heard(
        sum=jnp.where(real, (of_gap(delta) - (1.0 - told) * known.expected) / told, 0.0),
        variance=jnp.where(clear, factor * held / told, jnp.inf),
        expected=jnp.where(real, known.alone, 0.0),
    )

    gap_before = variance(before)
    share = 1.0 - variance(after) / jnp.where(gap_before > 0.0, gap_before, 1.0)
    strengths, _ = eigh(A.T @ seen / factor)
    moved = jnp.stack(effects, axis=1)
    removed = jnp.einsum("ik,ij,jk->k", moved, before - after, moved)
    filled = real & ~known.harmful
    # What the data say is a quadratic form about the mode.
    data = A @ (A.T @ delta) - slope + known.precision @ delta + known.slope
    certain = inverse_positive(before)

    def posterior(factor):
        pull = data / factor - certain @ (known.covariance @ known.slope)
        return truncated_moments(certain + A @ A.T / factor, pull, segment.bound, filled)

    # δ does without the factor: sums of gaps were further from the truth with it.
    (mean, away), (_, spread) = jax.lax.map(posterior, jnp.stack([1.0, factor]))
    mean = jnp.where(filled, jnp.clip(mean, 0.0, segment.bound), delta)
    away = jnp.where(filled, away - mean, 0.0)
    of_value = jnp.sqrt(jnp.diagonal(spread) + away**2)
    of_sum = jnp.sqrt(variance(spread) + of_gap(away) ** 2)
    return Uncertainty(
        mean=mean,
        sd=jnp.where(real, jnp.where(known.harmful, jnp.sqrt(known.variance), of_value), 0.0),
        gap_sd=jnp.where(real, of_sum, 0.0),
        identified=jnp.where(real, share, 0.0),
        heard=heard,
        asked=jnp.where(jnp.any(segment.arrival != 0.0) & ~kept, asked, jnp.nan),
        rank=jnp.sum(strengths > LEAST_SEEN),
        arrival=jnp.sqrt(jnp.maximum(removed, 0.0)),
    )
