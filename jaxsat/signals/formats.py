"""The formats that recordings come in: how each is recognised, where its signals lie, which units it uses."""

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pandas as pd

from jaxsat.errors import InputError
from jaxsat.signals.files import Source, nearest, numbers, read_table
from jaxsat.signals.recording import CHANNELS

GRAVITY = 9.80665
"""Standard gravity, the unit `g` (m/s²)."""
ANGULAR_RATE = {"rad/s": 1.0, "deg/s": np.pi / 180}
SPECIFIC_FORCE = {"m/s^2": 1.0, "g": GRAVITY}
CLIP = tuple(f"clip_{channel}" for channel in CHANNELS)
XIO = (*(f"Gyroscope {axis} (deg/s)" for axis in "XYZ"), *(f"Accelerometer {axis} (g)" for axis in "XYZ"))


@dataclass
class Raw:
    """What one file holds, in its own units; NaN where nothing was measured."""

    gyr: np.ndarray
    acc: np.ndarray
    time: np.ndarray | None = None
    """Time stamps (s), if there are usable ones."""
    rate: float | None = None
    """The rate that the format is known to have (Hz): without stamps it defines the time."""
    gyr_unit: str = "rad/s"
    acc_unit: str = "m/s^2"
    flags: dict[str, Any] = field(default_factory=dict)
    """Columns or variables that rests can be taken from, by name."""
    clipped: np.ndarray | None = None
    header_lines: int = 0


@dataclass(frozen=True)
class Format:
    """One known format: what it is recognised by, and how to load it (or one sensor of it)."""

    looks_for: str
    matches: Callable[[Source], bool]
    load: Callable[[Source, str | None], Raw]


def load_raw(source: Source, format: str, sensor: str | None) -> Raw:
    """Load a source as `format`, or for "auto" as the format that its content fits.

    Raises `InputError` if it fits none, or lacks what its format needs.
    """
    if format != "auto" and format not in BY_NAME:
        raise InputError(f"format '{format}' is not known; choose auto or one of {', '.join(BY_NAME)}.")
    candidates = BY_NAME if format == "auto" else {format: BY_NAME[format]}
    for candidate in candidates.values():
        if candidate.matches(source):
            return candidate.load(source, sensor)
    if source.kind == "csv" and any(mark in cell for cell in source.names for mark in ";\t"):
        raise source.fail("the columns are not separated by commas; save the table with commas between them.")
    if source.kind == "csv" and _is_numeric(source.names):
        raise source.fail("line 1 holds numbers where names belong; add a line time,gyr_x,…,acc_z above it.")
    known = "; ".join(f"{name}: {candidate.looks_for}" for name, candidate in candidates.items())
    raise source.fail(f"the content is not what was looked for ({known}); rename columns to fit one.")


def _is_numeric(cells: tuple[str, ...]) -> bool:
    try:
        return len(cells) > 0 and all(np.isfinite(float(cell)) for cell in cells)
    except ValueError:
        return False


def _one_sensor(source: Source, sensor: str | None) -> None:
    if sensor is not None:
        raise source.fail(f"the file does not name its sensor; leave out --sensor {sensor}.")


def _columns(source: Source, table: dict[str, np.ndarray], names: tuple[str, ...], lines: int) -> np.ndarray:
    for name in names:
        if name not in table:
            others = [other for other in table if other not in names]
            raise source.fail(f"column '{name}' is missing, {nearest(name, others)}; rename or add it.")
    return np.stack([numbers(source, table[name], name, lines) for name in names], axis=1)


def _table(source: Source, time: str, names: tuple[str, ...]) -> Raw:
    """A table with one header line."""
    table = read_table(source, source.names, 1)
    signal = _columns(source, table, names, 1)
    stamps = numbers(source, table[time], time, 1) if time in table else None
    return Raw(signal[:, :3], signal[:, 3:], stamps, flags=table, header_lines=1)


def _canonical(source: Source, sensor: str | None) -> Raw:
    _one_sensor(source, sensor)
    raw = _table(source, "time", CHANNELS)
    if not raw.flags.keys().isdisjoint(CLIP):
        absent = np.zeros(len(raw.gyr), dtype=bool)
        flags = [as_flags(source, raw.flags.get(name, absent), name) for name in CLIP]
        raw.clipped = np.stack(flags, axis=1)
    return raw


def _xio(source: Source, sensor: str | None) -> Raw:
    _one_sensor(source, sensor)
    raw = _table(source, "Time (s)", XIO)
    raw.gyr_unit, raw.acc_unit = "deg/s", "g"
    return raw


def _gaitmap(source: Source, sensor: str | None) -> Raw:
    # The first line names the sensor of each column, the second its axis; the first column only counts.
    sensors = [*dict.fromkeys(source.names[1:])]
    if sensor is None and len(sensors) > 1:
        raise source.fail(f"the file holds several sensors ({', '.join(sensors)}); name one with --sensor.")
    sensor = sensor or sensors[0]
    if sensor not in sensors:
        raise source.fail(f"there is no sensor '{sensor}', {nearest(sensor, sensors)}; correct --sensor.")
    if len(source.names) != len(source.second_line):
        raise source.fail("the two header lines differ in length; export the recording again.")
    names = tuple(f"{one} {axis}" for one, axis in zip(source.names, source.second_line, strict=True))
    table = read_table(source, names, 2)
    signal = _columns(source, table, tuple(f"{sensor} {channel}" for channel in CHANNELS), 2)
    flags = {name.removeprefix(f"{sensor} "): table[name] for name in table}
    return Raw(signal[:, :3], signal[:, 3:], rate=204.8, gyr_unit="deg/s", flags=flags, header_lines=2)


def _tremor(source: Source, sensor: str | None) -> Raw:
    _one_sensor(source, sensor)
    table = read_table(source, ("ns", "acc_x", "acc_y", "acc_z", "quality"), 0)
    time, *acc = (numbers(source, table[name], name, 0) for name in ("ns", "acc_x", "acc_y", "acc_z"))
    # Nanoseconds since some start of the phone; there is no gyroscope beside its accelerometer.
    return Raw(np.full((len(time), 3), np.nan), np.stack(acc, axis=1), (time - time[0]) * 1e-9)


def _array(source: Source, name: str, width: int, transposed: bool = False) -> np.ndarray:
    """A variable of an archive as float64 of N × width."""
    array = np.asarray(source.arrays[name])
    if array.dtype.kind not in "iuf":
        raise source.fail(f"variable '{name}' does not hold real numbers; export the recording again.")
    array = array.reshape(-1, 1) if width == 1 else array.T if transposed else array
    if array.ndim != 2 or array.shape[1] != width or not len(array):
        shape = " × ".join(map(str, np.shape(source.arrays[name])))
        raise source.fail(f"variable '{name}' has the shape {shape}, not N × {width}; export it again.")
    if np.isinf(array).any():
        raise source.fail(f"variable '{name}' holds infinite values; correct them or make them NaN.")
    return array.astype(np.float64)


def _same_length(source: Source, *signals: np.ndarray) -> None:
    lengths = [len(signal) for signal in signals]
    if len({*lengths}) > 1:
        raise source.fail(
            f"the signals have {lengths} samples, not equally many; export the recording again."
        )


def _six_columns(imu: str, time: str) -> Callable[[Source, str | None], Raw]:
    def load(source: Source, sensor: str | None) -> Raw:
        _one_sensor(source, sensor)
        signal, stamps = _array(source, imu, 6), _array(source, time, 1)[:, 0]
        _same_length(source, signal, stamps)
        return Raw(signal[:, 3:], signal[:, :3], stamps, flags=source.arrays)

    return load


def _openshoe(source: Source, sensor: str | None) -> Raw:
    _one_sensor(source, sensor)
    gyr, acc = _array(source, "gyr_rad_s", 3), _array(source, "acc_g", 3)
    _same_length(source, gyr, acc)
    # The host's time stamps come late by milliseconds; the sensor's own counter shows that nothing was lost.
    return Raw(gyr, acc, rate=249.75, acc_unit="g", flags=source.arrays)


def _broad(source: Source, sensor: str | None) -> Raw:
    _one_sensor(source, sensor)
    gyr, acc = _array(source, "imu_gyr", 3), _array(source, "imu_acc", 3)
    _same_length(source, gyr, acc)
    return Raw(gyr, acc, rate=float(_array(source, "sampling_rate", 1)[0, 0]), flags=source.arrays)


def _robot_arm(source: Source, sensor: str | None) -> Raw:
    _one_sensor(source, sensor)
    gyr, acc = _array(source, "SENSgyro", 3, transposed=True), _array(source, "SENSacc", 3, transposed=True)
    time = _array(source, "MATLABtime", 1)[:, 0]
    _same_length(source, gyr, acc, time)
    # Rates are 16-bit numbers with a full scale of 5000 deg/s: what is beyond was damaged on the radio link.
    gyr[np.abs(gyr) > 5000] = np.nan
    # The first row is a placeholder of zeros. The sensor samples at nearly 100 Hz; stamps come in bursts.
    return Raw(gyr[1:], acc[1:], time[1:], rate=100.0, gyr_unit="deg/s", acc_unit="g", flags=source.arrays)


def as_flags(source: Source, column: Any, name: str) -> np.ndarray:
    """A column or variable of zeros and ones as bools; anything else is an `InputError`."""
    words = pd.Series(np.ravel(column)).astype(str).str.strip().str.lower()
    flags = words.map({"1": True, "1.0": True, "true": True, "0": False, "0.0": False, "false": False})
    wrong = np.flatnonzero(flags.isna())
    if len(wrong):
        place = source.row(int(wrong[0]), 1)
        raise source.fail(f"{place}, '{name}' is {words[wrong[0]]}, but flags are 0 or 1; correct the flag.")
    return flags.to_numpy(dtype=bool)


def _has(kind: str, *names: str) -> Callable[[Source], bool]:
    return lambda source: source.kind == kind and set(names) <= set(source.names)


def _is_canonical(source: Source) -> bool:
    return source.kind in ("csv", "parquet") and not set(CHANNELS).isdisjoint(source.names)


def _is_gaitmap(source: Source) -> bool:
    return source.kind == "csv" and (source.names[:1], source.second_line[:1]) == (("sensor",), ("axis",))


def _is_tremor(source: Source) -> bool:
    cells = source.names
    return source.kind == "csv" and len(cells) == 5 and _is_numeric(cells) and cells[0].isdigit()


BY_NAME = {
    "canonical": Format("columns time, gyr_x…gyr_z, acc_x…acc_z", _is_canonical, _canonical),
    "xio": Format("columns Time (s), Gyroscope X (deg/s)…, Accelerometer X (g)…", _has("csv", XIO[0]), _xio),
    "gaitmap": Format("two header lines, 'sensor' and 'axis'", _is_gaitmap, _gaitmap),
    "pyshoe": Format("MAT variables imu, ts", _has("mat", "imu", "ts"), _six_columns("imu", "ts")),
    "ipyshoe": Format(
        "MAT variables imu_data, timestamps",
        _has("mat", "imu_data", "timestamps"),
        _six_columns("imu_data", "timestamps"),
    ),
    "robot_arm": Format(
        "MAT variables SENSgyro, SENSacc, MATLABtime",
        _has("mat", "SENSgyro", "SENSacc", "MATLABtime"),
        _robot_arm,
    ),
    "openshoe": Format("npz arrays gyr_rad_s, acc_g", _has("npz", "gyr_rad_s", "acc_g"), _openshoe),
    "broad": Format(
        "npz arrays imu_gyr, imu_acc, sampling_rate",
        _has("npz", "imu_gyr", "imu_acc", "sampling_rate"),
        _broad,
    ),
    "tremor": Format("five columns without names: ns, acc x, y, z, quality", _is_tremor, _tremor),
}
