"""What the speed board measures on: bars in a batch, walks, and a bare strapdown pass beside them."""

from collections.abc import Callable
from functools import cache, partial
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from peers import shortest
from peers.strapdown import bare_trials, numba_strapdown

from jaxsat import Sensor, load_config, simulate
from jaxsat.inertial.programs import Beside, compiled, computing, usable_cores
from jaxsat.inertial.strapdown import Samples
from jaxsat.pipeline import search_options
from jaxsat.preparation import prepare
from jaxsat.saturation.arrival import arrivals
from jaxsat.saturation.compensate import filter_trial, solve_segments
from jaxsat.saturation.layout import Ends, Sizes, Trial, padded_sizes
from jaxsat.saturation.methods import Options
from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import find_segments
from jaxsat.studies import sweep
from jaxsat.studies.elements import run_elements
from jaxsat.studies.motions import Bar, Walk
from jaxsat.studies.simulate import GRAVITY, Truth

# Before any array is made: the tolerances among the options are of double precision.
jax.config.update("jax_enable_x64", True)
OPTIONS = search_options(load_config(), "direct")


# A sweep in a process of its own; trials and rails are its arguments. Prints peak memory, seconds, share converged.
SWEEP = """
import dataclasses, pathlib, sys, time
import jax, numpy as np
from jaxsat import Sensor, load_config, simulate, sweep
from jaxsat.studies.motions import Bar
trials, rails = int(sys.argv[1]), int(sys.argv[2])
recording, truth = simulate(Bar(), rate=320.0, duration=1.6, sensor=Sensor(), key=jax.random.key(0))
rng = np.random.default_rng(0)
recordings = [
    dataclasses.replace(
        recording, rest=truth.rest, name=f"bar {i}",
        gyr=recording.gyr + 1e-3 * rng.normal(size=recording.gyr.shape),
    )
    for i in range(trials)
]
start = time.perf_counter()
table = sweep(
    recordings, load_config(None, **{"saturation.gyr_bound": 5.0}), methods=("direct",),
    gyr_rails=np.linspace(4.0, 10.0, rails), memory=1.5e8,
)
seconds = time.perf_counter() - start
assert len(table) == trials * rails
peak = pathlib.Path("/proc/self/status").read_text().split("VmHWM:")[1].split()[0]
print(int(peak) * 1024, seconds, (table.status == "converged").mean())
"""


class Batch(eqx.Module):
    """Bar trials of the paper's simulation, each clipped so that as many samples saturate as asked."""

    trials: Trial
    departure: np.ndarray
    arrival: np.ndarray
    rest_end: np.ndarray

    @property
    def sizes(self) -> Sizes:
        """Padded lengths of the one segment."""
        return padded_sizes(int(self.arrival[0] - self.departure[0]), 32, factor=2)

    def table(self, trial: Trial):
        """Λ of the arrival in one trial."""
        samples = Samples(trial.signal, trial.period, trial.variance)
        longest = int((self.rest_end - self.arrival).max())
        return arrivals(samples, trial.rows, jnp.asarray(self.arrival), jnp.asarray(self.rest_end), longest)


def with_rests(recording: Recording, truth: Truth) -> Recording:
    """The recording with its rests as they truly are."""
    return eqx.tree_at(lambda r: r.rest, recording, truth.rest, is_leaf=lambda x: x is None)


@cache
def bars(trials: int, samples: int = 512, saturated: int = 32) -> Batch:
    """B trials with noise of their own, leading axis B."""
    rate = samples / 1.6
    recording, truth = simulate(Bar(), rate=rate, duration=1.6, sensor=Sensor(), key=jax.random.key(0))
    prepared = prepare(with_rests(recording, truth), load_config())
    base = jax.tree.map(np.asarray, prepared.trial)
    rng = np.random.default_rng(0)
    signal = base.signal[None] + rng.normal(size=(trials, *base.signal.shape)) * np.sqrt(base.variance)[None]
    rate_y = np.abs(signal[:, :, 1])
    rail = np.sort(rate_y, axis=1)[:, -saturated]
    at = rate_y >= rail[:, None]
    signal[:, :, 1] = np.where(at, np.sign(signal[:, :, 1]) * rail[:, None], signal[:, :, 1])
    sign = np.zeros(signal.shape, int)
    sign[:, :, 1] = np.where(at, np.sign(signal[:, :, 1]), 0)
    segments = find_segments(prepared.rest)
    busy = [i for i in range(len(segments)) if at[0, segments.departure[i] + 1 : segments.arrival[i]].any()]
    assert len(busy) == 1, "the bar moves once"
    whole = jax.tree.map(lambda x: np.broadcast_to(x, (trials, *np.shape(x))), base)
    whole = eqx.tree_at(
        lambda t: (t.signal, t.sign, t.clean, t.bound),
        whole,
        (signal, sign, sign == 0, np.full((trials, 6), 5.0)),
    )
    return Batch(whole, segments.departure[busy], segments.arrival[busy], segments.rest_end[busy])


def direct(trial: Trial, batch: Batch, whole: bool, options: Options = OPTIONS, sure: bool = False):
    """δ of one trial from its arrays: filter to the departure, what the arrival tells, and the search.

    whole: with the filter over the entire trial, as a recording of many segments needs it; sure: take
    saturated values before the departure as measured.
    """
    table = batch.table(trial)
    stop = len(trial.period) if whole else int(batch.departure[0]) + 1
    first = jax.tree.map(lambda x: x[:stop] if np.ndim(x) and len(x) == len(trial.period) else x, trial)
    filtered = filter_trial(first, first.signal, jnp.where(sure, 0.0, first.unfilled_variance))
    state, covariance, _ = jax.tree.map(lambda x: x[batch.departure], filtered)
    ends = Ends(batch.departure, batch.arrival, state, covariance, table)
    return solve_segments(trial, trial.signal, ends, None, batch.sizes, options)


# On a CPU as a sweep does it: on each core a part, none so large that it leaves the cache.
PART = 1024 if jax.default_backend() == "gpu" else 128


def side_by_side(solve: Callable, arguments: Any, most: int = PART) -> Callable:
    """solve(arguments) by parts of at most so many of their leading axis, on all cores."""
    leaves, structure = jax.tree.flatten(arguments)
    parts = -(-len(leaves[0]) // most)
    split = zip(*(np.array_split(leaf, parts) for leaf in leaves), strict=True)
    given = [jax.device_put(jax.tree.map(jnp.asarray, structure.unflatten(part))) for part in split]
    if parts == 1:
        return lambda: [solve(given[0])]
    cores = Beside(usable_cores())
    return lambda: list(cores.map(lambda part: jax.block_until_ready(solve(part)), given))


def run_direct(batch: Batch, whole: bool) -> Callable:
    return side_by_side(compiled(jax.vmap(lambda trial: direct(trial, batch, whole))), batch.trials)


@cache
def strapdown_seconds(trials: int = 256, samples: int = 512, all_states: bool = True) -> float:
    signal, initial = bare_trials(trials, samples)
    return shortest(partial(numba_strapdown, signal, 0.005, initial, GRAVITY, all_states=all_states), 50)


def swept(trials: int, rails: int, memory: float) -> Callable:
    """A sweep of bars of 512 samples at rails from 4 to 10 rad/s by `direct`, but for the preparation of its trials.

    The function returns the scores of its chunks.
    """
    recording, truth = simulate(Bar(), rate=320.0, duration=1.6, sensor=Sensor(), key=jax.random.key(0))
    recording = with_rests(recording, truth)
    config = load_config(None, **{"saturation.gyr_bound": 5.0})
    grid = np.linspace(4.0, 10.0, rails).tolist()
    plan = sweep._plan(config, ("direct",), grid, [np.inf], None, None, memory)
    with computing():
        (batch,), _ = sweep._batches({"bar": lambda: recording}, plan)
    (case,), rng = batch.cases, np.random.default_rng(0)

    def noisy():
        signal = np.array(case.trial.signal)
        signal[: len(recording), :3] += 1e-3 * rng.normal(size=(len(recording), 3))
        return eqx.tree_at(lambda c: c.trial.signal, case, signal)

    batch = batch._replace(cases=[noisy() for _ in range(trials)])

    def run():
        with computing():
            given = (sweep._chunk_size(batch, plan), batch.sizes, (OPTIONS,), config, False)
            return [scores for _, scores in run_elements(batch.cases, plan.grid, *given)]

    return run


def walk(seconds: float, seed: int = 0, rail: float = 5.0):
    """A foot at 200 Hz with 35 segments in 32 s, each of them saturated."""
    motion = Walk(strides=round(35 * seconds / 32), swing=0.5, stance=0.36)
    recording, truth = simulate(
        motion, rate=200.0, duration=seconds, sensor=Sensor(gyr_rail=rail), key=jax.random.key(seed)
    )
    return recording, truth
