"""The pipeline: a recording and a configuration in, a trajectory out."""

import time
from collections.abc import Callable
from functools import partial
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.config import Config
from jaxsat.errors import InputError
from jaxsat.inertial.orientation import Gains, Start, backward
from jaxsat.inertial.rotations import quat_between, quat_conjugate, quat_multiply
from jaxsat.inertial.smoother import (
    ActiveSet,
    Filtered,
    Rows,
    Smoothed,
    displacement_covariance,
    smooth,
    smooth_nonnegative,
)
from jaxsat.inertial.strapdown import NavState, Samples, prefixes, sample_intervals
from jaxsat.saturation.compensate import (
    Fills,
    compensate_parallel,
    compensate_sequential,
    filter_recording,
)
from jaxsat.saturation.false_rests import false_rests
from jaxsat.saturation.layout import Trial, bucket, pad
from jaxsat.saturation.methods import Compensation, Options
from jaxsat.signals.checks import check
from jaxsat.signals.rails import Gaps, Rails, find_gaps, find_rails, saturation_mask
from jaxsat.signals.recording import Recording
from jaxsat.signals.rests import Segments, find_rests, find_segments
from jaxsat.signals.support import find_support

# Up to so long before its first rest (s) a recording's tilt is as well known as in it.
LATEST_FIRST_REST = 1.0
# A gyroscope offset is taken from a first rest of at least this length; a shorter one tells less than it costs.
SHORTEST_OFFSET_REST = 1.0
# sd of the unknown velocity of a sensor that does not start at rest (m/s), and of its tilt (rad), however long it
# moves before its first rest: a round number above the PI controller's inclination errors in results/orientation.
MOVING_START_SD = 3.0
MOVING_START_TILT_SD = 0.05
# sd of the gyroscope offset that is left while a rate is integrated back from the first rest (rad/s).
LEFT_OFFSET_SD = 1e-3


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
    standard_position: Float[np.ndarray, "N 3"]
    """Where the standard smoother, which ignores saturation, puts the sensor (m)."""
    cost: Float[np.ndarray, ""]
    """J* of the whole recording as reported."""
    cost_standard: Float[np.ndarray, ""]
    """J* of the whole recording with saturation ignored."""
    gravity: float
    gyr_offset: Float[np.ndarray, "3"]
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
    with jax.enable_x64(True):
        return _estimate(recording, config, progress or (lambda *_: None))


class Prepared(eqx.Module):
    """A recording with its rests, rails and gaps found, ready for the smoother."""

    trial: Trial
    """Padded."""
    gyr_offset: Float[np.ndarray, "3"]
    """What was taken off the rates (rad/s)."""
    rails: Rails
    rest: Bool[np.ndarray, "N"]
    segments: Segments
    gaps: Gaps
    sign: Int[np.ndarray, "N 6"]
    warnings: list[str] = eqx.field(static=True)


def prepare(recording: Recording, config: Config) -> Prepared:
    """All that is done to a recording before it is smoothed; raises `InputError` as `estimate` does."""
    with jax.enable_x64(True):
        return _prepare(recording, config)[0]


def _prepare(recording: Recording, config: Config) -> tuple[Prepared, Filtered]:
    """And the filter pass over it, saturated values being free within their bounds."""
    warnings = check(recording)
    rails = find_rails(recording, config.rails.gyr, config.rails.acc)
    saturated, sign = saturation_mask(recording, rails)
    at_rail = np.any(saturated, axis=1)
    rest = find_rests(
        recording,
        config.rests.detector,
        config.rests.threshold,
        config.rests.window,
        config.rests.min_duration,
        at_rail,
    )
    rest = rest & ~at_rail & ~recording.missing.all(axis=1)
    while True:
        trial, offset = _trial(recording, config, rest, sign)
        segments, searched = find_segments(rest), _without_floor(trial, config)
        filtered = filter_recording(searched, trial.signal, trial.unfilled_variance)
        false = false_rests(searched, segments, filtered)
        if not false.any():
            break
        for start, end in zip(segments.arrival[false], segments.rest_end[false], strict=True):
            rest[start:end] = False
            warnings.append(
                f"the rest from {recording.time[start]:.2f} to {recording.time[end]:.2f} s is left out: the motions "
                "before and after it say that the sensor moved."
            )
    return Prepared(trial, offset, rails, rest, segments, find_gaps(sign), sign, warnings), filtered


def _without_floor(trial: Trial, config: Config) -> Trial:
    """An inequality acts on the whole trajectory only: a single segment is searched without it."""
    if config.height.mode == "nonnegative":
        return eqx.tree_at(lambda t: t.rows.height, trial, None)
    return trial


def search_options(config: Config, method: str) -> Options:
    """How a compensating method searches."""
    chosen = config.saturation
    bias_sd = np.repeat([config.smoother.gyr_bias_sd, config.smoother.acc_bias_sd], 3)
    # A sensor of which no bias is wanted has one that is as good as known.
    wanted = method == "map" and bool(bias_sd.any())
    return Options(
        cast(Compensation, method),
        chosen.solver,
        chosen.free_peak_time,
        jnp.asarray(chosen.max_iterations),
        jnp.asarray(chosen.tolerance),
        jnp.asarray(np.maximum(bias_sd, 1e-9)) if wanted else None,
    )


def _estimate(recording: Recording, config: Config, progress: Progress) -> Estimate:
    clock = _Clock()
    prepared, filtered = _prepare(recording, config)
    trial, segments, gaps = prepared.trial, prepared.segments, prepared.gaps
    clock.lap("signals")
    fills = Fills.nothing(trial, len(segments))
    standard, floor = _smooth(trial, config)
    smoothed, sure = standard, trial
    clock.lap("smoother")
    if config.method != "standard" and len(gaps):
        options = search_options(config, config.method)
        report = partial(progress, "segments")
        searched = _without_floor(trial, config)
        if config.saturation.segments == "parallel":
            fills = compensate_parallel(
                searched, segments, options, config.saturation.sweeps, report, filtered
            )
        else:
            fills = compensate_sequential(searched, segments, options, report)
        clock.lap("compensation")
        filled = eqx.tree_at(lambda t: t.signal, trial, fills.unbiased)
        path, sure = (
            eqx.tree_at(lambda t: t.variance, filled, trial.variance + extra)
            for extra in (fills.slack, fills.variance)
        )
        smoothed, floor = _smooth(path, config)
        if (fills.slack != fills.variance).any():
            # How sure the path is, is another question.
            covariance = _smooth(sure, config)[0].covariance
            smoothed = eqx.tree_at(lambda s: s.covariance, smoothed, covariance)
        clock.lap("smoother")

    n = len(recording)

    def sampled(f):
        return f.signal, f.variance, f.slack, f.sd, f.gap_sd, f.identified, f.at_bound, f.inflated

    fills = eqx.tree_at(sampled, fills, [x[:n] for x in sampled(fills)])
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
            q_nb=np.asarray(smoothed.state.q_nb)[:n],
            position=np.asarray(smoothed.state.position)[:n],
            velocity=np.asarray(smoothed.state.velocity)[:n],
            covariance=np.asarray(smoothed.covariance)[:n],
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
        standard_position=np.asarray(standard.state.position)[:n],
        cost=np.asarray(smoothed.cost),
        cost_standard=np.asarray(standard.cost),
        gravity=float(trial.gravity),
        gyr_offset=prepared.gyr_offset,
        floor=floor,
        warnings=prepared.warnings,
        seconds=clock.seconds,
    )


def displacements(found: Estimate) -> tuple[Float[np.ndarray, "S 3"], Float[np.ndarray, "S 3 3"]]:
    """The way from departure to arrival of each segment (m), and its covariance (m²).

    NaN where no rest precedes or follows, the covariance also where heights are used, which tie ways together.
    """
    segments, n = found.segments, len(found.recording)
    whole = (segments.departure >= 0) & (segments.arrival < n)
    way, covariance = np.full((len(segments), 3), np.nan), np.full((len(segments), 3, 3), np.nan)
    ends = np.stack([segments.departure, segments.arrival])[:, whole]
    position = found.trajectory.position
    way[whole] = position[ends[1]] - position[ends[0]]
    if whole.any() and found.config.height.mode == "off":
        problem, size = found.problem, len(found.problem.period)
        # Padding repeats the last motion.
        count = int(whole.sum())
        departure, arrival = np.pad(ends, ((0, 0), (0, bucket(count, 16) - count)), mode="edge")
        states = found.trajectory.q_nb, found.trajectory.velocity, position, found.trajectory.covariance
        with jax.enable_x64(True):
            ways = _ways(problem, *(pad(x, size) for x in states), departure, arrival)
        covariance[whole] = np.asarray(ways)[:count]
    return way, covariance


@eqx.filter_jit
def _ways(problem: Trial, q_nb, velocity, position, covariance, departure, arrival):
    samples = Samples(problem.signal, problem.period, problem.variance)
    start = NavState(q_nb, velocity, position)
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


def _trial(
    recording: Recording, config: Config, rest: Bool[np.ndarray, "N"], sign: Int[np.ndarray, "N 6"]
) -> tuple[Trial, Float[np.ndarray, "3"]]:
    """The recording as the smoother wants it, and the gyroscope offset that was taken off (rad/s)."""
    n, T, signal = len(recording), recording.period, recording.signal
    started = np.flatnonzero(rest)
    if not len(started):
        raise InputError(
            f"{recording.name}: no rest is found, and without any a trajectory drifts away within seconds; give a "
            f"rest column if the sensor does rest. As it is, {find_support(recording, rest).sentence()}."
        )
    first = int(started[0])
    moving = np.flatnonzero(~rest[first:])
    first_rest = slice(first, first + int(moving[0]) if len(moving) else n)
    length = first_rest.stop - first_rest.start
    # The first rest at a foot's first step includes its first stir: leave out its last tenth of a second.
    quiet = slice(first, max(first + 1, first_rest.stop - round(0.1 / T)))

    offset = np.zeros(3)
    if config.smoother.gyr_offset == "first_rest" and length * T >= SHORTEST_OFFSET_REST:
        offset = signal[quiet, :3].mean(axis=0)
    signal = signal - np.concatenate([offset, np.zeros(3)])
    up = signal[quiet, 3:].mean(axis=0)
    gravity = np.linalg.norm(up) if config.gravity == "auto" else float(config.gravity)

    # Density to per-sample variance; a value that was not measured may be anything the channel did.
    noise, limits = config.noise, config.saturation
    density = np.repeat([noise.gyr_density, noise.acc_density], 3)
    variance = np.where(recording.missing, np.maximum(signal.var(axis=0), density**2 / T), density**2 / T)

    # Attitude in the first rest from gravity, heading zero; back to the first sample by the gyroscope, or by the PI
    # controller of `orientation` where that is so long that its offset would do more than the controller errs.
    q_nb = quat_between(jnp.asarray(up), jnp.array([0.0, 0.0, 1.0]))
    velocity, tilt = jnp.zeros(3), noise.initial_tilt_sd**2
    drifted = (LEFT_OFFSET_SD * first * T) ** 2 + noise.gyr_density**2 * first * T
    if first * T > LATEST_FIRST_REST:
        tilt += min(drifted, MOVING_START_TILT_SD**2)
    if drifted > MOVING_START_TILT_SD**2:
        trusted = ((sign[:first] == 0) & ~recording.missing[:first]).reshape(first, 2, 3).all(axis=2)
        start = Start(q_nb, jnp.zeros(3), jnp.asarray(float(gravity)))
        q_nb = _attitude_before(signal[:first], trusted, T, start, config)
    elif first > 0:
        early = prefixes(sample_intervals(jnp.asarray(signal[:first]), jnp.full(first, T)))
        q_nb = quat_multiply(q_nb, quat_conjugate(early.rotation[-1]))
    speed = MOVING_START_SD**2 if first > 0 else noise.rest_velocity_sd**2
    # Tilt is horizontal in the navigation frame; heading and position are the origin of the map.
    prior_covariance = np.diag([tilt, tilt, 0.0, 0.0, 0.0, 0.0, speed, speed, speed])

    height = None
    if config.height.mode != "off":
        height = np.zeros(n, bool)
        arrivals = np.flatnonzero(rest[1:] & ~rest[:-1]) + 1
        height[arrivals[arrivals > first]] = True
    rows = Rows(
        rest=jnp.asarray(rest),
        velocity_variance=jnp.full(n, noise.rest_velocity_sd**2),
        height=None if height is None else jnp.asarray(height),
        height_variance=jnp.full(n, config.height.sd**2),
    )
    trial = Trial(
        signal=signal,
        period=np.full(n, T),
        variance=variance,
        sign=sign,
        clean=(sign == 0) & ~recording.missing,
        bound=np.repeat([limits.gyr_bound, limits.acc_bound], 3),
        rows=rows,
        prior=jax.tree.map(np.asarray, NavState(q_nb, velocity, jnp.zeros(3))),
        prior_covariance=prior_covariance,
        gravity=np.asarray(gravity),
    )
    return trial.padded(), offset


def _attitude_before(signal, trusted, period: float, rest: Start, config: Config) -> Float[Array, "4"]:
    """Attitude at the first of the samples before a rest."""
    # Blank samples before the first turn nothing; lengths that are about the same share a program.
    blank = ((-len(signal) % 4096, 0), (0, 0))
    periods = jnp.asarray(np.pad(np.full(len(signal), period), blank[0]))
    values, trusted = jnp.asarray(np.pad(signal, blank)), jnp.asarray(np.pad(trusted, blank))
    return _backward(values, periods, trusted, rest, given_gains(config)).q_nb[0]


_backward = eqx.filter_jit(backward)


def given_gains(config: Config) -> Gains:
    """The gains of `config.orientation`, as numbers of JAX."""
    s = config.orientation
    gate = np.inf if s.gate == "none" else s.gate
    return Gains(*(jnp.asarray(x, float) for x in (s.kp, s.ki, s.tau, gate, s.limit)))


def _smooth(trial: Trial, config: Config) -> tuple[Smoothed, ActiveSet | None]:
    smoothed, floor = _whole_trial(
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
    return jax.block_until_ready(smoothed), floor


@eqx.filter_jit
def _whole_trial(
    signal, period, variance, rows, prior, prior_covariance, gravity, relinearisations, nonnegative: bool
):
    problem = (Samples(signal, period, variance), rows, prior, prior_covariance, gravity, relinearisations)
    return smooth_nonnegative(*problem) if nonnegative else (smooth(*problem), None)
