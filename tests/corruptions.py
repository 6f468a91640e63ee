"""One healthy recording of a foot-like motion, and many ways to spoil it that must each be told in one sentence."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd
import scipy.io

from jaxsat.signals.recording import CHANNELS

RATE = 200.0
G = 9.80665


def healthy() -> pd.DataFrame:
    """Eight seconds at 200 Hz: five strides of 0.7 s between rests, pitching by 70 deg and back, with noise."""
    t = np.arange(1600) / RATE
    pitch, speed, lift = np.zeros(1600), np.zeros(1600), np.zeros(1600)
    for start in 1.0 + 1.3 * np.arange(5):
        phase = np.clip((t - start) / 0.7, 0, 1)
        pitch += 1.2 * np.sin(2 * np.pi * phase) * np.sin(np.pi * phase) ** 2
        speed += 3.6 * np.sin(np.pi * phase) ** 4
        lift += 0.08 * np.sin(np.pi * phase) ** 4
    forward = np.gradient(speed, t)
    upward = np.gradient(np.gradient(lift, t), t) + G
    # A rotation about y by the pitch: x_b = cos·x_n − sin·z_n, z_b = sin·x_n + cos·z_n.
    cos, sin, zero = np.cos(pitch), np.sin(pitch), np.zeros_like(t)
    exact = [
        zero,
        np.gradient(pitch, t),
        zero,
        cos * forward - sin * upward,
        zero,
        sin * forward + cos * upward,
    ]
    rng = np.random.default_rng(20140506)
    noise = rng.normal(size=(6, 1600)) * np.array([[0.005]] * 3 + [[0.05]] * 3)
    return pd.DataFrame(dict(zip(("time", *CHANNELS), [t, *(exact + noise)], strict=True)))


def write_gaitmap(path: Path, table: pd.DataFrame) -> None:
    """Two sensors, deg/s, in the two-header layout."""
    rows = [["sensor", *["left"] * 6, *["right"] * 6], ["axis", *CHANNELS * 2]]
    values = table[[*CHANNELS]].to_numpy() * np.array([180 / np.pi] * 3 + [1] * 3)
    rows += [[k, *row, *row] for k, row in enumerate(values)]
    path.write_text("\n".join(",".join(map(str, row)) for row in rows) + "\n")


Spoil = Callable[[Path], tuple[Path, list[str]]]
CORRUPTIONS: dict[str, Spoil] = {}
"""Name of the fault → a function that writes it into a folder and returns the path and extra arguments."""


def _file(name: str, content: bytes | None, *args: str) -> None:
    def spoil(folder: Path) -> tuple[Path, list[str]]:
        path = folder / name
        if content is not None:
            path.write_bytes(content)
        return path, [*args]

    CORRUPTIONS[Path(name).stem] = spoil


def _table(*args: str) -> Callable[[Callable[[pd.DataFrame], pd.DataFrame]], None]:
    """A spoilt table, written as CSV under the name of the function."""

    def register(change: Callable[[pd.DataFrame], pd.DataFrame]) -> None:
        def spoil(folder: Path) -> tuple[Path, list[str]]:
            path = folder / f"{change.__name__}.csv"
            change(healthy()).to_csv(path, index=False)
            return path, [*args]

        CORRUPTIONS[change.__name__] = spoil

    return register


def _text(change: Callable[[str], str | bytes]) -> None:
    """The text of the healthy CSV, spoilt."""

    def spoil(folder: Path) -> tuple[Path, list[str]]:
        path = folder / f"{change.__name__}.csv"
        text = change(healthy().to_csv(index=False))
        path.write_bytes(text if isinstance(text, bytes) else text.encode())
        return path, []

    CORRUPTIONS[change.__name__] = spoil


def _other(change: Callable[[Path], tuple[Path, list[str]]]) -> None:
    CORRUPTIONS[change.__name__] = change


# Files that are no recordings.
_file("absent.csv", None)
_file("empty.csv", b"")
_file("picture.csv", b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR" + bytes(100))
_file("damaged_parquet.parquet", b"PAR1" + bytes(200))
_file("damaged_mat.mat", b"MATLAB 5.0 MAT-file, cut short")
_file("damaged_npz.npz", b"PK\x03\x04" + bytes(50))
_file("matlab_hdf5.mat", b"\x89HDF\r\n\x1a\n" + bytes(100))
_file("only_header.csv", b"time,gyr_x,gyr_y,gyr_z,acc_x,acc_y,acc_z\n")
_file(
    "header_and_two_rows.csv",
    b"time,gyr_x,gyr_y,gyr_z,acc_x,acc_y,acc_z\n0,0,0,0,0,0,9.8\n0.01,0,0,0,0,0,9.8\n",
)


@_other
def a_folder(folder: Path) -> tuple[Path, list[str]]:
    return folder, []


@_other
def unknown_archive(folder: Path) -> tuple[Path, list[str]]:
    np.savez(folder / "unknown_archive.npz", omega=np.zeros((9, 3)))
    return folder / "unknown_archive.npz", []


@_other
def wrong_shape(folder: Path) -> tuple[Path, list[str]]:
    scipy.io.savemat(folder / "wrong_shape.mat", {"imu": np.zeros((9, 5)), "ts": np.arange(9.0)})
    return folder / "wrong_shape.mat", []


@_other
def unequal_lengths(folder: Path) -> tuple[Path, list[str]]:
    scipy.io.savemat(folder / "unequal_lengths.mat", {"imu": np.zeros((9, 6)), "ts": np.arange(8.0)})
    return folder / "unequal_lengths.mat", []


@_other
def text_in_archive(folder: Path) -> tuple[Path, list[str]]:
    np.savez(folder / "text_in_archive.npz", gyr_rad_s=np.full((9, 3), "x"), acc_g=np.zeros((9, 3)))
    return folder / "text_in_archive.npz", []


@_other
def two_sensors_none_named(folder: Path) -> tuple[Path, list[str]]:
    write_gaitmap(folder / "two_sensors_none_named.csv", healthy())
    return folder / "two_sensors_none_named.csv", []


@_other
def sensor_misspelt(folder: Path) -> tuple[Path, list[str]]:
    write_gaitmap(folder / "sensor_misspelt.csv", healthy())
    return folder / "sensor_misspelt.csv", ["--sensor", "letf"]


# Tables whose form is wrong.
@_text
def no_header(text: str) -> str:
    return text.split("\n", 1)[1]


@_text
def semicolons(text: str) -> str:
    return text.replace(",", ";")


@_text
def ragged_line(text: str) -> str:
    lines = text.split("\n")
    lines[300] += ",1.0,2.0"
    return "\n".join(lines)


@_text
def every_line_too_long(text: str) -> str:
    first, *rest = text.split("\n")
    return "\n".join([first, *(line + ",1.0" for line in rest if line)])


@_text
def not_utf8(text: str) -> bytes:
    return text.encode().replace(b"\n0.5,", b"\n\xff0.5,", 1)


@_text
def text_in_cell(text: str) -> str:
    return text.replace("\n1.0,", "\n1.0,overrun", 1)


@_text
def infinite_cell(text: str) -> str:
    return text.replace("\n1.0,", "\n1.0,inf,0,0,0,0,9.8\n1.0001,", 1)


@_text
def repeated_column(text: str) -> str:
    return text.replace("gyr_y", "gyr_x", 1)


@_table()
def unknown_columns(table: pd.DataFrame) -> pd.DataFrame:
    return table.set_axis(["t", "wx", "wy", "wz", "fx", "fy", "fz"], axis=1)


@_table()
def missing_column(table: pd.DataFrame) -> pd.DataFrame:
    return table.drop(columns="acc_y")


@_table()
def misspelt_column(table: pd.DataFrame) -> pd.DataFrame:
    return table.rename(columns={"gyr_z": "gyro_z"})


@_table()
def no_time_no_rate(table: pd.DataFrame) -> pd.DataFrame:
    return table.drop(columns="time")


@_table("--format", "xio")
def wrong_format(table: pd.DataFrame) -> pd.DataFrame:
    return table


@_table("--sensor", "left")
def sensor_of_a_plain_file(table: pd.DataFrame) -> pd.DataFrame:
    return table


@_table("--rests", "stance")
def absent_rest_column(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(stand=0)


@_table()
def rest_not_a_flag(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(rest=np.arange(len(table)) % 3)


# Time that cannot be.
@_table()
def time_jumps_back(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(time=table.time - (table.time > 4) * 2)


@_table()
def time_stands_still(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(time=table.time.round(2))


@_table()
def time_empty(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(time=table.time.where(table.index != 700))


@_table()
def time_jumps_ahead(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(time=table.time + (table.time > 4) * 3600)


@_table()
def time_in_milliseconds(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(time=table.time * 1000)


@_table("--rate", "100")
def rate_against_time(table: pd.DataFrame) -> pd.DataFrame:
    return table


@_table("--rate", "-200")
def negative_rate(table: pd.DataFrame) -> pd.DataFrame:
    return table


@_table("--rate", "100")
def wrong_rate_without_time(table: pd.DataFrame) -> pd.DataFrame:
    return table.drop(columns="time")


# Values that cannot be.
GYR, ACC = [*CHANNELS[:3]], [*CHANNELS[3:]]


@_table()
def acc_in_g(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(**table[ACC] / G)


@_table("--acc-unit", "g")
def acc_not_in_g(table: pd.DataFrame) -> pd.DataFrame:
    return table


@_table()
def gyr_in_degrees(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(**np.rad2deg(table[GYR]))


@_table("--gyr-unit", "deg/s")
def gyr_not_in_degrees(table: pd.DataFrame) -> pd.DataFrame:
    return table


@_table()
def swapped_sensors(table: pd.DataFrame) -> pd.DataFrame:
    return table.rename(columns=dict(zip(GYR + ACC, ACC + GYR, strict=True)))


@_table()
def gravity_removed(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(acc_z=table.acc_z - G)


@_table()
def badly_scaled(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(**table[ACC] * 1.5)


@_table()
def too_short(table: pd.DataFrame) -> pd.DataFrame:
    return table[table.time < 0.4]


@_table()
def stuck_channel(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(gyr_x=0.0)


@_table()
def integer_overflow(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(gyr_y=(table.gyr_y + 4.0) % 8.0 - 4.0)


@_table()
def channel_missing(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(gyr_z=np.nan)


@_table()
def mostly_missing(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(acc_x=table.acc_x.where(table.index % 3 == 0))


@_table()
def missing_at_the_start(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(gyr_x=table.gyr_x.where(table.index > 4))
