"""A recording: what was measured, in SI units, with masks instead of NaN."""

from typing import Any

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float

CHANNELS = ("gyr_x", "gyr_y", "gyr_z", "acc_x", "acc_y", "acc_z")


class Recording(eqx.Module):
    """One inertial recording on a uniform time grid; sample k holds over [time[k], time[k] + period).

    Every array that speaks of channels has them in the order of `CHANNELS`.
    """

    time: Float[np.ndarray, "N"]
    """Start of each sample (s)."""
    gyr: Float[np.ndarray, "N 3"]
    """Angular rate in the body frame (rad/s)."""
    acc: Float[np.ndarray, "N 3"]
    """Specific force in the body frame (m/s²): +g upwards at rest."""
    missing: Bool[np.ndarray, "N 6"]
    """Samples that were not measured; the values there are interpolated and carry no weight."""
    rest: Bool[np.ndarray, "N"] | None = None
    """Rest flags that came with the recording, if any."""
    clipped: Bool[np.ndarray, "N 6"] | None = None
    """Saturation flags that came with the recording, if any."""
    name: str = eqx.field(static=True, default="recording")
    """What to call it in messages and tables."""

    def __len__(self) -> int:
        return len(self.time)

    @property
    def period(self) -> float:
        """Sampling period (s)."""
        return float((self.time[-1] - self.time[0]) / (len(self.time) - 1))

    @property
    def signal(self) -> Float[np.ndarray, "N 6"]:
        """All six channels side by side (rad/s and m/s²)."""
        return np.concatenate([self.gyr, self.acc], axis=1)

    def with_signal(self, signal: Float[np.ndarray, "N 6"]) -> "Recording":
        """The same recording with other values in its six channels."""
        return eqx.tree_at(lambda r: (r.gyr, r.acc), self, (signal[:, :3], signal[:, 3:]))


def sensor_changes(signal: Float[Any, "N 6"]) -> Float[Any, "N 6"]:
    """By how much each sensor's reading changes from a sample to one beside it, the larger of both; three axes alike.

    A sample stands for all its period, and a sensor that is turned reads on one axis what was on another: what is
    wrong with a value grows with this (rad/s, m/s²). Of arrays of NumPy or of JAX.
    """
    xp = signal.__array_namespace__()
    steps = xp.sqrt(xp.sum((signal[1:] - signal[:-1]).reshape(-1, 2, 3) ** 2, axis=2))
    still = steps[:1] * 0.0
    either = xp.maximum(xp.concat([still, steps]), xp.concat([steps, still]))
    return xp.repeat(either, 3, axis=1)
