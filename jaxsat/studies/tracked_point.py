"""The point that motion capture tracks: markers are seldom where the sensor is, and cameras seldom on its clock.

A marker 4 cm from a sensor that turns over with each stride moves by up to 8 cm against it. An estimate is scored
where the truth was measured: the lever between them is found from the swings themselves, once for a mounting.
"""

from typing import NamedTuple

import numpy as np
from jaxtyping import Float
from scipy.optimize import least_squares
from scipy.spatial.transform import Rotation

from jaxsat.errors import InputError

Positions = Float[np.ndarray, "N 3"]

# Displacements over so long (s) hold a good part of a swing, and next to nothing of a path's drift.
WINDOW = 0.25
# Displacements further off than this (m) are dropouts of the cameras, not levers.
USUAL = 0.01
# Markers are about so near to the sensor (m), if its turns say nothing else.
NEAR = 0.1
# Of a walk every few samples are enough.
POINTS = 4000


class TrackedPoint(NamedTuple):
    """Where motion capture looks, and when."""

    lever: Float[np.ndarray, "3"]
    """From the sensor to the tracked point in the body frame (m)."""
    lag: float
    """By which the truth is late on the sensor's clock (s)."""

    def path(
        self, time: Float[np.ndarray, "N"], position: Positions, q_nb: Float[np.ndarray, "N 4"]
    ) -> Positions:
        """Of that point by an estimate of the sensor's path, as the truth's time stamps have it (m)."""
        # SciPy's quaternions have w last.
        point = position + Rotation.from_quat(np.roll(q_nb, -1, axis=1)).apply(self.lever)
        return np.stack([np.interp(time - self.lag, time, axis) for axis in point.T], axis=1)


def find_tracked_point(
    time: Float[np.ndarray, "N"], position: Positions, q_nb: Float[np.ndarray, "N 4"], truth: Positions
) -> TrackedPoint:
    """By robust least squares of displacements over `WINDOW`, the heading of the estimate free.

    time (s), position (m), q_nb: the estimate, of a recording without saturation; truth (m) at the same times. What
    the sensor's turns do not tell of the lever, as that along the only axis of a turntable, stays zero. Raises
    `InputError` where it is shorter than that window.
    """
    period = (time[-1] - time[0]) / (len(time) - 1)
    apart = max(1, round(WINDOW / period))
    first = np.arange(0, len(time) - apart, max(1, len(time) // POINTS))
    if not len(first):
        raise InputError(
            f"tracked point: {len(time)} samples are shorter than {WINDOW} s; give a longer recording."
        )
    moved = truth[first + apart] - truth[first]

    def misfit(parameters: Float[np.ndarray, "5"]) -> Float[np.ndarray, "M"]:
        point = TrackedPoint(parameters[:3], parameters[3]).path(time, position, q_nb)
        turned = Rotation.from_euler("z", parameters[4]).apply(point[first + apart] - point[first])
        near = USUAL / NEAR * parameters[:3]
        return np.concatenate([(turned - moved).ravel(), near])

    own = position[first + apart] - position[first]
    yaw = np.angle(np.vdot(own[:, 0] + 1j * own[:, 1], moved[:, 0] + 1j * moved[:, 1]))
    start = np.array([0.0, 0.0, 0.0, 0.0, yaw])
    scale = np.array([0.1, 0.1, 0.1, period, 0.1])
    found = least_squares(misfit, start, loss="soft_l1", f_scale=USUAL, x_scale=scale, diff_step=1e-6)
    return TrackedPoint(found.x[:3], float(found.x[3]))
