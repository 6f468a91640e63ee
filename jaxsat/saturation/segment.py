"""The objective of one segment: how badly the rest after a motion fits the filled signal (paper A, Eq. 15-18).

A segment is departure (a known state) → moving samples, no row → arrival (rest samples). Two closed forms make
f(δ) cheap and exact; the sample-by-sample filter is their oracle in the tests:

1. The moving samples collapse into one interval, and what lies between saturated samples does so once for all δ.
2. The arrival is a fixed quadratic. In the body frame at arrival the rest samples are the same whatever δ is;
   only the velocity and the direction of gravity on arrival depend on it. With m = [θ, v̂ + v_e] and γ = [g; 1]
   in that frame, the rows of the rest cost ½ [m; γ]ᵀ Λ [m; γ], and Λ is built once per recording.

The minimum over m with the arriving covariance P needs no inverse of P, so singular priors are fine:
f = ½ mᵀΛ_mm m + mᵀh + ½ γᵀΛ_γγ γ − ½ uᵀ(I + P Λ_mm)⁻¹P u, with h = Λ_mγ γ and u = Λ_mm m + h at the mean.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial import kalman
from jaxsat.inertial.preintegration import alternate, input_effects, remainders, stretches
from jaxsat.inertial.rotations import quat_conjugate, quat_multiply, quat_rotate, quat_to_matrix, skew
from jaxsat.inertial.smoother import HEIGHT, Rows
from jaxsat.inertial.strapdown import (
    Interval,
    Moments,
    NavState,
    Samples,
    advance,
    error_transition,
    noise_covariance,
    rotate_noise,
    sample_intervals,
    sample_noise,
)
from jaxsat.saturation.gap_shapes import Edges

# Position is not seen by a velocity row, so the arrival speaks of [θ, v] only.
_SEEN = np.array([0, 1, 2, 6, 7, 8])


class Segment(eqx.Module):
    """One motion between two rests, padded: n moving samples, m saturated values."""

    signal: Float[Array, "n 6"]
    """As measured, from the departure sample on (rad/s, m/s²)."""
    period: Float[Array, "n"]
    """Sampling period; zero pads (s)."""
    variance: Float[Array, "n 2"]
    """Per-sample noise variance of a gyroscope and of an accelerometer axis."""
    cut: Int[Array, "M"]
    """Samples with a saturated value, ascending; n pads."""
    element: Int[Array, "m"]
    """Which of `cut` a saturated value belongs to."""
    channel: Int[Array, "m"]
    """Which channel."""
    sign: Float[Array, "m"]
    """Direction of the rail: the true value is signal + sign·δ with 0 ≤ δ ≤ bound; zero pads."""
    bound: Float[Array, "m"]
    """δ_b (rad/s or m/s²)."""
    gap: Int[Array, "m"]
    """Which of the segment's gaps a saturated value belongs to."""
    edges: Edges
    """Edges of each gap, time in samples of the segment; padded."""
    departure: NavState
    """State at the start of sample 0."""
    departure_covariance: Float[Array, "9 9"]
    arrival: Float[Array, "10 10"]
    """Λ over [m (6), γ (4)]; zeros where no rest follows."""
    height: Bool[Array, ""]
    """Whether the arrival is at height zero."""
    height_variance: Float[Array, ""]


class Condensed(eqx.Module):
    """A segment as f(δ) sees it: saturated samples, and between them stretches that do not depend on δ.

    Element j is stretch j followed by saturated sample j; the last sample is a blank one.
    """

    stretches: Interval
    """M+1 of them."""
    noise: Moments
    """Of the stretches."""
    signal: Float[Array, "M1 6"]
    period: Float[Array, "M1"]
    variance: Float[Array, "M1 2"]
    segment: Segment


def condense(segment: Segment) -> Condensed:
    """Collapse what lies between the saturated samples; done once per segment."""

    def pick(x):
        return jnp.concatenate([x.at[segment.cut].get(mode="fill", fill_value=0), jnp.zeros_like(x[:1])])

    between, noise = stretches(segment.signal, segment.period, segment.variance, segment.cut)
    return Condensed(
        stretches=between,
        noise=noise,
        signal=pick(segment.signal),
        period=pick(segment.period),
        variance=pick(segment.variance),
        segment=segment,
    )


def _fill(condensed: Condensed, delta: Float[Array, "m"]) -> tuple[Interval, Moments, Float[Array, "M1 6"]]:
    """The compensated signal ȳ = y + s·δ (Eq. 17) with the elements' prefixes and the noise of them all."""
    segment = condensed.segment
    signal = condensed.signal.at[segment.element, segment.channel].add(segment.sign * delta)
    upto, noise = alternate(
        condensed.stretches, condensed.noise, signal, condensed.period, condensed.variance
    )
    return upto, noise, signal


def _arrive(segment: Segment, upto: Interval, noise: Moments, gravity: Float[Array, ""]):
    """State, mean error, covariance on arrival and the cost of the height row, if there is one."""
    start = segment.departure
    interval = jax.tree.map(lambda x: x[-1], upto)
    state = advance(start, interval, gravity)
    zero = jnp.zeros(9, gravity.dtype)
    mean, covariance = kalman.predict(
        zero,
        segment.departure_covariance,
        error_transition(start.q_nb, interval),
        zero,
        rotate_noise(start.q_nb, noise_covariance(noise)),
    )
    mean, covariance, cost, _ = kalman.update_row(
        mean, covariance, HEIGHT, -state.position[2], segment.height_variance, segment.height
    )
    return state, mean, covariance, cost


def objective(delta: Float[Array, "m"], condensed: Condensed, gravity: Float[Array, ""]) -> Float[Array, ""]:
    """f(δ) of Eq. 18: the inner minimum J* over departure, moving samples and the rest that follows."""
    segment = condensed.segment
    upto, noise, _ = _fill(condensed, delta)
    state, mean, covariance, cost = _arrive(segment, upto, noise, gravity)
    to_body = quat_conjugate(state.q_nb)
    mean = jnp.concatenate([quat_rotate(to_body, mean[:3]), quat_rotate(to_body, state.velocity + mean[6:])])
    P = rotate_noise(to_body, covariance)[_SEEN][:, _SEEN]
    down = jnp.zeros(3, gravity.dtype).at[2].set(gravity)
    gamma = jnp.concatenate([quat_rotate(to_body, down), jnp.ones(1, gravity.dtype)])
    information, cross, constant = segment.arrival[:6, :6], segment.arrival[:6, 6:], segment.arrival[6:, 6:]
    slope = cross @ gamma
    u = information @ mean + slope
    gained = jnp.linalg.solve(jnp.eye(6, dtype=P.dtype) + P @ information, P @ u)
    return (
        cost
        + 0.5 * mean @ (information @ mean)
        + mean @ slope
        + 0.5 * gamma @ (constant @ gamma)
        - 0.5 * u @ gained
    )


def arrival_sensitivity(
    delta: Float[Array, "m"], condensed: Condensed, gravity: Float[Array, ""]
) -> tuple[Float[Array, "m 6"], Float[Array, "6 6"]]:
    """Gauss-Newton factors of f at δ: rows ∂[θ, v]/∂δ_i on arrival, and the information M that weighs them.

    The Hessian of f is rows M rowsᵀ up to second derivatives; M = Λ_mm (I + P Λ_mm)⁻¹.
    """
    segment = condensed.segment
    upto, noise, signal = _fill(condensed, delta)
    state, _, covariance, _ = _arrive(segment, upto, noise, gravity)
    effects = input_effects(remainders(upto), signal, condensed.period, segment.element, segment.channel)
    columns = segment.sign[:, None] * effects
    R = quat_to_matrix(quat_multiply(quat_conjugate(state.q_nb), segment.departure.q_nb))
    rows = jnp.concatenate([columns[:, :3] @ R.T, columns[:, 6:] @ R.T], axis=1)
    P = rotate_noise(quat_conjugate(state.q_nb), covariance)[_SEEN][:, _SEEN]
    information = segment.arrival[:6, :6]
    weight = jnp.linalg.solve(jnp.eye(6, dtype=P.dtype) + information @ P, information)
    return rows, 0.5 * (weight + weight.T)


def arrivals(
    samples: Samples,
    rows: Rows,
    segment_at: Int[Array, "N"],
    starts: Bool[Array, "N"],
    count: int,
) -> Float[Array, "S 10 10"]:
    """Λ of each of `count` segments from one pass over the recording (§ arrival of the module's docstring).

    segment_at: the segment whose arrival rest sample k belongs to;
    starts: first sample of each arrival. The pass is the forward filter from an exactly known, symbolic
    arrival: its mean is a matrix over [m, γ], so each innovation is a row and Λ the sum of their squares.
    """
    eye6, zero3 = jnp.eye(6), jnp.zeros((3, 3))
    symbolic = jnp.eye(6, 10)

    def step(carry, inputs):
        q, mean, P, table = carry
        interval, sample, rest, segment, start = inputs
        q = jnp.where(start, jnp.array([1.0, 0.0, 0.0, 0.0]), q)
        mean = jnp.where(start, symbolic, mean)
        P = jnp.where(start, 0.0, P)
        gathered = jnp.zeros((10, 10))
        for index in (3, 4, 5):
            column = P[:, index]
            weight = jnp.where(rest, 1.0 / (column[index] + rows.velocity_variance), 0.0)
            innovation = -mean[index]
            gathered = gathered + weight * jnp.outer(innovation, innovation)
            mean = mean + weight * jnp.outer(column, innovation)
            P = P - weight * jnp.outer(column, column)
        table = table.at[segment].add(jnp.where(rest, gathered, 0.0))
        force = quat_rotate(q, interval.velocity)
        transition = jnp.block([[eye6[:3]], [-skew(force), jnp.eye(3)]])
        gain = jnp.concatenate(
            [
                jnp.zeros((3, 10)),
                jnp.concatenate([zero3, zero3, -interval.duration * jnp.eye(3), force[:, None]], 1),
            ]
        )
        noise = sample_noise(q, sample.signal, sample.period, sample.variance)[_SEEN][:, _SEEN]
        return (
            quat_multiply(q, interval.rotation),
            transition @ mean + gain,
            transition @ P @ transition.T + noise,
            table,
        ), None

    intervals = sample_intervals(samples.signal, samples.period)
    carry = (jnp.array([1.0, 0.0, 0.0, 0.0]), symbolic, jnp.zeros((6, 6)), jnp.zeros((count, 10, 10)))
    (_, _, _, table), _ = jax.lax.scan(
        step, carry, (intervals, samples, rows.rest & (segment_at >= 0), segment_at, starts)
    )
    return table
