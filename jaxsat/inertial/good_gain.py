"""Gains that the Good Gain method proposes for the PI controller of `orientation`, from a step response."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxsat.errors import InputError
from jaxsat.inertial.orientation import Gains, Start, orientation, start_at_rest, up_in_body
from jaxsat.inertial.programs import computing
from jaxsat.inertial.rotations import quat_conjugate, quat_exp, quat_multiply, quat_rotate

STEP = np.deg2rad(10.0)
"""Height of the step (rad): small enough that sin(STEP) is STEP to half a per cent."""
VISIBLE = 0.005
"""An undershoot is barely observable from this share of the step on, or from three sd of the noise."""
_LADDER = 96


def good_gain(rest: Float[np.ndarray, "n 6"], period: float, tau: float = 0.0) -> Gains:
    """Gains that the Good Gain method proposes for a recording, from a stretch of it at rest.

    F. Haugen, Modeling, Identification and Control 33(4), 2012, as paper C names it. The P controller alone starts
    `STEP` off level; K_GG is the least gain whose response overshoots and then barely undershoots, T_ou the time
    between the two. Proposed are kp = 0.8 K_GG and ki = kp/(1.5 T_ou). The loop is an integrator: without a
    low-pass (tau, s) it overshoots only where a sample corrects by more than the whole error, so that what is
    proposed follows the accelerometer within samples.

    rest: angular rate and specific force (rad/s, m/s²), repeated for as long as the response takes; period: s.
    Raises `InputError` where no gain of the ladder responds so.
    """
    # A damped swing of a loop with a low-pass takes about 4π τ to show both.
    n = int(np.ceil(16.0 * tau / period)) + 100
    kp = np.geomspace(0.02 if tau else 0.1 / period, 3.9 / period, _LADDER)
    with computing():
        signal = jnp.asarray(np.resize(rest, (n, 6)))
        start = start_at_rest(jnp.asarray(rest))
        response = np.asarray(
            _responses(signal, jnp.asarray(period), start, jnp.asarray(kp), jnp.asarray(tau))
        )
    for gain, y in zip(kp, response, strict=True):
        between = _over_to_under(y)
        if between is not None:
            proposed = 0.8 * gain
            return Gains(proposed, proposed / (1.5 * between * period), tau)
    raise InputError(
        "Good Gain: no gain makes the response overshoot and undershoot; give a longer or quieter rest."
    )


@eqx.filter_jit
def _responses(signal, period, start: Start, kp: Float[Array, "K"], tau) -> Float[Array, "K M"]:
    """Tilt about x (in steps) over time, of each gain."""
    tilted = eqx.tree_at(
        lambda s: s.q_nb, start, quat_multiply(quat_exp(jnp.array([STEP, 0.0, 0.0])), start.q_nb)
    )
    n = len(signal)

    def response(gain):
        gains = Gains(gain, jnp.zeros_like(gain), tau)
        q_nb = orientation(signal, jnp.full(n, period), jnp.ones((n, 2), bool), tilted, gains).q_nb
        return (
            jax.vmap(lambda q: jnp.cross(up_in_body(start.q_nb), up_in_body(q)) @ _axis(start))(q_nb) / STEP
        )

    return jax.vmap(response)(kp)


def _axis(start: Start) -> Float[Array, "3"]:
    """The navigation frame's x axis seen from the body at the start, with the sign that makes the step +1."""
    return -quat_rotate(quat_conjugate(start.q_nb), jnp.array([1.0, 0.0, 0.0]))


def _over_to_under(y: Float[np.ndarray, "M"]) -> int | None:
    """Samples from the overshoot to the undershoot that follows it; None where they cannot be seen."""
    settled = y[-len(y) // 4 :]
    y = y - settled.mean()
    seen = max(VISIBLE, 3.0 * float(settled.std()))
    below = np.flatnonzero(y < -seen)
    if not len(below):
        return None
    rises = np.flatnonzero(y[below[0] :] > 0.0)
    if not len(rises):
        return None
    crossing = below[0] + rises[0]
    over = below[0] + int(np.argmin(y[below[0] : crossing]))
    falls = np.flatnonzero(y[crossing:] < 0.0)
    under = crossing + int(np.argmax(y[crossing : crossing + (falls[0] if len(falls) else len(y))]))
    return int(under - over) if y[under] > seen else None
