"""`jaxsat periodic` end to end: files, options, and one line for every error."""

import json

import numpy as np
import pandas as pd
import pytest
from shaking import shaken

from jaxsat.cli import main


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
