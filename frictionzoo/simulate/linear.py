"""Linear algebra of a few joints, written out entry by entry so that it runs over any batch without LAPACK."""

import jax.numpy as jnp
from jaxtyping import Array, Float


def solve_spd(matrix: Float[Array, "nv nv"], right: Float[Array, "nv"]) -> Float[Array, "nv"]:
    """Solution of a symmetric positive definite system, by Cholesky's L D L' without square roots."""
    size = len(right)
    if size == 1:
        return right / matrix[0]
    lower: list[list[Array]] = []
    inverse: list[Array] = []
    for i in range(size):
        row: list[Array] = []
        for j in range(i):
            row.append(matrix[i, j] - sum(row[k] * lower[j][k] for k in range(j)))
        scaled = [entry * inverse[j] for j, entry in enumerate(row)]
        inverse.append(1 / (matrix[i, i] - sum(entry * other for entry, other in zip(row, scaled, strict=True))))
        lower.append(scaled)
    found: list[Array] = []
    for i in range(size):
        found.append(right[i] - sum(lower[i][k] * found[k] for k in range(i)))
    found = [entry * factor for entry, factor in zip(found, inverse, strict=True)]
    for i in reversed(range(size)):
        found[i] = found[i] - sum(lower[k][i] * found[k] for k in range(i + 1, size))
    return jnp.stack(found)
