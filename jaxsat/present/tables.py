"""An estimate as tables: one column a quantity, SI units, the names of the documented files."""

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxsat.attitude import Orientation
from jaxsat.pipeline import Estimate, displacements
from jaxsat.saturation.solvers import Status
from jaxsat.signals.recording import CHANNELS

AXES = ("x", "y", "z")


def _axes(prefix: str, suffix: str = "") -> list[str]:
    return [f"{prefix}_{axis}{suffix}" for axis in AXES]


def _frame(columns: dict[tuple[str, ...], np.ndarray]) -> pd.DataFrame:
    """Blocks of columns side by side, each keeping its type."""
    data = {}
    for names, block in columns.items():
        data.update(zip(names, block.reshape(len(block), -1).T, strict=True))
    return pd.DataFrame(data)


def trajectory_table(estimate: Estimate) -> pd.DataFrame:
    """One row a sample: the state at its start, its sd, and where in the recording it is.

    Columns: `time` (s), `q_w…q_z` (body to navigation frame), `pos_*` (m), `vel_*` (m/s), their sd with the
    attitude's as `att_*_sd` (rad, navigation frame), `rest`, and `segment`, the number of the stretch of
    motion, -1 at rest.
    """
    trajectory = estimate.trajectory
    sd = np.sqrt(np.diagonal(trajectory.covariance, axis1=1, axis2=2))
    columns = {
        ("time",): trajectory.time,
        ("q_w", "q_x", "q_y", "q_z"): trajectory.q_nb,
        tuple(_axes("pos")): trajectory.position,
        tuple(_axes("vel")): trajectory.velocity,
        (*_axes("att", "_sd"), *_axes("pos", "_sd"), *_axes("vel", "_sd")): sd,
        ("rest",): estimate.rest,
        ("segment",): _segment_at(estimate, np.arange(len(trajectory.time))),
    }
    return _frame(columns)


def signals_table(estimate: Estimate) -> pd.DataFrame:
    """One row a sample: `time`, the filled channels, the measured ones as `raw_*`, where they saturate as
    `sat_*`, and the sd of the filled ones as `*_sd` (rad/s, m/s²).
    """
    columns = {
        ("time",): estimate.recording.time,
        CHANNELS: estimate.filled,
        tuple(f"raw_{channel}" for channel in CHANNELS): estimate.recording.signal,
        tuple(f"sat_{channel}" for channel in CHANNELS): estimate.saturated,
        tuple(f"{channel}_sd" for channel in CHANNELS): estimate.signal_sd,
    }
    return _frame(columns)


def gaps_table(estimate: Estimate) -> pd.DataFrame:
    """One row a gap, in the order of time.

    Columns: `channel`, `start` and `end` (s, [start, end)), `rail` (the limit, signed; where the device flagged
    the gap and no limit is known, the extreme measured value), `peak` (extreme filled value, signed), `impulse`
    (time integral of what was added, rad or m/s), `status` (how the search of the gap's segment ended: `converged`,
    `max_iterations`, `no_arrival` where no rest follows, `ignored` by method standard, or `inflated` where map left
    the values as they are and took them as noisier, because unsaturated peaks of the channel and about that length
    were further off when hidden and filled than when cut off). Method map
    says how well a gap is known: `peak_sd` of the extreme value, `impulse_sd`, and `identified`, the share of the
    impulse's variance under the signal prior that the rests removed (0: the prior alone decides, 1: the rests do).
    The other methods find one best signal, not a distribution, and leave these empty.
    """
    gaps, recording = estimate.gaps, estimate.recording
    period, added = recording.period, estimate.filled - recording.signal
    limits = np.stack([estimate.rails.low, estimate.rails.high])[(gaps.sign > 0).astype(int), gaps.channel]
    spans = list(zip(gaps.channel, gaps.start, gaps.end, strict=True))
    measured = np.array([_extreme(recording.signal[i:j, c]) for c, i, j in spans])
    fills = estimate.fills
    first = (gaps.start, gaps.channel)
    known = np.isfinite(fills.identified[first])
    status = np.where(
        fills.inflated[first], "inflated", _status_words(estimate)[_segment_at(estimate, gaps.start)]
    )
    tops = [i + int(np.argmax(np.abs(estimate.filled[i:j, c]))) for c, i, j in spans]

    def where_known(x) -> pd.Series:
        return pd.Series(x, dtype="Float64").where(known)

    table = pd.DataFrame(
        {
            "channel": pd.array(np.array(CHANNELS)[gaps.channel], dtype="string"),
            "start": recording.time[gaps.start],
            "end": recording.time[gaps.start] + period * (gaps.end - gaps.start),
            "rail": np.where(np.isfinite(limits), limits, measured),
            "peak": np.array([_extreme(estimate.filled[i:j, c]) for c, i, j in spans], float),
            "peak_sd": where_known(estimate.signal_sd[tops, gaps.channel]),
            "impulse": np.array([added[i:j, c].sum() * period for c, i, j in spans], float),
            "impulse_sd": where_known(fills.gap_sd[first] * period),
            "identified": where_known(fills.identified[first]),
            "status": pd.array(status, dtype="string"),
        }
    )
    return table.sort_values(["start", "channel"], ignore_index=True)


def segments_table(estimate: Estimate) -> pd.DataFrame:
    """One row a segment, the stretch of motion between two rests: a stride, where the sensor is on a foot.

    Columns: `segment` (its number, as in the trajectory), `start` and `end` (s), `saturated` (values that saturate in
    it), `length` (m, horizontal, from the rest before to the rest after), `climb` (m), their `*_sd`, and `status` of
    its search as in the gaps' table. Lengths are empty where no rest precedes or follows; their sd, which do not
    count that the ground is level, also where heights are told to be zero. Method map says what the rest after it
    decides of what was lost: `rank`, in how many directions (of at most six) it removes more than a hundredth of the
    variance under the signal prior, and `seen`, by what: attitude and velocity on arrival, about and along those axes
    of the navigation frame where it removes at least a tenth of the sd that it removes on the axis where it removes
    most.
    """
    segments, time = estimate.segments, estimate.recording.time
    way, covariance = displacements(estimate)
    length = np.hypot(way[:, 0], way[:, 1])
    along = np.zeros_like(way)
    along[:, :2] = way[:, :2] / np.maximum(length, 1e-9)[:, None]
    spread = np.einsum("si,sij,sj->s", along, covariance, along), covariance[:, 2, 2]
    total = np.concatenate([[0], np.cumsum(estimate.saturated.sum(axis=1))])
    start = np.maximum(segments.departure + 1, 0)
    saturated = total[segments.arrival] - total[start]
    words = np.where(saturated == 0, Status.NOTHING_TO_DO.name.lower(), _status_words(estimate))
    fills = estimate.fills
    judged = np.isfinite(fills.arrival).all(axis=1)
    kinds = fills.arrival.reshape(-1, 2, 3)
    much = (kinds > 0.1 * kinds.max(axis=2, keepdims=True)).reshape(-1, 6) & (fills.rank > 0)[:, None]
    names = np.array([*_axes("att"), *_axes("vel")])
    seen = [", ".join(names[row]) for row in much]
    return pd.DataFrame(
        {
            "segment": np.arange(len(segments)),
            "start": time[np.minimum(start, len(time) - 1)],
            "end": time[np.minimum(segments.arrival, len(time) - 1)],
            "saturated": saturated,
            "length": length,
            "length_sd": np.sqrt(np.maximum(spread[0], 0.0)),
            "climb": way[:, 2],
            "climb_sd": np.sqrt(np.maximum(spread[1], 0.0)),
            "rank": pd.Series(fills.rank, dtype="Int64").where(judged),
            "seen": pd.Series(seen, dtype="string").where(judged),
            "status": pd.array(words, dtype="string"),
        }
    )


def orientation_table(found: Orientation) -> pd.DataFrame:
    """One row a sample: the attitude at its start.

    Columns: `time` (s), `q_w…q_z` (body to navigation frame), `euler_*` (rad, about x, y and z; Q_z ⊗ Q_y ⊗ Q_x),
    `inclination_sd` and `heading_sd` (rad, empty for the filters, which do not know them), `bias_*` (rad/s, the
    gyroscope's offset as known then), and `sat_*`, which channels saturate.
    """
    unknown = np.full((len(found.recording), 2), np.nan)
    columns = {
        ("time",): found.recording.time,
        ("q_w", "q_x", "q_y", "q_z"): found.q_nb,
        tuple(_axes("euler")): found.euler,
        ("inclination_sd", "heading_sd"): unknown if found.sd is None else found.sd,
        tuple(_axes("bias")): found.bias,
        tuple(f"sat_{channel}" for channel in CHANNELS): found.sign != 0,
    }
    return _frame(columns)


def _extreme(values: Float[np.ndarray, "n"]) -> float:
    return float(values[np.argmax(np.abs(values))])


def _segment_at(estimate: Estimate, sample: np.ndarray) -> np.ndarray:
    """Number of the segment that a sample lies in, -1 at rest."""
    segment = np.searchsorted(estimate.segments.arrival, sample, side="right")
    return np.where(estimate.rest[sample], -1, segment)


def _status_words(estimate: Estimate) -> np.ndarray:
    if estimate.config.method == "standard":
        return np.full(len(estimate.segments), "ignored", dtype=object)
    return np.array([Status(code).name.lower() for code in estimate.fills.status], dtype=object)
