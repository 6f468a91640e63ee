"""`jaxsat orientation`: attitude alone."""

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


def orientation_command(
    recording: RecordingPath,
    out: Out,
    estimate: Annotated[
        str | None,
        typer.Option(help="gyro, accel, gyro_accel, pi or smoothed (default: smoothed)", metavar="NAME"),
    ] = None,
    update: Annotated[
        str | None, typer.Option(help="exact, comp or imp (default: exact)", metavar="NAME")
    ] = None,
    kp: Annotated[float | None, typer.Option(help="proportional gain, 1/s", metavar="VALUE")] = None,
    ki: Annotated[float | None, typer.Option(help="integral gain, 1/s²", metavar="VALUE")] = None,
    tau: Annotated[
        float | None, typer.Option(help="low-pass on the specific force; 0 for none", metavar="S")
    ] = None,
    gate: Annotated[
        str | None,
        typer.Option(help="how far |a| may be from g, m/s², or none (default: none)", metavar="VALUE"),
    ] = None,
    good_gain: Annotated[
        bool, typer.Option("--good-gain", help="take kp and ki from a step response of the recording")
    ] = False,
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
    """Estimate the attitude of a recording from gyroscope and accelerometer, and write it to a folder."""
    from jaxsat.config import load_config
    from jaxsat.present.folder import ORIENTATION_FILES, check_folder, write_orientation
    from jaxsat.present.text import orientation_text

    check_folder(out, ORIENTATION_FILES)
    measured = read_recording(recording, format, rate, gyr_unit, acc_unit, None, sensor, negate_acc)
    given = {
        "estimate": estimate,
        "update": update,
        "kp": kp,
        "ki": ki,
        "tau": tau,
        "gate": gate,
        "gains": "good_gain" if good_gain else None,
    }
    given = {f"orientation.{key}": value for key, value in given.items() if value is not None}
    settings = load_config(config, **given, **rail_overrides(gyr_rail, acc_rail, gyr_unit, acc_unit))
    use_compilation_cache()
    from jaxsat.attitude import orient

    found = orient(measured, settings)
    path = write_orientation(found, out, csv=csv, source=recording)
    tell(orientation_text(found, path), found.warnings, quiet, strict)
