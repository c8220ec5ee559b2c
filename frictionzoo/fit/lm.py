"""Levenberg-Marquardt with exact Jacobians, by scipy's trust-region solver for bounded least squares."""

from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, refuse_outside
from frictionzoo.fit.base import Evaluation, Fit, as_start, refuse_nothing, refuse_torch, register_method
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.normal_equations import NormalEquations, trust_region
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.space import Space

MOST_TRIES = 10_000  # the Hessian of every try is kept; ten tries are usual
MOST_COORDINATES = 200  # the Jacobian has a column per coordinate; more coordinates are a network's weights
_ALIKE = 1e-2  # relative difference up to which two losses count as equal
_PATIENCE = 3  # tries after which a search ends if the loss has fallen by a negligible amount
_SLACK = 30.0  # multiples of the floating-point precision below which a change of the loss is rounding


class SolverState(NamedTuple):
    """Record of all vectors tried, from which the solver's next vector follows.

    Attributes:
        tried: Number of vectors tried.
        asked: The vector to try next, or the last one if the solver has ended, of shape (coordinates,).
        ended: Whether the solver has converged.
        loss: The objective at each vector tried, of shape (iterations,).
        gradient: Half its gradient, (iterations, coordinates).
        hessian: Half its approximate second derivative, (iterations, coordinates, coordinates).
        begun: Start of the search for initial states at the next vector; None where they are not estimated.
    """

    tried: np.ndarray
    asked: np.ndarray
    ended: np.ndarray
    loss: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    begun: Any


@register_method("lm")
class LevenbergMarquardt(Fit):
    """scipy's `least_squares`, method `trf`: a trust region within bounds, coordinates scaled by Jacobian columns.

    A long log has millions of residuals. For n coordinates the solver gets n + 1 numbers with the same sum of squares,
    gradient and approximate second derivative instead. One iteration evaluates one vector.

    Source: K. Levenberg 1944; D. Marquardt 1963; M. Branch, T. Coleman, Y. Li, "A Subspace, Interior, and Conjugate
    Gradient Method for Large-Scale Bound-Constrained Minimization Problems", 1999, for the bounds.

    Args:
        iterations: Largest number of vectors to try.
        tolerance: Relative change of the loss or of the vector below which the fit has converged; never below a small
            multiple of the floating-point precision. With multiple shooting (`refine`), the fit also ends after three
            tries that together change no parameter by more than a third of its standard error.
        start: The method whose result is the starting point, such as `InverseDynamics`; None for the initial values.

    Raises:
        ConfigError: An argument is out of range.
    """

    traced = False

    def __init__(self, iterations: int = 100, tolerance: float = 1e-8, start: Fit | None = None) -> None:
        refuse_outside("fit.iterations", iterations, 1, MOST_TRIES)
        refuse_tolerance(tolerance)
        self.start = as_start(start)
        self._iterations = iterations
        self._tolerance = tolerance

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; refuses networks, whose Jacobian has too many columns, and models only in torch."""
        refuse_nothing(objective)
        refuse_torch(objective, self.name)
        refuse_many(objective.space, "fit=lm", "use fit=adam")
        return self._iterations

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """See `Fit.init`."""
        start = np.asarray(objective.space.start, np.float64)
        equations = np.zeros(self._iterations), *(np.zeros((self._iterations, *[len(start)] * axes)) for axes in (1, 2))
        state = SolverState(np.asarray(0), start, np.asarray(False), *equations, begun=objective.begun)
        asked = _ask(objective, state, self._tolerance).asked
        return start, state._replace(asked=asked)

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Evaluation, Any, Any]:
        """See `Fit.step`; tries `state.asked`, the solver's vector in float64."""
        result = objective.beginning(state.begun).compile_normal_equations()(state.asked)
        row = int(state.tried)
        # The start must have finite equations; after a later vector without them the solver shortens its step.
        diverged = row == 0 and not result.finite
        equations = [part.copy() for part in (state.loss, state.gradient, state.hessian)]
        before = state.loss[:row]
        least = np.min(before, initial=np.inf, where=np.isfinite(before))  # of the vectors without divergence
        begun = result.begun if is_near(result.loss, least) else state.begun
        for part, value in zip(equations, result[:3], strict=True):
            part[row] = value
        following = SolverState(np.asarray(row + 1), state.asked, state.ended, *equations, begun=begun)
        following = following if diverged else _ask(objective, following, self._tolerance)
        return Evaluation(result.loss, 2 * result.gradient, diverged), following.asked, following

    def done(self, state: Any) -> Any:
        """See `Fit.done`."""
        return state.ended

    def prepare(self, objective: Objective) -> None:
        """See `Fit.prepare`."""
        objective.compile_normal_equations()


def refuse_many(space: Space, option: str, remedy: str) -> None:
    """Raise ConfigError for more coordinates than a Jacobian has columns."""
    coordinates = len(space.start)
    if coordinates > MOST_COORDINATES:
        raise ConfigError(
            f"{option}: {coordinates} coordinates ({space.names[-1]} among them), expected at most {MOST_COORDINATES}; "
            f"{remedy}"
        )


def refuse_tolerance(tolerance: float) -> None:
    """Raise ConfigError if the tolerance is not between 0 and 1."""
    if not 0 < tolerance < 1:
        raise ConfigError(f"fit.tolerance={tolerance}; expected a number between 0 and 1")


def is_near(loss: float, least: float) -> bool:
    """Return whether the initial states at a vector with this loss are a good start for the next vector's."""
    return bool(loss < (1 + _ALIKE) * least)


class _AskedError(Exception):
    """Request of the solver for a vector that has not been tried."""


def _ask(objective: Objective, state: SolverState, tolerance: float) -> SolverState:
    """Return the state with the next vector of scipy's solver, or with the mark that it has ended.

    The solver cannot be paused. It runs again from the start on the recorded results, a fraction of a millisecond per
    vector, and asks for the same vectors in the same order. Where initial states are estimated, the loss is known to
    the accuracy of their search, and the solver's own criteria may never hold.
    """
    space, replayed, asked = objective.space, 0, state.asked
    least = np.minimum.accumulate(np.where(np.isfinite(state.loss), state.loss, np.inf)[: int(state.tried)])
    if len(least) > _PATIENCE and least[-1 - _PATIENCE] - least[-1] < objective.negligible * least[-1]:
        return state._replace(ended=np.asarray(True))
    tolerance = max(tolerance, _SLACK * float(np.finfo(space.start.dtype).eps))

    def replay(vector: Float[np.ndarray, "coordinates"]) -> NormalEquations:
        nonlocal replayed, asked
        if replayed == int(state.tried):
            asked = vector.copy()
            raise _AskedError
        replayed += 1
        return NormalEquations(*(part[replayed - 1] for part in (state.loss, state.gradient, state.hessian)))

    try:
        converged = trust_region(replay, space.box, len(state.loss), tolerance)[2]
    except _AskedError:
        return state._replace(asked=asked)
    return state._replace(ended=np.asarray(converged))
