"""Scores of trajectories against motion capture; its readers live here because truth is for scoring only."""

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
import pandas as pd
from jaxtyping import Bool, Float
from scipy.io import loadmat
from scipy.io.matlab import MatReadError

from jaxsat.errors import InputError

Positions = Float[np.ndarray, "N 3"]
Times = Float[np.ndarray, "M"]
Track = tuple[Float[np.ndarray, "K"], Float[np.ndarray, "K 3"]]
Axes = Literal[2, 3]

_GAITMAP_MOCAP_RATE = 100.0


def align_yaw_translation(estimate: Positions, truth: Positions) -> Positions:
    """The estimate turned about z and moved so that its squared distance to the truth is least.

    An inertial trajectory has no heading and no origin of its own; tilt and height over time are kept.
    """
    from_mean, to_mean = estimate.mean(axis=0), truth.mean(axis=0)
    x, y, z = (estimate - from_mean).T
    u, v, _ = (truth - to_mean).T
    # Σ|R(ψ)e − t|² is least where Σ e·t cos ψ + Σ e×t sin ψ is largest.
    yaw = np.arctan2(x @ v - y @ u, x @ u + y @ v)
    cosine, sine = np.cos(yaw), np.sin(yaw)
    return np.stack([cosine * x - sine * y, sine * x + cosine * y, z], axis=1) + to_mean


def _error(estimate: Positions, truth: Positions, axes: Axes, align: bool) -> Float[np.ndarray, "N D"]:
    aligned = align_yaw_translation(estimate, truth) if align else estimate
    return (aligned - truth)[:, :axes]


def position_rmse(estimate: Positions, truth: Positions, *, axes: Axes = 3, align: bool = True) -> float:
    """Root of the mean over time of the squared norm of the position error (m); 2 axes are the horizontal."""
    return float(np.sqrt((_error(estimate, truth, axes, align) ** 2).sum(axis=1).mean()))


def pyshoe_error(estimate: Positions, truth: Positions, *, axes: Axes = 3, align: bool = True) -> float:
    """PyShoe's "ARMSE" (m): mean over time of the root of the mean over axes of the squared error.

    Wagstaff, Peretroukhin & Kelly 2019. It never exceeds `position_rmse`/√`axes`.
    """
    return float(np.sqrt((_error(estimate, truth, axes, align) ** 2).mean(axis=1)).mean())


def last_position_error(
    estimate: Positions, truth: Positions, *, axes: Axes = 3, align: bool = False
) -> float:
    """Distance between the last positions (m); unaligned as in Dang & Suh 2014, Table 1, unless asked."""
    return float(np.linalg.norm(_error(estimate, truth, axes, align)[-1]))


class AttitudeErrors(NamedTuple):
    """Root mean squares over time (rad)."""

    total: float
    heading: float
    inclination: float


def attitude_errors(
    estimate: Float[np.ndarray, "N 4"],
    truth: Float[np.ndarray, "N 4"],
    scored: Bool[np.ndarray, "N"],
    *,
    align: bool = True,
) -> AttitudeErrors:
    """Errors of attitudes q_nb by the decomposition of the BROAD benchmark (Laidig et al., Data 2021, 6(7), 72).

    Of the error quaternion in the navigation frame, q ⊗ q_true*, the total angle is 2 acos|w|, the heading
    2 atan(z/w) and the inclination 2 acos√(w² + z²); scored: the samples that count. An estimate without a
    magnetometer has a heading of its own, so its mean heading error is taken off first (`align`).
    """
    p, q = estimate[scored], truth[scored] * np.array([1.0, -1.0, -1.0, -1.0])
    w = p[:, 0] * q[:, 0] - np.sum(p[:, 1:] * q[:, 1:], axis=1)
    z = p[:, 0] * q[:, 3] + p[:, 3] * q[:, 0] + p[:, 1] * q[:, 2] - p[:, 2] * q[:, 1]
    heading, tilted = 2.0 * np.arctan2(z, w), np.clip(np.hypot(w, z), 0.0, 1.0)
    if align:
        heading = heading - np.angle(np.mean(np.exp(1j * heading)))
    heading = np.angle(np.exp(1j * heading))
    total = 2.0 * np.arccos(np.clip(tilted * np.cos(0.5 * heading), 0.0, 1.0))
    errors = (total, heading, 2.0 * np.arccos(tilted))
    return AttitudeErrors(*(float(np.sqrt(np.mean(error**2))) for error in errors))


def geometric_mean_ratio(values: Float[np.ndarray, "N"], baselines: Float[np.ndarray, "N"]) -> float:
    """Geometric mean of values over baselines: 1 is no change, halving and doubling cancel.

    Raises `InputError` where one of them is not positive, or there are none.
    """
    if not (len(values) and np.all(values > 0) and np.all(baselines > 0)):
        raise InputError("ratio: values and baselines must be positive numbers; leave out the other pairs.")
    return float(np.exp(np.mean(np.log(values / baselines))))


def _at(time: Times, position: np.ndarray, at: np.ndarray | None, path: Path) -> Track:
    """Linear interpolation; beyond the ends by one period of the truth at most, where the ends are held."""
    if at is None:
        return time, position
    period = np.median(np.diff(time))
    if at.min() < time[0] - 1.01 * period or at.max() > time[-1] + 1.01 * period:
        raise InputError(
            f"{path}: truth from {time[0]:.3f} to {time[-1]:.3f} s does not cover the asked "
            f"{at.min():.3f} to {at.max():.3f} s; score a shorter stretch."
        )
    return at, np.stack([np.interp(at, time, axis) for axis in position.T], axis=1)


def load_pyshoe_truth(path: Path, at: Times | None = None) -> Track:
    """Time (s, that of `ts`) and position (m, right-handed, z up) of the foot in a PyShoe trial.

    With `at`, linearly interpolated at those times; `InputError` where the truth does not cover them. The
    file's frame is left-handed, so y changes its sign; Vicon lags the sensor by 2 to 9 ms, not corrected.
    """
    try:
        trial = loadmat(path, variable_names=["ts", "gt"])
        time, position = trial["ts"].ravel(), trial["gt"] * [1.0, -1.0, 1.0]
    except (OSError, ValueError, MatReadError, KeyError) as error:
        raise InputError(f"{path}: no PyShoe truth ('ts', 'gt') in it ({error}); check the file.") from None
    return _at(time, position, at, path)


def load_gaitmap_truth(path: Path, markers: Sequence[str], at: Times | None = None) -> Track:
    """Time (s) and mean position (m, z up) of some markers in a gaitmap trial; `at` as for PyShoe.

    Markers are `L_` or `R_` with `FCC` (heel), `TOE` or `FM5` (5th metatarsal). Time counts from the start
    that motion capture and sensors share.
    """
    try:
        table = pd.read_csv(path, header=[0, 1], index_col=0)
        known = list(dict.fromkeys(table.columns.get_level_values(0)))
    except (OSError, ValueError) as error:
        raise InputError(f"{path}: not a gaitmap motion-capture table ({error}); check the file.") from None
    unknown = [marker for marker in markers if marker not in known]
    if unknown or not markers:
        raise InputError(f"{path}: no marker {unknown}; choose some of {', '.join(known)}.")
    position = 1e-3 * np.mean(
        [table.loc[:, [(marker, axis) for axis in "xyz"]].to_numpy() for marker in markers], axis=0
    )
    return _at(np.arange(len(table)) / _GAITMAP_MOCAP_RATE, position, at, path)


def load_truth(recording: Path) -> Track:
    """Time (s) and position (m) of the truth of a recording: within a PyShoe file, else in a table beside it.

    Beside `walk.csv` that is `walk_truth.csv`, or `.parquet`, with `time` and `pos_x…z`, as `jaxsat simulate` writes
    it. Raises `InputError` where there is none.
    """
    path = Path(recording)
    if path.suffix == ".mat":
        return load_pyshoe_truth(path)
    beside = [path.with_name(f"{path.stem}_truth{suffix}") for suffix in (".parquet", ".csv")]
    found = [one for one in beside if one.is_file()]
    if not found:
        raise InputError(
            f"{path}: no truth beside it; put time, pos_x, pos_y and pos_z into {beside[1].name}."
        )
    try:
        table = pd.read_parquet(found[0]) if found[0].suffix == ".parquet" else pd.read_csv(found[0])
        time, position = (table[c].to_numpy(float) for c in ("time", ["pos_x", "pos_y", "pos_z"]))
    except (OSError, ValueError, KeyError) as error:
        raise InputError(f"{found[0]}: no truth ('time', 'pos_x…z') in it ({error}); check it.") from None
    kept = np.isfinite(time) & np.isfinite(position).all(axis=1)
    if kept.sum() < 2 or not np.all(np.diff(time[kept]) > 0):
        raise InputError(f"{found[0]}: fewer than two positions, or time does not increase; check the file.")
    return time[kept], position[kept]


def load_broad_truth(
    path: Path,
) -> tuple[Times, Float[np.ndarray, "M 4"], Float[np.ndarray, "M 3"], Bool[np.ndarray, "M"]]:
    """Time (s), attitude q_nb (n = ENU), position (m) and where both were tracked, of a BROAD trial.

    Untracked samples hold the identity and the origin. The sensor lags by one sample, not corrected.
    """
    try:
        with np.load(path) as trial:
            rate = trial["sampling_rate"].item()
            q_nb, position = trial["opt_quat"].astype(float), trial["opt_pos"].astype(float)
    except (OSError, ValueError, KeyError) as error:
        raise InputError(
            f"{path}: no BROAD truth ('opt_quat', 'opt_pos') in it ({error}); check it."
        ) from None
    valid = np.isfinite(q_nb).all(axis=1) & np.isfinite(position).all(axis=1)
    q_nb = np.where(valid[:, None], q_nb, [1.0, 0.0, 0.0, 0.0])
    position = np.where(valid[:, None], position, 0.0)
    return np.arange(len(q_nb)) / rate, q_nb / np.linalg.norm(q_nb, axis=1, keepdims=True), position, valid
