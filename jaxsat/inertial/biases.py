"""Constant biases of the sensors, estimated in the smoother's own problem.

The quadratic problem of Eq. 14 with the biases b among its variables is still one forward pass: the mean of the
filter becomes a matrix over [1, b], each innovation a row of it, and the sum of their squares over their variances
is the cost as a quadratic in b. Its minimum is the bias that the smoother with six more states would find.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxsat.inertial import kalman
from jaxsat.inertial.dense import inverse_positive
from jaxsat.inertial.rotations import quat_exp, quat_multiply, quat_to_matrix
from jaxsat.inertial.smoother import VELOCITY, Rows, linearised, smooth
from jaxsat.inertial.strapdown import (
    NavState,
    Samples,
    error_transition,
    sample_noise,
)


def bias_quadratic(
    reference: NavState,
    samples: Samples,
    rows: Rows,
    prior_covariance: Float[Array, "9 9"],
    gravity: Float[Array, ""],
) -> Float[Array, "7 7"]:
    """Λ with J(b) = ½ [1; b]ᵀ Λ [1; b], for biases b of what is left in the samples (rad/s, m/s²).

    reference: N+1 states to linearise about; height rows are not used.
    """
    start, intervals, offsets = linearised(reference, samples, gravity)

    def step(carry, inputs):
        mean, covariance, total = carry
        state, interval, sample, offset, row = inputs
        for axis, index in enumerate(VELOCITY):
            column = covariance[:, index]
            weight = jnp.where(row.rest, 1.0 / (column[index] + row.velocity_variance), 0.0)
            innovation = -mean[index].at[0].add(state.velocity[axis])
            total = total + weight * jnp.outer(innovation, innovation)
            mean = mean + weight * jnp.outer(column, innovation)
            covariance = covariance - weight * jnp.outer(column, column)
        transition = error_transition(state.q_nb, interval)
        # A bias that is there turns and pushes the reference too much.
        middle = quat_multiply(state.q_nb, quat_exp(0.5 * sample.period * sample.signal[:3]))
        turned, zero = -quat_to_matrix(middle) * sample.period, jnp.zeros((3, 3))
        rate = jnp.concatenate([turned, zero, zero])
        force = jnp.concatenate([zero, 0.5 * sample.period * turned, turned])
        shift, covariance = kalman.predict(
            mean[:, 0],
            covariance,
            transition.forth,
            offset,
            sample_noise(state.q_nb, sample.signal, sample.period, sample.variance),
        )
        moved = transition.forth(mean[:, 1:]) + jnp.concatenate([rate, force], axis=1)
        return (jnp.concatenate([shift[:, None], moved], axis=1), covariance, total), None

    carry = (jnp.zeros((9, 7)), prior_covariance, jnp.zeros((7, 7)))
    (_, _, total), _ = jax.lax.scan(step, carry, (start, intervals, samples, offsets, rows))
    return total


def estimate_biases(
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "9 9"],
    gravity: Float[Array, ""],
    sd: Float[Array, "6"],
    steps: Int[Array, ""] | int,
    start: Float[Array, "6"],
) -> tuple[Float[Array, "6"], Float[Array, "6 6"]]:
    """Biases with a zero-mean prior, by Gauss-Newton steps from `start`, and their covariance.

    sd: prior standard deviation of each bias (rad/s, m/s²), positive.
    """

    def step(_, carry):
        bias, _ = carry
        left = Samples(samples.signal - bias[None], samples.period, samples.variance)
        reference = smooth(left, rows, prior, prior_covariance, gravity, 0).state
        quadratic = bias_quadratic(reference, left, rows, prior_covariance, gravity)
        # In units of the prior, where the Hessian is at least the identity.
        hessian = jnp.eye(6) + quadratic[1:, 1:] * sd[:, None] * sd[None]
        gradient = bias / sd + quadratic[1:, 0] * sd
        covariance = inverse_positive(hessian) * sd[:, None] * sd[None]
        return bias - covariance @ (gradient / sd), covariance

    return jax.lax.fori_loop(0, steps, step, (start, jnp.diag(sd**2)))
