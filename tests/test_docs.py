"""What the documents say is so: the example runs, options, columns and names exist."""

import ast
import re
import subprocess
import sys
from pathlib import Path

import pytest

import jaxsat
from jaxsat.cli import app
from jaxsat.config import Method
from jaxsat.signals.readers import FORMATS

ROOT = Path(__file__).resolve().parents[1]
README = (ROOT / "README.md").read_text()
BLOCKS = re.findall(r"```(\w*)\n(.*?)```", README, re.DOTALL)


def test_the_example_runs_and_shows_what_it_claims(tmp_path, monkeypatch, capsys):
    (example,) = [text for language, text in BLOCKS if language == "python"]
    assert len([line for line in example.splitlines() if line.strip()]) <= 20
    monkeypatch.chdir(tmp_path)
    exec(compile(example, "README.md", "exec"), {})
    printed = capsys.readouterr().out
    standard, direct = (float(x) for x in re.findall(r"position is ([\d.]+) m off", printed))
    assert direct < 0.1 * standard
    assert (tmp_path / "bar-results" / "report.html").is_file()


def options_of(command: str) -> set[str]:
    """Names of the options that a command really has, from its own help."""
    script = f"from jaxsat.cli import main; main(['{command}', '--help'])"
    text = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True).stdout
    return {*re.findall(r"(--?[a-z][a-z-]*)", text)}


def test_commands_and_options_in_the_documents_exist():
    commands = {info.name for info in app.registered_commands}
    options = {command: options_of(command) for command in commands}
    for line in [line for _, text in BLOCKS for line in text.splitlines() if line.startswith("jaxsat ")]:
        _, command, *arguments = line.split("#")[0].split()
        assert command in commands
        assert {argument for argument in arguments if argument.startswith("-")} <= options[command]
    mentioned = set(re.findall(r"`(--[a-z-]+)", README))
    assert mentioned <= set.union(*options.values())


@pytest.mark.parametrize("table", ["trajectory", "signals", "gaps"])
def test_documented_columns_are_real(table):
    """Each `name` in the README's row of a file is a column, `pos_*` stands for its axes."""
    from test_tables import GAPS, SIGNALS, TRAJECTORY

    real = {"trajectory": TRAJECTORY, "signals": SIGNALS, "gaps": GAPS}[table]
    row = next(line for line in README.splitlines() if line.startswith(f"| `{table}.parquet`"))
    named = re.findall(r"`([^`]+)`", row.split("|")[3])
    covered = set()
    for name in named:
        if "…" in name:
            first, last = name.split("…")
            last = last if "_" in last else first.rsplit("_", 1)[0] + "_" + last
            found = {*real[real.index(first) : real.index(last) + 1]}
        else:
            found = {column for column in real if re.fullmatch(name.replace("*", ".*"), column)}
        assert found, f"{name} is no column of {table}"
        covered |= found
    assert covered == set(real)


def test_methods_and_formats_are_complete():
    methods = set(re.findall(r"^\| `(\w+)` \|", README.split("## Which method?")[1], re.MULTILINE))
    assert methods == set(Method.__args__)
    paragraph = README.split("## Formats")[1].split("##")[0]
    assert set(FORMATS) <= set(re.findall(r"`(\w+)`", paragraph))


def test_the_make_targets_exist():
    targets = set(re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE))
    for document in ("README.md", "CONTRIBUTING.md"):
        assert set(re.findall(r"\bmake ([a-z-]+)", (ROOT / document).read_text())) <= targets


def test_the_changelog_knows_this_version():
    changelog = (ROOT / "CHANGELOG.md").read_text()
    assert f"## {jaxsat.__version__}" in changelog and "### Scientific changes" in changelog


def test_public_names_are_the_same_for_people_and_for_type_checkers():
    tree = ast.parse((ROOT / "jaxsat" / "__init__.py").read_text())
    (guarded,) = [node for node in tree.body if isinstance(node, ast.If)]
    typed = {alias.name: node.module for node in guarded.body for alias in node.names}
    assert typed == jaxsat._HOME and set(jaxsat.__all__) == set(typed)
    for name in jaxsat.__all__:
        assert getattr(jaxsat, name) is getattr(sys.modules[typed[name]], name)


def test_importing_the_package_loads_nothing_and_changes_nothing():
    script = "import sys, jaxsat; print('jax' in sys.modules, 'numpy' in sys.modules)"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True)
    assert done.stdout.split() == ["False", "False"]
