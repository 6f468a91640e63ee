"""Linear algebra of dense matrices that may run side by side on a CPU.

The LAPACK kernels of jaxlib split a batch over the threads that they run on themselves, and wait: as many such calls
at a time as there are cores wait for each other for ever (seen with jaxlib 0.10.2 on two cores: an inverse beside a
search that factorises). So on a CPU each matrix of a batch is a call of its own, which waits for nothing.
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def one_by_one(function: Callable) -> Callable:
    """The same function; under `vmap` on a CPU called for one element of the batch after the other."""
    single = jax.custom_batching.sequential_vmap(function)

    def call(*matrices):
        return jax.lax.platform_dependent(*matrices, cpu=single, default=function)

    return call


_solve_positive = one_by_one(
    lambda matrix, right: jax.scipy.linalg.cho_solve((jnp.linalg.cholesky(matrix), True), right)
)
_inverse_root = one_by_one(
    lambda matrix: jax.scipy.linalg.solve_triangular(
        jnp.linalg.cholesky(matrix), jnp.eye(len(matrix), dtype=matrix.dtype), lower=True
    )
)
_eigh = one_by_one(lambda matrix: tuple(jnp.linalg.eigh(matrix)))


def product(a: Float[Array, "i j"], b: Float[Array, "j k"]) -> Float[Array, "i k"]:
    """a @ b of matrices with few columns and rows, term by term.

    XLA makes a library call of each product in a batch: for 64 lanes of 6 × 6 that is five times slower.
    """
    terms = [a[:, j, None] * b[j][None] for j in range(a.shape[1])]
    return sum(terms[1:], terms[0])


def total(x: Float[Array, "n *k"]) -> Float[Array, "*k"]:
    """The sum over the leading axis.

    Compiled for a CPU, `jnp.sum` adds one term after the other, each waiting for the last; halves are added side by
    side.
    """
    odd = []
    while len(x) > 8:
        half = len(x) // 2
        odd += [x[-1]] if len(x) % 2 else []
        x = x[:half] + x[half : 2 * half]
    return sum(odd, jnp.sum(x, axis=0))


def solve_positive(matrix: Float[Array, "n n"], right: Float[Array, "n *k"]) -> Float[Array, "n *k"]:
    """x of matrix @ x = right with a positive definite matrix."""
    return _solve_positive(matrix, right)


def inverse_root(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """W, lower triangular, with WᵀW the inverse of a positive definite matrix."""
    return _inverse_root(matrix)


def inverse_positive(matrix: Float[Array, "n n"]) -> Float[Array, "n n"]:
    """The inverse of a positive definite matrix."""
    root = inverse_root(matrix)
    return root.T @ root


def eigh(matrix: Float[Array, "n n"]) -> tuple[Float[Array, "n"], Float[Array, "n n"]]:
    """Eigenvalues, rising, and eigenvectors (columns) of a symmetric matrix."""
    return _eigh(matrix)
