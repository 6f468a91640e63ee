"""Linear-Gaussian atoms in covariance form: one scalar row, its adjoint, and nothing about sensors.

Rows are taken one after the other, so no step factorises a matrix and no covariance is ever inverted: singular
process noise and exactly known initial states are ordinary cases. The backward pass is the modified
Bryson-Frazier smoother (Bierman 1973), here for scalar rows.
"""

from collections.abc import Callable

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxsat.inertial.dense import product


class Row(eqx.Module):
    """What one scalar row h·x = z + noise did to the estimate; zeros where the row was switched off."""

    gain: Float[Array, "n"]
    """K = P h / s."""
    weighted: Float[Array, ""]
    """Innovation over its variance, e / s."""
    weight: Float[Array, ""]
    """1 / s."""


def update_row(
    mean: Float[Array, "n"],
    covariance: Float[Array, "n n"],
    index: int,
    residual: Float[Array, ""],
    variance: Float[Array, ""],
    active: Bool[Array, ""],
) -> tuple[Float[Array, "n"], Float[Array, "n n"], Float[Array, ""], Row]:
    """Condition on x[index] = residual + noise(variance); also returns the cost ½e²/s and the row's record."""
    column = covariance[:, index]
    s = jnp.where(active, column[index] + variance, 1.0)
    weight = jnp.where(active, 1.0 / s, 0.0)
    innovation = residual - mean[index]
    gain = column * weight
    cost = 0.5 * weight * innovation**2
    row = Row(gain=gain, weighted=weight * innovation, weight=weight)
    return mean + gain * innovation, covariance - jnp.outer(gain, column), cost, row


Linear = Callable[[Float[Array, "n k"]], Float[Array, "n k"]]
"""A matrix, by what it does to columns."""


def predict(
    mean: Float[Array, "n"],
    covariance: Float[Array, "n n"],
    transition: Linear,
    offset: Float[Array, "n"],
    noise: Float[Array, "n n"],
) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """x' = Φ x + offset + w, cov(w) = noise."""
    spread = transition(transition(covariance).T) + noise
    return transition(mean[:, None])[:, 0] + offset, 0.5 * (spread + spread.T)


class Adjoint(eqx.Module):
    """What all later rows say about a state: mean_s = mean − P·gradient, P_s = P − P·curvature·P.

    Of states on which nothing later depends it is zero, so they may be left out."""

    gradient: Float[Array, "n"]
    curvature: Float[Array, "n n"]


def adjoint_row(
    adjoint: Adjoint, index: int, gain: Float[Array, "n"], row: Row
) -> tuple[Adjoint, Float[Array, ""]]:
    """Add one row to the adjoint; also returns its multiplier dJ*/dz. gain: `row`'s, of the adjoint's states."""
    multiplier = jnp.sum(gain * adjoint.gradient) + row.weighted
    # CᵀΛC + h hᵀ/s with C = I − K hᵀ differs from Λ in row and column `index` only.
    pulled = product(adjoint.curvature, gain[:, None])[:, 0]
    curvature = adjoint.curvature.at[index, :].add(-pulled).at[:, index].add(-pulled)
    curvature = curvature.at[index, index].add(jnp.sum(gain * pulled) + row.weight)
    return Adjoint(adjoint.gradient.at[index].add(-multiplier), curvature), multiplier


def adjoint_transition(adjoint: Adjoint, back: Linear) -> Adjoint:
    """The adjoint at the start of a transition; back: Φᵀ."""
    curvature = back(back(adjoint.curvature).T)
    return Adjoint(back(adjoint.gradient[:, None])[:, 0], 0.5 * (curvature + curvature.T))


def condition_on_future(
    mean: Float[Array, "n"], covariance: Float[Array, "n n"], columns: Float[Array, "n k"], adjoint: Adjoint
) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """Smoothed mean and covariance from the filtered ones.

    columns: those of the covariance that belong to the adjoint's states; on the others nothing later depends.
    """
    # Symmetric to rounding; nothing feeds on it, and to mirror it XLA would compute it twice.
    smoothed = covariance - product(product(columns, adjoint.curvature), columns.T)
    return mean - product(columns, adjoint.gradient[:, None])[:, 0], smoothed
