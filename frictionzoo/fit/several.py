"""Multi-start: Levenberg-Marquardt from several starting points, among them the fits of nested models."""

import logging
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool, Float

from frictionzoo.core.errors import refuse_outside
from frictionzoo.core.telling import tell_progress
from frictionzoo.fit.base import Evaluation, Fit, register_method
from frictionzoo.fit.blocks import Blocks
from frictionzoo.fit.contained import Part
from frictionzoo.fit.lm import MOST_TRIES, LevenbergMarquardt, is_near, refuse_tolerance
from frictionzoo.fit.normal_equations import NOTHING, NormalEquations, descend
from frictionzoo.fit.objective import Objective
from frictionzoo.fit.space import Box
from frictionzoo.models import FrictionModel

_log = logging.getLogger(__name__)

_SHARES = (1.0, 0.5, 0.0)  # shares of the best delay that are tried with the initial armature
_ALIKE = 0.2  # difference in an armature's coordinate below which the armature counts as the same
_SHIFTS = (-1.0, -0.5, 0.5, 1.0)  # sample intervals added to the best delay
_SHORT = 12  # largest number of vectors after a shift: a minimum is near, or this delay has none
_NEAR = 0.2  # difference in sample intervals below which two delays lead to the same minimum
_FAR = 2.0  # largest change of any coordinate that follows a shifted delay
_ROUNDS = 5  # rounds of shifts, each from the best result so far
_FLAT = 1e-8  # curvature of a combination, as a share of the largest, below which it does not follow the delay
_RIVALS = (8, 0.2)  # vectors within which the loss must fall by this share if there are other starting points
_LOWER = 1e-6  # share of the loss by which another minimum must be lower


class End(NamedTuple):
    """Result of one search: its starting point, the best coordinates, and the loss, infinite if the start has none."""

    name: str
    vector: Float[np.ndarray, "coordinates"]
    loss: float


@register_method("several")
class Several(Fit):
    """Levenberg-Marquardt from several starting points; the best minimum is the result.

    The starting points are:

    - the initial values;
    - the result of each nested model, fitted in the same way, with the further parameters at the values that reduce the
      model to the nested one, and at their initial values;
    - the best result so far with other values of parameters in which the model is known to have several minima
      (`FrictionModel.valleys`);
    - the best result so far with the initial armature and all, half or none of its delay, because a delay can replace
      nearly all of the inertia;
    - the best result so far with a delay up to one sample interval shorter or longer, because held commands cause a
      minimum in each interval.

    The result is never worse than a nested model's, unless bounds exclude the nested model.

    Args:
        tries: Largest number of vectors that each search tries.
        tolerance: A search ends when the predicted decrease of the loss is below this share of it.
        contained: Whether to start from nested models and other parameter values too; if not, only from the initial
            values and other delays.

    Raises:
        ConfigError: An argument is out of range.
    """

    traced = False

    def __init__(self, tries: int = 40, tolerance: float = 1e-8, contained: bool = True) -> None:
        refuse_outside("fit.tries", tries, 1, MOST_TRIES)
        refuse_tolerance(tolerance)
        self._tries, self._tolerance, self._contained = tries, tolerance, contained

    def total(self, objective: Objective) -> int:
        """See `Fit.total`; refuses networks and models only in torch, as `LevenbergMarquardt` does."""
        LevenbergMarquardt().total(objective)
        return 1

    def init(self, objective: Objective) -> tuple[Any, Any]:
        """See `Fit.init`; runs all searches."""
        self.total(objective)
        searches = Searches(objective, self._tries, self._tolerance)
        best = searches.best(searches.look() if self._contained else searches.go_on(np.asarray(objective.space.start)))
        return best.vector, searches.begun

    def step(self, objective: Objective, vector: Any, state: Any, data: Blocks) -> tuple[Evaluation, Any, Any]:
        """See `Fit.step`; evaluates the best vector."""
        equations = objective.beginning(state).compile_normal_equations()(np.asarray(vector, np.float64))
        return Evaluation(equations.loss, 2 * equations.gradient, not np.isfinite(equations.loss)), vector, state

    def done(self, state: Any) -> Any:
        """See `Fit.done`."""
        return True

    def prepare(self, objective: Objective) -> None:
        """See `Fit.prepare`."""
        objective.compile_normal_equations()


class Searches:
    """All searches of an objective; each nested model is fitted once.

    Attributes:
        begun: Start of the search for initial states at the best vector so far.

    Args:
        kept: Which coordinates move; None for all.
        patience: See `descend`.
    """

    def __init__(
        self,
        objective: Objective,
        tries: int,
        tolerance: float,
        kept: Bool[np.ndarray, "coordinates"] | None = None,
        patience: Sequence[tuple[int, float]] = (),
    ) -> None:
        self._objective, self._space = objective.beginning(objective.begun), objective.space
        self._tries, self._tolerance = tries, tolerance
        self._least, self.begun = np.inf, objective.begun
        self._found: dict[str, End] = {}
        self._evaluations = 0
        self._kept = np.ones(len(objective.space.start), bool) if kept is None else kept
        # A model with several minima is fitted from several starting points: a slow search has rivals.
        recordings = objective.recordings
        has_rivals = recordings is not None and recordings.model.valleys
        self._patience = (*patience, _RIVALS) if has_rivals else patience

    def go_on(self, vector: Float[np.ndarray, "coordinates"]) -> End:
        """Search from this vector; coordinates that do not move keep its values."""
        return self._descend(self._moving(vector), "the given start", vector)

    def look(self) -> End:
        """Search from all starting points that nested models give, with all coordinates moving."""
        recordings = self._objective.recordings
        return self._look(Part.of(None if recordings is None else recordings.model, self._space))

    def best(self, found: End) -> End:
        """Improve a result with the initial armature and with other delays."""
        recordings = self._objective.recordings
        delays = [i for i, label in enumerate(self._space.labels) if label == "bench.delay" and self._kept[i]]
        if recordings is not None and delays:
            found = self._shift(found, delays[0], recordings.logs[0].timestep)
        _log.debug("multi-start: best result from %s", found.name)
        return found

    def _moving(self, vector: Float[np.ndarray, "coordinates"]) -> Part:
        """Return a `Part` of the moving coordinates alone, without reference to a model."""
        fixed, spread = np.where(self._kept, 0.0, vector), np.eye(len(vector))[:, self._kept]
        return Part(FrictionModel, self._space, fixed, spread)

    def _evaluate(self, vector: Float[np.ndarray, "coordinates"]) -> NormalEquations:
        """Evaluate the objective; the search for initial states begins at those of the last vector that was as good."""
        self._evaluations += 1
        tell_progress(f"evaluation {self._evaluations}")
        equations = self._objective.compile_normal_equations()(vector)
        if is_near(equations.loss, self._least):
            self._objective = self._objective.beginning(equations.begun)
        if equations.loss < self._least:
            self._least, self.begun = equations.loss, equations.begun
        return equations

    def _look(self, part: Part) -> End:
        """Return the best result of a model from all its starting points."""
        if (end := self._found.get(part.law.name)) is not None:
            return end
        initial = part.whole(np.clip(*part.box))
        ends = [self._descend(part, "the initial values", initial)]
        for inner in part.contained():
            nested, fixed = self._look(inner).vector, ~inner.spread.any(axis=1)
            ends.append(self._descend(part, f"the fit of {inner.law.name}", nested))
            combined = np.where(fixed, initial, nested)
            if (combined != nested).any():
                ends.append(self._descend(part, f"the fit of {inner.law.name} with other initial values", combined))
        best = _least(ends)
        for name, factors in part.law.valleys.items():
            for factor in factors if name in part.places else ():
                moved = part.moved(name, factor, best.vector)
                ends.append(self._descend(part, f"{factor:g} times the initial {name}", moved))
        return self._found.setdefault(part.law.name, _least(ends))

    def _descend(
        self,
        part: Part,
        name: str,
        vector: Float[np.ndarray, "coordinates"],
        most: int = MOST_TRIES,
        enough: Callable[[np.ndarray], bool] = lambda vector: False,
        goal: float = np.inf,
    ) -> End:
        _, low, high = part.box
        coordinates, loss, _ = descend(
            part.restrict(self._evaluate),
            Box(np.clip(part.own(vector), low, high), low, high),
            min(most, self._tries),
            self._tolerance,
            enough=lambda coordinates: enough(part.whole(coordinates)),
            patience=self._patience,
            goal=goal,
        )
        _log.debug("%s: loss %.9g, started at %s", part.law.__name__, loss, name)
        return End(name, part.whole(coordinates), loss)

    def _shift(self, best: End, at: int, interval: float) -> End:
        """Improve a result with delays up to a sample interval shorter or longer, in several rounds."""
        part, kept = self._moving(best.vector), self._kept
        unit = interval / float(self._space.params["bench.delay"].scale)
        low, high = (float(side[at]) for side in (self._space.low, self._space.high))
        best = self._restore_inertia(best, part, at, unit)
        bests: list[float] = []
        for _ in range(_ROUNDS):
            direction = np.zeros(len(kept))
            direction[kept] = _along(self._evaluate(best.vector).hessian[np.ix_(kept, kept)], int(kept[:at].sum()))
            ends, delay = [best], best.vector[at]
            bests.append(delay)
            leads_back = _is_near(bests, at, unit)
            for shift in _SHIFTS:
                change = np.clip(delay + shift * unit, low, high) - delay
                if not leads_back(shifted := best.vector + np.clip(change * direction, -_FAR, _FAR)):
                    name = f"a delay {change / unit:+.2g} sample intervals from the previous best"
                    ends.append(self._descend(part, name, shifted, _SHORT, leads_back, best.loss))
            if (least := _least(ends)) is best:
                break
            best = least
        return best

    def _restore_inertia(self, best: End, whole: Part, at: int, unit: float) -> End:
        """Improve a result with the initial armature and a part of the delay."""
        inertia = np.array([label.startswith("bench.armature") for label in self._space.labels])
        is_as_late, ends = _is_near([best.vector[at]], at, unit), [best]

        def leads_back(vector: np.ndarray) -> bool:
            return is_as_late(vector) and bool((np.abs(vector - best.vector)[inertia] < _ALIKE).all())

        for share in _SHARES:
            start = np.where(inertia & self._kept, self._space.start, best.vector)
            start[at] = share * best.vector[at]
            if not leads_back(start):
                name = f"the previous best with the initial armature and {share:g} times the delay"
                ends.append(self._descend(whole, name, start, _SHORT, leads_back, best.loss))
        return _least(ends)


def _least(ends: Sequence[End]) -> End:
    """Return the best result; of equally good ones, the first."""
    least = min(end.loss for end in ends)
    return next(end for end in ends if end.loss <= least * (1 + _LOWER))


def _is_near(places: Sequence[float], at: int, unit: float) -> Callable[[np.ndarray], bool]:
    """Return a test for delays that lead to the minimum of one of these: near it and in its sample interval."""
    delays = np.asarray(places) / unit

    def is_near(vector: np.ndarray) -> bool:
        delay = vector[at] / unit
        return bool(((np.abs(delay - delays) < _NEAR) & (np.floor(delay) == np.floor(delays))).any())

    return is_near


def _along(hessian: Float[np.ndarray, "coordinates coordinates"], at: int) -> Float[np.ndarray, "coordinates"]:
    """Return how all coordinates move, for the least loss, when one of them moves by 1."""
    diagonal = np.diag(hessian)
    has_effect = diagonal > NOTHING * diagonal.max()  # rounding leaves a little, or less than 0
    others = np.flatnonzero(has_effect & (np.arange(len(hessian)) != at))
    scale = np.sqrt(np.where(has_effect, diagonal, 1.0))
    scaled = hessian / np.outer(scale, scale)
    direction = np.zeros(len(hessian))
    direction[at] = 1.0
    response = np.linalg.lstsq(scaled[np.ix_(others, others)], scaled[others, at], rcond=_FLAT)[0]
    direction[others] = -response * scale[at] / scale[others]
    return direction
