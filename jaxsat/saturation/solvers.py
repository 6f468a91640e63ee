"""Minimising a smooth function in a box; nothing here knows about sensors."""

import enum
import warnings
from collections.abc import Callable

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.components import Cholesky, Matrix
from jaxsat.inertial.dense import one_by_one, solve_positive, total


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
    """It is not, and the search gave up before: a kink, mostly. Projected gradient where steps of a thousandth of
    their length lower the value by less than a thousandth of the tolerance (relative), Gauss-Newton at its highest
    damping."""


class Solution(eqx.Module):
    """Minimiser, and how good it is."""

    x: Float[Array, "n"]
    value: Float[Array, ""]
    gradient: Float[Array, "n"]
    columns: tuple[Float[Array, "n"], ...]
    """Of A, as `Linearise` gives them; like the gradient at x."""
    residual: Float[Array, ""]
    """max |u − clip(u − ∂f/∂u)| with u = x / scale: zero exactly at a stationary point of the bounded problem."""
    iterations: Int[Array, ""]
    status: Int[Array, ""]


Linearise = Callable[
    [Float[Array, "n"]], tuple[Float[Array, ""], Float[Array, "n"], tuple[Float[Array, "n"], ...]]
]
"""Value, gradient, and the columns of A with A Aᵀ the Gauss-Newton Hessian."""


class Box(eqx.Module):
    """Where to search, from where, and how far: lower ≤ x ≤ upper."""

    start: Float[Array, "n"]
    lower: Float[Array, "n"]
    upper: Float[Array, "n"]
    scale: Float[Array, "n"]
    """The change of each x that moves the value by about ½ (1/√ of the Hessian's diagonal)."""
    tolerance: float | Float[Array, ""]
    """Of the solution's residual."""
    max_iterations: int | Int[Array, ""]
    precision: Float[Array, "n n"] | None = None
    """Curvature that the value has besides A Aᵀ; None for none."""

    def scaled(self) -> tuple[Float[Array, "n"], Float[Array, "n"], Float[Array, "n"]]:
        """Start, moved into the box, and the bounds, in u = x / scale."""
        low, high = self.lower / self.scale, self.upper / self.scale
        return jnp.clip(self.start / self.scale, low, high), low, high


def _assess(linearise: Linearise, u, scale, low, high):
    """Value, gradient and columns in u = x / scale, and the residual of a bounded stationary point."""
    value, gradient, columns = linearise(u * scale)
    gradient = gradient * scale
    residual = jnp.max(jnp.abs(u - jnp.clip(u - gradient, low, high)))
    return value, gradient, tuple(column * scale for column in columns), residual


# Momentum is dropped after so many steps, then after twice as many: without restarts it swings about the minimiser,
# and always after few it never gathers where curvatures differ by a million.
_FIRST_ROUND = 120
# Of a step, where a search by projected gradient gives up.
_SHORTEST = 1e-3


def projected_gradient(linearise: Linearise, box: Box) -> Solution:
    """Minimise over the box by accelerated projected gradient with restarts.

    The search runs in u = x / scale on the value divided by the number of free variables, so curvature is at most
    about 1 in any direction and steps of 1 do without a search along the line; after a round that did not pay, since
    the value bends more elsewhere, they are half as long. (With jaxopt's line search batches never ended.)
    Whether it has arrived is decided by the residual of the solution, not by the solver's own step length.
    """
    with warnings.catch_warnings():
        # jaxopt announces on import that it is no longer developed; here, since loading it takes a second.
        warnings.simplefilter("ignore", DeprecationWarning)
        import jaxopt

    u, low, high = box.scaled()
    whole = 1.0 / jnp.maximum(jnp.sum(box.upper > box.lower), 1).astype(u.dtype)

    def shared(u, share):
        value, gradient, _ = linearise(u * box.scale)
        return share * value, share * box.scale * gradient

    solver = jaxopt.ProjectedGradient(
        fun=shared,
        value_and_grad=True,
        projection=lambda u, limits: optax.projections.projection_box(u, *limits),
        stepsize=1.0,
    )

    def proceed(carry):
        _, _, error, count, share, _ = carry
        return (error > box.tolerance) & (count < box.max_iterations) & (share > _SHORTEST * whole)

    def one_round(carry):
        u, value, error, count, share, steps = carry
        most = jnp.minimum(steps, box.max_iterations - count)

        def still_moving(carry):
            state = carry[1]
            return (state.iter_num < most) & (state.error > 0.01 * share * box.tolerance)

        def one_step(carry):
            return tuple(solver.update(*carry, hyperparams_proj=(low, high), share=share))

        state = solver.init_state(u, (low, high), share=share)
        u_end, state = jax.lax.while_loop(still_moving, one_step, (u, state))
        u_end = optax.projections.projection_box(u_end, low, high)
        end_value, _, _, end_error = _assess(linearise, u_end, box.scale, low, high)
        better = end_value < value
        # In the first round there is nothing to compare with: value is infinite.
        pays = jnp.isinf(value) | (value - end_value >= 1e-3 * box.tolerance * (1.0 + jnp.abs(value)))
        share, steps = jnp.where(pays, share, 0.5 * share), jnp.where(pays, 2 * steps, _FIRST_ROUND)
        u, value, error = jax.tree.map(
            lambda new, old: jnp.where(better, new, old), (u_end, end_value, end_error), (u, value, error)
        )
        return u, value, error, count + state.iter_num, share, steps

    infinite = jnp.full((), jnp.inf, u.dtype)
    start = u, infinite, infinite, jnp.asarray(0), whole, jnp.asarray(_FIRST_ROUND)
    u, value, error, count, share, _ = jax.lax.while_loop(proceed, one_round, start)
    _, gradient, columns, _ = _assess(linearise, u, box.scale, low, high)
    return _solution(box, u, (value, gradient, columns, error), count, share <= _SHORTEST * whole)


def _solution(box: Box, u, at, count, stalled) -> Solution:
    """at: of `_assess` at u."""
    value, gradient, columns, error = at
    unfinished = jnp.where(stalled, Status.STALLED, Status.MAX_ITERATIONS)
    return Solution(
        x=u * box.scale,
        value=value,
        gradient=gradient / box.scale,
        columns=tuple(column / box.scale for column in columns),
        residual=error,
        iterations=count,
        status=jnp.where(error <= box.tolerance, Status.CONVERGED, unfinished),
    )


# Damping, relative to a scaled diagonal of 1: where it starts, the least there is (or the tolerance where that is
# less: a direction that is damped by more than its curvature settles slowly), and where a search gives up. With less
# of it, what the data do not see moves further: the value bends, so every step has a little of that in it.
_DAMPING = (1.0, 1e-2, 1e6)
# The least with a prior.
_UNDAMPED = 1e-9


def projected_gauss_newton(linearise: Linearise, box: Box) -> Solution:
    """The same problem by Gauss-Newton steps within the box, damped after Levenberg and Marquardt.

    Without `precision` the Hessian has a low rank, so most directions are free: damping takes the shortest of the
    steps (in scaled variables) that the data cannot tell apart. One evaluation a step; a step that does not pay is
    not taken.
    """
    u, low, high = box.scaled()
    first, least, most = _DAMPING
    least = jnp.minimum(least, box.tolerance)
    known = None if box.precision is None else box.precision * box.scale[:, None] * box.scale[None]
    if known is not None:
        # The prior tells apart what the data do not, so full steps may be tried at once, and nothing need be damped:
        # smooth movement has directions of very little curvature.
        first = least = jnp.minimum(least, _UNDAMPED)
    # Traced once; a method of a module of tracers, which has no hash, would not do for `jit`.
    once = jax.jit(lambda x: linearise(x))
    rank = len(jax.eval_shape(once, box.start)[2])

    def proceed(carry):
        _, _, (_, _, _, error), _, damping, count = carry
        return (error > box.tolerance) & (count <= box.max_iterations) & (damping < most)

    def step(carry):
        # The start is evaluated in the first round, so the objective is compiled once.
        u, there, at, promised, damping, count = carry
        value, _, _, error = at
        new = _assess(once, there, box.scale, low, high)
        kept = jnp.where(promised > 0.0, (value - new[0]) / jnp.where(promised > 0.0, promised, 1.0), 0.0)
        # Where the value no longer tells two points apart, the residual does.
        level = (new[0] - value <= 1e-13 * jnp.abs(value)) & (new[3] < error)
        better = (count == 0) | ((kept > 1e-4) & (new[0] < value)) | level
        u, at = jax.tree.map(lambda new, old: jnp.where(better, new, old), (there, new), (u, at))
        factor = jnp.where((kept > 0.75) | level, 0.1, jnp.where(kept > 0.25, 1.0, 8.0))
        damping = jnp.where(count == 0, damping, jnp.maximum(damping * factor, least))
        _, gradient, columns, _ = at
        if known is None:
            d = box_step(gradient, columns, damping, low - u, high - u)
        else:
            A = jnp.stack(columns, axis=1)
            hessian = known + A @ A.T + damping * jnp.eye(len(u))
            # Beside others that still search, one that is done waits.
            d = dense_box_step(gradient, hessian, low - u, high - u, proceed(carry))
        there = jnp.clip(u + d, low, high)
        d = there - u
        promised = -jnp.sum(gradient * d) - 0.5 * sum(jnp.sum(a * d) ** 2 for a in columns)
        if known is not None:
            promised = promised - 0.5 * d @ (known @ d)
        return u, there, at, promised, damping, count + 1

    infinite, zero = jnp.full((), jnp.inf, u.dtype), jnp.zeros((), u.dtype)
    nothing = (infinite, jnp.zeros_like(u), tuple(jnp.zeros_like(u) for _ in range(rank)), infinite)
    damping = jnp.full((), first, u.dtype)
    u, _, at, _, damping, count = jax.lax.while_loop(
        proceed, step, (u, u, nothing, zero, damping, jnp.asarray(0))
    )
    return _solution(box, u, at, count - 1, damping >= most)


# Where the slope of a search along a line is looked at: near zero first, since small damping makes kinks there.
_FRACTIONS = np.concatenate([[0.0], 0.25 ** np.arange(12)[::-1]])


def _root(rise: Callable[[Float[Array, "k"]], Float[Array, "k"]], fractions: Float[Array, "k"]):
    """Where in [0, 1] an increasing, piecewise linear function crosses zero; 1 if it does not."""

    def bracket(points):
        values = rise(points)
        after = jnp.clip(jnp.sum(values <= 0.0), 1, len(points) - 1)
        return points[after - 1], points[after], values[after - 1], values[after]

    low, high, _, _ = bracket(fractions)
    spread = jnp.linspace(0.0, 1.0, len(fractions), dtype=fractions.dtype)
    low, high, below, above = bracket(low + (high - low) * spread)
    crossing = below / jnp.where(above > below, below - above, -1.0)
    return jnp.where(above <= 0.0, high, low + (high - low) * jnp.clip(crossing, 0.0, 1.0))


def box_step(
    gradient: Float[Array, "n"],
    columns: tuple[Float[Array, "n"], ...],
    damping: Float[Array, ""],
    low: Float[Array, "n"],
    high: Float[Array, "n"],
) -> Float[Array, "n"]:
    """min over low ≤ d ≤ high of gᵀd + ½ |Aᵀd|² + ½ μ |d|², A given by its few columns.

    Its dual has as many variables as A has columns: d(y) = clip(−(g + A y)/μ), and y = Aᵀd(y) is the stationary
    point of a convex, piecewise quadratic function, found by Newton's method with a line search. An
    iteration costs a few passes over d and no factorisation larger than the rank.
    """
    rank = range(len(columns))
    fractions = jnp.asarray(_FRACTIONS, gradient.dtype)

    def primal(pull):
        return jnp.clip(-pull / damping, low, high)

    def newton(carry):
        y, pull, _, count = carry
        d = primal(pull)
        free = (d > low) & (d < high)
        slope = Matrix.column(y[k] - total(columns[k] * d) for k in rank)
        weighted = [jnp.where(free, column, 0.0) / damping for column in columns]
        curvature = Matrix(
            tuple(
                tuple(total(weighted[i] * columns[j]) + (1.0 if i == j else 0.0) for j in rank) for i in rank
            )
        ).mirrored()
        change = [-c for c in Cholesky(curvature).solve(slope).entries()]
        turned = sum(column * c for column, c in zip(columns, change, strict=True))

        def rise(t):
            d = primal(pull + t * turned)
            along = sum((a + t * c) * c for a, c in zip(y, change, strict=True))
            return along - total(turned * d)

        t = _root(jax.vmap(rise), fractions)
        size = jnp.sqrt(sum(c**2 for c in change)) / (1.0 + jnp.sqrt(sum(a**2 for a in y)))
        y = tuple(a + t * c for a, c in zip(y, change, strict=True))
        return y, pull + t * turned, size, count + 1

    def proceed(carry):
        _, _, size, count = carry
        return (size > 1e-9) & (count < 50)

    zero = jnp.zeros_like(damping)
    start = (tuple(zero for _ in rank), gradient, jnp.full_like(damping, jnp.inf), jnp.asarray(0))
    _, pull, _, _ = jax.lax.while_loop(proceed, newton, start)
    return primal(pull)


def dense_box_step(
    gradient: Float[Array, "n"],
    hessian: Float[Array, "n n"],
    low: Float[Array, "n"],
    high: Float[Array, "n"],
    wanted: Bool[Array, ""] | bool = True,
) -> Float[Array, "n"]:
    """min over low ≤ d ≤ high of gᵀd + ½ dᵀHd with H positive definite, by projected Newton (Bertsekas 1982).

    Variables at a bound that their slope pushes against are held; the others take a Newton step, shortened until
    the value of its projection is least. Where it is not wanted, the result is of no use and costs nothing.
    """
    return _dense_box_step(gradient, hessian, low, high, jnp.asarray(wanted))


@one_by_one
def _dense_box_step(gradient, hessian, low, high, wanted):
    fractions = jnp.asarray(0.5 ** np.arange(12.0), gradient.dtype)[:, None]

    def newton(carry):
        d, _, count = carry
        slope = gradient + hessian @ d
        held = ((d <= low) & (slope >= 0.0)) | ((d >= high) & (slope <= 0.0))
        masked = jnp.where(held[:, None] | held[None], jnp.diag(jnp.where(held, 1.0, 0.0)), hessian)
        step = -solve_positive(masked, jnp.where(held, 0.0, slope))
        tried = jnp.clip(d[None] + fractions * step[None], low[None], high[None])
        value = tried @ gradient + 0.5 * jnp.sum(tried * (tried @ hessian), axis=1)
        best = tried[jnp.argmin(value)]
        return best, jnp.max(jnp.abs(best - d)), count + 1

    def proceed(carry):
        d, change, count = carry
        return (change > 1e-10 * (1.0 + jnp.max(jnp.abs(d)))) & (count < 50)

    start = jnp.clip(jnp.zeros_like(gradient), low, high)
    change = jnp.where(wanted, jnp.inf, 0.0).astype(start.dtype)
    return jax.lax.while_loop(proceed, newton, (start, change, jnp.asarray(0)))[0]
