"""Saturated samples filled from the signal alone, for the standard smoother; neither knows of rests.

- `spline`: the cubic spline through a channel's unsaturated samples (SciPy's, not-a-knot).
- `second_difference`: the values of least sum of squared second differences, the rest of the channel as measured.

What lies below its rail is put there; a gap at an end of the recording stays as measured.
"""

import equinox as eqx
import numpy as np
from jaxtyping import Bool, Float
from scipy.interpolate import CubicSpline
from scipy.sparse import csr_array, eye_array
from scipy.sparse.linalg import spsolve

from jaxsat.preparation import Prepared
from jaxsat.signals.recording import Recording

Channel = Float[np.ndarray, "N"]


def spline(channel: Channel, lost: Bool[np.ndarray, "N"]) -> Channel:
    at = np.arange(len(channel))
    return CubicSpline(at[~lost], channel[~lost])(at)


def second_difference(channel: Channel, lost: Bool[np.ndarray, "N"]) -> Channel:
    one = csr_array(eye_array(len(channel)))
    second = (one[:-2] - 2.0 * one[1:-1] + one[2:]).tocsc()
    filled = np.where(lost, 0.0, channel)
    free = second[:, lost]
    filled[lost] = spsolve((free.T @ free).tocsc(), -free.T @ (second @ filled))
    return filled


FILLS = {"spline": spline, "second_difference": second_difference}


def filled(recording: Recording, prepared: Prepared, name: str) -> Recording:
    """A recording with the samples that `prepared` calls saturated filled, and with its rests."""
    signal, sign = recording.signal.copy(), prepared.sign
    inside = (sign == 0).cumsum(axis=0).astype(bool) & (sign == 0)[::-1].cumsum(axis=0)[::-1].astype(bool)
    for j in np.flatnonzero((sign != 0).any(axis=0)):
        way, measured = sign[:, j], recording.signal[:, j]
        guess = FILLS[name](measured, (way != 0) & inside[:, j])
        signal[:, j] = np.where(way != 0, way * np.maximum(way * guess, way * measured), measured)
    found = recording.with_signal(signal)
    return eqx.tree_at(
        lambda r: (r.rest, r.clipped), found, (prepared.rest, None), is_leaf=lambda x: x is None
    )
