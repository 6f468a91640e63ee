"""gaitmap's trajectory of a foot: an error-state Kalman filter with zero-velocity updates and RTS smoothing.

As its package has it: its own rests (34 °/s), and heights of rests that are zero (`level_walking`), which ours are
not told. Given are the attitude at the start, and the recording as measured or filled.
"""

import numpy as np
import pandas as pd
from jaxtyping import Float

from jaxsat.preparation import Prepared
from jaxsat.signals.recording import CHANNELS, Recording

from . import import_peer


def rts_kalman(recording: Recording, prepared: Prepared) -> Float[np.ndarray, "N 3"]:
    """Positions at the start of each sample (m)."""
    methods = import_peer("gaitmap.trajectory_reconstruction")
    w, x, y, z = np.asarray(prepared.trial.prior.q_nb)
    data = pd.DataFrame(recording.signal, columns=list(CHANNELS))
    data[["gyr_x", "gyr_y", "gyr_z"]] = np.rad2deg(recording.gyr)
    smoother = methods.RtsKalman(initial_orientation=np.array([x, y, z, w]))
    found = smoother.estimate(data, sampling_rate_hz=1.0 / recording.period)
    return found.position_[["pos_x", "pos_y", "pos_z"]].to_numpy()[: len(recording)]
