"""The standard smoother: a linearised 9-state error model with zero-velocity rows (paper A, Section 3).

The quadratic problem of Eq. 12-15, summed from k = 0, is solved exactly in O(N) by a forward pass and its
adjoint; its minimum J* comes out of the forward pass alone. Rows: zero velocity at rest samples; optionally one
height row at the first sample of each rest, as an equality with a given sd or as the inequality z ≥ 0.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial import kalman
from jaxsat.inertial.strapdown import (
    NavState,
    Samples,
    add_error,
    advance,
    error_between,
    error_transition,
    sample_intervals,
    sample_noise,
)

HEIGHT, VELOCITY = 5, (6, 7, 8)
"""Rows of the state [θ, r, v] that are observed."""


class Rows(eqx.Module):
    """What is known of the states without a sensor; state k is the start of sample k."""

    rest: Bool[Array, "N"]
    """Zero velocity at state k."""
    velocity_variance: Float[Array, ""]
    """Of each axis at rest (m²/s²)."""
    height: Bool[Array, "N"]
    """Zero height at state k."""
    height_variance: Float[Array, ""]
    """Of a height row (m²); zero makes it exact."""


class Smoothed(eqx.Module):
    """States at the N+1 sample boundaries given all rows."""

    state: NavState
    covariance: Float[Array, "N1 9 9"]
    """Of [θ, r, v], θ in the navigation frame."""
    cost: Float[Array, ""]
    """J*, the minimum of Eq. 14."""
    height_multiplier: Float[Array, "N"]
    """dJ*/dz of each height row; zero where there is none."""


def update_rows(
    mean: Float[Array, "9"],
    covariance: Float[Array, "9 9"],
    state: NavState,
    rows: Rows,
    rest: Bool[Array, ""],
    height: Bool[Array, ""],
) -> tuple[Float[Array, "9"], Float[Array, "9 9"], Float[Array, ""], list[kalman.Row]]:
    """The rows of one state on the error about the reference `state`; rest, height: its flags in `rows`."""
    cost, done = jnp.zeros_like(state.velocity[0]), []
    for axis, index in enumerate(VELOCITY):
        mean, covariance, extra, row = kalman.update_row(
            mean, covariance, index, -state.velocity[axis], rows.velocity_variance, rest
        )
        cost, done = cost + extra, [*done, row]
    mean, covariance, extra, row = kalman.update_row(
        mean, covariance, HEIGHT, -state.position[2], rows.height_variance, height
    )
    return mean, covariance, cost + extra, [*done, row]


def closed_loop(
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "9 9"],
    gravity: Float[Array, ""],
) -> tuple[NavState, Float[Array, "N1 9 9"]]:
    """Extended Kalman filter: strapdown that is corrected at each row.

    Returns the N+1 corrected states and their filtered covariances; they
    are the reference of the smoother's first linearisation and the departure of each segment (Section 5).
    """

    def step(carry, inputs):
        state, covariance = carry
        interval, sample, rest, height = inputs
        mean, covariance, _, _ = update_rows(
            jnp.zeros(9, covariance.dtype), covariance, state, rows, rest, height
        )
        state = add_error(state, mean)
        _, predicted = kalman.predict(
            mean,
            covariance,
            error_transition(state.q_nb, interval),
            jnp.zeros_like(mean),
            sample_noise(state.q_nb, sample.signal, sample.period, sample.variance),
        )
        return (advance(state, interval, gravity), predicted), (state, covariance)

    intervals = sample_intervals(samples.signal, samples.period)
    last, corrected = jax.lax.scan(
        step, (prior, prior_covariance), (intervals, samples, rows.rest, rows.height)
    )
    return jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), corrected, last)


def smooth_about(
    reference: NavState,
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "9 9"],
    gravity: Float[Array, ""],
) -> Smoothed:
    """Solve the quadratic problem of Eq. 14 about a reference trajectory (N+1 states).

    Where the reference does not follow the sensors (a corrected or already smoothed trajectory) its defects
    enter as known offsets, so repeating the call at its own result is Gauss-Newton on the nonlinear problem.
    """
    intervals = sample_intervals(samples.signal, samples.period)
    start = jax.tree.map(lambda x: x[:-1], reference)
    end = jax.tree.map(lambda x: x[1:], reference)
    offsets = jax.vmap(lambda a, i, b: error_between(advance(a, i, gravity), b))(start, intervals, end)

    def forward(carry, inputs):
        mean, covariance, cost = carry
        state, interval, sample, offset, rest, height = inputs
        mean, covariance, extra, row = update_rows(mean, covariance, state, rows, rest, height)
        predicted = kalman.predict(
            mean,
            covariance,
            error_transition(state.q_nb, interval),
            offset,
            sample_noise(state.q_nb, sample.signal, sample.period, sample.variance),
        )
        return (*predicted, cost + extra), (mean, covariance, row)

    def backward(adjoint, inputs):
        state, interval, mean, covariance, row = inputs
        adjoint = kalman.adjoint_transition(adjoint, error_transition(state.q_nb, interval))
        smoothed = kalman.condition_on_future(mean, covariance, adjoint)
        adjoint, multiplier = kalman.adjoint_row(adjoint, HEIGHT, row[-1])
        for index, velocity_row in reversed(list(zip(VELOCITY, row[:-1], strict=True))):
            adjoint, _ = kalman.adjoint_row(adjoint, index, velocity_row)
        return adjoint, (*smoothed, multiplier)

    initial_error = error_between(prior, jax.tree.map(lambda x: x[0], reference))
    zero = jnp.zeros_like(gravity)
    (last_mean, last_covariance, cost), (mean, covariance, row) = jax.lax.scan(
        forward,
        (initial_error, prior_covariance, zero),
        (start, intervals, samples, offsets, rows.rest, rows.height),
    )
    nothing = kalman.Adjoint(jnp.zeros_like(last_mean), jnp.zeros_like(last_covariance))
    _, (error, smoothed, multiplier) = jax.lax.scan(
        backward, nothing, (start, intervals, mean, covariance, row), reverse=True
    )
    return Smoothed(
        state=jax.vmap(add_error)(reference, jnp.concatenate([error, last_mean[None]])),
        covariance=jnp.concatenate([smoothed, last_covariance[None]]),
        cost=cost,
        height_multiplier=multiplier,
    )


def smooth(
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "9 9"],
    gravity: Float[Array, ""],
    relinearisations: Int[Array, ""] | int = 1,
) -> Smoothed:
    """The standard smoother of a whole recording: closed-loop reference, then Gauss-Newton."""
    reference, _ = closed_loop(samples, rows, prior, prior_covariance, gravity)
    first = smooth_about(reference, samples, rows, prior, prior_covariance, gravity)
    return jax.lax.fori_loop(
        0,
        relinearisations,
        lambda _, s: smooth_about(s.state, samples, rows, prior, prior_covariance, gravity),
        first,
    )


class ActiveSet(eqx.Module):
    """Which rests touch the floor in the inequality z ≥ 0, and whether the search ended at a solution."""

    active: Bool[Array, "N"]
    iterations: Int[Array, ""]
    converged: Bool[Array, ""]


def smooth_nonnegative(
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "9 9"],
    gravity: Float[Array, ""],
    relinearisations: Int[Array, ""] | int = 1,
    max_iterations: int = 50,
    tolerance: float = 1e-9,
) -> tuple[Smoothed, ActiveSet]:
    """`smooth` subject to height ≥ 0 at the states flagged in `rows.height`.

    Primal-dual active set: rows in the set hold with equality (their variance is zero); a row enters when its
    height is negative and leaves when its multiplier is. At the end heights are ≥ −tolerance (m), multipliers
    are ≥ 0 and each row is complementary: the solution of the quadratic problem with the inequality of Section 3.
    """
    candidates = rows.height
    zero = jnp.zeros_like(gravity)

    def solve(active):
        exact = Rows(rows.rest, rows.velocity_variance, active, zero)
        smoothed = smooth(samples, exact, prior, prior_covariance, gravity, relinearisations)
        low = smoothed.state.position[:-1, 2] < -tolerance
        wanted = candidates & jnp.where(active, smoothed.height_multiplier > 0.0, low)
        return smoothed, wanted

    def step(carry):
        _, wanted, count = carry
        smoothed, further = solve(wanted)
        return smoothed, further, count + 1, wanted

    def proceed(carry):
        _, wanted, count, active = carry
        return jnp.any(wanted != active) & (count < max_iterations)

    none = jnp.zeros_like(candidates)
    smoothed, wanted = solve(none)
    smoothed, wanted, count, active = jax.lax.while_loop(
        proceed, lambda c: step(c[:3]), (smoothed, wanted, jnp.asarray(1), none)
    )
    return smoothed, ActiveSet(active=active, iterations=count, converged=jnp.all(wanted == active))
