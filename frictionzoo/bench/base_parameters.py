"""Base parameters: identifiable combinations of the parameters of a linear regression."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

DEPENDENT = 1e-7
"""A column depends on the previous columns below this relative residual of its projection onto them."""
_NOTHING = 1e-9  # deviation of a coefficient from 1 that counts as rounding


@dataclass(frozen=True)
class BaseParameters:
    """Minimal set of parameter combinations that determines a regressor's output, one per row of `matrix`.

    Each combination has a leading parameter with coefficient 1; `leading` has its index.
    """

    names: tuple[str, ...]
    leading: tuple[int, ...]
    matrix: Float[np.ndarray, "base parameters"]

    @property
    def combined(self) -> tuple[str, ...]:
        """Parameters that are identifiable only in combination with others."""
        grouped = (self.matrix != 0)[(self.matrix != 0).sum(axis=1) > 1].any(axis=0)
        return tuple(name for name, is_grouped in zip(self.names, grouped, strict=True) if is_grouped)

    def describe(self) -> list[str]:
        """Return each combination as text: `Izz link_1 + Iyy link_2 + 0.05 m link_3`."""
        return [self._say(row, first) for row, first in zip(self.matrix, self.leading, strict=True)]

    def _say(self, row: Float[np.ndarray, "parameters"], first: int) -> str:
        text = self.names[first]
        for index in np.flatnonzero(row):
            if index != first:
                size = abs(row[index])
                factor = "" if abs(size - 1) < _NOTHING else f"{size:.4g} "
                text += f" {'+' if row[index] > 0 else '-'} {factor}{self.names[index]}"
        return text


def find_base_parameters(
    regressor: Float[np.ndarray, "rows parameters"], names: Sequence[str], dependent: float = DEPENDENT
) -> BaseParameters:
    """Return the base parameters of a regressor: its independent columns, with the dependent ones grouped into them.

    Order a robot's bodies from the base outwards, which groups parameters of outer bodies into inner bodies, as usual.
    Random states give the structurally identifiable parameters; a recording's states give those that it excites.

    Source: M. Gautier, "Numerical calculation of the base inertial parameters of robots", 1991, with a selection of
    columns in their order instead of a QR decomposition that drops the smallest diagonal entries.
    """
    triangle = np.asarray(np.linalg.qr(regressor, mode="r"))
    basis, independent = np.zeros((len(triangle), 0)), []
    lengths = np.linalg.norm(triangle, axis=0)
    for index, column in enumerate(triangle.T):
        residual = column - basis @ (basis.T @ column)
        residual = residual - basis @ (basis.T @ residual)  # a second time against rounding errors
        if np.linalg.norm(residual) > dependent * max(lengths[index], dependent * lengths.max()):
            basis = np.column_stack([basis, residual / np.linalg.norm(residual)])
            independent.append(index)
    effective = lengths > dependent * lengths.max()
    grouped = np.setdiff1d(np.flatnonzero(effective), independent)
    matrix = np.zeros((len(independent), len(names)))
    matrix[np.arange(len(independent)), independent] = 1
    if len(grouped):
        factors = np.linalg.lstsq(triangle[:, independent], triangle[:, grouped], rcond=None)[0]
        scale = np.abs(factors).max(initial=1.0)
        matrix[:, grouped] = np.where(np.abs(factors) > dependent * scale, factors, 0)
    return BaseParameters(tuple(names), tuple(independent), matrix)
