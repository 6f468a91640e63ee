"""The elements of a sweep: one trial clipped at one set of rails, reconstructed by every method, and compared.

`score` works on one element; `run_elements` is the one place that runs it on many of them.
"""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import AxisType, Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from jaxsat.config import Config
from jaxsat.inertial.calibration import Calibration
from jaxsat.inertial.programs import Beside, compiled, stored_jit, usable_cores
from jaxsat.inertial.smoother import smooth
from jaxsat.inertial.strapdown import Samples
from jaxsat.preparation import Prepared, constants_sd, find_ground
from jaxsat.saturation.arrival import arrivals
from jaxsat.saturation.compensate import (
    FIRST_STEPS,
    calibrate_trial,
    filter_trial,
    signal_prior,
    solve_segments,
)
from jaxsat.saturation.experience import Heard, experienced
from jaxsat.saturation.layout import Arrays, Ends, Sizes, Trial, pad
from jaxsat.saturation.methods import Options
from jaxsat.saturation.solvers import Status
from jaxsat.signals.recording import sensor_changes

# Numbers of eight bytes that a call keeps alive for each sample (and for each further method that compensates), each
# padded sample of a segment, and each of its padded saturated values; fitted to what XLA reported on a CPU, elements
# side by side, for its arguments, results and temporary arrays.
_PER_SAMPLE, _PER_METHOD, _PER_MOVING, _PER_VALUE = 450, 200, 75, 110
# And of `map`, for each sample and each pair of such values.
_PER_LEARNED, _PER_PAIR = 1000, 10

# Elements of a call on each device of a CPU, which runs them one after the other: more would only wait for the last.
ELEMENTS = 64

# How a search can end, from best to worst.
_SEVERITY = (
    Status.NOTHING_TO_DO,
    Status.CONVERGED,
    Status.NO_ARRIVAL,
    Status.STALLED,
    Status.MAX_ITERATIONS,
)

Scores = dict[str, dict[str, Arrays]]
"""Of each method, by the names of columns."""


class Case(eqx.Module):
    """A trial as a sweep holds it: padded to the shapes of its bucket."""

    trial: Trial
    grounded: Bool[Arrays, "N"] | None
    """First samples of the rests whose height the path is told (`find_ground`)."""
    offset: Float[Arrays, "6"]
    """What was taken off the signal: rails act on what the sensor reads."""
    departure: Int[Arrays, "S"]
    arrival: Int[Arrays, "S"]
    rest_end: Int[Arrays, "S"]
    change: Float[Arrays, "6"]
    """Share of a sensor's change between samples that is noise, of each channel."""
    length: Int[Arrays, ""]
    path: Float[Arrays, "N 3"] | None
    """What to compare with; None for that of the recording as given, by the standard smoother."""


def make_case(
    prepared: Prepared,
    busy: Int[np.ndarray, "B"],
    lanes: int,
    config: Config,
    path: Float[np.ndarray, "N 3"] | None = None,
) -> Case:
    """A trial of which the segments `busy` may saturate; path: `Case.path`."""
    trial, segments = prepared.trial, prepared.segments
    # What a segment without a departure arrives at tells nothing about it. Nor does a padded lane have anything to
    # solve.
    rest_end = np.where(segments.departure >= 0, segments.rest_end, segments.arrival)
    return Case(
        trial=jax.tree.map(np.asarray, trial),
        grounded=find_ground(prepared, config),
        offset=offset_of(prepared),
        departure=pad(segments.departure[busy], lanes),
        arrival=pad(segments.arrival[busy], lanes),
        rest_end=pad(rest_end[busy], lanes),
        change=np.array(config.noise.changes),
        length=np.asarray(len(prepared.rest)),
        path=path,
    )


def offset_of(prepared: Prepared) -> Float[np.ndarray, "6"]:
    """What to add to the signal of the trial for what the sensor read (rad/s, m/s²)."""
    return np.concatenate([prepared.gyr_offset, np.zeros(3)])


def measured(trial: Trial) -> Bool[Arrays, "N 6"]:
    """Values that were measured, saturated or not."""
    return trial.clean | (trial.sign != 0)


def element_bytes(length: int, lanes: int, sizes: Sizes, methods: Sequence[str]) -> float:
    """About what the arrays of one element take, at most.

    length: padded samples of the trial; lanes: segments, of the padded lengths `sizes`.
    """
    compensating = sum(method != "standard" for method in methods)
    each = _PER_SAMPLE + _PER_METHOD * max(0, compensating - 1)
    of_lane = sizes.samples * _PER_MOVING + sizes.values * _PER_VALUE
    if "map" in methods:
        each, of_lane = each + _PER_LEARNED, of_lane + _PER_PAIR * sizes.values**2
    return 8.0 * (length * each + lanes * of_lane)


class Chunk(NamedTuple):
    """Elements of one call."""

    which: Int[np.ndarray, "C"]
    """The case of each."""
    values: Float[np.ndarray, "C 4"]
    """Gyroscope rail, accelerometer rail and the two bounds of each."""
    held: int
    """So many cases at most are among the elements of any chunk."""
    real: int
    """Elements after so many repeat the last one."""


def chunks(cases: int, grid: Float[np.ndarray, "E 4"], size: int) -> Iterator[Chunk]:
    """Every case at each row of rails and bounds, case after case, in chunks of one size."""
    count = cases * len(grid)
    # A chunk may begin and end within the rails of a case.
    held = min(cases, -(-size // len(grid)) + 1)
    for first in range(0, count, size):
        at = np.minimum(np.arange(first, first + size), count - 1)
        yield Chunk(at // len(grid), grid[at % len(grid)], held, min(size, count - first))


def calls_at_once() -> int:
    """A CPU that is one device runs as many as it has cores; otherwise devices share the elements of one."""
    alone = jax.default_backend() == "cpu" and jax.local_device_count() == 1
    return usable_cores() if alone else 1


def run_elements(
    cases: Sequence[Case],
    grid: Float[np.ndarray, "E 4"],
    size: int,
    sizes: Sizes,
    options: tuple[Options, ...],
    config: Config,
    standard: bool,
) -> Iterator[tuple[Chunk, Scores]]:
    """The scores, by method, of every case at each row of rails and bounds, chunk after chunk.

    cases: all of like shapes. size: elements of a chunk, a multiple of the number of local devices, among which they
    are spread. Chunks of one size that hold as many cases share a program.
    """
    cases = _alike(cases)
    first, *others = chunks(len(cases), grid, size)

    def run(chunk: Chunk) -> Scores:
        return _run_chunk(cases, chunk, sizes, options, config, standard)

    # The first compiles what the others run.
    yield first, run(first)
    with Beside(calls_at_once()) as beside:
        yield from zip(others, beside.map(run, others), strict=True)


def _alike(cases: Sequence[Case]) -> list[Case]:
    """Cases that can be stacked: if the ground of one is known, rests of the others are on none."""
    if all(case.grounded is None for case in cases):
        return list(cases)
    nowhere = np.zeros(len(cases[0].trial.signal), bool)
    return [replace(case, grounded=nowhere) if case.grounded is None else case for case in cases]


def _run_chunk(
    cases: Sequence[Case],
    chunk: Chunk,
    sizes: Sizes,
    options: tuple[Options, ...],
    config: Config,
    standard: bool,
) -> Scores:
    devices = jax.local_device_count()
    mesh = jax.make_mesh((devices,), ("elements",), (AxisType.Auto,), devices=jax.local_devices())
    rails, bounds = (np.repeat(part, 3, axis=1) for part in np.split(chunk.values, 2, axis=1))
    used, index = np.unique(chunk.which, return_inverse=True)
    # Each case travels to the devices once, however many rails it is clipped at.
    used = np.resize(used, -(-chunk.held // devices) * devices)
    stacked = jax.tree.map(lambda *x: np.stack(x), *(cases[i] for i in used))
    whole, index, rails, bounds = jax.device_put(
        (stacked, index, rails, bounds), NamedSharding(mesh, PartitionSpec("elements"))
    )
    found = _scores(
        whole,
        index,
        rails,
        bounds,
        mesh,
        sizes,
        options,
        constants_sd(config),
        tuple(config.saturation.passes(option.method) for option in options),
        jnp.asarray(config.smoother.relinearisations),
        standard,
    )
    return jax.tree.map(np.asarray, found)


@compiled
def _scores(cases: Case, index, rails, bounds, mesh: Mesh, *settings) -> Scores:
    _, _, wanted, _, relinearisations, _ = settings
    spread = PartitionSpec("elements")

    def on_devices(function, *spread_out):
        # Devices run on their own: a search that is done in one need not wait for another's.
        return jax.shard_map(function, mesh=mesh, in_specs=spread, out_specs=spread, check_vma=False)(
            *spread_out
        )

    if cases.path is None:

        def paths(trials: Trial, grounded):
            return _paths_of_device(trials, grounded, wanted, relinearisations)

        path = on_devices(paths, cases.trial, cases.grounded)
        cases = eqx.tree_at(lambda c: c.path, cases, path, is_leaf=lambda x: x is None)
    elements = jax.tree.map(lambda x: x[index], cases)
    return on_devices(lambda *mine: _scores_of_device(*mine, *settings), elements, rails, bounds)


@partial(stored_jit, options=None)
def _paths_of_device(trials: Trial, grounded, wanted, relinearisations) -> Float[Array, "C N 3"]:
    """Of recordings as given, by the standard smoother."""

    def path(trial: Trial, grounded):
        calibration = _calibration(trial, trial.signal, trial.unfilled_variance, wanted)
        told = trial.on_ground(grounded)
        return _smooth_path(told, trial.signal, trial.variance, calibration, relinearisations)

    return _of_each(path, trials, grounded)


@partial(stored_jit, options=None)
def _scores_of_device(cases: Case, rails, bounds, *settings) -> Scores:
    return _of_each(lambda case, rail, bound: score(case, rail, bound, *settings), cases, rails, bounds)


def _of_each(function: Callable, *over):
    """`vmap`; on a CPU a loop: filters of one trial are one program there and keep within its caches."""
    if jax.default_backend() == "cpu":
        return jax.lax.map(lambda each: function(*each), over)
    return jax.vmap(function)(*over)


def score(
    case: Case,
    rail: Float[Array, "6"],
    bound: Float[Array, "6"],
    sizes: Sizes,
    options: tuple[Options, ...],
    wanted: Float[Array, "9"] | None,
    sweeps: tuple[int, ...],
    relinearisations: Int[Array, ""],
    standard: bool,
) -> Scores:
    """One trial clipped at one set of rails; every method on it.

    sweeps: of each method; wanted: prior sd of what is constant, as `Options.calibration_sd`.
    """
    whole, count = case.trial, len(case.trial.signal)
    raw = whole.signal + case.offset[None]
    real = jnp.arange(count) < case.length
    beyond = (jnp.abs(raw) >= rail[None]) & real[:, None]
    # A value that was not measured does not saturate, whatever was interpolated there.
    clipped = beyond & measured(whole)
    # Only a value that did not saturate before is known.
    known = clipped & whole.clean
    way = jnp.sign(raw)
    sign = jnp.where(clipped, way.astype(whole.sign.dtype), whole.sign)
    signal = jnp.where(beyond, way * rail[None] - case.offset[None], whole.signal)
    noisier = sensor_changes(signal) ** 2 - sensor_changes(whole.signal) ** 2
    variance = whole.variance + jnp.where(measured(whole), case.change[None] ** 2 * noisier, 0.0)
    trial = eqx.tree_at(
        lambda t: (t.signal, t.variance, t.sign, t.clean, t.bound),
        whole,
        (signal, variance, sign, whole.clean & ~clipped, bound),
    )

    def compared(path, filled):
        away = jnp.sum((path - case.path) ** 2, axis=1)
        last = case.length - 1
        wrong = jnp.sum(jnp.where(known, filled - whole.signal, 0.0).reshape(count, 2, 3) ** 2, axis=(0, 2))
        missing = jnp.sum(known.reshape(count, 2, 3), axis=(0, 2)).astype(wrong.dtype)
        fill = jnp.where(missing > 0, jnp.sqrt(wrong / jnp.maximum(missing, 1)), jnp.nan)
        return {
            "saturated": jnp.sum(sign != 0),
            "path_rmse": jnp.sqrt(jnp.sum(jnp.where(real, away, 0.0)) / case.length.astype(away.dtype)),
            "end_distance": jnp.sqrt(away[last]),
            **{f"end_{axis}": path[last, i] for i, axis in enumerate("xyz")},
            **{f"fill_rmse_{sensor}": fill[i] for i, sensor in enumerate(("gyr", "acc"))},
        }

    found, at, unfilled = {}, jnp.maximum(case.departure, 0), trial.unfilled_variance
    told = trial.on_ground(case.grounded)
    first = _calibration(trial, signal, unfilled, wanted)
    if standard:
        path = _smooth_path(told, signal, trial.variance, first, relinearisations)
        found["standard"] = compared(path, signal)
    bare = None if wanted is not None or not options else _table(case, trial)
    for option, passes in zip(options, sweeps, strict=True):
        first_prior = signal_prior(trial, option.scales) if option.method == "map" else None

        def once(before, _, option=option):
            filled, extra, _, calibration, prior = before
            here, filled = trial.calibrated(calibration), filled - calibration.constants[None, :6]
            filtered = filter_trial(here, filled, extra)
            states, covariances, _ = jax.tree.map(lambda x: x[at], filtered)
            table = _table(case, here) if bare is None else bare
            ends = Ends(case.departure, case.arrival, states, covariances, table)
            fill, values = solve_segments(here, filled, ends, prior, sizes, option)
            place = (values.sample, values.channel)
            way = sign.at[place].get(mode="fill", fill_value=0)
            filled = signal.at[place].add(way.astype(signal.dtype) * fill.delta, mode="drop")
            extra, slack = (unfilled.at[place].set(x, mode="drop") for x in (fill.variance, fill.slack))
            calibration = _calibration(trial, filled, extra, wanted, 1, calibration)
            if (found := fill.uncertainty) is not None:
                # Of values that do not saturate nothing is heard.
                nothing = Heard(
                    jnp.zeros_like(signal), jnp.full_like(signal, jnp.inf), jnp.zeros_like(signal)
                )
                heard = jax.tree.map(lambda x, y: x.at[place].set(y, mode="drop"), nothing, found.heard)
                asked = jnp.where(jnp.any(values.sample < count, axis=1), found.asked, jnp.nan)
                taught = experienced(prior.experience, sign, heard, asked)
                prior = eqx.tree_at(lambda p: p.experience, prior, taught)
            return (filled, extra, slack, calibration, prior), (fill, values)

        # A loop, not a repetition: the program is compiled once.
        begin = (signal, unfilled, unfilled, first, first_prior)
        (filled, _, slack, calibration, _), every = jax.lax.scan(once, begin, None, length=passes)
        fill, values = jax.tree.map(lambda x: x[-1], every)
        path = _smooth_path(told, filled, trial.variance + slack, calibration, relinearisations)
        busy = jnp.any(values.sample < count, axis=1)
        order = jnp.asarray([_SEVERITY.index(status) for status in sorted(Status)])
        worst = jnp.max(jnp.where(busy, order[fill.solution.status], 0))
        found[option.method] = {
            **compared(path, filled),
            "segments": jnp.sum(busy),
            "status": jnp.asarray(_SEVERITY)[worst],
            "cost_before": jnp.sum(jnp.where(busy, fill.cost_before, 0.0)),
            "cost_after": jnp.sum(jnp.where(busy, fill.solution.value, 0.0)),
            "iterations": jnp.sum(jnp.where(busy, fill.solution.iterations, 0)),
            "residual": jnp.max(jnp.where(busy, fill.solution.residual, 0.0)),
            "at_bound": jnp.sum(fill.at_bound),
        }
    return found


def _calibration(
    trial: Trial, signal, extra, wanted, steps: int = FIRST_STEPS, start: Calibration | None = None
) -> Calibration:
    start = Calibration.none() if start is None else start
    if wanted is None:
        return start

    def step(_, found: Calibration) -> Calibration:
        return calibrate_trial(trial, signal, extra, wanted, found)

    return jax.lax.fori_loop(0, steps, step, start)


def _table(case: Case, trial: Trial) -> Float[Array, "S 10 10"]:
    """Λ of each arrival."""
    samples = Samples(trial.signal, trial.period, trial.variance)
    longest = jnp.max(case.rest_end - case.arrival)
    return arrivals(samples, trial.rows, case.arrival, case.rest_end, longest)


def _smooth_path(
    trial: Trial, signal, variance, calibration: Calibration, relinearisations
) -> Float[Array, "N 3"]:
    samples, rows = calibration.applied(Samples(signal, jnp.asarray(trial.period), variance), trial.rows)
    known = trial.prior, jnp.asarray(trial.prior_covariance), jnp.asarray(trial.gravity)
    return smooth(samples, rows, *known, relinearisations).state.position[:-1]
