"""The pipeline: a recording and a configuration in, a trajectory out."""

import time
from collections.abc import Callable
from functools import partial
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.claims import (
    Doubt,
    calibration_in_doubt,
    common_errors,
    doubt,
    outer,
    with_rests_in_doubt,
)
from jaxsat.config import Config
from jaxsat.inertial.calibration import Calibration
from jaxsat.inertial.programs import Beside, computing, stored_jit
from jaxsat.inertial.smoother import (
    ActiveSet,
    Rows,
    displacement_covariance,
    smooth,
    smooth_about,
    smooth_nonnegative,
)
from jaxsat.inertial.strapdown import NavState, Samples
from jaxsat.preparation import constants_sd, find_ground, prepare
from jaxsat.saturation.compensate import (
    Fills,
    compensate_parallel,
    compensate_sequential,
    learn_prior,
    trace_search,
)
from jaxsat.saturation.layout import Trial, bucket, pad
from jaxsat.saturation.methods import Compensation, Options
from jaxsat.saturation.prior import Scales
from jaxsat.signals.rails import Gaps, Rails
from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import Segments


class Trajectory(eqx.Module):
    """States at the start of each sample, with their covariance."""

    time: Float[np.ndarray, "N"]
    q_nb: Float[np.ndarray, "N 4"]
    position: Float[np.ndarray, "N 3"]
    velocity: Float[np.ndarray, "N 3"]
    covariance: Float[np.ndarray, "N 9 9"]
    """Of [attitude error θ (rad, navigation frame), position, velocity]."""


class Estimate(eqx.Module):
    """All that `estimate` found."""

    recording: Recording
    config: Config = eqx.field(static=True)
    trajectory: Trajectory
    problem: Trial
    """The recording as filled, padded, with the variances and rows that the trajectory's covariance follows from."""
    rails: Rails
    rest: Bool[np.ndarray, "N"]
    segments: Segments
    gaps: Gaps
    sign: Int[np.ndarray, "N 6"]
    """Direction of saturation of each value, 0 where there is none."""
    filled: Float[np.ndarray, "N 6"]
    """The recording's six channels with saturated values replaced (rad/s, m/s²)."""
    signal_sd: Float[np.ndarray, "N 6"]
    """sd of each value of `filled`: sensor noise, and where it was filled `Fills.sd`."""
    fills: Fills
    calibration: Calibration
    """Biases beside `gyr_offset`, and the lever, that the trajectory goes with."""
    standard_position: Float[np.ndarray, "N 3"]
    """Where the standard smoother, which ignores saturation, puts the sensor (m)."""
    cost: Float[np.ndarray, ""]
    """J* of the whole recording as reported."""
    cost_standard: Float[np.ndarray, ""]
    """J* of the whole recording with saturation ignored."""
    gravity: float
    level: bool
    """The ground was found to be level: rests are at one height."""
    gyr_offset: Float[np.ndarray, "3"]
    doubt: Doubt
    """What is uncertain all through the recording; the trajectory's covariance counts it."""
    floor: ActiveSet | None
    """Active set of `height.mode = "nonnegative"`."""
    warnings: list[str] = eqx.field(static=True)
    seconds: dict[str, float] = eqx.field(static=True)

    @property
    def saturated(self) -> Bool[np.ndarray, "N 6"]:
        return self.sign != 0


Progress = Callable[[str, int, int], None]
"""Called with (stage, steps done, steps in all)."""


def estimate(
    recording: Recording, config: Config | None = None, *, progress: Progress | None = None
) -> Estimate:
    """Reconstruct the trajectory of a recording, saturated or not.

    Computed in float64 whatever JAX's setting. Raises `InputError` where the recording cannot give a
    trajectory: no gyroscope, no rest at all, units that cannot be.
    """
    config = config or Config()
    with computing():
        return _estimate(recording, config, progress or (lambda *_: None))


def search_options(config: Config, method: str) -> Options:
    """How a compensating method searches."""
    chosen = config.saturation
    return Options(
        cast(Compensation, method),
        chosen.solver,
        chosen.free_peak_time,
        jnp.asarray(chosen.max_iterations),
        jnp.asarray(chosen.tolerance),
        constants_sd(config),
        prior_scales(config),
    )


def prior_scales(config: Config) -> Scales:
    chosen = config.saturation
    return Scales(jnp.asarray(chosen.prior_width, float), jnp.asarray(chosen.prior_share, float))


def _estimate(recording: Recording, config: Config, progress: Progress) -> Estimate:
    clock = _Clock()
    prepared = prepare(recording, config)
    trial, segments, gaps = prepared.trial, prepared.segments, prepared.gaps
    clock.lap("signals")
    together = config.saturation.segments == "parallel"
    options = None
    if config.method != "standard" and len(gaps):
        options = search_options(config, config.method)
    fills, calibration = None, prepared.calibration
    # What the search does not wait for goes on beside it.
    with Beside(2) as beside:
        programs = trace_search(trial, segments, options, together=together) if options else []
        compiling = [beside.submit(program) for program in programs]
        learning = beside.submit(learn_prior, trial, options) if options else None
        grounding = beside.submit(find_ground, prepared, config)
        if options is not None and learning is not None:

            def learned(prior=learning):
                for program in compiling:
                    program.result()
                return prior.result()

            report = partial(progress, "segments")
            given = trial, segments, options, calibration, learned
            if together:
                passes = config.saturation.passes(config.method)
                fills, calibration = compensate_parallel(*given, passes, report)
            else:
                fills, calibration = compensate_sequential(*given, report)
            clock.lap("compensation")
        ground = grounding.result()
    taken = fills or Fills.nothing(trial, len(segments))
    # One thread beside this one: what is waited for first comes first.
    with Beside(1) as beside:
        path = sure = ignoring = trial.calibrated(prepared.calibration)
        if fills is not None:
            filled = eqx.tree_at(lambda t: t.signal, trial, fills.signal).calibrated(calibration)
            path, sure = (
                eqx.tree_at(lambda t: t.variance, filled, trial.variance + extra)
                for extra in (fills.slack, fills.variance)
            )
        path, ignoring = path.on_ground(ground), ignoring.on_ground(ground)
        doubting = beside.submit(
            calibration_in_doubt, trial, config, calibration, taken.signal, taken.variance
        )
        standing = None if fills is None else beside.submit(_path, ignoring, config)
        found = _path(path, config)
        calibration = doubting.result()
        # How sure the path is, is another question.
        sure = with_rests_in_doubt(sure, config)
        grounded = sure.on_ground(ground)
        told = grounded.rows.height is not None and found.floor is None
        common = doubt(config, prepared.gyr_offset_sd, calibration, told)
        n = len(recording)
        q_nb, position, velocity = (
            np.asarray(x)[:n] for x in (found.state.q_nb, found.state.position, found.state.velocity)
        )
        rates = np.asarray(sure.signal)[:n, :3]
        rested = prepared.rest, recording.period
        errors = beside.submit(lambda: outer(common_errors(q_nb, position, velocity, rates, *rested, common)))
        known = np.asarray(_covariance(found, grounded))[:n]
        covariance = errors.result()
        covariance += known
        standard = found if standing is None else standing.result()
    clock.lap("smoother")

    def sampled(f):
        named = f.signal, f.variance, f.slack, f.sd, f.gap_sd, f.identified, f.at_bound, f.inflated
        return *named, *jax.tree.leaves(f.heard)

    fills = eqx.tree_at(sampled, taken, [x[:n] for x in sampled(taken)])
    floor = found.floor
    if floor is not None:
        floor = eqx.tree_at(lambda f: f.active, floor, floor.active[:n])
    offsets = np.concatenate([prepared.gyr_offset, np.zeros(3)])
    filled = np.where(prepared.sign != 0, fills.signal + offsets, recording.signal)
    variance = trial.variance[:n] + fills.sd**2
    return Estimate(
        recording=recording,
        config=config,
        trajectory=Trajectory(
            time=recording.time,
            q_nb=q_nb,
            position=position,
            velocity=velocity,
            covariance=covariance,
        ),
        problem=sure,
        rails=prepared.rails,
        rest=prepared.rest,
        segments=segments,
        gaps=gaps,
        sign=prepared.sign,
        filled=filled,
        signal_sd=np.sqrt(variance),
        fills=fills,
        calibration=jax.tree.map(np.asarray, calibration),
        standard_position=np.asarray(standard.state.position)[:n],
        cost=np.asarray(found.cost),
        cost_standard=np.asarray(standard.cost),
        gravity=float(trial.gravity),
        level=config.height.mode == "auto" and ground is not None,
        gyr_offset=prepared.gyr_offset,
        doubt=common,
        floor=floor,
        warnings=prepared.warnings,
        seconds=clock.seconds,
    )


def displacements(found: Estimate) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3 3"]]:
    """The way from departure to arrival of each segment (m), and its covariance (m²).

    NaN where no rest precedes or follows, the covariance also with `height.mode = "zero"`, which ties ways together;
    it does not count what is known of the ground otherwise.
    """
    segments, n = found.segments, len(found.recording)
    whole = (segments.departure >= 0) & (segments.arrival < n)
    way, covariance = np.full((len(segments), 3), np.nan), np.full((len(segments), 3, 3), np.nan)
    ends = np.stack([segments.departure, segments.arrival])[:, whole]
    position = found.trajectory.position
    way[whole] = position[ends[1]] - position[ends[0]]
    if whole.any() and found.problem.rows.height is None:
        problem, size, known = found.problem, len(found.problem.period), found.trajectory
        rates = np.asarray(problem.signal)[:n, :3]
        given = known.q_nb, position, known.velocity, rates, found.rest, found.recording.period
        # What is the same error everywhere is no part of what a motion's own rests tell of it.
        own = known.covariance - outer(common_errors(*given, found.doubt))
        # An offset turns a way and leaves it as long; a lever makes it longer, and climb where heights are not told.
        errors = common_errors(*given, found.doubt._replace(height=np.zeros(())))
        lever = (errors[ends[1]] - errors[ends[0]])[:, 3:6, 3:6]
        # Padding repeats the last motion.
        count = int(whole.sum())
        departure, arrival = np.pad(ends, ((0, 0), (0, bucket(count, 16) - count)), mode="edge")
        states = (pad(x, size) for x in (known.q_nb, known.velocity, position, own))
        with computing():
            ways = _ways(problem, tuple(states), departure, arrival)
        covariance[whole] = np.asarray(ways)[:count] + outer(lever)
    return way, covariance


@stored_jit
def _ways(problem: Trial, states, departure, arrival):
    samples = Samples(problem.signal, problem.period, problem.variance)
    *state, covariance = states
    start = NavState(*state)
    return displacement_covariance(
        start, covariance, samples, problem.rows, problem.prior_covariance, departure, arrival
    )


class _Clock:
    """Seconds spent in each stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        now = time.perf_counter()
        self.seconds[stage] = round(self.seconds.get(stage, 0.0) + now - self._last, 3)
        self._last = now


class Path(NamedTuple):
    """What the smoother says of a whole trial, but for how sure it is."""

    state: NavState
    """N+1 of them."""
    cost: Float[Array, ""]
    """J*."""
    floor: ActiveSet | None
    """Of `height.mode = "nonnegative"`."""


def _path(trial: Trial, config: Config) -> Path:
    found = _whole_trial(
        trial.signal,
        trial.period,
        trial.variance,
        trial.rows,
        trial.prior,
        trial.prior_covariance,
        trial.gravity,
        np.asarray(config.smoother.relinearisations),
        config.height.mode == "nonnegative",
    )
    return jax.block_until_ready(found)


def _covariance(path: Path, trial: Trial) -> Float[Array, "N1 9 9"]:
    """Of a path by the noise of `trial`; rests that touch the floor still do."""
    touching = None if path.floor is None else path.floor.active
    given = path.state, trial.signal, trial.period, trial.variance, trial.rows, touching
    return jax.block_until_ready(_about(*given, trial.prior, trial.prior_covariance, trial.gravity))


@stored_jit
def _about(state, signal, period, variance, rows, touching, prior, prior_covariance, gravity):
    if touching is not None:
        exact = jnp.zeros_like(rows.height_variance)
        rows = Rows(rows.rest, rows.velocity_variance, touching, exact, rows.velocity)
    samples = Samples(signal, period, variance)
    return smooth_about(state, samples, rows, prior, prior_covariance, gravity).covariance


@stored_jit
def _whole_trial(
    signal, period, variance, rows, prior, prior_covariance, gravity, relinearisations, nonnegative: bool
):
    problem = (Samples(signal, period, variance), rows, prior, prior_covariance, gravity, relinearisations)
    smoothed, floor = smooth_nonnegative(*problem) if nonnegative else (smooth(*problem), None)
    # Covariances that nobody asks for are not computed.
    return Path(smoothed.state, smoothed.cost, floor)
