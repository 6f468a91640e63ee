"""Reading a recording: from a file in whatever format and units to one `Recording` in SI units."""

from pathlib import Path

import numpy as np

from jaxsat.errors import InputError
from jaxsat.signals.files import Source, nearest, open_source
from jaxsat.signals.formats import ANGULAR_RATE, BY_NAME, SPECIFIC_FORCE, Raw, as_flags, load_raw
from jaxsat.signals.grid import Grid, drop_repeats, find_grid, flags_onto_grid, onto_grid
from jaxsat.signals.recording import Recording

FORMATS = tuple(BY_NAME)
"""Names of the formats that can be read."""


def read(
    path: str | Path,
    *,
    format: str = "auto",
    rate: float | None = None,
    gyr_unit: str | None = None,
    acc_unit: str | None = None,
    rest_column: str | None = None,
    sensor: str | None = None,
    negate_acc: bool = False,
) -> Recording:
    """Read one recording, in SI units on a uniform time grid.

    `format` is one of `FORMATS`, or "auto" to recognise the content. `rate` (Hz) defines the time of files
    that have none; where there are time stamps it must agree with them to 2 %, and samples are interpolated
    onto it unless they lie there already. `gyr_unit` ("rad/s", "deg/s") and `acc_unit` ("m/s^2", "g") replace
    the units that the format is known to have (SI for canonical files). `rest_column` names the column or
    variable of rest flags (by default `rest`, if present). `sensor` chooses one of several in a file.
    `negate_acc` is for sensors that report minus the specific force; a recording alone cannot tell.

    Exact repeats of a row are dropped; lost samples and empty cells are interpolated and flagged `missing`
    (the rules are in `jaxsat.signals.grid`). Raises `InputError` for everything that can be wrong in a file's
    form; whether its values make sense is for `jaxsat.signals.checks.check`.
    """
    _known(gyr_unit, ANGULAR_RATE, "--gyr-unit")
    _known(acc_unit, SPECIFIC_FORCE, "--acc-unit")
    if rate is not None and not (np.isfinite(rate) and rate > 0):
        raise InputError(f"the rate is {rate} Hz; give --rate a positive number.")
    source = open_source(path)
    raw = load_raw(source, format, sensor)
    if len(raw.gyr) < 3:
        raise source.fail(f"only {len(raw.gyr)} samples; a recording needs at least 3, record for longer.")

    gyr = raw.gyr * ANGULAR_RATE[gyr_unit or raw.gyr_unit]
    acc = raw.acc * SPECIFIC_FORCE[acc_unit or raw.acc_unit] * (-1 if negate_acc else 1)
    signal = np.concatenate([gyr, acc], axis=1)
    rest = _rest(source, raw, rest_column)
    keep, grid = _grid(source, raw, signal, rate)
    values, missing = onto_grid(grid, signal[keep])
    return Recording(
        time=grid.time,
        gyr=values[:, :3],
        acc=values[:, 3:],
        missing=missing,
        rest=None if rest is None else flags_onto_grid(grid, rest[keep]),
        clipped=None if raw.clipped is None else flags_onto_grid(grid, raw.clipped[keep]) & ~missing,
        name=source.path.stem + (f":{sensor}" if sensor else ""),
    )


def _known(unit: str | None, units: dict[str, float], option: str) -> None:
    if unit is not None and unit not in units:
        raise InputError(f"unit '{unit}' is not known; give {option} one of {', '.join(units)}.")


def _rest(source: Source, raw: Raw, column: str | None) -> np.ndarray | None:
    if column is None and "rest" not in raw.flags:
        return None
    name = column or "rest"
    if name not in raw.flags:
        names = [key for key in raw.flags if not key.startswith("__")]
        raise source.fail(f"there are no rests called '{name}', {nearest(name, names)}; correct --rests.")
    rest = as_flags(source, raw.flags[name], name)
    if len(rest) != len(raw.gyr):
        raise source.fail(f"'{name}' has {len(rest)} flags for {len(raw.gyr)} samples; correct --rests.")
    return rest


def _grid(source: Source, raw: Raw, signal: np.ndarray, rate: float | None) -> tuple[np.ndarray, Grid]:
    """Rows to keep, and the grid that they lie on or near."""
    if raw.time is None:
        period = 1 / _rate(source, rate or raw.rate)
        return np.arange(len(signal)), Grid(0.0, period, np.arange(len(signal), dtype=np.float64))
    keep = drop_repeats(raw.time, signal, str(source.path), lambda k: source.row(int(k), raw.header_lines))
    if len(keep) < 3:
        raise source.fail("fewer than 3 different time stamps; check the column of the time.")
    return keep, find_grid(raw.time[keep], rate or raw.rate, rate is not None, str(source.path))


def _rate(source: Source, rate: float | None) -> float:
    if rate is None:
        raise source.fail("there is no column 'time'; add one (in seconds) or give --rate (in Hz).")
    return rate
