"""Files as named columns: CSV, Parquet, MATLAB and NumPy archives, with their faults in plain words."""

import csv
import difflib
import struct
import warnings
import zipfile
import zlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

import numpy as np
import pandas as pd
import pyarrow
import pyarrow.parquet
import scipy.io
from jaxtyping import Float

from jaxsat.errors import InputError

HEAD = 1 << 16
"""Bytes that are looked at to tell what a file is."""

LIBRARY_ERRORS = (ValueError, TypeError, LookupError, OSError, EOFError, NotImplementedError, MemoryError)
BROKEN = (*LIBRARY_ERRORS, zipfile.BadZipFile, zlib.error, struct.error, pyarrow.ArrowException)
"""What libraries raise when a file is damaged."""


@dataclass(frozen=True)
class Source:
    """A file opened far enough to tell its format; archives are read whole, tables are not yet."""

    path: Path
    kind: Literal["csv", "parquet", "mat", "npz"]
    names: tuple[str, ...]
    """Columns or variables; of a CSV the cells of its first line."""
    second_line: tuple[str, ...] = ()
    """The cells of the second line of a CSV."""
    arrays: dict[str, Any] = field(default_factory=dict)
    """The variables of an archive."""

    def fail(self, what: str) -> InputError:
        """The error that says `what` about this file."""
        return InputError(f"{self.path}: {what}")

    def row(self, index: int, header_lines: int) -> str:
        """What to call a row in a message: its line in a CSV, else its number."""
        return f"line {index + header_lines + 1}" if self.kind == "csv" else f"sample {index}"


def open_source(path: str | Path) -> Source:
    """Tell what a file is, by its content and never by its name.

    Raises `InputError` if the file is absent, empty, damaged, or of no kind that is known here.
    """
    path = Path(path)
    try:
        with path.open("rb") as file:
            head = file.read(HEAD)
    except OSError as error:
        raise InputError(f"{path}: cannot read the file ({error.strerror}); check the path.") from None
    if not head.strip():
        raise InputError(f"{path}: the file is empty; export the recording again.")
    if head.startswith(b"\x89HDF") or head.startswith(b"MATLAB 7.3"):
        raise InputError(f"{path}: this is a MATLAB 7.3 (HDF5) file; save it again with `save(..., '-v7')`.")
    if head.startswith(b"PAR1"):
        names = _guarded(path, "Parquet", lambda: pyarrow.parquet.read_schema(path).names)
        return Source(path, "parquet", tuple(names))
    if head.startswith(b"MATLAB 5.0"):
        arrays = _guarded(path, "MATLAB", lambda: scipy.io.loadmat(str(path)))
        return Source(path, "mat", tuple(map(str, arrays)), arrays=arrays)
    if head.startswith(b"PK\x03\x04"):
        arrays = _guarded(path, "npz", lambda: _npz_arrays(path))
        return Source(path, "npz", tuple(arrays), arrays=arrays)
    if b"\0" in head:
        raise InputError(f"{path}: neither text nor a known archive; give CSV, Parquet, MAT (v7) or npz.")
    lines = head.decode("utf-8-sig", "replace").splitlines()[:2]
    first, second = ([tuple(cell.strip() for cell in cells) for cells in csv.reader(lines)] + [(), ()])[:2]
    return Source(path, "csv", first, second)


def _npz_arrays(path: Path) -> dict[str, np.ndarray]:
    # Opened here, because numpy leaves the files open that it cannot read.
    with path.open("rb") as file, np.load(file, allow_pickle=False) as archive:
        return dict(archive)


def _guarded(path: Path, kind: str, load: Callable[[], Any]) -> Any:
    """Whatever a library says about a damaged file, said in one sentence."""
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            return load()
    except BROKEN:
        raise InputError(f"{path}: the {kind} file is damaged or cut short; copy it again.") from None


def read_table(source: Source, names: tuple[str, ...], header_lines: int) -> dict[str, np.ndarray]:
    """All columns of a CSV (below its header) or Parquet file, by the names that they are to have.

    Empty cells are NaN; rows keep their positions in the file. Raises `InputError` for damaged or ragged
    files and for repeated names.
    """
    for name in names:
        if name and names.count(name) > 1:
            raise source.fail(f"two columns are called '{name}'; rename or delete one of them.")
    if source.kind == "parquet":
        frame = _guarded(source.path, "Parquet", lambda: pd.read_parquet(source.path))
        return {str(name): frame[name].to_numpy() for name in frame.columns}
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("error", pd.errors.ParserWarning)
            # From 3.1 on pandas reads digit for digit by itself and deprecates asking for it.
            warnings.simplefilter("ignore", DeprecationWarning)
            frame = pd.read_csv(
                source.path,
                header=None,
                names=[name or f"unnamed {k}" for k, name in enumerate(names)],
                skiprows=header_lines,
                index_col=False,
                encoding="utf-8-sig",
                skip_blank_lines=False,
                skipinitialspace=True,
                low_memory=False,
                float_precision="round_trip",
            )
    except UnicodeDecodeError:
        raise source.fail("the text holds bytes that are not UTF-8; save it again as UTF-8.") from None
    except pd.errors.ParserWarning:
        raise source.fail(
            "the lines have more cells than there are column names; name all columns."
        ) from None
    except ValueError as error:
        detail = (
            str(error).strip().splitlines()[-1].removeprefix("Error tokenizing data. C error: ").rstrip(".")
        )
        raise source.fail(f"not a regular CSV table ({detail}); give all lines the same columns.") from None
    filled = np.flatnonzero(frame.notna().any(axis=1))
    rows = filled[-1] + 1 if len(filled) else 0  # blank lines at the end say nothing
    return {str(name): frame[name].to_numpy()[:rows] for name in frame.columns}


def numbers(source: Source, column: np.ndarray, name: str, header_lines: int) -> Float[np.ndarray, "N"]:
    """One column as float64, empty cells as NaN; text and infinities raise `InputError` with their line."""
    values = np.asarray(pd.to_numeric(column, errors="coerce"), dtype=np.float64)
    bad = np.flatnonzero((np.isnan(values) & ~pd.isna(column)) | np.isinf(values))
    if len(bad):
        place = f"{source.row(int(bad[0]), header_lines)}, column '{name}'"
        text = " ".join(str(column[bad[0]]).split())[:40]
        raise source.fail(f"{place}: '{text}' is not a finite number; correct it or empty the cell.")
    return values


def nearest(name: str, known: Iterable[str]) -> str:
    """A half sentence that points to the known name most like `name`, or lists all of them."""
    known = [*known]
    close = difflib.get_close_matches(name, known, 1, 0.5)
    return f"the nearest there is '{close[0]}'" if close else f"there are {', '.join(known) or 'none'}"
