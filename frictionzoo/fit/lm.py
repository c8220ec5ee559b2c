"""Levenberg-Marquardt on exact Jacobians, by scipy's trust-region solver for bounded least squares."""

from collections.abc import Callable
from typing import Any, NamedTuple

import numpy as np
import scipy.optimize
from jaxtyping import Float

from frictionzoo.core.errors import ConfigError, refuse_outside
from frictionzoo.fit.base import Fit, Seen, as_start, refuse_nothing, refuse_torch, register_method
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.normal_equations import NormalEquations, bounded_step, compress
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.torque_balance import Box

MOST_TRIES = 10_000  # each is remembered with its second derivative; ten are usual
MOST_COORDINATES = 200  # a Jacobian has a column for each: more are a network's weights
_ALIKE = 1e-2  # share of a loss by which another is as good
_LEAST = 1e-6  # damping, as a share of each curvature: combinations that the data do not determine stay as they are
_SOFT, _STIFFEST = 0.1, 1e6  # damping after a step that was of no use, and with which none is but by rounding
_SLACK = 30.0  # of the floating-point type's precision, below which a change of the loss is rounding


class State(NamedTuple):
    """What was found so far, from which the solver tells the next vector whenever it is asked.

    Attributes:
        tried: How many vectors.
        asked: The vector that is tried next, or the last one where the solver has ended, of shape (coordinates,).
        ended: Whether the solver has ended of itself.
        loss: The objective at each vector that was tried, of shape (iterations,).
        gradient: Half its gradient, (iterations, coordinates).
        hessian: Half its approximate second derivative, (iterations, coordinates, coordinates).
        states: Where the search for initial states at the next one begins; None where none are refined.
    """

    tried: np.ndarray
    asked: np.ndarray
    ended: np.ndarray
    loss: np.ndarray
    gradient: np.ndarray
    hessian: np.ndarray
    states: Any


@register_method("lm")
class LevenbergMarquardt(Fit):
    """scipy's `least_squares`, method `trf`: a trust region within bounds, each coordinate scaled by its column.

    The solver is given not the residuals, of which a long log has millions, but n + 1 numbers of the same sum of
    squares, gradient and approximate second derivative for n coordinates. An iteration is one vector that it asks for.

    Source: K. Levenberg 1944; D. Marquardt 1963; M. Branch, T. Coleman, Y. Li, "A Subspace, Interior, and Conjugate
    Gradient Method for Large-Scale Bound-Constrained Minimization Problems", 1999, for the bounds.

    Args:
        iterations: Largest number of vectors that are tried.
        tolerance: Relative change of the loss or of the vector from which on the fit has converged; in float32 at least
            its precision.
        start: The method at whose end this one begins, such as `InverseDynamics`; None: at the initial values.

    Raises:
        ConfigError: An argument is out of range.
    """

    traced = False

    def __init__(self, iterations: int = 100, tolerance: float = 1e-8, start: Fit | None = None) -> None:
        refuse_outside("fit.iterations", iterations, 1, MOST_TRIES)
        if not 0 < tolerance < 1:
            raise ConfigError(f"fit.tolerance={tolerance}; expected a number between 0 and 1")
        self.start = as_start(start)
        self._iterations = iterations
        self._tolerance = tolerance

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; not for a network, whose Jacobian has too many columns, nor a law only in torch."""
        refuse_nothing(objective)
        refuse_torch(objective, self.name)
        coordinates = len(objective.space.start)
        if coordinates > MOST_COORDINATES:
            raise ConfigError(
                f"fit=lm: {coordinates} coordinates ({objective.space.names[-1]} among them), expected at most "
                f"{MOST_COORDINATES}; use fit=adam"
            )
        return self._iterations

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """See `Fit.init`."""
        start = np.asarray(objective.space.start, np.float64)
        equations = np.zeros(self._iterations), *(np.zeros((self._iterations, *[len(start)] * axes)) for axes in (1, 2))
        state = State(np.asarray(0), start, np.asarray(False), *equations, states=objective.begun)
        asked = _ask(objective, state, self._tolerance).asked
        return start, state._replace(asked=asked)

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Seen, Any, Any]:
        """See `Fit.step`; what is tried is the vector that the solver asked for, in its own precision."""
        found = objective.beginning(state.states).compile_normal_equations()(state.asked)
        at = int(state.tried)
        # A start without finite equations is none; from a later vector, the solver tries a shorter step.
        lost = at == 0 and not found.finite
        equations = [part.copy() for part in (state.loss, state.gradient, state.hessian)]
        before = state.loss[:at]
        least = np.min(before, initial=np.inf, where=np.isfinite(before))  # of those at which nothing diverged
        states = found.states if is_near(found.loss, least) else state.states
        for part, value in zip(equations, found[:3], strict=True):
            part[at] = value
        following = State(np.asarray(at + 1), state.asked, state.ended, *equations, states=states)
        following = following if lost else _ask(objective, following, self._tolerance)
        return Seen(found.loss, 2 * found.gradient, lost), following.asked, following

    def done(self, state: Any) -> Any:
        """See `Fit.done`."""
        return state.ended

    def prepare(self, objective: Objective) -> None:
        """See `Fit.prepare`."""
        objective.compile_normal_equations()


def is_near(loss: float, least: float) -> bool:
    """Whether initial states of a vector with this loss are a good start for those of the next vector."""
    return bool(loss < (1 + _ALIKE) * least)


class _AskedError(Exception):
    """The solver asks for a vector that was not tried yet."""


def _ask(objective: Objective, state: State, tolerance: float) -> State:
    """The state with the vector that scipy's solver tries next, or with its end.

    The solver cannot be stopped and asked; it is run again from the start over what was found, and asks for the same
    vectors in the same order. That takes a fraction of a millisecond for each, simulating one takes many.
    """
    space, asked = objective.space, [state.asked]
    tolerance = max(tolerance, _SLACK * float(np.finfo(space.start.dtype).eps))
    low, high, start = (np.asarray(side, np.float64) for side in (space.low, space.high, space.start))
    unit = float(state.loss[0]) or 1.0  # tolerances mean shares of it
    known: list[NormalEquations] = []

    def residuals(vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "compressed"]:
        at = len(known)
        if at == int(state.tried):
            asked.append(vector.copy())
            raise _AskedError
        equations = NormalEquations(*(part[at] for part in (state.loss, state.gradient, state.hessian)))
        known.append(equations)
        if not equations.finite:
            return np.full(len(vector) + 1, np.inf)  # the solver takes it back and tries a shorter step
        finite.append(equations)
        return compress(equations, unit)[0]

    finite: list[NormalEquations] = []
    try:
        found = _solve(
            residuals, lambda: compress(finite[-1], unit)[1], Box(start, low, high), tolerance, len(state.loss)
        )
    except _AskedError:
        return state._replace(asked=asked[-1])
    return state._replace(ended=np.asarray(found.status > 0))  # 0: the number of vectors is used up


def descend(
    evaluate: Callable[[Float[np.ndarray, "coordinates"]], NormalEquations],
    box: Box,
    tries: int,
    tolerance: float,
    enough: Callable[[Float[np.ndarray, "coordinates"]], bool] = lambda vector: False,
) -> tuple[Float[np.ndarray, "coordinates"], float]:
    """The least of a sum of squares that steps of Gauss, Newton, Levenberg and Marquardt come to, and where.

    Each goes to the least of the objective's quadratic within the bounds; scipy's go half the way to one at most, and
    shorten those of all coordinates beside it.

    Args:
        evaluate: The objective near a vector.
        box: Where to begin, and bounds.
        tries: Largest number of vectors that are tried.
        tolerance: Share of the objective by which a step has to promise to lower it.
        enough: Of a vector that is to be tried, whether the search ends there instead.

    Returns:
        The best vector and its loss; infinite where the objective is not finite at the beginning.
    """
    at, damping = np.clip(*box), _LEAST
    found = evaluate(at)
    if not found.finite:
        return at, np.inf
    for _ in range(tries - 1):
        stiff = found.hessian * (1 + damping * np.eye(len(at)))
        step = bounded_step(found.gradient, stiff, box.low - at, box.high - at)
        promised = -float(2 * step @ found.gradient + step @ found.hessian @ step)
        if promised <= tolerance * found.loss or damping > _STIFFEST or enough(tried := at + step):
            break
        there = evaluate(tried)
        if there.finite and there.loss < found.loss:
            at, found, damping = tried, there, damping / 10 if damping > _SOFT else _LEAST
        else:
            damping = max(10 * damping, _SOFT)
    return at, found.loss


def _solve(
    residuals: Callable[[np.ndarray], np.ndarray],
    slopes: Callable[[], np.ndarray],
    box: Box,
    tolerance: float,
    most: int,
) -> Any:
    """What scipy's solver answers, of residuals and their Jacobian where they were last asked for."""
    return scipy.optimize.least_squares(
        residuals,
        np.clip(*box),
        jac=lambda vector: slopes(),  # pyright: ignore[reportArgumentType] - one of its kinds
        bounds=(box.low, box.high),
        x_scale="jac",
        ftol=tolerance,
        xtol=tolerance,
        gtol=tolerance,
        max_nfev=most,
    )
