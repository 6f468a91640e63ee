"""Simulated recordings: sensors follow from a motion by automatic differentiation.

Gravity is the standard one: a simulated sensor at rest reads 9.80665 m/s².
"""

from functools import partial
from pathlib import Path

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pandas as pd
from jaxtyping import Array, Bool, Float, Key

from jaxsat.errors import InputError
from jaxsat.inertial.programs import computing
from jaxsat.inertial.rotations import quat_conjugate, quat_multiply, quat_rotate
from jaxsat.signals.recording import CHANNELS, Recording
from jaxsat.studies.boards import write_whole
from jaxsat.studies.motions import Motion

GRAVITY = 9.80665
# Samples are differentiated in chunks of one size: one compilation per kind of motion, whatever the length.
_CHUNK = 1024


def _floats(value) -> np.ndarray:
    return np.asarray(value, float)


def _zeros() -> np.ndarray:
    return np.zeros(3)


class Calibration(eqx.Module):
    """What a device does to a triad after clipping it: calibrated = matrix @ raw + offset."""

    matrix: Float[np.ndarray, "3 3"] = eqx.field(default_factory=lambda: np.eye(3), converter=_floats)
    offset: Float[np.ndarray, "3"] = eqx.field(default_factory=_zeros, converter=_floats)

    def __check_init__(self):
        if np.linalg.matrix_rank(self.matrix) < 3:
            raise InputError("Calibration: the matrix is singular; give three independent axes.")


class Sensor(eqx.Module):
    """An inertial sensor: white noise, constant biases, rails, and a calibration that smears the rails.

    Signals are calibrated ones (noise and bias included); rails belong to the raw values before calibration.
    """

    gyr_density: float = 7e-4
    """Angular-rate noise density of a consumer sensor (rad/s/√Hz)."""
    acc_density: float = 7e-3
    """Specific-force noise density (m/s²/√Hz)."""
    gyr_bias: Float[np.ndarray, "3"] = eqx.field(default_factory=_zeros, converter=_floats)
    """rad/s"""
    acc_bias: Float[np.ndarray, "3"] = eqx.field(default_factory=_zeros, converter=_floats)
    """m/s²"""
    gyr_rail: float = np.inf
    """rad/s"""
    acc_rail: float = np.inf
    """m/s²"""
    gyr_calibration: Calibration = Calibration()
    acc_calibration: Calibration = Calibration()

    def __check_init__(self):
        if not (self.gyr_density >= 0 and self.acc_density >= 0):
            raise InputError("Sensor: a noise density is negative; give 0 or more.")
        if not (self.gyr_rail > 0 and self.acc_rail > 0):
            raise InputError("Sensor: a rail is not positive; give a magnitude, or infinity for none.")


class Truth(eqx.Module):
    """What really happened, row for row with the recording: states at time[k], signals of sample k."""

    time: Float[np.ndarray, "N"]
    """s"""
    q_nb: Float[np.ndarray, "N 4"]
    position: Float[np.ndarray, "N 3"]
    """m"""
    velocity: Float[np.ndarray, "N 3"]
    """m/s"""
    rest: Bool[np.ndarray, "N"]
    """The motion stands still over the whole of sample k."""
    signal: Float[np.ndarray, "N 6"]
    """Angular rate and specific force without noise, bias or clipping (rad/s, m/s²)."""
    noisy: Float[np.ndarray, "N 6"]
    """The same with noise and bias, before clipping."""
    saturated: Bool[np.ndarray, "N 6"]
    """Channels that were clipped."""


def simulate(
    motion: Motion, *, rate: float, duration: float, sensor: Sensor | None = None, key: Key[Array, ""]
) -> tuple[Recording, Truth]:
    """Record a motion at `rate` (Hz) for `duration` (s); sample k is the signal at the middle of its period.

    The mid-period value represents [kT, (k+1)T) to second order, so a noiseless strapdown of the samples
    meets the true states to O(T²). Computed in float64 whatever JAX's setting. Raises `InputError` where
    there are fewer than two samples or the motion has no finite derivatives.
    """
    if not (np.isfinite(rate) and rate > 0 and np.isfinite(duration) and duration * rate >= 1.5):
        raise InputError(f"simulate: {duration} s at {rate} Hz hold no two samples; raise rate or duration.")
    index = np.arange(round(duration * rate))
    time, middle = index / rate, (index + 0.5) / rate
    with computing():
        # Parameters as arrays: another value of one does not compile anew.
        parameters = jax.tree.map(lambda leaf: jnp.asarray(leaf, float), motion)
        chunks = [_sample(parameters, *times) for times in zip(_chunked(time), _chunked(middle), strict=True)]
        columns = zip(*chunks, strict=True)
        q_nb, position, velocity, signal = (np.concatenate(parts)[: len(time)] for parts in columns)
        clipped, noisy, saturated = _read(sensor or Sensor(), signal, rate, key)
    if not np.isfinite(signal).all():
        raise InputError(
            f"{type(motion).__name__}: the motion has no finite derivatives; check its parameters."
        )
    rest = _rests(motion, rate, len(time))
    truth = Truth(time, q_nb, position, velocity, rest, signal, noisy, saturated)
    missing = np.zeros(clipped.shape, bool)
    name = type(motion).__name__.lower()
    return Recording(time, clipped[:, :3], clipped[:, 3:], missing, name=name), truth


def _chunked(time: np.ndarray) -> Float[np.ndarray, "C M"]:
    return np.pad(time, (0, -len(time) % _CHUNK), mode="edge").reshape(-1, _CHUNK)


@eqx.filter_jit
def _sample(motion: Motion, time: Float[Array, "M"], middle: Float[Array, "M"]) -> tuple[Array, ...]:
    """Attitude, position and velocity at `time`; angular rate 2 q* ⊗ q̇ and specific force at `middle`."""

    def pose_and_rate(t):
        return jax.jvp(motion.pose, (t,), (jnp.ones_like(t),))

    def state(t):
        (position, q_nb), (velocity, _) = pose_and_rate(t)
        return q_nb, position, velocity

    def signal(t):
        ((_, q_nb), (_, q_rate)), (_, (acceleration, _)) = jax.jvp(pose_and_rate, (t,), (jnp.ones_like(t),))
        q_bn = quat_conjugate(q_nb)
        gyr = 2.0 * quat_multiply(q_bn, q_rate)[1:]
        acc = quat_rotate(q_bn, acceleration + jnp.array([0.0, 0.0, GRAVITY]))
        return jnp.concatenate([gyr, acc])

    return *jax.vmap(state)(time), jax.vmap(signal)(middle)


def _read(sensor: Sensor, signal: np.ndarray, rate: float, key: Key[Array, ""]) -> tuple[np.ndarray, ...]:
    """What the sensor makes of a true signal: clipped, noisy but unclipped, and where it was clipped."""
    sd = np.repeat([sensor.gyr_density, sensor.acc_density], 3) * np.sqrt(rate)
    bias = np.concatenate([sensor.gyr_bias, sensor.acc_bias])
    noisy = signal + bias + sd * np.asarray(jax.random.normal(key, signal.shape, float))
    gyr, gyr_hit = _clip(noisy[:, :3], sensor.gyr_rail, sensor.gyr_calibration)
    acc, acc_hit = _clip(noisy[:, 3:], sensor.acc_rail, sensor.acc_calibration)
    return np.concatenate([gyr, acc], axis=1), noisy, np.concatenate([gyr_hit, acc_hit], axis=1)


def _clip(signal: np.ndarray, rail: float, calibration: Calibration) -> tuple[np.ndarray, np.ndarray]:
    raw = np.linalg.solve(calibration.matrix, (signal - calibration.offset).T).T
    clipped = np.clip(raw, -rail, rail) @ calibration.matrix.T + calibration.offset
    hit = np.abs(raw) > rail
    # Samples that no rail touched stay as they were to the last bit.
    return np.where(hit.any(axis=1, keepdims=True), clipped, signal), hit


def _rests(motion: Motion, rate: float, n: int) -> Bool[np.ndarray, "N"]:
    """Samples whose period meets no moving interval."""
    # Ends within a billionth of a period of a sample's edge are at that edge.
    first = np.floor(motion.moving[:, 0] * rate + 1e-9).astype(int)
    last = np.ceil(motion.moving[:, 1] * rate - 1e-9).astype(int)
    change = np.zeros(n + 1, int)
    np.add.at(change, np.clip(first, 0, n), 1)
    np.add.at(change, np.clip(last, 0, n), -1)
    return np.cumsum(change[:-1]) == 0


def write_simulation(path: Path, recording: Recording, truth: Truth, *, rest: bool = False) -> Path:
    """Write a recording as canonical CSV or Parquet and its truth beside it; returns the path of the truth.

    Recording: `time, gyr_x…acc_z`, with `rest` flags if asked. Truth: `time, q_w…q_z, pos_x…, vel_x…, rest`,
    the noise-free `gyr_x…acc_z`, and `sat_gyr_x…`. Raises `InputError` where the suffix is neither `.csv` nor
    `.parquet`, or where `path` cannot be written.
    """
    path = Path(path)
    measured = pd.DataFrame(recording.signal, columns=list(CHANNELS))
    measured.insert(0, "time", recording.time)
    if rest:
        measured["rest"] = truth.rest
    blocks = {
        ("time",): truth.time[:, None],
        ("q_w", "q_x", "q_y", "q_z"): truth.q_nb,
        ("pos_x", "pos_y", "pos_z"): truth.position,
        ("vel_x", "vel_y", "vel_z"): truth.velocity,
        ("rest",): truth.rest[:, None],
        CHANNELS: truth.signal,
        tuple(f"sat_{channel}" for channel in CHANNELS): truth.saturated,
    }
    true = pd.concat([pd.DataFrame(values, columns=list(names)) for names, values in blocks.items()], axis=1)
    truth_path = path.with_name(f"{path.stem}_truth{path.suffix}")
    _write(measured, path)
    _write(true, truth_path)
    return truth_path


def _write(table: pd.DataFrame, path: Path) -> None:
    if path.suffix not in (".csv", ".parquet"):
        raise InputError(f"{path}: unknown table format '{path.suffix}'; end the name in .csv or .parquet.")
    write = partial(table.to_csv, index=False) if path.suffix == ".csv" else table.to_parquet
    try:
        write_whole(path, write)
    except OSError as error:
        raise InputError(
            f"{path}: cannot be written ({error.strerror or error}); choose a writable folder."
        ) from None
