"""From a recording to its segments: which saturated values and gaps belong where, gathered and padded."""

from typing import Any, NamedTuple

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxsat.inertial.calibration import Calibration, corrected
from jaxsat.inertial.smoother import Rows
from jaxsat.inertial.strapdown import NavState
from jaxsat.saturation.gap_shapes import Edges, edge_slope, gap_ends
from jaxsat.saturation.prior import SignalPrior, of_values
from jaxsat.saturation.segment import Segment
from jaxsat.signals.rests import Segments

# Arrays of NumPy at the border, of JAX inside; shapes and types are checked, the kind is not.
Arrays = Any


class Trial(eqx.Module):
    """Everything that the smoother and the segments of one recording need, in numbers."""

    signal: Float[Arrays, "N 6"]
    period: Float[Arrays, "N"]
    variance: Float[Arrays, "N 6"]
    sign: Int[Arrays, "N 6"]
    """Direction of saturation, 0 where there is none."""
    clean: Bool[Arrays, "N 6"]
    """Measured and not saturated."""
    bound: Float[Arrays, "6"]
    """δ_b of each channel."""
    rows: Rows
    prior: NavState
    prior_covariance: Float[Arrays, "p p"]
    gravity: Float[Arrays, ""]

    def on_ground(self, rests: Bool[Arrays, "N"] | None) -> "Trial":
        """With heights of zero at these rests; None leaves it as it is."""
        if rests is None:
            return self
        return eqx.tree_at(lambda t: t.rows.height, self, jnp.asarray(rests), is_leaf=lambda x: x is None)

    @property
    def unfilled_variance(self) -> Float[Arrays, "N 6"]:
        """Of a saturated value while δ is 0: the second moment about that end of what its bounds leave."""
        numbers = np if isinstance(self.sign, np.ndarray) else jnp
        return numbers.where(self.sign != 0, self.bound[None] ** 2 / 3.0, 0.0)

    def calibrated(self, calibration: Calibration) -> "Trial":
        """Without the biases, and resting about the point that stands still."""
        found = corrected(*map(jnp.asarray, (self.signal, calibration.constants)))
        return eqx.tree_at(lambda t: (t.signal, t.rows.velocity), self, found, is_leaf=lambda x: x is None)

    def padded(self) -> "Trial":
        """With blank samples behind the end, to a length that recordings of about the same length share."""
        count = len(self.signal)
        size = 256
        while size < count:
            # 256, 384, 512, 768, …: a third is wasted at most.
            size = size * 3 // 2 if size & (size - 1) == 0 else size * 4 // 3
        extra = {name: pad(np.asarray(getattr(self, name)), size) for name in _SAMPLED}
        rows = jax.tree.map(lambda x: pad(np.asarray(x), size), self.rows)
        return eqx.tree_at(
            lambda t: (*(getattr(t, name) for name in _SAMPLED), t.rows), self, (*extra.values(), rows)
        )


_SAMPLED = ("signal", "period", "variance", "sign", "clean")


# So many segments are dealt with at once at most, and as many on each other core; more would gain nothing on a CPU
# and wait for the slowest.
LANES = 32


def evenly(indices: Int[np.ndarray, "S"], most: int) -> list[Int[np.ndarray, "L"]]:
    """In the fewest parts of at most so many."""
    return np.array_split(indices, max(1, -(-len(indices) // most)))


def padded_lanes(count: int) -> int:
    """A few numbers, so that few programs are compiled: 1, 4, 8, 16, 24, …"""
    return bucket(count, 1) if count <= 4 else -(-count // 8) * 8


class Sizes(NamedTuple):
    """Padded lengths of a segment; equal ones share a compiled program."""

    samples: int
    values: int


def bucket(count: int, smallest: int, factor: int = 4) -> int:
    """`smallest` times a power of `factor`: coarse steps, so shapes are shared and few programs are compiled."""
    size = smallest
    while size < count:
        size *= factor
    return size


def padded_sizes(samples: int, values: int, factor: int = 4) -> Sizes:
    """For segments of at most so many samples and saturated values; a smaller factor wastes and shares less."""
    padded = bucket(values, 16, factor)
    # `map` factorises matrices of that size: where they are large, what padding wastes counts.
    return Sizes(bucket(samples, 256, factor), padded if padded <= 64 else bucket(values, 64, 2))


def pad(x: np.ndarray, size: int) -> np.ndarray:
    """Zeros behind the leading axis up to `size`."""
    return np.concatenate([x, np.zeros((size - len(x), *x.shape[1:]), x.dtype)])


def count_values(
    sign: Int[np.ndarray, "N 6"], segments: Segments
) -> tuple[Int[np.ndarray, "S"], Int[np.ndarray, "S"]]:
    """Samples and saturated values of each segment."""
    total = np.concatenate([[0], np.cumsum((sign != 0).sum(axis=1))])
    start = np.maximum(segments.departure, 0)
    return segments.arrival - start, total[segments.arrival] - total[start]


class Ends(eqx.Module):
    """What is known at both ends of a segment, or of several along a leading axis."""

    departure: Int[Arrays, "*L"]
    """Its first sample; negative for none."""
    arrival: Int[Arrays, "*L"]
    """The one after its last."""
    state: NavState
    """Of the filter at departure."""
    covariance: Float[Arrays, "*L s s"]
    """Of that state."""
    table: Float[Arrays, "*L 10 10"]
    """Λ of the arrival."""


class Values(eqx.Module):
    """Where the saturated values of a segment lie in the recording; a padded one lies behind its end."""

    sample: Int[Array, "m"]
    channel: Int[Array, "m"]


def gather(
    trial: Trial,
    ends: Ends,
    sizes: Sizes,
    prior: SignalPrior | None = None,
    filled: Float[Array, "N 6"] | None = None,
) -> tuple[Segment, Values]:
    """One segment, padded.

    prior: of the signal, for `map`; filled: the signal to begin with, as measured if it is not given.
    """
    n, m = sizes
    count, arrival, covariance, table = len(trial.signal), ends.arrival, ends.covariance, ends.table
    start = jnp.maximum(ends.departure, 0)
    at = start + jnp.arange(n)
    inside = at < arrival
    safe = jnp.minimum(at, count - 1)

    def window(x):
        x = jnp.asarray(x)[safe]
        return jnp.where(inside.reshape(-1, *[1] * (x.ndim - 1)), x, 0)

    signal, sign, variance = window(trial.signal), window(trial.sign), window(trial.variance)
    saturated = sign != 0
    (cut,) = jnp.nonzero(jnp.any(saturated, axis=1), size=m, fill_value=n)
    (place,) = jnp.nonzero(saturated.reshape(-1), size=m, fill_value=6 * n)
    valid = place < 6 * n
    sample, channel = jnp.where(valid, place // 6, 0), jnp.where(valid, place % 6, 0)
    gap, edges = _gaps(trial, signal, sign, start, sample, channel, valid, m)
    height = None
    if trial.rows.height is not None:
        height = (arrival < count) & jnp.asarray(trial.rows.height)[jnp.minimum(arrival, count - 1)]
    place = Values(jnp.where(valid, start + sample, count), channel)
    way = jnp.where(valid, sign[sample, channel], 0).astype(signal.dtype)
    known, height_variance = None, jnp.asarray(trial.rows.height_variance)[jnp.clip(arrival, 0, count - 1)]
    if prior is not None:
        noise = prior.experience.noise
        variance, covariance, height_variance = (noise * x for x in (variance, covariance, height_variance))
        table = table / noise
        known = of_values(prior, jnp.asarray(trial.signal), start + sample, channel, way, gap)
    begin = jnp.zeros(m, signal.dtype)
    if filled is not None:
        begin = way * (jnp.asarray(filled)[start + sample, channel] - signal[sample, channel])
    segment = Segment(
        signal=signal,
        period=window(trial.period),
        # One variance for the three axes of a sensor, on the safe side where they differ.
        variance=variance.reshape(n, 2, 3).max(axis=2),
        cut=cut,
        element=jnp.where(valid, jnp.searchsorted(cut, sample), 0),
        channel=channel,
        sign=way,
        bound=jnp.where(valid, jnp.asarray(trial.bound)[channel], 0.0),
        start=begin,
        gap=gap,
        edges=edges,
        departure=ends.state,
        departure_covariance=covariance,
        arrival=table,
        height=height,
        height_variance=height_variance,
        known=known,
    )
    return segment, place


def _gaps(trial: Trial, signal, sign, start, sample, channel, valid, size: int):
    """The gap of each saturated value, and the edges of each gap in the direction of its rail.

    Slopes come from the three samples beside a gap (Section 4.2); they are sound only where all three were
    measured, lie inside the recording and do not saturate themselves, and where the gap has two samples.
    """
    n, count = len(signal), len(trial.signal)
    begins, ends = gap_ends(sign)
    # Channel after channel, so that the i-th beginning and the i-th end are those of the same gap.
    number = jnp.cumsum(begins.T.reshape(-1)).reshape(6, n) - 1
    (first,) = jnp.nonzero(begins.T.reshape(-1), size=size, fill_value=6 * n)
    (last,) = jnp.nonzero(ends.T.reshape(-1), size=size, fill_value=6 * n)
    real = first < 6 * n
    axis, first, last = jnp.where(real, first // n, 0), first % n, last % n
    way = sign[first, axis].astype(signal.dtype)
    gap = jnp.where(valid, number[channel, sample], size - 1)
    value = jnp.where(valid, signal[sample, channel] * sign[sample, channel].astype(signal.dtype), -jnp.inf)
    rail = jnp.full(size, -jnp.inf, signal.dtype).at[gap].max(value)
    offsets = jnp.arange(1, 4)
    before = start + first[:, None] - offsets[None]
    after = start + last[:, None] + offsets[None]
    whole = (before >= 0).all(1) & (after < count).all(1)
    before, after = jnp.maximum(before, 0), jnp.minimum(after, count - 1)
    original, clean = jnp.asarray(trial.signal), jnp.asarray(trial.clean)
    left = way[:, None] * original[before, axis[:, None]]
    right = way[:, None] * original[after, axis[:, None]]
    sound = clean[before, axis[:, None]].all(1) & clean[after, axis[:, None]].all(1)
    fields = (
        (first - 1).astype(signal.dtype),
        (last + 1).astype(signal.dtype),
        jnp.minimum(left[:, 0], rail),
        jnp.minimum(right[:, 0], rail),
        -edge_slope(*left.T),
        edge_slope(*right.T),
        rail,
    )
    # A padded gap is a flat one without samples.
    blank = (0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0)
    edges = Edges(
        *(jnp.where(real, field, empty) for field, empty in zip(fields, blank, strict=True)),
        sound=real & whole & sound & (last > first),
    )
    return gap, edges
