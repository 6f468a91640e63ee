"""Orientation: closed forms, the paper's equations, and what its options must and must not do."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat import Config, Recording, orient
from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.inertial.components import Vector
from jaxsat.inertial.good_gain import STEP, good_gain
from jaxsat.inertial.orientation import (
    Gains,
    Start,
    dcm,
    euler_angles,
    orientation,
    start_at_rest,
    turn,
    up_in_body,
)
from jaxsat.inertial.rotations import quat_exp, quat_log, quat_multiply
from jaxsat.studies.metrics import attitude_errors
from jaxsat.studies.tuning import Trials, inclination_loss, tune_gains

RATE, G = 100.0, 9.81
GAINS = Gains(0.5, 0.01, 2.5)
PAPER = Gains(1.0, 0.1)
LEVEL = Start(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.asarray(G))


compiled = eqx.filter_jit(orientation)


def run(signal, gains=GAINS, start=LEVEL, trusted=None, **options):
    n = len(signal)
    trusted = jnp.ones((n, 2), bool) if trusted is None else trusted
    return compiled(jnp.asarray(signal), jnp.full(n, 1 / RATE), trusted, start, gains, **options)


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
    return np.arccos(np.clip(np.asarray(jax.vmap(up_in_body)(q_nb))[:, 2], -1, 1))


def turning(rate, n=200):
    """A body that turns at a constant rate; its specific force is that of a rest."""
    attitude = Rotation.from_rotvec(np.outer(np.arange(n) / RATE, rate))
    force = attitude.inv().apply([0.0, 0.0, G])
    return np.concatenate([np.tile(rate, (n, 1)), force], axis=1), attitude


@pytest.mark.parametrize("estimate", ["gyro", "gyro_accel", "pi", "smoothed"])
def test_a_constant_rate_has_a_closed_form(estimate):
    rate = np.array([0.4, -1.1, 0.7])
    signal, attitude = turning(rate)
    found = run(signal, estimate=estimate).q_nb[:-1]
    expected = attitude.as_quat()[:, [3, 0, 1, 2]]
    # Backward, a specific force is seen from the other end of its sample.
    tolerance = 1e-6 if estimate == "smoothed" else 1e-12
    np.testing.assert_allclose(
        np.abs(np.sum(np.array(found) * expected, axis=1)), 1.0, atol=tolerance, rtol=0
    )


@pytest.mark.parametrize("axis", range(3))
@pytest.mark.parametrize("update", ["comp", "imp"])
def test_about_one_axis_the_updates_of_the_paper_turn_by_sigma(axis, update):
    """With half angles and no prefactor; Q_imp is off by a twelfth of the cube, as a tangent is."""
    sigma = 0.02
    q = turn(Vector.of(jnp.zeros(3).at[axis].set(sigma)), update).stack()
    angle = np.asarray(quat_log(q / jnp.linalg.norm(q)))[axis]
    assert angle == pytest.approx(sigma, abs=1e-15 if update == "comp" else sigma**3 / 11)
    assert abs(angle / sigma - 1) < 1e-4, "as printed (full angles) it would turn twice as far"


def test_q_comp_is_the_product_of_the_three_rotations():
    angles = np.array([0.3, -0.2, 0.5])
    q = np.asarray(turn(Vector.of(jnp.asarray(angles)), "comp").stack())
    expected = Rotation.from_euler("ZYX", angles[::-1])
    np.testing.assert_allclose(
        Rotation.from_quat(q[[1, 2, 3, 0]]).as_matrix(), expected.as_matrix(), atol=1e-15
    )
    np.testing.assert_allclose(np.asarray(dcm(jnp.asarray(q))), expected.as_matrix().T, atol=1e-15)
    np.testing.assert_allclose(np.asarray(euler_angles(jnp.asarray(q))), angles, atol=1e-15)


def test_first_order_updates_come_close_to_the_exact_one():
    signal, attitude = turning(np.array([0.4, -1.1, 0.7]), 400)
    last = attitude[-1].as_quat()[[3, 0, 1, 2]]
    errors = {
        update: np.arccos(np.abs(np.asarray(run(signal, estimate="gyro", update=update).q_nb[-2]) @ last))
        for update in ("exact", "imp", "comp")
    }
    assert errors["exact"] < 1e-7 < errors["imp"] < errors["comp"] < 0.02


def test_a_tilt_decays_as_the_proportional_gain_says():
    """Small angles: θ' = -½ kp θ per step of the explicit controller."""
    found = run(still(500), Gains(1.0, 0.0), tilted(0.01), estimate="pi")
    expected = 0.01 * (1 - 0.5 / RATE) ** np.arange(501)
    np.testing.assert_allclose(tilt(found.q_nb), expected, rtol=1e-4)


def test_the_accelerometer_alone_is_level_at_once_and_knows_no_heading():
    start = Start(quat_exp(jnp.array([0.05, -0.03, 0.7])), jnp.zeros(3), jnp.asarray(G))
    found = run(still(50), start=start, gains=PAPER, estimate="accel")
    assert tilt(found.q_nb)[-1] < 1e-6
    heading = np.asarray(jax.vmap(euler_angles)(found.q_nb))[:, 2]
    assert abs(heading[-1] - heading[0]) < 0.01


@pytest.mark.parametrize("gains", [PAPER, GAINS], ids=["paper", "low-pass"])
def test_a_constant_offset_is_learnt_but_for_the_vertical(gains, key):
    offset = np.array([0.002, -0.001, 0.003])
    signal = still(30_000, key, 1e-3, 0.02)
    signal[:, :3] += offset
    found = run(signal, gains, estimate="pi")
    assert np.rad2deg(tilt(found.q_nb)[-1000:]).max() < 0.1
    learnt = -np.asarray(found.integral)[-10_000:].mean(axis=0)
    np.testing.assert_allclose(learnt[:2], offset[:2], atol=3e-4)
    assert abs(learnt[2]) < 3e-4, "nothing vertical is ever learnt"
    heading = np.asarray(euler_angles(found.q_nb[-1]))[2]
    assert heading == pytest.approx(offset[2] * 300, rel=0.02)


def test_the_four_estimates_at_rest_behave_as_table_1_says(key):
    """σ_gyro drifts, σ_accel is noisy, the PI controller does neither, and none holds z."""
    signal = still(30_000, key, 1e-3, 0.03)
    signal[:, :3] += 0.001
    drift, noise, z = {}, {}, {}
    for estimate in ("gyro", "accel", "gyro_accel", "pi"):
        angles = np.rad2deg(np.asarray(jax.vmap(euler_angles)(run(signal, PAPER, estimate=estimate).q_nb)))
        drift[estimate] = abs(angles[-100:, 0].mean() - angles[:100, 0].mean())
        noise[estimate] = np.diff(angles[:, 0]).std()
        z[estimate] = angles[-1, 2]
    assert drift["gyro"] > 10 > 100 * drift["pi"] and drift["accel"] < 0.1
    assert noise["accel"] > 5 * noise["pi"] and noise["gyro_accel"] > 5 * noise["pi"]
    assert z["pi"] == pytest.approx(np.rad2deg(0.001 * 300), rel=0.02), "the drift of the gyroscope"
    assert abs(z["accel"]) < 0.5


def test_smoothing_has_no_lag(key):
    """The low-pass of a forward filter lags behind a slow tilt of the offset; forward and backward lags cancel."""
    n = 12_000
    signal = still(n, key, 1e-3, 0.5)
    signal[:, 0] += 0.002 * np.sin(2 * np.pi * np.arange(n) / n)
    rms = {
        estimate: np.sqrt(np.mean(tilt(run(signal, Gains(0.4, 0.0), estimate=estimate).q_nb) ** 2))
        for estimate in ("pi", "smoothed")
    }
    assert rms["smoothed"] < 0.6 * rms["pi"]


def test_gradients_agree_with_finite_differences(key):
    signal = still(300, key, 0.2, 1.0)

    def end(values):
        kp, ki, tau, gate = values
        return run(signal, Gains(kp, ki, tau, gate), tilted(0.1), estimate="smoothed").q_nb[150, 1]

    at, h = jnp.array([0.8, 0.2, 0.5, 3.0]), 1e-5
    forward, backward = jax.jacfwd(end)(at), jax.grad(end)(at)
    numeric = [(end(at + h * e) - end(at - h * e)) / (2 * h) for e in np.eye(4)]
    np.testing.assert_allclose(forward, backward, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(forward, numeric, rtol=1e-5, atol=1e-9)


def test_gradients_are_finite_in_free_fall_and_without_gate_or_low_pass():
    signal = still(20)
    signal[5, 3:] = 0.0
    for direction in ("mean", "unit"):
        slope = jax.grad(
            lambda kp, direction=direction: run(
                signal, Gains(kp, 0.1), tilted(0.1), direction=direction
            ).q_nb[-1, 1]
        )
        assert np.isfinite(slope(1.0))


def test_vmap_equals_a_loop_over_trials_and_gains(key):
    signals = jnp.stack([jnp.asarray(still(50, k, 0.3, 0.5)) for k in jax.random.split(key, 3)])
    gains = Gains(*(jnp.array(x) for x in ([0.2, 0.8], [0.0, 0.1], [0.0, 1.0], [jnp.inf, 2.0], [1.0, 0.01])))

    def one(signal, gain):
        return run(signal, gain, estimate="smoothed").q_nb

    together = jax.vmap(jax.vmap(one, (None, 0)), (0, None))(signals, gains)
    for i in range(3):
        for j in range(2):
            alone = one(signals[i], jax.tree.map(lambda x, j=j: x[j], gains))
            np.testing.assert_allclose(together[i, j], alone, atol=1e-14)


def test_padding_changes_nothing(key):
    signal = still(80, key, 0.3, 0.5)
    n, period = 80, jnp.full(120, 1 / RATE).at[80:].set(0.0)
    padded = np.concatenate([signal, np.full((40, 6), 7.0)])
    trusted = jnp.asarray(np.arange(120)[:, None] < [n, n])
    for estimate in ("accel", "smoothed"):
        found = orientation(jnp.asarray(padded), period, trusted, LEVEL, GAINS, estimate=estimate)
        # A rate that lasts no time turns nothing; the accelerometer's estimate knows no time, but trust.
        np.testing.assert_allclose(found.q_nb[: n + 1], run(signal, estimate=estimate).q_nb, atol=1e-14)


@pytest.mark.parametrize("gains", [PAPER, GAINS], ids=["paper", "low-pass"])
def test_a_saturated_accelerometer_corrects_nothing(gains):
    signal = still(300)
    signal[100:150, 3:] = [40.0, -40.0, 40.0]
    trusted = np.ones((300, 2), bool)
    believed = tilt(run(signal, gains).q_nb)
    trusted[100:150, 1] = False
    assert believed.max() > 0.01
    np.testing.assert_allclose(tilt(run(signal, gains, trusted=jnp.asarray(trusted)).q_nb), 0.0, atol=1e-7)


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
    frozen = np.asarray(run(signal, PAPER, trusted=jnp.asarray(trusted)).integral)
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


def test_good_gain_of_a_loop_with_a_low_pass_is_well_damped():
    """A pure integrator with a first-order lag: ζ = 1/√(2 kp tau), overshoot M = exp(-πζ/√(1-ζ²)), undershoot M²."""
    rest = still(100)
    for tau in (0.5, 2.0):
        proposed = good_gain(rest, 1 / RATE, tau)
        k_gg = float(proposed.kp) / 0.8
        damping = 1 / np.sqrt(2 * k_gg * tau)
        overshoot = np.exp(-np.pi * damping / np.sqrt(1 - damping**2))
        assert 0.05 < overshoot < 0.09 and overshoot**2 == pytest.approx(0.005, rel=0.3)
        half_period = np.pi / np.sqrt(0.5 * k_gg / tau - 0.25 / tau**2)
        assert float(proposed.kp / proposed.ki) == pytest.approx(1.5 * half_period, rel=0.05)
    assert STEP < 0.2


def test_good_gain_without_a_low_pass_corrects_most_of_the_error_at_each_sample():
    proposed = good_gain(still(100), 1 / RATE)
    assert 0.5 < 0.5 * float(proposed.kp) / RATE < 1.2


def test_tuning_finds_what_lowers_the_loss_and_its_gradient_is_right(key):
    n = 1500
    signal = still(n, key, 0.002, 1.0)
    signal[:, 0] += 0.01
    trials = Trials(
        jnp.asarray(signal)[None],
        jnp.full((1, n), 1 / RATE),
        jnp.ones((1, n, 2), bool),
        jax.tree.map(lambda x: x[None], LEVEL),
        jnp.tile(jnp.array([0.0, 0.0, 1.0]), (1, n, 1)),
        jnp.ones((1, n), bool),
    )
    first = Gains(0.02, 1e-3, 0.1)
    tuned = tune_gains(trials, first, steps=25, rate=0.4)
    assert inclination_loss(trials, tuned) < 0.3 * inclination_loss(trials, first)
    assert float(tuned.kp) > 0.1


def test_attitude_errors_are_those_that_were_put_in():
    truth = Rotation.random(200, random_state=1)
    heading, inclination = 0.3, 0.05
    error = Rotation.from_rotvec([0, 0, heading]) * Rotation.from_rotvec([inclination, 0, 0])
    found = (error * truth).as_quat()[:, [3, 0, 1, 2]]
    expected = truth.as_quat()[:, [3, 0, 1, 2]]
    scored = np.ones(200, bool)
    raw = attitude_errors(found, expected, scored, align=False)
    assert raw.heading == pytest.approx(heading) and raw.inclination == pytest.approx(inclination)
    assert raw.total == pytest.approx(error.magnitude())
    aligned = attitude_errors(-found, expected, scored)
    assert aligned.heading == pytest.approx(0, abs=1e-9) and aligned.total == pytest.approx(inclination)
    scored[:100], found[:100] = False, [1.0, 0.0, 0.0, 0.0]
    assert attitude_errors(found, expected, scored, align=False).inclination == pytest.approx(inclination)


def recording(signal, **changes):
    n = len(signal)
    missing = changes.pop("missing", np.zeros((n, 6), bool))
    return Recording(np.arange(n) / RATE, signal[:, :3], signal[:, 3:], missing, name="trial", **changes)


def simulated(n=600, seed=0):
    """One second at rest, then a turn to and fro about x, noise everywhere."""
    rng = np.random.default_rng(seed)
    t = np.arange(n) / RATE
    angle = np.where(t > 1.2, 0.8 * np.sin(2 * np.pi * (t - 1.2)) ** 3, 0.0)
    rate = np.diff(angle, append=0.0) * RATE
    force = Rotation.from_rotvec(np.outer(angle, [1, 0, 0])).inv().apply([0, 0, G])
    signal = np.concatenate([np.outer(rate, [1, 0, 0]), force], axis=1)
    return signal + rng.normal(size=(n, 6)) * np.repeat([1e-3, 1e-2], 3), angle


def test_orient_follows_a_recording_and_takes_its_offset_off():
    signal, angle = simulated()
    signal[:, :3] += [0.05, -0.02, 0.01]
    found = orient(recording(signal))
    np.testing.assert_allclose(found.euler[:, 0], angle, atol=0.02)
    np.testing.assert_allclose(found.start.offset, [0.05, -0.02, 0.01], atol=5e-4)
    assert found.warnings == [] and len(found.after) == len(found.q_nb) == 600


def test_flagged_saturation_of_the_rate_is_filled():
    signal, angle = simulated()
    clipped = np.zeros((600, 6), bool)
    clipped[:, 0] = np.abs(signal[:, 0]) > 4.5
    cut = signal.copy()
    cut[:, 0] = np.clip(cut[:, 0], -4.5, 4.5)
    errors = {}
    for fill in ("none", "interpolate"):
        found = orient(recording(cut, clipped=clipped), load_config(None, **{"orientation.fill": fill}))
        errors[fill] = np.abs(found.euler[:, 0] - angle).max()
        assert [w for w in found.warnings if "gaps in the rates" in w] == []
    assert errors["interpolate"] < 0.5 * errors["none"] and errors["none"] > 0.02


def test_gaps_too_long_to_be_filled_from_their_neighbours_are_said():
    signal, _ = simulated()
    clipped = np.zeros((600, 6), bool)
    clipped[:, 0] = np.abs(signal[:, 0]) > 0.7
    signal[:, 0] = np.clip(signal[:, 0], -0.7, 0.7)
    (warning,) = orient(recording(signal, clipped=clipped)).warnings
    assert "gaps in the rates last longer than 0.1 s" in warning


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (
            lambda s: recording(s, missing=np.tile([0, 0, 0, 1, 1, 1], (len(s), 1)).astype(bool)),
            "accelerometer",
        ),
        (lambda s: recording(s, missing=np.tile([1, 1, 1, 0, 0, 0], (len(s), 1)).astype(bool)), "gyroscope"),
        (lambda s: recording(s[:90]), "first second"),
    ],
)
def test_what_cannot_be_done_is_said_in_one_sentence(change, says):
    with pytest.raises(InputError, match=says) as error:
        orient(change(simulated()[0]))
    assert "\n" not in str(error.value) and "; " in str(error.value)


@pytest.mark.parametrize("key", ["kp", "ki", "tau", "limit", "gate"])
def test_negative_settings_are_refused(key):
    with pytest.raises(InputError, match=f"orientation.{key}"):
        load_config(None, **{f"orientation.{key}": -1.0})


def test_moving_within_the_first_second_is_said():
    signal, _ = simulated()
    found = orient(recording(signal[60:]), Config())
    assert "first second" in found.warnings[0] and not found.start.offset.any()


def test_a_turn_about_the_vertical_is_kept():
    """Heading is the gyroscope's: quat_multiply from the left by any heading changes nothing else."""
    signal = jnp.asarray(simulated()[0])
    turned = Start(
        quat_multiply(quat_exp(jnp.array([0.0, 0.0, 1.0])), LEVEL.q_nb), LEVEL.offset, LEVEL.gravity
    )
    a, b = run(signal).q_nb, run(signal, start=turned).q_nb
    shifted = jax.vmap(lambda q: quat_multiply(quat_exp(jnp.array([0.0, 0.0, 1.0])), q))(a)
    np.testing.assert_allclose(b, shifted, atol=1e-12)
