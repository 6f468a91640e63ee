"""What jaxsat's speed is compared with, each peer checked against jaxsat first.

    python scripts/peers.py --check      # every peer computes what jaxsat computes
    python scripts/peers.py --time       # how long each takes
    python scripts/peers.py --paper      # one segment in the paper's way

- `numba_strapdown`: a bare pass over the samples, compiled; nothing that looks at each sample can do less.
- `paper_way`: δ of one segment as in Dang & Suh 2014, a dense quadratic problem inside a generic solver.
- `dynamax_smoother`, `cuthbert_smoother`: the linear smoother by general libraries in JAX.

A peer that is not installed raises `MissingPeer`; `pip install jaxsat[bench]` brings all of them.
"""

import argparse
import importlib
import math
import time
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, partial
from typing import Any, Literal

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import scipy.linalg
import scipy.optimize
from jaxtyping import Array, Bool, Float, Int
from scipy.spatial.transform import Rotation

from jaxsat import Config, Sensor, simulate
from jaxsat.inertial.rotations import quat_between
from jaxsat.inertial.smoother import VELOCITY, Rows, smooth_about
from jaxsat.inertial.strapdown import (
    NavState,
    Samples,
    error_between,
    error_transition,
    sample_intervals,
    sample_noise,
    strapdown,
)
from jaxsat.studies.motions import Bar, Walk
from jaxsat.studies.simulate import GRAVITY


class MissingPeer(ImportError):
    """A package to compare with is not installed."""


def _peer(module: str) -> Any:
    """A module of a peer, imported only when it is asked for."""
    try:
        return importlib.import_module(module)
    except ImportError as error:
        name = module.split(".")[0]
        raise MissingPeer(
            f"{name} cannot be imported ({error}); pip install 'jaxsat[bench]' brings it."
        ) from None


def _state(q_nb: Any, velocity: Any, position: Any) -> NavState:
    """A state of numpy arrays."""
    return NavState(q_nb, velocity, position)


# --- A compiled bare strapdown pass ---------------------------------------------------------------------------


def numba_strapdown(
    signal: Float[np.ndarray, "B N 6"],
    period: float,
    initial: NavState,
    gravity: float,
    all_states: bool = False,
) -> NavState:
    """`jaxsat.inertial.strapdown` of B trials by numba, on all cores: the last state of each trial, (B, …).

    initial: B states. With all_states the N+1 states of each trial, (B, N+1, …); writing them costs more than
    computing them, so the last state alone is the harder comparator. Raises ValueError where a sample turns by
    more than one revolution.
    """
    start = np.concatenate([initial.q_nb, initial.velocity, initial.position], axis=1)
    states, fastest = _strapdown_kernel()(signal, float(period), start, float(gravity), all_states)
    if fastest > 2.0 * math.pi:
        raise ValueError(f"a sample turns by {fastest:.3g} rad; the series hold up to one revolution")
    states = states if all_states else states[:, 0]
    return _state(states[..., :4], states[..., 4:7], states[..., 7:])


@cache
def _strapdown_kernel() -> Callable:
    """Compile the pass: 64 trials side by side in vector lanes, groups of them on the cores."""
    numba = _peer("numba")
    lanes = 64
    # sin(a)/a and cos(a) of a² by their series: exact to 3e-16 for a quarter of one revolution, and they vectorise.
    sine = [(-1.0) ** n / math.factorial(2 * n + 1) for n in range(11)]
    cosine = [(-1.0) ** n / math.factorial(2 * n) for n in range(12)]
    s0, s1, s2, s3, s4, s5, s6, s7, s8, s9, s10 = sine
    c0, c1, c2, c3, c4, c5, c6, c7, c8, c9, c10, c11 = cosine

    @numba.njit(fastmath=True, error_model="numpy", cache=False)
    def gather(sample, signal, k):
        for j in range(len(signal)):
            for i in range(6):
                sample[i, j] = signal[j, k, i]

    # A function of its own: inlined into the loop over samples it would not vectorise.
    @numba.njit(fastmath=True, error_model="numpy", cache=False)
    def advance(state, sample, T, g):
        for j in range(lanes):
            # The quarter turn gives the rotation of half a sample, which is applied twice.
            x, y, z = 0.25 * T * sample[0, j], 0.25 * T * sample[1, j], 0.25 * T * sample[2, j]
            t = x * x + y * y + z * z
            state[10, j] = max(state[10, j], t)
            s = s6 + t * (s7 + t * (s8 + t * (s9 + t * s10)))
            s = s0 + t * (s1 + t * (s2 + t * (s3 + t * (s4 + t * (s5 + t * s)))))
            c = c6 + t * (c7 + t * (c8 + t * (c9 + t * (c10 + t * c11))))
            w = c0 + t * (c1 + t * (c2 + t * (c3 + t * (c4 + t * (c5 + t * c)))))
            x, y, z = s * x, s * y, s * z
            a, b, c, d = state[0, j], state[1, j], state[2, j], state[3, j]
            mw, mx = a * w - b * x - c * y - d * z, a * x + b * w + c * z - d * y
            my, mz = a * y - b * z + c * w + d * x, a * z + b * y - c * x + d * w
            state[0, j], state[1, j] = mw * w - mx * x - my * y - mz * z, mw * x + mx * w + my * z - mz * y
            state[2, j], state[3, j] = mw * y - mx * z + my * w + mz * x, mw * z + mx * y - my * x + mz * w
            ax, ay, az = sample[3, j], sample[4, j], sample[5, j]
            tx, ty, tz = 2 * (my * az - mz * ay), 2 * (mz * ax - mx * az), 2 * (mx * ay - my * ax)
            fx = T * (ax + mw * tx + my * tz - mz * ty)
            fy = T * (ay + mw * ty + mz * tx - mx * tz)
            fz = T * (az + mw * tz + mx * ty - my * tx - g)
            vx, vy, vz = state[4, j], state[5, j], state[6, j]
            state[4, j], state[5, j], state[6, j] = vx + fx, vy + fy, vz + fz
            state[7, j] += T * (vx + 0.5 * fx)
            state[8, j] += T * (vy + 0.5 * fy)
            state[9, j] += T * (vz + 0.5 * fz)

    @numba.njit(parallel=True, fastmath=True, error_model="numpy", cache=False)
    def run(signal, T, start, g, all_states):
        trials, count = signal.shape[0], signal.shape[1]
        groups = (trials + lanes - 1) // lanes
        found = np.empty((trials, count + 1 if all_states else 1, 10))
        fastest = np.zeros(groups)
        for group in numba.prange(groups):
            state, sample = np.zeros((11, lanes)), np.zeros((6, lanes))
            first = group * lanes
            used = min(lanes, trials - first)
            for j in range(used):
                for i in range(10):
                    state[i, j] = start[first + j, i]
            for k in range(count + 1):
                if all_states or k == count:
                    for j in range(used):
                        norm = math.sqrt(
                            state[0, j] ** 2 + state[1, j] ** 2 + state[2, j] ** 2 + state[3, j] ** 2
                        )
                        for i in range(10):
                            found[first + j, k if all_states else 0, i] = state[i, j] / (
                                norm if i < 4 else 1.0
                            )
                if k < count:
                    gather(sample, signal[first : first + used], k)
                    advance(state, sample, T, g)
            fastest[group] = 4.0 * math.sqrt(state[10].max())
        return found, fastest.max()

    return run


# --- One segment in the paper's way ---------------------------------------------------------------------------


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
        prior=_state(q_nb, np.zeros(3), np.zeros(3)),
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


# --- The linear smoother by general libraries -----------------------------------------------------------------


class LinearModel(eqx.Module):
    """The smoother's quadratic problem of B trials about a reference: x' = F x + w, y = H x + e at rests.

    As in jaxsat, N samples lead to N+1 states [θ, r, v], and row k is one of state k; the last state has none.
    """

    F: Float[Array, "B N 9 9"]
    Q: Float[Array, "B N 9 9"]
    """cov(w), of rank 6."""
    root: Float[Array, "B N 9 6"]
    """Q = root rootᵀ."""
    H: Float[Array, "3 9"]
    R: Float[Array, "3 3"]
    """cov(e)."""
    y: Float[Array, "B N 3"]
    mask: Bool[Array, "B N"]
    """Where y was observed."""
    m0: Float[Array, "B 9"]
    P0: Float[Array, "B 9 9"]
    """May be singular."""


class WalkingTrials(eqx.Module):
    """B recordings of one walk, each with noise of its own, as `jaxsat.inertial.smoother` takes them."""

    samples: Samples
    reference: NavState
    """Open-loop strapdown."""
    rows: Rows
    prior: NavState
    prior_covariance: Float[Array, "9 9"]


def walking_trials(trials: int, count: int) -> WalkingTrials:
    """Foot-mounted recordings at 200 Hz, unsaturated; JAX must be in float64."""
    T, noise = 0.005, Config().noise
    motion = Walk(strides=max(1, int((count * T - 1.5) / 1.1)))
    _, truth = simulate(motion, rate=1 / T, duration=count * T, key=jax.random.key(0))
    variance = np.repeat([noise.gyr_density, noise.acc_density], 3) ** 2 / T
    errors = np.random.default_rng(0).normal(size=(trials, count, 6)) * np.sqrt(variance)
    samples = Samples(
        signal=jnp.asarray(truth.signal + errors),
        period=jnp.full((trials, count), T),
        variance=jnp.broadcast_to(jnp.asarray(variance), (trials, count, 6)),
    )
    start = NavState(jnp.asarray(truth.q_nb[0]), jnp.zeros(3), jnp.zeros(3))
    prior = jax.tree.map(lambda x: jnp.broadcast_to(x, (trials, *x.shape)), start)
    speed = jnp.asarray(noise.rest_velocity_sd**2)
    no_height = jnp.zeros((trials, count), bool)
    rest = jnp.broadcast_to(jnp.asarray(truth.rest), (trials, count))
    one = jnp.ones(trials)
    return WalkingTrials(
        samples=samples,
        reference=jax.jit(jax.vmap(partial(strapdown, gravity=jnp.asarray(GRAVITY))))(
            samples.signal, samples.period, prior
        ),
        rows=Rows(rest, speed * one, no_height, one),
        prior=prior,
        prior_covariance=jnp.diag(jnp.array([noise.initial_tilt_sd**2] * 2 + [0.0] * 4 + [speed] * 3)),
    )


@jax.jit
def linear_model(trials: WalkingTrials) -> LinearModel:
    """The problem that `smooth_about` solves about the reference, in matrices."""

    def one(samples, reference, rest):
        start = jax.tree.map(lambda x: x[:-1], reference)
        intervals = sample_intervals(samples.signal, samples.period)
        Q = jax.vmap(sample_noise)(start.q_nb, samples.signal, samples.period, samples.variance)
        # cov(w) of a velocity and its position is one matrix V times [[¼T², ½T], [½T, 1]].
        turn, push = jnp.linalg.cholesky(Q[:, :3, :3]), jnp.linalg.cholesky(Q[:, 6:, 6:])
        half, zero = 0.5 * samples.period[:, None, None], jnp.zeros_like(turn)
        root = jnp.block([[turn, zero], [zero, half * push], [zero, push]])
        return jax.vmap(error_transition)(start.q_nb, intervals), Q, root, -start.velocity, rest

    F, Q, root, y, mask = jax.vmap(one)(trials.samples, trials.reference, trials.rows.rest)
    H = jnp.eye(9)[jnp.array(VELOCITY)]
    count = len(F)
    return LinearModel(
        F=F,
        Q=Q,
        root=root,
        H=H,
        R=trials.rows.velocity_variance[0] * jnp.eye(3),
        y=y,
        mask=mask,
        m0=jnp.zeros((count, 9)),
        P0=jnp.broadcast_to(trials.prior_covariance, (count, 9, 9)),
    )


Variant = Literal["moments", "sequential", "parallel"]
Smoother = Callable[[], tuple[Float[Array, "B N1 9"], Float[Array, "B N1 9 9"]]]
"""Means and covariances of the N+1 states of each trial; compiled by its first call."""


def _observed(model: LinearModel) -> tuple[Array, Array]:
    """H and y of the N+1 states; zeros where nothing was observed, which changes no estimate and is exact."""
    mask = jnp.pad(model.mask, ((0, 0), (0, 1)))[..., None]
    y = jnp.pad(model.y, ((0, 0), (0, 1), (0, 0)))
    return jnp.where(mask[..., None], model.H, 0.0), jnp.where(mask, y, 0.0)


def dynamax_smoother(model: LinearModel) -> Smoother:
    """`dynamax.lgssm_smoother`, vmapped.

    dynamax adds 1e-9 to the diagonal of each matrix that it solves with. In SI units that is more than a sample's
    position noise, so the model is handed over in units so small (1e-10 m, rad, m/s) that it does not matter.
    """
    ssm = _peer("dynamax.linear_gaussian_ssm.inference")
    unit = 1e-10
    H, y = _observed(model)
    # In dynamax entry k + 1 leads from state k to k + 1, and entry 0 is not used.
    F, Q = (jnp.pad(x, ((0, 0), (1, 0), (0, 0), (0, 0))) for x in (model.F, model.Q / unit**2))
    inputs = (F, Q, H, y / unit, model.m0 / unit, model.P0 / unit**2)

    def one(F, Q, H, y, m0, P0):
        parameters = ssm.ParamsLGSSM(
            ssm.ParamsLGSSMInitial(m0, P0),
            ssm.ParamsLGSSMDynamics(F, None, None, Q),
            ssm.ParamsLGSSMEmissions(H, None, None, model.R / unit**2),
        )
        found = ssm.lgssm_smoother(parameters, y)
        return unit * found.smoothed_means, unit**2 * found.smoothed_covariances

    return partial(jax.jit(jax.vmap(one)), *jax.block_until_ready(inputs))


def cuthbert_smoother(model: LinearModel, variant: Variant = "moments") -> Smoother:
    """`cuthbert.filter` and `cuthbert.smoother` in square-root form, vmapped.

    variant: the filter of the linearised-moments family, the fastest on a CPU; the exact filter in sequence, which
    prepares each step for an associative scan; or that scan. The scan may block for ever on a CPU with few cores
    (seen with jaxlib 0.10.2 and two) unless XLA_FLAGS holds --xla_cpu_multi_thread_eigen=false.
    """
    cuthbert = _peer("cuthbert")
    kalman = _peer("cuthbert.gaussian.kalman")
    moments = _peer("cuthbert.gaussian.moments")
    update = _peer("cuthbertlib.kalman").filter_update
    H, y = _observed(model)
    values, vectors = jnp.linalg.eigh(model.P0)
    first = vectors * jnp.sqrt(jnp.maximum(values, 0.0))[:, None, :]
    root = jnp.pad(model.root, ((0, 0), (0, 0), (0, 0), (0, 3)))
    noise_root, nothing = jnp.linalg.cholesky(model.R), jnp.zeros(3)

    def dynamics(inputs):
        return inputs[0], jnp.zeros(9), inputs[1]

    def observation(inputs):
        return inputs[2], nothing, noise_root, inputs[3]

    def dynamics_moments(state, inputs):
        return lambda x: (inputs[0] @ x, inputs[1]), state.mean

    def observation_moments(state, inputs):
        return lambda x: (inputs[2] @ x, noise_root), state.mean, inputs[3]

    def one(F, root, H, y, m0, first):
        # cuthbert observes nothing at state 0, so its row goes into the prior.
        (m0, first), _ = update(m0, first, H[0], nothing, noise_root, y[0])
        if variant == "moments":
            forward = moments.build_filter(m0, first, dynamics_moments, observation_moments)
        else:
            forward = kalman.build_filter(m0, first, dynamics, observation)
        inputs, parallel = (F, root, H[1:], y[1:]), variant == "parallel"
        states = cuthbert.filter(forward, inputs, forward.init_prepare(), parallel=parallel)
        found = cuthbert.smoother(kalman.build_smoother(dynamics), states, inputs, parallel=parallel)
        return found.mean, found.chol_cov @ jnp.swapaxes(found.chol_cov, -1, -2)

    inputs = (model.F, root, H, y, model.m0, first)
    return partial(jax.jit(jax.vmap(one)), *jax.block_until_ready(inputs))


def plain_smoother(model: LinearModel) -> tuple[np.ndarray, np.ndarray]:
    """Kalman filter and Rauch-Tung-Striebel smoother as in a textbook, in numpy; slow, to check the others."""
    F, Q, H, R, y, mask = (np.asarray(x) for x in (model.F, model.Q, model.H, model.R, model.y, model.mask))
    means, covariances = [], []
    for b in range(len(F)):
        m, P, filtered = np.asarray(model.m0[b]), np.asarray(model.P0[b]), []
        for k in range(len(F[b]) + 1):
            if k < len(F[b]) and mask[b, k]:
                gain = np.linalg.solve(H @ P @ H.T + R, H @ P).T
                # Joseph's form keeps P symmetric and positive.
                rest = np.eye(9) - gain @ H
                m, P = m + gain @ (y[b, k] - H @ m), rest @ P @ rest.T + gain @ R @ gain.T
            filtered.append((m, P))
            if k < len(F[b]):
                m, P = F[b, k] @ m, F[b, k] @ P @ F[b, k].T + Q[b, k]
        smoothed = [filtered[-1]]
        for k in reversed(range(len(F[b]))):
            (m, P), (later, spread) = filtered[k], smoothed[-1]
            predicted = F[b, k] @ P @ F[b, k].T + Q[b, k]
            gain = np.linalg.solve(predicted, F[b, k] @ P).T
            smoothed.append((m + gain @ (later - F[b, k] @ m), P + gain @ (spread - predicted) @ gain.T))
        means.append([m for m, _ in reversed(smoothed)])
        covariances.append([P for _, P in reversed(smoothed)])
    return np.array(means), np.array(covariances)


# --- Checks and times -----------------------------------------------------------------------------------------


def bare_trials(trials: int, count: int) -> tuple[np.ndarray, NavState]:
    """Lively random signals and first states: a bare pass takes as long for any."""
    rng = np.random.default_rng(0)
    signal = rng.normal(size=(trials, count, 6)) * np.repeat([3.0, 5.0], 3) + [0, 0, 0, 0, 0, GRAVITY]
    q_nb = rng.normal(size=(trials, 4))
    q_nb /= np.linalg.norm(q_nb, axis=1, keepdims=True)
    return signal, _state(q_nb, rng.normal(size=(trials, 3)), rng.normal(size=(trials, 3)))


def whole_trial_cost(problem: SegmentProblem, delta: Float[np.ndarray, "m"]) -> float:
    """J*(δ) of `dense_objective` by jaxsat's smoother."""
    count = len(problem.signal)
    samples = Samples(
        signal=jnp.asarray(problem.filled(delta)),
        period=jnp.full(count, problem.period),
        variance=jnp.broadcast_to(jnp.asarray(problem.variance), (count, 6)),
    )
    no_height = jnp.zeros(count, bool)
    rows = Rows(jnp.asarray(problem.rest), jnp.asarray(problem.velocity_variance), no_height, jnp.ones(()))
    prior, gravity = jax.tree.map(jnp.asarray, problem.prior), jnp.asarray(problem.gravity)
    reference = strapdown(samples.signal, samples.period, prior, gravity)
    covariance = jnp.asarray(problem.prior_covariance)
    return float(jax.jit(smooth_about)(reference, samples, rows, prior, covariance, gravity).cost)


def _apart(found, expected) -> float:
    """Largest difference of means and covariances, relative to the largest mean and sd of each component."""
    (mean, covariance), (m, P) = (jax.tree.map(np.asarray, pair) for pair in (found, expected))
    sd = np.sqrt(np.einsum("bkii->bki", P)).max(axis=(0, 1))
    means = np.abs(mean - m).max(axis=(0, 1)) / np.abs(m).max(axis=(0, 1))
    return max(means.max(), (np.abs(covariance - P) / np.outer(sd, sd)).max())


def check_strapdown() -> None:
    """70 trials, which is no multiple of the lanes; all states and the last."""
    signal, initial = bare_trials(70, 120)
    signal[3] = 0.0
    period = jnp.full((70, 120), 0.01)
    expected = jax.vmap(partial(strapdown, gravity=jnp.asarray(GRAVITY)))(
        jnp.asarray(signal), period, jax.tree.map(jnp.asarray, initial)
    )
    for all_states in (True, False):
        found = numba_strapdown(signal, 0.01, initial, GRAVITY, all_states)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b if all_states else b[:, -1], atol=1e-10)
    # Almost one revolution in a sample, where the series are at their worst; one and a half is refused.
    fast = np.zeros((1, 2, 6))
    fast[0, :, 1] = 2.0 * np.pi - 1e-9
    first = jax.tree.map(lambda x: x[:1], initial)
    back = numba_strapdown(fast, 1.0, first, 0.0)
    np.testing.assert_allclose(back.q_nb, first.q_nb, atol=1e-8)
    try:
        numba_strapdown(1.5 * fast, 1.0, first, 0.0)
    except ValueError:
        return
    raise AssertionError("a sample of one and a half revolutions was not refused")


def check_paper() -> None:
    """The dense system and jaxsat's smoother agree on J*(δ)."""
    problem = bar_problem()
    objective = dense_objective(problem)
    zero = np.zeros(len(problem.sample))
    for delta in (zero, np.random.default_rng(0).uniform(0.0, problem.bound, len(zero))):
        np.testing.assert_allclose(objective(delta), whole_trial_cost(problem, delta), rtol=1e-10)


def check_smoothers() -> None:
    """dynamax, cuthbert and jaxsat against the textbook, singular noise and prior included."""
    trials = walking_trials(2, 300)
    model = linear_model(trials)
    np.testing.assert_allclose(model.root @ jnp.swapaxes(model.root, -1, -2), model.Q, atol=1e-20)
    expected = plain_smoother(model)

    def ours(reference, samples, rows, prior):
        found = smooth_about(reference, samples, rows, prior, trials.prior_covariance, jnp.asarray(GRAVITY))
        return jax.vmap(error_between)(found.state, reference), found.covariance

    found = jax.jit(jax.vmap(ours))(trials.reference, trials.samples, trials.rows, trials.prior)
    apart = {"jaxsat": _apart(found, expected), "dynamax": _apart(dynamax_smoother(model)(), expected)}
    for variant in ("moments", "sequential"):
        apart[f"cuthbert, {variant}"] = _apart(cuthbert_smoother(model, variant)(), expected)
    print({name: f"{value:.1e}" for name, value in apart.items()})
    assert max(apart.values()) < 1e-8, apart


def shortest(function: Callable, repeats: int = 5) -> float:
    """Seconds of the fastest call; a first one compiles."""
    jax.block_until_ready(function())
    seconds = []
    for _ in range(repeats):
        start = time.perf_counter()
        jax.block_until_ready(function())
        seconds.append(time.perf_counter() - start)
    return min(seconds)


def print_times() -> None:
    signal, initial = bare_trials(256, 512)
    for all_states in (False, True):
        run = partial(numba_strapdown, signal, 0.005, initial, GRAVITY, all_states)
        what = "all states" if all_states else "last state"
        print(
            f"numba strapdown, {what}: {1e6 * shortest(run, 50) / (256 * 512):.4f} µs per sample", flush=True
        )
    problem = bar_problem()
    run = partial(dense_objective(problem), np.zeros(len(problem.sample)))
    print(f"dense J*(δ): {1e3 * shortest(run):.1f} ms", flush=True)
    model = linear_model(walking_trials(64, 1000))
    print(f"dynamax: {shortest(dynamax_smoother(model)):.3f} s for 64 × 1,000 samples", flush=True)
    for variant in ("moments", "sequential"):
        seconds = shortest(cuthbert_smoother(model, variant))
        print(f"cuthbert, {variant}: {seconds:.3f} s for 64 × 1,000 samples", flush=True)


def main() -> None:
    parser = argparse.ArgumentParser(description="What jaxsat's speed is compared with")
    parser.add_argument("--check", action="store_true", help="does every peer compute what jaxsat computes?")
    parser.add_argument("--time", action="store_true", help="how long does each take?")
    parser.add_argument("--paper", action="store_true", help="solve one segment in the paper's way")
    arguments = parser.parse_args()
    jax.config.update("jax_enable_x64", True)
    try:
        if arguments.check:
            for check in (check_strapdown, check_paper, check_smoothers):
                check()
                print(f"{check.__name__}: agrees", flush=True)
        if arguments.time:
            print_times()
    except MissingPeer as missing:
        raise SystemExit(str(missing)) from None
    if arguments.paper:
        found = paper_way(bar_problem())
        print(
            f"J* {found.cost:.6f} in {found.seconds:.1f} s and {found.evaluations} evaluations: {found.message}"
        )


if __name__ == "__main__":
    main()
