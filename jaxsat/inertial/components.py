"""Small vectors, rotations and matrices, one array per component.

Kept in one array, the components of many vectors lie side by side, and compiled code must slice, select and copy
between any two operations. One array per component makes every operation plain arithmetic on equal shapes, and
a chain of them one loop: the segment objective and its gradient are seven times faster on a CPU so. A component
may have any shape; components broadcast. In sums, scaling, dot, outer and matrix products zero as a Python number is
structural: it costs nothing and stays. Cross products, quaternions and `Cholesky` compute with it as with any number.
"""

import equinox as eqx
import jax.numpy as jnp
from jaxtyping import Array

Scalar = Array | float

# Below this squared angle (rad²) series replace trigonometric quotients; both agree to 1e-16 there.
SMALL = 1e-6


def _product(a: Scalar, b: Scalar) -> Scalar:
    return 0.0 if _is_zero(a) or _is_zero(b) else a * b


def _is_zero(a: Scalar) -> bool:
    return isinstance(a, float) and a == 0.0


def _sum(terms) -> Scalar:
    total = 0.0
    for term in terms:
        if not _is_zero(term):
            total = term if _is_zero(total) else total + term
    return total


class Vector(eqx.Module):
    """A vector in space."""

    x: Scalar
    y: Scalar
    z: Scalar

    @staticmethod
    def of(array: Array) -> "Vector":
        """From an array whose last axis is (x, y, z)."""
        return Vector(array[..., 0], array[..., 1], array[..., 2])

    def stack(self) -> Array:
        """Back to an array (..., 3)."""
        return jnp.stack(list(self), axis=-1)

    def __iter__(self):
        return iter((self.x, self.y, self.z))

    def __add__(self, other: "Vector") -> "Vector":
        return Vector(*(_sum(pair) for pair in zip(self, other, strict=True)))

    def __neg__(self) -> "Vector":
        return Vector(-self.x, -self.y, -self.z)

    def __sub__(self, other: "Vector") -> "Vector":
        return self + (-other)

    def __mul__(self, scalar: Scalar) -> "Vector":
        return Vector(*(_product(a, scalar) for a in self))

    def dot(self, other: "Vector") -> Scalar:
        return _sum(_product(a, b) for a, b in zip(self, other, strict=True))

    def cross(self, other: "Vector") -> "Vector":
        return Vector(
            self.y * other.z - self.z * other.y,
            self.z * other.x - self.x * other.z,
            self.x * other.y - self.y * other.x,
        )

    def outer(self, other: "Vector") -> "Matrix":
        return Matrix(tuple(tuple(_product(a, b) for b in other) for a in self))


class Quaternion(eqx.Module):
    """A rotation: unit, Hamilton, scalar first."""

    w: Scalar
    x: Scalar
    y: Scalar
    z: Scalar

    @staticmethod
    def of(array: Array) -> "Quaternion":
        """From an array whose last axis is (w, x, y, z)."""
        return Quaternion(array[..., 0], array[..., 1], array[..., 2], array[..., 3])

    @staticmethod
    def exp(phi: Vector) -> "Quaternion":
        """Of the rotation vector φ (rad); smooth at zero in derivatives of any order."""
        square = phi.dot(phi)
        small = square < SMALL
        angle = jnp.sqrt(jnp.where(small, 1.0, square))
        cosine = jnp.where(small, 1.0 - square / 8.0 + square**2 / 384.0, jnp.cos(0.5 * angle))
        sine = jnp.where(small, 0.5 - square / 48.0 + square**2 / 3840.0, jnp.sin(0.5 * angle) / angle)
        return Quaternion(cosine, sine * phi.x, sine * phi.y, sine * phi.z)

    def stack(self) -> Array:
        """Back to an array (..., 4)."""
        return jnp.stack(list(self), axis=-1)

    def __iter__(self):
        return iter((self.w, self.x, self.y, self.z))

    @property
    def vector(self) -> Vector:
        return Vector(self.x, self.y, self.z)

    def __matmul__(self, other: "Quaternion") -> "Quaternion":
        """Hamilton product: first `other`, then `self`."""
        p, q = self, other
        return Quaternion(
            p.w * q.w - p.x * q.x - p.y * q.y - p.z * q.z,
            p.w * q.x + p.x * q.w + p.y * q.z - p.z * q.y,
            p.w * q.y - p.x * q.z + p.y * q.w + p.z * q.x,
            p.w * q.z + p.x * q.y - p.y * q.x + p.z * q.w,
        )

    def conjugate(self) -> "Quaternion":
        return Quaternion(self.w, -self.x, -self.y, -self.z)

    def rotate(self, v: Vector) -> Vector:
        """q ⊗ v ⊗ q*."""
        t = self.vector.cross(v) * 2.0
        return v + t * self.w + self.vector.cross(t)

    def matrix(self) -> "Matrix":
        """R(q) with R(q) v = q ⊗ v ⊗ q*."""
        w, x, y, z = self
        return Matrix(
            (
                (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
                (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
                (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
            )
        )


class Matrix(eqx.Module):
    """A small matrix, row by row; a column is a matrix too."""

    rows: tuple[tuple[Scalar, ...], ...]

    @staticmethod
    def of(array: Array) -> "Matrix":
        """From an array whose last two axes are rows and columns."""
        rows, columns = array.shape[-2:]
        return Matrix(tuple(tuple(array[..., i, j] for j in range(columns)) for i in range(rows)))

    @staticmethod
    def identity(size: int, value: Scalar = 1.0) -> "Matrix":
        return Matrix(tuple(tuple(value if i == j else 0.0 for j in range(size)) for i in range(size)))

    @staticmethod
    def skew(v: Vector) -> "Matrix":
        """Cross-product matrix: skew(v) w = v × w."""
        return Matrix(((0.0, -v.z, v.y), (v.z, 0.0, -v.x), (-v.y, v.x, 0.0)))

    @staticmethod
    def column(values) -> "Matrix":
        return Matrix(tuple((value,) for value in values))

    @staticmethod
    def block(blocks) -> "Matrix":
        """From rows of blocks."""
        return Matrix(
            tuple(
                sum((block.rows[i] for block in row), ()) for row in blocks for i in range(len(row[0].rows))
            )
        )

    def stack(self) -> Array:
        """Back to an array (..., rows, columns)."""
        rows = [[jnp.asarray(a) for a in row] for row in self.rows]
        shape = jnp.broadcast_shapes(*(a.shape for row in rows for a in row))
        return jnp.stack(
            [jnp.stack([jnp.broadcast_to(a, shape) for a in row], axis=-1) for row in rows], axis=-2
        )

    def __getitem__(self, index: tuple[int, int]) -> Scalar:
        return self.rows[index[0]][index[1]]

    @property
    def T(self) -> "Matrix":
        return Matrix(tuple(zip(*self.rows, strict=True)))

    def part(self, rows: slice, columns: slice) -> "Matrix":
        return Matrix(tuple(row[columns] for row in self.rows[rows]))

    def __add__(self, other: "Matrix") -> "Matrix":
        return Matrix(
            tuple(
                tuple(_sum(pair) for pair in zip(*pairs, strict=True))
                for pairs in zip(self.rows, other.rows, strict=True)
            )
        )

    def __mul__(self, scalar: Scalar) -> "Matrix":
        return Matrix(tuple(tuple(_product(a, scalar) for a in row) for row in self.rows))

    def __neg__(self) -> "Matrix":
        return self * -1.0

    def __sub__(self, other: "Matrix") -> "Matrix":
        return self + (-other)

    def __matmul__(self, other: "Matrix") -> "Matrix":
        columns = other.T.rows
        return Matrix(
            tuple(
                tuple(_sum(_product(a, b) for a, b in zip(row, column, strict=True)) for column in columns)
                for row in self.rows
            )
        )

    def __call__(self, v: Vector) -> Vector:
        """Matrix times vector."""
        return Vector(*(_sum(_product(a, b) for a, b in zip(row, v, strict=True)) for row in self.rows))

    def mirrored(self) -> "Matrix":
        """A symmetric matrix from its upper triangle: the other one is not computed."""
        size = range(len(self.rows))
        return Matrix(tuple(tuple(self[min(i, j), max(i, j)] for j in size) for i in size))

    def trace(self) -> Scalar:
        return _sum(self[i, i] for i in range(len(self.rows)))

    def entries(self) -> tuple[Scalar, ...]:
        """All of them, row after row."""
        return sum(self.rows, ())


class Cholesky:
    """L Lᵀ = S of a symmetric positive definite matrix, without a library call; the diagonal is kept inverted."""

    def __init__(self, S: Matrix):
        n = len(S.rows)
        L: list[list[Scalar]] = [[0.0] * n for _ in range(n)]
        for i in range(n):
            for j in range(i + 1):
                rest = S[i, j] - _sum(_product(L[i][k], L[j][k]) for k in range(j))
                L[i][j] = 1.0 / jnp.sqrt(rest) if i == j else rest * L[j][j]
        self._L = L

    def forward(self, B: Matrix) -> Matrix:
        """L⁻¹ B."""
        rows: list[tuple[Scalar, ...]] = []
        for i, row in enumerate(B.rows):
            known = [_sum(_product(self._L[i][k], rows[k][c]) for k in range(i)) for c in range(len(row))]
            rows.append(tuple((b - a) * self._L[i][i] for a, b in zip(known, row, strict=True)))
        return Matrix(tuple(rows))

    def backward(self, B: Matrix) -> Matrix:
        """L⁻ᵀ B."""
        n = len(B.rows)
        rows: list[tuple[Scalar, ...]] = [()] * n
        for i in reversed(range(n)):
            known = [
                _sum(_product(self._L[k][i], rows[k][c]) for k in range(i + 1, n))
                for c in range(len(B.rows[i]))
            ]
            rows[i] = tuple((b - a) * self._L[i][i] for a, b in zip(known, B.rows[i], strict=True))
        return Matrix(tuple(rows))

    def solve(self, B: Matrix) -> Matrix:
        """S⁻¹ B."""
        return self.backward(self.forward(B))
