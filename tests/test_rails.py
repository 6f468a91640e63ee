"""Rails against recordings that were looked at, clipped in software, and smooth by construction."""

import tomllib

import numpy as np
import pytest

from jaxsat.errors import InputError
from jaxsat.signals.rails import find_gaps, find_rails, saturation_mask
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording

DEG, G = np.pi / 180, 9.80665
AXES = ["gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y", "acc_z"]
NONE = np.full(6, np.inf)

# Flat tops of 5 samples or more, found by printing every run of samples within 2.5 % (gyroscope) or 7 %
# (accelerometer) of each extreme with two neighbours and reading them: runs whose steps fall from tens of °/s
# to about one and back (-gy "469 516 522.9 523.5 523.7 523.5 … 513 474"), or several short runs that
# jump by hundreds of °/s and end at one level (-gx "99 431 548 543 280", "62 318 546 549 550 395").
# Left out: fewer than 5 such samples (single peaks of one trial, though other trials show a rail there).
LOOKED_AT = {
    "2017-11-22-11-35-59": ["-gyr_y"],
    "2017-11-22-11-36-45": ["-gyr_y"],
    "2017-11-22-11-37-47": ["+gyr_x"],
    "2017-11-22-11-49-29": ["-gyr_y"],
    "2017-11-27-11-11-24": ["-gyr_y"],
    "2017-11-27-11-12-18": ["-gyr_y"],
    "2017-11-27-11-13-10": ["-gyr_x", "-gyr_z"],
    "2017-11-27-11-14-03": ["-gyr_y", "+gyr_y"],
    "2017-11-27-11-17-28": ["-gyr_x", "-gyr_y"],
    "2017-11-27-11-23-18": ["-gyr_x", "-gyr_y"],
    "2017-11-27-11-25-12": ["-gyr_x", "-gyr_y"],
    "2017-12-15-18-00-40": ["-gyr_y"],
    "2018-02-09-11-32-01": ["-gyr_x"],
}
# Lowest and highest plateau sample that the eye accepts (°/s), from the same reading.
PLATEAU = {
    "-gyr_x": (535, 558),
    "+gyr_x": (552, 558),
    "-gyr_y": (499, 529),
    "+gyr_y": (525, 547),
    "-gyr_z": (532, 537),
}


def recording(signal: np.ndarray, period: float = 0.005, **other) -> Recording:
    n = len(signal)
    missing = other.pop("missing", np.zeros((n, 6), bool))
    return Recording(
        time=np.arange(n) * period, gyr=signal[:, :3], acc=signal[:, 3:], missing=missing, **other
    )


def one_channel(x: np.ndarray) -> Recording:
    signal = np.zeros((len(x), 6))
    signal[:, 1], signal[:, 5] = x, G
    return recording(signal)


def levels(rails) -> dict[str, float]:
    low = {f"-{axis}": -v for axis, v in zip(AXES, rails.low, strict=True) if np.isfinite(v)}
    return low | {f"+{axis}": v for axis, v in zip(AXES, rails.high, strict=True) if np.isfinite(v)}


def clean(shared_data):
    """Recordings in which nothing saturates."""
    splits = tomllib.loads((shared_data / "pyshoe/splits.toml").read_text())
    for name in [*splits["clip"], *splits["other"]]:
        if name not in LOOKED_AT:
            yield read(shared_data / f"pyshoe/{name}.mat")
    for pattern in ("broad/*.npz", "openshoe/*.npz", "xio/*.csv", "tremor/*.csv"):
        for path in sorted(shared_data.glob(pattern)):
            yield read(path)


def software(shared_data):
    """Recordings and limits to clip them at (°/s, g)."""
    splits = tomllib.loads((shared_data / "pyshoe/splits.toml").read_text())
    for name in splits["clip"]:
        yield read(shared_data / f"pyshoe/{name}.mat"), (350, 250, 200), ()
    yield read(shared_data / "xio/short_walk.csv"), (500, 400, 250), (3, 2)
    for number in (36, 44):
        yield read(shared_data / f"openshoe/Measurement_100521_{number}.npz"), (350, 300), ()
    for side in ("left_sensor", "right_sensor"):
        yield read(shared_data / "gaitmap/imu_sample_not_rotated.csv", sensor=side), (300,), (8,)


def clipped(shared_data):
    """(recording, sensor columns, limit) of every software clip, the recording being the unclipped one."""
    for whole, gyr, acc in software(shared_data):
        for limit in gyr:
            yield whole, slice(0, 3), limit * DEG
        for limit in acc:
            yield whole, slice(3, 6), limit * G


def test_trials_have_the_rails_that_were_seen(shared_data):
    for name, expected in LOOKED_AT.items():
        trial = read(shared_data / f"pyshoe/{name}.mat")
        rails = find_rails(trial)
        found = levels(rails)
        assert set(expected) <= set(found), name
        for rail in expected:
            low, high = PLATEAU[rail]
            assert low - 1 <= found[rail] / DEG <= high, (name, rail)
        # What is found beyond the list has fewer than five samples, at a level of the same device.
        counts = dict(zip([f"-{a}" for a in AXES], rails.low_count, strict=True))
        counts |= dict(zip([f"+{a}" for a in AXES], rails.high_count, strict=True))
        for rail in set(found) - set(expected):
            assert counts[rail] < 5 and 485 < found[rail] / DEG < 560, (name, rail)


def test_digital_flat_top_of_the_robot(shared_data):
    for number, expected in ((3, "+acc_z"), (4, "-acc_y")):
        found = levels(find_rails(read(shared_data / f"robot_arm/V1500_Sequencia{number}_SENTRAL.mat")))
        assert abs(found[expected] / G - 1.998) < 0.02


def test_what_does_not_saturate_has_no_flags(shared_data):
    for whole in clean(shared_data):
        mask, _ = saturation_mask(whole, find_rails(whole))
        assert mask.any(axis=1).mean() < 1e-3, whole.name


def test_software_clips_are_found_exactly(shared_data):
    rails = found = exact = samples = hits = 0
    for whole, sensor, limit in clipped(shared_data):
        signal = whole.signal
        signal[:, sensor] = np.clip(signal[:, sensor], -limit, limit)
        cut = whole.with_signal(signal)
        result = find_rails(cut)
        mask, sign = saturation_mask(cut, result)
        truth = np.zeros(sign.shape, int)
        truth[:, sensor] = np.where(np.abs(signal[:, sensor]) == limit, np.sign(signal[:, sensor]), 0)
        for s, level in ((-1, -result.low), (1, result.high)):
            many = (truth == s).sum(axis=0) >= 5
            rails += many.sum()
            found += np.isfinite(level[many]).sum()
            exact += (level[many] == limit).sum()
        assert ((truth == 0) & mask).any(axis=1).mean() < 1e-3, whole.name
        truth[whole.missing] = 0
        samples += np.count_nonzero(truth)
        hits += np.sum((truth != 0) & (truth == sign))
    assert found == exact == rails
    assert hits / samples > 0.9995


def test_calibrated_after_clipping_is_still_found(shared_data):
    rng = np.random.default_rng(7)
    rails = found = samples = hits = 0
    for whole, sensor, limit in clipped(shared_data):
        signal = whole.signal
        raw = np.clip(signal[:, sensor], -limit, limit)
        calibration = np.eye(3) + 0.01 * rng.standard_normal((3, 3))
        signal[:, sensor] = raw @ calibration.T + 0.002 * limit * rng.standard_normal(3)
        cut = whole.with_signal(signal)
        result = find_rails(cut)
        mask, sign = saturation_mask(cut, result)
        truth = np.zeros(sign.shape, int)
        truth[:, sensor] = np.where(np.abs(raw) == limit, np.sign(raw), 0)
        for s, level in ((-1, -result.low), (1, result.high)):
            many = (truth == s).sum(axis=0) >= 5
            rails += many.sum()
            found += np.isfinite(level[many]).sum()
        assert ((truth == 0) & mask).any(axis=1).mean() < 0.02, whole.name
        truth[whole.missing] = 0
        samples += np.count_nonzero(truth)
        hits += np.sum((truth != 0) & (truth == sign))
    assert found / rails > 0.97
    assert hits / samples > 0.95


@pytest.mark.parametrize("frequency", [0.5, 1, 3, 7.3, 10, 12.5, 20, 33])
@pytest.mark.parametrize("noise", [0.0, 0.01])
@pytest.mark.parametrize("quantum", [0.0, 0.02])
def test_sines_are_whole(frequency, noise, quantum):
    t = np.arange(6000) * 0.005
    for phase in (0.0, 0.3):
        x = 8 * np.sin(2 * np.pi * frequency * t + phase)
        x = x + noise * np.random.default_rng(3).standard_normal(len(x))
        x = np.round(x / quantum) * quantum if quantum else x
        assert levels(find_rails(one_channel(x))) == {}


@pytest.mark.parametrize("frequency", [0.5, 1, 3, 7.3, 10, 13.37])
@pytest.mark.parametrize("noise", [0.0, 0.01])
def test_clipped_sines_are_not(frequency, noise):
    t = np.arange(6000) * 0.005
    x = 8 * np.sin(2 * np.pi * frequency * t + 0.3)
    x = np.clip(x + noise * np.random.default_rng(3).standard_normal(len(x)), -6, 6)
    assert levels(find_rails(one_channel(x))) == {"-gyr_y": 6.0, "+gyr_y": 6.0}


def test_unequal_harmonics_are_whole():
    t = np.arange(6000) * 0.005
    assert levels(find_rails(one_channel(8 * np.sin(t**2 / 3)))) == {}
    assert (
        levels(find_rails(one_channel(4 * np.sin(7 * t) + 3 * np.sin(11.3 * t) + 2 * np.sin(31 * t)))) == {}
    )
    assert levels(find_rails(one_channel(8 * np.tanh(5 * np.sin(6 * t))))) == {}


@pytest.mark.parametrize("quantum", [0.0, 0.001, 0.005, 0.01, 0.02, 0.05, 0.1])
def test_rest_has_no_rail(quantum):
    for seed in range(3):
        signal = 0.01 * np.random.default_rng(seed).standard_normal((6000, 6)) + [0.02, 0, 0, 0, 0, G]
        signal = np.round(signal / quantum) * quantum if quantum else signal
        assert levels(find_rails(recording(signal))) == {}


def test_quantised_clip_is_found():
    rng = np.random.default_rng(5)
    t = np.arange(8000) * 0.005
    x = 6 * np.sin(9 * t) * (1 + 0.3 * np.sin(0.7 * t)) + 0.02 * rng.standard_normal(len(t))
    count = 8.75e-3 * DEG
    x = np.clip(np.round(x / count), -20000, 20000) * count
    assert levels(find_rails(one_channel(x))) == {"-gyr_y": 20000 * count, "+gyr_y": 20000 * count}
    peaks = np.round(x / 2 / count) * count
    assert levels(find_rails(one_channel(np.clip(peaks, -99, 99)))).keys() == {"-gyr_y", "+gyr_y"}


def test_shift_of_level_and_unit_do_not_matter(shared_data):
    trial = read(shared_data / "pyshoe/2017-11-22-11-36-45.mat")
    rails = find_rails(trial)
    scaled = find_rails(trial.with_signal(trial.signal * 57.3))
    np.testing.assert_allclose(scaled.low, rails.low * 57.3, rtol=1e-12)
    flipped = find_rails(trial.with_signal(-trial.signal))
    np.testing.assert_array_equal(flipped.high, -rails.low)


@pytest.mark.parametrize("seed", range(40))
def test_odd_inputs_do_not_warn(seed):
    rng = np.random.default_rng(seed)
    n = int(rng.integers(2, 30))
    scale = 10.0 ** rng.integers(-12, 6)
    x = rng.choice([0.0, 1.0, 9.81]) + scale * np.round(rng.standard_normal((n, 6)), int(rng.integers(0, 6)))
    r = recording(np.clip(x, -1e4, 1e4))
    r.missing[:, 0] = True
    mask, sign = saturation_mask(r, find_rails(r))
    assert not mask[:, 0].any() and np.array_equal(mask, sign != 0)


def test_plateau_at_the_ends_is_flagged_once_the_rail_is_known():
    t = np.arange(4000) * 0.005
    x = np.clip(8 * np.cos(2 * np.pi * 1.3 * t) * (1 + 0.2 * np.sin(t)), -6, 6)
    r = one_channel(x)
    mask, _ = saturation_mask(r, find_rails(r))
    assert mask[0, 1] and np.array_equal(mask[:, 1], np.abs(x) == 6)


def test_given_rails_and_none():
    signal = np.random.default_rng(0).standard_normal((100, 6))
    rails = find_rails(recording(signal), gyr=1.0, acc="none")
    np.testing.assert_allclose(rails.high, [1, 1, 1, *NONE[:3]], rtol=2e-6)
    np.testing.assert_allclose(rails.low, -rails.high)
    assert np.array_equal(rails.high_count[:3], (signal[:, :3] >= 1).sum(axis=0))
    with pytest.raises(InputError, match="positive magnitude"):
        find_rails(recording(signal), gyr=-1.0)


def test_given_rail_in_another_unit_touches_its_plateau():
    x = np.float32(np.clip(700 * np.sin(np.arange(500) / 9), -500, 500)) * np.float32(DEG)
    mask, _ = saturation_mask(
        one_channel(x.astype(float)), find_rails(one_channel(x.astype(float)), gyr=500 * DEG)
    )
    assert mask[:, 1].sum() > 100


def test_device_flags_are_added_and_missing_samples_left_out():
    signal = np.zeros((10, 6))
    signal[:, 0], signal[:, 4] = 3.0, -2.0
    clip, missing = np.zeros((10, 6), bool), np.zeros((10, 6), bool)
    clip[2:5, 0], clip[6, 4] = True, True
    missing[3] = True
    r = recording(signal, clipped=clip, missing=missing)
    mask, sign = saturation_mask(r, find_rails(r, gyr="none", acc="none"))
    assert np.array_equal(np.argwhere(mask), [[2, 0], [4, 0], [6, 4]])
    assert sign[2, 0] == 1 and sign[6, 4] == -1 and np.array_equal(mask, sign != 0)


def test_gaps_equal_a_loop():
    sign = np.random.default_rng(2).integers(-1, 2, (60, 6))
    sign[:3, 1], sign[-4:, 2] = -1, 1
    expected = []
    for channel in range(6):
        k = 0
        while k < len(sign):
            s, start = sign[k, channel], k
            while k < len(sign) and sign[k, channel] == s:
                k += 1
            if s:
                expected.append((channel, s, start, k))
    gaps = find_gaps(sign)
    assert list(zip(gaps.channel, gaps.sign, gaps.start, gaps.end, strict=True)) == expected
    assert len(find_gaps(np.zeros((5, 6), int))) == 0
