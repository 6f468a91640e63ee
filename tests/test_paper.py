"""The paper reproduced: a fast version of each experiment runs, and shows what it is there to show.

All simulated motions share one compiled program, minutes of compiling when it is not in the cache: what needs it is
slow. Eq. 21 searches nothing and needs none of it.
"""

import importlib
import json
import sys
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
import pytest

from jaxsat.inertial.strapdown import NavState, strapdown
from jaxsat.studies.simulate import GRAVITY

ROOT = Path(__file__).resolve().parents[1]
METHODS = ("direct", "triangle", "quadratic", "map")


@pytest.fixture(scope="module")
def script():
    sys.path.insert(0, str(ROOT / "scripts"))
    try:
        yield importlib.import_module("reproduce_paper")
    finally:
        sys.path.remove(str(ROOT / "scripts"))


@pytest.fixture(scope="module")
def run(script, tmp_path_factory):
    """Runs an experiment fast, once; gives its table."""
    out, done = tmp_path_factory.mktemp("paper"), {}

    def once(name: str) -> pd.DataFrame:
        if name not in done:
            done[name] = script.run(name, out, ROOT.parent / "shared" / "data", quick=True)
            for figure in (out / name).glob("*.png"):
                assert figure.with_suffix(".svg").stat().st_size > 1000
            assert json.loads((out / name / "env.json").read_text())["settings"]["title"]
        return pd.read_csv(out / name / "table.csv")

    once.out, once.done = out, done
    return once


def of(table: pd.DataFrame, method: str) -> pd.Series:
    return table[table["method"] == method].iloc[0]


def test_every_experiment_has_its_settings_and_a_method_for_each_goal(script):
    named = {path.stem for path in (ROOT / "configs" / "paper").glob("*.toml")}
    assert named == set(script.EXPERIMENTS)
    for name in named:
        whole, quick = script.settings(name), script.settings(name, quick=True)
        assert set(whole) == set(quick) and whole["title"] and whole["about"]


def test_the_page_is_that_of_the_results_that_are_there(script):
    out = ROOT / "results" / "paper"
    done = {name: script.settings(name) for name in script.EXPERIMENTS if (out / name / "table.csv").exists()}
    assert (out / "README.md").read_text() == script.page.page(out, done)


@pytest.mark.slow
def test_table_1_each_method_beats_the_ratio_of_the_paper(run):
    table = run("bar")
    assert of(table, "standard")["last_ratio_median"] == 1.0
    for method, ratio in {"direct": 0.070, "triangle": 0.098, "quadratic": 0.079, "map": 0.070}.items():
        assert of(table, method)["last_ratio_median"] < ratio
        assert of(table, method)["saturated"] > 10


@pytest.mark.slow
def test_figure_9_a_bound_below_what_the_peak_needs_costs_accuracy(run):
    table = run("rail_direct").query("method == 'direct'").sort_values("gyr_rail")
    short, enough = table["fill_rmse_gyr_median"]
    assert short > 2 * enough and table["last_median"].iloc[0] > table["last_median"].iloc[1]
    assert table["at_bound_median"].iloc[0] > 0 == table["at_bound_median"].iloc[1]


@pytest.mark.slow
def test_figure_10_method_2_holds_where_method_1_is_bound(run):
    shapes, bound = run("rail_shapes"), run("rail_direct")
    low = shapes["gyr_rail"].min()
    for method in ("triangle", "quadratic"):
        mine = of(shapes[shapes["gyr_rail"] == low], method)
        theirs = of(bound[bound["gyr_rail"] == low], "direct")
        assert mine["fill_rmse_gyr_median"] < theirs["fill_rmse_gyr_median"]


@pytest.mark.slow
def test_figure_11_a_larger_bound_does_no_harm(run):
    table = run("bound").query("method == 'direct'").sort_values("gyr_bound")
    assert table["last_median"].iloc[0] > 3 * table["last_median"].iloc[-1]


@pytest.mark.slow
def test_table_2_a_push_that_saturates_comes_back_from_the_rest_after_it(run):
    table = run("straight")
    assert of(table, "direct")["last_ratio_median"] < 0.5
    assert 0.05 < of(table, "standard")["last_median"] < 0.2


@pytest.mark.slow
def test_table_2_what_cancels_in_velocity_the_rest_does_not_see(run):
    table = run("straight_even")
    assert of(table, "direct")["last_ratio_median"] > 0.9


@pytest.mark.slow
def test_table_3_start_and_stop_of_a_curve(run):
    assert of(run("planar"), "direct")["distance_ratio_median"] < 1.0


@pytest.mark.slow
def test_figure_16_a_stride(run):
    table = run("walk")
    assert of(table, "direct")["last_ratio_median"] < 0.391


@pytest.mark.slow
def test_section_5_both_orders_agree_on_one_segment(run):
    table = run("segments").set_index("order")
    assert table.loc["sequential", "last_median"] == pytest.approx(
        table.loc["parallel", "last_median"], rel=0.1
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ["coverage", "coverage_drawn"])
def test_intervals_are_counted(run, name):
    table = run(name)
    shares = table[[f"{what}_{share}" for what in ("fill", "peak", "end") for share in (50, 90)]].to_numpy()
    assert shares.min() >= 0.0 and shares.max() <= 1.0 and table["sd_median"].min() > 0.0


@pytest.mark.slow
def test_a_drawn_recording_is_that_of_a_sensor(script):
    """Of which the strapdown ends at rest, and which only lacks what lies beyond the rail."""
    recording, truth, _ = script.drawn.drawn(script.settings("coverage_drawn"), 0)
    period = np.full(len(recording), np.median(np.diff(recording.time)))
    with jax.enable_x64(True):
        start = NavState(*(jnp.asarray(x[0]) for x in (truth.q_nb, truth.velocity, truth.position)))
        states = strapdown(jnp.asarray(truth.signal), jnp.asarray(period), start, jnp.asarray(GRAVITY))
    velocity = np.asarray(states.velocity)
    assert np.abs(velocity[-1]).max() < 1e-9 < 0.1 < np.abs(velocity).max()
    np.testing.assert_allclose(states.position[:-1], truth.position, atol=1e-12)
    hidden = truth.saturated
    np.testing.assert_array_equal(recording.signal[~hidden], truth.noisy[~hidden])
    assert hidden.any() and (np.abs(truth.noisy[hidden]) >= np.abs(recording.signal[hidden])).all()


@pytest.mark.slow
def test_the_search_descends(run):
    table = run("iterations")
    best = table["best"].to_numpy()
    assert np.all(np.diff(best) <= 0.0) and best[-1] < best[0]


@pytest.mark.slow
def test_with_a_prior_every_start_ends_alike(run):
    table = run("starts")
    # But for a constant, so it may be negative.
    assert np.ptp(table["cost"]) < 1e-3 * abs(table["cost"].iloc[0]) and table["away"].max() < 1e-2


def test_equation_21_as_printed_puts_peaks_outside_their_gaps(run):
    table = run("eq21").set_index("formula")
    assert table.loc["corrected", "usable"].min() == 1.0
    assert table.loc["printed", "usable"].max() < 0.5
    assert table.loc["corrected", "off_median"].max() < 2.0
    assert (table.loc["printed", "off_median"] > 0.5 * table.loc["printed", "gap_median"]).all()


@pytest.mark.slow
@pytest.mark.parametrize("name", ["walk_clipped", "walk_saturated"])
def test_figure_16_on_real_walks(run, name, request):
    if name == "walk_saturated":
        request.getfixturevalue("shared_data")
    table = run(name)
    assert set(table["method"]) == {"standard", "direct"} and table["last"].between(0.0, 10.0).all()


@pytest.mark.slow
def test_the_board_and_the_page_tell_what_was_run(run, script):
    run("bar")
    rows = {row.metric: row for row in script.page.board(run.out, run.done)}
    for method, goal in {"direct": 0.070, "triangle": 0.098, "quadratic": 0.079, "map": 0.070}.items():
        assert rows[f"table1_{method}"].goal == goal
        assert rows[f"table1_{method}"].value == of(run("bar"), method)["last_ratio_median"]
    text = script.page.page(run.out, run.done)
    assert all(run.done[name]["title"] in text for name in run.done) and "0.0458" in text
