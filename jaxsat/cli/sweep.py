"""`jaxsat sweep`: many recordings at many rails."""

import time
from pathlib import Path
from typing import Annotated

import typer

from jaxsat.cli.shared import (
    AccUnit,
    ConfigPath,
    Csv,
    Format,
    GyrUnit,
    NegateAcc,
    Out,
    Quiet,
    Rate,
    RestColumn,
    SensorName,
    limit,
    progress_bar,
    read_recording,
    scales,
    use_compilation_cache,
)
from jaxsat.errors import InputError

_CLIP = "limit to clip at: none or a magnitude as for estimate; repeatable"
Rails = Annotated[list[str] | None, typer.Option(help=_CLIP, metavar="VALUE")]


def sweep_command(
    recordings: Annotated[
        list[Path], typer.Argument(metavar="RECORDING...", help="files with recordings, one trial each")
    ],
    out: Out,
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
            help="standard, direct, triangle, quadratic or map; repeatable (default: standard, direct)",
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
    csv: Csv = False,
    quiet: Quiet = False,
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
    use_compilation_cache()
    from jaxsat.studies.sweep import sweep

    def loader(path: Path):
        return lambda: read_recording(path, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc)

    loaders = {str(path): loader(path) for path in recordings}
    if len(loaders) < len(recordings):
        twice = next(str(path) for i, path in enumerate(recordings) if path in recordings[:i])
        raise InputError(f"{twice} is given twice; give each recording once.")
    started = time.perf_counter()
    with progress_bar(quiet) as progress:
        table = sweep(loaders, settings, memory=memory * 1e9, progress=progress, **swept)
    _check_used(table)
    summary = summarise_sweep(table, settings, swept, recordings, time.perf_counter() - started)
    path = write_sweep(table, summary, out, csv=csv)
    if not quiet:
        typer.echo(sweep_text(table, path))


def _check_used(table) -> None:
    """A table without any result is an error: nothing is written."""
    if set(table["status"]) == {"failed"}:
        more = f" (and {len(table) - 1} more recordings that cannot be used)" if len(table) > 1 else ""
        raise InputError(f"{table['note'].iloc[0]}{more}")


def _swept_rails(
    name: str, texts: list[str] | None, gyr_unit: str | None, acc_unit: str | None
) -> list[float]:
    """Limits in SI units; infinite where the sensor is left as it is."""
    scale = scales(gyr_unit, acc_unit)[name]
    return [
        float("inf") if text == "none" else limit(name, text, "none") * scale for text in texts or ["none"]
    ]
