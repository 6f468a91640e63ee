"""`jaxsat simulate` and `jaxsat demo`: recordings whose truth is known."""

from pathlib import Path
from typing import Annotated

import typer

from jaxsat.cli.shared import progress_bar, use_compilation_cache
from jaxsat.errors import InputError


def simulate_command(
    motion: Annotated[str, typer.Argument(metavar="MOTION", help="bar, joint, line, planar or walk")],
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

    use_compilation_cache()
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


def demo_command(
    out: Annotated[Path, typer.Option("--out", "-o", help="folder for the results", metavar="DIR")] = Path(
        "jaxsat-demo"
    ),
) -> None:
    """Clip a real walk as a ±300 °/s sensor would have, reconstruct it, and score it by motion capture."""
    use_compilation_cache()
    from jaxsat.demo import run_demo

    with progress_bar(False) as progress:
        text = run_demo(out, progress)
    typer.echo(text)


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
