"""`jaxsat inspect` and `jaxsat estimate`: one recording."""

import json
from pathlib import Path
from typing import Annotated, Any

import typer

from jaxsat.cli.shared import (
    AccRail,
    AccUnit,
    ConfigPath,
    Format,
    GyrRail,
    GyrUnit,
    NegateAcc,
    Rate,
    RecordingPath,
    RestColumn,
    SensorName,
    app,
    limit,
    progress_bar,
    read_recording,
    scales,
    use_compilation_cache,
)


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

    measured = read_recording(recording, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc)
    settings = load_config(config, **rail_overrides(gyr_rail, acc_rail, gyr_unit, acc_unit))
    found = inspect(measured, settings)
    typer.echo(json.dumps(found, indent=2, allow_nan=False) if as_json else inspection_text(found))


@app.command("estimate")
def estimate_command(
    recording: RecordingPath,
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the results", metavar="DIR")],
    method: Annotated[
        str | None,
        typer.Option(help="standard, direct, triangle, quadratic or map (default: direct)", metavar="NAME"),
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
    measured = read_recording(recording, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc)
    given = {"method": method, "saturation.segments": segments, "height.mode": height}
    given = {key: value for key, value in given.items() if value is not None}
    settings = load_config(config, **given, **rail_overrides(gyr_rail, acc_rail, gyr_unit, acc_unit))
    use_compilation_cache()
    from jaxsat.pipeline import estimate

    with progress_bar(quiet) as progress:
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
