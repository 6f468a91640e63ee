"""The command line end to end: files, exit codes, one line for every error, and silence when asked."""

import hashlib
import json
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from corruptions import CORRUPTIONS

from jaxsat.cli import main
from jaxsat.config import load_config
from jaxsat.errors import InputError

FILES = {
    "trajectory.parquet",
    "signals.parquet",
    "gaps.parquet",
    "segments.parquet",
    "summary.json",
    "report.html",
}


@pytest.fixture(scope="module")
def bar(tmp_path_factory) -> Path:
    """The paper's bar, clipped at 7.5 rad/s; its truth lies beside it."""
    path = tmp_path_factory.mktemp("bar") / "bar.csv"
    assert main(["simulate", "bar", "-o", str(path), "--gyr-rail", "7.5", "--seed", "1"]) == 0
    return path


def test_estimate_writes_the_documented_files_and_comes_close_to_the_truth(bar, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["estimate", str(bar), "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert "22 values in 1 gap" in printed.out and str(out / "report.html") in printed.out
    assert printed.err == ""
    assert {path.name for path in out.iterdir()} == FILES
    truth = pd.read_csv(bar.with_name("bar_truth.csv"))
    found = pd.read_parquet(out / "trajectory.parquet")
    axes = ["pos_x", "pos_y", "pos_z"]
    # The standard smoother ends 0.66 m off.
    assert np.linalg.norm(found[axes].iloc[-1] - truth[axes].iloc[-1]) < 0.05
    assert json.loads((out / "summary.json").read_text())["method"] == "map"


def test_quiet_is_silent_and_csv_is_csv(bar, tmp_path, capfd):
    out = tmp_path / "out"
    arguments = ["estimate", str(bar), "-o", str(out), "--method", "standard", "--quiet", "--csv"]
    assert main(arguments) == 0
    assert capfd.readouterr() == ("", "")
    assert {path.name for path in out.iterdir()} == {name.replace("parquet", "csv") for name in FILES}
    assert main(arguments) == 0, "a former result is replaced"
    assert list(pd.read_csv(out / "gaps.csv")["status"]) == ["ignored"]


def test_options_reach_the_configuration(bar, tmp_path):
    config = tmp_path / "config.toml"
    config.write_text('method = "direct"\n[noise]\ngyr_density = 1e-3\n')
    out = tmp_path / "out"
    options = "--method standard --segments sequential --height zero --gyr-rail 430 --acc-rail none"
    units = "--gyr-unit rad/s --acc-unit m/s^2"
    arguments = ["estimate", str(bar), "-o", str(out), "--config", str(config), "--quiet", "--strict"]
    # 430 rad/s: nobody turns so fast, and that is said.
    assert main([*arguments, *options.split(), *units.split()]) == 3
    summary = json.loads((out / "summary.json").read_text())
    used = summary["configuration"]
    assert (used["method"], used["saturation"]["segments"], used["height"]["mode"]) == (
        "standard",
        "sequential",
        "zero",
    )
    assert used["rails"] == {"gyr": 430.0, "acc": "none"} and used["noise"]["gyr_density"] == 1e-3
    assert "no sample reaches" in summary["warnings"][0]


def test_rails_are_in_the_unit_of_the_file(bar, tmp_path, capsys):
    table = pd.read_csv(bar)
    table[["gyr_x", "gyr_y", "gyr_z"]] = np.rad2deg(table[["gyr_x", "gyr_y", "gyr_z"]])
    table[["acc_x", "acc_y", "acc_z"]] /= 9.80665
    table.to_csv(tmp_path / "units.csv", index=False)
    arguments = ["inspect", str(tmp_path / "units.csv"), "--gyr-unit", "deg/s", "--acc-unit", "g", "--json"]
    assert main([*arguments, "--gyr-rail", str(np.rad2deg(7.5)), "--acc-rail", "8"]) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["rails"]["gyr_y"]["high"]["rail"] == pytest.approx(7.5, rel=1e-5)
    assert found["rails"]["acc_x"]["low"]["rail"] == pytest.approx(-8 * 9.80665, rel=1e-5)
    assert found["saturated"]["gyr_y"] == 22


def test_a_sweep_writes_its_table_and_a_summary(bar, tmp_path, capsys):
    out, broken = tmp_path / "out", tmp_path / "broken.csv"
    broken.write_text("time,gyr_x\n0,1\n")
    arguments = ["sweep", str(bar), str(broken), "-o", str(out), "--gyr-unit", "rad/s", "--memory", "1"]
    assert main([*arguments, "--gyr-rail", "7", "--gyr-bound", "5"]) == 0
    printed = capsys.readouterr()
    assert printed.err == "" and f"failed: {broken}" in printed.out and "1 trial;" in printed.out
    direct = next(line for line in printed.out.splitlines() if line.startswith("direct"))
    assert direct.split()[1:3] == ["7", "none"]
    assert {path.name for path in out.iterdir()} == {"sweep.parquet", "summary.json"}
    table = pd.read_parquet(out / "sweep.parquet")
    assert list(table["trial"]) == [str(bar), str(bar), str(broken)]
    assert list(table["status"]) == ["ignored", "converged", "failed"]
    assert str(broken) in table["note"].iloc[2]
    summary = json.loads((out / "summary.json").read_text())
    assert summary["swept"]["gyr_rails"] == [7.0] and summary["swept"]["acc_rails"] == ["none"]
    assert summary["status"] == {"converged": 1, "failed": 1, "ignored": 1}
    assert summary["inputs"][0]["sha256"] == hashlib.sha256(bar.read_bytes()).hexdigest()
    assert main(["estimate", str(bar), "-o", str(out)]) == 2, "an estimate does not replace a sweep"
    assert "sweep.parquet" in capsys.readouterr().err


def test_a_sweep_of_files_of_which_none_can_be_used_is_an_error(tmp_path, capsys):
    paths = [tmp_path / "a.csv", tmp_path / "b.csv"]
    assert main(["sweep", *map(str, paths), "-o", str(tmp_path / "out")]) == 2
    assert re.search(r"a\.csv.* \(and 1 more", capsys.readouterr().err)
    assert list(tmp_path.iterdir()) == []


def test_a_quiet_sweep_in_the_unit_of_the_file_writes_csv(bar, tmp_path, capfd):
    units = tmp_path / "units.csv"
    table = pd.read_csv(bar)
    table[["gyr_x", "gyr_y", "gyr_z"]] = np.rad2deg(table[["gyr_x", "gyr_y", "gyr_z"]])
    table.to_csv(units, index=False)
    arguments = ["sweep", str(units), "-o", str(tmp_path / "out"), "--method", "standard", "--csv", "--quiet"]
    assert main([*arguments, "--gyr-unit", "deg/s", "--gyr-rail", "400", "--gyr-rail", "none"]) == 0
    assert capfd.readouterr() == ("", "")
    found = pd.read_csv(tmp_path / "out" / "sweep.csv")
    assert list(found["gyr_rail"]) == pytest.approx([np.deg2rad(400), np.inf])
    assert found["saturated"].iloc[1] == 22 < found["saturated"].iloc[0]


def test_inspect_shows_what_was_clipped(bar, capsys):
    assert main(["inspect", str(bar)]) == 0
    row = next(line for line in capsys.readouterr().out.splitlines() if line.startswith("gyr_y"))
    assert row.split()[-3:] == ["22", "1", "22"] and "7.5 (429.7 deg/s)" in row


def test_rests_come_from_the_file_unless_detection_is_asked_for(bar, tmp_path, capsys):
    table = pd.read_csv(bar)
    table["rest"] = (np.arange(160) < 20) | (np.arange(160) >= 150)
    table["stance"] = np.arange(160) < 30
    table.to_csv(tmp_path / "rests.csv", index=False)
    shares = {}
    for options in ([], ["--rests", "stance"], ["--rests", "auto"]):
        assert main(["inspect", str(tmp_path / "rests.csv"), "--json", *options]) == 0
        rests = json.loads(capsys.readouterr().out)["rests"]
        shares[tuple(options)] = (rests["source"], rests["share"])
    assert shares[()] == ("recording", 30 / 160)
    assert (
        shares["--rests", "stance"] == ("recording", 30 / 160) and shares["--rests", "auto"][0] == "detected"
    )
    assert shares["--rests", "auto"][1] > 0.5


@pytest.mark.parametrize("name", CORRUPTIONS)
def test_bad_input_is_one_line_and_leaves_nothing_behind(name, tmp_path, capfd):
    (tmp_path / "in").mkdir()
    path, options = CORRUPTIONS[name](tmp_path / "in")
    out = tmp_path / "results" / "out"
    assert main(["estimate", str(path), "-o", str(out), *options]) == 2
    printed = capfd.readouterr()
    assert printed.out == ""
    assert printed.err.startswith("jaxsat: ") and printed.err.count("\n") == 1
    assert {entry.name for entry in tmp_path.iterdir()} == {"in"}


@pytest.mark.parametrize(
    "arguments",
    [
        "nonsense",
        "estimate",
        "estimate BAR",
        "estimate BAR -o OUT --method fast",
        "estimate BAR -o OUT --mehtod direct",
        "estimate BAR -o OUT --height floor",
        "estimate BAR -o OUT --rate fast",
        "estimate BAR -o OUT --gyr-rail high",
        "estimate BAR -o OUT --gyr-rail -5",
        "estimate BAR -o OUT --gyr-rail nan",
        "estimate BAR -o OUT --gyr-unit rpm",
        "estimate BAR -o OUT --config absent.toml",
        "estimate BAR -o BAR",
        "estimate BAR -o BAR/below",
        "inspect BAR --format excel",
        "sweep -o OUT",
        "sweep BAR",
        "sweep absent.csv -o OUT",
        "sweep absent.csv missing.csv -o OUT",
        "sweep BAR BAR -o OUT",
        "sweep BAR -o BAR",
        "sweep BAR -o OUT --method fast",
        "sweep BAR -o OUT --gyr-rail 0",
        "sweep BAR -o OUT --gyr-rail auto",
        "sweep BAR -o OUT --acc-rail -20",
        "sweep BAR -o OUT --acc-rail 9",
        "sweep BAR -o OUT --acc-bound 0",
        "sweep BAR -o OUT --memory 0",
        "sweep BAR -o OUT --gyr-unit rpm",
        "sweep BAR -o OUT --config absent.toml",
        "simulate swim -o OUT.csv",
        "simulate bar -o OUT.xlsx",
        "simulate bar -o OUT/absent/bar.csv",
        "simulate bar -o OUT.csv --gyr-rail -1",
        "simulate bar -o OUT.csv --rate 0",
        "simulate walk -o OUT.csv --duration -3",
        "simulate walk -o OUT.csv --duration nan",
    ],
)
def test_bad_arguments_are_one_line(arguments, bar, tmp_path, capfd):
    filled = arguments.replace("BAR", str(bar)).replace("OUT", str(tmp_path / "out"))
    assert main(filled.split()) == 2
    printed = capfd.readouterr()
    assert printed.out == "" and printed.err.startswith("jaxsat: ") and printed.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_folders_with_other_files_are_refused_before_any_work(bar, tmp_path, capsys):
    (tmp_path / "thesis.docx").write_text("years of work")
    assert main(["estimate", str(bar), "-o", str(tmp_path)]) == 2
    assert "thesis.docx" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["thesis.docx"]


def test_a_simulation_is_repeated_by_its_seed(tmp_path):
    tables = []
    for name, seed in (("a", "5"), ("b", "5"), ("c", "6")):
        path = tmp_path / f"{name}.parquet"
        options = ["--gyr-rail", "7.5", "--smear", "0.02", "--rest", "--seed", seed]
        assert main(["simulate", "bar", "-o", str(path), *options]) == 0
        tables.append(pd.read_parquet(path))
    pd.testing.assert_frame_equal(tables[0], tables[1])
    assert not tables[0]["gyr_y"].equals(tables[2]["gyr_y"])
    # A calibration after clipping smears the plateau: the largest value is there once.
    assert (tables[0]["gyr_y"] == tables[0]["gyr_y"].max()).sum() == 1


def test_a_walk_fills_the_duration_with_strides(tmp_path):
    ends = {}
    for duration in ("12", "24"):
        path = tmp_path / f"walk{duration}.csv"
        assert main(["simulate", "walk", "-o", str(path), "--duration", duration]) == 0
        ends[duration] = pd.read_csv(tmp_path / f"walk{duration}_truth.csv")["pos_x"].iloc[-1]
    assert ends["12"] == pytest.approx(10 * 1.3) and ends["24"] == pytest.approx(20 * 1.3)


def test_help_and_version_load_nothing_heavy():
    """Starting must be quick: JAX alone takes half a second."""
    script = (
        "import sys; from jaxsat.cli import main; assert main(['--version']) == main(['--help']) == 0; "
        "print(sorted({'jax', 'numpy', 'pandas', 'scipy', 'plotly'} & set(sys.modules)))"
    )
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.startswith("jaxsat 0.") and done.stdout.strip().endswith("[]")


def test_the_compilation_cache_of_the_user_is_respected(monkeypatch, tmp_path):
    script = (
        "import jax; from jaxsat.cli.shared import use_compilation_cache as use; use(); "
        "from jaxsat.inertial import programs; print(jax.config.jax_compilation_cache_dir, programs._folder)"
    )
    for given, expected in (({}, tmp_path / "xdg" / "jaxsat"), ({"JAX_COMPILATION_CACHE_DIR": "/x"}, "/x")):
        environment = {"XDG_CACHE_HOME": str(tmp_path / "xdg"), "PATH": "", **given}
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, env=environment)
        assert done.stdout.split() == [str(expected), f"{expected}/traces"]


def test_a_bug_is_not_hidden(monkeypatch, bar):
    import jaxsat.present.summary as summary

    def broken(*_):
        raise ZeroDivisionError

    monkeypatch.setattr(summary, "inspect", broken)
    with pytest.raises(ZeroDivisionError):
        main(["inspect", str(bar)])


@pytest.mark.slow
def test_the_demo_compensates_most_of_the_error(tmp_path, capsys):
    assert main(["demo", "-o", str(tmp_path / "demo")]) == 0
    lines = capsys.readouterr().out.splitlines()
    before, after, unclipped = (
        float(next(line for line in lines if line.startswith(word)).split()[-2])
        for word in ("before", "after", "never")
    )
    assert unclipped < 0.2 and after < 0.1 * before
    report = Path(lines[-1].removeprefix("report: "))
    assert "motion capture" in report.read_text() and (tmp_path / "demo" / "walk_300dps.parquet").is_file()


def test_a_value_of_two_kinds_is_told_both(tmp_path):
    path = tmp_path / "sweeps.toml"
    path.write_text("[saturation]\nsweeps = 0\n")
    with pytest.raises(InputError, match=r"is 0, but input should be 'auto' or greater than or equal to 1\."):
        load_config(path)
