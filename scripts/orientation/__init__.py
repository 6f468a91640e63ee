"""The tables of Barraza-Madrigal et al. 2014, and attitude on real trials beside Madgwick, Mahony and VQF.

    python -m scripts.orientation ../shared/data [--only static moving tuning broad clipped] [-o results/orientation]

`configs/orientation/board.toml` says what is measured. Recordings: BROAD (Laidig et al., Data 2021, 6(7), 72,
CC BY 4.0) and a still stretch of x-io's `fusion_sensor_data.csv` (MIT). Truth tunes gains on the named training
trials and scores. The packages that it compares with are the extra `bench`. A run with --only keeps the other
tables; README.md and board.json are written from all of them. Here: what the tables share.
"""

from pathlib import Path
from typing import Any

import numpy as np

from jaxsat.attitude import orient
from jaxsat.config import load_config
from jaxsat.signals.formats import GRAVITY
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.studies.metrics import load_broad_truth
from jaxsat.studies.simulate import Sensor

ESTIMATES = ("gyro", "accel", "gyro_accel", "pi", "smoothed")
AXES = "xyz"
# A data frame: its type stubs know too little of what is done with one here.
Table = Any
Trial = tuple[Recording, np.ndarray, np.ndarray]


def settings(**given: Any):
    """The default configuration, with some of [orientation] replaced."""
    return load_config(None, **{f"orientation.{key}": value for key, value in given.items()})


def sensor(c: dict) -> Sensor:
    """The simulated device; `Sensor` scales a density by √rate, the bandwidth lets more through."""
    spread = {name: np.sqrt(c[f"{name}_bandwidth"] / c["rate_hz"]) for name in ("gyr", "acc")}
    return Sensor(
        gyr_density=float(np.deg2rad(c["gyr_noise"]) * spread["gyr"]),
        acc_density=float(c["acc_noise"] * GRAVITY * spread["acc"]),
        gyr_bias=np.deg2rad(c["gyr_bias"]),
        acc_bias=np.array(c["acc_bias"]) * GRAVITY,
        gyr_rail=float(np.deg2rad(c["gyr_rail"])),
        acc_rail=c["acc_rail"] * GRAVITY,
    )


def warmed(recording: Recording, c: dict) -> Recording:
    """With both zeros drifting as the device warms."""
    share = (recording.time / 300.0 * c["warming"])[:, None]
    drift = [np.deg2rad(c["gyr_per_degree"])] * 3 + [c["acc_per_degree"] * GRAVITY] * 3
    return recording.with_signal(recording.signal + share * drift)


def load_trial(path: Path) -> tuple[Recording, np.ndarray, np.ndarray]:
    """A BROAD trial, its true attitude and the samples that count: moving and tracked."""
    _, q_nb, _, valid = load_broad_truth(path)
    with np.load(path) as arrays:
        moving = arrays["movement"].astype(bool)
    return read(path), q_nb, valid & moving


def ours(recording: Recording, rails: dict | None = None, **given: Any) -> np.ndarray:
    options = {f"orientation.{key}": value for key, value in given.items()}
    return orient(recording, load_config(None, **options, **(rails or {}))).after
