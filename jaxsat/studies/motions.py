"""Motions as functions of time, for simulation.

Every motion starts at the origin with the identity attitude, has four continuous derivatives and stands
exactly still outside its moving intervals.
"""

import abc

import equinox as eqx
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsat.errors import InputError
from jaxsat.inertial.rotations import quat_exp, quat_multiply, quat_rotate


def _ramp(x: Float[Array, ""]) -> Float[Array, ""]:
    """From 0 to 1 over 0 ≤ x ≤ 1 with four zero derivatives at both ends; slope 315/128 in the middle."""
    x = jnp.clip(x, 0.0, 1.0)

    def lower(x):
        return x**5 * (126.0 + x * (-420.0 + x * (540.0 + x * (-315.0 + x * 70.0))))

    # Each half from its own end: there the value is exact, and its derivatives are exactly zero.
    return jnp.where(x < 0.5, lower(x), 1.0 - lower(1.0 - x))


def _bump(x: Float[Array, ""]) -> Float[Array, ""]:
    """Up to 1 in the middle of 0 ≤ x ≤ 1 and down again."""
    return _ramp(2.0 * x) - _ramp(2.0 * x - 1.0)


class Motion(eqx.Module):
    """A motion as a function of time (SI units, radians); raises `InputError` where intervals overlap."""

    @abc.abstractmethod
    def pose(self, t: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        """Position r_n (m) and attitude q_nb at time t (s)."""

    @property
    @abc.abstractmethod
    def moving(self) -> Float[np.ndarray, "M 2"]:
        """Starts and ends of the moving intervals (s), in order."""

    def __check_init__(self):
        starts, ends = self.moving.T
        # Rounding may overlap two intervals that touch.
        if not (len(starts) and np.all(starts < ends) and np.all(starts[1:] - ends[:-1] > -1e-9)):
            name = type(self).__name__
            raise InputError(f"{name}: moving intervals are empty or overlap; correct its times.")


class _Single(Motion):
    """One movement between two rests."""

    start: float = 0.5
    """When it begins (s)."""
    duration: float = 1.0
    """How long it lasts (s)."""

    @property
    def moving(self) -> Float[np.ndarray, "M 2"]:
        return np.array([[self.start, self.start + self.duration]])

    def _progress(self, t: Float[Array, ""]) -> Float[Array, ""]:
        return _ramp((t - self.start) / self.duration)


class Bar(_Single):
    """A sensor at the end of a bar that swings over the top about the body's y axis (Dang & Suh 2014, §6).

    The rate is one bell with a peak of 315/128 `sweep`/`duration`: 11.0 rad/s unless told otherwise.
    """

    radius: float = 0.5
    """Length of the bar (m)."""
    sweep: float = np.pi
    """Angle that it turns by (rad)."""
    start: float = 0.45
    duration: float = 0.7

    def pose(self, t: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        angle = self.sweep * self._progress(t)
        zero = jnp.zeros_like(angle)
        # The pivot lies ahead of the sensor, so that it first rises.
        position = self.radius * jnp.stack([1.0 - jnp.cos(angle), zero, jnp.sin(angle)])
        return position, quat_exp(jnp.stack([zero, angle, zero]))


class Line(_Single):
    """A straight slide along the body's x axis: specific force x peaks near 9.4 `length`/`duration`²."""

    length: float = 0.95
    """Distance (m)."""
    duration: float = 0.8
    haste: float = 0.0
    """How much harder it is pushed than braked, −1 to 1: with 0.5 the peaks are 14.3 and 10.1."""

    def pose(self, t: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        x = jnp.clip((t - self.start) / self.duration, 0.0, 1.0)
        way = self.length * _ramp(x + self.haste * x * (1.0 - x))
        zero = jnp.zeros_like(way)
        return jnp.stack([way, zero, zero]), quat_exp(jnp.stack([zero, zero, zero]))


class Planar(_Single):
    """A hump in the horizontal plane, the x axis along the path: it turns left, right (the fastest) and left.

    The path is y = `width` sin²(π x/`length`); the turn at its top peaks near
    4.9 π² `width`/`length`/`duration`: 9.7 rad/s unless told otherwise.
    """

    length: float = 0.5
    """Distance from start to stop (m)."""
    width: float = 0.15
    """Height of the hump (m)."""
    duration: float = 1.5

    def pose(self, t: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        progress = self._progress(t)
        zero = jnp.zeros_like(progress)
        y = self.width * jnp.sin(jnp.pi * progress) ** 2
        heading = jnp.arctan2(self.width * jnp.pi * jnp.sin(2.0 * jnp.pi * progress), self.length)
        return jnp.stack([self.length * progress, y, zero]), quat_exp(jnp.stack([zero, zero, heading]))


class Joint(Motion):
    """A joint bends about one axis, out to `angle`, over to minus `angle` and back, again and again.

    The rates peak at 315/128 `angle`/`quarter`.
    """

    axis: Float[Array | np.ndarray, "3"] = eqx.field(
        default_factory=lambda: np.array([1.0, 0.0, 0.0]), converter=np.asarray
    )
    """Unit vector, in the body."""
    lever: Float[Array | np.ndarray, "3"] = eqx.field(
        default_factory=lambda: np.full(3, 0.1), converter=np.asarray
    )
    """From the joint to the sensor (m)."""
    angle: float = np.pi / 2
    """rad"""
    repetitions: int = 6
    quarter: float = 1.15
    """Time from the middle to either end (s)."""
    start: float = 1.5

    @property
    def moving(self) -> Float[np.ndarray, "M 2"]:
        return np.array([[self.start, self.start + 4.0 * self.quarter * self.repetitions]])

    def pose(self, t: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        quarters = jnp.clip((t - self.start) / self.quarter, 0.0, 4.0 * self.repetitions)
        phase = quarters - 4.0 * jnp.floor(quarters / 4.0)
        bend = _ramp(phase) - 2.0 * _ramp((phase - 1.0) / 2.0) + _ramp(phase - 3.0)
        q_nb = quat_exp(self.angle * bend * jnp.asarray(self.axis))
        lever = jnp.asarray(self.lever)
        return quat_rotate(q_nb, lever) - lever, q_nb


class Walk(Motion):
    """A walking foot (x ahead, y left): strides over level ground, each a swing and then a stance at rest.

    The foot pitches toes-down at push-off (rate y positive), toes-up through the swing (negative, fastest)
    and lands flat; the peaks are near 6.6 and −8 rad/s unless told otherwise.
    """

    strides: int = 10
    length: float = 1.3
    """Distance from one foothold to the next (m)."""
    height: float = 0.08
    """Clearance of the foot in the middle of a swing (m)."""
    swing: float = 0.75
    """Time in motion per stride (s)."""
    stance: float = 0.35
    """Time at rest per stride (s)."""
    heel_rise: float = 1.0
    """Pitch of the push-off (rad, toes down)."""
    toe_rise: float = 0.35
    """Pitch before landing (rad, toes up)."""
    turn: float = 0.0
    """Change of heading per stride (rad, to the left)."""
    start: float = 1.0

    @property
    def moving(self) -> Float[np.ndarray, "M 2"]:
        starts = self.start + np.arange(self.strides) * (self.swing + self.stance)
        return np.stack([starts, starts + self.swing], axis=1)

    def pose(self, t: Float[Array, ""]) -> tuple[Float[Array, "3"], Float[Array, "4"]]:
        stride_time = self.swing + self.stance
        stride = jnp.clip(jnp.floor((t - self.start) / stride_time), 0.0, self.strides - 1.0)
        phase = (t - self.start - stride * stride_time) / self.swing
        progress = _ramp(phase)
        along = self._foothold(stride) + progress * (self._foothold(stride + 1.0) - self._foothold(stride))
        position = jnp.append(along, self.height * _bump(phase))

        push_off = _ramp(phase / 0.5)
        swing_through = _ramp((phase - 0.3) / 0.55)
        land = _ramp((phase - 0.7) / 0.3)
        pitch = self.heel_rise * (push_off - swing_through) - self.toe_rise * (swing_through - land)
        zero = jnp.zeros_like(pitch)
        heading = self.turn * (stride + progress)
        level = quat_exp(jnp.stack([zero, zero, heading]))
        return position, quat_multiply(level, quat_exp(jnp.stack([zero, pitch, zero])))

    def _foothold(self, n: Float[Array, ""]) -> Float[Array, "2"]:
        """Sum of the first n strides, Σ (cos, sin)((j + ½) turn): a sum of equal turns has a closed form."""
        straight = jnp.abs(self.turn) < 1e-8
        half = jnp.where(straight, 1.0, 0.5 * self.turn)
        chord = jnp.where(straight, n, jnp.sin(n * half) / jnp.sin(half))
        direction = 0.5 * n * self.turn
        return self.length * chord * jnp.stack([jnp.cos(direction), jnp.sin(direction)])


MOTIONS: dict[str, type[Motion]] = {"bar": Bar, "joint": Joint, "line": Line, "planar": Planar, "walk": Walk}
