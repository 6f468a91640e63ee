"""What is said about filled values: against SciPy, against a dense posterior, and against the truth over seeds."""

from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import problems
import pytest
from scipy.linalg import eigh
from scipy.stats import norm
from test_pipeline import BAR, bar
from test_segment import DELTA, build

from jaxsat.config import load_config
from jaxsat.pipeline import estimate
from jaxsat.present.tables import gaps_table, segments_table
from jaxsat.saturation.arrival import own_misfit
from jaxsat.saturation.prior import Known
from jaxsat.saturation.segment import condense, value_and_root, value_gradient_root
from jaxsat.saturation.truncated import truncated_moments
from jaxsat.saturation.uncertainty import CREDIT, LEAST_HEARD, LEAST_SEEN, uncertainty

COLUMNS, JUDGE = jax.jit(value_gradient_root), jax.jit(uncertainty)
MOMENTS = jax.jit(truncated_moments)


@jax.jit
def judge(segment, delta, left=0.0):
    """left: of f(δ) there, beyond what the rest costs by itself; nothing, unless it is said."""
    known = segment.known
    condensed = condense(segment)
    _, slope, _ = value_gradient_root(delta, condensed, problems.GRAVITY)
    _, columns, effects = value_and_root(delta, condensed, problems.GRAVITY)
    pull = known.precision @ delta
    value = left + own_misfit(segment.arrival) + delta @ (known.slope + 0.5 * pull)
    return uncertainty(segment, delta, value, slope + known.slope + pull, columns, effects)


def known_segment(scale: float):
    """Six values in two gaps, with a random prior."""
    root = np.random.default_rng(0).normal(size=(6, 6))
    precision = np.eye(8)
    precision[:6, :6] = (root @ root.T + np.eye(6)) * scale
    covariance = jnp.asarray(np.linalg.inv(precision))
    prior = Known(
        precision=jnp.asarray(precision),
        slope=jnp.zeros(8),
        covariance=covariance,
        believed=covariance,
        expected=jnp.zeros(8),
        alone=jnp.zeros(8),
        variance=jnp.diagonal(covariance),
        harmful=jnp.zeros(8, bool),
    )
    segment = build(False)
    gaps = jnp.array([0, 0, 1, 2, 3, 4, 7, 7])
    return eqx.tree_at(lambda s: (s.known, s.gap), segment, (prior, gaps), is_leaf=lambda x: x is None)


def within(segment, precision, pull):
    """Moments within the limits of the six values."""
    given = precision, pull, np.asarray(segment.bound)[:6], np.ones(6, bool)
    return map(np.asarray, MOMENTS(*map(jnp.asarray, given)))


PAIR = np.array([1.0, 1, 0, 0, 0, 0])


def about(mean, away, spread):
    """sd of values, and of the sum of the first two, about a mean that is not their own."""
    square = spread + np.outer(away - mean, away - mean)
    return np.sqrt(np.diagonal(square)), np.sqrt(PAIR @ square @ PAIR)


def dense(segment, factor=1.0):
    """By dense algebra: variance of the first gap's sum before and after, mean and sd of values, sd of that sum.

    Away from a mode the slope is large, and what it pushes to a limit agrees to five digits only.
    """
    # A is compared with derivatives of the strapdown in test_segment.
    _, slope, columns = COLUMNS(DELTA, condense(segment), problems.GRAVITY)
    A = np.stack(columns, axis=1)[:6]
    precision = np.asarray(segment.known.precision)[:6, :6]
    pull = A @ (A.T @ np.asarray(DELTA)[:6]) - np.asarray(slope)[:6]
    before, after = np.linalg.inv(precision), np.linalg.inv(precision + A @ A.T / factor)
    mean, _ = within(segment, precision + A @ A.T, pull)
    mean = np.clip(mean, 0.0, np.asarray(segment.bound)[:6])
    away, spread = within(segment, precision + A @ A.T / factor, pull / factor)
    return PAIR @ before @ PAIR, PAIR @ after @ PAIR, mean, *about(mean, away, spread)


def rank(segment):
    """Directions of δ in which the data say anything beside the prior, by the generalised eigenvalues."""
    _, _, columns = COLUMNS(DELTA, condense(segment), problems.GRAVITY)
    A = np.stack(columns, axis=1)[:6]
    return int(
        np.sum(eigh(A @ A.T, np.asarray(segment.known.precision)[:6, :6], eigvals_only=True) > LEAST_SEEN)
    )


def test_a_gap_is_known_as_well_as_its_dense_posterior_says():
    segment = known_segment(1e-2)
    found = judge(segment, DELTA)
    before, after, mean, sd, of_sum = dense(segment)
    np.testing.assert_allclose(found.mean[:6], mean, rtol=1e-4, atol=1e-4)
    np.testing.assert_allclose(found.sd[:6], sd, rtol=1e-4)
    np.testing.assert_allclose(found.gap_sd[:2], of_sum, rtol=1e-4)
    assert found.identified[0] == found.identified[1] == pytest.approx(1.0 - after / before, abs=1e-9)
    assert not np.asarray(found.sd[6:]).any() and not np.asarray(found.identified[6:]).any()
    assert found.rank == rank(segment)


def test_what_the_rests_say_is_the_posterior_without_the_prior():
    """Of the sum of a gap of which they say most; of one of which they say little nothing is passed on."""
    expected = jnp.where(jnp.arange(8) < 2, 0.3, 0.0)
    segment = eqx.tree_at(lambda s: s.known.expected, known_segment(1e-2), expected)
    found = judge(segment, DELTA)
    before, after, *_ = dense(segment)
    assert 1.0 - after / before > LEAST_HEARD
    variance = 1.0 / (1.0 / after - 1.0 / before)
    assert found.heard.variance[0] == pytest.approx(variance, rel=1e-6)
    product = after * (0.3 / before + found.heard.sum[0] / variance)
    assert product == pytest.approx(float(jnp.sum(DELTA[:2])), rel=1e-6)
    assert np.isinf(judge(known_segment(1e6), DELTA).heard.variance).all()


def test_data_that_leave_much_unexplained_are_believed_less():
    """Their variance is scaled by what is left at the mode, over the directions that δ does not take up."""
    segment = known_segment(1e-2)
    alike = judge(segment, DELTA)
    _, _, columns = COLUMNS(DELTA, condense(segment), problems.GRAVITY)
    A = np.stack(columns, axis=1)[:6]
    taken = np.linalg.eigvalsh(A.T @ np.linalg.solve(np.asarray(segment.known.precision)[:6, :6], A))
    free = np.sum(1.0 / (1.0 + taken))
    np.testing.assert_array_equal(judge(segment, DELTA, 0.5 * free).gap_sd, alike.gap_sd)
    for factor in (2.0, 5.0):
        found = judge(segment, DELTA, 0.5 * (factor * (free + CREDIT) - CREDIT))
        before, after, mean, sd, of_sum = dense(segment, factor)
        # What is filled in does not change.
        np.testing.assert_allclose(found.mean[:6], mean, rtol=1e-4, atol=1e-4)
        np.testing.assert_allclose(found.sd[:6], sd, rtol=1e-4)
        np.testing.assert_allclose(found.gap_sd[0], of_sum, rtol=1e-4)
        assert found.identified[0] == pytest.approx(1.0 - after / before, abs=1e-9)
        assert found.identified[0] < alike.identified[0]


def test_what_a_rest_costs_by_itself_is_the_least_over_all_arrivals():
    """Two directions are told by their sum only, as tilt and a turned gravity are."""
    rng = np.random.default_rng(4)
    root = rng.normal(size=(10, 12))
    root[6] = 0.5 * root[1]
    table = root @ root.T
    free = root[[0, 1, 2, 3, 4, 5, 7, 8]].T
    away = root[9] - free @ np.linalg.lstsq(free, root[9], rcond=None)[0]
    found = jax.jit(own_misfit)(jnp.asarray(table))
    assert found == pytest.approx(0.5 * away @ away, rel=1e-8)
    assert jax.jit(own_misfit)(jnp.zeros((10, 10))) == 0.0


def test_hidden_peaks_that_were_far_off_widen_what_is_known():
    """A prior about δ of one and of twice the sd, and no data."""
    plain, delta = known_segment(1.0), np.asarray(DELTA)[:6]
    plain = eqx.tree_at(lambda s: s.known.slope, plain, -plain.known.precision @ DELTA)
    doubted = eqx.tree_at(lambda s: s.known.believed, plain, 4.0 * plain.known.covariance)
    nothing = 6 * (jnp.zeros(8),)
    sd = []
    for segment, times in ((plain, 1.0), (doubted, 2.0)):
        found = JUDGE(segment, DELTA, jnp.zeros(()), jnp.zeros(8), nothing, nothing)
        precision = np.asarray(segment.known.precision)[:6, :6] / times**2
        mean, spread = within(segment, precision, precision @ delta)
        np.testing.assert_allclose(found.mean[:6], mean, rtol=1e-6)
        np.testing.assert_allclose(found.sd[:6], about(mean, mean, spread)[0], rtol=1e-6)
        sd.append(found.sd[:6])
    assert (sd[1] > sd[0]).all()


def test_what_is_not_filled_stays_as_it_is():
    """Neither does it limit the others, which then may be anything beside it."""
    segment = known_segment(1.0)
    harmful = eqx.tree_at(lambda s: s.known.harmful, segment, jnp.arange(8) == 2)
    delta = DELTA.at[2].set(0.0)
    found = judge(harmful, delta)
    assert found.mean[2] == 0.0 and found.sd[2] == pytest.approx(float(jnp.sqrt(segment.known.variance[2])))
    assert (np.asarray(found.mean)[[0, 1, 3, 4, 5]] > 0.0).all()


def test_without_a_rest_the_prior_decides():
    segment = eqx.tree_at(lambda s: s.arrival, known_segment(1.0), jnp.zeros((10, 10)))
    found = judge(segment, DELTA)
    np.testing.assert_allclose(found.identified, 0.0, atol=1e-12)
    np.testing.assert_allclose(found.arrival, 0.0, atol=1e-12)
    assert found.rank == 0
    *_, of_sum = dense(segment)
    np.testing.assert_allclose(found.gap_sd[0], of_sum, rtol=1e-4)


def test_the_rest_sees_turn_and_velocity_in_the_plane_of_the_bar():
    """About y in the plane of x and z: three directions; of a gap that no rest follows, none."""
    recording, truth = bar(0, gyr_rail=7.5)
    whole = segments_table(estimate(recording, load_config(None, method="map", **BAR)))
    assert list(whole["rank"]) == [3] and list(whole["seen"]) == ["att_y, vel_x, vel_z"]
    last = replace(recording, rest=truth.rest & (truth.time < 0.8))
    open_end = segments_table(estimate(last, load_config(None, method="map", **BAR)))
    assert list(open_end["rank"]) == [0] and list(open_end["seen"]) == [""]
    other = segments_table(estimate(recording, load_config(None, method="direct", **BAR)))
    assert other["rank"].isna().all() and other["seen"].isna().all()


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
