"""What gaps teach of gaps like them, against the formulas written out and dense algebra."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsat.saturation.experience import (
    NODES,
    NOTHING,
    POWER,
    Experience,
    Habit,
    Heard,
    experienced,
    habit,
    with_habit,
)

N, CHANNEL, LENGTH = 2400, 1, 16
NODE = NODES.index(LENGTH)
LEARN, HABIT = jax.jit(experienced), jax.jit(habit)


def gaps_of(rates, sd, expected=0.0) -> tuple[np.ndarray, Heard]:
    """One after the other in one channel, all as long, and what was heard of each."""
    sign, scale = np.zeros((N, 6), int), LENGTH**POWER
    heard = Heard(np.zeros((N, 6)), np.full((N, 6), np.inf), np.zeros((N, 6)))
    for i, (rate, error) in enumerate(zip(rates, sd, strict=True)):
        at = slice(10 + 40 * i, 10 + 40 * i + LENGTH), CHANNEL
        sign[at], heard.sum[at], heard.variance[at] = 1, rate * scale, (error * scale) ** 2
        heard.expected[at] = expected * scale
    return sign, heard


def learn(sign, heard, asked=(np.nan,), before=None) -> Experience:
    return LEARN(
        before or Experience.none(), jnp.asarray(sign), jax.tree.map(jnp.asarray, heard), jnp.array(asked)
    )


@pytest.fixture(scope="module")
def sample() -> tuple[np.ndarray, np.ndarray]:
    """Rates that differ by 0.3 about 2, each heard with an sd of its own, of the last ten next to nothing."""
    rng = np.random.default_rng(2)
    sd = np.concatenate([rng.uniform(0.05, 0.4, 45), np.full(10, 50.0)])
    return 2.0 + np.hypot(0.3, sd) * rng.normal(size=55), sd


def test_mean_and_spread_are_those_of_random_effects(sample):
    rates, sd = sample
    found = learn(*gaps_of(rates, sd, expected=0.5))
    weight = 1.0 / sd**2
    fixed = weight @ rates / weight.sum()
    excess = weight @ (rates - fixed) ** 2 - (len(rates) - 1)
    spread = excess / (weight.sum() - weight @ weight / weight.sum())
    weight = 1.0 / (spread + sd**2)
    at = CHANNEL, 0, NODE
    mean = weight @ rates / weight.sum()
    assert found.spread[at] == pytest.approx(spread + 1.0 / weight.sum(), rel=1e-8)
    assert found.mean[at] == pytest.approx(mean, rel=1e-8)
    assert found.count[at] == pytest.approx(np.sum(mean**2 / (mean**2 + sd**2)), rel=1e-8)
    missed = weight @ ((rates - 0.5) ** 2 - sd**2) / weight.sum()
    assert found.miss[at] == pytest.approx(missed, rel=1e-8)
    # Of what made them, too; and nothing of any other kind.
    assert found.mean[at] == pytest.approx(2.0, abs=0.15) and np.sqrt(spread) == pytest.approx(0.3, abs=0.1)
    assert 40 < found.count[at] < 46
    assert np.count_nonzero(found.count) == np.count_nonzero(found.mean) == 1


def test_gaps_that_lose_alike_say_so():
    """Their differences are within what is heard of each: no spread, and a further one is known like their mean."""
    found = learn(*gaps_of([2.0, 2.01, 1.99, 2.0], [0.1] * 4))
    assert found.spread[CHANNEL, 0, NODE] == pytest.approx(0.1**2 / 4)
    assert found.count[CHANNEL, 0, NODE] == pytest.approx(4.0, abs=0.02)


def test_gaps_of_which_nothing_is_heard_teach_nothing(sample):
    sign, heard = gaps_of(*sample)
    deaf = eqx.tree_at(lambda h: h.variance, heard, np.full((N, 6), np.inf))
    for a, b in zip(jax.tree.leaves(learn(sign, deaf)), jax.tree.leaves(Experience.none()), strict=True):
        np.testing.assert_array_equal(a, b)


def test_the_noise_is_what_most_motions_ask_for_and_never_less_than_the_sensors():
    sign, heard = gaps_of([], [])
    first = learn(sign, heard, (np.nan, 2.0, 3.0, 90.0))
    assert first.noise == 3.0
    assert learn(sign, heard, (0.1, np.nan)).noise == learn(sign, heard, (np.nan, np.nan)).noise == 1.0
    # Once is enough.
    for factors in ((0.1, 0.5), (5.0, 9.0), (np.nan, np.nan)):
        assert learn(sign, heard, factors, first).noise == 3.0


def told(count: float, mean: float = 2.0, spread: float = 0.09) -> Habit:
    """Of a gap of the kind, one twice as long, of which nothing is known, and none."""
    nothing = jnp.zeros((6, 2, len(NODES)))
    at = CHANNEL, 0, NODE
    known = Experience(*(nothing.at[at].set(x) for x in (count, mean, spread, 4.0)), jnp.ones(()))
    kind = jnp.full(3, CHANNEL), jnp.array([1.0, 1.0, 0.0]), jnp.array([LENGTH, 2.0 * LENGTH, 0.0])
    return HABIT(known, *kind)


def test_the_fewer_others_there_are_the_less_they_say():
    scale = LENGTH**POWER
    for count in (2.0, 30.0):
        found = told(count)
        np.testing.assert_allclose(found.sum, [2.0 * scale, 0.0, 0.0])
        expected = (0.09 + (0.09 + 4.0) / (count - 1.0)) * scale**2
        np.testing.assert_allclose(found.variance, [expected, NOTHING, NOTHING])
        np.testing.assert_allclose(found.miss, [4.0 * scale**2 * (count - 1.0) / count, 0.0, 0.0])
    # One that is alone of its kind has no others.
    np.testing.assert_array_equal(told(1.0).variance, NOTHING)


def test_values_given_the_sums_of_their_gaps_are_those_of_dense_algebra():
    rng = np.random.default_rng(6)
    root, mean = rng.normal(size=(5, 5)), rng.normal(size=5)
    covariance = root @ root.T + np.eye(5)
    gaps = np.array([[1, 0, 0], [1, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, 0.0]])
    known = Habit(*map(jnp.asarray, (np.array([3.0, -1.0, 0.0]), np.array([0.5, 2.0, NOTHING]), np.zeros(3))))
    found = jax.jit(with_habit)(*map(jnp.asarray, (mean, covariance, gaps)), known)
    precision = np.linalg.inv(covariance)
    after = np.linalg.inv(precision + gaps[:, :2] @ np.diag([2.0, 0.5]) @ gaps[:, :2].T)
    np.testing.assert_allclose(found[1], after, atol=1e-9)
    np.testing.assert_allclose(found[0], after @ (precision @ mean + gaps[:, :2] @ [6.0, -0.5]), atol=1e-9)


def test_a_signal_that_was_further_off_than_it_claimed_yields():
    """The variance of a sum is raised to the square of the misses; what is beyond the sum keeps its own."""
    covariance, gaps = np.array([[2.0, 0.5], [0.5, 1.0]]), np.ones((2, 1))
    known = Habit(*map(jnp.asarray, (np.zeros(1), np.full(1, NOTHING), np.array([16.0]))))
    _, found = jax.jit(with_habit)(jnp.zeros(2), jnp.asarray(covariance), jnp.asarray(gaps), known)
    assert np.sum(found) == pytest.approx(16.0, rel=1e-6)
    # Given the sum, the rest of the values is as it was.
    for matrix in (covariance, np.asarray(found)):
        column = matrix.sum(axis=1)
        rest = matrix - np.outer(column, column) / matrix.sum()
        np.testing.assert_allclose(rest, [[0.4375, -0.4375], [-0.4375, 0.4375]], atol=1e-6)
