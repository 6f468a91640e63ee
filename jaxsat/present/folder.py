"""Result folders: whole or not at all."""

import json
import os
import shutil
import tempfile
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pandas as pd

from jaxsat.attitude import Orientation
from jaxsat.errors import InputError
from jaxsat.periodic import PeriodicEstimate
from jaxsat.pipeline import Estimate
from jaxsat.present.periodic import (
    motion_table,
    periodic_gaps_table,
    periodic_signals_table,
    summarise_periodic,
)
from jaxsat.present.report import Track, render_report
from jaxsat.present.summary import summarise, summarise_orientation
from jaxsat.present.tables import (
    gaps_table,
    orientation_table,
    segments_table,
    signals_table,
    trajectory_table,
)

_TABLES = {
    "trajectory": trajectory_table,
    "signals": signals_table,
    "gaps": gaps_table,
    "segments": segments_table,
}
_PERIODIC = {"periodic": motion_table, "signals": periodic_signals_table, "gaps": periodic_gaps_table}
_KINDS = ("csv", "parquet")

ESTIMATE_FILES = frozenset(
    {"summary.json", "report.html", *(f"{name}.{kind}" for name in _TABLES for kind in _KINDS)}
)
ORIENTATION_FILES = frozenset({"summary.json", *(f"orientation.{kind}" for kind in _KINDS)})
PERIODIC_FILES = frozenset({"summary.json", *(f"{name}.{kind}" for name in _PERIODIC for kind in _KINDS)})
SWEEP_FILES = frozenset({"summary.json", *(f"sweep.{kind}" for kind in _KINDS)})


def check_folder(folder: Path, files: frozenset[str] = ESTIMATE_FILES) -> None:
    """Raise `InputError` where results cannot go: only a new, an empty or a former result folder is written.

    files: what results of that kind consist of; those of another kind are not replaced.
    """
    if folder.is_symlink() or (folder.exists() and not folder.is_dir()):
        raise InputError(f"{folder}: not a folder; choose another name for the results.")
    if folder.is_dir():
        present = {entry.name for entry in folder.iterdir()}
        if present and not ("summary.json" in present and present <= files):
            other = min(present - files, default="other files")
            raise InputError(
                f"{folder}: holds files that are no such results ({other}); choose another folder."
            )
    parent = folder.absolute().parent
    while not parent.exists():
        parent = parent.parent
    if not (parent.is_dir() and os.access(parent, os.W_OK)):
        raise InputError(f"{folder}: {parent} is not a folder that can be written; choose another place.")


def write_results(
    estimate: Estimate,
    folder: str | Path,
    *,
    csv: bool = False,
    source: Path | None = None,
    beside: Mapping[str, Track] | None = None,
    scores: pd.DataFrame | None = None,
) -> Path:
    """Write the documented files of an estimate; returns the path of its report.

    `source` is the file that the recording came from; `beside` are other tracks to draw, and `scores` a table
    to show, in the report. A former result folder is replaced; raises `InputError` as `check_folder` does.
    """
    folder = Path(folder)
    with _replaced(folder, ESTIMATE_FILES) as new:
        for name, make in _TABLES.items():
            _write_table(make(estimate), new, name, csv)
        summary = summarise(estimate, source)
        _write_summary(summary, new)
        (new / "report.html").write_text(render_report(estimate, summary, beside or {}, scores), "utf-8")
    return folder / "report.html"


def write_orientation(
    found: Orientation, folder: str | Path, *, csv: bool = False, source: Path | None = None
) -> Path:
    """Write the table of an orientation and its summary; returns the path of the table.

    A former folder of an orientation is replaced; raises `InputError` as `check_folder` does.
    """
    folder = Path(folder)
    with _replaced(folder, ORIENTATION_FILES) as new:
        name = _write_table(orientation_table(found), new, "orientation", csv).name
        _write_summary(summarise_orientation(found, source), new)
    return folder / name


def write_periodic(
    found: PeriodicEstimate, folder: str | Path, *, csv: bool = False, source: Path | None = None
) -> Path:
    """Write the tables of a periodic estimate and its summary; returns the path of the motion's table.

    A former folder of `jaxsat periodic` is replaced; raises `InputError` as `check_folder` does.
    """
    folder = Path(folder)
    with _replaced(folder, PERIODIC_FILES) as new:
        names = [_write_table(make(found), new, name, csv).name for name, make in _PERIODIC.items()]
        _write_summary(summarise_periodic(found, source), new)
    return folder / names[0]


def write_sweep(
    table: pd.DataFrame, summary: Mapping[str, Any], folder: str | Path, *, csv: bool = False
) -> Path:
    """Write the table of a sweep and its summary; returns the path of the table.

    A former folder of a sweep is replaced; raises `InputError` as `check_folder` does.
    """
    folder = Path(folder)
    with _replaced(folder, SWEEP_FILES) as new:
        name = _write_table(table, new, "sweep", csv).name
        _write_summary(summary, new)
    return folder / name


def _write_table(table: pd.DataFrame, folder: Path, name: str, csv: bool) -> Path:
    if csv:
        table.to_csv(path := folder / f"{name}.csv", index=False)
    else:
        table.to_parquet(path := folder / f"{name}.parquet", index=False)
    return path


def _write_summary(summary: Mapping[str, Any], folder: Path) -> None:
    (folder / "summary.json").write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n")


@contextmanager
def _replaced(folder: Path, files: frozenset[str]) -> Iterator[Path]:
    """A new folder that takes the place of `folder` when the block ends well, and vanishes otherwise."""
    check_folder(folder, files)
    folder = folder.absolute()
    try:
        folder.parent.mkdir(parents=True, exist_ok=True)
        # Beside the target, so that renaming stays within one file system.
        work = Path(tempfile.mkdtemp(prefix=f".{folder.name}.", dir=folder.parent))
    except OSError as error:
        raise InputError(f"{folder}: cannot be written ({error.strerror}); choose another place.") from None
    try:
        new, old = work / "new", work / "old"
        new.mkdir()
        yield new
        if folder.exists():
            os.rename(folder, old)
        os.rename(new, folder)
    finally:
        if (work / "old").exists() and not folder.exists():
            os.rename(work / "old", folder)
        shutil.rmtree(work)
