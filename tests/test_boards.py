"""Boards: what is written can be read, told by people, and gated."""

import json
import math
import socket
from importlib.metadata import version

import pytest

from jaxsat.errors import InputError
from jaxsat.studies import boards
from jaxsat.studies.boards import Row, machine, read_board, worse, write_board

ROWS = [
    Row("speed", 0.25, "µs", "lower", goal=0.5, baseline=1.0, note="256 | 512"),
    Row("speedup", 3, "1", "higher", goal=4.0),
    Row("gpu_speed", math.nan, "µs", "lower", goal=0.1),
]


def one(value, direction="lower", unit="s", metric="time"):
    return [Row(metric, value, unit, direction)]


def test_a_board_reads_as_it_was_written(tmp_path):
    path = tmp_path / "deep" / "board.json"
    write_board(path, ROWS, {"trials": 256})
    assert read_board(path) == ROWS
    assert sorted(file.name for file in path.parent.iterdir()) == ["board.json", "board.md", "env.json"]
    assert json.loads((path.parent / "env.json").read_text())["configuration"] == {"trials": 256}


def test_the_form_is_the_documented_one(tmp_path):
    write_board(tmp_path / "board.json", ROWS[:1], {})
    assert json.loads((tmp_path / "board.json").read_text()) == [
        {
            "metric": "speed",
            "value": 0.25,
            "unit": "µs",
            "direction": "lower",
            "goal": 0.5,
            "baseline": 1.0,
            "note": "256 | 512",
        }
    ]


def test_boards_of_one_folder_keep_apart(tmp_path):
    write_board(tmp_path / "cpu.json", ROWS, {"device": "cpu"})
    write_board(tmp_path / "gpu.json", ROWS, {"device": "gpu"})
    names = {"cpu.json", "cpu.md", "cpu_env.json", "gpu.json", "gpu.md", "gpu_env.json"}
    assert {file.name for file in tmp_path.iterdir()} == names
    assert json.loads((tmp_path / "cpu_env.json").read_text())["configuration"]["device"] == "cpu"


def test_the_table_tells_goals_met_goals_missed_and_what_was_not_measured(tmp_path):
    write_board(tmp_path / "board.json", ROWS, {})
    lines = (tmp_path / "board.md").read_text().splitlines()
    assert lines[2] == "| `speed` | 0.25 | µs | ≤ 0.5, met | 1 | 256 \\| 512 |"
    assert lines[3] == "| `speedup` | 3 | 1 | ≥ 4, missed |  |  |"
    assert lines[4] == "| `gpu_speed` | not measured | µs | ≤ 0.1 |  |  |"
    assert f"jaxsat {version('jaxsat')}" in lines[-1]


def test_nan_is_written_as_null(tmp_path):
    write_board(tmp_path / "board.json", one(math.nan), {})
    assert json.loads((tmp_path / "board.json").read_text())[0]["value"] is None
    assert Row("m", math.nan, "s", "lower") == Row("m", None, "s", "lower")


@pytest.mark.parametrize(
    "direction, old, new, gated",
    [
        ("lower", 10.0, 10.9, False),
        ("lower", 10.0, 11.1, True),
        ("lower", 10.0, 1.0, False),
        ("higher", 10.0, 9.1, False),
        ("higher", 10.0, 8.9, True),
        ("higher", 10.0, 100.0, False),
        ("higher", -10.0, -10.9, False),
        ("higher", -10.0, -11.1, True),
        ("lower", 0.0, 1e-9, True),
        ("lower", 0.0, 0.0, False),
        ("lower", None, 5.0, False),
        ("lower", 5.0, None, False),
        ("lower", 5.0, math.nan, False),
    ],
)
def test_worse_is_beyond_the_tolerance_in_the_bad_direction(direction, old, new, gated):
    sentences = worse(one(new, direction), one(old, direction), 0.1)
    assert bool(sentences) == gated
    if gated:
        assert "time" in sentences[0] and "10 %" in sentences[0]


def test_a_metric_that_vanished_or_changed_its_meaning_is_reported():
    assert "time is missing" in worse([], one(1.0), 0.1)[0]
    # The same number in another unit, and one that is better only if read the other way round.
    assert "'ms'" in worse(one(1.0, unit="ms"), one(1.0), 0.1)[0]
    assert "higher" in worse(one(2.0, "higher"), one(1.0, "lower"), 0.1)[0]
    # A new metric has nothing to be worse than.
    assert worse(one(1.0), [], 0.1) == []


def test_a_write_that_fails_leaves_the_old_board(tmp_path):
    path = tmp_path / "board.json"
    write_board(path, ROWS, {})
    before = {file.name: file.read_text() for file in tmp_path.iterdir()}
    with pytest.raises(TypeError):
        write_board(path, one(1.0), {"not JSON": object()})
    assert {file.name: file.read_text() for file in tmp_path.iterdir()} == before


def test_wrong_boards_are_refused_in_one_sentence(tmp_path):
    with pytest.raises(InputError, match=r"comes twice"):
        write_board(tmp_path / "board.json", [*one(1.0), *one(2.0)], {})
    with pytest.raises(InputError, match=r"\.json"):
        write_board(tmp_path / "board.csv", ROWS, {})
    with pytest.raises(InputError, match="infinite"):
        Row("m", math.inf, "s", "lower")
    with pytest.raises(InputError, match="cannot be read"):
        read_board(tmp_path / "none.json")
    for number, text in enumerate(("{", "[1]", '[{"metric": "m"}]')):
        path = tmp_path / f"{number}.json"
        path.write_text(text)
        with pytest.raises(InputError, match="not a board"):
            read_board(path)


def test_the_machine_names_hardware_and_versions_but_no_host_and_no_path():
    found = machine()
    assert found["cores"] >= 1 and found["cpu"] and found["device"]
    names = {"jaxsat", "jax", "jaxlib", "jaxopt", "optax", "equinox", "numpy"}
    assert found["versions"] == {name: version(name) for name in names}
    texts = [value for value in found.values() if isinstance(value, str)]
    assert socket.gethostname() not in texts
    assert not [text for text in texts if text.startswith("/")]


def test_the_commit_is_that_of_the_package_or_none(monkeypatch, tmp_path):
    commit = machine()["commit"]
    assert commit is None or len(commit) in (40, 64)
    # A copy outside of any checkout, or one that the checkout around it does not track.
    monkeypatch.setattr(boards, "__file__", str(tmp_path / "jaxsat" / "studies" / "boards.py"))
    assert machine()["commit"] is None
