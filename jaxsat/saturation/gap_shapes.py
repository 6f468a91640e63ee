"""Method 2: the shape of a gap from its height (paper A, Section 4.2).

Everything is in the direction of the rail (values times its sign), time in samples. Two lines leave the gap's
edges with the slopes there; they meet at the peak (t_m, x_m). Eq. 21 is misprinted; with lines
ξ(k) + ξ'(k)(t − k) and g(h) + g'(h)(t − h) the intersection is
t_m = k + [g(h) − ξ(k) − (h − k) g'(h)] / [ξ'(k) − g'(h)],  x_m = ξ(k) + (t_m − k) ξ'(k).
"""

from typing import Literal

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

Shape = Literal["triangle", "quadratic"]


def gap_ends(sign: Int[Array, "N 6"]) -> tuple[Bool[Array, "N 6"], Bool[Array, "N 6"]]:
    """Of the values that saturate, the first and the last of each gap: of neighbours that do so in one direction."""
    still = jnp.zeros_like(sign[:1])
    begins = (sign != 0) & (sign != jnp.concatenate([still, sign[:-1]]))
    ends = (sign != 0) & (sign != jnp.concatenate([sign[1:], still]))
    return begins, ends


class Edges(eqx.Module):
    """The last sample before a gap (k) and the first after it (h), with slopes per sample."""

    k: Float[Array, "*gaps"]
    h: Float[Array, "*gaps"]
    left: Float[Array, "*gaps"]
    right: Float[Array, "*gaps"]
    left_slope: Float[Array, "*gaps"]
    right_slope: Float[Array, "*gaps"]
    rail: Float[Array, "*gaps"]
    """Highest measured value in the gap."""
    sound: Bool[Array, "*gaps"]
    """Three clean samples lie on each side, so the slopes mean something."""


class Peak(eqx.Module):
    """Where the two lines meet."""

    time: Float[Array, "*gaps"]
    height: Float[Array, "*gaps"]
    from_slopes: Bool[Array, "*gaps"]
    """False where a guard replaced the intersection by the middle of the gap and the given highest value."""


def edge_slope(
    near: Float[Array, "*gaps"], next_: Float[Array, "*gaps"], far: Float[Array, "*gaps"]
) -> Float[Array, "*gaps"]:
    """Slope away from the gap, at its edge, of the parabola through three samples (per sample)."""
    return (-3.0 * near + 4.0 * next_ - far) / 2.0


def peak(edges: Edges, highest: Float[Array, "*gaps"]) -> Peak:
    """Corrected Eq. 21 with its guards.

    highest: the most that the peak may reach (rail + δ_b). The intersection is used where the slopes are
    sound and opposed and it lies inside the gap and above the rail; elsewhere the peak time is the middle of
    the gap and the height is free up to `highest`.
    """
    opposed = (edges.left_slope > 0.0) & (edges.right_slope < 0.0)
    closing = jnp.where(opposed, edges.left_slope - edges.right_slope, 1.0)
    span = edges.h - edges.k
    time = edges.k + (edges.right - edges.left - span * edges.right_slope) / closing
    height = edges.left + (time - edges.k) * edges.left_slope
    usable = edges.sound & opposed & (time > edges.k) & (time < edges.h) & (height > edges.rail)
    return Peak(
        time=jnp.where(usable, time, 0.5 * (edges.k + edges.h)),
        height=jnp.where(usable, jnp.minimum(height, highest), highest),
        from_slopes=usable,
    )


def shape_value(
    shape: Shape,
    t: Float[Array, "*n"],
    edges: Edges,
    time: Float[Array, "*n"],
    height: Float[Array, "*n"],
) -> Float[Array, "*n"]:
    """Value at t of the triangle (Eq. 22) or parabola through both edges and the peak; arguments broadcast.

    A parabola whose vertex is not at `time` would rise above its own peak: it is cut at `height`.
    """
    before, after = time - edges.k, edges.h - time
    if shape == "triangle":
        rising = edges.left + (height - edges.left) / before * (t - edges.k)
        falling = edges.right + (height - edges.right) / after * (edges.h - t)
        return jnp.where(t < time, rising, falling)
    span = edges.h - edges.k
    value = (
        edges.left * (t - time) * (t - edges.h) / (before * span)
        + height * (t - edges.k) * (edges.h - t) / (before * after)
        + edges.right * (t - edges.k) * (t - time) / (span * after)
    )
    return jnp.minimum(value, height)
