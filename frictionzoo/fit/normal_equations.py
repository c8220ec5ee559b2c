"""Normal equations, a sum of squares near a vector in a few numbers, and two solvers for functions that give them."""

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from frictionzoo.fit.space import Box

NOTHING = 1e-24  # curvature, as a share of the largest, below which it is rounding
_STIFFEST = 1e6  # damping above which only rounding could lower the loss
_PACE = 3  # number of vectors over which a search's pace is measured


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
    least = max(NOTHING * np.abs(curvature).max(initial=0.0), np.finfo(float).tiny)  # rounding leaves negative ones
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

    Coordinates without effect do not move.

    Source: P. Stark, R. Parker, "Bounded-Variable Least-Squares: an Algorithm and Applications", 1995.
    """
    curvature, step = np.diag(hessian), np.zeros(len(gradient))
    moves = curvature > NOTHING * curvature.max(initial=0.0)  # rounding alone would take others to a bound
    if not moves.any():
        return step
    scale = np.sqrt(curvature[moves])
    residual, slopes = compress(NormalEquations(0.0, gradient[moves], hessian[np.ix_(moves, moves)]), 1.0)
    low, high = low[moves], high[moves]
    solution = scipy.optimize.lsq_linear(slopes / scale, -residual, (low * scale, high * scale), "bvls")
    step[moves] = np.where(solution.active_mask < 0, low, np.where(solution.active_mask > 0, high, solution.x / scale))
    return step


class Damping(NamedTuple):
    """Levenberg-Marquardt damping, as a share of each curvature.

    Attributes:
        least: At least; a successful step divides the damping by 10. Above 0, combinations that the data do not
            determine do not move.
        failed: At least, after a failed step.
    """

    least: float
    failed: float


DAMPING = Damping(1e-6, 0.1)


def descend(
    evaluate: Evaluate,
    box: Box,
    tries: int,
    tolerance: float,
    *,
    damping: Damping = DAMPING,
    lengths: Sequence[float] = (1.0,),
    enough: Callable[[Float[np.ndarray, "coordinates"]], bool] = lambda vector: False,
    patience: Sequence[tuple[int, float]] = (),
    goal: float = np.inf,
) -> tuple[Float[np.ndarray, "coordinates"], float, bool]:
    """Minimise a sum of squares by Levenberg-Marquardt steps within bounds.

    Each step goes to the minimum of the objective's quadratic model within the bounds. scipy's steps go at most half
    the way to a bound, and shorten the step of all other coordinates with it.

    The search ends after `tries` vectors; when the predicted decrease is below the share `tolerance` of the objective;
    when `enough` holds for the next vector, before that is tried; when the loss falls by less than a share within a
    number of vectors, which `patience` lists; or when at the pace of the last vectors the remaining ones would not
    bring it below `goal`. `lengths` are the shares of a step to try until one succeeds.

    Returns:
        The best vector; its loss, infinite where the objective is not finite at the start; whether it has converged.
    """
    best, stiffness, losses = box.start, damping.least, list[float]()
    equations = evaluate(best)
    if not equations.finite:
        return best, np.inf, False
    for _ in range(tries - 1):
        losses.append(equations.loss)
        if any(len(losses) > n and equations.loss > (1 - share) * losses[-1 - n] for n, share in patience):
            break
        if len(losses) > _PACE:
            reachable = (tries - len(losses)) * (losses[-1 - _PACE] - equations.loss) / _PACE
            if equations.loss - reachable > goal:
                break
        stiff = equations.hessian * (1 + stiffness * np.eye(len(best)))
        step = bounded_step(equations.gradient, stiff, box.low - best, box.high - best)
        decrease = -float(2 * step @ equations.gradient + step @ equations.hessian @ step)
        if decrease <= tolerance * equations.loss or stiffness > _STIFFEST:
            return best, equations.loss, True
        if enough(best + step):
            break
        for length in lengths:
            trial = evaluate(best + length * step)
            if trial.finite and trial.loss < equations.loss:
                best, equations = best + length * step, trial
                if length == 1:  # slowly: the damping that just failed would fail again
                    stiffness = max(stiffness / 10, damping.least)
                break
        else:
            stiffness = max(10 * stiffness, damping.failed)
    return best, equations.loss, False


def trust_region(
    evaluate: Evaluate, box: Box, tries: int, tolerance: float
) -> tuple[Float[np.ndarray, "coordinates"], float, bool]:
    """Minimise a sum of squares by scipy's `least_squares`, method `trf`; see `LevenbergMarquardt`.

    Returns:
        The best vector, its loss, and whether it has converged.

    Raises:
        ValueError: The objective is not finite at the start.
    """
    finite: list[NormalEquations] = []
    unit = 1.0

    def residuals(vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "compressed"]:
        nonlocal unit
        equations = evaluate(vector)
        if not equations.finite:
            return np.full(len(vector) + 1, np.inf)  # the solver rejects the step and tries a shorter one
        unit = unit if finite else equations.loss or 1.0  # makes the tolerances relative to the initial loss
        finite.append(equations)
        return compress(equations, unit)[0]

    result = scipy.optimize.least_squares(
        residuals,
        np.clip(*box),
        jac=lambda vector: compress(finite[-1], unit)[1],  # pyright: ignore[reportArgumentType] - one of its kinds
        bounds=box[1:],
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
        max_nfev=tries,
    )
    return result.x, 2 * result.cost * unit, result.status > 0  # 0: all tries used
