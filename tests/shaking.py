"""A shaken sensor: what the tests of periodic motion share."""

import jax.numpy as jnp
import numpy as np

from jaxsat.signals.recording import Recording

RATE = 250.0
TIME = np.arange(1000) / RATE
FREQUENCY = jnp.array([10.0, 11.0, 11.5])


def sensed(order: int, time, amplitude: float = 0.2):
    """Acceleration or rate of sines, and the motion that it comes from."""
    omega = 2 * np.pi * np.asarray(FREQUENCY)
    angle = time[:, None] * omega
    motion = -np.sin(angle) / omega**2 if order == 2 else -np.cos(angle) / omega
    return jnp.asarray(amplitude * np.sin(angle).sum(axis=1)), jnp.asarray(amplitude * motion.sum(axis=1))


def recording(acc=None, gyr=None, rate=100.0, seconds=6.0, name="shaking") -> Recording:
    n = int(rate * seconds)
    missing = np.zeros((n, 6), bool)
    missing[:, :3], missing[:, 3:] = gyr is None, acc is None
    empty = np.zeros((n, 3))
    return Recording(
        np.arange(n) / rate, empty if gyr is None else gyr, empty if acc is None else acc, missing, name=name
    )


def shaken(rate=100.0, seconds=6.0, tilt=0.0):
    """A sensor shaken along x at 6 Hz by 1 mm, tilting about y by `tilt` rad at the same time."""
    time = np.arange(int(rate * seconds)) / rate
    omega = 2 * np.pi * 6
    position = 1e-3 * np.sin(omega * time)
    angle = tilt * np.sin(omega * time)
    noise = 0.005 * np.random.default_rng(2).normal(size=(len(time), 6))
    # R_nb = exp(angle about y): gravity 9.81 along z has −9.81 sin(angle) along the body's x.
    force = -(omega**2) * position + 0.0
    acc = np.stack(
        [
            force * np.cos(angle) - 9.81 * np.sin(angle),
            0 * time,
            force * np.sin(angle) + 9.81 * np.cos(angle),
        ],
        axis=1,
    )
    gyr = np.stack([0 * time, tilt * omega * np.cos(omega * time), 0 * time], axis=1)
    return position, angle, acc + noise[:, 3:], gyr + noise[:, :3]
