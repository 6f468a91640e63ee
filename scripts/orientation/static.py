"""At rest (Table 1): drift and noise of each estimate."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd
from scipy.ndimage import uniform_filter1d

from jaxsat.attitude import orient
from jaxsat.signals.readers import read
from jaxsat.signals.recording import Recording
from jaxsat.studies.motions import Joint
from jaxsat.studies.simulate import simulate

from . import AXES, ESTIMATES, Table, sensor, settings, warmed


def static_table(c: dict, data: Path) -> Table:
    device, duration = c["sensor"], c["static"]["duration"]
    still, rows = Joint(start=duration + 1.0), []
    for seed in range(c["static"]["seeds"]):
        recording, _ = simulate(
            still, rate=device["rate_hz"], duration=duration, sensor=sensor(device), key=jax.random.key(seed)
        )
        rows += at_rest(warmed(recording, device), "simulated, 300 s")
    table: Table = pd.DataFrame(rows)
    simulated = table.groupby(["recording", "estimate"], sort=False).mean().reset_index()
    real = read(data / "xio" / "fusion_sensor_data.csv")
    first, last = (int(np.searchsorted(real.time, t)) for t in c["static"]["tail"])
    tail = Recording(
        real.time[first:last] - real.time[first],
        real.gyr[first:last],
        real.acc[first:last],
        real.missing[first:last],
        name="tail",
    )
    return pd.concat([simulated, pd.DataFrame(at_rest(tail, "real, 32 s"))], ignore_index=True)


def at_rest(recording: Recording, name: str) -> list[dict]:
    """Rows of Table 1: drift between the means of the first and the last second, noise about running means."""
    second = round(1 / recording.period)
    rows = []
    options: dict[str, Any] = {name: {"estimate": name} for name in ESTIMATES}
    paper = {"estimate": "pi", "offset": "integral"}
    options["pi, integral alone"] = paper
    options["pi, Good Gain"] = paper | {"gains": "good_gain"}
    options["pi, Good Gain, tau 0"] = paper | {"gains": "good_gain", "tau": 0.0}
    for label, given in options.items():
        found = angles(recording, **given)
        drift = np.abs(found[-second:].mean(axis=0) - found[:second].mean(axis=0))
        noise = (found - uniform_filter1d(found, second, axis=0))[second:-second].std(axis=0)
        rows.append(
            {
                "recording": name,
                "estimate": label,
                **{f"drift_{axis}": drift[k] for k, axis in enumerate(AXES)},
                **{f"rmse_{axis}": noise[k] for k, axis in enumerate(AXES)},
            }
        )
        print(name, label, drift.round(3), noise.round(4), flush=True)
    return rows


def angles(recording: Recording, **given: Any) -> np.ndarray:
    """Angles about x, y, z (deg)."""
    return np.rad2deg(np.unwrap(orient(recording, settings(**given)).euler, axis=0))
