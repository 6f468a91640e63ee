"""What is said about filled values: against SciPy, against a dense posterior, and against the truth over seeds."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.stats import norm, truncnorm
from test_pipeline import BAR, bar
from test_segment import DELTA, build

from jaxsat.config import load_config
from jaxsat.pipeline import estimate
from jaxsat.present.tables import gaps_table
from jaxsat.saturation.prior import Known
from jaxsat.saturation.segment import condense, value_gradient_root
from jaxsat.saturation.uncertainty import truncated_sd, uncertainty

COLUMNS = jax.jit(value_gradient_root)


@jax.jit
def judge(segment, delta):
    known = segment.known
    _, slope, columns = value_gradient_root(delta, condense(segment), problems.GRAVITY)
    return uncertainty(segment, delta, slope + known.slope + known.precision @ delta, columns)


def known_segment(scale: float):
    """Six values in two gaps, with a random prior."""
    root = np.random.default_rng(0).normal(size=(6, 6))
    precision = np.eye(8)
    precision[:6, :6] = (root @ root.T + np.eye(6)) * scale
    covariance = jnp.asarray(np.linalg.inv(precision))
    variance, harmful = jnp.diagonal(covariance), jnp.zeros(8, bool)
    prior = Known(jnp.asarray(precision), jnp.zeros(8), covariance, variance, harmful)
    segment = build(False)
    gaps = jnp.array([0, 0, 1, 2, 3, 4, 7, 7])
    return eqx.tree_at(lambda s: (s.known, s.gap), segment, (prior, gaps), is_leaf=lambda x: x is None)


def test_sd_of_a_truncated_gaussian_is_that_of_scipy():
    centre, sd, upper = np.array([0.5, -1.0, -3.0, 4.0, 0.1]), np.array([0.2, 0.7, 1.0, 0.5, 50.0]), 3.0
    expected = truncnorm(-centre / sd, (upper - centre) / sd, centre, sd).std()
    found = jax.jit(truncated_sd)(jnp.asarray(centre), jnp.asarray(sd), jnp.full(5, upper))
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_a_gap_is_known_as_well_as_its_dense_posterior_says():
    segment = known_segment(1e-2)
    found = judge(segment, DELTA)
    # A is compared with derivatives of the strapdown in test_segment.
    _, _, columns = COLUMNS(DELTA, condense(segment), problems.GRAVITY)
    A = np.stack(columns, axis=1)[:6]
    hessian = A @ A.T
    precision = np.asarray(segment.known.precision)[:6, :6]
    before, after = np.linalg.inv(precision), np.linalg.inv(precision + hessian)
    pair = np.array([1.0, 1, 0, 0, 0, 0])
    np.testing.assert_allclose(found.gap_sd[0], np.sqrt(pair @ after @ pair), rtol=1e-9)
    share = 1 - (pair @ after @ pair) / (pair @ before @ pair)
    assert found.identified[0] == found.identified[1] == pytest.approx(share, abs=1e-9)
    assert not np.asarray(found.sd[6:]).any() and not np.asarray(found.identified[6:]).any()


def test_without_a_rest_the_prior_decides():
    segment = eqx.tree_at(lambda s: s.arrival, known_segment(1.0), jnp.zeros((10, 10)))
    found = judge(segment, DELTA)
    np.testing.assert_allclose(found.identified, 0.0, atol=1e-12)
    prior = np.linalg.inv(np.asarray(segment.known.precision))
    np.testing.assert_allclose(found.gap_sd[0], np.sqrt(prior[:2, :2].sum()), rtol=1e-9)


def test_intervals_of_the_bar_cover_its_truth():
    """Impulse and samples of the gap, over seeds: what is said to be known is known that well."""
    impulses, samples = [], []
    for seed in range(12):
        recording, truth = bar(seed, gyr_rail=7.5)
        found = estimate(recording, load_config(None, method="map", **BAR))
        gap = gaps_table(found).iloc[0]
        lost = (truth.signal - recording.signal)[truth.saturated].sum() * recording.period
        impulses.append((gap["impulse"] - lost) / gap["impulse_sd"])
        where = truth.saturated
        samples.append((found.filled - truth.signal)[where] / found.signal_sd[where])
        assert gap["identified"] > 0.9 and gap["peak_sd"] > 0.0
    assert np.max(np.abs(impulses)) < norm.ppf(1 - 1e-5)
    assert np.mean(np.abs(samples) < norm.ppf(0.95)) > 0.8
