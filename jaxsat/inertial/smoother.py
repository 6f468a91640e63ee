"""The standard smoother: a linearised 9-state error model with zero-velocity rows (paper A, Section 3).

The quadratic problem of Eq. 12-15, summed from k = 0, is solved exactly in O(N) by a forward pass and its
adjoint; its minimum J* comes out of the forward pass alone. Rows: zero velocity at rest samples; optionally one
height row at the first sample of each rest, as an equality with a given sd or as the inequality z ≥ 0.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial import kalman
from jaxsat.inertial.dense import solve_positive
from jaxsat.inertial.rotations import quat_rotate
from jaxsat.inertial.strapdown import (
    Interval,
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

    rest: Bool[Array, "*N"]
    """At state k the sensor rests: its velocity is known."""
    velocity_variance: Float[Array, "*N"]
    """Of each axis of that velocity (m²/s²)."""
    height: Bool[Array, "*N"] | None
    """Zero height at state k; None where heights are not used at all."""
    height_variance: Float[Array, "*N"]
    """Of that height (m²); zero makes it exact."""
    velocity: Float[Array, "*N 3"] | None = None
    """Velocity of a resting sensor in the body frame (m/s), where what it is fixed to turns about a point that stands
    still; None where that is zero."""

    def marked(self, change: Callable[[Any], Any]) -> "Rows":
        """With the flags of rests and heights changed alike."""
        height = None if self.height is None else change(self.height)
        return Rows(change(self.rest), self.velocity_variance, height, self.height_variance, self.velocity)

    def misfit(self, state: NavState) -> Float[Array, "3"]:
        """What the velocity of one state lacks to be that of its rest, in the navigation frame (m/s)."""
        if self.velocity is None:
            return -state.velocity
        return quat_rotate(state.q_nb, self.velocity) - state.velocity


class Smoothed(eqx.Module):
    """States at the N+1 sample boundaries given all rows."""

    state: NavState
    covariance: Float[Array, "N1 9 9"]
    """Of [θ, r, v], θ in the navigation frame."""
    cost: Float[Array, ""]
    """J*, the minimum of Eq. 14."""
    height_multiplier: Float[Array, "N"] | None
    """dJ*/dz of each height row; zero where there is none."""


def _observed(rows: Rows, size: int) -> tuple[int, ...]:
    """Where the observed rows stand in a state with or without position: velocity, then height."""
    first = size - 3
    return (first, first + 1, first + 2, *(() if rows.height is None else (HEIGHT,)))


def update_rows(
    mean: Float[Array, "n"],
    covariance: Float[Array, "n n"],
    state: NavState,
    rows: Rows,
) -> tuple[Float[Array, "n"], Float[Array, "n n"], Float[Array, ""], list[kalman.Row]]:
    """The rows of one state on the error about the reference `state`."""
    cost, done = jnp.zeros_like(state.velocity[0]), []
    known = [(v, rows.velocity_variance, rows.rest) for v in rows.misfit(state)]
    if rows.height is not None:
        known.append((-state.position[2], rows.height_variance, rows.height))
    for index, row in zip(_observed(rows, len(mean)), known, strict=True):
        mean, covariance, extra, done_row = kalman.update_row(mean, covariance, index, *row)
        cost, done = cost + extra, [*done, done_row]
    return mean, covariance, cost, done


def filtered_size(rows: Rows) -> int:
    """Of the covariances of `closed_loop`: [θ, r, v], or [θ, v] where no height is observed."""
    return 6 if rows.height is None else 9


class Filtered(NamedTuple):
    """What is known of each state by its own rows and all before."""

    state: NavState
    """N+1 of them."""
    covariance: Float[Array, "N1 n n"]
    """Of [θ, r, v], or of [θ, v] where no height is observed."""
    cost: Float[Array, "N"]
    """½ innovation² over its variance, summed over the rows of each state: in all, J*."""


def closed_loop(
    samples: Samples,
    rows: Rows,
    prior: NavState,
    prior_covariance: Float[Array, "p p"],
    gravity: Float[Array, ""],
) -> Filtered:
    """Extended Kalman filter: strapdown that is corrected at each row.

    Its states are the reference of the smoother's first linearisation and the departure of each segment (Section 5).
    Covariances, the prior's too, are of [θ, r, v] or, where no height is observed, of [θ, v]: position is then
    integrated, not corrected.
    """
    size = filtered_size(rows)

    def part(matrix):
        if len(matrix) == size:
            return matrix
        corner = [[matrix[i : i + 3, j : j + 3] for j in (0, 6)] for i in (0, 6)]
        return jnp.block(corner)

    def step(carry, inputs):
        state, covariance = carry
        interval, sample, row = inputs
        nothing = jnp.zeros(size, covariance.dtype)
        mean, covariance, cost, _ = update_rows(nothing, covariance, state, row)
        unseen = jnp.zeros(9 - size, mean.dtype)
        state = add_error(state, jnp.concatenate([mean[:3], unseen, mean[3:]]))
        transition = error_transition(state.q_nb, interval).forth
        noise = part(sample_noise(state.q_nb, sample.signal, sample.period, sample.variance))
        _, predicted = kalman.predict(nothing, covariance, transition, nothing, noise)
        return (advance(state, interval, gravity), predicted), ((state, covariance), cost)

    intervals = sample_intervals(samples.signal, samples.period)
    last, (corrected, cost) = jax.lax.scan(step, (prior, part(prior_covariance)), (intervals, samples, rows))
    state, covariance = jax.tree.map(lambda xs, x: jnp.concatenate([xs, x[None]]), corrected, last)
    return Filtered(state, covariance, cost)


def linearised(
    reference: NavState, samples: Samples, gravity: Float[Array, ""]
) -> tuple[NavState, Interval, Float[Array, "N 9"]]:
    """Of N+1 reference states: those at the starts of samples, the samples as intervals, and the defects.

    A defect is the error by which the reference does not follow its sample; zero for a strapdown.
    """
    intervals = sample_intervals(samples.signal, samples.period)
    start = jax.tree.map(lambda x: x[:-1], reference)
    end = jax.tree.map(lambda x: x[1:], reference)
    defects = jax.vmap(lambda a, i, b: error_between(advance(a, i, gravity), b))(start, intervals, end)
    return start, intervals, defects


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
    start, intervals, offsets = linearised(reference, samples, gravity)

    def forward(carry, inputs):
        mean, covariance, cost = carry
        state, interval, sample, offset, known = inputs
        mean, covariance, extra, row = update_rows(mean, covariance, state, known)
        predicted = kalman.predict(
            mean,
            covariance,
            error_transition(state.q_nb, interval).forth,
            offset,
            sample_noise(state.q_nb, sample.signal, sample.period, sample.variance),
        )
        return (*predicted, cost + extra), (mean, covariance, row)

    # Where no height is observed nothing that comes later depends on position.
    seen = slice(0, 9) if rows.height is not None else np.array([0, 1, 2, *VELOCITY])
    size = 6 if rows.height is None else 9

    def backward(adjoint, inputs):
        state, interval, mean, covariance, row = inputs
        adjoint = kalman.adjoint_transition(adjoint, error_transition(state.q_nb, interval).back)
        smoothed = kalman.condition_on_future(mean, covariance, covariance[:, seen], adjoint)
        multiplier = None
        for index, done in reversed(list(zip(_observed(rows, size), row, strict=True))):
            adjoint, pull = kalman.adjoint_row(adjoint, index, done.gain[seen], done)
            multiplier = pull if size == 9 and index == HEIGHT else multiplier
        return adjoint, (*smoothed, multiplier)

    initial_error = error_between(prior, jax.tree.map(lambda x: x[0], reference))
    zero = jnp.zeros_like(gravity)
    (last_mean, last_covariance, cost), (mean, covariance, row) = jax.lax.scan(
        forward,
        (initial_error, prior_covariance, zero),
        (start, intervals, samples, offsets, rows),
    )
    nothing = kalman.Adjoint(jnp.zeros(size, last_mean.dtype), jnp.zeros((size, size), last_mean.dtype))
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
    reference = closed_loop(samples, rows, prior, prior_covariance, gravity).state
    first = smooth_about(reference, samples, rows, prior, prior_covariance, gravity)
    return jax.lax.fori_loop(
        0,
        relinearisations,
        lambda _, s: smooth_about(s.state, samples, rows, prior, prior_covariance, gravity),
        first,
    )


def displacement_covariance(
    start: NavState,
    covariance: Float[Array, "N 9 9"],
    samples: Samples,
    rows: Rows,
    prior_covariance: Float[Array, "9 9"],
    departure: Int[Array, "S"],
    arrival: Int[Array, "S"],
) -> Float[Array, "S 3 3"]:
    """How well the way r(arrival) − r(departure) of each motion is known (m²), given all rows.

    start, covariance: smoothed, at the start of each sample; by the same samples and rows, none of them a height. No
    row may lie between departure and arrival, and motions follow one another.
    """
    begins = jnp.zeros(len(samples.period), bool).at[departure].set(True)
    moves = jnp.ones(9, bool).at[3:6].set(False)

    # Position that starts at zero with each motion: nothing observes it, so nothing else changes.
    def step(known, inputs):
        state, interval, sample, row, begin = inputs
        _, after, _, _ = update_rows(jnp.zeros(9), known, state, row)
        after = jnp.where(begin & ~(moves[:, None] & moves[None]), 0.0, after)
        noise = sample_noise(state.q_nb, sample.signal, sample.period, sample.variance)
        _, predicted = kalman.predict(
            jnp.zeros(9), after, error_transition(state.q_nb, interval).forth, jnp.zeros(9), noise
        )
        return predicted, known

    intervals = sample_intervals(samples.signal, samples.period)
    _, before = jax.lax.scan(step, prior_covariance, (start, intervals, samples, rows, begins))

    # What comes after the motion tells of its way by attitude and velocity on arrival only.
    def at_arrival(before, after):
        motion = jnp.asarray((0, 1, 2, *VELOCITY))
        known = before[motion][:, motion]
        gain = solve_positive(known, before[motion, 3:6]).T
        return before[3:6, 3:6] - gain @ (known - after[motion][:, motion]) @ gain.T

    return jax.vmap(at_arrival)(before[arrival], covariance[arrival])


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
    assert candidates is not None, "there are heights to keep"
    zero = jnp.zeros_like(rows.height_variance)

    def solve(active):
        exact = Rows(rows.rest, rows.velocity_variance, active, zero, rows.velocity)
        smoothed = smooth(samples, exact, prior, prior_covariance, gravity, relinearisations)
        low = smoothed.state.position[:-1, 2] < -tolerance
        assert smoothed.height_multiplier is not None
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
