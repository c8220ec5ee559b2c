"""Linear algebra of a few joints, entry by entry, to run over any batch without LAPACK; many joints use LAPACK."""

from collections.abc import Sequence
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
from jax.scipy.linalg import solve_triangular
from jaxtyping import Array, Float

FEW_JOINTS = 7
"""Largest number of joints for which equations are written out and slopes folded; more take minutes to compile."""

Rows = tuple[tuple[Any, ...], ...]
"""Lower triangle of a symmetric matrix, row by row, as single numbers that are not joined in memory."""


def solve_spd(matrix: Float[Array, "nv nv"], right: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Solve a symmetric positive definite system by Cholesky's L D L' without square roots."""
    return solve_rows(rows_of(matrix), right)


def rows_of(matrix: Float[Array, "nv nv"]) -> Rows:
    """Return a symmetric matrix as rows."""
    return tuple(tuple(matrix[i, j] for j in range(i + 1)) for i in range(len(matrix)))


@jax.custom_jvp
def solve_rows(rows: Rows, right: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Solve the system of a matrix given by rows; the derivative uses the same factors: dx = A^-1 (db - dA x)."""
    return _substitute(_factorise(rows), right)


@solve_rows.defjvp
def _solve_tangent(given: tuple, tangents: tuple) -> tuple[Array, Array]:
    (rows, right), (by_rows, by_right) = given, tangents
    factors = _factorise(rows)
    solution = _substitute(factors, right)
    return solution, _substitute(factors, by_right - multiply(by_rows, solution))


def add_diagonal(rows: Rows, diagonal: Float[Array, "nv"]) -> Rows:
    """Add a vector to the diagonal."""
    return tuple((*row[:-1], row[-1] + entry) for row, entry in zip(rows, diagonal, strict=True))


def multiply(rows: Rows, vector: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Multiply a symmetric matrix by a vector."""
    if len(rows) > FEW_JOINTS:
        return jnp.matmul(_matrix(rows), vector, precision="highest")
    size = range(len(rows))
    return jnp.stack([_dot([rows[max(i, j)][min(i, j)] for j in size], list(vector)) for i in size])


class _Few(NamedTuple):
    """Factors of a small matrix, entry by entry: L below its diagonal of ones, and the inverse of D."""

    lower: list[list[Array]]
    inverse: list[Array]


class _Many(NamedTuple):
    matrix: Float[Array, "nv nv"]
    inverse: Float[Array, "nv nv"]


def _factorise(rows: Rows) -> _Few | _Many:
    if len(rows) > FEW_JOINTS:
        matrix = _matrix(rows)
        root = solve_triangular(jnp.linalg.cholesky(matrix), jnp.eye(len(rows), dtype=matrix.dtype), lower=True)
        return _Many(matrix, jnp.matmul(root.T, root, precision="highest"))
    lower: list[list[Array]] = []
    inverse: list[Array] = []
    for i, entries in enumerate(rows):
        row: list[Array] = []
        for j in range(i):
            row.append(entries[j] - _dot(row, lower[j]))
        scaled = [entry * inverse[j] for j, entry in enumerate(row)]
        inverse.append(1 / (entries[i] - _dot(row, scaled)))
        lower.append(scaled)
    return _Few(lower, inverse)


def _substitute(factors: _Few | _Many, right: Float[Array, "nv"]) -> Float[Array, "nv"]:
    if isinstance(factors, _Many):
        estimate = jnp.matmul(factors.inverse, right, precision="highest")
        # Refine with the residual: a product with the inverse alone rounds more than substitution.
        residual = right - jnp.matmul(factors.matrix, estimate, precision="highest")
        return estimate + jnp.matmul(factors.inverse, residual, precision="highest")
    solution: list[Array] = []
    for i, row in enumerate(factors.lower):
        solution.append(right[i] - _dot(row, solution[:i]))
    solution = [entry * factor for entry, factor in zip(solution, factors.inverse, strict=True)]
    for i in reversed(range(len(solution))):
        solution[i] = solution[i] - _dot([row[i] for row in factors.lower[i + 1 :]], solution[i + 1 :])
    return jnp.stack(solution)


def _matrix(rows: Rows) -> Float[Array, "nv nv"]:
    size = range(len(rows))
    return jnp.stack([jnp.asarray(rows[max(i, j)][min(i, j)]) for i in size for j in size]).reshape(len(rows), -1)


def _dot(one: Sequence[Any], other: Sequence[Any]) -> Any:
    products = [a * b for a, b in zip(one, other, strict=True)]
    return sum(products[1:], products[0]) if products else 0.0
