"""Linear algebra of a few joints, written out entry by entry so that it runs over any batch without LAPACK."""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

Rows = tuple[tuple[Any, ...], ...]
"""A symmetric matrix by its lower triangle, row by row: single numbers, which are not put together in memory."""


def solve_spd(matrix: Float[Array, "nv nv"], right: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Solution of a symmetric positive definite system, by Cholesky's L D L' without square roots."""
    return solve_rows(tuple(tuple(matrix[i, j] for j in range(i + 1)) for i in range(len(right))), right)


@jax.custom_jvp
def solve_rows(rows: Rows, right: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """The same of a matrix by its rows. The derivative has the same factors: dx = A^-1 (db - dA x)."""
    return _substitute(_factorise(rows), right)


@solve_rows.defjvp
def _solve_tangent(given: tuple, tangents: tuple) -> tuple[Array, Array]:
    (rows, right), (by_rows, by_right) = given, tangents
    factors = _factorise(rows)
    found = _substitute(factors, right)
    return found, _substitute(factors, by_right - multiply(by_rows, found))


def add_diagonal(rows: Rows, diagonal: Float[Array, "nv"]) -> Rows:
    """The matrix with this on its diagonal too."""
    return tuple((*row[:-1], row[-1] + more) for row, more in zip(rows, diagonal, strict=True))


def multiply(rows: Rows, vector: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """A symmetric matrix times a vector."""
    size = range(len(rows))
    return jnp.stack([_dot([rows[max(i, j)][min(i, j)] for j in size], list(vector)) for i in size])


def _factorise(rows: Rows) -> tuple[list[list[Array]], list[Array]]:
    """L below its diagonal of ones, and the inverse of D."""
    lower: list[list[Array]] = []
    inverse: list[Array] = []
    for i, entries in enumerate(rows):
        row: list[Array] = []
        for j in range(i):
            row.append(entries[j] - _dot(row, lower[j]))
        scaled = [entry * inverse[j] for j, entry in enumerate(row)]
        inverse.append(1 / (entries[i] - _dot(row, scaled)))
        lower.append(scaled)
    return lower, inverse


def _substitute(factors: tuple[list[list[Array]], list[Array]], right: Float[Array, "nv"]) -> Float[Array, "nv"]:
    lower, inverse = factors
    found: list[Array] = []
    for i, row in enumerate(lower):
        found.append(right[i] - _dot(row, found[:i]))
    found = [entry * factor for entry, factor in zip(found, inverse, strict=True)]
    for i in reversed(range(len(found))):
        found[i] = found[i] - _dot([row[i] for row in lower[i + 1 :]], found[i + 1 :])
    return jnp.stack(found)


def _dot(one: Sequence[Any], other: Sequence[Any]) -> Any:
    products = [a * b for a, b in zip(one, other, strict=True)]
    return sum(products[1:], products[0]) if products else 0.0
