"""What the search of all gaps of a recording teaches the next one.

A movement that repeats itself is clipped again and again. Gaps of a kind, of one channel and direction and about
as long, lose about as much, and those of which the rests tell much say what to expect of those of which they tell
little. Of long gaps this says more than the signal beside them. And where the rests contradict each other by more
than the sensor's noise in most motions, they are believed less in all.
"""

from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsat.inertial.dense import solve_positive
from jaxsat.saturation.gap_shapes import gap_ends

# Lengths (samples) by which gaps are compared; each twice the last.
NODES = (1, 2, 4, 8, 16, 32, 64)
# What a gap loses grows with its length to this power: of 0, 1, 1.5, 2 and 3 the one by which the gaps of the PyShoe
# list `clip`, clipped at 350, 250 and 200 °/s, say most of each other.
POWER = 1.5
# Variance of what says nothing, over that of the prior; finite, so that it is a number in any precision.
NOTHING = 1e12


class Heard(eqx.Module):
    """What the rests say of gaps, each value standing for the gap that it lies in (arrays of NumPy or JAX)."""

    sum: Float[Any, "*values"]
    """The sum of δ over the gap by the rests alone (its unit)."""
    variance: Float[Any, "*values"]
    """Of that; infinite where they say too little."""
    expected: Float[Any, "*values"]
    """The same sum by the signal beside the gap alone."""


class Experience(eqx.Module):
    """Of the gaps of each channel and direction, by length (`NODES`), rates being sums of δ over lengthᴾᴼᵂᴱᴿ."""

    count: Float[Array, "6 2 L"]
    """How many there were, each as far as its rate is known better than to itself."""
    mean: Float[Array, "6 2 L"]
    """Mean rate."""
    spread: Float[Array, "6 2 L"]
    """Variance of a further rate about it."""
    miss: Float[Array, "6 2 L"]
    """Mean square of the difference to the rate that the signal beside a gap made one expect."""
    noise: Float[Array, ""]
    """By what to scale the variance of all that the rests say."""

    @staticmethod
    def none() -> "Experience":
        nothing = jnp.zeros((6, 2, len(NODES)))
        return Experience(nothing, nothing, nothing, nothing, jnp.ones(()))


def length_weights(length: Float[Array, "*m"]) -> Float[Array, "*m L"]:
    """How near a length lies to each of `NODES`, in all one."""
    place = jnp.clip(jnp.log2(jnp.maximum(length, 1.0)), 0.0, len(NODES) - 1.0)
    return jnp.maximum(1.0 - jnp.abs(jnp.subtract.outer(place, jnp.arange(float(len(NODES))))), 0.0)


def experienced(
    before: Experience, sign: Int[Any, "N 6"], heard: Heard, factor: Float[Any, "S"]
) -> Experience:
    """What a search teaches that was made with the experience `before`.

    heard: [N, 6] each; factor: by what each motion asks for the variance of its data to be scaled, NaN where nothing
    was searched. Rates are random effects: what their differences exceed their own variances is their spread
    (DerSimonian and Laird 1986, Controlled Clinical Trials 7). Noise is asked for once: what experience and rests
    disagree on later would be taken for more of it again and again.
    """
    steps, (begins, ends) = jnp.arange(len(sign))[:, None], gap_ends(sign)
    last = jax.lax.cummin(jnp.where(ends, steps, len(sign)), reverse=True)
    length = jnp.where(begins, last - steps + 1, 1).astype(heard.sum.dtype)
    sound = begins & (heard.variance > 0.0) & jnp.isfinite(heard.variance)
    scale = length**POWER

    def each(x, otherwise):
        return jnp.where(sound, x, otherwise)[..., None, None]

    rate, variance = each(heard.sum / scale, 0.0), each(heard.variance / scale**2, 1.0)
    missed = each((heard.sum - heard.expected) ** 2 / scale**2, 0.0) - variance
    way = jnp.stack([sign > 0, sign < 0], axis=-1)
    near = jnp.where(sound[..., None] & way, 1.0, 0.0)[..., None] * length_weights(length)[..., None, :]

    def total(x):
        return jnp.sum(x, axis=0)

    def over(x, y):
        return x / jnp.maximum(y, 1e-300)

    weight = near / variance
    mean = over(total(weight * rate), total(weight))
    excess = total(weight * (rate - mean[None]) ** 2) - (total(near) - 1.0)
    spread = jnp.maximum(over(excess, total(weight) - over(total(weight**2), total(weight))), 0.0)
    spread = jnp.where(total(near) > 1.0, spread, 0.0)
    weight = near / (spread[None] + variance)
    mean, asked = over(total(weight * rate), total(weight)), jnp.nanmedian(factor)
    square = mean[None] ** 2
    return Experience(
        count=total(near * over(square, square + variance)),
        mean=mean,
        spread=spread + over(jnp.sign(total(weight)), total(weight)),
        miss=jnp.maximum(over(total(weight * missed), total(weight)), 0.0),
        noise=jnp.where(before.noise > 1.0, before.noise, jnp.fmax(asked, 1.0)),
    )


class Habit(eqx.Module):
    """What to expect of each gap, by its kind (one entry a gap)."""

    sum: Float[Array, "g"]
    """Of δ."""
    variance: Float[Array, "g"]
    """Of that; `NOTHING` where too few are known."""
    miss: Float[Array, "g"]
    """Mean square of how far off the signal beside such gaps was."""


def habit(
    experience: Experience, channel: Int[Array, "g"], sign: Float[Array, "g"], length: Float[Array, "g"]
) -> Habit:
    """Of some gaps. A gap is one of its kind itself, so one less is counted."""
    kind = channel, jnp.where(sign > 0.0, 0, 1)
    weights = length_weights(length) * experience.count[kind]
    count = jnp.sum(weights, axis=1)

    def of_kind(x):
        return jnp.sum(weights * x[kind], axis=1) / jnp.maximum(count, 1e-300)

    rate, spread, scale = of_kind(experience.mean), of_kind(experience.spread), length**POWER
    others = jnp.maximum(count - 1.0, 0.0)
    known = (others > 1e-6) & (rate > 0.0) & (length > 0.0)
    # The mean is known from so many; as if one more had been seen that lost twice as much, or nothing.
    variance = spread + (spread + rate**2) / jnp.maximum(others, 1e-6)
    return Habit(
        sum=jnp.where(known, scale * rate, 0.0),
        variance=jnp.where(known, scale**2 * variance, NOTHING),
        miss=jnp.where(known, scale**2 * of_kind(experience.miss) * others / (others + 1.0), 0.0),
    )


def with_habit(
    mean: Float[Array, "m"], covariance: Float[Array, "m m"], gaps: Float[Array, "m g"], known: Habit
) -> tuple[Float[Array, "m"], Float[Array, "m m"]]:
    """The Gaussian of the values of some gaps, given what gaps like them lost.

    gaps: which value lies in which. Where the signal beside such gaps was further off than it claimed, the variance
    of their sums is raised first.
    """
    claimed = jnp.diagonal(gaps.T @ covariance @ gaps)
    shape = covariance @ gaps / jnp.maximum(claimed, 1e-300)[None]
    covariance = covariance + (shape * jnp.maximum(known.miss - claimed, 0.0)[None]) @ shape.T
    seen = covariance @ gaps
    # A gap without values is a row of zeros.
    gain = solve_positive(gaps.T @ seen + jnp.diag(known.variance), seen.T).T
    return mean + gain @ (known.sum - gaps.T @ mean), covariance - gain @ seen.T
