"""How sure an estimate is: what its claims of sd heed that the path itself does not.

The path takes velocities at rests as white and what is constant in a recording as known. Neither is so: a foot that
is taken to rest creeps on, alike for some tenths of a second; the offset of a gyroscope and the lever to the point
that stands still are known as well as the rests tell them; and level ground is level to a centimetre.
"""

from typing import NamedTuple

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.spatial.transform import Rotation

from jaxsat.config import Config
from jaxsat.inertial.calibration import Calibration
from jaxsat.preparation import constants_sd
from jaxsat.saturation.compensate import calibrate_recording
from jaxsat.saturation.layout import Arrays, Trial
from jaxsat.signals.rests import runs


class Doubt(NamedTuple):
    """sd of what is the same error all through a recording."""

    gyr_offset: Float[Arrays, "3"]
    """rad/s."""
    lever: Float[Arrays, "3"]
    """To the point that stands still (m)."""
    height: Float[Arrays, ""]
    """Of the rest that the recording starts from, on level ground (m); zero where heights are not told."""


def doubt(
    config: Config, gyr_offset_sd: Float[np.ndarray, "3"], doubted: Calibration, heights: bool
) -> Doubt:
    """gyr_offset_sd: of what was taken off the rates; heights: the path was told of them."""
    left = np.asarray(doubted.sd[:3]) if config.smoother.gyr_bias_sd > 0 else gyr_offset_sd
    return Doubt(left, np.asarray(doubted.sd[6:]), np.asarray(config.height.sd if heights else 0.0))


def common_errors(
    q_nb: Float[np.ndarray, "N 4"],
    position: Float[np.ndarray, "N 3"],
    velocity: Float[np.ndarray, "N 3"],
    rates: Float[np.ndarray, "N 3"],
    rest: Bool[np.ndarray, "N"],
    period: float,
    common: Doubt,
) -> Float[np.ndarray, "N 9 7"]:
    """By how much one sd of each doubt moves each state's [θ, r, v]; they are independent, so squares add up.

    rates: rad/s, by samples of `period` (s). Tilt is what rests tell anew each time: of an offset's turns those about
    the vertical are left, and with them the way turns. A lever that is wrong by e gives a rest a velocity that is
    wrong by ω × e on average, and the motion between two rests what lies between theirs.
    """
    errors = np.zeros((len(rest), 9, 7))
    # SciPy's quaternions have w last.
    bodies = Rotation.from_quat(np.roll(q_nb, -1, axis=1)).as_matrix()
    heading = _summed(bodies[:, 2] * common.gyr_offset * period)
    errors[:, 2, :3] = heading
    # A small turn about the vertical, of the way and of the velocity.
    ways = np.diff(position, axis=0, append=position[-1:])
    errors[:, 3, :3], errors[:, 4, :3] = _summed(-ways[:, 1:2] * heading), _summed(ways[:, :1] * heading)
    errors[:, 6, :3], errors[:, 7, :3] = -velocity[:, 1:2] * heading, velocity[:, :1] * heading
    turning = np.cross(rates[:, None], np.eye(3)).swapaxes(1, 2)
    drift = _between((bodies @ turning) * common.lever, rest)
    # A path that is told its heights does not climb by it.
    if common.height > 0:
        drift[:, 2] = 0.0
    errors[:, 3:6, 3:6], errors[:, 6:, 3:6] = _summed(drift * period), drift
    errors[:, 5, 6] = np.where(np.cumsum(~rest) > 0, common.height, 0.0)
    return errors


def outer(errors: Float[np.ndarray, "N k m"]) -> Float[np.ndarray, "N k k"]:
    """Their covariance."""
    return errors @ errors.swapaxes(1, 2)


def _summed(changes: Float[np.ndarray, "N *k"]) -> Float[np.ndarray, "N *k"]:
    """At the start of each sample."""
    return np.cumsum(changes, axis=0) - changes


def _between(values: Float[np.ndarray, "N 3 3"], rest: Bool[np.ndarray, "N"]) -> Float[np.ndarray, "N 3 3"]:
    """Their mean over each rest, and straight lines between rests."""
    starts, ends = runs(rest)
    total = np.concatenate([np.zeros((1, 9)), np.cumsum(values.reshape(-1, 9), axis=0)])
    means = np.repeat((total[ends] - total[starts]) / (ends - starts)[:, None], 2, axis=0)
    knots = np.stack([starts, ends - 1], axis=1).ravel()
    lines = [np.interp(np.arange(len(rest)), knots, mean) for mean in means.T]
    return np.stack(lines, axis=1).reshape(-1, 3, 3)


def with_rests_in_doubt(trial: Trial, config: Config) -> Trial:
    """With the variance of resting velocities that claims of sd rest on.

    The velocity of a foot that is taken to rest is alike for `noise.rest_steady`: a rest tells it once, not once a
    sample, and a longer one gets no further than in that time. The point that stands still wanders from heel to toe
    by `smoother.lever_sd`.
    """
    rest = np.asarray(trial.rows.rest)
    starts, ends = runs(rest)
    lengths, steady = ends - starts, config.noise.rest_steady / trial.period[0]
    alike = np.minimum(lengths, steady**2 / lengths)
    times = np.ones(len(rest))
    times[rest] = np.repeat(np.maximum(alike, 1.0), lengths)
    turning = np.sum(np.asarray(trial.signal)[:, :3] ** 2, axis=1)
    variance = (np.asarray(trial.rows.velocity_variance) + config.smoother.lever_sd**2 * turning) * times
    return eqx.tree_at(lambda t: t.rows.velocity_variance, trial, variance)


def calibration_in_doubt(
    trial: Trial,
    config: Config,
    found: Calibration,
    signal: Float[Arrays, "P 6"],
    extra: Float[Arrays, "P 6"],
) -> Calibration:
    """The same constants with the sd that `with_rests_in_doubt` leaves.

    signal, extra: what they were found from, as for `calibrate_recording`.
    """
    sd = constants_sd(config)
    if sd is None:
        return found
    doubted = calibrate_recording(with_rests_in_doubt(trial, config), signal, extra, sd, found)
    return Calibration(found.constants, doubted.sd)
