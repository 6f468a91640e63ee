"""What the rest after a segment says about the state that arrives there, as one quadratic (paper A, Eq. 12-15).

In the body frame at arrival the rest samples do not depend on δ; the velocity and the direction of gravity there
do. With m = [θ, v̂ + v_e] and γ = [g; 1] in that frame the rows of the rest cost ½ [m; γ]ᵀ Λ [m; γ].
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.rotations import quat_multiply, quat_rotate, skew
from jaxsat.inertial.smoother import Rows
from jaxsat.inertial.strapdown import Samples, sample_intervals, sample_noise

# Position is not seen by a velocity row, so the arrival speaks of [θ, v] only.
_SEEN = np.array([0, 1, 2, 6, 7, 8])


def arrivals(
    samples: Samples,
    rows: Rows,
    segment_at: Int[Array, "N"],
    starts: Bool[Array, "N"],
    count: int,
) -> Float[Array, "S 10 10"]:
    """Λ of each of `count` segments from one pass over the recording.

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
