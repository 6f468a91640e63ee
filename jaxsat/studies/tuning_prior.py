"""Scales of the signal prior by gradient: those under which what recordings lose, clipped in software, is likely."""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.config import Config, Saturation
from jaxsat.errors import InputError
from jaxsat.inertial.programs import computing
from jaxsat.pipeline import search_options
from jaxsat.preparation import prepare
from jaxsat.saturation.compensate import learn_prior
from jaxsat.saturation.layout import padded_sizes
from jaxsat.saturation.prior import Scales, SignalPrior, by_signal
from jaxsat.signals.recording import Recording
from jaxsat.studies.tuning import least

# Rails at which `prior_trials` clips a recording, over its largest rate.
CLIPPED_AT = (0.5, 0.65, 0.8)


class PriorTrial(eqx.Module):
    """A recording clipped in software, and what that took off; S segments of at most m saturated values, padded."""

    signal: Float[np.ndarray, "N 6"]
    prior: SignalPrior
    """Learned from its unsaturated samples; with the scales that tuning starts from."""
    sample: Int[np.ndarray, "S m"]
    channel: Int[np.ndarray, "S m"]
    sign: Float[np.ndarray, "S m"]
    """Zero pads."""
    gap: Int[np.ndarray, "S m"]
    """A number of the gap in its segment that a value lies in."""
    lost: Float[np.ndarray, "S m"]
    """What was clipped off each value, in the direction of its rail; NaN where the recording had saturated itself."""

    @property
    def count(self) -> int:
        """Gaps of which all that was lost is known."""
        known = [
            np.isfinite(lost[(gap == k) & (sign != 0)]).all()
            for gap, sign, lost in zip(self.gap, self.sign, self.lost, strict=True)
            for k in np.unique(gap[sign != 0])
        ]
        return int(np.sum(known))


def prior_trials(recording: Recording, config: Config) -> list[PriorTrial]:
    """A recording with its rates clipped at `CLIPPED_AT`; raises `InputError` as `estimate` does."""
    with computing():
        saturated = prepare(recording, config).sign != 0
        largest = float(np.abs(recording.gyr).max())
        return [_clipped(recording, saturated, share * largest, config) for share in CLIPPED_AT]


def _clipped(
    recording: Recording, saturated: Bool[np.ndarray, "N 6"], rail: float, config: Config
) -> PriorTrial:
    limit = np.repeat([rail, np.inf], 3)
    limited = recording.with_signal(np.clip(recording.signal, -limit, limit))
    rails = config.rails.model_copy(update={"gyr": rail})
    prepared = prepare(limited, config.model_copy(update={"rails": rails}))
    lost = np.where(saturated, np.nan, np.abs(recording.signal - limited.signal))
    number = np.zeros(recording.signal.shape, int)
    for k, (channel, start, end) in enumerate(
        zip(prepared.gaps.channel, prepared.gaps.start, prepared.gaps.end, strict=True)
    ):
        number[start:end, channel] = k
    segments, found = prepared.segments, []
    for first, last in zip(np.maximum(segments.departure, 0), segments.arrival, strict=True):
        sample, channel = np.nonzero(prepared.sign[first:last])
        if len(sample):
            place = sample + first, channel
            gap = np.unique(number[place], return_inverse=True)[1]
            found.append((*place, prepared.sign[place].astype(float), gap, lost[place]))
    size = padded_sizes(1, max((len(one[0]) for one in found), default=1)).values
    # Padded values lie in a gap of their own.
    fill = (0, 0, 0.0, size - 1, 0.0)
    padded = [
        np.stack([np.pad(x, (0, size - len(x)), constant_values=value) for x in column])
        for column, value in zip(zip(*found, strict=True), fill, strict=True)
    ] or [np.zeros((0, size), type(value)) for value in fill]
    prior = learn_prior(prepared.trial, search_options(config, "map"))
    assert prior is not None, "map has one"
    return PriorTrial(np.asarray(prepared.trial.signal), prior, *padded)


def prior_misfit(trial: PriorTrial, scales: Float[Array, "2"]) -> Float[Array, ""]:
    """Minus the log-likelihood of what gaps lost in all, each on its own, without its constant.

    scales: width and share (`jaxsat.saturation.prior.Scales`). What the prior says rests on the clipped recording's
    own unsaturated samples; no rest has told of it yet.
    """
    prior = eqx.tree_at(lambda p: p.scales, trial.prior, Scales(scales[0], scales[1]))
    signal = jnp.asarray(trial.signal)

    def of_segment(values):
        sample, channel, sign, gap, lost = values
        mean, covariance = by_signal(prior, signal, sample, channel, sign, gap)
        real = sign != 0.0
        together = (gap[:, None] == gap[None]) & real[:, None] & real[None]
        rows = jnp.sum(jnp.where(together, covariance, 0.0), axis=1)
        total, expected, variance, length = (
            jnp.sum(jnp.where(together, x[None], 0.0), axis=1)
            for x in (lost, mean, rows, jnp.ones_like(lost))
        )
        counted = real & jnp.isfinite(total)
        variance, away = jnp.where(counted, variance, 1.0), jnp.where(counted, total - expected, 0.0)
        each = 0.5 * (away**2 / variance + jnp.log(variance))
        # Each gap counts once.
        return jnp.sum(jnp.where(counted, each / jnp.maximum(length, 1.0), 0.0))

    values = trial.sample, trial.channel, trial.sign, trial.gap, trial.lost
    return jnp.sum(jax.lax.map(of_segment, jax.tree.map(jnp.asarray, values)))


class TunedPrior(NamedTuple):
    """What `tune_prior` found; the loss is a mean over gaps."""

    saturation: Saturation
    before: float
    after: float


def tune_prior(
    trials: Sequence[PriorTrial],
    initial: Saturation,
    *,
    steps: int = 40,
    rate: float = 0.2,
    report: Callable[[int, int], None] = lambda *_: None,
) -> TunedPrior:
    """The scales of the signal prior under which what was clipped off is likeliest: prior_width and prior_share.

    Returns the best of all steps, as `tune_noise` does; raises `InputError` where nothing was clipped off.
    """
    trials = [trial for trial in trials if trial.count]
    if not trials or steps < 1:
        raise InputError(
            "tune: nothing is clipped off; give at least one recording that moves, and one step."
        )
    start, count = [initial.prior_width, initial.prior_share], sum(trial.count for trial in trials)
    best, before, after = least(prior_misfit, trials, start, count, steps, rate, report, side_by_side=False)
    width, share = (float(f"{x:.4g}") for x in best)
    found = initial.model_copy(update={"prior_width": width, "prior_share": share})
    return TunedPrior(found, before, after)
