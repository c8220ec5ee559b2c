"""Normal equations: a sum of squares near a vector in a few numbers, in place of millions of residuals."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

_NOTHING = 1e-24  # curvature, as a share of the largest, below which it is rounding


class NormalEquations(NamedTuple):
    """Objective near a vector, as a linear least-squares problem; arrays in float64.

    Attributes:
        loss: The objective.
        gradient: Half its gradient, J' r.
        hessian: Half the Gauss-Newton approximation of its second derivative, J' J, with `bend` where errors have a
            width.
        begun: Start of the search for initial states at another vector; None where they are not estimated.
    """

    loss: float
    gradient: Float[np.ndarray, "coordinates"]
    hessian: Float[np.ndarray, "coordinates coordinates"]
    begun: Any = None

    @property
    def finite(self) -> bool:
        """Whether loss, gradient and Hessian are finite."""
        return all(np.isfinite(part).all() for part in self[:3])


Evaluate = Callable[[Float[np.ndarray, "coordinates"]], NormalEquations]
"""Function of a vector that gives the normal equations there."""

Scores = Callable[
    [Float[np.ndarray, "coordinates"]], tuple[NormalEquations, Float[np.ndarray, "stretches coordinates"]]
]
"""Function of a vector that gives the normal equations there, and the gradient of each stretch of time."""


def compress(
    equations: NormalEquations, unit: float
) -> tuple[Float[np.ndarray, "compressed"], Float[np.ndarray, "compressed coordinates"]]:
    """Return n + 1 residuals and their Jacobian with the loss, gradient and J' J of n coordinates, all over `unit`.

    With J' J = V diag(w) V', the Jacobian is diag(sqrt(w)) V', and the residuals are diag(1 / sqrt(w)) V' J' r. The
    last residual is the remainder, which no coordinate changes.
    """
    curvature = np.diag(equations.hessian)
    least = max(_NOTHING * np.abs(curvature).max(initial=0.0), np.finfo(float).tiny)  # rounding leaves negative ones
    scale = np.sqrt(np.maximum(curvature, least))
    eigenvalues, vectors = np.linalg.eigh(equations.hessian / np.outer(scale, scale))
    kept = eigenvalues > np.finfo(float).eps * len(scale) * max(eigenvalues[-1], 0)
    roots = np.sqrt(np.where(kept, eigenvalues, 0.0))
    jacobian = roots[:, None] * vectors.T * scale
    inside = np.where(kept, vectors.T @ (equations.gradient / scale), 0.0) / np.where(kept, roots, 1.0)
    remainder = np.sqrt(max(equations.loss - inside @ inside, 0.0))
    root = np.sqrt(unit)
    return np.append(inside, remainder) / root, np.vstack([jacobian, np.zeros(len(scale))]) / root


def bounded_step(
    gradient: Float[np.ndarray, "coordinates"],
    hessian: Float[np.ndarray, "coordinates coordinates"],
    low: Float[np.ndarray, "coordinates"],
    high: Float[np.ndarray, "coordinates"],
) -> Float[np.ndarray, "coordinates"]:
    """Return the step to the minimum of a quadratic within bounds, exactly on a bound where it is active.

    Source: P. Stark, R. Parker, "Bounded-Variable Least-Squares: an Algorithm and Applications", 1995.
    """
    scale = np.sqrt(np.maximum(np.diag(hessian), np.finfo(float).tiny))
    residual, slopes = compress(NormalEquations(0.0, gradient, hessian), 1.0)
    solution = scipy.optimize.lsq_linear(slopes / scale, -residual, (low * scale, high * scale), "bvls")
    return np.where(solution.active_mask < 0, low, np.where(solution.active_mask > 0, high, solution.x / scale))
