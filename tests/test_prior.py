"""The signal prior: learned from what it may see, and its quadratic form against the energy written out."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxsat.saturation.experience import NODES, Experience
from jaxsat.saturation.prior import (
    CREDIT,
    LEAST_LEVEL,
    LEAST_ROUGHNESS,
    ORDER,
    PEAKS,
    Known,
    Scales,
    SignalPrior,
    hidden_peaks,
    learn,
    of_values,
    quadratic_form,
    roughness,
)

N = 3000
PERIOD = jnp.asarray(0.01)
# Poles well inside the circle, so that the second difference is stationary.
PHI = -np.poly([0.8 * np.exp(0.5j), 0.8 * np.exp(-0.5j), 0.6, -0.4]).real[1:]
SIGMA = np.array([0.1, 0.2, 0.3, 1.0, 2.0, 3.0])
LEARN = jax.jit(learn)
SCALES = Scales(jnp.asarray(0.5), jnp.asarray(0.3))


def filter_of(phi) -> np.ndarray:
    """a of a ∗ x = white noise."""
    return np.convolve([1.0, -2.0, 1.0], np.concatenate([[1.0], -np.asarray(phi)]))


@pytest.fixture(scope="module")
def walk() -> np.ndarray:
    """Six integrated autoregressions of the module's order."""
    assert len(PHI) == ORDER
    noise = SIGMA * np.random.default_rng(3).normal(size=(N, 6))
    second = np.zeros((N, 6))
    for k in range(ORDER, N):
        second[k] = noise[k] + sum(PHI[i] * second[k - 1 - i] for i in range(ORDER))
    return np.cumsum(np.cumsum(second, axis=0), axis=0)


def learned(signal, sign=None, clean=None, moving=None) -> SignalPrior:
    sign = np.zeros((N, 6), int) if sign is None else sign
    clean = (sign == 0) if clean is None else clean
    moving = np.ones(N, bool) if moving is None else moving
    return LEARN(*map(jnp.asarray, (signal, sign, clean, moving)), PERIOD, SCALES)


def test_the_process_that_made_a_signal_is_learned(walk):
    """Of channels that have nothing to do with each other nothing is made of the others."""
    found = learned(walk)
    np.testing.assert_allclose(found.predictor, np.tile(filter_of(PHI), (6, 1)), atol=0.4)
    assert np.abs(filter_of(PHI) - filter_of(np.zeros(ORDER))).max() > 2.0
    level = np.median(1.0 / np.asarray(found.weight), axis=0)
    np.testing.assert_allclose(level, SIGMA**2, rtol=0.2)
    assert (np.std(found.mean, axis=0) < 0.2 * SIGMA).all()


def test_what_goes_with_the_other_channels_is_expected(walk):
    """Second differences of one channel are another's, and noise."""
    second = np.diff(walk, 2, axis=0, prepend=np.zeros((2, 6)))
    driven = walk.copy()
    noise = 0.2 * np.random.default_rng(7).normal(size=N)
    driven[:, 2] = np.cumsum(np.cumsum(second[:, 4] + noise))
    before, found = learned(walk), learned(driven)
    # The mean is that of an innovation: what the channel's own past does not predict.
    x = driven[:, 2]
    innovation = np.convolve(x, found.predictor[2], "full")[:N]
    inside = slice(20, N - 20)
    left = (innovation - found.mean[:, 2])[inside]
    assert np.std(left) == pytest.approx(0.2, rel=0.25)
    assert np.std(left) < 0.2 * np.std(second[:, 4])
    # Nothing else has changed much; the channel speaks to the others, too.
    np.testing.assert_allclose(found.predictor[0], before.predictor[0], atol=0.1)


def test_saturated_and_resting_samples_of_a_channel_say_nothing_of_it(walk):
    sign = np.zeros((N, 6), int)
    sign[500:520], sign[1500:1510, 2] = 1, -1
    clean = sign == 0
    clean[900:910, 4] = False
    moving = np.ones(N, bool)
    moving[2000:2300] = False
    hidden = ~clean | ~moving[:, None]
    expected, noise = (
        learned(walk, sign, clean, moving),
        1e3 * np.random.default_rng(0).normal(size=walk.shape),
    )
    for channel in (2, 4):
        mine = hidden & (np.arange(6) == channel)
        found = learned(np.where(mine, noise, walk), sign, clean, moving)
        np.testing.assert_allclose(found.predictor[channel], expected.predictor[channel], rtol=1e-9)
        # Where the rail is, saturated values do say.
        found = learned(np.where(mine & (sign == 0), noise, walk), sign, clean, moving)
        np.testing.assert_allclose(found.excess[channel], expected.excess[channel], rtol=1e-9)
        np.testing.assert_array_equal(found.harmful[channel], expected.harmful[channel])
        seen = learned(np.where(mine, noise, walk))
        assert np.median(seen.weight[:, channel]) < 0.1 * np.median(expected.weight[:, channel])


def test_recordings_side_by_side_are_those_one_by_one(walk):
    both = jnp.stack([jnp.asarray(walk), jnp.asarray(walk[::-1] + 1.0)])
    sign, moving = jnp.zeros((N, 6), int), jnp.ones(N, bool)
    found = jax.jit(jax.vmap(lambda x: learn(x, sign, sign == 0, moving, PERIOD, SCALES)))(both)
    for i, signal in enumerate(both):
        one = learned(signal)
        for a, b in zip(jax.tree.leaves(one), jax.tree.leaves(found), strict=True):
            np.testing.assert_allclose(b[i], a, rtol=1e-7)


# Neighbours in one channel, one apart, one alone in another channel, and two padded ones.
SAMPLE, CHANNEL = np.array([30, 31, 32, 35, 32, 0, 0]), np.array([1, 1, 1, 1, 4, 0, 0])
SIGN, M = np.array([-1.0, -1.0, -1.0, 1.0, -1.0, 0.0, 0.0]), 7
GAP, LENGTH = np.array([0, 0, 0, 1, 2, 6, 6]), np.array([3.0, 3.0, 3.0, 1.0, 1.0, 0.0, 0.0])
SHORT = np.random.default_rng(5).normal(size=(60, 6)) + 3.0
OF_VALUES, FORM = jax.jit(of_values), jax.jit(quadratic_form)


@pytest.fixture(scope="module")
def prior() -> SignalPrior:
    nodes, rng = (6, len(NODES)), np.random.default_rng(6)
    # Innovations as large as they come, and not about zero.
    weight = rng.uniform(0.3, 3.0, size=SHORT.shape) / SIGMA**2
    told = np.tile(filter_of(PHI), (6, 1)), SIGMA * rng.normal(size=SHORT.shape), weight
    return SignalPrior(
        SCALES, *map(jnp.asarray, told), jnp.ones(nodes), jnp.zeros(nodes, bool), Experience.none()
    )


def known(prior, signal=SHORT, sample=SAMPLE, channel=CHANNEL, sign=SIGN) -> Known:
    given = signal, sample, channel, sign, GAP[: len(sign)]
    return OF_VALUES(prior, *map(jnp.asarray, given))


def form(prior) -> tuple[np.ndarray, np.ndarray]:
    given = SHORT, SAMPLE, CHANNEL, SIGN, LENGTH
    return tuple(map(np.asarray, FORM(prior, *map(jnp.asarray, given))))


def below(found, sd=1.0) -> np.ndarray:
    """How far below the rail values are put, in so many times their sd; one if it is less."""
    mean = -np.asarray(found.covariance @ found.slope)
    sd = sd * np.sqrt(np.diagonal(found.covariance))
    return np.where(SIGN != 0, np.maximum(-mean / sd, 1.0), 1.0)


def energy(prior, delta) -> float:
    """½ Σ (a ∗ x − m)²/σ² of the filled signal, and the pull of each gap's values to their rail."""
    real = SIGN != 0
    filled = SHORT.copy()
    np.add.at(filled, (SAMPLE[real], CHANNEL[real]), (SIGN * delta)[real])
    left = np.stack([np.convolve(x, filter_of(PHI), "valid") for x in filled.T], axis=1)
    first = len(SHORT) - len(left)
    left = left - np.asarray(prior.mean)[first:]
    rail = np.abs(SHORT[SAMPLE, CHANNEL])[real]
    pull = np.sum((delta[real] / (SCALES.width * rail)) ** 2 / LENGTH[real])
    return 0.5 * np.sum(left**2 * np.asarray(prior.weight)[first:]) + 0.5 * pull


def test_the_quadratic_form_is_the_energy_of_the_filled_signal(prior):
    (precision, linear), E = form(prior), np.eye(M)

    def cost(delta):
        return energy(prior, delta)

    slope = [(cost(e) - cost(-e)) / 2 for e in E]
    real = SIGN != 0
    np.testing.assert_allclose(linear, slope, atol=1e-8 * np.abs(slope).max())
    curvature = np.array([[cost(a + b) - cost(a) - cost(b) + cost(0 * a) for b in E] for a in E])
    expected = curvature + np.diag(np.where(real, 0.0, 1.0))
    np.testing.assert_allclose(precision, expected, atol=1e-8 * np.abs(expected).max())
    assert np.linalg.eigvalsh(precision).min() > 0.0


def test_the_scale_of_what_a_gap_lost_is_known_to_a_share(prior):
    """The same best values; to their covariance comes, gap by gap, a common factor of that sd."""
    found, (precision, slope) = known(prior), form(prior)
    within = np.linalg.inv(precision)
    mean = -within @ slope
    fill = np.where(SIGN != 0, np.maximum(mean, 0.0), 0.0)
    assert (fill[SIGN != 0] > 0.0).any()
    expected = within + SCALES.share**2 * np.where(np.equal.outer(GAP, GAP), np.outer(fill, fill), 0.0)
    np.testing.assert_allclose(found.covariance, expected, atol=1e-9)
    np.testing.assert_allclose(found.precision @ expected, np.eye(M), atol=1e-7)
    np.testing.assert_allclose(np.linalg.solve(found.precision, -np.asarray(found.slope)), mean, atol=1e-8)
    assert expected[0, 1] > within[0, 1] and expected[0, 3] == within[0, 3]


def test_padded_values_have_no_effect(prior):
    found, bare = known(prior), known(prior, sample=SAMPLE[:5], channel=CHANNEL[:5], sign=SIGN[:5])
    np.testing.assert_allclose(found.precision[:5, :5], bare.precision, rtol=1e-9, atol=1e-9)
    np.testing.assert_allclose(found.slope[:5], bare.slope, rtol=1e-9)
    # Even where they lie on a real one, or behind the end.
    moved = SAMPLE.copy()
    moved[5:] = 31, 200
    again = known(prior, sample=moved, channel=np.array([*CHANNEL[:5], 1, 1]))
    for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    np.testing.assert_array_equal(found.precision[5:], np.eye(M)[5:])
    assert not np.asarray(found.slope[5:]).any()


def test_the_variance_of_a_value_is_that_of_the_prior_alone(prior):
    """Drawn from the precision: sample variances agree within their own uncertainty."""
    found = known(prior)
    variance = np.asarray(found.variance) / below(found) ** 2
    root = np.linalg.cholesky(np.asarray(found.precision))
    draws = np.linalg.solve(root.T, np.random.default_rng(2).normal(size=(M, 20_000)))
    np.testing.assert_allclose(draws.var(axis=1)[SIGN != 0], variance[SIGN != 0], rtol=0.06)


def test_the_mode_of_a_gap_is_the_most_probable_signal(prior):
    """Without rests the prior alone interpolates: minimising Ω, b gives back the least energy."""
    found = known(prior)
    best = np.linalg.solve(found.precision, -np.asarray(found.slope))
    rng = np.random.default_rng(1)
    others = [best + 0.1 * rng.normal(size=M) * (SIGN != 0) for _ in range(20)]
    assert all(energy(prior, best) < energy(prior, other) for other in others)
    assert eqx.tree_equal(found, known(prior))


HIDDEN = jax.jit(hidden_peaks)


def hidden_errors(x, ok, rail, told, length, way) -> list[tuple[float, float, float, float]]:
    """Squared errors if filled and if cut off, variance and weight of the highest peaks of so many samples.

    told: a, and mean and weight of each innovation. Written out as the least energy of the whole signal.
    """
    predictor, mean, weight = told
    reach, found = len(predictor) - 1, []
    shift = np.zeros((len(x), len(x)))
    for lag, a in enumerate(predictor):
        shift += a * np.eye(len(x), k=-lag)
    weight = np.where(np.arange(len(x)) < reach, 0.0, weight)
    for i in range(reach + 1, len(x) - length - reach):
        inside, y = np.arange(i, i + length), way * x.copy()
        level = max(y[i - 1], y[i + length])
        if not ok[i - reach : i + length + reach].all() or level <= LEAST_LEVEL * rail:
            continue
        if y[inside].min() <= level:
            continue
        lost, top = np.sum(y[inside] - level), y[inside].max()
        y[inside] = level
        moved = shift[:, inside]
        own = moved.T @ (weight[:, None] * moved) + np.eye(length) / ((SCALES.width * rail) ** 2 * length)
        filled = np.linalg.solve(own, -moved.T @ (weight * (shift @ y - way * mean))).sum()
        variance, filled = np.linalg.inv(own).sum(), max(filled, 0.0)
        found.append(
            ((filled - lost) ** 2, lost**2, variance + (SCALES.share * filled) ** 2, (top / rail) ** 4)
        )
    return sorted(found, key=lambda peak: -peak[3])[:PEAKS]


def test_hidden_peaks_are_filled_one_by_one():
    """Against each peak cut off and filled by dense algebra; there are more than are looked at."""
    rng = np.random.default_rng(8)
    x = rng.normal(size=400).cumsum() + 3.0 * np.sin(np.arange(400) / 7.0)
    ok, rail = np.ones(400, bool), 6.0
    ok[120:130] = False
    told = filter_of(PHI), 0.5 * rng.normal(size=400), rng.uniform(0.3, 3.0, size=400)
    found = HIDDEN(*map(jnp.asarray, (x, ok, rail, *told)), SCALES)
    seen = []
    for length, excess, harmful in zip(NODES, *found, strict=True):
        each = [hidden_errors(x, ok, rail, told, length, way) for way in (1.0, -1.0)]
        seen += map(len, each)
        peaks = np.array(each[0] + each[1]).reshape(-1, 4)
        filled, cut = (np.sum(peaks[:, k] / peaks[:, 2] * peaks[:, 3]) + CREDIT for k in (0, 1))
        assert excess == pytest.approx(filled / (peaks[:, 3].sum() + CREDIT), rel=1e-8)
        assert harmful == (filled - CREDIT > cut)
    assert max(seen) == PEAKS and sum(seen) > 20 and 0 < np.sum(found[1]) < len(NODES)


def test_a_prior_that_is_right_is_believed_and_one_that_is_surprised_is_not():
    """A rhythm that the prior learns; then with impacts of one sample that nothing announces."""
    rng, time = np.random.default_rng(9), np.arange(N)
    calm = np.stack([5.0 * np.sin(time / 6.0 + k) for k in range(6)], axis=1)
    calm = calm + 1e-2 * rng.normal(size=calm.shape)
    struck = calm.copy()
    struck[40::37] += np.where(struck[40::37] > 0.0, 4.0, -4.0)
    sign = np.zeros((N, 6), int)
    sign[::1000] = 1
    one = NODES.index(1)
    assert (learned(calm, sign).excess[:, one] < 2.0).all()
    assert (learned(struck, sign).excess[:, one] > 1.5).all()


def test_what_was_far_off_is_believed_less_but_filled_alike(prior):
    """A channel whose hidden peaks were off by twice the sd has four times the variance, and the same mode."""
    found = known(prior)
    doubted = known(eqx.tree_at(lambda p: p.excess, prior, prior.excess.at[1].set(4.0)))
    sure = known(eqx.tree_at(lambda p: p.excess, prior, prior.excess.at[1].set(0.1)))
    np.testing.assert_array_equal(sure.believed, found.believed)
    np.testing.assert_array_equal(doubted.precision, found.precision)
    np.testing.assert_array_equal(doubted.slope, found.slope)
    sd = np.where((CHANNEL == 1) & (SIGN != 0), 2.0, 1.0)
    np.testing.assert_array_equal(doubted.covariance, found.covariance)
    sd = sd * below(found, sd)
    np.testing.assert_allclose(doubted.believed, np.outer(sd, sd) * found.covariance, atol=1e-9)
    np.testing.assert_allclose(doubted.variance, np.where(SIGN != 0, np.diagonal(doubted.believed), 0.0))


def test_what_would_be_worse_filled_is_marked_by_channel_and_length(prior):
    """What such a value may have lost is its square in the mean: variance and mean of the prior."""
    harmful = prior.harmful.at[1, NODES.index(1)].set(True)
    found = known(eqx.tree_at(lambda p: p.harmful, prior, harmful))
    np.testing.assert_array_equal(found.harmful, (LENGTH == 1) & (CHANNEL == 1) & (SIGN != 0))
    mean = np.linalg.solve(found.precision, -np.asarray(found.slope))
    variance = np.diagonal(np.linalg.inv(found.precision)) * below(found) ** 2
    expected = np.where(SIGN != 0, variance + np.where(found.harmful, mean**2, 0.0), 0.0)
    np.testing.assert_allclose(found.variance, expected, rtol=1e-8)


def test_a_value_put_below_the_rail_is_believed_to_be_off_by_as_much(prior):
    """Pushed down by means of innovations; the mode and its own covariance do not mind."""
    pushed = eqx.tree_at(lambda p: p.mean, prior, prior.mean.at[:, 1].add(6.0))
    found = known(pushed)
    times = below(found)
    assert (times > 1.5).any() and (times[SIGN != 0] == 1.0).any()
    np.testing.assert_allclose(found.believed, np.outer(times, times) * found.covariance, atol=1e-9)


def test_roughness_is_told_by_the_other_channels():
    """Written out, sample by sample; where none of them is sound it is one."""
    rng, half = np.random.default_rng(4), 3
    x = np.cumsum(np.cumsum(rng.normal(size=(120, 6)) * rng.uniform(0.1, 3.0, size=(120, 1)), axis=0), axis=0)
    sound, near = rng.random((120, 6)) < 0.9, rng.random((120, 6)) < 0.5
    sound[40:60] = False
    sound[52, 2] = sound[51, 2] = sound[53, 2] = True
    second = x[2:] - 2.0 * x[1:-1] + x[:-2]
    square = {}
    for t in range(1, 119):
        for j in range(6):
            if sound[t - 1 : t + 2, j].all():
                square[t, j] = second[t - 1, j] ** 2
    expected = np.ones((120, 6))
    for c in range(6):
        usual = [
            np.mean([square[t, j] for t in range(120) if (t, j) in square and near[t, c]]) for j in range(6)
        ]
        for t in range(120):
            told = []
            for j in set(range(6)) - {c}:
                about = [square[u, j] for u in range(t - half, t + half + 1) if (u, j) in square]
                told += [np.mean(about) / usual[j]] if about else []
            expected[t, c] = max(np.mean(told), LEAST_ROUGHNESS) if told else 1.0
    found = jax.jit(roughness)(*map(jnp.asarray, (x, sound, near, half)))
    # An innovation is that of a second difference about the sample before it.
    np.testing.assert_allclose(found[1:], expected[:-1], rtol=1e-9)
    assert (expected[45:48] == 1.0).all() and expected[52, 0] != 1.0 == expected[52, 2]


def test_variances_follow_those_of_the_other_channels(walk):
    """Where those of all channels grow a hundredfold, so does that of each innovation."""
    loud = np.where(np.arange(N) >= N // 2, 10.0, 1.0)[:, None]
    second = np.diff(walk, 2, axis=0, prepend=np.zeros((2, 6)))
    sign = np.zeros((N, 6), int)
    sign[50::100] = 1
    found = learned(np.cumsum(np.cumsum(loud * second, axis=0), axis=0), sign)
    calm, wild = np.asarray(found.weight[200:1400]), np.asarray(found.weight[1600:2800])
    np.testing.assert_allclose(np.median(calm, axis=0) / np.median(wild, axis=0), 100.0, rtol=0.15)
