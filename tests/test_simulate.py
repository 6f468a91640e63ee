"""Simulation: sensors against finite differences and strapdown, motions against their designed figures."""

import subprocess
import sys
from functools import partial

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.errors import InputError
from jaxsat.studies.motions import MOTIONS, Bar, Line, Motion, Planar, Walk
from jaxsat.studies.simulate import GRAVITY, Calibration, Sensor, simulate, write_simulation

G_N = np.array([0.0, 0.0, GRAVITY])
SILENT = Sensor(gyr_density=0.0, acc_density=0.0)
TURNING = Walk(strides=3, turn=0.4)
ALL = [Bar(), Line(), Planar(), TURNING]
by_name = pytest.mark.parametrize("motion", ALL, ids=[type(m).__name__ for m in ALL])


def pose(motion: Motion, time: np.ndarray) -> tuple[np.ndarray, Rotation]:
    position, q_nb = jax.jit(jax.vmap(motion.pose))(jnp.asarray(time))
    return np.asarray(position), Rotation.from_quat(np.asarray(q_nb).copy(), scalar_first=True)


def end_of(motion: Motion) -> float:
    return float(motion.moving[-1, 1])


@by_name
def test_sensors_are_the_finite_differences_of_the_motion(motion, key):
    h, rate = 2e-4, 50.0
    _, truth = simulate(motion, rate=rate, duration=end_of(motion) + 0.3, sensor=SILENT, key=key)
    middle = truth.time + 0.5 / rate
    position, R_nb = pose(motion, middle)
    before, R_before = pose(motion, middle - h)
    after, R_after = pose(motion, middle + h)
    acceleration = (after - 2.0 * position + before) / h**2
    specific_force = R_nb.inv().apply(acceleration + G_N)
    rate_b = (R_before.inv() * R_after).as_rotvec() / (2.0 * h)
    # Central differences: h²/12 of the fourth and h²/6 of the third derivative.
    np.testing.assert_allclose(truth.signal[:, :3], rate_b, atol=3e-5)
    np.testing.assert_allclose(truth.signal[:, 3:], specific_force, atol=3e-4)


@by_name
def test_states_are_those_of_the_motion(motion, key):
    _, truth = simulate(motion, rate=100.0, duration=end_of(motion) + 0.3, sensor=SILENT, key=key)
    position, R_nb = pose(motion, truth.time)
    np.testing.assert_allclose(truth.position, position, atol=1e-12)
    attitude = Rotation.from_quat(truth.q_nb, scalar_first=True)
    np.testing.assert_allclose((attitude.inv() * R_nb).magnitude(), 0.0, atol=1e-12)
    np.testing.assert_allclose(np.linalg.norm(truth.q_nb, axis=1), 1.0, rtol=1e-14)
    velocity = (pose(motion, truth.time + 1e-4)[0] - pose(motion, truth.time - 1e-4)[0]) / 2e-4
    np.testing.assert_allclose(truth.velocity, velocity, atol=3e-5)


def strapdown_error(motion: Motion, rate: float, key: jax.Array) -> np.ndarray:
    """Largest position and attitude error (m, rad) of a plain strapdown loop over noiseless samples."""
    recording, truth = simulate(motion, rate=rate, duration=end_of(motion) + 0.3, sensor=SILENT, key=key)
    T = 1.0 / rate
    R, v, r = Rotation.identity(), np.zeros(3), np.zeros(3)
    worst = np.zeros(2)
    for k in range(len(recording)):
        true = Rotation.from_quat(truth.q_nb[k], scalar_first=True)
        error = np.array([np.linalg.norm(r - truth.position[k]), (true.inv() * R).magnitude()])
        worst = np.maximum(worst, error)
        middle = R * Rotation.from_rotvec(0.5 * T * recording.gyr[k])
        a = middle.apply(recording.acc[k]) - G_N
        r = r + v * T + 0.5 * a * T**2
        v = v + a * T
        R = R * Rotation.from_rotvec(T * recording.gyr[k])
    return worst


@by_name
def test_strapdown_of_noiseless_samples_meets_the_truth_to_second_order(motion, key):
    coarse, fine = (strapdown_error(motion, rate, key) for rate in (100.0, 200.0))
    assert np.all(coarse < [0.02, 0.02])
    # Where the error is rounding (no rotation), there is no order to see.
    visible = coarse > 1e-9
    np.testing.assert_allclose((coarse / np.maximum(fine, 1e-30))[visible], 4.0, rtol=0.15)


@by_name
def test_rest_reads_gravity_and_no_rotation_exactly(motion, key):
    recording, truth = simulate(motion, rate=128.0, duration=end_of(motion) + 0.5, sensor=SILENT, key=key)
    assert truth.rest[0] and truth.rest[-1] and not truth.rest.all()
    assert np.all(recording.gyr[truth.rest] == 0.0)
    assert np.all(truth.velocity[truth.rest] == 0.0)
    norm = np.linalg.norm(recording.acc[truth.rest], axis=1)
    np.testing.assert_allclose(norm, GRAVITY, rtol=4e-16)
    # Its mid-period value moves, or it touches a moving interval only with a tip: then it is not a rest.
    moving = np.abs(recording.gyr).max(axis=1) + np.abs(truth.velocity).max(axis=1) > 0
    assert not np.any(moving & truth.rest)


def test_a_sample_rests_only_if_its_whole_period_does(key):
    _, truth = simulate(Bar(start=0.455, duration=0.69), rate=100.0, duration=1.6, key=key)
    # 0.455 to 1.145 s touches samples 45 to 114.
    assert np.flatnonzero(~truth.rest).tolist() == list(range(45, 115))
    _, truth = simulate(Bar(start=0.45, duration=0.7), rate=100.0, duration=1.6, key=key)
    assert np.flatnonzero(~truth.rest).tolist() == list(range(45, 115))


def test_the_bar_has_the_figures_of_the_paper(key):
    recording, truth = simulate(Bar(), rate=100.0, duration=1.6, sensor=Sensor(gyr_rail=7.5), key=key)
    assert len(recording) == 160
    assert 11.0 <= truth.signal[:, 1].max() <= 12.0
    assert 20 <= truth.saturated.sum() <= 24
    assert np.all(truth.saturated.sum(axis=0)[[0, 2, 3, 4, 5]] == 0)
    assert recording.gyr.max() == 7.5
    np.testing.assert_allclose(truth.position[-1], [1.0, 0.0, 0.0], atol=1e-14)
    np.testing.assert_allclose(np.linalg.norm(truth.position - [0.5, 0.0, 0.0], axis=1), 0.5, rtol=1e-12)


def test_the_line_is_as_long_as_told_and_saturates_x_only(key):
    recording, truth = simulate(Line(), rate=100.0, duration=1.8, sensor=Sensor(acc_rail=11.0), key=key)
    np.testing.assert_allclose(truth.position[-1], [0.95, 0.0, 0.0], atol=1e-14)
    assert truth.saturated[:, 3].any() and truth.saturated.sum() == truth.saturated[:, 3].sum()
    assert (recording.acc[:, 0].min(), recording.acc[:, 0].max()) == (-11.0, 11.0)
    assert np.abs(truth.signal[:, 3]).max() == pytest.approx(9.4 * 0.95 / 0.8**2, rel=0.01)


def test_a_hasty_line_is_pushed_harder_than_braked(key):
    motion = Line(duration=1.0, haste=0.5)
    _, truth = simulate(motion, rate=400.0, duration=2.0, sensor=SILENT, key=key)
    np.testing.assert_allclose(truth.position[-1], [0.95, 0.0, 0.0], atol=1e-14)
    assert truth.signal[:, 3].max() == pytest.approx(14.3 * 0.95, rel=0.01)
    assert truth.signal[:, 3].min() == pytest.approx(-10.1 * 0.95, rel=0.01)


def test_the_planar_curve_starts_and_stops_and_saturates_rate_z_only(key):
    _, truth = simulate(Planar(), rate=100.0, duration=2.5, sensor=Sensor(gyr_rail=7.5), key=key)
    np.testing.assert_allclose(truth.position[-1], [0.5, 0.0, 0.0], atol=1e-14)
    assert truth.position[:, 1].max() == pytest.approx(0.15, rel=1e-3) and np.all(truth.position[:, 2] == 0)
    assert truth.signal[:, 2].min() == pytest.approx(-9.7, abs=0.1)
    assert truth.saturated[:, 2].any() and truth.saturated.sum() == truth.saturated[:, 2].sum()
    # The x axis lies along the path.
    moving = np.linalg.norm(truth.velocity, axis=1) > 1e-3
    velocity_b = Rotation.from_quat(truth.q_nb, scalar_first=True).inv().apply(truth.velocity)
    np.testing.assert_allclose(velocity_b[moving, 1:], 0.0, atol=1e-10)


@pytest.mark.parametrize("turn", [0.0, 1e-9, 0.3])
def test_a_walk_has_the_designed_strides_heights_and_rates(turn, key):
    walk = Walk(strides=6, length=1.3, height=0.08, turn=turn)
    _, truth = simulate(walk, rate=200.0, duration=8.0, key=key)
    first_at_rest = np.flatnonzero(truth.rest & ~np.roll(truth.rest, 1))
    footholds = np.vstack([[0.0, 0.0, 0.0], truth.position[first_at_rest]])
    steps = np.diff(footholds[: walk.strides + 2], axis=0)
    steps = steps[np.linalg.norm(steps, axis=1) > 0]
    assert len(steps) == walk.strides
    np.testing.assert_allclose(np.linalg.norm(steps, axis=1), 1.3, rtol=1e-12)
    np.testing.assert_allclose(np.diff(np.arctan2(steps[:, 1], steps[:, 0])), turn, atol=1e-8)
    assert truth.position[:, 2].max() == pytest.approx(0.08, rel=1e-3) and truth.position[:, 2].min() >= 0.0
    assert 5.0 < truth.signal[:, 1].max() < 7.0 and -9.0 < truth.signal[:, 1].min() < -6.0
    stances = np.diff(np.flatnonzero(np.diff(truth.rest.astype(int))))[1::2]
    np.testing.assert_allclose(stances / 200.0, walk.stance, atol=0.006)


def test_noise_is_white_with_the_sd_of_its_density_and_bias_is_its_mean(key):
    sensor = Sensor(gyr_density=1e-3, acc_density=2e-2, gyr_bias=[0.1, 0.0, -0.1], acc_bias=[0.0, 0.5, 0.0])
    recording, truth = simulate(
        Line(start=0.0, duration=0.1), rate=400.0, duration=100.0, sensor=sensor, key=key
    )
    noise = recording.signal - truth.signal
    sd = np.repeat([1e-3 * 20.0, 2e-2 * 20.0], 3)
    n = len(recording)
    np.testing.assert_allclose(noise.std(axis=0), sd, rtol=4.0 / np.sqrt(2 * n))
    bias = np.array([0.1, 0.0, -0.1, 0.0, 0.5, 0.0])
    np.testing.assert_allclose((noise.mean(axis=0) - bias) / sd, 0.0, atol=4.5 / np.sqrt(n))
    correlation = np.corrcoef(np.concatenate([noise[1:], noise[:-1]], axis=1).T) - np.eye(12)
    assert np.abs(correlation).max() < 5.0 / np.sqrt(n)


def test_a_key_fixes_the_noise_and_another_changes_it(key):
    first, _ = simulate(Bar(), rate=100.0, duration=1.6, key=key)
    again, _ = simulate(Bar(), rate=100.0, duration=1.6, key=key)
    other, _ = simulate(Bar(), rate=100.0, duration=1.6, key=jax.random.key(1))
    assert np.array_equal(first.signal, again.signal)
    assert np.all(first.signal != other.signal)


def test_clipping_touches_what_lies_beyond_the_rails_and_nothing_else(key):
    sensor = Sensor(gyr_rail=5.0, acc_rail=15.0)
    recording, truth = simulate(Walk(strides=2), rate=200.0, duration=4.0, sensor=sensor, key=key)
    rails = np.repeat([5.0, 15.0], 3)
    assert np.array_equal(truth.saturated, np.abs(truth.noisy) > rails) and truth.saturated.sum() > 20
    assert np.array_equal(recording.signal, np.clip(truth.noisy, -rails, rails))
    free, _ = simulate(Walk(strides=2), rate=200.0, duration=4.0, key=key)
    assert np.array_equal(free.signal, truth.noisy)


def test_a_calibration_smears_the_rails_and_leaves_the_rest_alone(key):
    mixing = Calibration(np.eye(3) + 0.02 * np.array([[1, -1, 2], [1, 2, -1], [-2, 1, 1]]), [0.0, 0.1, 0.0])
    flat = Sensor(gyr_rail=5.0)
    smeared = eqx.tree_at(lambda s: s.gyr_calibration, flat, mixing)
    motion = Walk(strides=4, turn=0.5)
    recording, truth = simulate(motion, rate=200.0, duration=6.0, sensor=smeared, key=key)
    hit = truth.saturated[:, 1]
    plateau = recording.gyr[hit & (recording.gyr[:, 1] < 0), 1]
    assert len(plateau) > 10 and np.ptp(plateau) > 0.01 and abs(plateau.mean() + 5.0 * 1.04 - 0.1) < 0.1
    untouched = ~truth.saturated[:, :3].any(axis=1)
    assert np.array_equal(recording.gyr[untouched], truth.noisy[untouched, :3])
    raw = (recording.gyr - mixing.offset) @ np.linalg.inv(mixing.matrix).T
    np.testing.assert_allclose(np.abs(raw[hit, 1]), 5.0, rtol=1e-12)


def test_other_values_and_lengths_do_not_compile_anew(key):
    traces = []

    class Counted(Bar):
        def pose(self, t):
            traces.append(t)
            return super().pose(t)

    simulate(Counted(), rate=100.0, duration=1.6, key=key)
    first = len(traces)
    simulate(Counted(radius=0.3, sweep=2.0), rate=200.0, duration=20.0, key=key)
    assert len(traces) == first > 0


def test_chunks_join_without_a_seam(key):
    """The same samples elsewhere in their chunks are the same."""
    _, long = simulate(Walk(strides=12), rate=200.0, duration=15.0, sensor=SILENT, key=key)
    _, late = simulate(Walk(strides=12, start=3.0), rate=200.0, duration=17.0, sensor=SILENT, key=key)
    np.testing.assert_allclose(late.signal[400:], long.signal, atol=1e-9)
    np.testing.assert_allclose(late.position[400:], long.position, atol=1e-12)


def test_simulation_is_in_float64_whatever_the_setting_of_jax():
    program = (
        "import jax; from jaxsat.studies.motions import Bar; from jaxsat.studies.simulate import simulate\n"
        "r, t = simulate(Bar(), rate=100, duration=1.6, key=jax.random.key(20140506))\n"
        "assert not jax.config.jax_enable_x64 and r.gyr.dtype == t.q_nb.dtype == 'float64'\n"
        "print(repr(float(r.signal.sum())))"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    recording, _ = simulate(Bar(), rate=100.0, duration=1.6, key=jax.random.key(20140506))
    assert float(run.stdout) == pytest.approx(recording.signal.sum(), rel=1e-12)


# From 3.1 on pandas reads digit for digit by itself and deprecates asking for it.
@pytest.mark.filterwarnings("ignore:The 'float_precision' argument is deprecated")
@pytest.mark.parametrize("suffix", [".csv", ".parquet"])
@pytest.mark.parametrize("rest", [False, True])
def test_written_tables_hold_the_recording_and_its_truth(suffix, rest, tmp_path, key):
    recording, truth = simulate(Bar(), rate=100.0, duration=1.6, sensor=Sensor(gyr_rail=7.5), key=key)
    path = tmp_path / f"bar{suffix}"
    truth_path = write_simulation(path, recording, truth, rest=rest)
    read = partial(pd.read_csv, float_precision="round_trip") if suffix == ".csv" else pd.read_parquet
    table, true = read(path), read(truth_path)
    channels = ["gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y", "acc_z"]
    assert list(table) == ["time", *channels] + ["rest"] * rest
    assert np.array_equal(table[channels].to_numpy(), recording.signal)
    assert np.array_equal(table["time"], recording.time)
    assert np.array_equal(true[["q_w", "q_x", "q_y", "q_z"]].to_numpy(), truth.q_nb)
    assert np.array_equal(true[["pos_x", "pos_y", "pos_z"]].to_numpy(), truth.position)
    assert np.array_equal(true[["vel_x", "vel_y", "vel_z"]].to_numpy(), truth.velocity)
    assert np.array_equal(true[channels].to_numpy(), truth.signal)
    assert true["rest"].dtype == bool and np.array_equal(true["rest"], truth.rest)
    assert np.array_equal(true["sat_gyr_y"], truth.saturated[:, 1])
    assert sorted(p.name for p in tmp_path.iterdir()) == [path.name, truth_path.name]


def test_motions_are_found_by_name():
    assert {name: cls.__name__.lower() for name, cls in MOTIONS.items()} == {name: name for name in MOTIONS}


def test_impossible_requests_are_refused_in_one_sentence(tmp_path, key):
    recording, truth = simulate(Bar(), rate=100.0, duration=1.6, key=key)
    for attempt, words in [
        (lambda: simulate(Bar(), rate=0.0, duration=1.0, key=key), "two samples"),
        (lambda: simulate(Bar(), rate=100.0, duration=float("nan"), key=key), "two samples"),
        (lambda: simulate(Planar(length=0.0), rate=100.0, duration=2.0, key=key), "finite"),
        (lambda: Bar(duration=0.0), "Bar: moving intervals"),
        (lambda: Walk(stance=-0.1), "Walk: moving intervals"),
        (lambda: Walk(strides=0), "Walk: moving intervals"),
        (lambda: Sensor(gyr_rail=-1.0), "rail"),
        (lambda: Sensor(acc_density=-1.0), "density"),
        (lambda: Calibration(np.zeros((3, 3))), "singular"),
        (lambda: write_simulation(tmp_path / "bar.xlsx", recording, truth), r"\.xlsx"),
        (lambda: write_simulation(tmp_path / "nowhere" / "bar.csv", recording, truth), "cannot be written"),
    ]:
        with pytest.raises(InputError, match=words) as caught:
            attempt()
        assert "\n" not in str(caught.value) and "None" not in str(caught.value)


@pytest.mark.slow
def test_half_an_hour_of_walking_fits_in_memory_and_a_minute():
    program = (
        "import time, jax; from pathlib import Path; from jaxsat.studies.motions import Walk\n"
        "from jaxsat.studies.simulate import simulate\n"
        "start = time.perf_counter()\n"
        "r, _ = simulate(Walk(strides=1600, turn=0.1), rate=200, duration=1800, key=jax.random.key(0))\n"
        "assert len(r) == 360_000\n"
        # `getrusage` would count the process of the tests, which starts this one.
        "print(time.perf_counter() - start, Path('/proc/self/status').read_text().split('VmHWM:')[1].split()[0])"
    )
    run = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    seconds, kilobytes = map(float, run.stdout.split())
    assert seconds < 60.0 and kilobytes < 2e6
