"""Attitude by the smoother of a motion that stays about its place: what it holds, and how sure it says it is."""

import equinox as eqx
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.inertial.bounded import ROW_EVERY, bounded_attitude
from jaxsat.inertial.orientation import Start
from jaxsat.inertial.strapdown import Samples

RATE, G, N = 100.0, 9.81, 3000
NOISE = np.repeat([7e-4, 7e-3], 3) * np.sqrt(RATE)
compiled = eqx.filter_jit(bounded_attitude)


def hand(seed):
    """A hand that swings about its place: attitude, and what a sensor reads of it."""
    rng = np.random.default_rng(seed)
    t = np.arange(N + 1) / RATE
    f, phase = rng.uniform(0.2, 1.2, (6, 5)), rng.uniform(0, 2 * np.pi, (6, 5))
    waves = np.sin(2 * np.pi * f[..., None] * t + phase[..., None]).sum(axis=1) / np.sqrt(5)
    attitude = Rotation.from_rotvec(0.8 * waves[:3].T)
    velocity = 0.5 * waves[3:].T
    force = np.diff(velocity, axis=0) * RATE + [0, 0, G]
    turned = (attitude[:-1].inv() * attitude[1:]).as_rotvec()
    # A specific force holds in the middle of its sample.
    middle = attitude[:-1] * Rotation.from_rotvec(0.5 * turned)
    signal = np.concatenate([turned * RATE, middle.inv().apply(force)], axis=1)
    return attitude, signal + NOISE * rng.normal(size=signal.shape)


def smoothed(attitude, signal, variance, tilt_sd=0.005, velocity_sd=0.01):
    q = attitude[0].as_quat(scalar_first=True)
    samples = Samples(jnp.asarray(signal), jnp.full(N, 1 / RATE), jnp.asarray(variance))
    start = Start(jnp.asarray(q), jnp.zeros(3), jnp.asarray(G))
    numbers = (tilt_sd, velocity_sd, round(ROW_EVERY * RATE), 1)
    return compiled(samples, start, *(jnp.asarray(x) for x in numbers))


def inclination(attitude, found):
    """Angle between the true and the found vertical (rad), and its sd."""
    turn = Rotation.from_quat(np.asarray(found.state.q_nb), scalar_first=True) * attitude.inv()
    sd = np.sqrt(np.asarray(found.covariance)[:, [0, 1], [0, 1]].sum(axis=1))
    return np.arccos(np.clip(turn.as_matrix()[:, 2, 2], -1, 1)), sd


@pytest.fixture(scope="module")
def whole():
    variance = np.tile(NOISE**2, (N, 1))
    return [inclination(a, smoothed(a, s, variance, velocity_sd=1.0)) for a, s in map(hand, range(3))]


def test_the_vertical_is_held_as_well_as_is_said(whole):
    error, sd = (np.sqrt(np.mean(np.square(x))) for x in zip(*whole, strict=True))
    assert error < np.deg2rad(0.3) and 0.05 < error / sd < 1


def test_what_a_gap_loses_comes_back_and_is_said():
    """Half a second of rates that are off by 40 degrees in all, and known to be."""
    ratio, late = [], []
    for seed in range(3):
        attitude, signal = hand(seed)
        gap = slice(1400, 1450)
        lost = np.deg2rad(40.0)
        signal[gap, 0] += lost * RATE / 50
        variance = np.tile(NOISE**2, (N, 1))
        variance[gap, 0] += (lost * RATE) ** 2 / 50
        error, sd = inclination(attitude, smoothed(attitude, signal, variance, velocity_sd=1.0))
        ignorant, _ = inclination(
            attitude, smoothed(attitude, signal, np.tile(NOISE**2, (N, 1)), velocity_sd=1.0)
        )
        assert error[1000:2000].max() < 0.3 * ignorant[1000:2000].max()
        ratio.append(error[1400:1500] / sd[1400:1500])
        late.append(error[2500:])
        assert sd[1425] > 3 * np.median(sd)
    assert np.sqrt(np.mean(np.square(ratio))) < 2 and np.max(late) < np.deg2rad(2)


def test_a_start_in_motion_at_a_wrong_attitude_is_corrected():
    attitude, signal = hand(4)
    wrong = Rotation.from_rotvec([0.04, -0.03, 0.0]) * attitude
    found = smoothed(wrong, signal, np.tile(NOISE**2, (N, 1)), tilt_sd=0.05, velocity_sd=3.0)
    error, sd = inclination(attitude, found)
    assert error[0] < 0.02 and sd[0] < 0.03


def test_blank_samples_change_nothing():
    attitude, signal = hand(5)
    n = 2000
    variance = np.tile(NOISE**2, (N, 1))
    short = np.where(np.arange(N) < n, 1 / RATE, 0.0)
    start = Start(jnp.asarray(attitude[0].as_quat(scalar_first=True)), jnp.zeros(3), jnp.asarray(G))
    numbers = tuple(jnp.asarray(x) for x in (0.005, 1.0, round(ROW_EVERY * RATE), 1))

    def run(signal):
        return compiled(
            Samples(signal, jnp.asarray(short), jnp.asarray(variance)), start, *numbers
        ).state.q_nb

    other = signal.copy()
    other[n:] = 5.0
    a, b = run(jnp.asarray(signal)), run(jnp.asarray(other))
    np.testing.assert_allclose(a[: n + 1], b[: n + 1], atol=1e-12)
