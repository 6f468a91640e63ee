"""`jaxsat tune`: noise of the standard smoother, learned from recordings."""

import os
import tomllib
from pathlib import Path
from typing import Annotated

import typer

from jaxsat.cli.shared import (
    AccUnit,
    ConfigPath,
    Format,
    GyrUnit,
    NegateAcc,
    Quiet,
    Rate,
    RestColumn,
    SensorName,
    Strict,
    progress_bar,
    read_recording,
    tell,
    use_compilation_cache,
)
from jaxsat.errors import InputError


def tune_command(
    out: Annotated[Path, typer.Option("--out", "-o", help="FILE.toml for --config", metavar="FILE")],
    recordings: Annotated[
        list[Path] | None, typer.Argument(metavar="[RECORDING...]", help="files to learn from")
    ] = None,
    split: Annotated[
        tuple[Path, str] | None,
        typer.Option(
            help="learn from the files that a TOML file lists under a name, as it lies in their folder",
            metavar="FILE NAME",
        ),
    ] = None,
    truth: Annotated[
        bool,
        typer.Option(
            "--truth", help="fit the positions in NAME_truth.csv beside NAME.csv, or in a PyShoe file"
        ),
    ] = False,
    prior: Annotated[
        bool,
        typer.Option("--prior", help="learn the scales of the signal prior of `map`, not the noise"),
    ] = False,
    steps: Annotated[int, typer.Option(help="of Adam")] = 40,
    config: ConfigPath = None,
    format: Format = "auto",
    rate: Rate = None,
    gyr_unit: GyrUnit = None,
    acc_unit: AccUnit = None,
    rests: RestColumn = None,
    sensor: SensorName = None,
    negate_acc: NegateAcc = False,
    quiet: Quiet = False,
    strict: Strict = False,
) -> None:
    """Learn noise and how still a sensor rests, or what gaps lose, from recordings; write it as a configuration."""
    from jaxsat.config import config_toml, load_config
    from jaxsat.present.text import tuning_text

    _check_out(out)
    paths = [*(recordings or []), *(_listed(*split) if split else [])]
    if not paths:
        raise InputError("tune: no recording is given; name some, or a --split.")
    if prior and truth:
        raise InputError("tune: positions say nothing of the prior; leave out --truth or --prior.")
    settings = load_config(config)
    measured = [
        read_recording(path, format, rate, gyr_unit, acc_unit, rests, sensor, negate_acc) for path in paths
    ]
    use_compilation_cache()
    from jaxsat.studies.boards import write_whole
    from jaxsat.studies.metrics import load_truth
    from jaxsat.studies.tuning import noise_trial, tune_noise
    from jaxsat.studies.tuning_prior import prior_trials, tune_prior

    with progress_bar(quiet) as progress:
        report = (lambda done, total: progress("steps", done, total)) if progress else (lambda *_: None)
        if prior:
            clipped = [trial for one in measured for trial in prior_trials(one, settings)]
            tuned = tune_prior(clipped, settings.saturation, steps=steps, report=report)
            pair, warnings = (settings.saturation, tuned.saturation), []
            found = settings.model_copy(update={"saturation": tuned.saturation})
        else:
            trials = [
                noise_trial(one, settings, load_truth(path) if truth else None)
                for one, path in zip(measured, paths, strict=True)
            ]
            tuned = tune_noise(trials, settings.noise, against_truth=truth, steps=steps, report=report)
            pair, found = (settings.noise, tuned.noise), settings.model_copy(update={"noise": tuned.noise})
            warnings = _measured_warnings(measured, trials)
    text = tuning_text(pair, (tuned.before, tuned.after), truth, [path.name for path in paths])
    head = "".join(f"# {line}\n" for line in text.splitlines())
    write_whole(out, f"{head}\n{config_toml(found)}")
    tell(f"{text}\nwritten: {out}", warnings, quiet, strict)


def _measured_warnings(measured, trials) -> list[str]:
    saturated = {one.name: int((t.trial.sign != 0).sum()) for one, t in zip(measured, trials, strict=True)}
    return [
        f"{name}: {count} saturated values count as measured; learn from recordings that do not saturate."
        for name, count in saturated.items()
        if count
    ]


def _check_out(out: Path) -> None:
    if out.suffix != ".toml" or out.is_dir():
        raise InputError(f"{out}: the result is a TOML file; end its name in .toml.")
    if not os.access(out.absolute().parent, os.W_OK):
        raise InputError(f"{out}: its folder is not there or cannot be written; choose another place.")


def _listed(file: Path, name: str) -> list[Path]:
    """The files that a split names; a name may lack its suffix."""
    try:
        splits = tomllib.loads(file.read_text("utf-8"))
    except (OSError, ValueError) as error:
        raise InputError(f"{file}: no split can be read from it ({error}); check the file.") from None
    names = splits.get(name)
    if not (isinstance(names, list) and names and all(isinstance(one, str) for one in names)):
        known = ", ".join(key for key, value in splits.items() if isinstance(value, list))
        raise InputError(f"{file}: no list of files under '{name}'; choose one of {known or 'none'}.")
    found = []
    for one in names:
        exact = file.parent / one
        fitting = [exact] if exact.is_file() else sorted(file.parent.glob(f"{one}.*"))
        if len(fitting) != 1:
            raise InputError(
                f"{file}: '{one}' of '{name}' is {len(fitting)} files of {file.parent}; name one."
            )
        found += fitting
    return found
