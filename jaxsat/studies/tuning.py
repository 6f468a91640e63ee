"""Parameters by gradient of an error against a reference, on trials named for it."""

from collections.abc import Callable
from typing import cast

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import optax
from jaxtyping import Array, Bool, Float

from jaxsat.inertial.orientation import Direction, Estimate, Gains, Start, orientation, up_in_body


class Trials(eqx.Module):
    """Recordings with a reference, one a row (B leads everywhere); period zero pads."""

    signal: Float[Array, "B N 6"]
    period: Float[Array, "B N"]
    trusted: Bool[Array, "B N 2"]
    start: Start
    up: Float[Array, "B N 3"]
    """The true vertical in the body after each sample."""
    scored: Bool[Array, "B N"]


def inclination_loss(
    trials: Trials, gains: Gains, estimate: Estimate = "pi", direction: Direction = "mean"
) -> Float[Array, ""]:
    """Mean over trials of the mean squared inclination error (rad², of the chord between the verticals)."""

    def one(trial: Trials):
        found = orientation(
            trial.signal,
            trial.period,
            trial.trusted,
            trial.start,
            gains,
            estimate=estimate,
            direction=direction,
        )
        chord = jax.vmap(up_in_body)(found.q_nb[1:]) - trial.up
        square = jnp.where(trial.scored, jnp.sum(chord**2, axis=1), 0.0)
        return jnp.sum(square) / jnp.maximum(jnp.sum(trial.scored, dtype=square.dtype), 1.0)

    return jnp.mean(jax.vmap(one)(trials))


def tune_gains(
    trials: Trials,
    initial: Gains,
    *,
    estimate: Estimate = "pi",
    direction: Direction = "mean",
    steps: int = 30,
    rate: float = 0.2,
    report: Callable[[int, float, Gains], None] = lambda *_: None,
) -> Gains:
    """The gains of least `inclination_loss` on some trials, by Adam on the logarithms of kp, ki and tau.

    `gate` and `limit` stay as they are, and a zero stays zero. Returns the best of all steps. Three parameters and
    long recordings: the gradient is forward-mode, at the cost of three more passes and no memory.
    """

    def loss(logs, frozen: Gains):
        kp, ki, tau = (jnp.exp(x) for x in logs)
        return inclination_loss(trials, Gains(kp, ki, tau, frozen.gate, frozen.limit), estimate, direction)

    @eqx.filter_jit
    def value_and_gradient(logs):
        # One pass carries the value and its three tangents.
        value, tangents = jax.vmap(
            lambda tangent: jax.jvp(lambda x: loss(x, initial), (logs,), (tangent,)), out_axes=(None, 0)
        )(jnp.eye(3, dtype=logs.dtype))
        return value, jnp.where(jnp.isfinite(logs), tangents, 0.0)

    logs = jnp.log(jnp.stack([initial.kp, initial.ki, initial.tau]))
    optimiser = optax.adam(rate)
    state = optimiser.init(logs)
    best, lowest = logs, np.inf
    for k in range(steps):
        value, gradient = value_and_gradient(logs)
        kp, ki, tau = jnp.exp(logs)
        report(k, float(value), Gains(kp, ki, tau, initial.gate, initial.limit))
        if float(value) < lowest:
            best, lowest = logs, float(value)
        # Optax counts in integers and mixes them with floats.
        with jax.numpy_dtype_promotion("standard"):
            updates, state = optimiser.update(gradient, state)
            logs = cast(Array, optax.apply_updates(logs, updates))
    kp, ki, tau = jnp.exp(best)
    return Gains(kp, ki, tau, initial.gate, initial.limit)
