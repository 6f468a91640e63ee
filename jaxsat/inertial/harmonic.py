"""A band of frequencies fitted by regularised least squares, recursively or at once, with its uncertainty.

The reference input of the combiners in `periodic`, without their LMS: signal s_k = x_kᵀw + e_k with noise variance
σ² and a Gaussian prior of variance λ on each weight. The prior makes frequencies closer than the inverse of the
duration, which the data cannot tell apart, harmless.
"""

import equinox as eqx
import jax
import jax.numpy as jnp
from jax.scipy.linalg import cho_factor, cho_solve
from jaxtyping import Array, Float


class Fit(eqx.Module):
    """Posterior of the weights."""

    weights: Float[Array, "W"]
    covariance: Float[Array, "W W"]


class Tracked(eqx.Module):
    """What the recursion knew after each sample."""

    motion: Float[Array, "N"]
    variance: Float[Array, "N"]
    surprise: Float[Array, "N"]
    """Squared error of each sample's prediction over its variance: 1 on average if the variances are right, 0 where
    nothing was measured."""
    fit: Fit
    """After the last sample."""


class Spectrum(eqx.Module):
    """Variances that the data themselves were found to have."""

    prior: Float[Array, "W"]
    """λ of each weight."""
    noise: Float[Array, ""]
    """σ²."""


def least_squares(
    signal: Float[Array, "N"],
    weight: Float[Array, "N"],
    x: Float[Array, "N W"],
    spectrum: Spectrum,
) -> Fit:
    """argmin_w Σ_k weight_k (s_k − x_kᵀw)²/σ² + Σ_i w_i²/λ_i, and the inverse of half its Hessian.

    weight: 1 where measured, 0 where not. Tikhonov regularisation, or Bayesian linear regression (Bishop 2006,
    Eq. 3.53-3.54). Solved in w/√λ, so that λ = 0 leaves a weight out and tiny ones do no harm.
    """
    root = jnp.sqrt(spectrum.prior)
    scaled = x * root[None, :]
    hessian = jnp.eye(x.shape[1], dtype=x.dtype) + scaled.T @ (scaled * weight[:, None]) / spectrum.noise
    factor = cho_factor(hessian, lower=True)
    weights = cho_solve(factor, scaled.T @ (weight * signal)) / spectrum.noise
    covariance = cho_solve(factor, jnp.eye(x.shape[1], dtype=x.dtype))
    return Fit(root * weights, root[:, None] * covariance * root[None, :])


def predict(fit: Fit, z: Float[Array, "N W"]) -> tuple[Float[Array, "N"], Float[Array, "N"]]:
    """Mean and variance of z_kᵀw: the motion for x̂, the signal for x."""
    return z @ fit.weights, jnp.sum((z @ fit.covariance) * z, axis=1)


def recursive(
    signal: Float[Array, "N"],
    weight: Float[Array, "N"],
    x: Float[Array, "N W"],
    z: Float[Array, "N W"],
    spectrum: Spectrum,
    drift: Float[Array, "W"],
) -> Tracked:
    """The same least squares sample by sample: a Kalman filter whose state is w, a random walk of variance `drift`
    a sample. With drift = 0 it is recursive least squares, and ends at what `least_squares` gives.

    Causal: row k knows samples 0 to k (Ljung 1999, System Identification, 11.2-11.3).
    """
    identity = jnp.eye(x.shape[1], dtype=x.dtype)

    def step(carry, row):
        w, P = carry
        s, m, reference, output = row
        P = P + jnp.diag(drift)
        expected = reference @ P @ reference + spectrum.noise
        error = s - reference @ w
        gain = m * (P @ reference) / expected
        # Joseph's form keeps the covariance positive.
        A = identity - gain[:, None] * reference[None, :]
        P = A @ P @ A.T + spectrum.noise * gain[:, None] * gain[None, :]
        w = w + gain * error
        return (w, P), (output @ w, output @ P @ output, m * error**2 / expected)

    first = (jnp.zeros(x.shape[1], x.dtype), jnp.diag(spectrum.prior))
    (w, P), (motion, variance, surprise) = jax.lax.scan(step, first, (signal, weight, x, z))
    return Tracked(motion, variance, surprise, Fit(w, P))


def learn(
    signal: Float[Array, "V N"],
    weight: Float[Array, "V N"],
    x: Float[Array, "N W"],
    group: Float[Array, "W W"],
    start: Spectrum,
    iterations: int,
) -> Spectrum:
    """λ and σ² by expectation-maximisation of the evidence, common to V stretches of a signal.

    group: averages λ over the weights that share one, such as sine and cosine (rows sum to 1). Bishop 2006,
    Eq. 9.62-9.63; an iteration never lowers the evidence where groups do not overlap.
    """

    def one(s, m, spectrum):
        fit = least_squares(s, m, x, spectrum)
        mean, variance = predict(fit, x)
        return fit.weights**2 + jnp.diagonal(fit.covariance), jnp.sum(m * ((s - mean) ** 2 + variance))

    def step(_, spectrum):
        power, rest = jax.lax.map(lambda row: one(row[0], row[1], spectrum), (signal, weight))
        return Spectrum(group @ jnp.mean(power, axis=0), jnp.sum(rest) / jnp.sum(weight))

    return jax.lax.fori_loop(0, iterations, step, start)
