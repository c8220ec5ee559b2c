"""Base parameters: what of a linear model's parameters its data can tell at all."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float

DEPENDENT = 1e-7
"""Share of a column's length that is left beside the columns before it, below which it is a combination of them."""
_NOTHING = 1e-9  # coefficient, as a share of a group's largest, that is rounding


@dataclass(frozen=True)
class BaseParameters:
    """The fewest combinations of parameters that say all that a regressor sees of them.

    Attributes:
        names: Of the parameters.
        leading: Index of the parameter that each combination is named after and contains once.
        matrix: The combinations, in rows, of the parameters.
    """

    names: tuple[str, ...]
    leading: tuple[int, ...]
    matrix: Float[np.ndarray, "base parameters"]

    @property
    def unseen(self) -> tuple[str, ...]:
        """Parameters without any effect."""
        return self._pick(~self.matrix.any(axis=0))

    @property
    def combined(self) -> tuple[str, ...]:
        """Parameters that have an effect only together with others."""
        grouped = (self.matrix != 0)[(self.matrix != 0).sum(axis=1) > 1].any(axis=0)
        return self._pick(grouped)

    def describe(self) -> list[str]:
        """Each combination in words: `Izz link_1 + Iyy link_2 + 0.05 m link_3`."""
        return [self._say(row, first) for row, first in zip(self.matrix, self.leading, strict=True)]

    def _say(self, row: Float[np.ndarray, "parameters"], first: int) -> str:
        text = self.names[first]
        for index in np.flatnonzero(row):
            if index != first:
                size = abs(row[index])
                factor = "" if abs(size - 1) < _NOTHING else f"{size:.4g} "
                text += f" {'+' if row[index] > 0 else '-'} {factor}{self.names[index]}"
        return text

    def _pick(self, chosen: Any) -> tuple[str, ...]:
        return tuple(name for name, taken in zip(self.names, chosen, strict=True) if taken)


def find_base_parameters(
    regressor: Float[np.ndarray, "rows parameters"], names: Sequence[str], dependent: float = DEPENDENT
) -> BaseParameters:
    """The base parameters of a regressor: columns that the ones before them do not explain, with those that they do.

    Of a robot, give the bodies from the base on: what a joint cannot tell of the bodies behind it is then grouped into
    those before it, as usual. Random states show what the structure allows; those of a recording, what it excites.

    Source: M. Gautier, "Numerical calculation of the base inertial parameters of robots", 1991, with columns taken
    up in their order in place of a QR decomposition that drops the smallest diagonal entries.

    Args:
        regressor: Effect of each parameter on each measurement.
        names: Of the parameters.
        dependent: As `DEPENDENT`.
    """
    triangle = np.asarray(np.linalg.qr(regressor, mode="r"))
    basis, kept = np.zeros((len(triangle), 0)), []
    lengths = np.linalg.norm(triangle, axis=0)
    for index, column in enumerate(triangle.T):
        rest = column - basis @ (basis.T @ column)
        rest = rest - basis @ (basis.T @ rest)  # once more, for what rounding left
        if np.linalg.norm(rest) > dependent * max(lengths[index], dependent * lengths.max()):
            basis = np.column_stack([basis, rest / np.linalg.norm(rest)])
            kept.append(index)
    seen = lengths > dependent * lengths.max()
    others = np.setdiff1d(np.flatnonzero(seen), kept)
    matrix = np.zeros((len(kept), len(names)))
    matrix[np.arange(len(kept)), kept] = 1
    if len(others):
        factors = np.linalg.lstsq(triangle[:, kept], triangle[:, others], rcond=None)[0]
        scale = np.abs(factors).max(initial=1.0)
        matrix[:, others] = np.where(np.abs(factors) > dependent * scale, factors, 0)
    return BaseParameters(tuple(names), tuple(kept), matrix)
