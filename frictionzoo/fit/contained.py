"""Laws that a law contains: their coordinates within those of the law that is fitted."""

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from frictionzoo.core.params import Param
from frictionzoo.fit.normal_equations import NormalEquations
from frictionzoo.fit.space import Space
from frictionzoo.fit.torque_balance import Box
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import Within
from frictionzoo.models.registry import get_model

Evaluate = Callable[[Float[np.ndarray, "coordinates"]], NormalEquations]
"""An objective near a vector."""


@dataclass(frozen=True)
class Part:
    """A law that the fitted one is or contains, by its coordinates: the fitted law's are `at + spread @ own`.

    Attributes:
        law: Its class.
        space: The fitted law's coordinates.
        at: What the fitted law's coordinates are where its own are 0.
        spread: 1 where a coordinate of the fitted law is this one of its own.
        places: Where its parameters that are identified have their own coordinates.
        known: Values of its other parameters, one a joint.
    """

    law: type[FrictionModel]
    space: Space
    at: Float[np.ndarray, "coordinates"]
    spread: Float[np.ndarray, "coordinates own"]
    places: Mapping[str, Int[np.ndarray, "_"]]
    known: Mapping[str, np.ndarray]

    @classmethod
    def of(cls, model: FrictionModel | None, space: Space) -> "Part":
        """The fitted law itself; of none, coordinates without a meaning."""
        size = len(space.start)
        if model is None:
            return cls(FrictionModel, space, np.zeros(size), np.eye(size), {}, {})
        owners = [label.partition("/")[0] for label in space.labels]
        places = {name: np.flatnonzero([owner == f"friction.{name}" for owner in owners]) for name in model.params}
        known = {name: param.each("init", model.nv) for name, param in model.params.items() if not len(places[name])}
        return cls(
            type(model),
            space,
            np.zeros(size),
            np.eye(size),
            {name: own for name, own in places.items() if len(own)},
            known,
        )

    @property
    def box(self) -> Box:
        """Where its own coordinates start, and their bounds; the narrower ones of several that stand for one."""
        start, low, high = (np.asarray(x, np.float64) for x in (self.space.start, self.space.low, self.space.high))
        own = self.spread > 0
        return Box(
            self.own(start),
            np.where(own, low[:, None], -np.inf).max(axis=0),
            np.where(own, high[:, None], np.inf).min(axis=0),
        )

    def own(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "own"]:
        """Its own coordinates, the mean of several that stand for one."""
        return self.spread.T @ vector / self.spread.sum(axis=0)

    def whole(self, own: Float[np.ndarray, "own"]) -> Float[np.ndarray, "coordinates"]:
        """The fitted law's coordinates."""
        return self.at + self.spread @ own

    def moved(
        self, name: str, factor: float, vector: Float[np.ndarray, "coordinates"]
    ) -> Float[np.ndarray, "coordinates"]:
        """The fitted law's coordinates with a parameter at this multiple of its initial value."""
        moved = self.own(vector)
        for at, own in ((at, float(self.box.start[at])) for at in self.places[name].tolist()):
            moved[at] = self._bounded(at, factor * float(self._param(at).from_coordinate(own, np)))
        return self.whole(moved)

    def restrict(self, evaluate: Evaluate) -> Evaluate:
        """The objective by its own coordinates alone."""

        def of_own(own: Float[np.ndarray, "own"]) -> NormalEquations:
            loss, gradient, hessian, states = evaluate(self.whole(own))
            return NormalEquations(loss, self.spread.T @ gradient, self.spread.T @ hessian @ self.spread, states)

        return of_own

    def contained(self) -> Iterator["Part"]:
        """The laws that it contains, but for those that known values keep it from being."""
        for name, within in self.law.contains.items():
            if (part := self._narrow(get_model(name), within)) is not None:
                yield part

    def _narrow(self, law: type[FrictionModel], within: Within) -> "Part | None":
        """One of them."""
        base, groups = self.box.start, {}
        taken = np.zeros(len(base), bool)
        for name, own in self.places.items():
            rule = within.get(name, name)
            if isinstance(rule, str) and rule in law.dimensions:
                groups.setdefault(rule, []).append(own)
            elif not callable(rule):  # held: at a number, or where it is if it has no effect
                base[own] = base[own] if isinstance(rule, str) else [self._bounded(at, rule) for at in own.tolist()]
            taken[own] = not callable(rule)
        if not (self._knows(within) and all(map(self._are_alike, groups.values()))):
            return None
        free = [[at] for at in np.flatnonzero(~taken)]
        places = {}
        for name, alike in groups.items():
            places[name] = len(free) + np.arange(len(alike[0]))
            free += np.stack(alike, axis=1).tolist()
        narrow = np.zeros((len(base), len(free)))
        for at, columns in enumerate(free):
            narrow[columns, at], base[columns] = 1.0, 0.0
        known = {name: value for name, value in self.known.items() if name in law.dimensions}
        return Part(law, self.space, self.whole(base), self.spread @ narrow, places, known)

    def _knows(self, within: Within) -> bool:
        """Whether known values are those of the contained law."""
        rules = [(value, within.get(name, name), name) for name, value in self.known.items()]
        return all(
            callable(rule) or (rule == name if isinstance(rule, str) else bool((value == rule).all()))
            for value, rule, name in rules
        )

    def _are_alike(self, alike: list[np.ndarray]) -> bool:
        """Whether coordinates that are to be one are as many, and measured alike."""
        scales = {self._param(at).scale for own in alike for at in own.tolist()}
        return len({len(own) for own in alike}) == len(scales) == 1

    def _param(self, own: int) -> Param:
        """What is identified there."""
        row = int(np.argmax(self.spread[:, own]))
        return self.space.params[self.space.labels[row].partition("/")[0]]

    def _bounded(self, own: int, value: float) -> float:
        """The coordinate of a value, or of the bound that is next to it."""
        param, ends = self._param(own), [side[own] for side in self.box[1:]]
        low, high = (float(param.from_coordinate(end, np)) for end in ends)
        return ends[0] if value <= low else ends[1] if value >= high else float(param.to_coordinate(value, np))
