"""How sure an estimate is: what its claims of sd heed that the path itself does not.

The path takes velocities at rests as white and what is constant in a recording as known. Neither is so: a foot that
is taken to rest creeps on, alike for some tenths of a second and always a little the same way, a gyroscope's offset
is known as well as the rests tell it, and level ground is level to a centimetre.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsat.config import Config
from jaxsat.inertial.calibration import Calibration
from jaxsat.inertial.rotations import quat_to_matrix
from jaxsat.inertial.strapdown import NavState
from jaxsat.preparation import constants_sd
from jaxsat.saturation.compensate import calibrate_recording
from jaxsat.saturation.layout import Arrays, Trial
from jaxsat.signals.rests import runs


class Doubt(NamedTuple):
    """sd of what is the same error all through a recording."""

    gyr_offset: Float[Arrays, "3"]
    """rad/s."""
    creep: Float[Arrays, ""]
    """By which share of its length each way is too short or too long."""
    height: Float[Arrays, ""]
    """Of the rest that the recording starts from, on level ground (m); zero where heights are not told."""


def doubt(
    config: Config, gyr_offset_sd: Float[np.ndarray, "3"], calibration: Calibration, heights: bool
) -> Doubt:
    """gyr_offset_sd: of what was taken off the rates; heights: the path was told of them."""
    left = np.asarray(calibration.sd[:3]) if config.smoother.gyr_bias_sd > 0 else gyr_offset_sd
    height = config.height.sd if heights else 0.0
    return Doubt(left, np.asarray(config.noise.rest_creep), np.asarray(height))


def common_errors(
    state: NavState, period: Float[Array, "P"], rest: Bool[Array, "P"], common: Doubt
) -> Float[Array, "N 9 5"]:
    """By how much one sd of each doubt moves each state's [θ, r, v]; they are independent, so squares add up.

    state: of N ≤ P + 1, at the starts of samples. Tilt is what rests tell anew each time; of an offset's turns those
    about the vertical are left, and with them the way turns.
    """
    count = len(state.q_nb) - 1

    def summed(changes):
        return jnp.concatenate([jnp.zeros_like(changes[:1]), jnp.cumsum(changes, axis=0)])

    vertical = jax.vmap(quat_to_matrix)(state.q_nb[:-1])[:, 2]
    heading = summed(vertical * common.gyr_offset[None] * period[:count, None])
    zero = jnp.zeros_like(heading)

    def turned(ways, heading):
        """By a small turn about the vertical."""
        return jnp.stack([-ways[:, 1:2] * heading, ways[:, 0:1] * heading, jnp.zeros_like(heading)], axis=1)

    offset = [
        jnp.stack([zero, zero, heading], axis=1),
        summed(turned(jnp.diff(state.position, axis=0), heading[:-1])),
        turned(state.velocity, heading),
    ]
    creep = common.creep * jnp.concatenate(
        [zero, state.position - state.position[:1], state.velocity], axis=1
    )
    left = summed(jnp.where(rest[:count], 0.0, 1.0)) > 0.0
    height = jnp.zeros_like(creep).at[:, 5].set(jnp.where(left, common.height, 0.0))
    return jnp.concatenate([jnp.concatenate(offset, axis=1), creep[:, :, None], height[:, :, None]], axis=2)


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
