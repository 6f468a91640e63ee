"""`jaxsat inspect` and `jaxsat estimate`: one recording."""

import json
from typing import Annotated

import typer

from jaxsat.cli.shared import (
    AccRail,
    AccUnit,
    ConfigPath,
    Csv,
    Format,
    GyrRail,
    GyrUnit,
    NegateAcc,
    Out,
    Quiet,
    Rate,
    RecordingPath,
    RestColumn,
    SensorName,
    Strict,
    progress_bar,
    rail_overrides,
    read_recording,
    tell,
    use_compilation_cache,
)


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


def estimate_command(
    recording: RecordingPath,
    out: Out,
    method: Annotated[
        str | None,
        typer.Option(help="standard, direct, triangle, quadratic or map (default: map)", metavar="NAME"),
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
        typer.Option(
            help="height of rests: one where the recording agrees (auto), free (off), zero or nonnegative",
            metavar="MODE",
        ),
    ] = None,
    csv: Csv = False,
    quiet: Quiet = False,
    strict: Strict = False,
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
    tell(estimate_text(found, report), warnings_of(found), quiet, strict)
