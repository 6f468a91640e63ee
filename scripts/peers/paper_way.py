"""δ of one segment as in Dang & Suh 2014: a dense quadratic problem inside a generic solver."""

import time
from collections.abc import Callable
from dataclasses import dataclass

import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxsat import Config, Sensor, simulate
from jaxsat.inertial.rotations import quat_between
from jaxsat.inertial.smoother import VELOCITY
from jaxsat.inertial.strapdown import NavState
from jaxsat.studies.motions import Bar

from . import numpy_state


@dataclass(frozen=True)
class SegmentProblem:
    """A recording with one motion between two rests, some of it saturated."""

    signal: Float[np.ndarray, "N 6"]
    """As clipped (rad/s, m/s²)."""
    period: float
    variance: Float[np.ndarray, "6"]
    """Of each channel's noise in one sample."""
    rest: Bool[np.ndarray, "N"]
    velocity_variance: float
    """At rest (m²/s²)."""
    sample: Int[np.ndarray, "m"]
    """Where a value saturated; so are the next two."""
    channel: Int[np.ndarray, "m"]
    sign: Float[np.ndarray, "m"]
    bound: float
    """δ_b."""
    prior: NavState
    prior_covariance: Float[np.ndarray, "9 9"]
    gravity: float

    def filled(self, delta: Float[np.ndarray, "m"]) -> Float[np.ndarray, "N 6"]:
        """The signal with δ added in the direction of the rail."""
        signal = self.signal.copy()
        signal[self.sample, self.channel] += self.sign * delta
        return signal


def bar_problem(seed: int = 0) -> SegmentProblem:
    """The bar of Dang & Suh 2014, §6, with rail 7.5 rad/s and δ_b = 5, rests as they truly are."""
    recording, truth = simulate(
        Bar(), rate=100.0, duration=1.6, sensor=Sensor(gyr_rail=7.5), key=jax.random.key(seed)
    )
    noise, period = Config().noise, recording.period
    # The last tenth of the first rest may already stir.
    quiet = int(np.argmin(truth.rest)) - round(0.1 / period)
    up = recording.signal[:quiet, 3:].mean(axis=0)
    with jax.enable_x64(True):
        q_nb = np.asarray(quat_between(jnp.asarray(up), jnp.array([0.0, 0.0, 1.0])))
    tilt, speed = noise.initial_tilt_sd**2, noise.rest_velocity_sd**2
    sample, channel = np.nonzero(truth.saturated)
    return SegmentProblem(
        signal=recording.signal,
        period=period,
        variance=np.repeat([noise.gyr_density, noise.acc_density], 3) ** 2 / period,
        rest=truth.rest,
        velocity_variance=speed,
        sample=sample,
        channel=channel,
        sign=np.sign(recording.signal[sample, channel]),
        bound=5.0,
        prior=numpy_state(q_nb, np.zeros(3), np.zeros(3)),
        prior_covariance=np.diag([tilt, tilt, 0.0, 0.0, 0.0, 0.0, speed, speed, speed]),
        gravity=float(np.linalg.norm(up)),
    )


def _skew(v: Float[np.ndarray, "... 3"]) -> Float[np.ndarray, "... 3 3"]:
    """[v×] of each vector."""
    matrix = np.zeros((*v.shape, 3))
    matrix[..., [2, 0, 1], [1, 2, 0]] = v
    return matrix - np.swapaxes(matrix, -1, -2)


def _rotations(phi: Float[np.ndarray, "N 3"]) -> Float[np.ndarray, "N 3 3"]:
    """Rotation matrices of rotation vectors (Rodrigues)."""
    angle, cross = np.linalg.norm(phi, axis=1)[:, None, None], _skew(phi)
    return (
        np.eye(3) + np.sinc(angle / np.pi) * cross + 0.5 * np.sinc(0.5 * angle / np.pi) ** 2 * cross @ cross
    )


def dense_objective(problem: SegmentProblem) -> Callable[[Float[np.ndarray, "m"]], float]:
    """J*(δ) of Eq. 14–18 by one dense system: strapdown of the filled signal, then all unknowns at once.

    The unknowns are the noise inputs, 6 in each sample, and the first state: the process noise of Eq. 9 has rank 6,
    so the 9(N+1) states with its inverse, as printed, do not exist. The system is a third smaller than theirs.
    """
    T, count = problem.period, len(problem.signal)
    values, vectors = np.linalg.eigh(problem.prior_covariance)
    first = vectors * np.sqrt(np.maximum(values, 0.0))
    sd = np.sqrt(problem.variance)
    start = Rotation.from_quat(problem.prior.q_nb, scalar_first=True).as_matrix()

    def objective(delta: Float[np.ndarray, "m"]) -> float:
        signal = problem.filled(delta)
        halves = _rotations(0.5 * T * signal[:, :3])
        R, v = start, problem.prior.velocity
        # How the state depends on the unknowns, row by row of [θ, r, v]; position only follows.
        effect = np.zeros((9, 9 + 6 * count))
        effect[:, :9] = first
        rows, known = [], []
        for k in range(count):
            if problem.rest[k]:
                rows.append(effect[VELOCITY, :].copy())
                known.append(-v)
            R = R @ halves[k]
            force = R @ signal[k, 3:]
            turn = _skew(force)
            effect[3:6] += T * effect[6:] - 0.5 * T**2 * turn @ effect[:3]
            effect[6:] -= T * turn @ effect[:3]
            mine = slice(9 + 6 * k, 15 + 6 * k)
            effect[:3, mine][:, :3] = T * R * sd[:3]
            effect[3:6, mine][:, 3:] = 0.5 * T**2 * R * sd[3:]
            effect[6:, mine][:, 3:] = T * R * sd[3:]
            R = R @ halves[k]
            v = v + T * (force - [0.0, 0.0, problem.gravity])
        G = np.concatenate(rows) / np.sqrt(problem.velocity_variance)
        z = np.concatenate(known) / np.sqrt(problem.velocity_variance)
        normal = G.T @ G
        normal[np.diag_indices_from(normal)] += 1.0
        u = scipy.linalg.cho_solve(scipy.linalg.cho_factor(normal), G.T @ z)
        residual = z - G @ u
        return 0.5 * float(u @ u + residual @ residual)

    return objective


@dataclass(frozen=True)
class PaperWay:
    """What the paper's way found, and what it took."""

    delta: Float[np.ndarray, "m"]
    cost: float
    """J*(δ)."""
    seconds: float
    evaluations: int
    """Of J*, those for finite differences included."""
    message: str
    """How the solver ended."""


def paper_way(problem: SegmentProblem) -> PaperWay:
    """Method 1 as published: a generic solver (SLSQP, finite differences) on J*(δ), 0 ≤ δ ≤ δ_b, from δ = 0."""
    start = time.perf_counter()
    zero = np.zeros(len(problem.sample))
    found = scipy.optimize.minimize(
        dense_objective(problem),
        zero,
        method="SLSQP",
        bounds=[(0.0, problem.bound)] * len(zero),
        options={"maxiter": 200},
    )
    seconds = time.perf_counter() - start
    return PaperWay(found.x, float(found.fun), seconds, int(found.nfev), str(found.message))
