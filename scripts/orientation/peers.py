"""The filters of others on a recording: attitude after each sample, as their packages say it."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsat.inertial.orientation import start_at_rest
from jaxsat.signals.recording import Recording
from scripts.peers import import_peer


def offset_taken_off(recording: Recording) -> tuple[np.ndarray, np.ndarray]:
    """Rates without the mean of the first second, and the level start: what filters without a bias are given."""
    first = recording.signal[: round(1 / recording.period)].mean(axis=0)
    with jax.enable_x64(True):
        q = np.asarray(start_at_rest(jnp.asarray(first[None])).q_nb)
    return recording.gyr - first[:3], q


def madgwick(recording: Recording, gain: float) -> np.ndarray:
    filters, (gyr, q0) = import_peer("ahrs.filters"), offset_taken_off(recording)
    return filters.Madgwick(gyr=gyr, acc=recording.acc, frequency=1 / recording.period, gain=gain, q0=q0).Q


def mahony(recording: Recording, kp: float, ki: float) -> np.ndarray:
    filters, (gyr, q0) = import_peer("ahrs.filters"), offset_taken_off(recording)
    return filters.Mahony(gyr=gyr, acc=recording.acc, frequency=1 / recording.period, k_P=kp, k_I=ki, q0=q0).Q


def vqf(recording: Recording, offline: bool) -> np.ndarray:
    package = import_peer("vqf")
    gyr, acc = np.ascontiguousarray(recording.gyr), np.ascontiguousarray(recording.acc)
    if offline:
        return package.offlineVQF(gyr, acc, None, recording.period, {})["quat6D"]
    return package.VQF(recording.period).updateBatch(gyr, acc)["quat6D"]
