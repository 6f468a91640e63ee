"""Beyond the paper: the search of one segment seen from inside, coverage of the intervals, and Eq. 21 as printed."""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Float, Int
from scipy.stats import norm

from jaxsat.config import Config
from jaxsat.inertial.programs import compiled
from jaxsat.inertial.smoother import smooth
from jaxsat.inertial.strapdown import Samples
from jaxsat.pipeline import estimate, search_options
from jaxsat.preparation import Prepared, prepare
from jaxsat.saturation.arrival import arrival_table
from jaxsat.saturation.compensate import filter_trial, signal_prior
from jaxsat.saturation.gap_shapes import Edges, edge_slope, peak, shape_value
from jaxsat.saturation.layout import Ends, Sizes, Trial, gather
from jaxsat.saturation.prior import Scales
from jaxsat.saturation.segment import Condensed, Segment, condense, value_gradient_root
from jaxsat.saturation.solvers import Box, projected_gauss_newton, projected_gradient
from jaxsat.signals.recording import Recording
from jaxsat.studies.simulate import Truth

from . import drawing_extras as drawing
from .trials import QUANTILES, Settings, clipped, config_of, record

SIZES = Sizes(256, 64)
SHARES = (0.5, 0.9)
Trials = Callable[[Settings, int], tuple[Recording, Truth, Config]]
SOLVERS = {"gauss_newton": projected_gauss_newton, "projected_gradient": projected_gradient}


def coverage(chosen: Settings, out: Path, trial: Trials = clipped) -> None:
    """How often intervals hold the truth: filled values, peaks, and the three coordinates of the end.

    trial: makes the recording of a seed. From `estimate`, recording by recording: a sweep gives no covariances.
    """
    rows, ends = [], {method: [] for method in chosen["methods"]}
    for method in chosen["methods"]:
        for seed in range(chosen["seeds"]):
            recording, truth, config = trial(chosen, seed)
            found = estimate(recording, config.model_copy(update={"method": method}))
            lost = found.saturated
            # The signal without noise is what is asked for; the sd of a filled value holds the noise too.
            away = (found.filled - truth.signal)[lost] / found.signal_sd[lost]
            sd = np.sqrt(np.diagonal(found.trajectory.covariance[-1])[3:6])
            error = (found.trajectory.position - truth.position)[-1]
            ends[method] += (np.abs(error) / sd).tolist()
            # All that saturates is one gap.
            top = np.argmax(np.abs(found.filled[lost]))
            peak = np.abs(found.filled[lost])[top] - np.abs(truth.signal[lost]).max()
            scores = {"fill": away, "peak": peak / found.signal_sd[lost][top], "end": error / sd}
            rows.append(
                {
                    "method": method,
                    "seed": seed,
                    **{
                        f"{what}_{share * 100:.0f}": float(np.mean(np.abs(z) <= norm.ppf(0.5 + share / 2)))
                        for what, z in scores.items()
                        for share in SHARES
                    },
                    "error": float(np.linalg.norm(error)),
                    "sd": float(np.linalg.norm(sd)),
                }
            )
    table = pd.DataFrame(rows)
    groups = table.groupby("method", sort=False)
    held = groups.agg(
        seeds=("seed", "size"),
        **{column: (column, "mean") for column in table if column.startswith(("fill_", "peak_", "end_"))},
        error_median=("error", "median"),
        sd_median=("sd", "median"),
    )
    held.reset_index().to_csv(out / "table.csv", index=False, float_format="%.4g")
    drawing.coverage(out / "intervals", ends)


class Problem(eqx.Module):
    """The search of the one segment of a recording, as `jaxsat.saturation.methods` poses it, from any start."""

    segment: Segment
    condensed: Condensed
    gravity: Float[Array, "*many"]
    tolerance: Float[Array, "*many"]
    max_iterations: Int[Array, "*many"]

    def linearise(self, delta: Float[Array, "m"]):
        """f(δ), with the energy of the signal prior for `map`."""
        value, gradient, columns = value_gradient_root(delta, self.condensed, self.gravity)
        if self.segment.known is not None:
            pull = self.segment.known.precision @ delta
            value = value + delta @ (self.segment.known.slope + 0.5 * pull)
            gradient = gradient + self.segment.known.slope + pull
        return value, gradient, columns

    def box(self, start: Float[Array, "m"]) -> Box:
        bound, known = self.segment.bound, self.segment.known
        curvature = sum((column**2 for column in self.linearise(start)[2]), jnp.zeros_like(start))
        if known is not None:
            curvature = curvature + jnp.diagonal(known.precision)
        real = bound > 0.0
        return Box(
            start=start,
            lower=jnp.zeros_like(bound),
            upper=bound,
            scale=jnp.where(real, 1.0 / jnp.sqrt(curvature + 1.0 / jnp.where(real, bound, 1.0) ** 2), 1.0),
            tolerance=self.tolerance,
            max_iterations=self.max_iterations,
            precision=None if known is None else known.precision,
        )


def problem_of(recording: Recording, config: Config, method: str) -> tuple[Prepared, Problem]:
    prepared = prepare(recording, config)
    segments = prepared.segments
    table = arrival_table(prepared.trial, segments)[0]
    options = search_options(config, method)
    scales = options.scales if method == "map" else None
    segment, condensed = _gathered(
        prepared.trial, segments.departure[:1], segments.arrival[:1], table, scales
    )
    gravity = jnp.asarray(prepared.trial.gravity)
    return prepared, Problem(segment, condensed, gravity, options.tolerance, options.max_iterations)


@compiled
def _gathered(trial: Trial, departure, arrival, table, scales: Scales | None) -> tuple[Segment, Condensed]:
    trial, departure, arrival = jax.tree.map(jnp.asarray, trial), departure[0], arrival[0]
    filtered = filter_trial(trial, trial.signal, trial.unfilled_variance)
    state, covariance, _ = jax.tree.map(lambda x: x[departure], filtered)
    known = None if scales is None else signal_prior(trial, scales)
    segment, _ = gather(trial, Ends(departure, arrival, state, covariance, table), SIZES, known)
    return segment, condense(segment)


@compiled
def _ends(trial: Trial, signals: Float[Array, "B N 6"], variance, last) -> Float[Array, "B 3"]:
    """Where the smoother ends with each filled signal."""

    def one(signal):
        samples = Samples(signal, trial.period, trial.variance + variance)
        problem = (trial.rows, trial.prior, trial.prior_covariance, trial.gravity, jnp.asarray(1))
        return smooth(samples, *problem).state.position[last]

    return jax.vmap(one)(signals)


def last_errors(prepared: Prepared, truth: Truth, delta: Float[np.ndarray, "B m"]) -> Float[np.ndarray, "B"]:
    """Last-position errors (m) with each δ; filled values carry δ_b²/12, as methods 1 and 2 have it."""
    trial = jax.tree.map(jnp.asarray, prepared.trial)
    sample, channel = np.nonzero(prepared.sign)
    signals = np.repeat(np.asarray(trial.signal)[None], len(delta), axis=0)
    signals[:, sample, channel] += prepared.sign[sample, channel] * delta[:, : len(sample)]
    variance = np.where(np.asarray(trial.sign) != 0, np.asarray(trial.bound) ** 2 / 12.0, 0.0)
    ends = _ends(trial, jnp.asarray(signals), jnp.asarray(variance), len(truth.time) - 1)
    return np.linalg.norm(np.asarray(ends) - truth.position[-1], axis=1)


def iterations(chosen: Settings, out: Path) -> None:
    """J along the evaluations of both solvers, from δ = 0, for method 1 and `map`."""
    rows = []
    recording, _, config = clipped(chosen, 0)
    for method in chosen["methods"]:
        for name in chosen["solvers"]:
            _, problem = problem_of(recording, config, method)
            seen: list[float] = []

            def search(problem, solve=SOLVERS[name], seen=seen):
                def told(delta):
                    found = problem.linearise(delta)
                    jax.debug.callback(lambda value: seen.append(float(value)), found[0])
                    return found

                return solve(told, problem.box(jnp.zeros_like(problem.segment.bound)))

            jax.block_until_ready(compiled(search)(problem))
            jax.effects_barrier()
            rows += [
                {"method": method, "solver": name, "evaluation": k, "cost": cost}
                for k, cost in enumerate(seen)
            ]
    table = pd.DataFrame(rows)
    table["best"] = table.groupby(["method", "solver"])["cost"].cummin()
    # A long tail that lowers nothing tells nothing.
    table = table.loc[
        (table["best"] != table.groupby(["method", "solver"])["best"].shift()) | (table["evaluation"] == 0)
    ]
    table.to_csv(out / "table.csv", index=False, float_format="%.9g")
    drawing.descents(out / "descent", table)


@compiled
def _search(problems: Problem, first: Float[Array, "S B m"]):
    """Every problem from every start."""

    def one(problem, start):
        return projected_gauss_newton(problem.linearise, problem.box(start))

    return jax.vmap(lambda problem, starts: jax.vmap(partial(one, problem))(starts))(problems, first)


def starts(chosen: Settings, out: Path) -> None:
    """Where a search ends from different first values of δ: at zero, even, at the bound, and at random."""
    rows = []
    trials = [clipped(chosen, seed) for seed in range(chosen["seeds"])]
    for method in chosen["methods"]:
        posed = [problem_of(recording, config, method) for recording, _, config in trials]
        problems = jax.tree.map(lambda *x: jnp.stack(x), *(problem for _, problem in posed))
        bound = np.asarray(problems.segment.bound)
        even = np.array(chosen["shares"])[:, None] * np.ones(SIZES.values)
        random = np.random.default_rng(chosen["seed"]).uniform(
            size=(len(trials), chosen["random"], SIZES.values)
        )
        shares = np.concatenate([np.repeat(even[None], len(trials), axis=0), random], axis=1)
        found = jax.tree.map(np.asarray, _search(problems, jnp.asarray(shares * bound[:, None])))
        names = [f"{share:g} δ_b" for share in chosen["shares"]] + ["random"] * chosen["random"]
        for seed, ((prepared, _), (_, truth, _)) in enumerate(zip(posed, trials, strict=True)):
            errors = last_errors(prepared, truth, found.x[seed])
            real = found.x[seed][:, bound[seed] > 0]
            rows += [
                {
                    "method": method,
                    "seed": seed,
                    "start": name,
                    "cost": found.value[seed, i],
                    "iterations": found.iterations[seed, i],
                    "status": found.status[seed, i],
                    "last": errors[i],
                    "away": np.sqrt(np.mean((real[i] - real[0]) ** 2)),
                }
                for i, name in enumerate(names)
            ]
    table = pd.DataFrame(rows)
    table.to_csv(out / "table.csv", index=False, float_format="%.6g")
    drawing.starts(out / "errors", table)


def printed_peak(edges: Edges) -> tuple[Float[Array, "*gaps"], Float[Array, "*gaps"]]:
    """Eq. 21 with its printed denominator, a sum of slopes; time is counted from k, in the formula's favour."""
    rise = edges.right - edges.left - (edges.h - edges.k) * edges.right_slope
    after = rise / (edges.left_slope + edges.right_slope)
    return edges.k + after, edges.left + after * edges.left_slope


def gap_edges(signals: Float[np.ndarray, "P N"], rails: Float[np.ndarray, "P"]) -> Edges:
    """Of the one gap of each signal, which exceeds its rail once."""
    lost = signals >= rails[:, None]
    k, h = lost.argmax(axis=1) - 1, signals.shape[1] - lost[:, ::-1].argmax(axis=1)
    row, offset = np.arange(len(rails))[:, None], np.arange(3)[None]
    left, right = signals[row, k[:, None] - offset].T, signals[row, h[:, None] + offset].T
    slopes = -edge_slope(*map(jnp.asarray, left)), edge_slope(*map(jnp.asarray, right))
    begin, end, first, last = (jnp.asarray(x, float) for x in (k, h, left[0], right[0]))
    sound = jnp.ones(len(rails), bool)
    return Edges(begin, end, first, last, *slopes, jnp.asarray(rails), sound)


def eq21(chosen: Settings, out: Path) -> None:
    """The peak by Eq. 21 as printed and corrected, and what a triangle with that peak misses."""
    low, high, count = chosen["sweep"]
    pairs = [
        (rail, seed) for rail in np.linspace(low, high, count).tolist() for seed in range(chosen["seeds"])
    ]
    recordings = [record(chosen, seed) for seed in range(chosen["seeds"])]
    signals = np.stack([recordings[seed][0].gyr[:, 1] for _, seed in pairs])
    edges = gap_edges(signals, np.array([rail for rail, _ in pairs]))
    top = edges.rail + config_of(chosen).saturation.gyr_bound
    right, printed = peak(edges, top), printed_peak(edges)
    true = np.argmax(recordings[0][1].signal[:, 1])
    t = np.broadcast_to(np.arange(signals.shape[1], dtype=float), signals.shape)
    wide = jax.tree.map(lambda x: jnp.broadcast_to(x[:, None], signals.shape), edges)
    gap = np.asarray((t > wide.k) & (t < wide.h))
    rows = []
    for name, time, height in (("corrected", right.time, right.height), ("printed", *printed)):
        usable = (time > edges.k) & (time < edges.h) & (height > edges.rail)
        # What a search that trusts the formula can draw: a peak inside the gap and within the bound.
        at, tall = jnp.clip(time, edges.k + 0.5, edges.h - 0.5), jnp.clip(height, edges.rail, top)
        at, tall = (jnp.broadcast_to(x[:, None], signals.shape) for x in (at, tall))
        missed = np.where(
            gap, np.asarray(shape_value("triangle", jnp.asarray(t), wide, at, tall)) - signals, 0.0
        )
        part = pd.DataFrame(pairs, columns=pd.Index(["rail", "seed"])).assign(
            formula=name,
            usable=np.asarray(usable),
            time=np.asarray(time) - true,
            off=np.abs(np.asarray(time) - true),
            gap=gap.sum(axis=1),
            height=np.asarray(height),
            fill_rmse=np.sqrt((missed**2).sum(axis=1) / gap.sum(axis=1)),
            impulse=missed.sum(axis=1) / chosen["rate"],
        )
        rows.append(part)
    groups = pd.concat(rows).groupby(["rail", "formula"], sort=False)
    columns = {
        f"{column}_{label}": groups[column].quantile(q)
        for column in ("time", "off", "gap", "height", "fill_rmse", "impulse")
        for label, q in zip(("low", "median", "high"), QUANTILES, strict=True)
    }
    table = pd.DataFrame({"usable": groups["usable"].mean(), **columns}).reset_index()
    table.to_csv(out / "table.csv", index=False, float_format="%.5g")
    drawing.peaks(out / "peaks", table)
