"""Boards: one form for every measured result, with what it was measured on beside it.

A board is a JSON list of rows. `board.json` stands beside `board.md`, the same for people, and `env.json`; another
name keeps its stem, `cpu.json` beside `cpu.md` and `cpu_env.json`. None of them holds a host name or a path.
"""

import json
import math
import os
import platform
import subprocess
from collections.abc import Callable, Iterable, Mapping
from dataclasses import asdict, dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, Literal

import jax

from jaxsat.errors import InputError
from jaxsat.inertial.programs import usable_cores

Direction = Literal["lower", "higher"]
"""Which values are better."""

_PACKAGES = ("jaxsat", "jax", "jaxlib", "jaxopt", "optax", "equinox", "numpy")


@dataclass(frozen=True)
class Row:
    """One measured number. None or NaN says that it was not measured; NaN becomes None."""

    metric: str
    value: float | int | None
    unit: str
    direction: Direction
    goal: float | int | None = None
    """What is aimed at."""
    baseline: float | int | None = None
    """What it is compared with: another method, another package."""
    note: str = ""

    def __post_init__(self):
        if self.direction not in ("lower", "higher"):
            raise InputError(f"{self.metric}: direction '{self.direction}'; give 'lower' or 'higher'.")
        for name in ("value", "goal", "baseline"):
            number = getattr(self, name)
            if number is not None and math.isinf(number):
                raise InputError(
                    f"{self.metric}: {name} is infinite; give a finite number, or None for none."
                )
            if number is not None and math.isnan(number):
                object.__setattr__(self, name, None)


def write_board(path: Path, rows: Iterable[Row], configuration: Mapping[str, Any]) -> None:
    """Write a board, its Markdown twin and its environment; each file is whole or not there.

    configuration: what has to be known to measure again, ready for JSON. Raises `InputError` where the name of
    the file does not end in .json or a metric comes twice.
    """
    path, rows = Path(path), list(rows)
    if path.suffix != ".json":
        raise InputError(f"{path}: a board is JSON; end its name in .json.")
    metrics = [row.metric for row in rows]
    twice = sorted({metric for metric in metrics if metrics.count(metric) > 1})
    if twice:
        raise InputError(f"{path}: the metric '{twice[0]}' comes twice; name each row differently.")
    environment = {**machine(), "configuration": dict(configuration)}
    path.parent.mkdir(parents=True, exist_ok=True)
    write_whole(_environment_path(path), _as_json(environment))
    write_whole(path.with_suffix(".md"), _as_markdown(rows, environment))
    write_whole(path, _as_json([asdict(row) for row in rows]))


def read_board(path: Path) -> list[Row]:
    """The rows of a board. Raises `InputError` where the file is none."""
    try:
        return [Row(**row) for row in json.loads(Path(path).read_text("utf-8"))]
    except OSError as error:
        raise InputError(f"{path}: cannot be read ({error.strerror}); check the path.") from None
    except (ValueError, TypeError) as error:
        raise InputError(f"{path}: not a board ({error}); write it again.") from None


def worse(rows: Iterable[Row], baseline_rows: Iterable[Row], tolerance: float) -> list[str]:
    """What got worse than a committed board, one sentence each; empty if nothing did.

    tolerance: relative to the committed value. A committed metric that is missing, or has another unit or
    direction, counts as worse; one that either board did not measure does not.
    """
    found = {row.metric: row for row in rows}
    sentences = []
    for old in baseline_rows:
        new = found.get(old.metric)
        if new is None:
            sentences.append(f"{old.metric} is missing; the committed board has it.")
        elif (new.unit, new.direction) != (old.unit, old.direction):
            sentences.append(
                f"{old.metric} is now in '{new.unit}' ({new.direction} is better), and was committed in "
                f"'{old.unit}' ({old.direction} is better)."
            )
        elif new.value is not None and old.value is not None:
            loss = new.value - old.value if old.direction == "lower" else old.value - new.value
            if loss > tolerance * abs(old.value):
                sentences.append(
                    f"{old.metric} is {_number(new.value)} {old.unit}, worse than the committed "
                    f"{_number(old.value)} by more than {100 * tolerance:g} % ({old.direction} is better)."
                )
    return sentences


def machine() -> dict[str, Any]:
    """What measurements here run on: hardware, versions and, in a checkout, the commit."""
    devices = jax.devices()
    return {
        "cpu": _cpu_model(),
        "cores": usable_cores(),
        "device": devices[0].device_kind,
        "devices": len(devices),
        "python": platform.python_version(),
        "versions": {name: version(name) for name in _PACKAGES},
        **_commit(),
    }


def _cpu_model() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
    except OSError:
        lines = []
    names = [line.split(":", 1)[1].strip() for line in lines if line.startswith("model name")]
    return names[0] if names else platform.processor() or platform.machine()


def _commit() -> dict[str, Any]:
    """The commit of the package, and whether the package differs from it; None where it is in no checkout."""
    package = Path(__file__).resolve().parents[1]
    # An installed package may lie in the checkout of another project, which does not track it.
    if _git(package, "ls-files", "--error-unmatch", "__init__.py") is None:
        return {"commit": None}
    # Without locks: measuring must not disturb a commit that is under way.
    clean = _git(package, "--no-optional-locks", "diff", "--quiet", "HEAD", "--", ".")
    return {"commit": _git(package, "rev-parse", "HEAD"), "modified": clean is None}


def _git(folder: Path, *arguments: str) -> str | None:
    """The output of git, or None where it fails or is absent."""
    command = ["git", "-C", str(folder), *arguments]
    try:
        return subprocess.run(command, check=True, capture_output=True, text=True).stdout.strip()
    except (OSError, subprocess.CalledProcessError):
        return None


def _environment_path(path: Path) -> Path:
    return path.with_name("env.json" if path.stem == "board" else f"{path.stem}_env.json")


def _as_json(value: Any) -> str:
    return json.dumps(value, indent=2, ensure_ascii=False, allow_nan=False) + "\n"


def _as_markdown(rows: list[Row], environment: Mapping[str, Any]) -> str:
    """A table, and the machine in one line below it."""
    cells = [
        ("metric", "value", "unit", "goal", "baseline", "note"),
        ("---", "---:", "---", "---", "---:", "---"),
    ]
    for row in rows:
        value = "not measured" if row.value is None else _number(row.value)
        cells.append((f"`{row.metric}`", value, row.unit, _goal(row), _number(row.baseline), row.note))
    table = "".join("| " + " | ".join(cell.replace("|", "\\|") for cell in line) + " |\n" for line in cells)
    versions = ", ".join(f"{name} {number}" for name, number in environment["versions"].items())
    cores = "1 core" if environment["cores"] == 1 else f"{environment['cores']} cores"
    device = "" if environment["device"] == "cpu" else f", {environment['devices']} × {environment['device']}"
    return f"{table}\n{environment['cpu']}, {cores}{device}; Python {environment['python']}, {versions}.\n"


def _goal(row: Row) -> str:
    """The goal with its direction, and whether it is met."""
    if row.goal is None:
        return ""
    bound = f"{'≤' if row.direction == 'lower' else '≥'} {_number(row.goal)}"
    if row.value is None:
        return bound
    met = row.value <= row.goal if row.direction == "lower" else row.value >= row.goal
    return f"{bound}, {'met' if met else 'missed'}"


def _number(value: float | int | None) -> str:
    return "" if value is None else f"{value:.4g}"


def write_whole(path: Path, content: str | Callable[[Path], object]) -> None:
    """A text, or what a function writes to the path given to it, under a temporary name first: a file with the
    final name is always whole."""
    partial = path.with_name(f".{path.name}.partial")
    if callable(content):
        content(partial)
    else:
        partial.write_text(content, "utf-8")
    os.replace(partial, path)
