"""`jaxsat orientation` end to end: files, options, and one line for every error."""

import json

import numpy as np
import pandas as pd
import pytest

from jaxsat.cli import main

COLUMNS = [
    "time",
    *("q_w", "q_x", "q_y", "q_z"),
    *("euler_x", "euler_y", "euler_z", "inclination_sd", "heading_sd"),
    *("bias_x", "bias_y", "bias_z"),
    *(f"sat_{sensor}_{axis}" for sensor in ("gyr", "acc") for axis in "xyz"),
]
CHANNELS = [f"{sensor}_{axis}" for sensor in ("gyr", "acc") for axis in "xyz"]


@pytest.fixture(scope="module")
def joint(tmp_path_factory):
    """A joint that bends ±90° about x, and its truth beside it."""
    path = tmp_path_factory.mktemp("joint") / "joint.csv"
    assert main(["simulate", "joint", "-o", str(path), "--duration", "8", "--seed", "3"]) == 0
    return path


def test_it_writes_the_documented_files_and_comes_close_to_the_truth(joint, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["orientation", str(joint), "-o", str(out)]) == 0
    printed = capsys.readouterr()
    assert printed.err == "" and str(out / "orientation.parquet") in printed.out and "smoothed" in printed.out
    assert {path.name for path in out.iterdir()} == {"orientation.parquet", "summary.json"}
    found = pd.read_parquet(out / "orientation.parquet")
    assert list(found.columns) == COLUMNS
    truth = pd.read_csv(joint.with_name("joint_truth.csv"))
    names = ["q_w", "q_x", "q_y", "q_z"]
    dot = np.abs(np.sum(found[names].to_numpy() * truth[names].to_numpy(), axis=1))
    assert np.rad2deg(2 * np.arccos(np.clip(dot, 0, 1))).max() < 1.0
    summary = json.loads((out / "summary.json").read_text())
    assert summary["estimate"] == "smoothed" and summary["gains"]["gate"] == "none"
    assert len(summary["input"]["sha256"]) == 64


def test_options_reach_the_filter(joint, tmp_path, capfd):
    out = tmp_path / "out"
    options = "--estimate pi --update imp --kp 0.7 --ki 0.02 --tau 1 --gate 2 --gyr-rail none --csv --quiet"
    assert main(["orientation", str(joint), "-o", str(out), *options.split()]) == 0
    assert capfd.readouterr() == ("", "")
    summary = json.loads((out / "summary.json").read_text())
    assert summary["gains"] == {"kp": 0.7, "ki": 0.02, "tau": 1.0, "gate": 2.0, "limit": 0.05}
    used = summary["configuration"]["orientation"]
    assert (used["estimate"], used["update"]) == ("pi", "imp")
    assert list(pd.read_csv(out / "orientation.csv").columns) == COLUMNS


def test_good_gain_proposes_from_the_recording(joint, tmp_path, capsys):
    assert main(["orientation", str(joint), "-o", str(tmp_path / "out"), "--good-gain", "--tau", "1"]) == 0
    gains = json.loads((tmp_path / "out" / "summary.json").read_text())["gains"]
    assert gains["kp"] == pytest.approx(1.0, rel=0.15) and gains["ki"] > 0.05
    assert f"kp {gains['kp']:.4g}" in capsys.readouterr().out


def test_moving_at_once_is_a_warning_that_strict_counts(joint, tmp_path, capsys):
    table = pd.read_csv(joint).iloc[110:]
    table.to_csv(tmp_path / "late.csv", index=False)
    assert main(["orientation", str(tmp_path / "late.csv"), "-o", str(tmp_path / "out"), "--strict"]) == 3
    assert "first second" in capsys.readouterr().err


def spoilt(joint, folder, change):
    table = pd.read_csv(joint)
    path = folder / "spoilt.csv"
    change(table).to_csv(path, index=False)
    return path


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda t: t.drop(columns=CHANNELS[3:]), "acc_x"),
        (lambda t: t.assign(**dict.fromkeys(CHANNELS[3:], "")), "accelerometer"),
        (lambda t: t.assign(**dict.fromkeys(CHANNELS[:3], "")), "gyroscope"),
        (lambda t: t.iloc[:80], "first second"),
    ],
    ids=["no-columns", "no-accelerometer", "no-gyroscope", "short"],
)
def test_bad_recordings_are_one_sentence(joint, tmp_path, capfd, change, says):
    path = spoilt(joint, tmp_path, change)
    assert main(["orientation", str(path), "-o", str(tmp_path / "out")]) == 2
    printed = capfd.readouterr()
    assert printed.out == "" and says in printed.err
    assert printed.err.startswith("jaxsat: ") and printed.err.count("\n") == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "options",
    ["--kp -1", "--ki -0.1", "--tau -2", "--gate 0", "--gate wide", "--estimate best", "--update none"],
)
def test_bad_options_are_one_sentence(joint, tmp_path, capfd, options):
    assert main(["orientation", str(joint), "-o", str(tmp_path / "out"), *options.split()]) == 2
    printed = capfd.readouterr()
    key = options.split()[0].removeprefix("--")
    assert f"orientation.{key}" in printed.err and printed.err.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


def test_results_of_another_kind_are_not_replaced(joint, tmp_path, capsys):
    out = tmp_path / "out"
    assert main(["orientation", str(joint), "-o", str(out), "--estimate", "gyro", "--quiet"]) == 0
    assert main(["estimate", str(joint), "-o", str(out)]) == 2
    assert "orientation.parquet" in capsys.readouterr().err
