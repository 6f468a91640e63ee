"""`jaxsat periodic`: position and angle of periodic motion."""

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
    SensorName,
    Strict,
    rail_overrides,
    read_recording,
    tell,
    use_compilation_cache,
)


def periodic_command(
    recording: RecordingPath,
    out: Out,
    method: Annotated[
        str | None,
        typer.Option(help="least_squares, recursive, bmflc or wflc (default: least_squares)", metavar="NAME"),
    ] = None,
    band: Annotated[
        tuple[float, float] | None,
        typer.Option(
            help="lowest and highest frequency of the motion, Hz (default: found in the recording)",
            metavar="LOW HIGH",
        ),
    ] = None,
    sensor_lowpass: Annotated[
        float | None,
        typer.Option(help="cut-off of the first-order filter in the sensor, Hz", metavar="HZ"),
    ] = None,
    highpass: Annotated[
        float | None,
        typer.Option(help="cut-off before bmflc and wflc, Hz (default: half of LOW)", metavar="HZ"),
    ] = None,
    config: ConfigPath = None,
    format: Format = "auto",
    rate: Rate = None,
    gyr_unit: GyrUnit = None,
    acc_unit: AccUnit = None,
    gyr_rail: GyrRail = None,
    acc_rail: AccRail = None,
    sensor: SensorName = None,
    negate_acc: NegateAcc = False,
    csv: Csv = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Position and angle of periodic motion, without drift, rests or attitude."""
    from jaxsat.config import load_config
    from jaxsat.present.folder import PERIODIC_FILES, check_folder, write_periodic
    from jaxsat.present.periodic import periodic_text

    check_folder(out, PERIODIC_FILES)
    given = {"method": method, "band": band, "sensor_lowpass": sensor_lowpass, "highpass": highpass}
    given = {f"periodic.{key}": value for key, value in given.items() if value is not None}
    settings = load_config(config, **given, **rail_overrides(gyr_rail, acc_rail, gyr_unit, acc_unit))
    measured = read_recording(recording, format, rate, gyr_unit, acc_unit, None, sensor, negate_acc)
    use_compilation_cache()
    from jaxsat.periodic import estimate_periodic

    found = estimate_periodic(measured, settings)
    path = write_periodic(found, out, csv=csv, source=recording)
    tell(periodic_text(found, path), found.warnings, quiet, strict)
