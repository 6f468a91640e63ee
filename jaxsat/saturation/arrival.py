"""What the rest after a segment says about the state that arrives there, as one quadratic (paper A, Eq. 12-15).

In the body frame at arrival the rest samples do not depend on δ; the velocity and the direction of gravity there
do. With m = [θ, v̂ + v_e] and γ = [g; 1] in that frame the rows of the rest cost ½ [m; γ]ᵀ Λ [m; γ].
"""

from collections.abc import Iterator

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxsat.inertial.dense import eigh
from jaxsat.inertial.programs import stored_jit
from jaxsat.inertial.rotations import quat_multiply, quat_rotate, skew
from jaxsat.inertial.smoother import Rows
from jaxsat.inertial.strapdown import Samples, sample_interval, sample_noise
from jaxsat.saturation.layout import LANES, Trial, evenly, pad, padded_lanes
from jaxsat.signals.rests import Segments

# Position is not seen by a velocity row, so the arrival speaks of [θ, v] only.
_SEEN = np.array([0, 1, 2, 6, 7, 8])


def arrivals(
    samples: Samples,
    rows: Rows,
    start: Int[Array, "S"],
    end: Int[Array, "S"],
    longest: Int[Array, ""] | int,
) -> Float[Array, "S 10 10"]:
    """Λ of each arrival, whose rest samples are [start, end); zeros where there are none.

    longest: of the rests, in samples. All rests are passed side by side by the forward filter from an exactly
    known, symbolic arrival: its mean is a matrix over [m, γ], so each innovation is a row and Λ the sum of
    their squares.
    """
    count = len(samples.period)

    def one(carry, at, end):
        q, mean, P, table = carry
        here = jnp.minimum(at, count - 1)
        signal, period, variance = (x[here] for x in (samples.signal, samples.period, samples.variance))
        rest = (at < end) & rows.rest[here]
        moves = None if rows.velocity is None else quat_rotate(q, rows.velocity[here])
        for index in (3, 4, 5):
            column = P[:, index]
            weight = jnp.where(rest, 1.0 / (column[index] + rows.velocity_variance[here]), 0.0)
            innovation = -mean[index]
            if moves is not None:
                innovation = innovation.at[9].add(moves[index - 3])
            table = table + weight * jnp.outer(innovation, innovation)
            mean = mean + weight * jnp.outer(column, innovation)
            P = P - weight * jnp.outer(column, column)
        interval = sample_interval(signal, period)
        force = quat_rotate(q, interval.velocity)
        lift = -skew(force)
        # Φ = [[I, 0], [−[F×], I]], row by row.
        fallen = jnp.concatenate([jnp.zeros((3, 6)), -period * jnp.eye(3), force[:, None]], axis=1)
        mean = jnp.concatenate([mean[:3], mean[3:] + lift @ mean[:3] + fallen])
        top, below = P[:3], P[3:] + lift @ P[:3]
        P = jnp.concatenate(
            [
                jnp.concatenate([top[:, :3], top[:, 3:] + top[:, :3] @ lift.T], axis=1),
                jnp.concatenate([below[:, :3], below[:, 3:] + below[:, :3] @ lift.T], axis=1),
            ]
        )
        P = P + sample_noise(q, signal, period, variance)[_SEEN][:, _SEEN]
        return quat_multiply(q, interval.rotation), mean, P, table

    blank = (jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.eye(6, 10), jnp.zeros((6, 6)), jnp.zeros((10, 10)))
    lanes = jax.tree.map(lambda x: jnp.broadcast_to(x, (len(start), *x.shape)), blank)
    return jax.lax.fori_loop(0, longest, lambda k, c: jax.vmap(one)(c, start + k, end), lanes)[3]


@stored_jit
def _arrivals(trial: Trial, start, end, longest):
    return arrivals(Samples(trial.signal, trial.period, trial.variance), trial.rows, start, end, longest)


def arrival_table(trial: Trial, segments: Segments) -> Float[np.ndarray, "S 10 10"]:
    """Λ of every segment's arrival; zeros where no rest follows. Independent of δ: rests do not saturate."""
    # A segment without a departure has no known start, so its arrival tells nothing about it.
    length = np.where(segments.departure >= 0, segments.rest_end - segments.arrival, 0)
    table = np.zeros((len(segments), 10, 10))
    for mine in _alike(np.argsort(length), length):
        lanes = padded_lanes(len(mine))
        start, steps = pad(segments.arrival[mine], lanes), pad(length[mine], lanes)
        table[mine] = np.asarray(_arrivals(trial, start, start + steps, steps.max()))[: len(mine)]
    return table


def _alike(order: Int[np.ndarray, "S"], length: Int[np.ndarray, "S"]) -> Iterator[Int[np.ndarray, "L"]]:
    """Rests of like length, to pass side by side: all wait for the longest, so a few that are long go apart.

    order: by length.
    """

    def cost(part):
        # A step takes as long as 6 lanes of it, on a CPU.
        return length[part[-1]] * (6 + padded_lanes(len(part))) if len(part) else 0

    for part in evenly(order, 2 * LANES):
        ways = [np.split(part, [len(part) - apart]) for apart in (0, 1, 4, 8, 16) if apart <= len(part)]
        yield from (some for some in min(ways, key=lambda way: sum(map(cost, way))) if len(some))


def own_misfit(arrival: Float[Array, "10 10"]) -> Float[Array, ""]:
    """What the samples of a rest cost however the motion arrives: the least of ½ [x; 1]ᵀ Λ [x; 1] over attitude,
    velocity and gravity."""
    values, vectors = eigh(arrival[:9, :9])
    along = vectors.T @ arrival[:9, 9]
    # Turning about gravity is not seen, and a tilt not told from a turned gravity.
    seen = values > 1e-12 * jnp.max(values)
    gained = jnp.sum(jnp.where(seen, along**2 / jnp.where(seen, values, 1.0), 0.0))
    return 0.5 * jnp.maximum(arrival[9, 9] - gained, 0.0)
