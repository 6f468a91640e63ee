"""All segments of a recording, in parallel or one after the other (paper A, Section 5)."""

from collections.abc import Callable, Iterator
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.biases import estimate_biases
from jaxsat.inertial.programs import UNOPTIMISED, stored_jit
from jaxsat.inertial.smoother import Filtered, closed_loop
from jaxsat.inertial.strapdown import NavState, Samples
from jaxsat.saturation.arrival import arrivals
from jaxsat.saturation.layout import (
    Arrays,
    Sizes,
    Trial,
    Values,
    bucket,
    count_values,
    gather,
    pad,
    padded_sizes,
)
from jaxsat.saturation.methods import Options, SegmentFill, solve_segment
from jaxsat.saturation.prior import SignalPrior, learn
from jaxsat.saturation.solvers import Status
from jaxsat.signals.rests import Segments

Progress = Callable[[int, int], None]
"""Called with (segments done, segments in all)."""

# So many segments are solved at once; more would gain nothing on a CPU and wait for the slowest.
LANES = 64


class Fills(eqx.Module):
    """The filled signal, and how each segment ended (one row a segment)."""

    signal: Float[np.ndarray, "N 6"]
    variance: Float[np.ndarray, "N 6"]
    """What a filled value adds to the sensor's noise, before rests are heard."""
    slack: Float[np.ndarray, "N 6"]
    """What it adds for the path that goes with the filled signal."""
    bias: Float[np.ndarray, "6"]
    """Of the sensors (rad/s, m/s²); zero where they are not estimated."""
    bias_sd: Float[np.ndarray, "6"]
    """Of these; zero where they are not estimated."""
    sd: Float[np.ndarray, "N 6"]
    """Of filled values: by `map` that of their posterior, by the others that of a value anywhere in its bounds."""
    gap_sd: Float[np.ndarray, "N 6"]
    """Of the sum over the gap that a filled value lies in; NaN where the method does not say."""
    identified: Float[np.ndarray, "N 6"]
    """Share of the variance of that sum that the rests removed; NaN where the method does not say."""
    rank: Int[np.ndarray, "S"]
    """Of each segment: `Uncertainty.rank`, and 0 for methods without uncertainty."""
    arrival: Float[np.ndarray, "S 6"]
    """Of each segment: `Uncertainty.arrival`, and nan."""
    at_bound: Bool[np.ndarray, "N 6"]
    """Values where the bound decided, not the data."""
    inflated: Bool[np.ndarray, "N 6"]
    """Values that `map` left as they are but for their noise (`SegmentFill.inflated`)."""
    status: Int[np.ndarray, "S"]
    cost_before: Float[np.ndarray, "S"]
    """f(0), with the departure of the last sweep."""
    cost_after: Float[np.ndarray, "S"]
    residual: Float[np.ndarray, "S"]
    iterations: Int[np.ndarray, "S"]

    @property
    def unbiased(self) -> Float[np.ndarray, "N 6"]:
        """The filled signal without the biases."""
        return self.signal - self.bias[None]

    @staticmethod
    def nothing(trial: Trial, count: int) -> "Fills":
        zeros, shape = np.zeros(count), trial.signal.shape
        return Fills(
            signal=np.array(trial.signal),
            variance=np.array(trial.unfilled_variance),
            slack=np.array(trial.unfilled_variance),
            bias=np.zeros(6),
            bias_sd=np.zeros(6),
            sd=np.zeros(shape),
            gap_sd=np.full(shape, np.nan),
            identified=np.full(shape, np.nan),
            rank=np.zeros(count, int),
            arrival=np.full((count, 6), np.nan),
            at_bound=np.zeros(shape, bool),
            inflated=np.zeros(shape, bool),
            status=np.full(count, int(Status.NOTHING_TO_DO)),
            cost_before=zeros,
            cost_after=zeros.copy(),
            residual=zeros.copy(),
            iterations=np.zeros(count, int),
        )

    def record(
        self, trial: Trial, segments: Int[np.ndarray, "L"], found: SegmentFill, values: Values
    ) -> None:
        """Write what was found for some segments into the arrays of the whole recording."""
        found, values = jax.tree.map(lambda x: np.asarray(x)[: len(segments)], (found, values))
        real = values.sample < len(trial.signal)
        sample, channel = values.sample[real], values.channel[real]
        self.signal[sample, channel] = (
            trial.signal[sample, channel]
            + self.bias[channel]
            + trial.sign[sample, channel] * found.delta[real]
        )
        self.variance[sample, channel] = found.variance[real]
        self.slack[sample, channel] = found.slack[real]
        self.sd[sample, channel] = np.sqrt(found.variance[real])
        self.at_bound[sample, channel] = found.at_bound[real]
        self.inflated[sample, channel] = found.inflated[real]
        if (known := found.uncertainty) is not None:
            self.sd[sample, channel], self.gap_sd[sample, channel] = known.sd[real], known.gap_sd[real]
            self.identified[sample, channel] = known.identified[real]
            self.rank[segments], self.arrival[segments] = known.rank, known.arrival
        self.status[segments] = found.solution.status
        self.cost_before[segments], self.cost_after[segments] = found.cost_before, found.solution.value
        self.residual[segments], self.iterations[segments] = (
            found.solution.residual,
            found.solution.iterations,
        )


def filter_trial(trial: Trial, signal: Float[Arrays, "N 6"], extra: Float[Arrays, "N 6"]) -> Filtered:
    """The departures of all segments: one filter pass over the recording with a filled signal.

    extra: variance beyond the sensor's. With that of filled values departures know how uncertain their tilt is, and
    one bad fill does not bend what follows.
    """
    samples = Samples(signal, trial.period, trial.variance + extra)
    return closed_loop(samples, trial.rows, trial.prior, trial.prior_covariance, trial.gravity)


def solve_segments(
    trial: Trial,
    states: NavState,
    covariances: Float[Arrays, "L s s"],
    table: Float[Arrays, "L 10 10"],
    departure: Int[Arrays, "L"],
    arrival: Int[Arrays, "L"],
    prior: SignalPrior | None,
    sizes: Sizes,
    options: Options,
) -> tuple[SegmentFill, Values]:
    """Some segments of a recording side by side, from the filtered states at their departures.

    prior: what `signal_prior` says; None for methods other than `map`.
    """

    def solve(state, covariance, table, departure, arrival):
        segment, values = gather(trial, departure, arrival, state, covariance, table, sizes, prior)
        return solve_segment(segment, jnp.asarray(trial.gravity), options), values

    return jax.vmap(solve)(states, covariances, table, departure, arrival)


def signal_prior(trial: Trial) -> SignalPrior:
    """What the unsaturated samples of a recording say of its saturated ones."""
    moving = ~jnp.asarray(trial.rows.rest)
    signal, sign, clean = map(jnp.asarray, (trial.signal, trial.sign, trial.clean))
    return learn(signal, sign, clean, moving, jnp.asarray(trial.period)[0])


def trial_biases(
    trial: Trial,
    signal: Float[Arrays, "N 6"],
    extra: Float[Arrays, "N 6"],
    sd: Float[Arrays, "6"],
    start: Float[Arrays, "6"],
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Biases of the sensors (rad/s, m/s²) by one step from `start`, given a filled signal, and their covariance.

    `extra` as above.
    """
    samples = Samples(signal, trial.period, trial.variance + extra)
    return estimate_biases(
        samples, trial.rows, trial.prior, trial.prior_covariance, trial.gravity, sd, 1, start
    )


_bias = stored_jit(trial_biases)
filter_recording = stored_jit(filter_trial)
_solve = stored_jit(solve_segments)
_prior = stored_jit(signal_prior, UNOPTIMISED)


@stored_jit
def _arrivals(trial: Trial, start, end, longest):
    return arrivals(Samples(trial.signal, trial.period, trial.variance), trial.rows, start, end, longest)


def arrival_table(trial: Trial, segments: Segments) -> Float[np.ndarray, "S 10 10"]:
    """Λ of every segment's arrival; zeros where no rest follows. Independent of δ: rests do not saturate."""
    # A segment without a departure has no known start, so its arrival tells nothing about it.
    length = np.where(segments.departure >= 0, segments.rest_end - segments.arrival, 0)
    table = np.zeros((len(segments), 10, 10))
    # Rests of like length side by side: all wait for the longest.
    order = np.argsort(length)
    for first in range(0, len(order), LANES):
        mine = order[first : first + LANES]
        lanes = bucket(len(mine), 1)
        start, steps = pad(segments.arrival[mine], lanes), pad(length[mine], lanes)
        table[mine] = np.asarray(_arrivals(trial, start, start + steps, steps.max()))[: len(mine)]
    return table


def _solve_some(
    trial, departures, table, segments: Segments, mine, prior, sizes: Sizes, options, fills: Fills
) -> None:
    """Solve the segments `mine`, padded to a bucket of lanes, and record them."""
    lanes = bucket(len(mine), 1)
    given = (departures, table[mine], segments.departure[mine], segments.arrival[mine])
    (states, covariances), table, departure, arrival = jax.tree.map(lambda x: pad(x, lanes), given)
    found = _solve(trial, states, covariances, table, departure, arrival, prior, sizes, options)
    fills.record(trial, mine, *found)


def compensate_parallel(
    trial: Trial,
    segments: Segments,
    options: Options,
    sweeps: int = 2,
    progress: Progress | None = None,
    filtered: Filtered | None = None,
) -> Fills:
    """Solve each segment on its own from one filter pass over the recording; then again with the filled signal.

    filtered: the first of these passes, where it is at hand.
    """
    fills = Fills.nothing(trial, len(segments))
    table = arrival_table(trial, segments)
    prior = _prior(trial) if options.method == "map" else None
    chunks = list(_chunks(*count_values(trial.sign, segments)))
    total, done = sum(len(mine) for mine, _ in chunks), 0
    for sweep in range(sweeps):
        if sweep or filtered is None:
            filtered = filter_recording(trial, fills.unbiased, fills.variance)
        states, covariances, _ = jax.tree.map(np.asarray, filtered)
        shifted = eqx.tree_at(lambda t: t.signal, trial, trial.signal - fills.bias[None])
        for mine, sizes in chunks:
            at = np.maximum(segments.departure[mine], 0)
            departures = jax.tree.map(lambda x, at=at: x[at], (states, covariances))
            _solve_some(shifted, departures, table, segments, mine, prior, sizes, options, fills)
            done += len(mine)
            if progress:
                progress(done, sweeps * total)
        if options.bias_sd is not None:
            bias, known = _bias(trial, fills.signal, fills.variance, options.bias_sd, fills.bias)
            fills = replace(fills, bias=np.asarray(bias), bias_sd=np.sqrt(np.diagonal(known)))
    return fills


def _chunks(
    samples: Int[np.ndarray, "S"], values: Int[np.ndarray, "S"]
) -> Iterator[tuple[Int[np.ndarray, "L"], Sizes]]:
    """Segments that saturate, those of like size together; a short recording is one chunk, so one program."""
    busy = np.flatnonzero(values)
    busy = busy[np.lexsort((samples[busy], values[busy]))]
    for first in range(0, len(busy), LANES):
        mine = busy[first : first + LANES]
        yield mine, padded_sizes(int(samples[mine].max()), int(values[mine].max()))


def compensate_sequential(
    trial: Trial, segments: Segments, options: Options, progress: Progress | None = None
) -> Fills:
    """The paper's order: each segment departs from the filtered end of the one before, filled already."""
    fills = Fills.nothing(trial, len(segments))
    table = arrival_table(trial, segments)
    prior = _prior(trial) if options.method == "map" else None
    samples, values = count_values(trial.sign, segments)
    busy = np.flatnonzero(values)
    # One program for all of them.
    sizes = padded_sizes(int(samples[busy].max(initial=1)), int(values[busy].max(initial=1)))
    state, covariance, at = trial.prior, trial.prior_covariance, 0
    for count, index in enumerate(busy.tolist()):
        departure = max(0, int(segments.departure[index]))
        state, covariance = _filter_to(trial, fills, state, covariance, at, departure)
        at = departure
        here = jax.tree.map(lambda x: np.asarray(x)[None], (state, covariance))
        _solve_some(trial, here, table, segments, np.array([index]), prior, sizes, options, fills)
        if progress:
            progress(count + 1, len(busy))
    return fills


def _filter_to(trial: Trial, fills: Fills, state: NavState, covariance, start: int, stop: int):
    """The filtered state at sample `stop`, from that at `start` (whose rows are used already, but at 0)."""
    states, covariances, _ = _filter_span(
        trial, fills.signal, fills.variance, state, covariance, start, stop + 1, start == 0
    )
    at = stop - start
    return jax.tree.map(lambda x: np.asarray(x[at]), states), np.asarray(covariances[at])


def filter_part(
    trial: Trial,
    rest: Bool[np.ndarray, "N"],
    state: NavState,
    covariance: Float[Arrays, "s s"],
    start: int,
    stop: int,
) -> Filtered:
    """The filter over samples [start, stop) with other rests, from the filtered state at `start`; nothing filled."""
    other = eqx.tree_at(lambda t: t.rows.rest, trial, rest)
    nothing = trial.signal, np.asarray(trial.unfilled_variance)
    return _filter_span(other, *nothing, state, covariance, start, stop, False)


def _filter_span(trial: Trial, signal, extra, state, covariance, start: int, stop: int, fresh: bool):
    """The filter over samples [start, stop); fresh: the rows of `start` are not used already."""
    size = bucket(stop - start, 256)

    def span(x):
        return pad(np.asarray(x)[start:stop], size)

    unused = jnp.arange(size) >= (0 if fresh else 1)
    rows = jax.tree.map(lambda x: jnp.asarray(span(x)), trial.rows).marked(lambda flags: flags & unused)
    part = Trial(
        signal=span(trial.signal),
        period=span(trial.period),
        variance=span(trial.variance),
        sign=span(trial.sign),
        clean=span(trial.clean),
        bound=trial.bound,
        rows=rows,
        prior=state,
        prior_covariance=covariance,
        gravity=trial.gravity,
    )
    return filter_recording(part, span(signal), span(extra))
