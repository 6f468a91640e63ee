"""The command line: parse, call one function, write. Everything heavy is imported inside the commands."""

import contextlib
import json
import os
import sys
import time
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxsat.errors import InputError

# What typer raises for wrong arguments; where it lives changed between versions.
_UsageError: type[Exception] = typer.BadParameter.__bases__[0]

app = typer.Typer(
    name="jaxsat",
    help="Trajectories from inertial recordings that saturated.",
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
)

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
_CLIP = "limit to clip at: none or a magnitude as for estimate; repeatable"
Rails = Annotated[list[str] | None, typer.Option(help=_CLIP, metavar="VALUE")]
RestColumn = Annotated[
    str | None,
    typer.Option(help="auto detects rests; a name takes them from that column (default: rest, if present)"),
]
SensorName = Annotated[
    str | None, typer.Option(help="which sensor, where a file holds several", metavar="NAME")
]
NegateAcc = Annotated[bool, typer.Option("--negate-acc", help="the sensor reports minus the specific force")]
ConfigPath = Annotated[Path | None, typer.Option(help="TOML file with settings; options override it")]


@app.callback(invoke_without_command=True)
def root(version: Annotated[bool, typer.Option("--version", help="print the version")] = False) -> None:
    if version:
        import jaxsat

        typer.echo(f"jaxsat {jaxsat.__version__}")


@app.command("inspect")
def inspect_command(
    recording: RecordingPath,
    config: ConfigPath = None,
    format: Format = "auto",
    rate: Rate = None,
    gyr_unit: GyrUnit = None,
    acc_unit: AccUnit = None,
    gyr_rail: GyrRail = None,
    acc_rail: AccRail = None,
    rests: RestColumn = None,
    sensor: SensorName = None,
    negate_acc: NegateAcc = False,
    as_json: Annotated[bool, typer.Option("--json", help="for machines")] = False,
) -> None:
    """Show what a recording holds: sampling, units, rests, rails and gaps."""
    from jaxsat.config import load_config
    from jaxsat.present.summary import inspect
    from jaxsat.present.text import inspection_text

    measured = _read(recording, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc)
    settings = load_config(config, **_rails(gyr_rail, acc_rail, gyr_unit, acc_unit))
    found = inspect(measured, settings)
    typer.echo(json.dumps(found, indent=2, allow_nan=False) if as_json else inspection_text(found))


@app.command("estimate")
def estimate_command(
    recording: RecordingPath,
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the results", metavar="DIR")],
    method: Annotated[
        str | None,
        typer.Option(help="standard, direct, triangle or quadratic (default: direct)", metavar="NAME"),
    ] = None,
    config: ConfigPath = None,
    format: Format = "auto",
    rate: Rate = None,
    gyr_unit: GyrUnit = None,
    acc_unit: AccUnit = None,
    gyr_rail: GyrRail = None,
    acc_rail: AccRail = None,
    rests: RestColumn = None,
    sensor: SensorName = None,
    negate_acc: NegateAcc = False,
    segments: Annotated[str | None, typer.Option(help="parallel or sequential", metavar="ORDER")] = None,
    height: Annotated[
        str | None,
        typer.Option(help="what is known of the height of rests: off, zero or nonnegative", metavar="MODE"),
    ] = None,
    csv: Annotated[bool, typer.Option("--csv", help="write CSV instead of Parquet")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="print nothing unless something is wrong")] = False,
    strict: Annotated[bool, typer.Option("--strict", help="exit with code 3 if there are warnings")] = False,
) -> None:
    """Reconstruct the trajectory of a recording and write it, with a report, to a folder."""
    from jaxsat.config import load_config
    from jaxsat.present.folder import check_folder, write_results
    from jaxsat.present.summary import warnings_of
    from jaxsat.present.text import estimate_text

    check_folder(out)
    measured = _read(recording, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc)
    given = {"method": method, "saturation.segments": segments, "height.mode": height}
    given = {key: value for key, value in given.items() if value is not None}
    settings = load_config(config, **given, **_rails(gyr_rail, acc_rail, gyr_unit, acc_unit))
    _use_compilation_cache()
    from jaxsat.pipeline import estimate

    with _progress(quiet) as progress:
        found = estimate(measured, settings, progress=progress)
        beside = {}
        if settings.method != "standard" and len(found.gaps):
            beside["standard"] = (measured.time, found.standard_position)
        report = write_results(found, out, csv=csv, source=recording, beside=beside)
    warnings = warnings_of(found)
    if not quiet:
        typer.echo(estimate_text(found, report))
        for warning in warnings:
            typer.echo(f"jaxsat: warning: {warning}", err=True)
    if strict and warnings:
        raise typer.Exit(3)


@app.command("sweep")
def sweep_command(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="RECORDING...", help="files with recordings, one trial each")
    ],
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the results", metavar="DIR")],
    gyr_rail: Rails = None,
    acc_rail: Rails = None,
    gyr_bound: Annotated[
        list[float] | None,
        typer.Option(help="most that a rate exceeds its rail, rad/s; repeatable", metavar="VALUE"),
    ] = None,
    acc_bound: Annotated[
        list[float] | None,
        typer.Option(help="the same for specific force, m/s²; repeatable", metavar="VALUE"),
    ] = None,
    method: Annotated[
        list[str] | None,
        typer.Option(
            help="standard, direct, triangle or quadratic; repeatable (default: standard and direct)",
            metavar="NAME",
        ),
    ] = None,
    memory: Annotated[float, typer.Option(help="what the arrays of a call may take", metavar="GB")] = 2.0,
    config: ConfigPath = None,
    format: Format = "auto",
    rate: Rate = None,
    gyr_unit: GyrUnit = None,
    acc_unit: AccUnit = None,
    rests: RestColumn = None,
    sensor: SensorName = None,
    negate_acc: NegateAcc = False,
    csv: Annotated[bool, typer.Option("--csv", help="write CSV instead of Parquet")] = False,
    quiet: Annotated[bool, typer.Option("--quiet", help="print nothing unless something is wrong")] = False,
) -> None:
    """Clip recordings at many rails in software, reconstruct them, and tabulate how far off each is."""
    from jaxsat.config import load_config
    from jaxsat.present.folder import SWEEP_FILES, check_folder, write_sweep
    from jaxsat.present.summary import summarise_sweep
    from jaxsat.present.text import sweep_text

    check_folder(out, SWEEP_FILES)
    settings = load_config(config)
    swept = {
        "methods": method or ["standard", "direct"],
        "gyr_rails": _swept_rails("gyr", gyr_rail, gyr_unit, acc_unit),
        "acc_rails": _swept_rails("acc", acc_rail, gyr_unit, acc_unit),
        "gyr_bounds": gyr_bound or [settings.saturation.gyr_bound],
        "acc_bounds": acc_bound or [settings.saturation.acc_bound],
    }
    _use_compilation_cache()
    from jaxsat.studies.sweep import sweep_files

    def read(path: Path):
        return _read(path, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc)

    started = time.perf_counter()
    with _progress(quiet) as progress:
        table = sweep_files(recordings, settings, read=read, memory=memory * 1e9, progress=progress, **swept)
    summary = summarise_sweep(table, settings, swept, recordings, time.perf_counter() - started)
    path = write_sweep(table, summary, out, csv=csv)
    if not quiet:
        typer.echo(sweep_text(table, path))


@app.command("simulate")
def simulate_command(
    motion: Annotated[str, typer.Argument(metavar="MOTION", help="bar, line, planar or walk")],
    out: Annotated[Path, typer.Option("--out", "-o", help="FILE.csv or FILE.parquet", metavar="FILE")],
    rate: Annotated[float, typer.Option(help="sampling rate", metavar="HZ")] = 100.0,
    duration: Annotated[
        float | None,
        typer.Option(
            help="default: that of the motion and its rests; a walk fills it with strides", metavar="S"
        ),
    ] = None,
    gyr_rail: Annotated[float, typer.Option(help="gyroscope limit, rad/s", metavar="VALUE")] = float("inf"),
    acc_rail: Annotated[float, typer.Option(help="accelerometer limit, m/s²", metavar="VALUE")] = float(
        "inf"
    ),
    smear: Annotated[
        float,
        typer.Option(help="size of the calibration after clipping, which smears the rails (0.02: 2 %)"),
    ] = 0.0,
    seed: Annotated[int, typer.Option(help="of the sensor's noise and calibration")] = 0,
    rest: Annotated[bool, typer.Option("--rest", help="write the true rests into the recording")] = False,
) -> None:
    """Simulate a recording of a known motion; its truth is written beside it."""
    import jax

    from jaxsat.studies.simulate import Sensor, simulate, write_simulation

    _use_compilation_cache()
    moves = _motion(motion, duration)
    keys = jax.random.split(jax.random.key(seed), 3)
    sensor = Sensor(
        gyr_rail=gyr_rail,
        acc_rail=acc_rail,
        gyr_calibration=_calibration(smear, keys[1]),
        acc_calibration=_calibration(smear, keys[2]),
    )
    # As long a rest after the motion as before it.
    start, end = moves.moving[0, 0], moves.moving[-1, 1]
    duration = float(end + start) if duration is None else duration
    recording, truth = simulate(moves, rate=rate, duration=duration, sensor=sensor, key=keys[0])
    truth_path = write_simulation(out, recording, truth, rest=rest)
    saturated = int(truth.saturated.sum())
    typer.echo(f"{out}: {len(recording)} samples, {saturated} saturated values; truth: {truth_path}")


@app.command("demo")
def demo_command(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the results", metavar="DIR")] = Path(
        "jaxsat-demo"
    ),
) -> None:
    """Clip a real walk as a ±300 °/s sensor would have, reconstruct it, and score it by motion capture."""
    _use_compilation_cache()
    from jaxsat.demo import run_demo

    with _progress(False) as progress:
        text = run_demo(out, progress)
    typer.echo(text)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run the command line; returns its exit code. Bad arguments and input become one line on stderr."""
    try:
        given = sys.argv[1:] if arguments is None else arguments
        return app(args=list(given) or ["--help"], standalone_mode=False) or 0
    except InputError as error:
        message = str(error)
    except _UsageError as error:
        message = f"{error.format_message()} (see jaxsat --help)"  # type: ignore[attr-defined]
    except typer.Abort:
        return 130
    print("jaxsat:", " ".join(message.split()), file=sys.stderr)
    return 2


def _read(path, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc):
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


def _rails(gyr: str | None, acc: str | None, gyr_unit: str | None, acc_unit: str | None) -> dict[str, Any]:
    """Overrides of the configuration; a magnitude is in the unit that was declared for the file."""
    scale = _scales(gyr_unit, acc_unit)
    overrides = {}
    for name, text in (("gyr", gyr), ("acc", acc)):
        if text in ("auto", "none"):
            overrides[f"rails.{name}"] = text
        elif text is not None:
            overrides[f"rails.{name}"] = _limit(name, text, "auto, none") * scale[name]
    return overrides


def _swept_rails(
    name: str, texts: list[str] | None, gyr_unit: str | None, acc_unit: str | None
) -> list[float]:
    """Limits in SI units; infinite where the sensor is left as it is."""
    scale = _scales(gyr_unit, acc_unit)[name]
    return [
        float("inf") if text == "none" else _limit(name, text, "none") * scale for text in texts or ["none"]
    ]


def _scales(gyr_unit: str | None, acc_unit: str | None) -> dict[str, float]:
    """What a limit is multiplied with to be in SI units; readers complain of unknown units, with the file."""
    from jaxsat.signals.formats import ANGULAR_RATE, SPECIFIC_FORCE

    return {
        "gyr": ANGULAR_RATE.get(gyr_unit or "rad/s", 1.0),
        "acc": SPECIFIC_FORCE.get(acc_unit or "m/s^2", 1.0),
    }


def _limit(name: str, text: str, words: str) -> float:
    try:
        return float(text)
    except ValueError:
        raise InputError(f"--{name}-rail '{text}' is no limit; give {words} or a number.") from None


def _motion(name: str, duration: float | None):
    from jaxsat.studies.motions import MOTIONS, Walk

    if name not in MOTIONS:
        raise InputError(f"motion '{name}' is not known; choose one of {', '.join(MOTIONS)}.")
    if MOTIONS[name] is not Walk or duration is None:
        return MOTIONS[name]()
    if not 0 < duration < float("inf"):
        raise InputError(f"a walk of {duration} s cannot be; give --duration a positive number.")
    walk = Walk()
    return Walk(strides=max(1, int((duration - walk.start) / (walk.swing + walk.stance))))


def _calibration(size: float, key):
    """Scale and misalignment, each up to `size` either way."""
    import jax
    import numpy as np

    from jaxsat.studies.simulate import Calibration

    return Calibration(matrix=np.eye(3) + size * np.asarray(jax.random.uniform(key, (3, 3), minval=-1.0)))


def _use_compilation_cache() -> None:
    """Compiled programs are kept between runs, in the user's cache unless JAX was told another place."""
    import jax

    if jax.config.jax_compilation_cache_dir is None:  # type: ignore[attr-defined]
        base = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache")
        jax.config.update("jax_compilation_cache_dir", str(base / "jaxsat"))
        jax.config.update("jax_persistent_cache_min_compile_time_secs", 0.3)


@contextlib.contextmanager
def _progress(quiet: bool) -> Iterator[Any]:
    """A progress bar on stderr for people who watch; None otherwise."""
    if quiet or not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.progress import Progress

    with Progress(console=Console(stderr=True), transient=True) as bar:
        task = bar.add_task("estimating", total=None)
        yield lambda stage, done, total: bar.update(task, description=stage, completed=done, total=total)
