"""What a recording says about its own lost peaks: a signal prior learned from its unsaturated samples.

Each channel is an integrated autoregression: its second difference is predicted from the few before it, and what
remains is white. Interpolation under it is smooth like a spline but keeps the rhythm of the channel. The energy
½ Σ (a ∗ x)²/σ² of a signal x is quadratic, so all that is needed of it is the precision kernel c = a ⋆ a / σ²
(autocorrelation of a): Ω_ij = c(|i − j|) between saturated samples i and j of a channel. Unlike a pure difference
penalty the prior is proper: what a gap lost on average is also known to be a fraction of the rail, which only long
gaps feel. And what it predicts is known to a share only (`SHARE`).

The white remainder is not as large everywhere: where a foot strikes the ground it is a hundred times what it is in
its swing. How large it is in a gap the other channels tell (`roughness`); what is said of filled values follows it.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.dense import inverse_positive, solve_positive
from jaxsat.saturation.experience import NODES, Experience, habit, length_weights, with_habit

# Terms that predict the second difference. Of 1, 2, 4 and 6 terms four filled the long gaps of the PyShoe walks of
# the list `clip` best (clipped at 250 °/s) and two the short ones (350 °/s), compared before `WIDTH` was per gap.
ORDER = 4
# An autoregression is learned from samples within so many seconds of a gap of its channel: movement that is as
# fast as what was lost, not the average of rest and movement.
REACH = 0.1
# Roughness is that of the samples within so many seconds.
MOMENT = 0.05
# The mean is not less than so much of the usual one.
LEAST_ROUGHNESS = 1e-4
# Windows without which the channel's other movement is taken too.
FEWEST = 100
# Root mean square of what a gap lost (δ), in rails.
WIDTH = 0.5
# sd of what a gap lost, as a share of what the prior says that it lost; besides the sd that the prior claims, which
# rests on the movement that is left being as lively as what was lost. On the walks of the list `clip`, clipped at
# 350, 250 and 200 °/s, half of the gaps lost at least 30 to 100 % more or less than the prior alone says, by length.
SHARE = 0.3
# A hidden peak stands above so much of the rail at least.
LEAST_LEVEL = 0.25
# As if so many hidden peaks at the rail had been as far off as the prior says.
CREDIT = 2.0


class SignalPrior(eqx.Module):
    """The prior of six channels."""

    kernel: Float[Array, "6 K"]
    """c(0), c(1), … of each channel, in 1/(its unit)²."""
    innovation: Float[Array, "6"]
    """σ², the variance of a sample given all before it."""
    excess: Float[Array, "6 L"]
    """By how much the squares of the errors of the sums of hidden peaks exceed what the prior says, by length
    (`NODES`)."""
    harmful: Bool[Array, "6 L"]
    """Whether hidden peaks of that length were further off filled than cut off."""
    roughness: Float[Array, "N 6"]
    """About each sample, variance of the innovation over `innovation`."""
    experience: Experience
    """What the search before taught; with none of it at first."""


def learn(
    signal: Float[Array, "N 6"],
    sign: Int[Array, "N 6"],
    clean: Bool[Array, "N 6"],
    moving: Bool[Array, "N"],
    period: Float[Array, ""],
) -> SignalPrior:
    """Conditional maximum likelihood from windows of unsaturated, moving samples.

    The normal equations carry a weak prior at zero coefficients, which is the second-difference prior.
    """
    reach = jnp.asarray(REACH / period, int)
    sound = clean & moving[:, None]
    near = jax.vmap(lambda s: _near(s != 0, reach), in_axes=1, out_axes=1)(sign)
    rough = roughness(signal, sound, near, jnp.asarray(MOMENT / period, int))
    channels = jax.vmap(_learn_channel, in_axes=1)
    kernel, innovation, excess, harmful, scale = channels(signal, sign != 0, sound, near, rough)
    return SignalPrior(kernel, innovation, excess, harmful, rough * scale[None], Experience.none())


def _near(saturated: Bool[Array, "N"], reach: Int[Array, ""]) -> Bool[Array, "N"]:
    """Within so many samples of a saturated one."""
    steps = jnp.arange(len(saturated))
    # Distance to the nearest, by running maxima from both sides.
    behind = steps - jax.lax.cummax(jnp.where(saturated, steps, -len(saturated)))
    ahead = jax.lax.cummin(jnp.where(saturated, steps, 2 * len(saturated)), reverse=True) - steps
    return jnp.minimum(behind, ahead) <= reach


def roughness(
    signal: Float[Array, "N 6"], sound: Bool[Array, "N 6"], near: Bool[Array, "N 6"], moment: Int[Array, ""]
) -> Float[Array, "N 6"]:
    """How large the innovations of each channel are about each sample, as a variance in any unit of the channel.

    Told by the other channels, which seldom saturate at the same time: their mean squared second differences within
    `moment` samples, each over what it is near the gaps of the channel, and the root of the mean of these. Squared
    errors within gaps grow with that root (slope 1.04 of their logarithms, over the recordings on which
    the board scores intervals).
    """
    whole = sound[1:-1] & sound[2:] & sound[:-2]
    square = jnp.where(whole, (signal[2:] - 2.0 * signal[1:-1] + signal[:-2]) ** 2, 0.0)
    whole, square = (jnp.pad(x.astype(signal.dtype), ((1, 1), (0, 0))) for x in (whole, square))
    steps = jnp.arange(len(signal))
    first, last = jnp.maximum(steps - moment, 0), jnp.minimum(steps + moment + 1, len(signal))

    def about(x):
        total = jnp.pad(jnp.cumsum(x, axis=0), ((1, 0), (0, 0)))
        return jnp.maximum(total[last] - total[first], 0.0)

    count = about(whole)
    local = about(square) / jnp.maximum(count, 1.0)
    beside = near.astype(signal.dtype)
    # Of each other channel (columns) near the gaps of a channel (rows).
    usual = (beside.T @ square) / jnp.maximum(beside.T @ whole, 1.0)
    tells = (usual > 0.0) & ~jnp.eye(6, dtype=bool)
    weight = jnp.where(tells, 1.0 / jnp.where(tells, usual, 1.0), 0.0)
    told = (count > 0.0).astype(signal.dtype) @ tells.T.astype(signal.dtype)
    mean = jnp.where(told > 0.0, local @ weight.T / jnp.maximum(told, 1.0), 1.0)
    return jnp.sqrt(jnp.maximum(mean, LEAST_ROUGHNESS))


def _learn_channel(x, saturated, ok, near, rough):
    second = x[2:] - 2.0 * x[1:-1] + x[:-2]
    count = len(second) - ORDER
    lagged = [second[ORDER - lag : ORDER - lag + count] for lag in range(ORDER + 1)]
    whole = jnp.ones(count, bool)
    for offset in range(ORDER + 3):
        whole = whole & ok[offset : offset + count]
    close = whole & near[ORDER + 2 :]
    used = jnp.where(jnp.sum(close) >= FEWEST, close, whole)
    weight = used.astype(x.dtype)
    moments = jnp.stack([jnp.stack([jnp.sum(weight * a * b) for a in lagged]) for b in lagged])
    # As if ORDER windows had been seen in which nothing predicts anything.
    total = jnp.maximum(jnp.sum(weight), 1.0)
    mean_square = jnp.maximum(moments[0, 0] / total, 1e-12)
    ridge = ORDER * mean_square * jnp.eye(ORDER)
    phi = solve_positive(moments[1:, 1:] + ridge, moments[1:, 0])
    innovation = jnp.maximum((moments[0, 0] - phi @ moments[1:, 0]) / total, 1e-3 * mean_square)
    predictor = jnp.convolve(jnp.array([1.0, -2.0, 1.0]), jnp.concatenate([jnp.ones(1), -phi]))
    size = len(predictor)
    kernel = jnp.stack([jnp.sum(predictor[: size - k] * predictor[k:]) for k in range(size)])
    kernel = kernel / innovation
    excess, harmful = hidden_peaks(x, ok, jnp.max(jnp.where(saturated, jnp.abs(x), 0.0)), kernel)
    # Innovations over their roughness are what is alike.
    left = weight * (lagged[0] - phi @ jnp.stack(lagged[1:])) ** 2
    scale = jnp.sum(left / rough[ORDER + 2 :]) / jnp.maximum(jnp.sum(left), 1e-300)
    return kernel, innovation, excess, harmful, jnp.where(scale > 0.0, scale, 1.0)


def hidden_peaks(
    x: Float[Array, "N"], ok: Bool[Array, "N"], rail: Float[Array, ""], kernel: Float[Array, "K"]
) -> tuple[Float[Array, "L"], Bool[Array, "L"]]:
    """Masked cross-validation on a channel: `SignalPrior.excess` and `SignalPrior.harmful`.

    Peaks that did not saturate (`ok`) are cut off at the higher of the values beside them, and what they lost in all
    is asked of the prior; those near the rail count most.
    """
    reach = len(kernel) - 1
    lag = jnp.abs(jnp.arange(NODES[-1])[:, None] - jnp.arange(NODES[-1])[None])
    band = jnp.where(lag <= reach, kernel[jnp.minimum(lag, reach)], 0.0)
    rail, steps, bad = jnp.where(rail > 0.0, rail, 1.0), jnp.arange(len(x)), jnp.cumsum(~ok)

    def at(values, offset):
        return jnp.roll(values, -offset)

    def peaks_up(x):
        least, top, total, found = x, x, x, []
        for length in NODES:
            if half := length // 2:
                least, top = jnp.minimum(least, at(least, half)), jnp.maximum(top, at(top, half))
                total = total + at(total, half)
            inside = (steps > reach) & (steps < len(x) - length - reach)
            sound = inside & (at(bad, length + reach - 1) == at(bad, -reach - 1))
            level = jnp.maximum(at(x, -1), at(x, length))
            peak = sound & (least > level) & (level > LEAST_LEVEL * rail)
            pull = 1.0 / ((WIDTH * rail) ** 2 * length)
            # The sum of what is filled is linear in the level and in the values on both sides.
            toll = solve_positive(band[:length, :length] + pull * jnp.eye(length), jnp.ones(length))
            weights = jnp.convolve(toll, jnp.concatenate([kernel[:0:-1], kernel]))
            left, within, right = jnp.split(weights, [reach, reach + length])
            sides = sum(left[k] * at(x, k - reach) + right[k] * at(x, length + k) for k in range(reach))
            filled = jnp.maximum(-sides - jnp.sum(within) * level, 0.0)
            lost = total - length * level
            claimed = jnp.sum(toll) + (SHARE * filled) ** 2
            weight = jnp.where(peak, (top / rail) ** 4 / claimed, 0.0)
            found.append([jnp.sum(weight * each) for each in ((filled - lost) ** 2, lost**2, claimed)])
        return jnp.array(found)

    filled, cut, weights = jnp.sum(jax.vmap(peaks_up)(jnp.stack([x, -x])), axis=0).T
    return (filled + CREDIT) / (weights + CREDIT), filled > cut + CREDIT


class Known(eqx.Module):
    """The prior of the δ of one segment: ½ δᵀΩδ + bᵀδ."""

    precision: Float[Array, "m m"]
    """Ω."""
    slope: Float[Array, "m"]
    """b."""
    covariance: Float[Array, "m m"]
    """Ω⁻¹."""
    believed: Float[Array, "m m"]
    """Covariance for what is said of fills: with how far off hidden peaks were. The mode of δ does without that: it
    was no nearer to the truth with it, and worse where short gaps were believed less."""
    expected: Float[Array, "m"]
    """Mean of the sum of δ over the gap of each."""
    alone: Float[Array, "m"]
    """The same without what gaps of its kind lost."""
    variance: Float[Array, "m"]
    """Of each value about what it is set to.

    A smoother takes values as independent, though errors within a gap go together. Letting each stand for its whole
    gap (row sums of the covariance) was worse: rests have told most of that sum already."""
    rough: Float[Array, "m"]
    """By what to scale the believed variance of each once the sum of its gap is known."""
    harmful: Bool[Array, "m"]
    """Not to be filled."""


def quadratic_form(
    prior: SignalPrior,
    signal: Float[Array, "N 6"],
    sample: Int[Array, "m"],
    channel: Int[Array, "m"],
    sign: Float[Array, "m"],
    length: Float[Array, "m"],
) -> tuple[Float[Array, "m m"], Float[Array, "m"]]:
    """Ω and b of x = signal + sign·δ at some saturated values, all else of the signal and its scale being known.

    sample, channel: where they lie; sign: zero pads (δ = 0, of no effect); length: of the gap of each, in samples.
    """
    kernel = prior.kernel[channel]
    reach = prior.kernel.shape[1] - 1
    lag = jnp.abs(sample[:, None] - sample[None])
    same = (channel[:, None] == channel[None]) & (lag <= reach)
    values = jnp.take_along_axis(kernel, jnp.minimum(lag, reach), axis=1)
    around = sample[:, None] + jnp.arange(-reach, reach + 1)[None]
    window = signal[jnp.clip(around, 0, len(signal) - 1), channel[:, None]]
    weights = jnp.concatenate([kernel[:, :0:-1], kernel], axis=1)
    rail = jnp.maximum(jnp.abs(window[:, reach]), 1e-9)
    # Values of a gap go together: what is known of their mean must not be counted once for each.
    pull = 1.0 / ((WIDTH * rail) ** 2 * jnp.maximum(length, 1.0))
    real = sign != 0.0
    precision = jnp.where(same & real[:, None] & real[None], values * sign[:, None] * sign[None], 0.0)
    precision = precision + jnp.diag(jnp.where(real, pull, 1.0))
    return precision, jnp.where(real, sign * jnp.sum(weights * window, axis=1), 0.0)


def of_values(
    prior: SignalPrior,
    signal: Float[Array, "N 6"],
    sample: Int[Array, "m"],
    channel: Int[Array, "m"],
    sign: Float[Array, "m"],
    gap: Int[Array, "m"],
) -> Known:
    """The prior of some saturated values, as in `quadratic_form`; gap: a number of the gap that each lies in."""
    real = sign != 0.0
    length = jnp.zeros_like(sign).at[gap].add(jnp.abs(sign))[gap]
    precision, slope = quadratic_form(prior, signal, sample, channel, sign, length)
    within = inverse_positive(precision)
    mean = -within @ slope
    # What a gap lost is known to a share only, and its values are too much or too little together.
    fill = jnp.where(real, jnp.maximum(mean, 0.0), 0.0)
    together = gap[:, None] == gap[None]
    covariance = within + jnp.where(together, SHARE**2 * fill[:, None] * fill[None], 0.0)
    # What hidden peaks of about that length say.
    near = length_weights(length)
    excess = jnp.where(real, jnp.sum(near * prior.excess[channel], axis=1), 1.0)
    harmful = real & prior.harmful[channel, jnp.argmax(near, axis=1)]
    doubt = jnp.sqrt(excess)
    believed = covariance * doubt[:, None] * doubt[None]

    # What gaps like them lost.
    gaps = jnp.where(real[:, None], gap[:, None] == jnp.arange(len(gap))[None], False).astype(sign.dtype)
    alone, some = gaps.T @ mean, jnp.argmax(gaps, axis=0)
    rough = gaps.T @ jnp.where(real, prior.roughness[sample, channel] / jnp.maximum(length, 1.0), 0.0)
    usual = habit(prior.experience, channel[some], sign[some], jnp.sum(gaps, axis=0))
    _, believed = with_habit(mean, believed, gaps, usual)
    mean, covariance = with_habit(mean, covariance, gaps, usual)
    precision = inverse_positive(covariance)
    variance = jnp.diagonal(believed) + jnp.where(harmful, mean**2, 0.0)
    return Known(
        precision=precision,
        slope=-precision @ mean,
        covariance=covariance,
        believed=believed,
        expected=(gaps.T @ mean)[gap],
        alone=alone[gap],
        variance=jnp.where(real, variance, 0.0),
        # Hidden peaks spoke of the sums.
        rough=rough[gap] / excess,
        harmful=harmful,
    )
