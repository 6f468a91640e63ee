"""Orientation: closed forms, the paper's equations, and what its options must and must not do."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.inertial.components import Vector
from jaxsat.inertial.orientation import (
    Attitude,
    Gains,
    Start,
    backward,
    dcm,
    ending,
    euler_angles,
    orientation,
    start_at_rest,
    turn,
    up_in_body,
)
from jaxsat.inertial.rotations import quat_exp

RATE, G = 100.0, 9.81
GAINS = Gains(0.5, 0.01, 2.5)
PAPER = Gains(1.0, 0.1)
LEVEL = Start(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.asarray(G))
# All runs have one of two lengths, the shorter ones blank at their end, so that few programs are compiled.
SHORT, LONG = 512, 30_000

compiled = eqx.filter_jit(orientation)
reversed_run = eqx.filter_jit(backward)
angles_of = jax.jit(jax.vmap(euler_angles))
_turn = jax.jit(lambda sigma, update: turn(Vector.of(sigma), update).stack(), static_argnums=1)


def padded(signal, trusted=None, rest=None):
    n = len(signal)
    size = SHORT if n <= SHORT else LONG
    blank = (0, size - n)
    trusted = np.ones((n, 2), bool) if trusted is None else trusted
    rest = np.zeros(n, bool) if rest is None else rest
    return (
        jnp.asarray(np.pad(signal, (blank, (0, 0)))),
        jnp.asarray(np.pad(np.full(n, 1 / RATE), blank)),
        jnp.asarray(np.pad(trusted, (blank, (0, 0)))),
    ), jnp.asarray(np.pad(rest, blank))


def run(signal, gains=GAINS, start=LEVEL, trusted=None, rest=None, **options):
    n = len(signal)
    samples, rest = padded(signal, trusted, rest)
    found = compiled(*samples, start, gains, rest=rest, **options)
    return Attitude(found.q_nb[: n + 1], found.integral[: n + 1])


def turned_by(sigma, update):
    return _turn(jnp.asarray(sigma), update)


def euler(found):
    return np.asarray(angles_of(jnp.asarray(np.resize(found.q_nb, (LONG + 1, 4)))))[: len(found.q_nb)]


def still(n, key=None, gyr=0.0, acc=0.0):
    """A level sensor at rest, with white noise."""
    signal = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, G], (n, 1))
    if key is not None:
        signal += np.repeat([gyr, acc], 3) * np.asarray(jax.random.normal(key, (n, 6)))
    return signal


def tilted(angle):
    """The level start, tilted about x."""
    return Start(quat_exp(jnp.array([angle, 0.0, 0.0])), LEVEL.offset, LEVEL.gravity)


def tilt(q_nb):
    """Angle between the estimated and the true vertical of a level sensor (rad)."""
    _, x, y, _ = np.asarray(q_nb).T
    return np.arccos(np.clip(1 - 2 * (x**2 + y**2), -1, 1))


def turning(rate, n=200):
    """A body that turns at a constant rate; its specific force is that of a rest."""
    attitude = Rotation.from_rotvec(np.outer(np.arange(n) / RATE, rate))
    force = attitude.inv().apply([0.0, 0.0, G])
    return np.concatenate([np.tile(rate, (n, 1)), force], axis=1), attitude


@pytest.mark.parametrize("estimate", ["gyro", "gyro_accel", "pi"])
def test_a_constant_rate_has_a_closed_form(estimate):
    rate = np.array([0.4, -1.1, 0.7])
    signal, attitude = turning(rate)
    found = run(signal, estimate=estimate).q_nb[:-1]
    expected = attitude.as_quat()[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(np.array(found) * expected, axis=1)), 1.0, atol=1e-12, rtol=0)


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("update", ["comp", "imp"])
def test_about_one_axis_the_updates_of_the_paper_turn_by_sigma(axis, update):
    """With half angles and no prefactor; Q_imp is off by a twelfth of the cube, as a tangent is."""
    sigma = 0.02
    q = np.asarray(turned_by(sigma * np.eye(3)[axis], update))
    angle = Rotation.from_quat(q, scalar_first=True).as_rotvec()[axis]
    assert angle == pytest.approx(sigma, abs=1e-15 if update == "comp" else sigma**3 / 11)
    assert abs(angle / sigma - 1) < 1e-4, "as printed (full angles) it would turn twice as far"


def test_q_comp_is_the_product_of_the_three_rotations():
    angles = np.array([0.3, -0.2, 0.5])
    q = np.asarray(turned_by(angles, "comp"))
    expected = Rotation.from_euler("ZYX", angles[::-1])
    np.testing.assert_allclose(
        Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), expected.as_matrix(), atol=1e-15
    )
    matrix, found = jax.jit(lambda q: (dcm(q), euler_angles(q)))(jnp.asarray(q))
    np.testing.assert_allclose(matrix, expected.as_matrix().T, atol=1e-15)
    np.testing.assert_allclose(found, angles, atol=1e-15)


def test_first_order_updates_come_close_to_the_exact_one():
    signal, attitude = turning(np.array([0.4, -1.1, 0.7]), 400)
    errors = {}
    for update in ("exact", "imp", "comp"):
        q = np.asarray(run(signal, estimate="gyro", update=update).q_nb[-2])
        errors[update] = (Rotation.from_quat(q, scalar_first=True) * attitude[-1].inv()).magnitude()
    assert errors["exact"] < 1e-12 < errors["imp"] < errors["comp"] < 0.02


def test_a_tilt_decays_as_the_proportional_gain_says():
    """Small angles: θ' = -½ kp θ per step of the explicit controller."""
    found = run(still(500), Gains(1.0, 0.0), tilted(0.01), estimate="pi")
    expected = 0.01 * (1 - 0.5 / RATE) ** np.arange(501)
    np.testing.assert_allclose(tilt(found.q_nb), expected, rtol=1e-4)


def test_the_accelerometer_alone_is_level_at_once_and_knows_no_heading():
    start = Start(quat_exp(jnp.array([0.05, -0.03, 0.7])), jnp.zeros(3), jnp.asarray(G))
    found = run(still(50), start=start, gains=PAPER, estimate="accel")
    assert tilt(found.q_nb)[-1] < 1e-6
    heading = euler(found)[:, 2]
    assert abs(heading[-1] - heading[0]) < 0.01


@pytest.mark.parametrize("gains", [PAPER, GAINS], ids=["paper", "low-pass"])
def test_a_constant_offset_is_learnt_but_for_the_vertical(gains, key):
    offset = np.array([0.002, -0.001, 0.003])
    signal = still(LONG, key, 1e-3, 0.02)
    signal[:, :3] += offset
    found = run(signal, gains, estimate="pi")
    assert np.rad2deg(tilt(found.q_nb)[-1000:]).max() < 0.1
    learnt = -np.asarray(found.integral)[-10_000:].mean(axis=0)
    np.testing.assert_allclose(learnt[:2], offset[:2], atol=3e-4)
    assert abs(learnt[2]) < 3e-4, "nothing vertical is ever learnt"
    heading = euler(found)[-1, 2]
    assert heading == pytest.approx(offset[2] * 300, rel=0.02)


def test_the_four_estimates_at_rest_behave_as_table_1_says(key):
    """σ_gyro drifts, σ_accel is noisy, the PI controller does neither, and none holds z."""
    signal = still(LONG, key, 1e-3, 0.03)
    signal[:, :3] += 0.001
    drift, noise, z = {}, {}, {}
    for estimate in ("gyro", "accel", "gyro_accel", "pi"):
        angles = np.rad2deg(euler(run(signal, PAPER, estimate=estimate)))
        drift[estimate] = abs(angles[-100:, 0].mean() - angles[:100, 0].mean())
        noise[estimate] = np.diff(angles[:, 0]).std()
        z[estimate] = angles[-1, 2]
    assert drift["gyro"] > 10 > 100 * drift["pi"] and drift["accel"] < 0.1
    assert noise["accel"] > 5 * noise["pi"] and noise["gyro_accel"] > 5 * noise["pi"]
    assert z["pi"] == pytest.approx(np.rad2deg(0.001 * 300), rel=0.02), "the drift of the gyroscope"
    assert abs(z["accel"]) < 0.5


def test_gradients_agree_with_finite_differences(key):
    samples, rest = padded(still(300, key, 0.2, 1.0))

    def end(values):
        kp, ki, tau, gate = values
        gains = Gains(kp, ki, tau, gate)
        return orientation(*samples, tilted(0.1), gains, rest=rest).q_nb[150, 1]

    at, h = jnp.array([0.8, 0.2, 0.5, 3.0]), 1e-5
    reverse, end = jax.jit(jax.grad(end))(at), jax.jit(end)
    numeric = [(end(at + h * e) - end(at - h * e)) / (2 * h) for e in np.eye(4)]
    np.testing.assert_allclose(reverse, numeric, rtol=1e-5, atol=1e-9)


def test_gradients_are_finite_in_free_fall_and_without_gate_or_low_pass():
    signal = still(20)
    signal[5, 3:] = 0.0
    samples, rest = padded(signal)

    def end(kp):
        return orientation(*samples, tilted(0.1), Gains(kp, 0.1), rest=rest, direction="unit").q_nb[-1, 1]

    assert np.isfinite(jax.jit(jax.grad(end))(1.0))


def test_vmap_equals_a_loop_over_trials_and_gains(key):
    signals = jnp.asarray(still(3 * SHORT, key, 0.3, 0.5).reshape(3, SHORT, 6))
    gains = Gains(*(jnp.array(x) for x in ([0.2, 0.8], [0.0, 0.1], [0.0, 1.0], [jnp.inf, 2.0], [1.0, 0.01])))

    def one(signal, gain):
        period, trusted = jnp.full(SHORT, 1 / RATE), jnp.ones((SHORT, 2), bool)
        return orientation(signal, period, trusted, LEVEL, gain).q_nb

    together = jax.jit(jax.vmap(jax.vmap(one, (None, 0)), (0, None)))(signals, gains)
    one = jax.jit(one)
    for i in range(3):
        for j in range(2):
            alone = one(signals[i], jax.tree.map(lambda x, j=j: x[j], gains))
            np.testing.assert_allclose(together[i, j], alone, atol=1e-14)


def test_padding_changes_nothing(key):
    """Blank samples that claim to be motion, against none at all."""
    signal = still(SHORT, key, 0.3, 0.5)
    n = SHORT - 40
    (_, period, trusted), rest = padded(signal[:n])
    signal[n:] = 7.0
    for estimate in ("accel", "pi"):
        found = compiled(jnp.asarray(signal), period, trusted, LEVEL, GAINS, rest=rest, estimate=estimate)
        whole = (jnp.full(n, 1 / RATE), jnp.ones((n, 2), bool))
        bare = compiled(jnp.asarray(signal[:n]), *whole, LEVEL, GAINS, estimate=estimate)
        # A rate that lasts no time turns nothing; the accelerometer's estimate knows no time, but trust.
        np.testing.assert_allclose(found.q_nb[: n + 1], bare.q_nb, atol=1e-14)


@pytest.mark.parametrize("gains", [PAPER, GAINS], ids=["paper", "low-pass"])
def test_a_saturated_accelerometer_corrects_nothing(gains):
    signal = still(300)
    signal[100:150, 3:] = [40.0, -40.0, 40.0]
    trusted = np.ones((300, 2), bool)
    believed = tilt(run(signal, gains).q_nb)
    trusted[100:150, 1] = False
    assert believed.max() > 0.01
    np.testing.assert_allclose(tilt(run(signal, gains, trusted=trusted).q_nb), 0.0, atol=1e-7)


def test_the_gate_ignores_what_is_not_gravity():
    signal = still(300)
    signal[100:150, 3:] = [9.0, 0.0, 12.0]
    gated = Gains(1.0, 0.1, 0.0, 1.0)
    assert tilt(run(signal, gated).q_nb).max() < 1e-3 * tilt(run(signal, PAPER).q_nb).max()


def test_the_integral_neither_winds_up_nor_moves_while_the_gyroscope_saturates():
    signal = still(2000)
    signal[:, 3] = 3.0
    limited = run(signal, Gains(0.1, 1.0, 0.0, jnp.inf, 0.01)).integral
    assert (
        np.abs(limited).max() == pytest.approx(0.01)
        and np.abs(run(signal, Gains(0.1, 1.0)).integral).max() > 0.02
    )
    trusted = np.ones((2000, 2), bool)
    trusted[500:900, 0] = False
    frozen = np.asarray(run(signal, PAPER, trusted=trusted).integral)
    assert np.ptp(frozen[500:901], axis=0).max() == 0 < np.ptp(frozen[:500], axis=0).max()


def test_the_mean_of_specific_force_is_gravity_and_that_of_its_direction_is_not():
    """A sensor that is shaken at a slant: strong and short up, weak and long down, at rest on average."""
    signal = still(6000)
    push = np.tile(np.r_[np.full(10, 3.0), np.full(30, -1.0)], 150)
    signal[:, 3] += 4 * push
    signal[:, 5] += 3 * push
    gains = Gains(0.1, 0.0)
    mean, unit = (tilt(run(signal, gains, direction=d).q_nb)[-400:].mean() for d in ("mean", "unit"))
    assert mean < 0.1 * unit


def test_the_start_is_level_and_carries_the_offset():
    attitude = Rotation.from_euler("ZYX", [0.0, 0.4, -0.9])
    force = attitude.inv().apply([0.0, 0.0, 9.7])
    start = start_at_rest(jnp.asarray(np.tile([0.01, 0.02, -0.03, *force], (100, 1))))
    np.testing.assert_allclose(start.offset, [0.01, 0.02, -0.03], atol=1e-15)
    assert float(start.gravity) == pytest.approx(9.7)
    np.testing.assert_allclose(up_in_body(start.q_nb), force / 9.7, atol=1e-12)


def test_a_turn_about_the_vertical_is_kept():
    """Heading is the gyroscope's: quat_multiply from the left by any heading changes nothing else."""
    signal, _ = turning(np.array([0.4, -1.1, 0.7]))
    heading = Rotation.from_rotvec([0.0, 0.0, 1.0])
    turned = Start(jnp.asarray(heading.as_quat(scalar_first=True)), LEVEL.offset, LEVEL.gravity)
    a, b = (run(signal, start=start).q_nb for start in (LEVEL, turned))
    shifted = heading * Rotation.from_quat(np.asarray(a), scalar_first=True)
    np.testing.assert_allclose(np.abs(np.sum(shifted.as_quat(scalar_first=True) * b, axis=1)), 1, atol=1e-12)


def test_a_rest_teaches_the_offset_about_every_axis(key):
    """What warms by a constant rate is followed with a lag of `OFFSET_TIME`, far below what the integral allows."""
    n, slope = LONG, 1e-5
    signal = still(n, key, 1e-3, 0.02)
    signal[:, :3] += slope * np.arange(n)[:, None] / RATE
    rest = np.ones(n, bool)
    learnt = -np.asarray(run(signal, rest=rest, estimate="pi").integral)
    np.testing.assert_allclose(learnt[-1], slope * (n / RATE - 1.0), atol=3e-4)
    found = {known: run(signal, rest=rest & known, estimate="pi").q_nb for known in (False, True)}
    late = {known: np.rad2deg(tilt(q)[-500:]).mean() for known, q in found.items()}
    # At the steady state of a ramp the integral leaves 2 slope/ki.
    assert late[False] == pytest.approx(np.rad2deg(np.hypot(1, 1) * 2 * slope / 0.01), rel=0.1)
    assert late[True] < 0.05 * late[False]
    assert abs(euler(run(signal, rest=rest))[-1, 2]) < 0.02 * 0.5 * slope * (n / RATE) ** 2


def test_what_a_rest_teaches_stays_within_the_limit_and_needs_a_trusted_gyroscope():
    signal = still(SHORT)
    signal[:, 2] = 0.3
    rest, gains = np.ones(SHORT, bool), Gains(0.5, 0.01, 2.5, jnp.inf, 0.05)
    assert np.asarray(run(signal, gains, rest=rest).integral)[-1, 2] == pytest.approx(-0.05)
    trusted = np.tile([False, True], (SHORT, 1))
    assert np.asarray(run(signal, gains, trusted=trusted, rest=rest).integral)[-1, 2] == 0


def test_backward_from_a_known_end_finds_the_start(key):
    """An exact end, white noise and an offset that the end knows: the start is as good as the gyroscope."""
    rate = np.array([0.2, -0.1, 0.3])
    signal, attitude = turning(rate, SHORT)
    offset = np.array([0.02, -0.01, 0.03])
    signal[:, :3] += offset
    after = attitude[-1] * Rotation.from_rotvec(rate / RATE)
    end = Start(jnp.asarray(after.as_quat()[[3, 0, 1, 2]]), jnp.asarray(offset), LEVEL.gravity)
    samples, rest = padded(signal)
    found = np.asarray(reversed_run(*samples, end, GAINS, rest).q_nb)
    expected = np.concatenate([attitude.as_quat(), after.as_quat()[None]])[:, [3, 0, 1, 2]]
    np.testing.assert_allclose(np.abs(np.sum(found * expected, axis=1)), 1.0, atol=1e-6)


def test_a_wrong_start_is_forgotten_at_the_end_and_back(key):
    signal = still(LONG, key, 1e-3, 0.02)
    signal[:, :3] += [0.01, -0.02, 0.0]
    samples, rest = padded(signal)
    forward = compiled(*samples, tilted(0.5), GAINS, rest=rest)
    end = ending(forward, tilted(0.5))
    np.testing.assert_allclose(end.offset, [0.01, -0.02, 0.0], atol=1e-3)
    assert tilt(reversed_run(*samples, end, GAINS, rest).q_nb)[0] < 0.005
