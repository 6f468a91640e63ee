"""Parameters by gradient, on recordings named for it: Adam on their logarithms.

Gains of the orientation filter by their error against a reference; noise of the standard smoother by the likelihood
of its rests, or by its error against motion capture. Few parameters and long recordings: gradients are forward-mode,
at the cost of one more pass a parameter and no memory.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple, cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from jaxsat.config import Config, Noise
from jaxsat.errors import InputError
from jaxsat.inertial import kalman
from jaxsat.inertial.orientation import Direction, Estimate, Gains, Start, orientation, up_in_body
from jaxsat.inertial.programs import compiled, computing
from jaxsat.inertial.rotations import quat_rotate
from jaxsat.inertial.smoother import Rows, smooth, update_rows
from jaxsat.inertial.strapdown import (
    NavState,
    Samples,
    add_error,
    advance,
    error_transition,
    sample_intervals,
    sample_noise,
)
from jaxsat.preparation import find_ground, prepare
from jaxsat.saturation.layout import Trial, pad
from jaxsat.signals.recording import Recording
from jaxsat.studies.metrics import Track
from jaxsat.studies.tracked_point import find_tracked_point

Logs = Float[Array, "P"]


class Trials(eqx.Module):
    """Recordings with a reference, one a row (B leads everywhere); period zero pads."""

    signal: Float[Array, "B N 6"]
    period: Float[Array, "B N"]
    trusted: Bool[Array, "B N 2"]
    start: Start
    up: Float[Array, "B N 3"]
    """The true vertical in the body after each sample."""
    scored: Bool[Array, "B N"]


def inclination_loss(
    trials: Trials, gains: Gains, estimate: Estimate = "pi", direction: Direction = "mean"
) -> Float[Array, ""]:
    """Mean over trials of the mean squared inclination error (rad², of the chord between the verticals)."""

    def one(trial: Trials):
        found = orientation(
            trial.signal,
            trial.period,
            trial.trusted,
            trial.start,
            gains,
            estimate=estimate,
            direction=direction,
        )
        chord = jax.vmap(up_in_body)(found.q_nb[1:]) - trial.up
        square = jnp.where(trial.scored, jnp.sum(chord**2, axis=1), 0.0)
        return jnp.sum(square) / jnp.maximum(jnp.sum(trial.scored, dtype=square.dtype), 1.0)

    return jnp.mean(jax.vmap(one)(trials))


def tune_gains(
    trials: Trials,
    initial: Gains,
    *,
    estimate: Estimate = "pi",
    direction: Direction = "mean",
    steps: int = 30,
    rate: float = 0.2,
    report: Callable[[int, float, Gains], None] = lambda *_: None,
) -> Gains:
    """The gains of least `inclination_loss` on some trials: kp, ki and tau.

    `gate` and `limit` stay as they are, and a zero stays zero. Returns the best of all steps.
    """

    def gains(logs: Logs) -> Gains:
        kp, ki, tau = jnp.exp(logs)
        return Gains(kp, ki, tau, initial.gate, initial.limit)

    gradient = compiled(
        value_and_gradient(lambda logs: inclination_loss(trials, gains(logs), estimate, direction))
    )
    first = jnp.log(jnp.stack([initial.kp, initial.ki, initial.tau]))
    return gains(_descend(gradient, first, steps, rate, lambda k, value, logs: report(k, value, gains(logs))))


class NoiseTrial(eqx.Module):
    """A recording as the standard smoother takes it, with what its noise is made of."""

    trial: Trial
    """Calibrated with the noise that tuning starts from."""
    measured: Bool[np.ndarray, "N 6"]
    """The variance of the value is that of the sensor's density and of its changes."""
    extra: Float[np.ndarray, "N 6"]
    """Its variance beyond that (`noise.change`)."""
    axes: Float[np.ndarray, "6"]
    """Density of each channel over that of its sensor."""
    at_rest: Bool[np.ndarray, ""]
    """The recording starts at rest."""
    relinearisations: Int[np.ndarray, ""]
    position: Float[np.ndarray, "N 3"]
    """Of the reference (m)."""
    scored: Bool[np.ndarray, "N"]
    """Where there is one."""
    lever: Float[np.ndarray, "3"]
    """From the sensor to the point that it is of, in the body frame (m)."""

    def problem(self, noise: Float[Array, "3"]) -> tuple[Samples, Rows, NavState, Float[Array, "9 9"], Array]:
        """What the smoother is asked with this noise: gyr_density, acc_density, rest_velocity_sd."""
        trial = jax.tree.map(jnp.asarray, self.trial)
        density = jnp.repeat(noise[:2], 3) * self.axes
        held = jnp.where(trial.period > 0.0, trial.period, 1.0)
        white = density[None] ** 2 / held[:, None]
        variance = jnp.where(self.measured, white + self.extra, trial.variance)
        still = jnp.full_like(trial.period, noise[2] ** 2)
        rows = eqx.tree_at(lambda r: r.velocity_variance, trial.rows, still)
        diagonal = jnp.diag(trial.prior_covariance)
        start = jnp.where(self.at_rest & (jnp.arange(9) >= 6), noise[2] ** 2, diagonal)
        covariance = trial.prior_covariance + jnp.diag(start - diagonal)
        return (
            Samples(trial.signal, trial.period, variance),
            rows,
            trial.prior,
            covariance,
            trial.gravity,
        )


def noise_trial(recording: Recording, config: Config, truth: Track | None = None) -> NoiseTrial:
    """A recording prepared for `rest_misfit` and `position_loss`; raises `InputError` as `estimate` does.

    truth: times (s) and positions (m); samples that they do not cover are not scored. They are those of the point
    that motion capture tracks, which is found as seen from the path by the noise of `config`.
    """
    with computing():
        prepared = prepare(recording, config)
        # The likelihood is that of velocities; a position has the height that the estimate gives it.
        ground = find_ground(prepared, config) if truth is not None else None
        trial = jax.tree.map(np.asarray, prepared.trial.calibrated(prepared.calibration).on_ground(ground))
    n, size = len(recording), len(prepared.trial.signal)
    extra = prepared.trial.variance[:n] - np.array(config.noise.densities) ** 2 / recording.period
    made = NoiseTrial(
        trial,
        pad(~recording.missing, size),
        pad(extra, size),
        np.array(config.noise.axes),
        np.asarray(prepared.rest[0]),
        np.asarray(config.smoother.relinearisations),
        np.zeros((size, 3)),
        np.zeros(size, bool),
        np.zeros(3),
    )
    return made if truth is None else _against(made, recording, truth, config)


def _against(made: NoiseTrial, recording: Recording, truth: Track, config: Config) -> NoiseTrial:
    """With the reference that its positions are scored against."""
    (time, track), own = truth, recording.time
    scored = (own >= time[0]) & (own <= time[-1])
    if not scored.any():
        raise InputError(
            f"{recording.name}: motion capture from {time[0]:.3f} to {time[-1]:.3f} s covers none of the "
            f"recording's {own[0]:.3f} to {own[-1]:.3f} s; put both on one clock."
        )

    def reference(at: Float[np.ndarray, "K"]) -> Float[np.ndarray, "K 3"]:
        return np.stack([np.interp(at, time, axis) for axis in track.T], axis=1)

    noise = config.noise
    with computing():
        start = jnp.asarray([noise.gyr_density, noise.acc_density, noise.rest_velocity_sd], float)
        state = jax.tree.map(lambda x: np.asarray(x)[: len(own)][scored], jax.jit(_path)(made, start))
    point = find_tracked_point(own[scored], state.position, state.q_nb, reference(own[scored]))
    size = len(made.scored)
    changed = pad(reference(own + point.lag), size), pad(scored, size), point.lever
    return eqx.tree_at(lambda m: (m.position, m.scored, m.lever), made, changed)


def rest_misfit(trial: NoiseTrial, noise: Float[Array, "3"]) -> Float[Array, ""]:
    """Minus the log-likelihood of the velocities (and heights) at rest, without its constant.

    The prediction-error form of Schweppe (IEEE Trans. Inf. Theory 1965, 11(1), 61-70), ½ Σ (e²/s + log s) over the
    innovations e and their variances s of the smoother's extended Kalman filter: J* of Eq. 14 with the determinants
    that keep noise from growing.
    """
    samples, rows, prior, covariance, gravity = trial.problem(noise)

    def step(carry, inputs):
        state, covariance, total = carry
        interval, sample, row = inputs
        error, covariance, cost, done = update_rows(jnp.zeros(9), covariance, state, row)
        weight = jnp.stack([one.weight for one in done])
        seen = weight > 0.0
        total = total + cost - 0.5 * jnp.sum(jnp.where(seen, jnp.log(jnp.where(seen, weight, 1.0)), 0.0))
        state = add_error(state, error)
        transition = error_transition(state.q_nb, interval)
        spread = sample_noise(state.q_nb, sample.signal, sample.period, sample.variance)
        _, covariance = kalman.predict(error, covariance, transition.forth, error, spread)
        return (advance(state, interval, gravity), covariance, total), None

    intervals = sample_intervals(samples.signal, samples.period)
    carry = (prior, covariance, jnp.zeros(()))
    (_, _, total), _ = jax.lax.scan(step, carry, (intervals, samples, rows))
    return total


def _path(trial: NoiseTrial, noise: Float[Array, "3"]) -> NavState:
    """By the standard smoother, at the starts of samples."""
    state = smooth(*trial.problem(noise), jnp.asarray(trial.relinearisations)).state
    return jax.tree.map(lambda x: x[:-1], state)


def position_loss(trial: NoiseTrial, noise: Float[Array, "3"]) -> Float[Array, ""]:
    """Mean squared position error (m²) by the standard smoother, turned about z and shifted onto the reference.

    Of the point that the reference is of.
    """
    state = _path(trial, noise)
    found = state.position + jax.vmap(quat_rotate, (0, None))(state.q_nb, jnp.asarray(trial.lever))
    weight = jnp.where(trial.scored, 1.0, 0.0)[:, None] / jnp.sum(trial.scored, dtype=found.dtype)
    true = jnp.asarray(trial.position)
    centred, truth = (x - jnp.sum(weight * x, axis=0)[None] for x in (found, true))
    # As metrics.align_yaw_translation: the best turn is that of the sums of inner and outer products.
    inner = jnp.sum(weight[:, 0] * (centred[:, 0] * truth[:, 0] + centred[:, 1] * truth[:, 1]))
    outer = jnp.sum(weight[:, 0] * (centred[:, 0] * truth[:, 1] - centred[:, 1] * truth[:, 0]))
    return jnp.sum(weight * (centred**2 + truth**2)) - 2.0 * (
        jnp.hypot(inner, outer) + jnp.sum(weight[:, 0] * centred[:, 2] * truth[:, 2])
    )


class TunedNoise(NamedTuple):
    """What `tune_noise` found; the loss is a mean over samples at rest (likelihood) or recordings (m²)."""

    noise: Noise
    before: float
    after: float


def tune_noise(
    trials: Sequence[NoiseTrial],
    initial: Noise,
    *,
    against_truth: bool = False,
    steps: int = 40,
    rate: float = 0.2,
    report: Callable[[int, int], None] = lambda *_: None,
) -> TunedNoise:
    """The noise under which the rests of some recordings are likeliest, or their positions least in error.

    gyr_density, acc_density and rest_velocity_sd are searched from `initial` on; initial_tilt_sd stays. Returns the
    best of all steps, computed in float64 whatever JAX's setting. report: called with (steps done, steps in all).
    Raises `InputError` where there is no recording, or a loss is not finite.
    """
    if not trials or steps < 1:
        raise InputError("tune: there is nothing to do; give at least one recording and one step.")
    loss = position_loss if against_truth else rest_misfit
    count = len(trials) if against_truth else sum(int(np.sum(t.trial.rows.rest)) for t in trials)
    start = [initial.gyr_density, initial.acc_density, initial.rest_velocity_sd]
    best, before, after = least(loss, trials, start, count, steps, rate, report)
    gyr, acc, still = (float(f"{x:.4g}") for x in best)
    found = initial.model_copy(update={"gyr_density": gyr, "acc_density": acc, "rest_velocity_sd": still})
    return TunedNoise(found, before, after)


def least(
    loss: Callable[..., Float[Array, ""]],
    trials: Sequence[eqx.Module],
    start: Sequence[float],
    count: int,
    steps: int,
    rate: float,
    report: Callable[[int, int], None],
    side_by_side: bool = True,
) -> tuple[np.ndarray, float, float]:
    """Parameters of least summed loss over `count`, and that before and after; side_by_side: of `value_and_gradient`.

    Raises `InputError` where a loss is not finite.
    """
    with computing():
        gradient = compiled(value_and_gradient(lambda logs, trial: loss(trial, jnp.exp(logs)), side_by_side))

        def together(logs: Logs) -> tuple[Array, Array]:
            values, slopes = zip(*(gradient(logs, trial) for trial in trials), strict=True)
            return jnp.sum(jnp.stack(values)) / count, jnp.sum(jnp.stack(slopes), axis=0) / count

        values: list[float] = []

        def note(k: int, value: float, _: Logs) -> None:
            values.append(value)
            report(k + 1, steps)

        best = np.exp(np.asarray(_descend(together, jnp.log(jnp.asarray(start)), steps, rate, note)))
    if not np.isfinite(values).all():
        raise InputError(
            "tune: the loss is not finite; start from other values, or leave out recordings that do not fit."
        )
    return best, values[0], min(values)


def value_and_gradient(
    loss: Callable[..., Float[Array, ""]], side_by_side: bool = True
) -> Callable[..., tuple[Array, Array]]:
    """Value and gradient of a loss of few logarithms (and data).

    side_by_side: one pass carries the value and its tangents; else one after the other, for a loss that factorises
    matrices (what `jaxsat.inertial.dense` does one by one has no batch of derivatives at a point).
    """

    def both(logs: Logs, *data):
        def along(tangent):
            return jax.jvp(lambda x: loss(x, *data), (logs,), (tangent,))

        each = jnp.eye(len(logs), dtype=logs.dtype)
        values, tangents = jax.vmap(along)(each) if side_by_side else jax.lax.map(along, each)
        return values[0], jnp.where(jnp.isfinite(logs), tangents, 0.0)

    return both


def _descend(
    gradient: Callable[[Logs], tuple[Array, Array]],
    first: Logs,
    steps: int,
    rate: float,
    report: Callable[[int, float, Logs], None],
) -> Logs:
    """Adam from `first` on; the best of all steps."""
    logs, optimiser = first, optax.adam(rate)
    state = optimiser.init(logs)
    best, lowest = logs, np.inf
    for k in range(steps):
        value, slope = gradient(logs)
        report(k, float(value), logs)
        if float(value) < lowest:
            best, lowest = logs, float(value)
        # Optax counts in integers and mixes them with floats.
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimiser.update(slope, state)
            logs = cast(Array, optax.apply_updates(logs, updates))
    return best
