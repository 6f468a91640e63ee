"""Attitude of a motion that stays about its place, by the smoother of `smoother`.

A hand accelerates as it likes, but its velocity stays within about a metre a second of zero. Rows of zero velocity
with that sd, instead of rests, hold the vertical: over a time t they leave an acceleration of VELOCITY_SD/t, a tilt
of VELOCITY_SD/(g t). That the mean of acceleration vanishes is what the low-pass of a filter with fixed gains rests
on too (Laidig & Seel, Information Fusion 91, 2023, 187-204); the smoother weighs each rate by its own variance
besides, such as that of a filled gap, looks ahead, and says how sure it is. It holds neither heading nor position.
"""

import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsat.inertial.orientation import Start
from jaxsat.inertial.smoother import Rows, Smoothed, smooth
from jaxsat.inertial.strapdown import NavState, Samples

VELOCITY_SD = 1.0
"""Of a hand, a tool or a limb that goes nowhere (m/s)."""
ROW_EVERY = 0.1
"""From row to row (s): velocities of such a motion are about independent."""
GYR_DENSITY, ACC_DENSITY = 7e-4, 7e-3
"""Noise of the sensors alone (rad/s/√Hz, m/s²/√Hz); `config.Noise` also holds what their scale does, here apart."""
SCALE, SWING = 0.005, 0.3
"""A calibrated gyroscope's error as a share of the rate, and how long a movement turns one way (s)."""


def bounded_attitude(
    samples: Samples,
    start: Start,
    tilt_sd: Float[Array, ""],
    velocity_sd: Float[Array, ""],
    every: Int[Array, ""],
    relinearisations: Int[Array, ""],
) -> Smoothed:
    """Attitude with its covariance, from rates without offset; position and velocity are by-products.

    samples: padded ones (zero period) at the end; start: attitude and gravity, known to tilt_sd (rad), the velocity
    to velocity_sd (m/s); every: samples from row to row.
    """
    T = samples.period
    # What a scale error adds to an angle over a swing, spread over its samples.
    scale = SCALE**2 * SWING * samples.signal[:, :3] ** 2 / jnp.where(T > 0.0, T, 1.0)[:, None]
    variance = samples.variance + jnp.pad(scale, ((0, 0), (0, 3)))
    rows = Rows(
        rest=(jnp.arange(len(T)) % every == 0) & (T > 0.0),
        velocity_variance=jnp.full(len(T), VELOCITY_SD**2),
        height=None,
        height_variance=jnp.ones(len(T)),
    )
    tilt, zero, speed = tilt_sd**2, jnp.zeros_like(tilt_sd), velocity_sd**2
    covariance = jnp.diag(jnp.stack([tilt, tilt, zero, zero, zero, zero, speed, speed, speed]))
    prior = NavState(start.q_nb, jnp.zeros(3), jnp.zeros(3))
    return smooth(
        Samples(samples.signal, T, variance), rows, prior, covariance, start.gravity, relinearisations
    )
