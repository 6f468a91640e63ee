"""Gains by gradient: what lowers the loss is found."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxsat.inertial.orientation import Gains, Start
from jaxsat.studies.tuning import Trials, inclination_loss, tune_gains

RATE, G = 100.0, 9.81
LEVEL = Start(jnp.array([1.0, 0.0, 0.0, 0.0]), jnp.zeros(3), jnp.asarray(G))


def test_tuning_finds_what_lowers_the_loss_and_its_gradient_is_right(key):
    n = 1500
    signal = np.tile([0.0, 0.0, 0.0, 0.0, 0.0, G], (n, 1))
    signal += np.repeat([0.002, 1.0], 3) * np.asarray(jax.random.normal(key, (n, 6)))
    signal[:, 0] += 0.01
    trials = Trials(
        jnp.asarray(signal)[None],
        jnp.full((1, n), 1 / RATE),
        jnp.ones((1, n, 2), bool),
        jax.tree.map(lambda x: x[None], LEVEL),
        jnp.tile(jnp.array([0.0, 0.0, 1.0]), (1, n, 1)),
        jnp.ones((1, n), bool),
    )
    first = Gains(0.02, 1e-3, 0.1)
    tuned = tune_gains(trials, first, steps=25, rate=0.4)
    assert inclination_loss(trials, tuned) < 0.3 * inclination_loss(trials, first)
    assert float(tuned.kp) > 0.1
