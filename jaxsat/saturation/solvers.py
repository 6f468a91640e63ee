"""Minimising a smooth function in a box; nothing here knows about sensors."""

import enum
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import optax
from jaxtyping import Array, Float, Int

with warnings.catch_warnings():
    # jaxopt announces on import that it is no longer developed; it is the solver the project is built on.
    warnings.simplefilter("ignore", DeprecationWarning)
    import jaxopt


class Status(enum.IntEnum):
    """How a search ended."""

    CONVERGED = 0
    """The optimality residual is below the tolerance."""
    MAX_ITERATIONS = 1
    """It is not, and the iterations are used up; the best point found is returned."""
    NOTHING_TO_DO = 2
    """There was nothing to search."""
    NO_ARRIVAL = 3
    """No rest follows, so the data say nothing; the start is returned."""
    STALLED = 4
    """A whole round lowered the value by less than a thousandth of the tolerance (relative): a kink, mostly."""


class Solution(eqx.Module):
    """Minimiser, and how good it is."""

    x: Float[Array, "n"]
    value: Float[Array, ""]
    residual: Float[Array, ""]
    """max |u − clip(u − ∂f/∂u)| with u = x / scale: zero exactly at a stationary point of the bounded problem."""
    iterations: Int[Array, ""]
    status: Int[Array, ""]


# Momentum is dropped after so many steps: acceleration without restarts oscillates about the minimiser.
_STEPS_PER_ROUND = 120


def projected_gradient(
    fun: Callable[[Float[Array, "n"]], Float[Array, ""]],
    start: Float[Array, "n"],
    lower: Float[Array, "n"],
    upper: Float[Array, "n"],
    scale: Float[Array, "n"],
    tolerance: float | Float[Array, ""],
    max_iterations: int,
) -> Solution:
    """Minimise fun over lower ≤ x ≤ upper by accelerated projected gradient with restarts.

    scale: the change of each x that moves fun by about ½ (1/√ of the Hessian's diagonal). The search runs in
    u = x / scale on fun divided by the number of free variables, so curvature is at most about 1 in any direction:
    `jaxopt.ProjectedGradient` restarts its step at 1 and can stop far from the optimum otherwise. Whether it
    has arrived is decided by the residual of the solution, not by the solver's own step length.
    """
    low, high = lower / scale, upper / scale
    share = 1.0 / jnp.maximum(jnp.sum(upper > lower), 1).astype(start.dtype)

    def assess(u):
        value, gradient = jax.value_and_grad(lambda u: fun(u * scale))(u)
        return value, jnp.max(jnp.abs(u - jnp.clip(u - gradient, low, high)))

    solver = jaxopt.ProjectedGradient(
        fun=lambda u: share * fun(u * scale),
        projection=lambda u, box: optax.projections.projection_box(u, *box),
        maxls=15,
    )

    def proceed(carry):
        _, _, error, count, stalled = carry
        return (error > tolerance) & (count < max_iterations) & ~stalled

    def one_step(carry):
        return tuple(solver.update(*carry, hyperparams_proj=(low, high)))

    def still_moving(carry):
        state = carry[1]
        return (state.iter_num < _STEPS_PER_ROUND) & (state.error > 0.01 * share * tolerance)

    def one_round(carry):
        u, value, error, count, _ = carry
        u_end, state = jax.lax.while_loop(still_moving, one_step, (u, solver.init_state(u, (low, high))))
        u_end = optax.projections.projection_box(u_end, low, high)
        end_value, end_error = assess(u_end)
        better = end_value < value
        # In the first round there is nothing to compare with: value is infinite.
        stalled = jnp.isfinite(value) & (value - end_value < 1e-3 * tolerance * (1.0 + jnp.abs(value)))
        u, value, error = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (u_end, end_value, end_error), (u, value, error)
        )
        return u, value, error, count + state.iter_num, stalled

    u = optax.projections.projection_box(start / scale, low, high)
    infinite = jnp.full((), jnp.inf, start.dtype)
    u, value, error, count, stalled = jax.lax.while_loop(
        proceed, one_round, (u, infinite, infinite, jnp.asarray(0), jnp.asarray(False))
    )
    unfinished = jnp.where(stalled, Status.STALLED, Status.MAX_ITERATIONS)
    status = jnp.where(error <= tolerance, Status.CONVERGED, unfinished)
    return Solution(x=u * scale, value=value, residual=error, iterations=count, status=status)
