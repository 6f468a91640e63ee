"""Scales of the signal prior: the misfit is that of sums of gaps, and scales that were drawn from are found again."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsat.config import Config, Saturation, load_config
from jaxsat.errors import InputError
from jaxsat.saturation.prior import Scales, by_signal
from jaxsat.studies.motions import Walk
from jaxsat.studies.simulate import simulate
from jaxsat.studies.tuning import value_and_gradient
from jaxsat.studies.tuning_prior import prior_misfit, prior_trials, tune_prior


@pytest.fixture(scope="module")
def clipped_walk():
    recording, truth = simulate(Walk(strides=4), rate=100.0, duration=6.0, key=jax.random.key(3))
    recording = eqx.tree_at(lambda r: r.rest, recording, truth.rest, is_leaf=lambda x: x is None)
    return recording, prior_trials(recording, Config())


def test_the_misfit_of_what_was_clipped_off_is_that_of_its_sums(clipped_walk):
    """Against the density of each gap's sum, gap by gap, and its slope against differences."""
    recording, trials = clipped_walk
    assert len(trials) == 3 and all(trial.count for trial in trials)
    with jax.enable_x64(True):
        for trial, share in zip(trials, (0.5, 0.65, 0.8), strict=True):
            prior = eqx.tree_at(lambda p: p.scales, trial.prior, Scales(jnp.asarray(0.7), jnp.asarray(0.4)))
            expected, rail, gaps = 0.0, share * np.abs(recording.gyr).max(), 0
            rows = zip(trial.sample, trial.channel, trial.sign, trial.gap, trial.lost, strict=True)
            for sample, channel, sign, gap, lost in rows:
                real = sign != 0
                beyond = np.abs(recording.signal[sample[real], channel[real]]) - rail
                np.testing.assert_allclose(lost[real], beyond, atol=1e-12)
                mean, covariance = by_signal(
                    prior, *map(jnp.asarray, (trial.signal, sample, channel, sign, gap))
                )
                for k in np.unique(gap[real]):
                    mine, gaps = real & (gap == k), gaps + 1
                    variance = np.asarray(covariance)[np.ix_(mine, mine)].sum()
                    away = lost[mine].sum() - np.asarray(mean)[mine].sum()
                    expected += 0.5 * (away**2 / variance + np.log(variance))
            assert gaps == trial.count
            at = jnp.log(jnp.array([0.7, 0.4]))

            def loss(logs, trial=trial):
                return prior_misfit(trial, jnp.exp(logs))

            value, slope = jax.jit(value_and_gradient(loss, side_by_side=False))(at)
            assert value == pytest.approx(expected, rel=1e-9)
            run, step = jax.jit(loss), 1e-5
            for k, e in enumerate(np.eye(2)):
                difference = (run(at + step * e) - run(at - step * e)) / (2 * step)
                assert slope[k] == pytest.approx(float(difference), rel=1e-5, abs=1e-6)


def test_scales_of_the_prior_are_those_under_which_it_was_drawn(clipped_walk):
    """Where what gaps lost scatters about the prior's mean by a share, that share is found."""
    _, trials = clipped_walk
    rng, drawn = np.random.default_rng(0), []
    with jax.enable_x64(True):
        for trial in trials * 12:
            prior = eqx.tree_at(lambda p: p.scales, trial.prior, Scales(jnp.asarray(0.5), jnp.asarray(1.5)))
            lost = np.zeros_like(trial.lost)
            for i, values in enumerate(zip(trial.sample, trial.channel, trial.sign, trial.gap, strict=True)):
                mean, covariance = by_signal(prior, *map(jnp.asarray, (trial.signal, *values)))
                lost[i] = rng.multivariate_normal(mean, covariance)
            drawn.append(eqx.tree_at(lambda t: t.lost, trial, lost))
    found = tune_prior(drawn, Saturation(), steps=40)
    assert found.saturation.prior_share == pytest.approx(1.5, rel=0.3)
    assert found.after < found.before
    again = tune_prior(drawn, found.saturation, steps=3)
    assert again.before == pytest.approx(found.after, abs=0.02)


def test_what_saturated_by_itself_is_not_counted(clipped_walk):
    recording, _ = clipped_walk
    rail = 0.9 * np.abs(recording.gyr).max()
    limit = np.repeat([rail, np.inf], 3)
    limited = recording.with_signal(np.clip(recording.signal, -limit, limit))
    config = load_config(None, **{"rails.gyr": rail})
    again = prior_trials(limited, config)
    for trial in again:
        gaps = sum(len(np.unique(gap[sign != 0])) for gap, sign in zip(trial.gap, trial.sign, strict=True))
        assert np.isnan(trial.lost).any() and trial.count < gaps


def test_a_recording_of_which_nothing_is_clipped_off_teaches_nothing():
    with pytest.raises(InputError, match="nothing is clipped off"):
        tune_prior([], Saturation())
