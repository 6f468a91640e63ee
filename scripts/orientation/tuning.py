"""Gains by gradient of the inclination error on the training trials."""

from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd

from jaxsat.config import Orientation
from jaxsat.inertial.orientation import Direction, Gains, start_at_rest
from jaxsat.signals.recording import Recording
from jaxsat.studies.tuning import Trials, tune_gains

from . import Table, load_trial


def tuning_table(c: dict, data: Path) -> Table:
    """Gains by gradient on the training trials: for what is the default, and for the paper's form of it."""
    trials = [load_trial(data / "broad" / f"{name}.npz") for name in c["broad"]["train"]]
    n = max(len(recording) for recording, _, _ in trials)
    start, given, rows = c["tuning"]["start"], Orientation(), []
    with jax.enable_x64(True):
        stacked = jax.tree.map(lambda *x: jnp.stack(x), *(_padded(*trial, n) for trial in trials))
        forms: tuple[tuple[Direction, float], ...] = (("mean", start["tau"]), ("unit", 0.0))
        for direction, tau in forms:
            first = jax.tree.map(
                lambda x: jnp.asarray(x, float), Gains(start["kp"], start["ki"], tau, np.inf, given.limit)
            )
            best = tune_gains(
                stacked,
                first,
                direction=direction,
                steps=c["tuning"]["steps"],
                rate=c["tuning"]["rate"],
                report=lambda k, loss, g: print(k, np.rad2deg(np.sqrt(loss)), g.kp, g.ki, g.tau, flush=True),
            )
            rows.append(
                {"form": direction, **{name: float(getattr(best, name)) for name in ("kp", "ki", "tau")}}
            )
    return pd.DataFrame(rows)


def _padded(recording: Recording, q_nb: np.ndarray, scored: np.ndarray, n: int) -> Trials:
    def pad(x):
        return jnp.asarray(np.pad(x, ((0, n - len(x)), *((0, 0) for _ in x.shape[1:]))))

    w, x, y, z = q_nb.T
    up = np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], axis=1)
    first = recording.signal[: round(1 / recording.period)]
    return Trials(
        pad(recording.signal),
        pad(np.full(len(recording), recording.period)),
        pad(~recording.missing.reshape(-1, 2, 3).any(axis=2)),
        start_at_rest(jnp.asarray(first)),
        pad(up),
        pad(scored),
    )
