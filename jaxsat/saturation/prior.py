"""What a recording says about its own lost peaks: a signal prior learned from its unsaturated samples.

Each channel is an integrated autoregression: its second difference is predicted from the few before it. What remains,
the innovation, is not alike everywhere, and the other channels, which seldom saturate at the same time, tell of it
twice. How large it is: where a foot strikes the ground all channels are a hundred times as rough as in its swing, so
its variance follows their roughness (`roughness`). And what it is: a body that is shaken turns and accelerates at
once, so its mean is linear in what the other channels do about that sample (`beside`).

With innovations e = a ∗ x − m of variance σ² the energy ½ Σ e²/σ² is quadratic in the saturated values, of
precision Ω_ij = Σ_t a_{t−i} a_{t−j}/σ²_t. Unlike a pure difference penalty the prior is proper: what a gap lost on
average is also known to be a fraction of the rail, which only long gaps feel. And what it predicts is known to a
share only (`Scales`).
"""

from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.dense import inverse_positive, solve_positive
from jaxsat.saturation.experience import NODES, Experience, habit, length_weights, with_habit

# Terms that predict the second difference. Of 1, 2, 4 and 6 terms four filled the long gaps of the PyShoe walks of
# the list `clip` best (clipped at 250 °/s) and two the short ones (350 °/s), compared before
# `Scales.width` was per gap.
ORDER = 4
# All this is learned from samples within so many seconds of a gap of its channel: movement that is as fast as what
# was lost, not the average of rest and movement.
REACH = 0.2
# Roughness is that of the samples within so many seconds, and no less than so much of what it usually is there.
MOMENT, LEAST_ROUGHNESS = 0.01, 0.01
# Windows without which the channel's other movement is taken too.
FEWEST = 100
# A hidden peak stands above so much of the rail at least; of each length and direction the highest are filled.
LEAST_LEVEL, PEAKS = 0.25, 16
# As if so many hidden peaks at the rail had been as far off as the prior says.
CREDIT = 2.0


class Scales(eqx.Module):
    """How far beyond what is learned of a recording the prior goes; `jaxsat tune --prior` learns both."""

    width: Float[Array, ""]
    """Root mean square of what a gap lost (δ), in rails."""
    share: Float[Array, ""]
    """sd of what a gap lost, as a share of what the prior says of it; besides the sd that the prior claims, which
    rests on the movement that is left being as lively as what was lost."""


class SignalPrior(eqx.Module):
    """The prior of six channels."""

    scales: Scales
    predictor: Float[Array, "6 K"]
    """a: of a sample and of those before it, what makes an innovation."""
    mean: Float[Array, "N 6"]
    """Of the innovation of each sample."""
    weight: Float[Array, "N 6"]
    """1/σ² of it, in 1/(its unit)²."""
    excess: Float[Array, "6 L"]
    """By how much the squares of the errors of the sums of hidden peaks exceed what the prior says, by length
    (`NODES`)."""
    harmful: Bool[Array, "6 L"]
    """Whether hidden peaks of that length were further off filled than cut off."""
    experience: Experience
    """What the search before taught; with none of it at first."""


def blank(samples: int, scales: Scales) -> SignalPrior:
    """Of the shapes of one that is learned from so many samples."""
    predictor, by_sample, by_length = (
        jnp.asarray(np.zeros(shape)) for shape in ((6, ORDER + 3), (samples, 6), (6, len(NODES)))
    )
    harmful = jnp.asarray(np.zeros((6, len(NODES)), bool))
    return SignalPrior(scales, predictor, by_sample, by_sample, by_length, harmful, Experience.none())


def learn(
    signal: Float[Array, "N 6"],
    sign: Int[Array, "N 6"],
    clean: Bool[Array, "N 6"],
    moving: Bool[Array, "N"],
    period: Float[Array, ""],
    scales: Scales,
) -> SignalPrior:
    """Conditional maximum likelihood from windows of unsaturated, moving samples."""
    reach = jnp.asarray(REACH / period, int)
    near = jax.vmap(lambda s: _near(s != 0, reach), in_axes=1, out_axes=1)(sign)
    moment = jnp.maximum(jnp.round(MOMENT / period), 1.0).astype(int)
    rough = roughness(signal, clean, near & clean & moving[:, None], moment)
    channels = jax.vmap(partial(_learn_channel, scales), in_axes=1)
    predictor, mean, weight, excess, harmful = channels(
        signal, sign != 0, clean & moving[:, None], near, rough, beside(signal)
    )
    return SignalPrior(scales, predictor, mean.T, weight.T, excess, harmful, Experience.none())


def _near(saturated: Bool[Array, "N"], reach: Int[Array, ""]) -> Bool[Array, "N"]:
    """Within so many samples of a saturated one."""
    steps = jnp.arange(len(saturated))
    # Distance to the nearest, by running maxima from both sides.
    behind = steps - jax.lax.cummax(jnp.where(saturated, steps, -len(saturated)))
    ahead = jax.lax.cummin(jnp.where(saturated, steps, 2 * len(saturated)), reverse=True) - steps
    return jnp.minimum(behind, ahead) <= reach


def roughness(
    signal: Float[Array, "N 6"], clean: Bool[Array, "N 6"], usual: Bool[Array, "N 6"], moment: Int[Array, ""]
) -> Float[Array, "N 6"]:
    """How large the innovation of each sample is, as a variance in any unit of the channel.

    Told by the other channels: their mean squared second differences within `moment` samples, each over what it
    is where `usual` says so for the channel, and the mean of these.
    """
    whole = clean[1:-1] & clean[2:] & clean[:-2]
    square = jnp.where(whole, (signal[2:] - 2.0 * signal[1:-1] + signal[:-2]) ** 2, 0.0)
    whole, square = (jnp.pad(x.astype(signal.dtype), ((1, 1), (0, 0))) for x in (whole, square))
    steps = jnp.arange(len(signal))
    first, last = jnp.maximum(steps - moment, 0), jnp.minimum(steps + moment + 1, len(signal))

    def about(x):
        total = jnp.pad(jnp.cumsum(x, axis=0), ((1, 0), (0, 0)))
        return jnp.maximum(total[last] - total[first], 0.0)

    count = about(whole)
    local = about(square) / jnp.maximum(count, 1.0)
    where = usual.astype(signal.dtype)
    # Of each other channel (columns) where it counts for a channel (rows).
    size = (where.T @ square) / jnp.maximum(where.T @ whole, 1.0)
    tells = (size > 0.0) & ~jnp.eye(6, dtype=bool)
    weight = jnp.where(tells, 1.0 / jnp.where(tells, size, 1.0), 0.0)
    told = (count > 0.0).astype(signal.dtype) @ tells.T.astype(signal.dtype)
    mean = jnp.where(told > 0.0, local @ weight.T / jnp.maximum(told, 1.0), 1.0)
    mean = jnp.maximum(mean, LEAST_ROUGHNESS)
    # The innovation of a sample is that of a second difference about the one before it.
    return jnp.concatenate([jnp.ones_like(mean[:1]), mean[:-1]])


def beside(signal: Float[Array, "N 6"]) -> Float[Array, "N 6 R"]:
    """What goes with the innovation of each sample: the other channels' values, slopes and second differences.

    About the sample before it, as that innovation is, and the next second difference too; a channel's own are zero.
    Saturated values are taken as they are: what they lost moves little beside what they say.
    """
    steps = jnp.arange(len(signal))[:, None] + jnp.arange(-2, 2)[None]
    first, before, here, after = jnp.moveaxis(signal[jnp.clip(steps, 0, len(signal) - 1)], 1, 0)
    slope, second, next_second = here - first, here - 2.0 * before + first, after - 2.0 * here + before
    every = jnp.stack([before, slope, second, next_second], axis=-1)
    others = jnp.where(~jnp.eye(6, dtype=bool)[None, :, :, None], every[:, None], 0.0)
    return others.reshape(len(signal), 6, -1)


def _learn_channel(scales: Scales, x, saturated, ok, near, rough, others):
    second = x[2:] - 2.0 * x[1:-1] + x[:-2]
    count = len(second) - ORDER
    lagged = [second[ORDER - lag : ORDER - lag + count] for lag in range(ORDER + 1)]
    whole = jnp.ones(count, bool)
    for offset in range(ORDER + 3):
        whole = whole & ok[offset : offset + count]
    close = whole & near[ORDER + 2 :]
    used = jnp.where(jnp.sum(close) >= FEWEST, close, whole)
    weight = used.astype(x.dtype) / rough[ORDER + 2 :]
    terms = jnp.concatenate([jnp.stack(lagged[1:], axis=1), others[ORDER + 2 :]], axis=1)
    moments = terms.T @ (weight[:, None] * terms)
    # As if ORDER windows had been seen in which nothing predicts anything.
    total = jnp.maximum(jnp.sum(used.astype(x.dtype)), 1.0)
    mean_square = jnp.maximum(jnp.sum(weight * lagged[0] ** 2) / total, 1e-12)
    power = jnp.diagonal(moments) / total
    size = jnp.where(jnp.arange(len(power)) < ORDER, mean_square, jnp.where(power > 0.0, power, 1.0))
    found = solve_positive(moments + ORDER * jnp.diag(size), terms.T @ (weight * lagged[0]))
    left = weight * (lagged[0] - terms @ found) ** 2
    innovation = jnp.maximum(jnp.sum(left) / total, 1e-3 * mean_square)
    predictor = jnp.convolve(jnp.array([1.0, -2.0, 1.0]), jnp.concatenate([jnp.ones(1), -found[:ORDER]]))
    mean, weight = others @ found[ORDER:], 1.0 / (innovation * rough)
    rail = jnp.max(jnp.where(saturated, jnp.abs(x), 0.0))
    return predictor, mean, weight, *hidden_peaks(x, ok, rail, predictor, mean, weight, scales)


def hidden_peaks(
    x: Float[Array, "N"],
    ok: Bool[Array, "N"],
    rail: Float[Array, ""],
    predictor: Float[Array, "K"],
    mean: Float[Array, "N"],
    weight: Float[Array, "N"],
    scales: Scales,
) -> tuple[Float[Array, "L"], Bool[Array, "L"]]:
    """Masked cross-validation on a channel: `SignalPrior.excess` and `SignalPrior.harmful`.

    Peaks that did not saturate (`ok`) are cut off at the higher of the values beside them, and what they lost in all
    is asked of the prior; those near the rail count most.
    """
    reach = len(predictor) - 1
    rail, steps, bad = jnp.where(rail > 0.0, rail, 1.0), jnp.arange(len(x)), jnp.cumsum(~ok)

    def at(values, offset):
        return jnp.roll(values, -offset)

    def peaks_up(x, mean):
        least, top, found = x, x, []
        for length in NODES:
            if half := length // 2:
                least, top = jnp.minimum(least, at(least, half)), jnp.maximum(top, at(top, half))
            inside = (steps > reach) & (steps < len(x) - length - reach)
            sound = inside & (at(bad, length + reach - 1) == at(bad, -reach - 1))
            level = jnp.maximum(at(x, -1), at(x, length))
            peak = sound & (least > level) & (level > LEAST_LEVEL * rail)
            worth, first = jax.lax.top_k(jnp.where(peak, (top / rail) ** 4, 0.0), min(PEAKS, len(x)))
            first = jnp.clip(first, reach, len(x) - length - reach)
            place = jnp.arange(length)[:, None] + jnp.arange(2 * reach + 1)[None]

            def fill(start, level, length=length, place=place):
                true = jax.lax.dynamic_slice(x, (start - reach,), (length + 2 * reach,))
                cut = true.at[reach : reach + length].set(level)
                told = (jax.lax.dynamic_slice(y, (start,), (length + reach,)) for y in (mean, weight))
                own = jnp.broadcast_to(predictor, (length, reach + 1))
                after = (y[place[:, : reach + 1]] for y in told)
                within, slope = _energy(place[:, 0], jnp.zeros_like(place[:, 0]), own, cut[place], *after)
                pull = 1.0 / ((scales.width * rail) ** 2 * length)
                toll = solve_positive(within + pull * jnp.eye(length), jnp.ones(length))
                filled = jnp.maximum(-toll @ slope, 0.0)
                lost = jnp.sum(true - cut)
                return (filled - lost) ** 2, lost**2, jnp.sum(toll) + (scales.share * filled) ** 2

            errors, losses, claimed = jax.vmap(fill)(first, level[first])
            counts = jnp.where(worth > 0.0, worth / jnp.where(worth > 0.0, claimed, 1.0), 0.0)
            found.append([jnp.sum(counts * each) for each in (errors, losses, claimed)])
        return jnp.array(found)

    both = jax.vmap(peaks_up)(jnp.stack([x, -x]), jnp.stack([mean, -mean]))
    filled, cut, weights = jnp.sum(both, axis=0).T
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
    """Covariance for what is said of fills: not below what hidden peaks were off by, nor what lies below the rail.
    The mode of δ does without that: it was no nearer to the truth with it, and worse where short gaps were believed
    less."""
    expected: Float[Array, "m"]
    """Mean of the sum of δ over the gap of each."""
    alone: Float[Array, "m"]
    """The same without what gaps of its kind lost."""
    variance: Float[Array, "m"]
    """Of each value about what it is set to.

    A smoother takes values as independent, though errors within a gap go together. Letting each stand for its whole
    gap (row sums of the covariance) was worse: rests have told most of that sum already."""
    harmful: Bool[Array, "m"]
    """Not to be filled."""


def _energy(
    sample: Int[Array, "m"],
    channel: Int[Array, "m"],
    predictor: Float[Array, "m K"],
    window: Float[Array, "m W"],
    mean: Float[Array, "m K"],
    weight: Float[Array, "m K"],
) -> tuple[Float[Array, "m m"], Float[Array, "m"]]:
    """Precision and slope of ½ Σ (a ∗ x − m)²/σ² in some values.

    Of each value: its place, a of its channel, the signal about it (K − 1 samples before to as many after), and mean
    and weight of the innovations that it is a part of: of its own sample and those after it.
    """
    size = predictor.shape[1]
    steps = jnp.arange(size)
    # Of each value with what lies d samples before, the part of each of its innovations: columns d, terms k.
    both = steps[:, None] + steps[None]
    later = jnp.where(both < size, predictor[:, jnp.minimum(both, size - 1)], 0.0)
    band = jnp.sum((weight * predictor)[:, None] * later, axis=2)
    lag = sample[:, None] - sample[None]
    near = (channel[:, None] == channel[None]) & (jnp.abs(lag) < size)
    before = jnp.take_along_axis(band, jnp.minimum(jnp.abs(lag), size - 1), axis=1)
    precision = jnp.where(near, jnp.where(lag >= 0, before, before.T), 0.0)
    innovation = jnp.sum(predictor[:, None, ::-1] * window[:, both], axis=2)
    return precision, jnp.sum(weight * predictor * (innovation - mean), axis=1)


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
    predictor = prior.predictor[channel]
    reach, last = predictor.shape[1] - 1, len(signal) - 1
    around = jnp.clip(sample[:, None] + jnp.arange(-reach, reach + 1)[None], 0, last), channel[:, None]
    after = jnp.clip(sample[:, None] + jnp.arange(reach + 1)[None], 0, last), channel[:, None]
    window = signal[around]
    within, slope = _energy(sample, channel, predictor, window, prior.mean[after], prior.weight[after])
    rail = jnp.maximum(jnp.abs(window[:, reach]), 1e-9)
    # Values of a gap go together: what is known of their mean must not be counted once for each.
    pull = 1.0 / ((prior.scales.width * rail) ** 2 * jnp.maximum(length, 1.0))
    real = sign != 0.0
    precision = jnp.where(real[:, None] & real[None], within * sign[:, None] * sign[None], 0.0)
    return precision + jnp.diag(jnp.where(real, pull, 1.0)), jnp.where(real, sign * slope, 0.0)


def by_signal(
    prior: SignalPrior,
    signal: Float[Array, "N 6"],
    sample: Int[Array, "m"],
    channel: Int[Array, "m"],
    sign: Float[Array, "m"],
    gap: Int[Array, "m"],
) -> tuple[Float[Array, "m"], Float[Array, "m m"]]:
    """Mean and covariance of some saturated values by the signal alone; arguments as of `of_values`."""
    length = jnp.zeros_like(sign).at[gap].add(jnp.abs(sign))[gap]
    precision, slope = quadratic_form(prior, signal, sample, channel, sign, length)
    within = inverse_positive(precision)
    mean = -within @ slope
    # What a gap lost is known to a share only, and its values are too much or too little together.
    common = jnp.where(sign != 0.0, jnp.maximum(mean, 0.0), 0.0) * prior.scales.share
    together = gap[:, None] == gap[None]
    return mean, within + jnp.where(together, common[:, None] * common[None], 0.0)


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
    mean, covariance = by_signal(prior, signal, sample, channel, sign, gap)
    # What hidden peaks of about that length say.
    near = length_weights(length)
    excess = jnp.where(real, jnp.sum(near * prior.excess[channel], axis=1), 1.0)
    harmful = real & prior.harmful[channel, jnp.argmax(near, axis=1)]
    believed = scaled(covariance, jnp.sqrt(jnp.maximum(excess, 1.0)))

    # What gaps like them lost.
    gaps = jnp.where(real[:, None], gap[:, None] == jnp.arange(len(gap))[None], False).astype(sign.dtype)
    alone, some = gaps.T @ mean, jnp.argmax(gaps, axis=0)
    usual = habit(prior.experience, channel[some], sign[some], jnp.sum(gaps, axis=0))
    _, believed = with_habit(mean, believed, gaps, usual)
    mean, covariance = with_habit(mean, covariance, gaps, usual)
    # That the sensor saturated is an observation too: whoever puts a value below the rail is off by as much.
    below = -mean / jnp.sqrt(jnp.diagonal(believed))
    believed = scaled(believed, jnp.where(real, jnp.maximum(below, 1.0), 1.0))
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
        harmful=harmful,
    )


def scaled(covariance: Float[Array, "m m"], times: Float[Array, "m"]) -> Float[Array, "m m"]:
    """With so many times the sd of each value."""
    return covariance * times[:, None] * times[None]
