"""How sure an estimate is: what its claims of sd heed that the path itself does not.

The path takes velocities at rests as white and what is constant in a recording as known. Neither is so: a foot that
is taken to rest creeps on, alike for some tenths of a second; the offset of a gyroscope and the lever to the point
that stands still are known as well as the rests tell them; and level ground is level to a centimetre.
"""

from typing import NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float

from jaxsat.config import Config
from jaxsat.inertial.calibration import Calibration
from jaxsat.inertial.rotations import quat_to_matrix, skew
from jaxsat.inertial.strapdown import NavState
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
    state: NavState,
    rates: Float[Array, "P 3"],
    period: Float[Array, "P"],
    rest: Bool[Array, "P"],
    common: Doubt,
) -> Float[Array, "N 9 7"]:
    """By how much one sd of each doubt moves each state's [θ, r, v]; they are independent, so squares add up.

    state: of N ≤ P + 1, at the starts of samples; rates: rad/s. Tilt is what rests tell anew each time: of an
    offset's turns those about the vertical are left, and with them the way turns. A lever that is wrong by e gives a
    rest a velocity that is wrong by ω × e on average, and the motion between two rests what lies between theirs.
    """
    count = len(state.q_nb) - 1
    rates, period, rest = rates[:count], period[:count, None], rest[:count]
    bodies = jax.vmap(quat_to_matrix)(state.q_nb)

    def summed(changes):
        return jnp.concatenate([jnp.zeros_like(changes[:1]), jnp.cumsum(changes, axis=0)])

    heading = summed(bodies[:-1, 2] * common.gyr_offset[None] * period)
    zero = jnp.zeros((count + 1, 3, 3))

    def turned(ways, heading):
        """By a small turn about the vertical."""
        return jnp.stack([-ways[:, 1:2] * heading, ways[:, 0:1] * heading, jnp.zeros_like(heading)], axis=1)

    offset = (
        zero.at[:, 2].set(heading),
        summed(turned(jnp.diff(state.position, axis=0), heading[:-1])),
        turned(state.velocity, heading),
    )
    moving = bodies[:-1] @ jax.vmap(skew)(rates) * common.lever[None, None]
    # A path that is told its heights does not climb by it.
    moving = moving.at[:, 2].multiply(jnp.where(common.height > 0.0, 0.0, 1.0))
    drift = _between(moving, rest)
    lever = zero, summed(drift * period[:, :, None]), jnp.concatenate([drift, drift[-1:]])
    left = summed(jnp.where(rest, 0.0, 1.0)) > 0.0
    height = jnp.zeros((count + 1, 9, 1)).at[:, 5, 0].set(jnp.where(left, common.height, 0.0))
    return jnp.concatenate([*(jnp.concatenate(part, axis=1) for part in (offset, lever)), height], axis=2)


def _between(values: Float[Array, "N 3 3"], rest: Bool[Array, "N"]) -> Float[Array, "N 3 3"]:
    """Their mean over each rest, and straight lines between rests."""
    here, last = jnp.arange(len(rest)), len(rest) - 1
    number = jnp.cumsum(rest & ~jnp.concatenate([jnp.zeros(1, bool), rest[:-1]]))
    weights = jnp.where(rest, 1.0, 0.0)[:, None, None]
    total, count = (jnp.zeros_like(x).at[number].add(x) for x in (weights * values, weights))
    means = (total / jnp.maximum(count, 1.0))[number]
    before = jax.lax.cummax(jnp.where(rest, here, -1))
    after = jax.lax.cummin(jnp.where(rest, here, last + 1), reverse=True)
    share = (here - before) / jnp.maximum(after - before, 1)
    # Before the first and after the last as there.
    share = jnp.where(before < 0, 1.0, jnp.where(after > last, 0.0, share))[:, None, None]
    return (1.0 - share) * means[jnp.maximum(before, 0)] + share * means[jnp.minimum(after, last)]


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
