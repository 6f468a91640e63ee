"""Real motion clipped in software: filled, ignored and unclipped."""

from pathlib import Path

import equinox as eqx
import numpy as np
import pandas as pd

from jaxsat.attitude import orient
from jaxsat.config import load_config
from jaxsat.studies.metrics import attitude_errors

from . import Table, load_trial
from .peers import vqf

FILTERS = {
    "jaxsat pi, integral alone": {"orientation.estimate": "pi", "orientation.offset": "integral"},
    "jaxsat smoothed": {},
}


def clipped_table(c: dict, data: Path) -> Table:
    """Trials whose rates pass the limit: unclipped, clipped and ignored, clipped and filled."""
    rows, limit = [], float(np.deg2rad(c["broad"]["clip"]))
    for name in sorted((*c["broad"]["train"], *c["broad"]["test"])):
        recording, q_nb, scored = load_trial(data / "broad" / f"{name}.npz")
        beyond = np.asarray(np.abs(recording.gyr) > limit)
        if not np.any(beyond):
            continue
        clipped = eqx.tree_at(lambda r: r.gyr, recording, np.clip(recording.gyr, -limit, limit))
        rails = {"rails.gyr": limit}
        filled = eqx.tree_at(
            lambda r: r.gyr, clipped, orient(clipped, load_config(None, **rails)).filled[:, :3]
        )
        values = {
            "gyr_max": np.rad2deg(np.abs(recording.gyr).max()),
            "saturated": float(np.mean(np.any(beyond, axis=1)[scored])),
        }
        for filter, options in FILTERS.items():
            for label, given, limits in (
                ("unclipped", recording, {"rails.gyr": "none"}),
                ("ignored", clipped, {"rails.gyr": "none"}),
                ("filled", clipped, rails),
            ):
                found = orient(given, load_config(None, **limits, **options))
                errors = np.rad2deg(attitude_errors(found.after, q_nb, scored))
                rows.append({"trial": name, **values, "filter": filter, "input": label})
                rows[-1] |= dict(zip(("total", "heading", "inclination"), errors, strict=True))
                if found.sd is not None:
                    rows[-1]["inclination_sd"] = np.rad2deg(np.sqrt(np.mean(found.sd[scored, 0] ** 2)))
                print(*rows[-1].values(), flush=True)
        for label, given in (("unclipped", recording), ("ignored", clipped), ("filled", filled)):
            errors = np.rad2deg(attitude_errors(vqf(given, True), q_nb, scored))
            rows.append({"trial": name, **values, "filter": "VQF offline", "input": label})
            rows[-1] |= dict(zip(("total", "heading", "inclination"), errors, strict=True))
    return pd.DataFrame(rows)
