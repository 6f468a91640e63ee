"""The whole way on simulated recordings: the paper's ratios, no harm without saturation, both orders of segments."""

import tomllib
from dataclasses import replace

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxsat.config import load_config
from jaxsat.errors import InputError
from jaxsat.inertial.programs import keep_traces
from jaxsat.pipeline import Estimate, estimate
from jaxsat.preparation import LATEST_FIRST_REST
from jaxsat.present.summary import summarise
from jaxsat.present.tables import gaps_table
from jaxsat.saturation import compensate
from jaxsat.saturation.compensate import ENTRIES, signal_prior, solved_together
from jaxsat.saturation.layout import LANES
from jaxsat.signals.readers import read
from jaxsat.studies.metrics import load_pyshoe_truth, position_rmse
from jaxsat.studies.motions import Bar, Walk
from jaxsat.studies.simulate import Sensor, simulate

BIASES = {"smoother.gyr_bias_sd": 1e-3, "smoother.acc_bias_sd": 0.05}
BAR = {"saturation.gyr_bound": 5.0, "rails.gyr": 7.5}
PAPER = {"direct": 0.070, "triangle": 0.098, "quadratic": 0.079}
"""Last-position error over that of the standard smoother, from Table 1 of Dang & Suh 2014."""


def bar(seed: int, **sensor):
    recording, truth = simulate(
        Bar(), rate=100.0, duration=1.6, sensor=Sensor(**sensor), key=jax.random.key(seed)
    )
    return eqx.tree_at(lambda r: r.rest, recording, truth.rest, is_leaf=lambda x: x is None), truth


def walk(strides: int, seed: int = 1, **sensor):
    motion = Walk(strides=strides)
    duration = float(motion.moving[-1, 1]) + 1.0
    recording, truth = simulate(
        motion, rate=100.0, duration=duration, sensor=Sensor(**sensor), key=jax.random.key(seed)
    )
    return eqx.tree_at(lambda r: r.rest, recording, truth.rest, is_leaf=lambda x: x is None), truth


def last_error(found, truth) -> float:
    return float(np.linalg.norm(found.trajectory.position[-1] - truth.position[-1]))


@pytest.mark.parametrize(
    "method",
    ["direct", *(pytest.param(shape, marks=pytest.mark.slow) for shape in ("triangle", "quadratic"))],
)
def test_bar_of_the_paper_is_compensated_at_least_as_well_as_in_table_1(method):
    """Rail 7.5 of a peak of 11 rad/s, δ_b = 5; median of 20 seeds."""
    ratios = []
    for seed in range(20):
        recording, truth = bar(seed, gyr_rail=7.5)
        standard = np.linalg.norm(
            estimate(recording, load_config(None, method="standard", **BAR)).trajectory.position[-1]
            - truth.position[-1]
        )
        found = estimate(recording, load_config(None, method=method, **BAR))
        assert found.fills.status.tolist() == [0] and found.fills.residual.max() <= 1e-2
        ratios.append(last_error(found, truth) / standard)
    assert np.median(ratios) <= PAPER[method]


@pytest.mark.parametrize("method", ["map", pytest.param("quadratic", marks=pytest.mark.slow)])
def test_filled_signal_lies_beyond_the_rail_and_near_the_truth(method):
    recording, truth = bar(3, gyr_rail=7.5)
    found = estimate(recording, load_config(None, method=method, **BAR))
    where = truth.saturated
    assert (found.saturated == where).all() and where.sum() == 22
    added = (found.filled - recording.signal)[where] * found.sign[where]
    assert (added >= 0.0).all() and (added <= 5.0).all()
    assert (found.filled == recording.signal)[~where].all()
    error = np.sqrt(np.mean((found.filled - truth.signal)[where] ** 2))
    ignored = np.sqrt(np.mean((recording.signal - truth.signal)[where] ** 2))
    assert error < 0.1 * ignored


def test_the_path_of_map_takes_filled_rates_as_measured_and_its_covariance_does_not():
    recording, _ = bar(3, gyr_rail=7.5)
    # What is learned of the sensor depends on how well the filled values are known.
    given = {**BAR, "noise.change": 0.0, "smoother.acc_bias_sd": 0.0, "smoother.lever_sd": 0.0}
    found = estimate(recording, load_config(None, method="map", **given))
    mended = replace(recording.with_signal(found.filled), clipped=None)
    plain = estimate(mended, load_config(None, **{**given, "rails.gyr": "none", "method": "standard"}))
    assert not plain.saturated.any() and found.saturated.any()
    np.testing.assert_allclose(found.trajectory.position, plain.trajectory.position, atol=1e-9)
    np.testing.assert_allclose(found.trajectory.q_nb, plain.trajectory.q_nb, atol=1e-9)
    sure, unsure = (np.diagonal(x.trajectory.covariance, axis1=1, axis2=2) for x in (plain, found))
    assert (unsure >= sure * (1 - 1e-6)).all() and (unsure.max(axis=0) > 1.01 * sure.max(axis=0)).any()


def test_a_path_is_free_where_the_bound_holds_a_rate():
    """δ_b of 2 where up to 3.5 are lost: the path of `map` is not held to rates that are known to be too low."""
    recording, truth = bar(3, gyr_rail=7.5)
    found = estimate(recording, load_config(None, method="map", **{**BAR, "saturation.gyr_bound": 2.0}))
    assert found.fills.at_bound.sum() > 5
    assert ((found.fills.slack > found.fills.slack[0, 0]) == found.fills.at_bound).all()
    standard = np.linalg.norm(found.standard_position[-1] - truth.position[-1])
    assert last_error(found, truth) < 0.1 * standard


def test_what_map_would_worsen_is_left_as_measured_and_only_taken_as_noisier(monkeypatch):
    recording, truth = bar(3, gyr_rail=7.5)

    def all_harmful(trial, scales):
        prior = signal_prior(trial, scales)
        return eqx.tree_at(lambda p: p.harmful, prior, jnp.ones_like(prior.harmful))

    monkeypatch.setattr(compensate, "_prior", jax.jit(all_harmful))
    found = estimate(recording, load_config(None, method="map", **BAR))
    np.testing.assert_array_equal(found.filled, recording.signal)
    np.testing.assert_array_equal(found.fills.inflated, truth.saturated)
    assert list(gaps_table(found)["status"]) == ["inflated"]
    # As noisy as what the prior says was lost; with that freedom the path is better than without.
    sd = found.signal_sd[truth.saturated]
    assert (sd > 0.05).all() and sd.max() > 1.0
    standard = np.linalg.norm(found.standard_position[-1] - truth.position[-1])
    assert last_error(found, truth) < 0.5 * standard


def test_map_leaves_at_most_a_tenth_of_the_error_on_the_bar():
    """Six seeds of the same; biases, of which the sensor has none, cost nothing."""
    ratios = []
    for seed in range(6):
        recording, truth = bar(seed, gyr_rail=7.5)
        found = estimate(recording, load_config(None, method="map", **BIASES, **BAR))
        standard = np.linalg.norm(found.standard_position[-1] - truth.position[-1])
        ratios.append(last_error(found, truth) / standard)
        added = (found.filled - recording.signal)[truth.saturated]
        assert found.fills.status.tolist() == [0]
        assert (added >= 0.0).all() and (added <= 5.0 * (1 + 1e-9)).all()
        # The prior knows more than the bounds do.
        assert found.signal_sd[truth.saturated].max() < 5.0 / np.sqrt(12.0)
    assert max(ratios) <= 0.1


def rms(found: Estimate, true: np.ndarray) -> float:
    return float(np.sqrt(np.sum((found.trajectory.position - true) ** 2, axis=1).mean()))


@pytest.mark.slow
def test_strides_without_a_rest_between_them_learn_from_the_others(pyshoe_trial):
    """A PyShoe walk clipped in software, two strides of which trade what they lost."""
    whole = pyshoe_trial("2017-11-22-11-48-35")
    rail = np.repeat([np.deg2rad(250.0), np.inf], 3)
    clipped = whole.with_signal(np.clip(whole.signal, -rail, rail))
    true = estimate(whole, load_config(None, method="standard")).trajectory.position
    away = [
        rms(estimate(clipped, load_config(None, method="map", **{"saturation.sweeps": sweeps})), true)
        for sweeps in (1, "auto")
    ]
    assert away[1] < 0.5 * away[0]


@pytest.mark.slow
def test_map_on_recordings_that_truly_saturated(shared_data):
    """PyShoe trials, scored by Vicon: in the geometric mean over them nearer by a sixth, in space and on the ground.
    One by one they need not be: what standard gets wrong in height may make up for what saturation did. Slow: sizes
    of many trials are compiled."""
    folder = shared_data / "pyshoe"
    if not (folder / "splits.toml").is_file():
        pytest.skip(f"the trials are not at {folder}")
    ratios = {}
    for name in tomllib.loads((folder / "splits.toml").read_text())["saturated"]:
        path = folder / f"{name}.mat"
        recording = read(path)
        found = estimate(recording, load_config(None, method="map"))
        _, truth = load_pyshoe_truth(path, at=recording.time)
        mapped, standard = (
            [position_rmse(position, truth, axes=axes) for axes in (3, 2)]
            for position in (found.trajectory.position, found.standard_position)
        )
        ratios[name] = np.divide(mapped, standard)
    assert len(ratios) == 12
    assert (np.exp(np.mean(np.log([*ratios.values()]), axis=0)) <= 0.85).all()
    # Where errors of height make up for each other, the ground shows it.
    assert ratios["2017-12-15-18-00-40"][1] <= 0.85


@pytest.mark.parametrize("method", [*PAPER, "map"])
def test_without_saturation_every_method_is_standard_to_the_last_bit(method):
    recording, _ = bar(0)
    plain = estimate(recording, load_config(None, method="standard"))
    found = estimate(recording, load_config(None, method=method))
    for a, b in zip(jax.tree.leaves(plain.trajectory), jax.tree.leaves(found.trajectory), strict=True):
        assert a.tobytes() == b.tobytes()
    assert found.filled.tobytes() == recording.signal.tobytes()


@pytest.mark.slow
def test_parallel_and_sequential_segments_agree_on_a_walk():
    """Section 5 of the paper against all segments at once: the same fills to a few percent of what they add."""
    recording, truth = walk(4, gyr_rail=6.0)
    settings = {"method": "direct", "rails.gyr": 6.0, "saturation.gyr_bound": 4.0}
    both = [
        estimate(recording, load_config(None, **settings, **{"saturation.segments": order}))
        for order in ("parallel", "sequential")
    ]
    plain = estimate(recording, load_config(None, **{**settings, "method": "standard"}))
    errors = [position_rmse(e.trajectory.position, truth.position) for e in (*both, plain)]
    assert max(errors[:2]) < 0.1 * errors[2]
    added = [np.abs(e.filled - recording.signal).sum() for e in both]
    np.testing.assert_allclose(added[0], added[1], rtol=0.05)
    assert abs(errors[0] - errors[1]) < 0.05 * errors[2]


@pytest.mark.slow
def test_free_peak_time_converges_and_stays_inside_its_bounds():
    recording, truth = bar(2, gyr_rail=7.5)
    found = estimate(
        recording, load_config(None, method="triangle", **BAR, **{"saturation.free_peak_time": True})
    )
    added = (found.filled - recording.signal)[truth.saturated]
    assert found.fills.status.tolist() == [0]
    assert (added >= 0.0).all() and (added <= 5.0).all()
    assert last_error(found, truth) < 0.1 * np.linalg.norm(found.standard_position[-1] - truth.position[-1])


def test_heading_and_place_of_the_sensor_do_not_matter():
    """The same motion recorded by a sensor that is mounted turned about its own axes."""
    recording, _ = bar(5, gyr_rail=7.5)
    turn = np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    signal = np.concatenate([recording.gyr @ turn.T, recording.acc @ turn.T], axis=1)
    settings = load_config(None, method="direct", **BAR)
    a = estimate(recording, settings).trajectory.position
    b = estimate(recording.with_signal(signal), settings).trajectory.position
    assert position_rmse(a, b) < 1e-6
    assert np.ptp(a, axis=0).max() > 0.5


def test_height_modes_hold_the_rests_at_or_above_the_floor():
    recording, _ = walk(4, gyr_rail=6.0)
    settings = {"method": "standard", "rails.gyr": 6.0, "height.sd": 1e-4}
    heights = {}
    for mode in ("off", "zero", "nonnegative"):
        found = estimate(recording, load_config(None, **settings, **{"height.mode": mode}))
        arrivals = found.segments.arrival
        heights[mode] = found.trajectory.position[arrivals, 2]
        assert (found.floor is not None) == (mode == "nonnegative")
        if found.floor is not None:
            assert found.floor.converged and set(np.flatnonzero(found.floor.active)) <= set(arrivals)
    assert np.abs(heights["zero"]).max() < 1e-3 < 0.1 * np.abs(heights["off"]).max()
    assert heights["nonnegative"].min() > -1e-6


def test_covariance_grows_in_motion_and_is_small_at_rest():
    recording, truth = walk(4)
    still = {"noise.rest_steady": 0.0, "smoother.lever_sd": 0.0}
    found = estimate(recording, load_config(None, method="standard", **still))
    speed_sd = np.sqrt(np.einsum("kii->ki", found.trajectory.covariance)[:, 6:].max(axis=1))
    assert speed_sd[truth.rest].max() < 0.011
    assert speed_sd[~truth.rest].max() > 1.5 * np.median(speed_sd[truth.rest])
    eigenvalues = np.linalg.eigvalsh(found.trajectory.covariance[:: len(truth.rest) // 20])
    assert eigenvalues.min() > -1e-12


def test_missing_samples_carry_no_weight_and_one_sentence_says_so():
    recording, truth = walk(4)
    lost = np.zeros((len(recording), 6), bool)
    moving = np.flatnonzero(~truth.rest)[20:23]
    lost[moving] = True
    signal = recording.signal
    signal[moving] = 0.5 * (signal[moving[0] - 1] + signal[moving[-1] + 1])
    gappy = eqx.tree_at(lambda r: r.missing, recording.with_signal(signal), lost)
    found = estimate(gappy, load_config(None, method="standard"))
    assert any("missing" in warning for warning in found.warnings)
    assert position_rmse(found.trajectory.position, truth.position) < 0.05


def test_a_recording_without_rest_is_told_what_it_supports():
    recording, _ = walk(4)
    never = eqx.tree_at(lambda r: r.rest, recording, np.zeros(len(recording), bool))
    with pytest.raises(
        InputError, match=r"no rest is found.*supports .*orientation.*no trajectory"
    ) as caught:
        estimate(never)
    assert "\n" not in str(caught.value)
    # What makes no sense is said first, whatever came of it.
    degrees = never.with_signal(never.signal * np.repeat([180.0 / np.pi, 1.0], 3))
    with pytest.raises(InputError, match="give --gyr-unit deg/s"):
        estimate(degrees)


@pytest.mark.parametrize("offset_sd", [1e-3, 0.1], ids=["gyroscope", "controller"])
def test_a_start_in_motion_takes_its_attitude_from_a_later_rest(offset_sd, monkeypatch):
    """Rests until the second stance are not told: attitude and way until there are as far off as they say."""
    recording, truth = walk(4)
    rest = recording.rest.copy()
    arrivals = np.flatnonzero(rest[1:] & ~rest[:-1]) + 1
    first = int(arrivals[1])
    rest[:first] = False
    assert first * recording.period > LATEST_FIRST_REST
    moving = eqx.tree_at(lambda r: r.rest, recording, rest)
    monkeypatch.setattr("jaxsat.preparation.LEFT_OFFSET_SD", offset_sd)
    # The one long rest that is left is too short to say that the offset is zero.
    given = {"rails.gyr": "none", "rails.acc": "none", "smoother.gyr_offset": "none"}
    found = estimate(moving, load_config(None, method="standard", **given)).trajectory
    turn, true = (Rotation.from_quat(q[0], scalar_first=True).inv() for q in (found.q_nb, truth.q_nb))
    tilt = np.arccos(np.clip(turn.apply([0, 0, 1]) @ true.apply([0, 0, 1]), -1, 1))
    sd = np.sqrt(np.diag(found.covariance[0]))
    assert tilt < 0.02 and tilt < 3 * np.hypot(*sd[:2]) < 0.25
    way = turn.apply(found.position[first] - found.position[0])
    assert np.linalg.norm(way - true.apply(truth.position[first] - truth.position[0])) < 0.1


def test_an_axis_may_be_noisier_than_its_sensor():
    """Gyroscope y trusted less by a factor: as if all three were, where only it turns the sensor."""
    recording, _ = bar(0, gyr_rail=7.5)
    axes = {"noise.axes": [1.0, 5.0, 1.0, 1.0, 1.0, 1.0]}
    found, plain = (estimate(recording, load_config(None, method="standard", **BAR, **x)) for x in (axes, {}))
    np.testing.assert_allclose(found.signal_sd / plain.signal_sd, np.tile([1, 5, 1, 1, 1, 1.0], (160, 1)))
    assert found.cost < plain.cost
    with pytest.raises(InputError, match=r"noise\.axes"):
        load_config(None, **{"noise.axes": [1.0, 2.0, 3.0]})
    with pytest.raises(InputError, match=r"noise\.axes"):
        load_config(None, **{"noise.axes": [1.0, 2.0, 3.0, 1.0, 0.0, 1.0]})


def test_what_is_learned_of_the_sensors_is_said():
    """An accelerometer's bias, within what is said of it; none that is not wanted, no lever where nothing rolls."""
    bias = np.array([0.05, -0.03, 0.02])
    recording, truth = walk(6, acc_bias=bias)
    told = {"noise.gyr_density": 7e-4, "noise.acc_density": 7e-3, "noise.change": 0.0, "gravity": 9.80665}
    given = {"method": "standard", "rails.gyr": "none", "rails.acc": "none", "smoother.gyr_offset": "none"}
    found, blind = (
        estimate(recording, load_config(None, **told, **given, **x))
        for x in ({}, {"smoother.acc_bias_sd": 0.0})
    )
    said = summarise(found)
    learned, sd = (np.array(list(said[name].values())) for name in ("bias", "bias_sd"))
    assert (np.abs(learned[3:] - bias) < 4 * sd[3:]).all() and abs(learned[5] - bias[2]) < 0.01
    assert not learned[:3].any() and not sd[:3].any()
    assert (np.abs(said["lever"]) < 4 * np.array(said["lever_sd"])).all()
    errors = [position_rmse(x.trajectory.position, truth.position) for x in (found, blind)]
    assert errors[0] < errors[1]


@pytest.mark.parametrize(
    "settings", [{"method": "map"}, {"saturation.segments": "sequential"}, {"height.mode": "zero"}]
)
def test_the_search_is_compiled_ahead_for_what_it_is_called_with(settings, monkeypatch, tmp_path):
    """Or it would be compiled twice: the call finds a program by the shapes, types and settings of its arguments."""
    seen, solve = {}, compensate._solve

    def told(*arguments):
        arrays, rest = eqx.partition(arguments, eqx.is_array)
        return jax.tree.map(jax.typeof, arrays), jax.tree.structure(arrays), repr(rest)

    def ahead(function, *arguments):
        seen.setdefault("ahead", told(*arguments))
        return lambda: None

    def call(*arguments):
        seen.setdefault("called", told(*arguments))
        return solve(*arguments)

    monkeypatch.setattr(compensate, "trace_ahead", ahead)
    monkeypatch.setattr(compensate, "_solve", call)
    recording, _ = bar(0, gyr_rail=7.5)
    keep_traces(tmp_path)
    try:
        estimate(recording, load_config(None, **BAR, **{"method": "direct", **settings}))
    finally:
        keep_traces(None)
    assert seen["ahead"] == seen["called"]


def test_long_segments_are_solved_fewer_at_a_time():
    """Matrices of values by values keep to a size; each segment that saturates is solved once, likes together."""
    rng = np.random.default_rng(0)
    values = np.concatenate(
        [np.zeros(9, int), rng.integers(1, 40, size=150), rng.integers(900, 3000, size=7)]
    )
    samples = 3 * values + 5
    chunks = list(solved_together(samples, values))
    solved = np.concatenate([mine for mine, _ in chunks])
    assert sorted(solved) == list(np.flatnonzero(values)) and (np.diff(values[solved]) >= 0).all()
    assert max(len(mine) for mine, _ in chunks) == LANES
    for mine, sizes in chunks:
        assert values[mine].max() <= sizes.values and samples[mine].max() <= sizes.samples
        assert len(mine) == 1 or len(mine) * sizes.values**2 <= ENTRIES
    assert len(chunks[-1][0]) < 7
