"""Methods 1 and 2 and `map`: what is searched, and the search of one segment (paper A, Section 4)."""

from collections.abc import Callable
from typing import Literal

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsat.saturation.gap_shapes import peak, shape_value
from jaxsat.saturation.prior import Scales
from jaxsat.saturation.segment import Segment, condense, value_and_root, value_gradient_root
from jaxsat.saturation.solvers import (
    Box,
    Solution,
    Status,
    dense_box_step,
    projected_gauss_newton,
    projected_gradient,
)
from jaxsat.saturation.uncertainty import Uncertainty, uncertainty

Compensation = Literal["direct", "triangle", "quadratic", "map"]
Solver = Literal["gauss_newton", "projected_gradient"]
_SOLVERS = {"gauss_newton": projected_gauss_newton, "projected_gradient": projected_gradient}


class Search(eqx.Module):
    """The variables of a method, their bounds and start, and how they make δ."""

    delta: Callable[[Float[Array, "p"]], Float[Array, "m"]] = eqx.field(static=True)
    upper: Float[Array, "p"]
    start: Float[Array, "p"]


def search_space(method: Compensation, segment: Segment, free_peak_time: bool = False) -> Search:
    """Method 1 (`direct`) searches every δ; method 2 the height of each gap, from half of its range.

    `map` searches every δ but for those of gaps that are not to be filled. Both begin at `Segment.start`; where that
    is nothing, `map` does where the signal prior alone puts it.
    free_peak_time: method 2 also searches where in the gap the peak lies, instead of fixing it by Eq. 21.
    """
    if method == "map":
        assert segment.known is not None, "the signal prior was gathered"
        nothing = jnp.zeros_like(segment.bound)
        upper = jnp.where(segment.known.harmful, 0.0, segment.bound)
        new = ~jnp.any(segment.start > 0.0)
        prior = dense_box_step(segment.known.slope, segment.known.precision, nothing, upper, new)
        return Search(lambda delta: delta, upper, jnp.where(new, prior, jnp.clip(segment.start, 0.0, upper)))
    if method == "direct":
        return Search(lambda delta: delta, segment.bound, jnp.clip(segment.start, 0.0, segment.bound))
    edges = segment.edges
    gap_bound = jnp.zeros_like(edges.rail).at[segment.gap].max(segment.bound)
    top = peak(edges, edges.rail + gap_bound)
    height_range = jnp.maximum(top.height - edges.rail, 0.0)
    sample = segment.cut[segment.element]
    measured = segment.sign * segment.signal[sample, segment.channel]
    mine = jax.tree.map(lambda x: x[segment.gap], edges)
    t = sample.astype(segment.bound.dtype)
    span = edges.h - edges.k

    def delta(p):
        height, time = edges.rail + p[: len(span)], top.time
        if free_peak_time:
            time = edges.k + span * p[len(span) :]
        value = shape_value(method, t, mine, time[segment.gap], height[segment.gap])
        return jnp.clip(value - measured, 0.0, segment.bound)

    if not free_peak_time:
        return Search(delta, height_range, 0.5 * height_range)
    # A peak at an edge has no side to fall on: keep it a twentieth of the gap away.
    fraction = jnp.clip((top.time - edges.k) / span, 0.05, 0.95)
    return Search(
        lambda p: delta(p.at[len(span) :].add(0.05)),
        jnp.concatenate([height_range, jnp.full_like(span, 0.9)]),
        jnp.concatenate([0.5 * height_range, fraction - 0.05]),
    )


class SegmentFill(eqx.Module):
    """What was found for one segment."""

    delta: Float[Array, "m"]
    cost_before: Float[Array, ""]
    """f(0)."""
    solution: Solution
    variance: Float[Array, "m"]
    """Of each filled value before rests are heard: what makes a smoother's covariances honest."""
    slack: Float[Array, "m"]
    """What to add to the noise of each filled value for the path that goes with it."""
    at_bound: Bool[Array, "m"]
    """δ ends at its bound: the bound decided, not the data."""
    uncertainty: Uncertainty | None
    """What `map` knows of each value; None for the others."""
    inflated: Bool[Array, "m"]
    """Not filled, because hidden peaks of its like were worse filled; its noise says what it may have lost."""


class Options(eqx.Module):
    """How the search runs; see `jaxsat.config.Saturation`."""

    method: Compensation = eqx.field(static=True)
    solver: Solver = eqx.field(static=True)
    free_peak_time: bool = eqx.field(static=True)
    max_iterations: Int[Array, ""]
    tolerance: Float[Array, ""]
    calibration_sd: Float[Array, "9"] | None
    """Prior sd of the constants of `Calibration`; None where none is estimated."""
    scales: Scales
    """Of the prior of `map`."""


def solve_segment(segment: Segment, gravity: Float[Array, ""], options: Options) -> SegmentFill:
    """min over δ of f(δ), bounded one-sided (Eq. 18-20), through the inner minimum.

    A segment that no rest follows (its arrival is zero) says so; it keeps δ = 0, or with `map` what the prior
    alone gives. A search that ends above f(0) keeps δ = 0 too.
    """
    search = search_space(options.method, segment, options.free_peak_time)
    condensed, known = condense(segment), segment.known

    def linearise(p):
        delta, back = jax.vjp(search.delta, p)
        value, gradient, columns = value_gradient_root(delta, condensed, gravity)
        if known is not None:
            pull = known.precision @ delta
            value, gradient = value + delta @ (known.slope + 0.5 * pull), gradient + known.slope + pull
        return value, *jax.tree.map(lambda x: back(x)[0], (gradient, columns))

    # f(0), and the curvature at the start, of `direct` at 0 too; both from one compiled evaluation.
    first, back = jax.vjp(search.delta, search.start)
    points = jnp.stack([jnp.zeros_like(first), first][: 1 if options.method == "direct" else 2])
    values, columns, effects = jax.lax.map(lambda delta: value_and_root(delta, condensed, gravity), points)
    before = values[0]
    curvature = sum(back(column[-1])[0] ** 2 for column in columns)
    if known is not None:
        curvature = curvature + jnp.diagonal(known.precision)
    # A variable that the data do not see is scaled by its range; one without range does not move.
    has_range = search.upper > 0.0
    scale = jnp.where(
        has_range, 1.0 / jnp.sqrt(curvature + 1.0 / jnp.where(has_range, search.upper, 1.0) ** 2), 1.0
    )
    box = Box(
        start=search.start,
        lower=jnp.zeros_like(search.upper),
        upper=search.upper,
        scale=scale,
        tolerance=options.tolerance,
        max_iterations=options.max_iterations,
        precision=None if known is None else known.precision,
    )
    solution = _SOLVERS[options.solver](linearise, box)
    blind = ~jnp.any(segment.arrival != 0.0)
    keep = solution.value > before
    if known is None:
        keep = keep | blind
    delta = jnp.where(keep, 0.0, search.delta(solution.x))
    solution = eqx.tree_at(
        lambda s: (s.status, s.value),
        solution,
        (
            jnp.where(blind, Status.NO_ARRIVAL, solution.status),
            jnp.where(keep, before, solution.value),
        ),
    )
    real = segment.bound > 0.0
    # Where no prior says better, a value lies anywhere within its bounds: uniform in 0 ≤ δ ≤ δ_b.
    variance = segment.bound**2 / 12.0 if known is None else known.variance
    # δ of `map` is the mode together with the path, which takes it as measured: a smoother that is free to turn what
    # is filled once more lets it account for what other axes did. Accelerometers saturate in impacts, which no smooth
    # prior describes; there the path is better off with some freedom.
    at_bound = real & (delta >= segment.bound * (1.0 - 1e-9))
    # So it is where a bound holds δ, or nothing is filled.
    slack = variance
    if known is not None:
        slack = jnp.where((segment.channel < 3) & ~known.harmful & ~at_bound, 0.0, variance)
    said = None
    if known is not None:
        effect = tuple(e[1] for e in effects)
        said = uncertainty(segment, delta, solution.value, solution.gradient, solution.columns, effect)
    return SegmentFill(
        delta=delta if said is None else jnp.where(keep, delta, said.mean),
        cost_before=before,
        solution=solution,
        variance=variance,
        slack=slack,
        at_bound=at_bound,
        uncertainty=said,
        inflated=jnp.zeros_like(real) if known is None else known.harmful,
    )
