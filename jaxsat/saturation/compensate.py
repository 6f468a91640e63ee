"""All segments of a recording, in parallel or one after the other (paper A, Section 5)."""

from collections.abc import Callable

import equinox as eqx
import jax
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.smoother import Rows, closed_loop
from jaxsat.inertial.strapdown import NavState, Samples
from jaxsat.saturation.layout import Layout, Trial, bucket, gather, pad
from jaxsat.saturation.methods import Compensation, SegmentFill, solve_segment
from jaxsat.saturation.segment import Segment, arrivals
from jaxsat.saturation.solvers import Status

Progress = Callable[[int, int], None]
"""Called with (segments done, segments in all)."""


class Options(eqx.Module):
    """How the search runs; see `jaxsat.config.Saturation`."""

    method: Compensation = eqx.field(static=True)
    free_peak_time: bool = eqx.field(static=True)
    max_iterations: int = eqx.field(static=True)
    tolerance: Float[Array, ""]


class Fills(eqx.Module):
    """The filled signal, and how each segment ended (one row a segment)."""

    signal: Float[np.ndarray, "N 6"]
    at_bound: Bool[np.ndarray, "N 6"]
    """Values where the bound decided, not the data."""
    status: Int[np.ndarray, "S"]
    cost_before: Float[np.ndarray, "S"]
    """f(0), with the departure of the last sweep."""
    cost_after: Float[np.ndarray, "S"]
    residual: Float[np.ndarray, "S"]
    iterations: Int[np.ndarray, "S"]

    @staticmethod
    def nothing(trial: Trial, count: int) -> "Fills":
        zeros = np.zeros(count)
        return Fills(
            signal=trial.signal.copy(),
            at_bound=np.zeros(trial.signal.shape, bool),
            status=np.full(count, int(Status.NOTHING_TO_DO)),
            cost_before=zeros,
            cost_after=zeros.copy(),
            residual=zeros.copy(),
            iterations=np.zeros(count, int),
        )


@eqx.filter_jit
def _filter(signal, period, variance, rows: Rows, prior: NavState, covariance, gravity):
    return closed_loop(Samples(signal, period, variance), rows, prior, covariance, gravity)


@eqx.filter_jit
def _arrivals(signal, period, variance, rows: Rows, segment_at, starts, count: int):
    return arrivals(Samples(signal, period, variance), rows, segment_at, starts, count)


@eqx.filter_jit
def _solve(segment: Segment, gravity, options: Options) -> SegmentFill:
    return solve_segment(
        segment,
        gravity,
        options.tolerance,
        options.method,
        options.free_peak_time,
        options.max_iterations,
    )


def arrival_table(trial: Trial, layout: Layout) -> Float[np.ndarray, "S 10 10"]:
    """Λ of every segment's arrival; zeros where no rest follows. Independent of δ: rests do not saturate."""
    n, segments = len(trial.signal), layout.segments
    segment_at, starts = np.full(n, -1), np.zeros(n, bool)
    for index, (start, end) in enumerate(zip(segments.arrival, segments.rest_end, strict=True)):
        segment_at[start:end] = index
        starts[start : start + 1] = True
    table = _arrivals(
        trial.signal,
        trial.period,
        trial.variance,
        trial.rows,
        segment_at,
        starts,
        bucket(len(segments), 16),
    )
    table = np.asarray(table)[: len(segments)].copy()
    table[segments.departure < 0] = 0.0
    return table


def _record(fills: Fills, trial: Trial, layout: Layout, index: int, found: SegmentFill) -> None:
    """Write what was found for one segment into the arrays of the whole recording."""
    found = jax.tree.map(np.asarray, found)
    mine = layout.values_of(index)
    sample, channel = layout.sample[mine], layout.channel[mine]
    count = len(sample)
    fills.signal[sample, channel] = (
        trial.signal[sample, channel] + trial.sign[sample, channel] * found.delta[:count]
    )
    fills.at_bound[sample, channel] = found.at_bound[:count]
    fills.status[index] = found.solution.status
    fills.cost_before[index], fills.cost_after[index] = found.cost_before, found.solution.value
    fills.residual[index], fills.iterations[index] = found.solution.residual, found.solution.iterations


def compensate_parallel(
    trial: Trial, layout: Layout, options: Options, sweeps: int = 2, progress: Progress | None = None
) -> Fills:
    """Solve each segment on its own from one filter pass over the recording; then again with the filled signal.

    Methods 1 and 2 do not say how sure they are of a filled value, so each enters the filter with the variance
    that its bounds leave: departures know how uncertain their tilt is, and one bad fill does not bend what
    follows. In the first pass δ is 0 and the variance is the second moment about it.
    """
    busy = np.unique(layout.gap_segment).tolist()
    fills = Fills.nothing(trial, len(layout.segments))
    table = arrival_table(trial, layout)
    count = 0

    for sweep in range(sweeps):
        # The second moment of a uniform distribution about its end is four times that about its middle.
        variance = trial.variance + (4.0 if sweep == 0 else 1.0) * trial.fill_variance
        states, covariances = _filter(
            fills.signal,
            trial.period,
            variance,
            trial.rows,
            trial.prior,
            trial.prior_covariance,
            trial.gravity,
        )
        states, covariances = jax.tree.map(np.asarray, (states, covariances))
        for i in busy:
            at = max(0, int(layout.segments.departure[i]))
            state = jax.tree.map(lambda x, at=at: x[at], states)
            segment = gather(trial, layout, i, state, covariances[at], table[i])
            _record(fills, trial, layout, i, _solve(segment, trial.gravity, options))
            count += 1
            if progress:
                progress(count, sweeps * len(busy))
    return fills


def compensate_sequential(
    trial: Trial, layout: Layout, options: Options, progress: Progress | None = None
) -> Fills:
    """The paper's order: each segment departs from the filtered end of the one before, filled already."""
    segments = layout.segments
    fills = Fills.nothing(trial, len(segments))
    table = arrival_table(trial, layout)
    busy = np.unique(layout.gap_segment).tolist()
    state, covariance, at = trial.prior, trial.prior_covariance, 0
    for count, index in enumerate(busy):
        departure = max(0, int(segments.departure[index]))
        state, covariance = _filter_to(trial, fills.signal, state, covariance, at, departure)
        at = departure
        segment = gather(trial, layout, index, state, covariance, table[index])
        _record(fills, trial, layout, index, _solve(segment, trial.gravity, options))
        if progress:
            progress(count + 1, len(busy))
    return fills


def _filter_to(trial: Trial, signal, state: NavState, covariance, start: int, stop: int):
    """The filtered state at sample `stop`, from that at `start` (whose rows are used already, but at 0)."""
    count = stop - start + 1
    size = bucket(count, 256)

    def span(x):
        return pad(np.asarray(x)[start : stop + 1], size)

    fresh = np.arange(size) >= (0 if start == 0 else 1)
    rows = eqx.tree_at(
        lambda r: (r.rest, r.height),
        trial.rows,
        (span(trial.rows.rest) & fresh, span(trial.rows.height) & fresh),
    )
    states, covariances = _filter(
        span(signal),
        span(trial.period),
        span(trial.variance + trial.fill_variance),
        rows,
        state,
        covariance,
        trial.gravity,
    )
    return jax.tree.map(lambda x: np.asarray(x[count - 1]), states), np.asarray(covariances[count - 1])
