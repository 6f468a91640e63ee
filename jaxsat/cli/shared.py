"""What the commands share: the application, options, and how recordings, limits and progress are handled."""

import contextlib
import os
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxsat.errors import InputError

RecordingPath = Annotated[Path, typer.Argument(metavar="RECORDING", help="file with the recording")]
Format = Annotated[
    str, typer.Option(help="format of the recording; auto looks at its content", metavar="NAME")
]
Rate = Annotated[float | None, typer.Option(help="sampling rate, for files without time", metavar="HZ")]
GyrUnit = Annotated[
    str | None, typer.Option(help="rad/s or deg/s; default: that of the format", metavar="UNIT")
]
AccUnit = Annotated[str | None, typer.Option(help="m/s^2 or g; default: that of the format", metavar="UNIT")]
GyrRail = Annotated[
    str | None,
    typer.Option(help="limit: auto, none or a magnitude in --gyr-unit (rad/s if not given)", metavar="VALUE"),
]
AccRail = Annotated[
    str | None,
    typer.Option(help="limit: auto, none or a magnitude in --acc-unit (m/s^2 if not given)", metavar="VALUE"),
]
RestColumn = Annotated[
    str | None,
    typer.Option(help="auto detects rests; a name takes them from that column (default: rest, if present)"),
]
SensorName = Annotated[
    str | None, typer.Option(help="which sensor, where a file holds several", metavar="NAME")
]
NegateAcc = Annotated[bool, typer.Option("--negate-acc", help="the sensor reports minus the specific force")]
ConfigPath = Annotated[Path | None, typer.Option(help="TOML file with settings; options override it")]

Out = Annotated[Path, typer.Option("--out", "-o", help="folder for the results", metavar="DIR")]
Csv = Annotated[bool, typer.Option("--csv", help="write CSV instead of Parquet")]
Quiet = Annotated[bool, typer.Option("--quiet", help="print nothing unless something is wrong")]
Strict = Annotated[bool, typer.Option("--strict", help="exit with code 3 if there are warnings")]


def read_recording(path, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc):
    import equinox as eqx

    from jaxsat.signals.readers import read

    recording = read(
        path,
        format=format,
        rate=rate,
        gyr_unit=gyr_unit,
        acc_unit=acc_unit,
        rest_column=None if rests == "auto" else rests,
        sensor=sensor,
        negate_acc=negate_acc,
    )
    # Asked for explicitly, detection goes before a column of the file.
    if rests == "auto" and recording.rest is not None:
        recording = eqx.tree_at(lambda r: r.rest, recording, None)
    return recording


def scales(gyr_unit: str | None, acc_unit: str | None) -> dict[str, float]:
    """What a limit is multiplied with to be in SI units; readers complain of unknown units, with the file."""
    from jaxsat.signals.formats import ANGULAR_RATE, SPECIFIC_FORCE

    return {
        "gyr": ANGULAR_RATE.get(gyr_unit or "rad/s", 1.0),
        "acc": SPECIFIC_FORCE.get(acc_unit or "m/s^2", 1.0),
    }


def rail_overrides(
    gyr: str | None, acc: str | None, gyr_unit: str | None, acc_unit: str | None
) -> dict[str, Any]:
    """Overrides of the configuration; a magnitude is in the unit that was declared for the file."""
    scale = scales(gyr_unit, acc_unit)
    overrides = {}
    for name, text in (("gyr", gyr), ("acc", acc)):
        if text in ("auto", "none"):
            overrides[f"rails.{name}"] = text
        elif text is not None:
            overrides[f"rails.{name}"] = limit(name, text, "auto, none") * scale[name]
    return overrides


def limit(name: str, text: str, words: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--{name}-rail '{text}' is no limit; give {words} or a number.") from None


def use_compilation_cache() -> None:
    """Programs and their traces are kept between runs, in the user's cache unless JAX was told another place."""
    import jax

    from jaxsat.inertial.programs import keep_traces

    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(base / "jaxsat"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.0)
    keep_traces(Path(jax.config.jax_compilation_cache_dir) / "traces")  # type: ignore[attr-defined]


def tell(text: str, warnings: list[str], quiet: bool, strict: bool) -> None:
    """The last words of a command that worked: its text, its warnings, and exit code 3 if these count."""
    if not quiet:
        typer.echo(text)
        for warning in warnings:
            typer.echo(f"jaxsat: warning: {warning}", err=True)
    if strict and warnings:
        raise typer.Exit(3)


@contextlib.contextmanager
def progress_bar(quiet: bool) -> Iterator[Any]:
    """A progress bar on stderr for people who watch; None otherwise."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("estimating", total=None)
        yield lambda stage, done, total: bar.update(task, description=stage, completed=done, total=total)
