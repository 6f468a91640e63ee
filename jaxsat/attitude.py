"""The other way through the house: a recording and a configuration in, an attitude out, rests or not."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Float, Int

from jaxsat.config import Config
from jaxsat.errors import InputError
from jaxsat.inertial.good_gain import good_gain
from jaxsat.inertial.orientation import Gains, Start, euler_angles, orientation, start_at_rest
from jaxsat.saturation.interpolation import interpolate_gaps
from jaxsat.signals.checks import TILT, check
from jaxsat.signals.rails import Gaps, Rails, find_gaps, find_rails, saturation_mask
from jaxsat.signals.recording import Recording

FIRST = 1.0
"""The offset of the gyroscope is its mean over so long a rest at the start (s)."""
LONG_GAP = 0.1
"""Neighbours say little of a gap that lasts longer (s): a hand or a foot changes its rate within such a time."""
# One compilation for recordings of about the same length.
_BLOCK = 8192


class Orientation(eqx.Module):
    """All that `orient` found; attitudes are at the start of each sample."""

    recording: Recording
    config: Config = eqx.field(static=True)
    q_nb: Float[np.ndarray, "N 4"]
    """Body to navigation frame (z up, heading arbitrary)."""
    after: Float[np.ndarray, "N 4"]
    """Attitude at the end of each sample: what a filter says that has seen it."""
    euler: Float[np.ndarray, "N 3"]
    """Angles about x, y and z (rad), Q_z ⊗ Q_y ⊗ Q_x."""
    bias: Float[np.ndarray, "N 3"]
    """Offset of the gyroscope, that of the first second with what the integral learnt (rad/s)."""
    start: Start
    gains: Gains
    rails: Rails
    gaps: Gaps
    sign: Int[np.ndarray, "N 6"]
    """Direction of saturation of each value, 0 where there is none."""
    filled: Float[np.ndarray, "N 6"]
    warnings: list[str] = eqx.field(static=True)


def orient(recording: Recording, config: Config | None = None) -> Orientation:
    """The attitude of a recording by paper C, as `config.orientation` says; needs no rest but a first second.

    Computed in float64 whatever JAX's setting. Raises `InputError` where the accelerometer or the gyroscope is
    absent, the recording is shorter than its first second, or its units cannot be.
    """
    config = config or Config()
    _check_sensors(recording)
    warnings = check(recording)
    settings, period = config.orientation, recording.period
    rails = find_rails(recording, config.rails.gyr, config.rails.acc)
    saturated, sign = saturation_mask(recording, rails)
    first = _first_rest(recording)
    with jax.enable_x64(True):
        start = start_at_rest(jnp.asarray(recording.signal[:first]))
        if first < round(FIRST / period):
            start = eqx.tree_at(lambda s: s.offset, start, jnp.zeros(3))
            warnings.append(
                f"{recording.name}: the sensor moves within its first second: no gyroscope offset was taken off."
            )
        if config.gravity != "auto":
            start = eqx.tree_at(lambda s: s.gravity, start, jnp.asarray(float(config.gravity)))
        gains = _gains(recording, config, first)
        filled = recording.signal
        if settings.fill == "interpolate":
            rates = interpolate_gaps(recording.gyr, sign[:, :3], period)
            filled = np.concatenate([rates, recording.acc], axis=1)
        trusted = ~np.any((saturated | recording.missing).reshape(-1, 2, 3), axis=2)
        padded = _padded(filled, period, trusted)
        found, angles = _attitude(
            *padded, start, gains, settings.estimate, settings.update, settings.direction
        )
    n, gaps = len(recording), find_gaps(sign)
    long = int(np.sum((gaps.end - gaps.start)[gaps.channel < 3] > LONG_GAP / period))
    if long and settings.fill == "interpolate":
        warnings.append(
            f"{recording.name}: {long} gaps in the rates last longer than {LONG_GAP:g} s: what fills them is a "
            "guess, and the attitude after them may be far off."
        )
    q_nb = np.asarray(found.q_nb)
    return Orientation(
        recording=recording,
        config=config,
        q_nb=q_nb[:n],
        after=q_nb[1 : n + 1],
        euler=np.asarray(angles)[:n],
        bias=(np.asarray(start.offset) - np.asarray(found.integral))[:n],
        start=jax.tree.map(np.asarray, start),
        gains=jax.tree.map(np.asarray, gains),
        rails=rails,
        gaps=gaps,
        sign=sign,
        filled=filled,
        warnings=warnings,
    )


def _check_sensors(recording: Recording) -> None:
    name, missing = recording.name, recording.missing
    for what, channels in (("gyroscope", slice(0, 3)), ("accelerometer", slice(3, 6))):
        if missing[:, channels].all(axis=0).any():
            raise InputError(
                f"{name}: the {what} is missing, but orientation needs both sensors; add its three channels."
            )
    length = len(recording) * recording.period
    if length < FIRST:
        raise InputError(
            f"{name}: only {length:.2f} s, but the offset of the gyroscope needs a first second at rest; "
            "record for longer."
        )


def _first_rest(recording: Recording) -> int:
    """Samples of the first second, or of its first fifth (which a check saw at rest) if the sensor moves later.

    It rests if what it turns beside a constant offset, and what its specific force turns, stay within `TILT`.
    """
    n = round(FIRST / recording.period)
    rate, fifth = recording.gyr[:n], max(1, n // 5)
    wandered = np.abs(np.cumsum(rate - rate.mean(axis=0), axis=0)).max() * recording.period
    early, late = recording.acc[:fifth].mean(axis=0), recording.acc[n - fifth : n].mean(axis=0)
    tilted = np.linalg.norm(late - early) / np.linalg.norm(early)
    return n if max(wandered, tilted) <= TILT else fifth


def _gains(recording: Recording, config: Config, first: int) -> Gains:
    settings = config.orientation
    kp, ki, tau = settings.kp, settings.ki, settings.tau
    if settings.gains == "good_gain":
        proposed = good_gain(recording.signal[:first], recording.period, tau)
        kp, ki = proposed.kp, proposed.ki
    gate = np.inf if settings.gate == "none" else float(settings.gate)
    return jax.tree.map(lambda x: jnp.asarray(x, float), Gains(kp, ki, tau, gate, settings.limit))


def _padded(signal: Float[np.ndarray, "N 6"], period: float, trusted):
    extra = -len(signal) % _BLOCK
    rows = ((0, extra), (0, 0))
    return np.pad(signal, rows), np.pad(np.full(len(signal), period), (0, extra)), np.pad(trusted, rows)


@eqx.filter_jit
def _attitude(signal, period, trusted, start: Start, gains: Gains, estimate, update, direction):
    found = orientation(
        signal, period, trusted, start, gains, estimate=estimate, update=update, direction=direction
    )
    return found, jax.vmap(euler_angles)(found.q_nb)
