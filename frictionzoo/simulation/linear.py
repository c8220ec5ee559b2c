"""Linear algebra of a few joints, entry by entry, to run over any batch without LAPACK; many joints use LAPACK."""

from collections.abc import Callable, Sequence
from typing import Any

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
    return _factorise(rows)(right)


@solve_rows.defjvp
def _solve_tangent(given: tuple, tangents: tuple) -> tuple[Array, Array]:
    (rows, right), (by_rows, by_right) = given, tangents
    solve = _factorise(rows)
    solution = solve(right)
    return solution, solve(by_right - multiply(by_rows, solution))


def add_diagonal(rows: Rows, diagonal: Float[Array, "nv"]) -> Rows:
    """Add a vector to the diagonal."""
    return tuple((*row[:-1], row[-1] + entry) for row, entry in zip(rows, diagonal, strict=True))


def multiply(rows: Rows, vector: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Multiply a symmetric matrix by a vector."""
    if len(rows) > FEW_JOINTS:
        return jnp.matmul(_matrix(rows), vector, precision="highest")
    size = range(len(rows))
    return jnp.stack([_dot([rows[max(i, j)][min(i, j)] for j in size], list(vector)) for i in size])


def _factorise(rows: Rows) -> Callable[[Array], Array]:
    """Return a function that solves the matrix's system for a right side."""
    if len(rows) > FEW_JOINTS:
        return _factorise_many(_matrix(rows))
    lower: list[list[Array]] = []  # L below its diagonal of ones
    inverse: list[Array] = []  # of D
    for i, entries in enumerate(rows):
        row: list[Array] = []
        for j in range(i):
            row.append(entries[j] - _dot(row, lower[j]))
        scaled = [entry * inverse[j] for j, entry in enumerate(row)]
        inverse.append(1 / (entries[i] - _dot(row, scaled)))
        lower.append(scaled)

    def solve(right: Array) -> Array:
        solution: list[Array] = []
        for i, row in enumerate(lower):
            solution.append(right[i] - _dot(row, solution[:i]))
        solution = [entry * factor for entry, factor in zip(solution, inverse, strict=True)]
        for i in reversed(range(len(solution))):
            solution[i] = solution[i] - _dot([row[i] for row in lower[i + 1 :]], solution[i + 1 :])
        return jnp.stack(solution)

    return solve


def _factorise_many(matrix: Float[Array, "nv nv"]) -> Callable[[Array], Array]:
    root = solve_triangular(jnp.linalg.cholesky(matrix), jnp.eye(len(matrix), dtype=matrix.dtype), lower=True)
    inverse = jnp.matmul(root.T, root, precision="highest")

    def solve(right: Array) -> Array:
        estimate = jnp.matmul(inverse, right, precision="highest")
        # Refine with the residual: a product with the inverse alone rounds more than substitution.
        residual = right - jnp.matmul(matrix, estimate, precision="highest")
        return estimate + jnp.matmul(inverse, residual, precision="highest")

    return solve


def _matrix(rows: Rows) -> Float[Array, "nv nv"]:
    size = range(len(rows))
    return jnp.stack([jnp.asarray(rows[max(i, j)][min(i, j)]) for i in size for j in size]).reshape(len(rows), -1)


def _dot(one: Sequence[Any], other: Sequence[Any]) -> Any:
    products = [a * b for a, b in zip(one, other, strict=True)]
    return sum(products[1:], products[0]) if products else 0.0
