"""Many samples as few intervals, by sums over prefixes instead of composing one by one."""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsat.inertial.rotations import quat_exp, quat_multiply, quat_rotate
from jaxsat.inertial.strapdown import (
    Interval,
    Moments,
    between,
    compose,
    prefixes,
    sample_intervals,
    shift_moments,
)


def remainders(upto: Interval) -> Interval:
    """What follows each of N intervals until the end of all, in the body frame at the start of all.

    upto: their `prefixes`. Row j holds V, W and τ of what comes after j; its rotation is the attitude there.
    """
    total = jax.tree.map(lambda x: x[-1:], upto)
    duration = total.duration - upto.duration
    return Interval(
        rotation=upto.rotation,
        velocity=total.velocity - upto.velocity,
        position=total.position - upto.position - upto.velocity * duration[:, None],
        duration=duration,
    )


def noise_sources(after: Interval, period: Float[Array, "N"], variance: Float[Array, "N 2"]):
    """√c h (N, 7) and √a s (N, 2) of `Moments` for samples that `after` follows."""
    root = jnp.sqrt(variance) * period[:, None]
    one = jnp.ones_like(period)[:, None]
    h = jnp.concatenate([after.position, after.velocity, one], axis=1) * root[:, :1]
    s = jnp.concatenate([0.5 * period[:, None] + after.duration[:, None], one], axis=1) * root[:, 1:]
    return h, s


def collapse(
    signal: Float[Array, "N 6"], period: Float[Array, "N"], variance: Float[Array, "N 2"]
) -> Interval:
    """N samples as one interval with its noise."""
    upto = prefixes(sample_intervals(signal, period))
    h, s = noise_sources(remainders(upto), period, variance)
    total = jax.tree.map(lambda x: x[-1], upto)
    return eqx.tree_at(
        lambda i: i.noise, total, Moments(gyr=h.T @ h, acc=s.T @ s), is_leaf=lambda x: x is None
    )


def stretches(
    signal: Float[Array, "N 6"],
    period: Float[Array, "N"],
    variance: Float[Array, "N 2"],
    cut: Int[Array, "M"],
) -> tuple[Interval, Moments]:
    """The M+1 stretches between the samples `cut` (ascending; N pads), which belong to none of them."""
    count = len(period)
    upto = prefixes(sample_intervals(signal, period))
    edges = jax.tree.map(lambda x: jnp.concatenate([jnp.zeros_like(x[:1]), x]), upto)
    edges = eqx.tree_at(lambda i: i.rotation, edges, edges.rotation.at[0, 0].set(1.0))
    begin = jnp.concatenate([jnp.zeros(1, cut.dtype), jnp.minimum(cut + 1, count)])
    end = jnp.concatenate([cut, jnp.full(1, count, cut.dtype)])
    first, last = (jax.tree.map(lambda x, at=at: x[at], edges) for at in (begin, end))
    inner = jax.vmap(between)(first, last)

    # Which stretch a sample lies in; a cut sample counts for none. What follows it there, from its frame.
    sample = jnp.arange(count, dtype=cut.dtype)
    mine = jnp.searchsorted(cut, sample).astype(cut.dtype)
    one_hot = (mine[:, None] == jnp.arange(len(cut) + 1, dtype=cut.dtype)[None, :]) & (
        sample[:, None] < end[None, :]
    )
    here = jax.tree.map(lambda x: x[mine], (first, last))
    until = jax.vmap(between)(here[0], jax.tree.map(lambda x: x[1:], edges))
    whole = jax.vmap(between)(*here)
    left = whole.duration - until.duration
    after = Interval(
        rotation=until.rotation,
        velocity=whole.velocity - until.velocity,
        position=whole.position - until.position - until.velocity * left[:, None],
        duration=left,
    )
    h, s = noise_sources(after, period, variance)
    weight = one_hot.astype(h.dtype)
    noise = Moments(
        gyr=jnp.einsum("km,ki,kj->mij", weight, h, h), acc=jnp.einsum("km,ki,kj->mij", weight, s, s)
    )
    return inner, noise


def alternate(
    gaps: Interval,
    noise: Moments,
    signal: Float[Array, "M 6"],
    period: Float[Array, "M"],
    variance: Float[Array, "M 2"],
) -> tuple[Interval, Moments]:
    """M stretches, each followed by a sample: prefixes of these pairs, and the noise of all of them together."""
    samples = sample_intervals(signal, period)
    upto = prefixes(jax.vmap(compose)(gaps, samples))
    after = remainders(upto)
    h, s = noise_sources(after, period, variance)
    # A stretch starts where the pair before it ends, and its sample follows before the rest does.
    start = jnp.concatenate([jnp.zeros_like(upto.rotation[:1]).at[0, 0].set(1.0), upto.rotation[:-1]])
    turned = jax.vmap(quat_rotate)(jax.vmap(quat_multiply)(start, gaps.rotation), samples.velocity)
    moved = jax.vmap(quat_rotate)(jax.vmap(quat_multiply)(start, gaps.rotation), samples.position)
    later = Interval(
        rotation=after.rotation,
        velocity=after.velocity + turned,
        position=after.position + turned * after.duration[:, None] + moved,
        duration=after.duration + period,
    )
    shifted = jax.vmap(shift_moments)(start, noise, later)
    return upto, Moments(
        gyr=jnp.sum(shifted.gyr, axis=0) + h.T @ h, acc=jnp.sum(shifted.acc, axis=0) + s.T @ s
    )


def input_effects(
    after: Interval,
    signal: Float[Array, "M 6"],
    period: Float[Array, "M"],
    element: Int[Array, "m"],
    channel: Int[Array, "m"],
) -> Float[Array, "m 9"]:
    """How a unit error of single values shows at the end of all: [θ, r, v] in the body frame at the start.

    after: what follows each of M samples (`remainders`); element, channel: which value. With R the attitude in
    mid-sample, columns of T[I; −[W×]; −[V×]]R for the gyroscope and of T[0; ½T + τ; I]R for the
    accelerometer; the half step of a rate's own sample is left out.
    """

    def effect(left, values, T, axis):
        # The attitude at the end of a sample turned back by half of it is that in its middle.
        half = quat_multiply(left.rotation, quat_exp(-0.5 * T * values[:3]))
        unit = quat_rotate(half, jnp.eye(3, dtype=values.dtype)[axis % 3])
        turn = jnp.concatenate([unit, -jnp.cross(left.position, unit), -jnp.cross(left.velocity, unit)])
        push = jnp.concatenate([jnp.zeros_like(unit), (0.5 * T + left.duration) * unit, unit])
        return T * jnp.where(axis < 3, turn, push)

    left = jax.tree.map(lambda x: x[element], after)
    return jax.vmap(effect)(left, signal[element], period[element], channel)
