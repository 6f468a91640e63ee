"""The speed board: what things cost, as ratios measured side by side in one run.

    python scripts/bench.py [-o results/bench/cpu.json] [--only NAME ...] [--gate] [--small]

Compilation is apart, times are the shortest of several repeats. 256 trials × 512 samples, 32 saturated gyroscope
samples each, float64, unless a row says otherwise. `--gate` exits with 1 where a value is worse than the board
that is there by more than half. `--only` keeps the other rows of that board. `--small` is for a quick look: the
sweep with a tenth of its trials. Peers come with `pip install 'jaxsat[bench]'`. `solvers` needs the PyShoe recordings
in ../shared/data.
"""

import argparse
import os
import subprocess
import sys
import tempfile
import time
import tomllib
from collections.abc import Callable, Iterator
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from peers import shortest
from peers.paper_way import bar_problem, dense_objective, paper_way
from peers.smoothers import cuthbert_smoother, dynamax_smoother, linear_model, walking_trials
from problems import (
    OPTIONS,
    SWEEP,
    Batch,
    bars,
    direct,
    run_direct,
    side_by_side,
    strapdown_seconds,
    swept,
    walk,
    with_rests,
)

from jaxsat import Sensor, load_config, simulate
from jaxsat.inertial.programs import compiled, computing
from jaxsat.inertial.smoother import smooth_about
from jaxsat.pipeline import _covariance, _path, estimate
from jaxsat.preparation import find_ground, prepare
from jaxsat.saturation.compensate import filter_trial
from jaxsat.saturation.layout import Ends, gather
from jaxsat.saturation.segment import condense, value_gradient_root
from jaxsat.saturation.solvers import Status
from jaxsat.signals.readers import read
from jaxsat.studies.boards import Row, read_board, worse, write_board
from jaxsat.studies.motions import Bar
from jaxsat.studies.simulate import GRAVITY, write_simulation

GATE_TOLERANCE = 0.5


def objective_vs_strapdown() -> Iterator[Row]:
    batch = bars(256)

    def segment(trial):
        filtered = filter_trial(trial, trial.signal, trial.unfilled_variance)
        at = batch.departure[0]
        state, covariance, _ = jax.tree.map(lambda x: x[at], filtered)
        ends = Ends(at, batch.arrival[0], state, covariance, batch.table(trial)[0])
        return condense(gather(trial, ends, batch.sizes)[0])

    condensed = jax.jit(jax.vmap(segment))(jax.tree.map(jnp.asarray, batch.trials))
    delta = jnp.ones((256, batch.sizes.values))
    evaluate = compiled(
        jax.vmap(lambda each, g: value_gradient_root(each[0], each[1], g)[:2], in_axes=(0, None))
    )
    run = side_by_side(lambda each: evaluate(each, jnp.asarray(GRAVITY)), (delta, condensed))
    bare = strapdown_seconds()
    seconds = shortest(run, 50)
    bare = min(bare, strapdown_seconds())
    last = strapdown_seconds(all_states=False)
    yield Row(
        "objective_vs_strapdown", seconds / bare, "1", "lower", 3, 700,
        f"value and gradient of f(δ): {1e6 * seconds / 131072:.4f} µs per sample; bare pass with all its states "
        f"{1e6 * bare / 131072:.4f}, with the last one only {1e6 * last / 131072:.4f} (ratio {seconds / last:.2f})",
    )  # fmt: skip


def direct_vs_strapdown() -> Iterator[Row]:
    bare = strapdown_seconds()
    batch = bars(256)
    seconds = shortest(run_direct(batch, False))
    whole = shortest(run_direct(batch, True))
    found = [fill.solution for fill, _ in run_direct(batch, False)()]
    assert all((np.asarray(one.status) == 0).all() for one in found), "every search converges"
    steps = max(int(one.iterations.max()) for one in found)
    yield Row(
        "direct_vs_strapdown", seconds / bare, "1", "lower", 100, None,
        f"filter to the departure, arrival, search to tolerance 1e-2 ({steps} steps "
        f"at most): {1e3 * seconds:.0f} ms a batch; with the filter over the whole trial {1e3 * whole:.0f} ms "
        f"({whole / bare:.0f})",
    )  # fmt: skip


def estimate_vs_smoother() -> Iterator[Row]:
    recording, truth = walk(32.0)
    recording = with_rests(recording, truth)
    config = load_config(None, method="direct")
    found = estimate(recording, config)
    with computing():
        prepared = prepare(recording, config)
        ground = find_ground(prepared, config)
        smoother, free = (
            shortest(lambda trial=trial: _covariance(_path(trial, config), trial), 20)
            for trial in (prepared.trial.on_ground(ground), prepared.trial)
        )
    seconds = shortest(lambda: estimate(recording, config).cost, 20)
    plain = load_config(None, method="standard")
    standard = shortest(lambda: estimate(recording, plain).cost, 20)
    busy = int((found.fills.status != 2).sum())
    yield Row(
        "estimate_vs_smoother", seconds / smoother, "1", "lower", 3, None,
        f"{len(recording)} samples, {busy} segments that saturate: {seconds:.3f} s over {smoother:.3f} s "
        f"({free:.3f} s where it is told no ground); `estimate` with standard, which prepares and calibrates too, "
        f"{standard:.3f} s",
    )  # fmt: skip


def solvers() -> Iterator[Row]:
    """Both solvers on each segment of the recordings that really saturated, from the same departures."""
    folder = Path(__file__).resolve().parents[2] / "shared" / "data" / "pyshoe"
    if not folder.is_dir():
        print(f"solvers: left out, there are no recordings at {folder}")
        return
    settings = {"method": "direct", "saturation.sweeps": 1, "saturation.tolerance": 1e-6}
    unlike, notes, settled, segments = 0.0, [], 0, 0
    for name in tomllib.loads((folder / "splits.toml").read_text())["saturated"]:
        recording = read(folder / f"{name}.mat", rest_column="zv_shoe_opt")
        found, seconds = {}, {}
        for solver, most in (("gauss_newton", 1000), ("projected_gradient", 30_000)):
            chosen = {"saturation.solver": solver, "saturation.max_iterations": most}
            config = load_config(None, **settings, **chosen)
            found[solver] = estimate(recording, config).fills
            seconds[solver] = estimate(recording, config).seconds["compensation"]
        newton, gradient = found.values()
        heard = (newton.status != Status.NOTHING_TO_DO) & (newton.status != Status.NO_ARRIVAL)
        both = (newton.status == Status.CONVERGED) & (gradient.status == Status.CONVERGED)
        settled, segments = settled + int(both.sum()), segments + int(heard.sum())
        difference = (np.abs(newton.cost_after - gradient.cost_after) / (1.0 + newton.cost_after))[heard]
        unlike = max(unlike, float(difference.max(initial=0.0)))
        notes.append(
            f"{name} {newton.iterations.max()} and {gradient.iterations.max()} steps at most, "
            f"{seconds['gauss_newton']:.1f} and {seconds['projected_gradient']:.1f} s, {both.sum()} of {heard.sum()}"
        )
        print(notes[-1], f"{difference.max(initial=0.0):.1e}", flush=True)
    yield Row(
        "same_cost", unlike, "1", "lower", 1e-6, None,
        f"largest difference of J* / (1 + J*), method 1, tolerance 1e-6, of {segments} segments, in {settled} of "
        "which both solvers settle; Gauss-Newton and projected gradient by trial: " + "; ".join(notes),
    )  # fmt: skip


def paper_way_speedup() -> Iterator[Row]:
    problem = bar_problem(0)
    theirs = paper_way(problem)
    recording, truth = simulate(
        Bar(), rate=100.0, duration=1.6, sensor=Sensor(gyr_rail=7.5), key=jax.random.key(0)
    )
    recording = with_rests(recording, truth)
    config = load_config(
        None, **{"saturation.gyr_bound": 5.0, "rails.gyr": 7.5, "smoother.gyr_offset": "none"}
    )
    prepared = prepare(recording, config)
    segments = prepared.segments
    batch = Batch(prepared.trial, segments.departure, segments.arrival, segments.rest_end)
    tight = eqx.tree_at(lambda o: o.tolerance, OPTIONS, jnp.asarray(1e-5))
    solve = partial(direct, batch=batch, whole=False, options=tight, sure=True)
    run, trial = compiled(solve), jax.tree.map(jnp.asarray, prepared.trial)
    found, values = run(trial)
    real = np.asarray(values.sample[0]) < len(recording)
    delta = np.asarray(found.delta[0])[real]
    cost = dense_objective(problem)(delta)
    seconds = shortest(lambda: run(trial), 30)
    yield Row(
        "paper_way_speedup", theirs.seconds / seconds, "1", "higher", 1000, 1,
        f"{len(delta)} δ, N = 160: {theirs.seconds:.1f} s and J* = {theirs.cost:.6f} by SLSQP on the dense problem "
        f"({theirs.evaluations} evaluations), {1e3 * seconds:.2f} ms and J* = {cost:.6f} here",
    )  # fmt: skip


def smoother_vs_peers() -> Iterator[Row]:
    trials = walking_trials(64, 1000)
    model = linear_model(trials)
    gravity = jnp.asarray(GRAVITY)

    # Trials are arguments, as they are to the others: of constants XLA could work out a part beforehand.
    @compiled
    def ours(given):
        return jax.vmap(
            lambda reference, samples, rows, prior: smooth_about(
                reference, samples, rows, prior, trials.prior_covariance, gravity
            )
        )(*given)

    def in_parts(solve, given):
        return min(shortest(side_by_side(solve, given, part), 10) for part in (64, 32, 16, 8, 4, 2, 1))

    seconds = in_parts(ours, (trials.reference, trials.samples, trials.rows, trials.prior))
    dynamax = dynamax_smoother(model)
    others = {
        "dynamax": in_parts(lambda given: dynamax.func(*given), dynamax.args),
        # Two of its calls at once wait for each other for ever; each half alone would win less than a factor of 2.
        "cuthbert": min(
            shortest(cuthbert_smoother(model, variant), 2) for variant in ("moments", "sequential")
        ),
    }
    best = min(others, key=others.__getitem__)
    yield Row(
        "smoother_vs_peers", others[best] / seconds, "1", "higher", 3, None,
        f"64 × 1,000 samples, in the best of 1 to 64 parts on all cores: {seconds:.3f} s; "
        + ", ".join(f"{k} {v:.3f} s" for k, v in others.items())
        + " (cuthbert in one)",
    )  # fmt: skip


def batch_amortisation() -> Iterator[Row]:
    one, many = (shortest(run_direct(bars(size), False), 10) for size in (1, 1024))
    yield Row(
        "batch_amortisation", many / 1024 / one, "1", "lower", 0.05, None,
        f"direct estimate of a trial: {1e3 * one:.2f} ms alone, {1e3 * many / 1024:.3f} ms among 1,024",
    )  # fmt: skip


def growth() -> Iterator[Row]:
    def seconds(length):
        recording, truth = walk(length)
        recording = with_rests(recording, truth)
        return shortest(lambda: estimate(recording, load_config(None, method="direct")).cost, 3)

    # Lengths that fill their padded shapes equally well.
    short, long = seconds(15.36), seconds(8 * 15.36)
    yield Row(
        "growth_time", long / short, "1", "lower", 9, None,
        f"`estimate` with direct: {short:.2f} s for 3,072 samples, {long:.2f} s for 24,576",
    )  # fmt: skip
    few, many = (shortest(run_direct(bars(size), False), 10) for size in (128, 1024))
    yield Row(
        "growth_batch", many / few, "1", "lower", 8.5, None,
        f"direct estimate: {1e3 * few:.0f} ms for 128 trials, {1e3 * many:.0f} ms for 1,024",
    )  # fmt: skip


def sweep_peak(small: bool = False) -> Iterator[Row]:
    trials = 100 if small else 1000
    command = [sys.executable, "-c", SWEEP, str(trials), "16"]
    peak, seconds, settled = map(
        float, subprocess.run(command, check=True, capture_output=True, text=True).stdout.split()
    )
    yield Row(
        "sweep_peak_bytes", peak, "B", "lower", 2e9, None,
        f"{trials} trials × 16 rails × 512 samples, direct: the whole process, {seconds:.0f} s with compilation, "
        f"{100 * settled:.1f} % of the elements converged",
    )  # fmt: skip


def compilations() -> Iterator[Row]:
    from jaxsat.studies import sweep as module

    recording, truth = simulate(Bar(), rate=100.0, duration=1.6, sensor=Sensor(), key=jax.random.key(0))
    recording = with_rests(recording, truth)
    config, counts = load_config(None, **{"saturation.gyr_bound": 5.0}), []
    for rails in ([4.0], np.linspace(4.0, 10.0, 32).tolist()):
        jax.clear_caches()
        seen: list[str] = []

        def count(event, *_, seen=seen, **values):
            if event == "/jax/core/compile/backend_compile_duration" and "_scores" in str(values):
                seen.append(event)

        jax.monitoring.register_event_duration_secs_listener(count)
        module.sweep([recording], config, methods=("direct",), gyr_rails=rails)
        jax.monitoring.clear_event_listeners()
        counts.append(len(seen))
    yield Row(
        "compilations_per_bucket", counts[1], "1", "lower", 1, None,
        f"a sweep of 32 rails; a sweep of one rail: {counts[0]}",
    )  # fmt: skip


def cold_start() -> Iterator[Row]:
    recording, truth = walk(32.0)
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "walk.csv"
        write_simulation(path, recording, truth, rest=True)
        environment = {k: v for k, v in os.environ.items() if k != "JAX_COMPILATION_CACHE_DIR"}
        environment["XDG_CACHE_HOME"] = str(Path(folder) / "cache")
        seconds = []
        for run in range(3):
            command = [str(Path(sys.executable).parent / "jaxsat"), "estimate", str(path)]
            start = time.perf_counter()
            subprocess.run([*command, "-o", f"{folder}/{run}", "--quiet"], check=True, env=environment)
            seconds.append(time.perf_counter() - start)
    what = f"`jaxsat estimate` of a 32 s trial ({len(recording)} samples)"
    yield Row("cold_first_s", seconds[0], "s", "lower", 40, None, what + ", first run ever")
    yield Row("cold_later_s", min(seconds[1:]), "s", "lower", 8, None, what + ", later runs")


_SWEPT = """
import os, sys
os.sched_setaffinity(0, [int(core) for core in sys.argv[2:]])
from peers import shortest
from problems import swept
print(shortest(swept(int(sys.argv[1]), 16, 8e9), 2))
"""


def gpu() -> Iterator[Row]:
    if jax.default_backend() != "gpu":
        return
    trials, stats = 10_000, jax.devices()[0].memory_stats()
    accelerated = shortest(swept(trials, 16, 0.9 * stats["bytes_limit"]), 2)

    def on_cores(cores: list[int]) -> float:
        """Seconds of a sweep as large on some of the cores of this machine, extrapolated from a smaller one."""
        fewer = 16 * len(cores)
        devices = f"--xla_force_host_platform_device_count={len(cores)}"
        command = [sys.executable, "-c", _SWEPT, str(fewer), *map(str, cores)]
        found = subprocess.run(
            command, check=True, capture_output=True, text=True, cwd=Path(__file__).parent,
            env={**os.environ, "JAX_PLATFORMS": "cpu", "XLA_FLAGS": devices},
        )  # fmt: skip
        return float(found.stdout) * trials / fewer

    cores = sorted(os.sched_getaffinity(0))
    every, two = on_cores(cores), on_cores(cores[:2])
    yield Row(
        "gpu_vs_cpu", two / accelerated, "1", "higher", 50, None,
        f"sweep of {trials:,} segments × 16 rails, direct, prepared: {accelerated:.2f} s; two cores of its machine "
        f"{two:.0f} s, all {len(cores)} of them {every:.0f} s (ratio {every / accelerated:.0f}), both extrapolated "
        "from 16 trials a core",
    )  # fmt: skip


PARTS: dict[str, Callable[..., Iterator[Row]]] = {
    "objective": objective_vs_strapdown,
    "direct": direct_vs_strapdown,
    "estimate": estimate_vs_smoother,
    "solvers": solvers,
    "paper": paper_way_speedup,
    "smoother": smoother_vs_peers,
    "amortisation": batch_amortisation,
    "growth": growth,
    "sweep": sweep_peak,
    "compilations": compilations,
    "cold": cold_start,
    "gpu": gpu,
}


def main() -> int:
    parser = argparse.ArgumentParser(description="The speed board")
    parser.add_argument("-o", "--output", type=Path, default=None)
    parser.add_argument("--only", nargs="+", choices=PARTS, default=list(PARTS))
    parser.add_argument("--gate", action="store_true", help="exit with 1 where something got worse")
    parser.add_argument("--small", action="store_true", help="a sweep of a tenth of the trials")
    arguments = parser.parse_args()
    output = arguments.output or Path(f"results/bench/{jax.default_backend()}.json")
    former = read_board(output) if output.exists() else []
    rows = {row.metric: row for row in former}
    settings = {"tolerance": 1e-2, "dtype": "float64"}
    output.parent.mkdir(parents=True, exist_ok=True)
    for name in arguments.only:
        part = PARTS[name]
        for row in part(arguments.small) if name == "sweep" else part():
            print(f"{row.metric}: {row.value:.4g} (goal {row.goal:g}); {row.note}", flush=True)
            rows[row.metric] = row
            if not arguments.gate:
                # A run that is cut off keeps what it measured.
                write_board(output, rows.values(), settings)
    found = worse(rows.values(), former, GATE_TOLERANCE) if arguments.gate else []
    for sentence in found:
        print(sentence, file=sys.stderr)
    if not found:
        write_board(output, rows.values(), settings)
    return 1 if found else 0


if __name__ == "__main__":
    sys.exit(main())
