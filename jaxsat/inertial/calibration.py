"""Constants of a recording, estimated in the smoother's own problem: biases of the sensors, and a lever.

A foot is never still: while it stands it rolls, and the sensor on it moves about the point that does stand still. Of
that point, a lever ℓ away from the sensor in the body frame, the velocity v + R_nb (ω × ℓ) is zero: the zero-velocity
rows of Eq. 13, with ℓ to be found.

The quadratic problem of Eq. 14 with these constants c = [b, ℓ] among its variables is still one forward pass: the
mean of the filter becomes a matrix over [1, c], each innovation a row of it, and the sum of their squares over their
variances is the cost as a quadratic in c. Its minimum is what the smoother with nine more states would find.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsat.inertial import kalman
from jaxsat.inertial.dense import inverse_positive
from jaxsat.inertial.rotations import quat_exp, quat_multiply, quat_to_matrix, skew
from jaxsat.inertial.smoother import Rows
from jaxsat.inertial.strapdown import (
    NavState,
    Samples,
    add_error,
    advance,
    error_transition,
    sample_intervals,
    sample_noise,
)

CONSTANTS = 9
"""Biases of gyroscope and accelerometer (rad/s, m/s²), and the lever (m)."""

# Velocity rows see [θ, v] of [θ, r, v].
_SEEN = np.array([0, 1, 2, 6, 7, 8])


class Calibration(eqx.Module):
    """What is constant in a recording, and how well it is known."""

    constants: Float[Array, "9"]
    """[b, ℓ] (rad/s, m/s², m)."""
    sd: Float[Array, "9"]
    """Of each; zero where it is not estimated."""

    @staticmethod
    def none() -> "Calibration":
        return Calibration(jnp.zeros(CONSTANTS), jnp.zeros(CONSTANTS))

    def applied(self, samples: Samples, rows: Rows) -> tuple[Samples, Rows]:
        """Samples without the biases, and rests about the point that stands still."""
        signal, velocity = corrected(samples.signal, self.constants)
        rows = eqx.tree_at(lambda r: r.velocity, rows, velocity, is_leaf=lambda x: x is None)
        return Samples(signal, samples.period, samples.variance), rows


@jax.jit
def corrected(
    signal: Float[Array, "N 6"], constants: Float[Array, "9"]
) -> tuple[Float[Array, "N 6"], Float[Array, "N 3"]]:
    """Signals without the biases (rad/s, m/s²), and the velocity of a resting sensor in the body frame (m/s)."""
    signal = signal - constants[None, :6]
    return signal, jnp.cross(constants[None, 6:], signal[:, :3])


def constants_quadratic(
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "p p"],
    gravity: Float[Array, ""],
) -> Float[Array, "10 10"]:
    """Λ with J(c) = ½ [1; c]ᵀ Λ [1; c], c being what is left of the constants in samples and rows.

    Linearised about the states of the filter (`closed_loop`), of which attitude and velocity alone are needed: height
    rows are not used.
    """

    def step(carry, inputs):
        state, covariance, moved, total = carry
        interval, sample, row = inputs
        # A lever that is left moves the sensor at rest by ℓ × ω.
        lever = quat_to_matrix(state.q_nb) @ skew(sample.signal[:3])
        mean = jnp.concatenate([jnp.zeros((6, 1)), moved], axis=1)
        for axis, misfit in enumerate(row.misfit(state)):
            column = covariance[:, 3 + axis]
            weight = jnp.where(row.rest, 1.0 / (column[3 + axis] + row.velocity_variance), 0.0)
            innovation = (-mean[3 + axis]).at[0].add(misfit).at[7:].add(-lever[axis])
            total = total + weight * jnp.outer(innovation, innovation)
            mean = mean + weight * jnp.outer(column, innovation)
            covariance = covariance - weight * jnp.outer(column, column)
        state = add_error(state, jnp.zeros(9).at[_SEEN].set(mean[:, 0]))
        transition = error_transition(state.q_nb, interval)
        # A bias that is there turns and pushes too much.
        middle = quat_multiply(state.q_nb, quat_exp(0.5 * sample.period * sample.signal[:3]))
        turned, zero = -quat_to_matrix(middle) * sample.period, jnp.zeros((3, 3))
        biases = jnp.block([[turned, zero, zero], [zero, turned, zero]])
        noise = sample_noise(state.q_nb, sample.signal, sample.period, sample.variance)[_SEEN][:, _SEEN]
        nothing = jnp.zeros(6)
        _, covariance = kalman.predict(nothing, covariance, transition.forth, nothing, noise)
        moved = transition.forth(mean[:, 1:]) + biases
        return (advance(state, interval, gravity), covariance, moved, total), None

    known = prior_covariance if len(prior_covariance) == 6 else prior_covariance[_SEEN][:, _SEEN]
    carry = (prior, known, jnp.zeros((6, CONSTANTS)), jnp.zeros((1 + CONSTANTS, 1 + CONSTANTS)))
    intervals = sample_intervals(samples.signal, samples.period)
    return jax.lax.scan(step, carry, (intervals, samples, rows))[0][3]


def calibrate(
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "p p"],
    gravity: Float[Array, ""],
    sd: Float[Array, "9"],
    start: Calibration,
) -> Calibration:
    """The constants with a zero-mean prior, by one Gauss-Newton step from `start`.

    sd: prior standard deviation of each (rad/s, m/s², m); zero where it is not wanted.
    """
    # One that is not wanted is as good as known.
    scale = jnp.maximum(sd, 1e-12)
    quadratic = constants_quadratic(*start.applied(samples, rows), prior, prior_covariance, gravity)
    # In units of the prior, where the Hessian is at least the identity.
    hessian = jnp.eye(CONSTANTS) + quadratic[1:, 1:] * scale[:, None] * scale[None]
    gradient = start.constants / scale + quadratic[1:, 0] * scale
    covariance = inverse_positive(hessian)
    constants = start.constants - scale * (covariance @ gradient)
    found = scale * jnp.sqrt(jnp.diagonal(covariance))
    return Calibration(jnp.where(sd > 0.0, constants, 0.0), jnp.where(sd > 0.0, found, 0.0))
