"""From a recording to its segments: which saturated values and gaps belong where, gathered and padded."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Bool, Float, Int

from jaxsat.inertial.smoother import Rows
from jaxsat.inertial.strapdown import NavState
from jaxsat.saturation.gap_shapes import Edges, edge_slope
from jaxsat.saturation.segment import Segment
from jaxsat.signals.rails import Gaps
from jaxsat.signals.rests import Segments


class Trial(eqx.Module):
    """Everything that the smoother and the segments of one recording need, in numbers."""

    signal: Float[np.ndarray, "N 6"]
    period: Float[np.ndarray, "N"]
    variance: Float[np.ndarray, "N 6"]
    sign: Int[np.ndarray, "N 6"]
    """Direction of saturation, 0 where there is none."""
    clean: Bool[np.ndarray, "N 6"]
    """Measured and not saturated."""
    bound: Float[np.ndarray, "6"]
    """δ_b of each channel."""
    rows: Rows
    prior: NavState
    prior_covariance: Float[np.ndarray, "9 9"]
    gravity: Float[np.ndarray, ""]

    @property
    def fill_variance(self) -> Float[np.ndarray, "N 6"]:
        """Variance of a filled value of which only the bounds are known: uniform in 0 ≤ δ ≤ δ_b."""
        return np.where(self.sign != 0, self.bound**2 / 12.0, 0.0)


class Layout(eqx.Module):
    """Segments, gaps and saturated values of a recording in the order of time, so each segment is a slice."""

    segments: Segments
    edges: Float[np.ndarray, "G 8"]
    """Of each gap the fields of `Edges`, time in samples of the recording."""
    gap_segment: Int[np.ndarray, "G"]
    """The segment of each gap; does not decrease."""
    sample: Int[np.ndarray, "K"]
    """Of each saturated value; so are the next two."""
    channel: Int[np.ndarray, "K"]
    gap: Int[np.ndarray, "K"]

    def gaps_of(self, segment: int) -> slice:
        """The gaps of a segment."""
        return slice(*np.searchsorted(self.gap_segment, (segment, segment + 1)).tolist())

    def values_of(self, segment: int) -> slice:
        """The saturated values of a segment."""
        gaps = self.gaps_of(segment)
        return slice(*np.searchsorted(self.gap, (gaps.start, gaps.stop)).tolist())

    @staticmethod
    def of(trial: Trial, segments: Segments, gaps: Gaps) -> "Layout":
        order = np.lexsort((gaps.channel, gaps.start))
        gaps = jax.tree.map(lambda x: x[order], gaps)
        size = gaps.end - gaps.start
        first = np.cumsum(size) - size
        gap = np.repeat(np.arange(len(size)), size)
        sample = np.arange(size.sum()) - (first - gaps.start)[gap]
        channel = gaps.channel[gap]
        value = gaps.sign[gap] * trial.signal[sample, channel]
        rail = np.maximum.reduceat(value, first) if len(size) else np.zeros(0)
        gap_segment = np.searchsorted(segments.arrival, gaps.start, side="right")
        return Layout(segments, gap_edges(trial, gaps, rail), gap_segment, sample, channel, gap)


def gap_edges(trial: Trial, gaps: Gaps, rail: Float[np.ndarray, "G"]) -> Float[np.ndarray, "G 8"]:
    """The fields of `Edges` of all gaps, in the direction of their rail, time in samples of the recording.

    Slopes come from the three samples beside a gap (Section 4.2); they are sound only where all three were
    measured, lie inside the recording and do not saturate themselves, and where the gap has two samples.
    """
    n = len(trial.signal)
    offsets = np.arange(1, 4)
    before = gaps.start[:, None] - offsets
    after = gaps.end[:, None] + offsets - 1
    inside = (before >= 0).all(1) & (after < n).all(1)
    before, after = np.clip(before, 0, n - 1), np.clip(after, 0, n - 1)
    channel, sign = gaps.channel[:, None], gaps.sign[:, None]
    left, right = sign * trial.signal[before, channel], sign * trial.signal[after, channel]
    clean = trial.clean[before, channel].all(1) & trial.clean[after, channel].all(1)
    fields = (
        gaps.start - 1,
        gaps.end,
        np.minimum(left[:, 0], rail),
        np.minimum(right[:, 0], rail),
        -edge_slope(*left.T),
        edge_slope(*right.T),
        rail,
        inside & clean & (gaps.end - gaps.start > 1),
    )
    return np.stack([np.asarray(field, float) for field in fields], axis=1)


# A padded gap is a flat one without samples.
_NO_GAP = np.array([[0.0, 2.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]])


def bucket(count: int, smallest: int) -> int:
    """`smallest` times a power of four: coarse steps, so shapes are shared and few programs are compiled."""
    size = smallest
    while size < count:
        size *= 4
    return size


def pad(x: np.ndarray, size: int) -> np.ndarray:
    """Zeros behind the leading axis up to `size`."""
    return np.concatenate([x, np.zeros((size - len(x), *x.shape[1:]), x.dtype)])


def gather(
    trial: Trial,
    layout: Layout,
    index: int,
    departure: NavState,
    departure_covariance: Float[np.ndarray, "9 9"],
    arrival: Float[np.ndarray, "10 10"],
) -> Segment:
    """One segment as a padded `Segment`; departure and arrival come from the whole recording."""
    start = max(0, int(layout.segments.departure[index]))
    stop = int(layout.segments.arrival[index])
    n = bucket(stop - start, 256)
    gaps, values = layout.gaps_of(index), layout.values_of(index)
    channel, sample = layout.channel[values], layout.sample[values]
    count = gaps.stop - gaps.start
    cut, element = np.unique(sample - start, return_inverse=True)
    m = g = bucket(len(sample), 16)
    edges = np.concatenate([layout.edges[gaps], np.repeat(_NO_GAP, g - count, axis=0)])
    edges[:count, :2] -= start
    fields = jnp.asarray(edges.T)
    at_arrival = stop < len(trial.signal)
    arrays = {
        "signal": pad(trial.signal[start:stop], n),
        "period": pad(trial.period[start:stop], n),
        # One variance for the three axes of a sensor, on the safe side where they differ.
        "variance": pad(trial.variance[start:stop].reshape(-1, 2, 3).max(axis=2), n),
        "cut": np.concatenate([cut, np.full(m - len(cut), n)]),
        "element": pad(element, m),
        "channel": pad(channel, m),
        "sign": pad(trial.sign[sample, channel].astype(float), m),
        "bound": pad(trial.bound[channel], m),
        "gap": pad(layout.gap[values] - gaps.start, m),
        "departure_covariance": departure_covariance,
        "arrival": arrival,
        "height": at_arrival and np.asarray(trial.rows.height)[stop],
        "height_variance": trial.rows.height_variance,
    }
    return Segment(
        departure=departure,
        edges=Edges(*fields[:7], sound=fields[7] > 0),
        **{name: jnp.asarray(value) for name, value in arrays.items()},
    )
