"""Moving (Table 2): a joint that bends ±90° about each axis."""

from pathlib import Path
from typing import Any

import jax
import numpy as np
import pandas as pd

from jaxsat.attitude import orient
from jaxsat.studies.motions import Joint
from jaxsat.studies.simulate import simulate

from . import AXES, ESTIMATES, Table, sensor, settings, warmed


def moving_table(c: dict, data: Path) -> Table:
    """Table 2: ±90° about each axis; drift at the end and RMSE of the angle about that axis (deg)."""
    device, rows = c["sensor"], []
    options: dict[str, Any] = {name: {"estimate": name} for name in ESTIMATES}
    options["pi, Q_comp"] = {"estimate": "pi", "update": "comp"}
    options["pi, Q_imp"] = {"estimate": "pi", "update": "imp"}
    options["pi, Eq. 11"] = {"estimate": "pi", "direction": "unit", "tau": 0.0}
    options["pi, Good Gain"] = {"estimate": "pi", "gains": "good_gain"}
    for lever in c["moving"]["levers"]:
        for k, axis in enumerate(AXES):
            motion = Joint(axis=np.eye(3)[k], lever=np.full(3, lever))
            recording, truth = simulate(
                motion,
                rate=device["rate_hz"],
                duration=c["moving"]["duration"],
                sensor=sensor(device),
                key=jax.random.key(k),
            )
            recording = warmed(recording, device)
            turned = 2 * np.arctan2(truth.q_nb[:, 1 + k], truth.q_nb[:, 0])
            for label, given in options.items():
                found = orient(recording, settings(**given))
                # Relative to the start: the zero of the accelerometer tilts the whole, which is no drift.
                error = np.angle(np.exp(1j * (found.euler[:, k] - found.euler[0, k] - turned)))
                rows.append(
                    {
                        "lever": lever,
                        "axis": axis,
                        "estimate": label,
                        "drift": np.rad2deg(abs(error[-round(1 / recording.period) :].mean())),
                        "rmse": np.rad2deg(np.sqrt(np.mean(error**2))),
                    }
                )
                print(*rows[-1].values(), flush=True)
    return pd.DataFrame(rows)
