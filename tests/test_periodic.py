"""Periodic motion: filters, combiners and least squares against scipy, sinusoids and each other."""

import json

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest
from scipy import signal

from jaxsat.cli import main
from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.inertial.filters import apply, butterworth, response, trapezoid
from jaxsat.inertial.harmonic import Spectrum, learn, least_squares, predict, recursive
from jaxsat.inertial.periodic import (
    analytical,
    band,
    bmflc,
    chain_response,
    compensated,
    integrated,
    latt_bmflc,
    phases,
    wflc,
)
from jaxsat.inertial.windows import Windows, harmonics, neighbours, periodogram
from jaxsat.periodic import estimate_periodic
from jaxsat.saturation.harmonic_fill import fill_harmonic
from jaxsat.signals.recording import Recording
from jaxsat.signals.support import find_band, find_support

RATE = 250.0
TIME = np.arange(1000) / RATE
FREQUENCY = jnp.array([10.0, 11.0, 11.5])


@pytest.mark.parametrize(("kind", "order", "cutoff"), [("highpass", 4, 5.0), ("lowpass", 1, 50.0)])
def test_digital_filters_are_those_of_scipy(kind, order, cutoff, key):
    x = jax.random.normal(key, (500,))
    sections = signal.butter(order, cutoff, kind, fs=RATE, output="sos")
    stage = butterworth(kind, order, cutoff, RATE)
    np.testing.assert_allclose(apply(stage, x), signal.sosfilt(sections, x), rtol=1e-9, atol=1e-12)
    expected = signal.sosfreqz(sections, np.asarray(FREQUENCY), fs=RATE)[1]
    np.testing.assert_allclose(response((stage,), FREQUENCY), expected, rtol=1e-12)


@pytest.mark.parametrize(("kind", "order"), [("lowpass", 1), ("lowpass", 4), ("highpass", 3)])
def test_analogue_responses_are_those_of_scipy(kind, order):
    polynomials = signal.butter(order, 2 * np.pi * 30, kind, analog=True)
    expected = signal.freqs(*polynomials, 2 * np.pi * np.asarray(FREQUENCY))[1]
    stage = butterworth(kind, order, 30.0, None)
    np.testing.assert_allclose(response((stage,), FREQUENCY), expected, rtol=1e-9)
    with pytest.raises(ValueError, match="analogue"):
        apply(stage, jnp.ones(5))


def test_the_printed_gain_and_phase_of_the_low_pass_belong_to_250_hz():
    """Latt et al. 2011 print 0.9852 and −9.86° for its filter at 10 Hz, 0.9981 for the high-pass."""
    low = complex(response((butterworth("lowpass", 1, 50.0, RATE),), jnp.array(10.0)))
    assert abs(low) == pytest.approx(0.9852, abs=5e-5)
    assert np.rad2deg(np.angle(low)) == pytest.approx(-9.86, abs=5e-3)
    high = complex(response((butterworth("highpass", 4, 5.0, RATE),), jnp.array(10.0)))
    assert abs(high) == pytest.approx(0.9981, abs=5e-5)


def test_a_compensated_reference_seen_through_the_filters_is_the_plain_one():
    """Steady state: the chain turns x̂ into x."""
    chain = (butterworth("highpass", 4, 5.0, RATE), butterworth("lowpass", 1, 50.0, RATE))
    time = jnp.asarray(np.arange(4000) / RATE)
    angle = phases(FREQUENCY, time)
    gain = response(chain, FREQUENCY)
    seen = compensated(angle, gain)
    for stage in chain:
        seen = jax.vmap(lambda x, s=stage: apply(s, x), in_axes=1, out_axes=1)(seen)
    plain = compensated(angle, jnp.ones_like(gain))
    np.testing.assert_allclose(seen[3000:], plain[3000:], atol=1e-9)


def sensed(order: int, amplitude: float = 0.2, time=TIME):
    """Acceleration or rate of sines, and the motion that it comes from."""
    omega = 2 * np.pi * np.asarray(FREQUENCY)
    angle = time[:, None] * omega
    motion = -np.sin(angle) / omega**2 if order == 2 else -np.cos(angle) / omega
    return jnp.asarray(amplitude * np.sin(angle).sum(axis=1)), jnp.asarray(amplitude * motion.sum(axis=1))


def references(sensor=(), order=2, frequency=FREQUENCY):
    angle, one = phases(frequency, jnp.asarray(TIME)), jnp.ones((len(TIME), 1))
    gain = chain_response(sensor, order, frequency)
    x = jnp.concatenate([compensated(angle, jnp.ones_like(gain)), one], axis=1)
    return x, jnp.concatenate([compensated(angle, gain), 0 * one], axis=1)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("filtered", [False, True])
def test_least_squares_recovers_sinusoids_to_machine_precision(order, filtered):
    """Through an analogue filter in steady state, beside an offset, from the right frequencies among others."""
    read, truth = sensed(order)
    sensor = (butterworth("lowpass", 1, 50.0, None),) if filtered else ()
    gain = np.asarray(response(sensor, FREQUENCY))
    angle = TIME[:, None] * 2 * np.pi * np.asarray(FREQUENCY)
    read = 0.2 * (np.abs(gain) * np.sin(angle + np.angle(gain))).sum(axis=1) + 5.0
    x, z = references(sensor, order, jnp.asarray(band(10.0, 12.0, 0.5)))
    spectrum = Spectrum(jnp.full(x.shape[1], 1e4), jnp.asarray(1e-12))
    found, _ = predict(least_squares(jnp.asarray(read), jnp.ones(len(TIME)), x, spectrum), z)
    np.testing.assert_allclose(found, truth, atol=1e-10 * float(jnp.abs(truth).max()))


def test_the_method_of_the_paper_removes_drift_phase_and_gain():
    """Without noise, RMS within 0.5 % of the signal's; without compensation it is wrong by its size."""
    time = np.arange(4000) / RATE
    read, truth = sensed(2, time=time)
    stage = butterworth("lowpass", 1, 50.0, RATE)
    read = apply(stage, read + 5.0)
    highpass = butterworth("highpass", 4, 5.0, RATE)
    found = latt_bmflc(read, jnp.asarray(time), FREQUENCY, 2, highpass, (stage,), 0.02)
    late = time > 14

    def rms(x):
        return float(jnp.sqrt(jnp.mean(x[late] ** 2)))

    assert rms(found.motion - truth) < 5e-3 * rms(truth)
    assert rms(found.seen - truth) > 0.5 * rms(truth)
    # Analytical integration does not know of the sensor's filter.
    by_analysis = analytical(read, jnp.asarray(time), FREQUENCY, 2, 0.02).motion
    assert 0.1 < rms(by_analysis - truth) / rms(truth) < 0.3


def test_integration_is_a_filter_like_any_other():
    read, _ = sensed(1)
    highpass = butterworth("highpass", 4, 5.0, RATE)
    found, chain = integrated(read, 1, highpass, 1 / RATE)
    expected = np.concatenate([[read[0] / 2], read[0] / 2 + np.cumsum(read[1:] + read[:-1]) / 2]) / RATE
    np.testing.assert_allclose(apply(trapezoid(1 / RATE), read), expected, atol=1e-12)
    np.testing.assert_allclose(found, apply(highpass, jnp.asarray(expected)), atol=1e-12)
    assert len(chain) == 2


def test_the_wflc_converges_to_the_frequency():
    """From 9 Hz to 10.3 Hz, with its second harmonic, through the filters."""
    time = np.arange(5000) / RATE
    omega = 2 * np.pi * 10.3
    truth = np.sin(omega * time) + 0.3 * np.cos(2 * omega * time)
    stage = butterworth("highpass", 4, 5.0, RATE)
    found = wflc(apply(stage, jnp.asarray(truth)), 1 / RATE, 9.0, 2, (stage,), 0, 0.02, 5e-5)
    assert float(found.frequency[-1, 0]) == pytest.approx(10.3, abs=1e-3)
    np.testing.assert_allclose(found.motion[-200:], truth[-200:], atol=0.01)


def test_the_bmflc_follows_its_definition(key):
    """Three steps by hand."""
    s, time = jax.random.normal(key, (3,)), jnp.asarray(TIME[:3])
    found = bmflc(s, time, FREQUENCY, jnp.ones(3, complex), 0.01)
    w = np.zeros(6)
    for k in range(3):
        angle = 2 * np.pi * np.asarray(FREQUENCY) * k / RATE
        x = np.concatenate([np.sin(angle), np.cos(angle)])
        np.testing.assert_allclose(found.weights[k], w, atol=1e-15)
        assert float(found.motion[k]) == pytest.approx(w @ x, abs=1e-15)
        w = w + 0.02 * (float(s[k]) - w @ x) * x


def problem(key, n=300):
    read, _ = sensed(2)
    noisy = read[:n] + 0.04 * jax.random.normal(key, (n,)) + 1.0
    x, z = references()
    return noisy, x[:n], z[:n], Spectrum(jnp.full(x.shape[1], 4.0), jnp.asarray(0.04**2))


def test_the_recursion_ends_at_the_batch_and_at_the_normal_equations(key):
    s, x, z, spectrum = problem(key)
    weight = jnp.asarray(np.arange(len(s)) % 7 != 3, float)
    batch = least_squares(s, weight, x, spectrum)
    tracked = recursive(s, weight, x, z, spectrum, jnp.zeros(x.shape[1]))
    normal = np.asarray((x * weight[:, None]).T @ x) / 0.04**2 + np.eye(x.shape[1]) / 4
    np.testing.assert_allclose(
        batch.weights, np.linalg.solve(normal, x.T @ (weight * s) / 0.04**2), rtol=1e-9
    )
    np.testing.assert_allclose(batch.covariance, np.linalg.inv(normal), rtol=1e-7, atol=1e-14)
    np.testing.assert_allclose(tracked.fit.weights, batch.weights, rtol=1e-8)
    np.testing.assert_allclose(tracked.fit.covariance, batch.covariance, rtol=1e-6, atol=1e-12)
    mean, variance = predict(batch, z)
    assert float(tracked.motion[-1]) == pytest.approx(float(mean[-1]), rel=1e-6)
    assert float(tracked.variance[-1]) == pytest.approx(float(variance[-1]), rel=1e-5)


def test_vmap_equals_the_loop_and_gradients_exist(key):
    s, x, z, spectrum = problem(key)
    rows = jnp.stack([s, 2 * s, s[::-1]])
    ones = jnp.ones(len(s))

    def at_once(row):
        return predict(least_squares(row, ones, x, spectrum), z)[0]

    def paper(row):
        time = jnp.asarray(TIME[: len(s)])
        return latt_bmflc(row, time, FREQUENCY, 2, butterworth("highpass", 4, 5.0, RATE), (), 0.01).motion

    for function in (jax.jit(at_once), jax.jit(paper)):
        together = jax.vmap(function)(rows)
        np.testing.assert_allclose(together, jnp.stack([function(row) for row in rows]), atol=1e-12)

    def cost(noise):
        fit = least_squares(s, ones, x, Spectrum(spectrum.prior, noise))
        return 1e6 * jnp.sum(predict(fit, z)[0] ** 2) + 1e6 * jnp.sum(fit.weights**2)

    cost = jax.jit(cost)
    numeric = (cost(jnp.asarray(0.0016 + 1e-6)) - cost(jnp.asarray(0.0016 - 1e-6))) / 2e-6
    assert float(jax.grad(cost)(jnp.asarray(0.0016))) == pytest.approx(float(numeric), rel=1e-4)

    def gain_cost(mu):
        time = jnp.asarray(TIME[: len(s)])
        found = latt_bmflc(s, time, FREQUENCY, 2, butterworth("highpass", 4, 5.0, RATE), (), mu)
        return jnp.sum((1e3 * found.motion[100:]) ** 2)

    gain_cost = jax.jit(gain_cost)
    numeric = (gain_cost(jnp.asarray(0.01 + 1e-6)) - gain_cost(jnp.asarray(0.01 - 1e-6))) / 2e-6
    assert float(jax.grad(gain_cost)(jnp.asarray(0.01))) == pytest.approx(float(numeric), rel=1e-4)


def test_bands_cover_what_they_say(key):
    """Signals drawn from the model, spectrum learnt from them: 95 % bands hold 93 to 97 % of the motion."""
    rate, n, count = 50.0, 100, 40
    frequency = np.arange(1, 60) / (2 * n)
    density = np.exp(-0.5 * ((frequency * rate - 6) / 1.5) ** 2) + 1e-4
    x = harmonics(np.arange(n, dtype=float), frequency)
    keys = jax.random.split(key, 2)
    w = np.asarray(jax.random.normal(keys[0], (count, 2 * len(frequency)))) * np.sqrt(np.tile(density, 2))
    truth = w @ x[:, :-1].T
    s = truth + 0.7 * np.asarray(jax.random.normal(keys[1], truth.shape))
    power = periodogram(s, frequency)
    start = Spectrum(jnp.asarray(np.concatenate([power, power, [1e-6]])), jnp.asarray(1.0))
    group = jnp.asarray(neighbours(len(frequency), 2))
    ones = jnp.ones(s.shape)
    spectrum = jax.jit(learn, static_argnums=5)(jnp.asarray(s), ones, jnp.asarray(x), group, start, 20)
    assert float(spectrum.noise) == pytest.approx(0.49, rel=0.2)

    @jax.jit
    def band_of(row):
        return predict(least_squares(row, ones[0], jnp.asarray(x), spectrum), jnp.asarray(x))

    inside = []
    for row, true in zip(s, truth, strict=True):
        mean, variance = map(np.asarray, band_of(jnp.asarray(row)))
        inside.append(np.abs(mean - true) < 1.96 * np.sqrt(variance))
    assert 0.93 < np.mean(inside) < 0.97


def test_windows_blend_back_to_the_signal():
    x = np.sin(np.arange(1003.0))
    for length in (100, 777, 1003):
        windows = Windows.cut(len(x), length)
        assert windows.index.min() == 0 and windows.index.max() == 1002
        np.testing.assert_allclose(windows.joined(windows.of(x)), x, atol=1e-12)


def clipped(seconds=8.0, noise=0.02):
    """An amplitude-modulated oscillation of 6 Hz and its harmonic, cut off at ±0.7."""
    time = np.arange(int(seconds * 100)) / 100
    angle = 2 * np.pi * 6 * time + 0.5 * np.sin(time)
    true = (1 + 0.2 * np.sin(0.7 * time)) * np.sin(angle) + 0.1 * np.cos(2 * angle)
    true = true + noise * np.random.default_rng(6).normal(size=len(time))
    return true, np.clip(true, -0.7, 0.7), (true >= 0.7).astype(int) - (true <= -0.7).astype(int)


def test_a_fill_is_beyond_its_rail_near_the_truth_and_within_its_band():
    true, measured, sign = clipped()
    found = fill_harmonic(measured, sign)
    gap = sign != 0
    assert 0.3 < gap.mean() < 0.6
    assert (found.signal == measured)[~gap].all()
    assert (sign * found.signal >= 0.7)[gap].all()
    error = np.sqrt(np.mean((found.signal - true)[gap] ** 2))
    assert error < 0.04 < 0.15 * np.sqrt(np.mean((measured - true)[gap] ** 2)) + 0.02
    assert 0.85 < np.mean(np.abs(found.signal - true)[gap] < 1.96 * found.sd[gap]) <= 1
    # Units and offset do not matter.
    other = fill_harmonic(1e3 * measured - 5.0, sign)
    np.testing.assert_allclose(other.signal, 1e3 * found.signal - 5.0, rtol=1e-6)
    np.testing.assert_allclose(other.sd, 1e3 * found.sd, rtol=1e-5)


def test_a_fill_without_saturation_changes_nothing_and_with_too_much_is_refused():
    _, measured, sign = clipped(2.0)
    assert (fill_harmonic(measured, 0 * sign).signal == measured).all()
    with pytest.raises(InputError, match="too few"):
        fill_harmonic(measured, np.ones_like(sign))


def recording(acc=None, gyr=None, rate=100.0, seconds=6.0, name="shaking") -> Recording:
    n = int(rate * seconds)
    missing = np.zeros((n, 6), bool)
    missing[:, :3], missing[:, 3:] = gyr is None, acc is None
    empty = np.zeros((n, 3))
    return Recording(
        np.arange(n) / rate, empty if gyr is None else gyr, empty if acc is None else acc, missing, name=name
    )


def shaken(rate=100.0, seconds=6.0, tilt=0.0):
    """A sensor shaken along x at 6 Hz by 1 mm, tilting about y by `tilt` rad at the same time."""
    time = np.arange(int(rate * seconds)) / rate
    omega = 2 * np.pi * 6
    position = 1e-3 * np.sin(omega * time)
    angle = tilt * np.sin(omega * time)
    noise = 0.005 * np.random.default_rng(2).normal(size=(len(time), 6))
    # R_nb = exp(angle about y): gravity 9.81 along z has −9.81 sin(angle) along the body's x.
    force = -(omega**2) * position + 0.0
    acc = np.stack(
        [
            force * np.cos(angle) - 9.81 * np.sin(angle),
            0 * time,
            force * np.sin(angle) + 9.81 * np.cos(angle),
        ],
        axis=1,
    )
    gyr = np.stack([0 * time, tilt * omega * np.cos(omega * time), 0 * time], axis=1)
    return position, angle, acc + noise[:, 3:], gyr + noise[:, :3]


@pytest.mark.parametrize("method", ["least_squares", "recursive", "bmflc", "wflc"])
def test_a_shaken_sensor_without_gyroscope(method):
    position, _, acc, _ = shaken()
    options = {"periodic.method": method, "periodic.band": (5.0, 7.0)}
    if method in ("bmflc", "wflc"):
        options |= {"periodic.mu": 0.02}
    found = estimate_periodic(recording(acc), load_config(None, **options))
    late = slice(300, 570)
    error = np.sqrt(np.mean((found.motion[late, 3] - position[late]) ** 2))
    assert error < {"least_squares": 2e-5, "recursive": 5e-5, "wflc": 8e-5, "bmflc": 2e-4}[method]
    assert (found.motion[:, :3] == 0).all() and list(found.band) == ["acc"]
    assert (found.sd is None) == (method in ("bmflc", "wflc"))
    if found.sd is not None:
        # The sd is that of noise and spectrum: right to its order.
        assert 0.3 * error < np.median(found.sd[late, 3]) < 15 * error


def test_tilting_gravity_is_taken_off_where_there_is_a_gyroscope():
    position, angle, acc, gyr = shaken(tilt=0.02)
    config = load_config(None, **{"periodic.band": (5.0, 7.0)})
    both = estimate_periodic(recording(acc, gyr), config)
    alone = estimate_periodic(recording(acc), config)
    late = slice(100, 500)
    np.testing.assert_allclose(both.motion[late, 1], angle[late], atol=5e-4)
    np.testing.assert_allclose(both.motion[late, 3], position[late], atol=2e-4)
    assert np.sqrt(np.mean((alone.motion[late, 3] - position[late]) ** 2)) > 0.09e-3
    assert "no angle from a gyroscope" in alone.warnings[0] and not both.warnings


def test_the_band_is_found_or_its_absence_is_said_with_what_remains(key):
    _, _, acc, _ = shaken(seconds=10.0)
    band = find_band(acc, 0.01)
    assert band is not None
    low, peak, high = band
    assert low < 6 < high and peak == pytest.approx(6, abs=0.3)
    noise = np.asarray(jax.random.normal(key, (3000, 6)))
    assert find_band(noise[:, :3], 0.01) is None
    nothing = recording(noise[:, :3] + [0, 0, 9.81], noise[:, 3:], seconds=30.0)
    support = find_support(nothing)
    assert (support.trajectory, support.periodic, support.orientation) == (False, False, True)
    with pytest.raises(InputError, match=r"no frequency stands out.*supports orientation.*no trajectory"):
        estimate_periodic(nothing)
    still = eqx.tree_at(lambda r: r.gyr, nothing, 1e-3 * nothing.gyr)
    still = eqx.tree_at(lambda r: r.acc, still, 1e-2 * noise[:, :3] + [0, 0, 9.81])
    assert find_support(still).trajectory


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"periodic.band": (5.0, 60.0)}, "half of its rate"),
        ({"periodic.band": (7.0, 5.0)}, "LOW < HIGH"),
        ({"periodic.band": (0.1, 7.0)}, "less than one period"),
        (
            {"periodic.band": (5.0, 7.0), "periodic.method": "bmflc", "periodic.highpass": 80.0},
            "half of the samp",
        ),
        ({"periodic.band": (5.0, 7.0), "periodic.method": "bmflc", "periodic.mu": 0.5}, "does not converge"),
        ({"periodic.band": (5.0, 7.0), "periodic.sensor_lowpass": -3.0}, "positive frequency"),
    ],
)
def test_what_cannot_be_is_one_sentence(options, words):
    _, _, acc, _ = shaken()
    with pytest.raises(InputError, match=words) as raised:
        estimate_periodic(recording(acc), load_config(None, **options))
    assert "\n" not in str(raised.value) and ";" in str(raised.value)


def test_bands_and_filters_that_cannot_be_are_refused():
    with pytest.raises(InputError, match="band"):
        band(5.0, 4.0, 0.5)
    with pytest.raises(InputError, match="order"):
        butterworth("highpass", 0, 5.0, 100.0)


def test_real_tremor_has_its_known_frequencies(shared_data):
    """The data's own description: 5.9 Hz at rest, 7.4 to 7.8 Hz in posture."""
    from jaxsat.signals.readers import read

    for pattern, low, high in (("*POSTURAL*LEFT*", 7.2, 8.0),):
        (path,) = (shared_data / "tremor").glob(pattern)
        found = find_band(read(path).acc, 0.01)
        assert found is not None and low < found[1] < high


def test_the_arm_that_moves_from_rest_to_rest_has_a_trajectory_but_no_period(shared_data):
    from jaxsat.signals.readers import read

    support = find_support(read(shared_data / "robot_arm" / "V1500_Sequencia4_SENTRAL.mat"))
    assert support.trajectory and not support.periodic


@pytest.fixture(scope="module")
def shaken_csv(tmp_path_factory):
    """A shaken sensor whose accelerometer ends at ±1.2 m/s² beyond its mean along x; there is no gyroscope."""
    position, _, acc, _ = shaken(seconds=6.0)
    acc[:, 0] = np.clip(acc[:, 0], -1.2, 1.2)
    path = tmp_path_factory.mktemp("shaken") / "shaken.csv"
    table = pd.DataFrame(acc, columns=["acc_x", "acc_y", "acc_z"])
    for axis in "xyz":
        table.insert(0, f"gyr_{axis}", np.nan)
    table.insert(0, "time", np.arange(len(table)) / 100)
    table.to_csv(path, index=False)
    return path, position


def test_the_command_writes_its_files_and_fills_what_saturated(shaken_csv, tmp_path, capsys):
    path, position = shaken_csv
    out = tmp_path / "out"
    assert main(["periodic", str(path), "-o", str(out), "--band", "5", "7", "--csv"]) == 0
    printed = capsys.readouterr()
    assert "position x" in printed.out and "tilting" in printed.err
    names = {"periodic.csv", "signals.csv", "gaps.csv", "summary.json"}
    assert {entry.name for entry in out.iterdir()} == names
    found, gaps = pd.read_csv(out / "periodic.csv"), pd.read_csv(out / "gaps.csv")
    assert list(found) == ["time", "pos_x", "pos_y", "pos_z", "pos_x_sd", "pos_y_sd", "pos_z_sd"]
    error = np.sqrt(np.mean((found["pos_x"] - position)[100:500] ** 2))
    assert error < 0.05 * position.std()
    # The peak is 1.42 m/s².
    assert set(gaps["channel"]) == {"acc_x"} and 1.3 < gaps["peak"].abs().median() < 1.55
    summary = json.loads((out / "summary.json").read_text())
    assert summary["method"] == "least_squares" and summary["band"] == {"acc": [5.0, 7.0]}
    assert (
        main(["periodic", str(path), "-o", str(out), "--band", "5", "7", "--method", "bmflc", "--quiet"]) == 0
    )
    assert pd.read_parquet(out / "periodic.parquet")["pos_x_sd"].isna().all()


@pytest.mark.parametrize(
    "arguments",
    ["--band 5 70", "--band 7 5", "--band 0.01 1", "--band 5", "--method fft", "--sensor-lowpass 0"],
)
def test_bad_arguments_of_the_command_are_one_line(arguments, shaken_csv, tmp_path, capfd):
    path, _ = shaken_csv
    assert main(["periodic", str(path), "-o", str(tmp_path / "out"), *arguments.split()]) == 2
    printed = capfd.readouterr()
    assert printed.out == "" and printed.err.startswith("jaxsat: ") and printed.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []
