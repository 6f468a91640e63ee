"""All segments of a recording, in parallel or one after the other (paper A, Section 5)."""

from collections.abc import Callable, Iterator
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsat.inertial.calibration import Calibration, calibrate
from jaxsat.inertial.programs import UNOPTIMISED, Beside, stored_jit, trace_ahead, usable_cores
from jaxsat.inertial.smoother import Filtered, closed_loop, filtered_size
from jaxsat.inertial.strapdown import NavState, Samples
from jaxsat.saturation.arrival import arrival_table
from jaxsat.saturation.experience import Heard, experienced
from jaxsat.saturation.layout import (
    LANES,
    Arrays,
    Ends,
    Sizes,
    Trial,
    Values,
    bucket,
    count_values,
    evenly,
    gather,
    pad,
    padded_lanes,
    padded_sizes,
)
from jaxsat.saturation.methods import Options, SegmentFill, solve_segment
from jaxsat.saturation.prior import Scales, SignalPrior, blank, learn
from jaxsat.saturation.solvers import Status
from jaxsat.signals.rests import Segments

Progress = Callable[[int, int], None]
"""Called with (segments done, segments in all)."""

# `map` holds some matrices of values × values for each: of all together one has no more entries than of 32 × 512².
ENTRIES = LANES * 512**2
# Gauss-Newton steps from no calibration: a third changes no digit that is reported.
FIRST_STEPS = 2


class Fills(eqx.Module):
    """The filled signal, and how each segment ended (one row a segment)."""

    signal: Float[np.ndarray, "N 6"]
    variance: Float[np.ndarray, "N 6"]
    """What a filled value adds to the sensor's noise, before rests are heard."""
    slack: Float[np.ndarray, "N 6"]
    """What it adds for the path that goes with the filled signal."""
    sd: Float[np.ndarray, "N 6"]
    """Of filled values: by `map` that of their posterior, by the others that of a value anywhere in its bounds."""
    gap_sd: Float[np.ndarray, "N 6"]
    """Of the sum over the gap that a filled value lies in; NaN where the method does not say."""
    identified: Float[np.ndarray, "N 6"]
    """Share of the variance of that sum that the rests removed; NaN where the method does not say."""
    heard: Heard
    """[N, 6] each: `Uncertainty.heard`; nothing where the method does not say."""
    asked: Float[np.ndarray, "S"]
    """Of each segment: `Uncertainty.asked`, and NaN."""
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
    """f(0), with the departure of the last sweep; by `map` with the noise of `Experience`, like `cost_after`."""
    cost_after: Float[np.ndarray, "S"]
    residual: Float[np.ndarray, "S"]
    iterations: Int[np.ndarray, "S"]

    @staticmethod
    def nothing(trial: Trial, count: int) -> "Fills":
        zeros, shape, unfilled = np.zeros(count), trial.signal.shape, np.asarray(trial.unfilled_variance)
        return Fills(
            signal=np.array(trial.signal),
            variance=unfilled.copy(),
            slack=unfilled.copy(),
            sd=np.zeros(shape),
            gap_sd=np.full(shape, np.nan),
            identified=np.full(shape, np.nan),
            heard=Heard(np.zeros(shape), np.full(shape, np.inf), np.zeros(shape)),
            asked=np.full(count, np.nan),
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
            trial.signal[sample, channel] + trial.sign[sample, channel] * found.delta[real]
        )
        self.variance[sample, channel] = found.variance[real]
        self.slack[sample, channel] = found.slack[real]
        self.sd[sample, channel] = np.sqrt(found.variance[real])
        self.at_bound[sample, channel] = found.at_bound[real]
        self.inflated[sample, channel] = found.inflated[real]
        if (known := found.uncertainty) is not None:
            self.sd[sample, channel], self.gap_sd[sample, channel] = known.sd[real], known.gap_sd[real]
            self.identified[sample, channel] = known.identified[real]
            for whole, part in zip(jax.tree.leaves(self.heard), jax.tree.leaves(known.heard), strict=True):
                whole[sample, channel] = part[real]
            self.asked[segments] = known.asked
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
    filled: Float[Arrays, "N 6"],
    ends: Ends,
    prior: SignalPrior | None,
    sizes: Sizes,
    options: Options,
) -> tuple[SegmentFill, Values]:
    """Some segments of a recording side by side.

    filled: the signal to begin with, `trial.signal` where nothing is known; prior: what `signal_prior` says, None for
    methods other than `map`.
    """

    def solve(ends):
        segment, values = gather(trial, ends, sizes, prior, filled)
        return solve_segment(segment, jnp.asarray(trial.gravity), options), values

    return jax.vmap(solve)(ends)


def signal_prior(trial: Trial, scales: Scales) -> SignalPrior:
    """What the unsaturated samples of a recording say of its saturated ones."""
    moving = ~jnp.asarray(trial.rows.rest)
    signal, sign, clean = map(jnp.asarray, (trial.signal, trial.sign, trial.clean))
    return learn(signal, sign, clean, moving, jnp.asarray(trial.period)[0], scales)


def calibrate_trial(
    trial: Trial,
    signal: Float[Arrays, "N 6"],
    extra: Float[Arrays, "N 6"],
    sd: Float[Arrays, "9"],
    start: Calibration,
) -> Calibration:
    """The constants of a recording by one step from `start`, given a filled signal; `extra` as above.

    sd: prior sd of each.
    """
    samples = Samples(signal, trial.period, trial.variance + extra)
    known = trial.rows, trial.prior, trial.prior_covariance, trial.gravity
    return calibrate(samples, *known, sd, start)


calibrate_recording = stored_jit(calibrate_trial)
filter_recording = stored_jit(filter_trial)
_solve = stored_jit(solve_segments)
_prior = stored_jit(signal_prior, UNOPTIMISED)
_experienced = stored_jit(experienced)


def _solve_some(calibrated: Trial, filled, ends: Ends, prior, options, chunk) -> tuple[SegmentFill, Values]:
    """Solve some segments, of `solved_together`, padded to a number of lanes; ends: of all segments."""
    mine, sizes = chunk
    ends = jax.tree.map(lambda x: pad(x[mine], padded_lanes(len(mine))), ends)
    return jax.block_until_ready(_solve(calibrated, filled, ends, prior, sizes, options))


def trace_search(
    trial: Trial, segments: Segments, options: Options, *, together: bool
) -> list[Callable[[], None]]:
    """What compiles the programs of `compensate_parallel` (together) or `compensate_sequential` that take longest."""
    size, prior = filtered_size(trial.rows), None
    blank_ends = Ends(np.array(0), np.array(0), trial.prior, np.zeros((size, size)), np.zeros((10, 10)))
    if options.method == "map":
        prior = blank(len(trial.period), options.scales)
    counts, programs, still = count_values(trial.sign, segments), {}, trial.signal[:, :3]
    here = eqx.tree_at(lambda t: t.rows.velocity, trial, still, is_leaf=lambda x: x is None)
    for mine, sizes in solved_together(*counts) if together else [_one_by_one(*counts)]:
        lanes = padded_lanes(len(mine)) if together else 1
        ends = jax.tree.map(lambda x, lanes=lanes: np.broadcast_to(x, (lanes, *np.shape(x))), blank_ends)
        if len(mine) and (lanes, sizes) not in programs:
            programs[lanes, sizes] = trace_ahead(_solve, here, trial.signal, ends, prior, sizes, options)
    return list(programs.values())


def learn_prior(trial: Trial, options: Options) -> SignalPrior | None:
    """What a search takes from the signals alone: the signal prior, for methods that have one."""
    return _prior(trial, options.scales) if options.method == "map" else None


def compensate_parallel(
    trial: Trial,
    segments: Segments,
    options: Options,
    calibration: Calibration,
    learned: Callable[[], SignalPrior | None],
    sweeps: int,
    progress: Progress | None = None,
) -> tuple[Fills, Calibration]:
    """Solve each segment on its own from one filter pass over the recording; then again with the filled signal.

    `map` also learns from each sweep what gaps like a gap lost.

    calibration: to begin with; the one that goes with the fills is returned with them. learned: gives what
    `learn_prior` does, and is asked when nothing else is left to do.
    """
    fills = Fills.nothing(trial, len(segments))
    chunks = list(solved_together(*count_values(trial.sign, segments)))
    total, done, prior = sum(len(mine) for mine, _ in chunks), 0, None
    first = np.maximum(segments.departure, 0)
    with Beside(usable_cores()) as beside:
        for sweep in range(sweeps):
            here = trial.calibrated(calibration)
            filled = fills.signal - np.asarray(calibration.constants)[None, :6]
            arriving = beside.submit(arrival_table, here, segments)
            filtered = filter_recording(here, filled, fills.variance)
            states, covariances = jax.tree.map(
                lambda x: np.asarray(x)[first], (filtered.state, filtered.covariance)
            )
            if sweep == 0:
                prior = learned()
            ends = Ends(segments.departure, segments.arrival, states, covariances, arriving.result())
            solve = partial(_solve_some, here, filled, ends, prior, options)
            for (mine, _), found in zip(chunks, beside.map(solve, chunks), strict=True):
                fills.record(trial, mine, *found)
                done += len(mine)
                if progress:
                    progress(done, sweeps * total)
            calibration = recalibrated(trial, fills, options, calibration)
            if prior is not None:
                taught = _experienced(prior.experience, trial.sign, fills.heard, fills.asked)
                prior = eqx.tree_at(lambda p: p.experience, prior, taught)
    return fills, calibration


def recalibrated(trial: Trial, fills: Fills, options: Options, calibration: Calibration) -> Calibration:
    """The calibration that goes with a filled signal, from the one before."""
    if options.calibration_sd is None:
        return calibration
    return calibrate_recording(trial, fills.signal, fills.variance, options.calibration_sd, calibration)


def solved_together(
    samples: Int[np.ndarray, "S"], values: Int[np.ndarray, "S"]
) -> Iterator[tuple[Int[np.ndarray, "L"], Sizes]]:
    """Segments that saturate, those of like size together; a short recording is of one size, so one program."""
    busy = np.flatnonzero(values)
    busy = busy[np.lexsort((samples[busy], values[busy]))]
    while len(busy):
        longest = int(values[busy[: 2 * LANES]].max())
        lanes = min(LANES, max(1, ENTRIES // padded_sizes(1, longest).values ** 2))
        alike, busy = busy[: 2 * lanes], busy[2 * lanes :]
        sizes = padded_sizes(int(samples[alike].max()), int(values[alike].max()))
        yield from ((mine, sizes) for mine in evenly(alike, lanes))


def _one_by_one(
    samples: Int[np.ndarray, "S"], values: Int[np.ndarray, "S"]
) -> tuple[Int[np.ndarray, "L"], Sizes]:
    """Segments that saturate, and the sizes of one program for all of them."""
    busy = np.flatnonzero(values)
    return busy, padded_sizes(int(samples[busy].max(initial=1)), int(values[busy].max(initial=1)))


def compensate_sequential(
    trial: Trial,
    segments: Segments,
    options: Options,
    calibration: Calibration,
    learned: Callable[[], SignalPrior | None],
    progress: Progress | None = None,
) -> tuple[Fills, Calibration]:
    """The paper's order: each segment departs from the filtered end of the one before, filled already.

    calibration, learned: as in `compensate_parallel`.
    """
    fills = Fills.nothing(trial, len(segments))
    here, bias = trial.calibrated(calibration), np.asarray(calibration.constants)[None, :6]
    table = arrival_table(here, segments)
    busy, sizes = _one_by_one(*count_values(trial.sign, segments))
    state, covariance, at, prior = trial.prior, trial.prior_covariance, 0, learned()
    for count, index in enumerate(busy.tolist()):
        departure = max(0, int(segments.departure[index]))
        span = (at, departure + 1, at == 0)
        filtered = _filter_span(here, fills.signal - bias, fills.variance, state, covariance, *span)
        last = departure - at
        state, covariance = jax.tree.map(
            lambda x, last=last: np.asarray(x[last]), (filtered.state, filtered.covariance)
        )
        at = departure
        states, covariances = jax.tree.map(lambda x: np.stack([x] * len(segments)), (state, covariance))
        ends = Ends(segments.departure, segments.arrival, states, covariances, table)
        mine = np.array([index])
        found = _solve_some(here, fills.signal - bias, ends, prior, options, (mine, sizes))
        fills.record(trial, mine, *found)
        if progress:
            progress(count + 1, len(busy))
    return fills, recalibrated(trial, fills, options, calibration)


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
