"""A bare strapdown pass over the samples, compiled by numba for all cores."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
from jaxtyping import Float

from jaxsat.inertial.strapdown import NavState
from jaxsat.studies.simulate import GRAVITY

from . import import_peer, numpy_state


def bare_trials(trials: int, count: int) -> tuple[np.ndarray, NavState]:
    """Lively random signals and first states: a bare pass takes as long for any."""
    rng = np.random.default_rng(0)
    signal = rng.normal(size=(trials, count, 6)) * np.repeat([3.0, 5.0], 3) + [0, 0, 0, 0, 0, GRAVITY]
    q_nb = rng.normal(size=(trials, 4))
    q_nb /= np.linalg.norm(q_nb, axis=1, keepdims=True)
    return signal, numpy_state(q_nb, rng.normal(size=(trials, 3)), rng.normal(size=(trials, 3)))


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
    return numpy_state(states[..., :4], states[..., 4:7], states[..., 7:])


@cache
def _strapdown_kernel() -> Callable:
    """Compile the pass: 64 trials side by side in vector lanes, groups of them on the cores."""
    numba = import_peer("numba")
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
