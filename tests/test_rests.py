"""Rests against motion capture and brute force; segments against a loop."""

import tomllib

import numpy as np
import pytest
import scipy.io
from scipy.ndimage import uniform_filter1d

from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording, sensor_changes
from jaxsat.signals.rests import (
    OFFSET_SD,
    detector_statistic,
    find_rests,
    find_segments,
    rest_threshold,
    resting_rate,
    runs,
)

PERIOD = 0.005
DETECTORS = ("shoe", "ared", "amvd", "mag")


def recording(gyr: np.ndarray, acc: np.ndarray, **other) -> Recording:
    n = len(gyr)
    return Recording(time=np.arange(n) * PERIOD, gyr=gyr, acc=acc, missing=np.zeros((n, 6), bool), **other)


def still(n: int, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(seed)
    return 0.01 * rng.standard_normal((n, 3)), [0, 0, 9.81] + 0.05 * rng.standard_normal((n, 3))


def walking(strides: int = 12) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Stances of 0.4 s and swings of 0.6 s after 2 s of standing."""
    gyr, acc = still(400 + 200 * strides)
    stance = np.ones(len(gyr), bool)
    phase = np.sin(np.pi * (np.arange(120) + 0.5) / 120)
    for k in range(strides):
        swing = slice(400 + 200 * k, 520 + 200 * k)
        gyr[swing, 1] += 7 * phase
        acc[swing, 0] += 15 * np.cos(0.7 * np.arange(120))
        acc[swing, 2] += 15 * np.sin(0.7 * np.arange(120))
        stance[swing] = False
    return gyr, acc, stance


@pytest.mark.parametrize("name", DETECTORS)
def test_statistic_is_the_written_sum(name):
    gyr, acc, _ = walking(2)
    size = 9
    rate = uniform_filter1d(np.sum(gyr**2, axis=1), size, mode="nearest")
    length = np.linalg.norm(uniform_filter1d(acc, size, axis=0, mode="nearest"), axis=1)
    g = np.median(length[rate <= np.quantile(rate, 0.05)])
    result = detector_statistic(name, gyr, acc, PERIOD, window=0.045)
    for k in (4, 100, 430, 460, 700):
        w, a = gyr[k - 4 : k + 5], acc[k - 4 : k + 5]
        mean = a.mean(axis=0)
        expected = {
            "shoe": np.mean(np.sum(w**2, 1) + np.sum((a - g * mean / np.linalg.norm(mean)) ** 2, 1) / 100),
            "ared": np.mean(np.sum(w**2, 1)),
            "amvd": np.mean(np.sum((a - mean) ** 2, 1)),
            "mag": np.mean((np.linalg.norm(a, axis=1) - g) ** 2),
        }[name]
        np.testing.assert_allclose(result[k], expected, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("name", DETECTORS)
def test_walk_rests_in_its_stances(name):
    gyr, acc, stance = walking()
    rest = find_rests(recording(gyr, acc), name)
    # The window blurs each of the 24 borders by up to half its length.
    assert np.sum(rest != stance) <= 24 * 6
    assert len(find_segments(rest)) == 12


@pytest.mark.parametrize("name", DETECTORS)
def test_all_rest_is_one_rest(name):
    gyr, acc = still(3000)
    assert find_rests(recording(gyr, acc), name).all()


def test_motion_without_rest_has_no_rest():
    t = np.arange(4000) * PERIOD
    gyr = np.stack([2 * np.sin(3 * t) + 1, 2 * np.cos(3 * t), 1 + 0.5 * np.sin(t)], axis=1)
    acc = 9.81 + np.stack([np.sin(5 * t), np.cos(5 * t), np.sin(4 * t)], axis=1)
    assert not find_rests(recording(gyr, acc)).any()


def test_exact_zeros_do_not_warn():
    assert find_rests(recording(np.zeros((50, 3)), np.tile([0, 0, 9.81], (50, 1)))).all()


def test_given_rests_pass_through():
    gyr, acc, _ = walking(2)
    given = np.arange(len(gyr)) % 7 == 0
    assert np.array_equal(find_rests(recording(gyr, acc, rest=given)), given)


def stepping(stances: list[tuple[float, float]], swing: float = 10.0) -> tuple[Recording, np.ndarray]:
    """Stances (s, rad/s), each followed by a swing of 0.6 s; and which stance a sample belongs to, -1 in swings."""
    bump = swing * np.sin(np.pi * (np.arange(120) + 0.5) / 120)
    rates, which = [], []
    for k, (seconds, rate) in enumerate(stances):
        stance = np.full(round(seconds / PERIOD), rate)
        rates += [stance, np.maximum(bump, rate)]
        which += [np.full(len(stance), k), np.full(120, -1)]
    rate = np.concatenate(rates)
    gyr = np.stack([0 * rate, rate, 0 * rate], axis=1)
    return recording(gyr, np.tile([0.0, 0.0, 9.81], (len(rate), 1))), np.concatenate(which)


def test_the_stances_of_a_runner_rest_though_they_are_livelier():
    strides = [(0.2, 0.5)] * 8 + [(0.06, 1.2)] * 6 + [(0.2, 0.5)] * 3
    runner, which = stepping(strides)
    rest, given = find_rests(runner), find_rests(runner, threshold=1.0)
    assert set(which[rest]) - {-1} == set(range(len(strides)))
    assert np.abs(runner.gyr[rest]).max() < 1.5
    assert set(which[given]) - {-1} == set(range(len(strides))) - set(range(8, 14))
    # Not where the foot hardly swings beside them, nor where there are no strides to compare with.
    slow, _ = stepping(strides[8:14], swing=3.0)
    first, last = (which == 8).argmax(), (which == 14).argmax()
    shuffling = runner.gyr.copy()
    shuffling[first : first + len(slow)] = slow.gyr
    assert first + len(slow) == last
    assert not find_rests(recording(shuffling, runner.acc))[first + 20 : last - 20].any()
    few, which = stepping(strides[5:11])
    assert not (set(which[find_rests(few)]) & {3, 4, 5})


def test_saturated_and_unmeasured_samples_never_rest():
    gyr, acc = still(1000)
    saturated = np.zeros(1000, bool)
    saturated[300:320] = True
    r = recording(gyr, acc)
    r.missing[500:600] = True
    rest = find_rests(r, saturated=saturated)
    assert np.array_equal(rest, ~saturated & ~r.missing[:, 0])


def test_rests_below_the_minimum_duration_are_dropped():
    gyr, acc, _ = walking(3)
    r = recording(gyr, acc)
    start, end = runs(find_rests(r, min_duration=0.5))
    assert len(start) == 1 and end[0] >= 395
    for minimum in (0.0, 0.1, 0.3):
        start, end = runs(find_rests(r, min_duration=minimum))
        assert len(start) == 4 and ((end - start) * PERIOD >= minimum).all()


def test_threshold_scales_with_the_swing_but_stays_within_physics():
    gyr, acc, _ = walking()
    for factor in (0.3, 1, 3):
        statistic = detector_statistic("ared", factor * gyr, acc, PERIOD)
        assert 0.1**2 * 0.999 <= rest_threshold(statistic, PERIOD, "ared") <= 1.0001


@pytest.mark.parametrize("seed", range(6))
def test_segments_equal_a_loop(seed):
    rng = np.random.default_rng(seed)
    rest = np.repeat(rng.random(40) < 0.5, rng.integers(1, 6, 40))
    rest = (rest, np.zeros(9, bool), np.ones(9, bool))[0 if seed < 4 else seed - 3]
    expected, k = [], 0
    while k < len(rest):
        if rest[k]:
            k += 1
            continue
        departure = k - 1
        while k < len(rest) and not rest[k]:
            k += 1
        stop = k
        while stop < len(rest) and rest[stop]:
            stop += 1
        expected.append((departure, k, stop))
    s = find_segments(rest)
    assert list(zip(s.departure, s.arrival, s.rest_end, strict=True)) == expected
    assert len(s) == len(expected)


def capture(shared_data):
    """Foot recordings with the speed from motion capture and the flags that were tuned on it."""
    folder = shared_data / "pyshoe"
    for group, names in tomllib.loads((folder / "splits.toml").read_text()).items():
        for name in names:
            mat = scipy.io.loadmat(folder / f"{name}.mat", variable_names=["gt", "ts", "zv_shoe_opt"])
            velocity = np.gradient(mat["gt"].astype(float), mat["ts"].ravel(), axis=0)
            speed = np.linalg.norm(uniform_filter1d(velocity, 5, axis=0), axis=1)
            tuned = mat["zv_shoe_opt"].ravel().astype(bool)
            yield group, name, read(folder / f"{name}.mat"), speed, tuned


def test_feet_really_rest_as_well_as_with_tuned_thresholds(shared_data):
    moving, tuned_moving, found = [], [], {}
    for group, name, foot, speed, tuned in capture(shared_data):
        rest = find_rests(foot)
        moving.append(np.mean(speed[rest] > 0.1))
        tuned_moving.append(np.mean(speed[tuned] > 0.1))
        assert np.median(speed[rest]) < 0.06, name
        # Stances: tuned flags less than 0.25 s apart belong to one.
        start, end = runs(tuned)
        first = np.concatenate([[True], start[1:] - end[:-1] > 50])
        last = np.concatenate([first[1:], [True]])
        hit = [rest[a:b].any() for a, b in zip(start[first], end[last], strict=True)]
        found.setdefault(group, []).append(np.mean(hit))
    assert np.mean(moving) < np.mean(tuned_moving) + 0.02
    assert max(moving) < 0.2
    assert np.mean(found["saturated"]) > 0.94 and min(found["saturated"]) > 0.8
    assert np.mean(found["clip"]) > 0.99


def test_board_rests_where_the_experimenters_say(shared_data):
    for path in sorted((shared_data / "broad").glob("*.npz")):
        rest = find_rests(read(path))
        moving = np.load(path)["movement"]
        assert np.mean(rest == ~moving) > 0.98, path.name
        assert np.mean(rest[moving]) < 0.05, path.name


OFFSET = np.array([0.02, -0.01, 0.0])


def swaying(n: int, sway: float, seed: int = 0) -> np.ndarray:
    """Rates of a sensor that turns to and fro with a correlation of half a second, and has an offset."""
    rng = np.random.default_rng(seed)
    white = rng.standard_normal((n, 3))
    correlated = uniform_filter1d(white, round(0.5 / PERIOD), axis=0) * np.sqrt(0.5 / PERIOD)
    return OFFSET + 1e-3 * rng.standard_normal((n, 3)) + sway * correlated


def test_a_gyroscope_that_lies_still_says_its_offset():
    found, _ = resting_rate(swaying(600, sway=0.0), np.ones(600, bool), PERIOD)
    np.testing.assert_allclose(found, OFFSET, atol=2e-4)


def test_a_rest_that_sways_is_believed_as_far_as_it_goes():
    """Over many seeds the offset from two seconds of sway is nearer to the truth than the mean rate."""
    rest, errors = np.ones(400, bool), []
    for seed in range(40):
        rates = swaying(400, sway=0.02, seed=seed) - OFFSET
        errors.append([resting_rate(rates, rest, PERIOD)[0], rates.mean(axis=0)])
    shrunk, mean = np.sqrt(np.mean(np.square(errors), axis=(0, 2)))
    assert shrunk < 0.8 * mean
    # Where there is a large one, it is not mistaken for sway.
    large = [resting_rate(swaying(400, sway=0.002, seed=seed), rest, PERIOD)[0] for seed in range(40)]
    assert np.abs(np.mean(large, axis=0) - OFFSET).max() < OFFSET_SD


def test_a_quiet_rest_outweighs_a_stirring_one_and_short_ones_are_not_asked():
    stirring, quiet = swaying(300, sway=0.05), swaying(400, sway=0.0)
    moving = np.full((100, 3), 3.0)
    rates = np.concatenate([stirring, moving, quiet])
    rest = np.abs(rates).max(axis=1) < 2.0
    np.testing.assert_allclose(resting_rate(rates, rest, PERIOD)[0], OFFSET, atol=1e-3)
    short = rest & (np.arange(len(rest)) < 150)
    offset, sd = resting_rate(rates, short, PERIOD)
    assert not offset.any() and (sd == OFFSET_SD).all()


def test_a_change_is_that_of_a_sensor_to_the_farther_neighbour():
    signal = np.zeros((5, 6))
    signal[2, 0], signal[2, 4], signal[4, 3] = 3.0, 2.0, 4.0
    expected = np.repeat([[0, 0], [3, 2], [3, 2], [3, 4], [0, 4]], 3, axis=1)
    np.testing.assert_array_equal(sensor_changes(signal), expected)
