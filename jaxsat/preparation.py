"""From a recording to a trial: what saturates, what rests, where it starts, and what is known of its noise."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.config import Config
from jaxsat.errors import InputError
from jaxsat.inertial.calibration import Calibration
from jaxsat.inertial.orientation import Gains, Start, backward
from jaxsat.inertial.programs import Beside, computing, make_room, stored_jit
from jaxsat.inertial.rotations import quat_between, quat_conjugate, quat_multiply
from jaxsat.inertial.smoother import Rows
from jaxsat.inertial.strapdown import NavState, prefixes, sample_intervals
from jaxsat.saturation.compensate import FIRST_STEPS, calibrate_recording, filter_recording
from jaxsat.saturation.false_rests import false_rests
from jaxsat.saturation.layout import Trial, pad
from jaxsat.saturation.level_ground import ROW, is_level
from jaxsat.signals.checks import check, check_form
from jaxsat.signals.rails import Gaps, Rails, find_gaps, find_rails, saturation_mask
from jaxsat.signals.recording import Recording, sensor_changes
from jaxsat.signals.rests import Segments, find_rests, find_segments, resting_rate
from jaxsat.signals.support import find_support

# Up to so long before its first rest (s) a recording's tilt is as well known as in it.
LATEST_FIRST_REST = 1.0
# sd of the unknown velocity of a sensor that does not start at rest (m/s), and of its tilt (rad), however long it
# moves before its first rest: a round number above the PI controller's inclination errors in results/orientation.
MOVING_START_SD = 3.0
MOVING_START_TILT_SD = 0.05
# sd of the gyroscope offset that is left while a rate is integrated back from the first rest (rad/s).
LEFT_OFFSET_SD = 1e-3


class Prepared(eqx.Module):
    """A recording with its rests, rails and gaps found, ready for the smoother."""

    trial: Trial
    """Padded."""
    grounded: Bool[np.ndarray, "P"] | None
    """First samples of rests that may be on the ground, padded; None where it is not asked for, or by too few."""
    gyr_offset: Float[np.ndarray, "3"]
    """What was taken off the rates (rad/s)."""
    gyr_offset_sd: Float[np.ndarray, "3"]
    """How well that is known (rad/s); zero where none was asked for."""
    calibration: Calibration
    """What the rests tell; what saturates may be anything within its bounds."""
    rails: Rails
    rest: Bool[np.ndarray, "N"]
    segments: Segments
    gaps: Gaps
    sign: Int[np.ndarray, "N 6"]
    warnings: list[str] = eqx.field(static=True)


def prepare(recording: Recording, config: Config) -> Prepared:
    """All that is done to a recording before it is smoothed; raises `InputError` as `estimate` does."""
    with computing():
        return _prepare(recording, config)


def _prepare(recording: Recording, config: Config) -> Prepared:
    make_room()
    check_form(recording)
    left_out = []
    with Beside(1) as beside:
        try:
            rails = find_rails(recording, config.rails.gyr, config.rails.acc)
            saturated, sign = saturation_mask(recording, rails)
            rest = _rests(recording, config, np.any(saturated, axis=1))
            while True:
                trial, offset, grounded = _trial(recording, config, rest, sign)
                calibrating = beside.submit(_calibrate_by_rests, trial, config)
                segments = find_segments(rest)
                # Saturated values may be anything within their bounds here.
                filtered = filter_recording(trial, trial.signal, trial.unfilled_variance)
                false = false_rests(trial, segments, filtered)
                if not false.any():
                    break
                for start, end in zip(segments.arrival[false], segments.rest_end[false], strict=True):
                    rest[start:end] = False
                    left_out.append(
                        f"the rest from {recording.time[start]:.2f} to {recording.time[end]:.2f} s is left out: the "
                        "motions before and after it say that the sensor moved."
                    )
        finally:
            # Here it goes on beside the calibration; what makes no sense says so, not what came of it.
            warnings = check(recording)
        calibration = calibrating.result()
    return Prepared(
        trial=trial,
        grounded=grounded,
        gyr_offset=offset[0],
        gyr_offset_sd=offset[1],
        calibration=calibration,
        rails=rails,
        rest=rest,
        segments=segments,
        gaps=find_gaps(sign),
        sign=sign,
        warnings=[*warnings, *left_out],
    )


def _rests(recording: Recording, config: Config, at_rail: Bool[np.ndarray, "N"]) -> Bool[np.ndarray, "N"]:
    chosen = config.rests
    rest = find_rests(
        recording, chosen.detector, chosen.threshold, chosen.window, chosen.min_duration, at_rail
    )
    return rest & ~at_rail & ~recording.missing.all(axis=1)


def constants_sd(config: Config) -> Float[Array, "9"] | None:
    """None where no constant is wanted."""
    sd = config.smoother.constants_sd
    return jnp.asarray(sd) if any(sd) else None


def _calibrate_by_rests(trial: Trial, config: Config) -> Calibration:
    sd, found = constants_sd(config), Calibration.none()
    for _ in range(FIRST_STEPS if sd is not None else 0):
        found = calibrate_recording(trial, trial.signal, trial.unfilled_variance, sd, found)
    return found


def find_ground(prepared: Prepared, config: Config) -> Bool[np.ndarray, "P"] | None:
    """First samples of the rests whose height the whole path is told; the search for δ does without.

    With `height.mode = "auto"` None unless the ground is level. To be called within `computing`.
    """
    trial, grounded = prepared.trial, prepared.grounded
    if config.height.mode != "auto" or grounded is None:
        return grounded
    return grounded if is_level(trial.calibrated(prepared.calibration), grounded) else None


def _trial(
    recording: Recording, config: Config, rest: Bool[np.ndarray, "N"], sign: Int[np.ndarray, "N 6"]
) -> tuple[Trial, Float[np.ndarray, "2 3"], Bool[np.ndarray, "P"] | None]:
    """The recording as the smoother wants it, the offset taken off the rates and its sd, and `Prepared.grounded`."""
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
    # The first rest at a foot's first step includes its first stir: leave out its last tenth of a second.
    quiet = slice(first, max(first + 1, first_rest.stop - round(0.1 / T)))

    offset = np.zeros((2, 3))
    if config.smoother.gyr_offset == "rests":
        offset = resting_rate(signal[:, :3], rest, T)
    signal = signal - np.concatenate([offset[0], np.zeros(3)])
    up = signal[quiet, 3:].mean(axis=0)
    gravity = np.linalg.norm(up) if config.gravity == "auto" else float(config.gravity)

    # Density to per-sample variance; a value that was not measured may be anything the channel did.
    noise, limits = config.noise, config.saturation
    density = np.array(noise.densities)
    plain = density**2 / T + (np.array(noise.changes) * sensor_changes(signal)) ** 2
    variance = np.where(recording.missing, np.maximum(signal.var(axis=0), plain), plain)

    # Attitude in the first rest from gravity, heading zero; back to the first sample by the gyroscope, or by the PI
    # controller of `orientation` where that is so long that its offset would do more than the controller errs.
    q_nb = _between(jnp.asarray(up), jnp.array([0.0, 0.0, 1.0]))
    velocity, tilt = jnp.zeros(3), noise.initial_tilt_sd**2
    drifted = (LEFT_OFFSET_SD * first * T) ** 2 + density[:3].max() ** 2 * first * T
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

    # The height of a resting sensor is one, not one a sample.
    arrived = np.concatenate([[False], rest[1:] & ~rest[:-1]]) & (np.arange(n) > first)
    mode = config.height.mode
    rows = Rows(
        rest=jnp.asarray(rest),
        velocity_variance=jnp.full(n, noise.rest_velocity_sd**2),
        height=jnp.asarray(arrived) if mode == "zero" else None,
        height_variance=jnp.full(n, config.height.sd**2),
        velocity=jnp.zeros((n, 3)),
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
    ).padded()
    asked = mode == "nonnegative" or (mode == "auto" and arrived.sum() >= ROW)
    return trial, offset, pad(arrived, len(trial.signal)) if asked else None


_between = stored_jit(quat_between)


def _attitude_before(signal, trusted, period: float, rest: Start, config: Config) -> Float[Array, "4"]:
    """Attitude at the first of the samples before a rest."""
    # Blank samples before the first turn nothing; lengths that are about the same share a program.
    blank = ((-len(signal) % 4096, 0), (0, 0))
    periods = jnp.asarray(np.pad(np.full(len(signal), period), blank[0]))
    values, trusted = jnp.asarray(np.pad(signal, blank)), jnp.asarray(np.pad(trusted, blank))
    return _backward(values, periods, trusted, rest, given_gains(config)).q_nb[0]


_backward = stored_jit(backward)


def given_gains(config: Config) -> Gains:
    """The gains of `config.orientation`, as numbers of JAX."""
    s = config.orientation
    gate = np.inf if s.gate == "none" else s.gate
    return Gains(*(jnp.asarray(x, float) for x in (s.kp, s.ki, s.tau, gate, s.limit)))
