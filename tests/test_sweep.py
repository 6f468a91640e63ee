"""Sweeps: an element is an estimate, rails and chunks change neither programs nor results, one bad trial one row."""

from dataclasses import replace
from functools import partial, wraps
from types import SimpleNamespace

import equinox as eqx
import jax
import numpy as np
import pandas as pd
import pytest

from jaxsat.config import Config
from jaxsat.errors import InputError
from jaxsat.pipeline import estimate
from jaxsat.saturation.layout import Sizes
from jaxsat.saturation.solvers import Status
from jaxsat.signals.recording import Recording
from jaxsat.studies import elements
from jaxsat.studies import sweep as sweep_module
from jaxsat.studies.motions import Bar
from jaxsat.studies.simulate import Sensor, simulate
from jaxsat.studies.sweep import sweep

RAIL = 7.5
RAILS = (RAIL, np.inf)


def settings(gyr_rail="none") -> Config:
    """Searches run so far that programs of other shapes end alike."""
    return Config.model_validate(
        {"rails": {"gyr": gyr_rail, "acc": "none"}, "saturation": {"gyr_bound": 5.0, "tolerance": 1e-5}}
    )


def bar(seed: int, name: str, gyr_rail: float = np.inf) -> Recording:
    """The paper's bar with its true rests, and flags where it truly saturates."""
    sensor = Sensor(gyr_rail=gyr_rail)
    recording, truth = simulate(Bar(), rate=100.0, duration=1.6, sensor=sensor, key=jax.random.key(seed))
    return replace(recording, rest=truth.rest, clipped=truth.saturated, name=name)


@pytest.fixture(scope="module")
def trials() -> list[Recording]:
    lost = bar(3, "lost")
    missing = np.zeros((160, 6), bool)
    missing[np.argmax(lost.gyr[:, 1]), 1] = True
    moving = bar(4, "moving")
    return [
        bar(1, "whole"),
        replace(moving, rest=np.zeros(160, bool)),
        bar(2, "clipped", gyr_rail=8.0),
        replace(lost, missing=missing),
    ]


DEVICES = jax.local_device_count()


def chunk_of(count: int) -> float:
    """A budget of so many elements a device (bytes)."""
    return (count + 0.5) * elements.element_bytes(256, 1, Sizes(256, 64), ["direct"])


@pytest.fixture(scope="module")
def table(trials) -> pd.DataFrame:
    return sweep(trials, settings(), gyr_rails=RAILS)


@pytest.fixture(scope="module")
def mapped(trials) -> pd.DataFrame:
    return sweep([trials[0], trials[2]], settings(), methods=["map"], gyr_rails=RAILS)


def row(table: pd.DataFrame, trial: str, method: str, rail: float) -> pd.Series:
    found = table.query("trial == @trial and method == @method and gyr_rail == @rail")
    assert len(found) == 1
    return found.iloc[0]


@pytest.mark.parametrize("trial", [0, 2])
@pytest.mark.parametrize("method", ["standard", "direct", pytest.param("map", marks=pytest.mark.slow)])
@pytest.mark.parametrize("rail", RAILS)
def test_an_element_is_the_estimate_of_the_clipped_recording(table, mapped, trials, trial, method, rail):
    """`whole` at infinity does not saturate, `clipped` by itself; at the rail both are clipped in software."""
    given = trials[trial]
    signal = np.concatenate([np.clip(given.gyr, -rail, rail), given.acc], axis=1)
    config = settings(rail if np.isfinite(rail) else "none").model_copy(update={"method": method})
    found = estimate(given.with_signal(signal), config)
    truth = estimate(given, settings().model_copy(update={"method": "standard"}))
    mine = row(mapped if method == "map" else table, given.name, method, rail)

    assert mine["saturated"] == found.saturated.sum()
    position = found.trajectory.position
    away = np.linalg.norm(position - truth.trajectory.position, axis=1)
    np.testing.assert_allclose(mine[["end_x", "end_y", "end_z"]].astype(float), position[-1], atol=1e-6)
    assert mine["path_rmse"] == pytest.approx(np.sqrt(np.mean(away**2)), abs=1e-6)
    assert mine["end_distance"] == pytest.approx(away[-1], abs=1e-6)
    # Only what was clipped in software is known.
    known = found.saturated[:, :3] & ~given.clipped[:, :3]
    assert known.any() == (rail == RAIL)
    wrong = (found.filled - given.signal)[:, :3][known]
    expected = np.sqrt(np.mean(wrong**2)) if len(wrong) else np.nan
    assert mine["fill_rmse_gyr"] == pytest.approx(expected, abs=1e-6, nan_ok=True)
    assert np.isnan(mine["fill_rmse_acc"])
    if method == "standard":
        assert mine["status"] == ("ignored" if found.saturated.any() else "nothing_to_do")
        return
    fills = found.fills
    busy = fills.status != Status.NOTHING_TO_DO
    assert mine["segments"] == busy.sum() and mine["iterations"] == fills.iterations.sum()
    assert mine["at_bound"] == fills.at_bound.sum()
    assert mine["status"] == ("converged" if busy.any() else "nothing_to_do")
    assert mine["cost_before"] == pytest.approx(fills.cost_before.sum(), rel=1e-6)
    assert mine["cost_after"] == pytest.approx(fills.cost_after.sum(), rel=1e-6)


def test_compensation_comes_closer_to_the_recording_as_given(table):
    standard, direct = (row(table, "whole", method, RAIL)["path_rmse"] for method in ("standard", "direct"))
    assert direct < 0.1 * standard
    assert row(table, "whole", "standard", np.inf)["path_rmse"] == pytest.approx(0, abs=1e-9)


def test_values_that_were_not_measured_do_not_saturate(table, trials):
    beyond = np.abs(trials[3].gyr) >= RAIL
    assert beyond[trials[3].missing[:, :3]].all()
    assert row(table, "lost", "direct", RAIL)["saturated"] == beyond.sum() - 1


def test_a_trial_that_cannot_be_used_costs_one_row(table, trials):
    assert list(table["trial"].unique()) == [trial.name for trial in trials]
    assert list(table.groupby("trial", sort=False).size()) == [4, 1, 4, 4]
    failed = table[table["trial"] == "moving"].iloc[0]
    assert failed["status"] == "failed" and "no rest is found" in failed["note"]
    assert np.isnan(failed["path_rmse"])
    assert table["note"].notna().sum() == 1


@pytest.mark.parametrize("calls", [1, 2])
def test_neither_memory_nor_devices_nor_cores_change_a_number(table, trials, calls):
    """calls: at once, as on a CPU that is one device."""
    steps, places = [], []
    original = elements._scores

    def kept(*args):
        found = original(*args)
        places.append(found["direct"]["path_rmse"].sharding)
        return found

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(elements, "_scores", kept)
        patch.setattr(elements, "calls_at_once", lambda: calls)
        chunked = sweep(
            trials, settings(), gyr_rails=RAILS, memory=chunk_of(1), progress=lambda *step: steps.append(step)
        )
    assert all(len(place.device_set) == DEVICES for place in places)
    assert DEVICES == 1 or not places[0].is_fully_replicated
    assert steps == [("sweep", done, 6) for done in range(DEVICES, 7, DEVICES)]
    # Programs of other shapes round otherwise, and steps carry that where no rest sees it.
    np.testing.assert_allclose(chunked["fill_rmse_gyr"], table["fill_rmse_gyr"], atol=1e-8)
    chunked, expected = (t.drop(columns="fill_rmse_gyr") for t in (chunked, table))
    pd.testing.assert_frame_equal(chunked, expected, rtol=1e-9, atol=1e-9)


def test_elements_side_by_side_as_on_a_gpu_are_those_one_after_the_other(table, trials):
    original = elements._scores.__wrapped__
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(elements, "_of_each", lambda function, *over: jax.vmap(function)(*over))
        # A function of its own, so that it is traced anew.
        patch.setattr(elements, "_scores", eqx.filter_jit(wraps(original)(lambda *args: original(*args))))
        found = sweep(trials, settings(), gyr_rails=RAILS, memory=chunk_of(6 // DEVICES))
    np.testing.assert_allclose(found["fill_rmse_gyr"], table["fill_rmse_gyr"], atol=1e-8)
    found, expected = (t.drop(columns="fill_rmse_gyr") for t in (found, table))
    pd.testing.assert_frame_equal(found, expected, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("rails", "memory"), [pytest.param(1, 2e9, marks=pytest.mark.slow), (32, chunk_of(6 // DEVICES))]
)
def test_many_rails_are_one_program(trials, rails, memory):
    original, traces = elements._scores.__wrapped__, []

    # A function of its own has a cache of its own.
    @wraps(original)
    def counted(*args):
        traces.append(args)
        return original(*args)

    program = eqx.filter_jit(counted)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(elements, "_scores", program)
        found = sweep(trials[:1], settings(), gyr_rails=np.linspace(RAIL, 9.0, rails).tolist(), memory=memory)
    assert len(traces) == program._cached._cache_size() == 1
    # Chunks of six, the program of the other tests; the last one is not full: what it repeats is no row.
    assert len(found) == 2 * rails and not found.duplicated(["method", "gyr_rail"]).any()


@pytest.mark.parametrize(
    ("given", "message"),
    [
        ({"gyr_rails": [5.0, 0.0]}, "a gyroscope rail of 0 cannot be"),
        ({"gyr_rails": [-5.0]}, "a gyroscope rail of -5"),
        ({"acc_rails": [np.nan]}, "an accelerometer rail of nan"),
        ({"acc_rails": []}, "an accelerometer rail is missing"),
        ({"gyr_bounds": [np.inf]}, "a gyroscope bound of inf"),
        ({"acc_bounds": np.array([3.0, -1.0]).tolist()}, "an accelerometer bound of -1"),
        ({"gyr_bounds": []}, "a gyroscope bound is missing"),
        ({"methods": ["direct", "fast"]}, "method 'fast' cannot be swept; choose among standard"),
        ({"methods": []}, "there is no method"),
        ({"memory": 0.0}, "a memory of 0 GB"),
    ],
)
def test_values_that_cannot_be_are_told(given, message, trials):
    with pytest.raises(InputError, match=message):
        sweep(trials, settings(), **given)


def test_configurations_and_recordings_that_cannot_be_swept_are_told(trials):
    for section in ({"saturation": {"segments": "sequential"}}, {"height": {"mode": "nonnegative"}}):
        with pytest.raises(InputError, match="in parallel and knows no inequality"):
            sweep(trials, Config.model_validate(section))
    with pytest.raises(InputError, match="two recordings are called 'whole'"):
        sweep([trials[0], trials[0]])
    for nothing in ([], {}):
        with pytest.raises(InputError, match="there is no recording"):
            sweep(nothing)


def test_a_rail_within_what_the_sensor_reads_at_rest_is_a_failed_row(trials):
    found = sweep(trials[:1], settings(), acc_rails=[9.0, 50.0])
    assert list(found["status"]) == ["failed"]
    assert "a rail of 9 m/s² lies within what the sensor reads at rest" in found["note"][0]


def test_recordings_are_loaded_in_turn_under_the_names_given(table, trials):
    """One that cannot be loaded costs a row, as one that cannot be used; messages speak of the name given."""
    loaded = []

    def load(k):
        loaded.append(k)
        return trials[k]

    def absent():
        raise InputError("gone.csv: there is no such file.")

    loaders = {f"file {k}": partial(load, k) for k in range(4)}
    found = sweep({"gone": absent, **loaders}, settings(), gyr_rails=RAILS)
    assert loaded == [0, 1, 2, 3]
    assert tuple(found.iloc[0][["trial", "status", "note"]]) == (
        "gone",
        "failed",
        "gone.csv: there is no such file.",
    )
    names = dict(zip((trial.name for trial in trials), loaders, strict=True))
    failed = found.set_index("trial").loc["file 1", "note"]
    assert failed == table.set_index("trial").loc["moving", "note"].replace("moving", "file 1")
    assert failed.startswith("file 1")
    expected = table.assign(trial=table["trial"].replace(names)).drop(columns="note")
    pd.testing.assert_frame_equal(found.iloc[1:].drop(columns="note").reset_index(drop=True), expected)


def test_the_devices_of_one_cpu_share_the_memory(monkeypatch):
    """Four elements at a time in all, not on each of them."""
    assert jax.local_device_count() == 2, "the tests run on two devices of a CPU"
    monkeypatch.setattr(sweep_module, "element_bytes", lambda *_: 1.0)
    case = SimpleNamespace(trial=SimpleNamespace(signal=np.zeros((10, 6))), departure=np.zeros(2, int))
    batch = sweep_module._Batch([case] * 8, ["bar"] * 8, None)
    plan = sweep_module._Plan(Config(), ("direct",), np.ones((1, 4)), 4.0)
    size = sweep_module._chunk_size(batch, plan)
    assert [chunk.real for chunk in elements.chunks(8, plan.grid, size)] == [4, 4]


def test_chunks_hold_every_element_once_and_no_more_cases_than_they_say():
    """Whatever their size; of five cases at three rails, and of one."""
    for cases, size in ((5, 1), (5, 4), (5, 7), (5, 40), (1, 2)):
        grid = np.arange(12.0).reshape(3, 4)
        found = list(elements.chunks(cases, grid, size))
        assert {len(chunk.which) for chunk in found} == {size}
        assert all(len(set(chunk.which)) <= chunk.held <= cases for chunk in found)
        which = np.concatenate([chunk.which[: chunk.real] for chunk in found])
        values = np.concatenate([chunk.values[: chunk.real] for chunk in found])
        np.testing.assert_array_equal(which, np.repeat(np.arange(cases), 3))
        np.testing.assert_array_equal(values, np.tile(grid, (cases, 1)))
