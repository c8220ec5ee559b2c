"""Nested models: their coordinates within those of the fitted model."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field

import numpy as np
from jaxtyping import Float, Int

from frictionzoo.core.params import Param
from frictionzoo.fit.normal_equations import Evaluate, NormalEquations
from frictionzoo.fit.space import Box, Space
from frictionzoo.models import FrictionModel
from frictionzoo.models.base import Within
from frictionzoo.models.registry import get_model


@dataclass(frozen=True)
class Part:
    """The fitted model or a model nested in it; with coordinates `own`, the fitted model has `at + spread @ own`.

    Attributes:
        law: Class of the model.
        space: Coordinates of the fitted model.
        at: The fitted model's coordinates where all of `own` are 0.
        spread: 1 where a coordinate of the fitted model equals one of `own`, else 0.
        places: Index in `own` of the coordinates of each identified friction parameter.
        known: Values of the other friction parameters, one per joint.
    """

    law: type[FrictionModel]
    space: Space
    at: Float[np.ndarray, "coordinates"]
    spread: Float[np.ndarray, "coordinates own"]
    places: Mapping[str, Int[np.ndarray, "_"]] = field(default_factory=dict)
    known: Mapping[str, np.ndarray] = field(default_factory=dict)

    @classmethod
    def of(cls, model: FrictionModel | None, space: Space) -> "Part":
        """Return the part of the fitted model itself; without a model, coordinates without parameters."""
        start, spread = np.zeros(len(space.start)), np.eye(len(space.start))
        if model is None:
            return cls(FrictionModel, space, start, spread)
        owners = [label.partition("/")[0] for label in space.labels]
        places = {name: np.flatnonzero([owner == f"friction.{name}" for owner in owners]) for name in model.params}
        known = {name: param.each("init", model.nv) for name, param in model.params.items() if not len(places[name])}
        places = {name: indices for name, indices in places.items() if len(indices)}
        return cls(type(model), space, start, spread, places, known)

    @property
    def box(self) -> Box:
        """Start and bounds of the model's coordinates; the narrowest bounds where it merges several into one."""
        start, low, high = self.space.box
        mask = self.spread > 0
        return Box(
            self.own(start),
            np.where(mask, low[:, None], -np.inf).max(axis=0),
            np.where(mask, high[:, None], np.inf).min(axis=0),
        )

    def own(self, vector: Float[np.ndarray, "coordinates"]) -> Float[np.ndarray, "own"]:
        """Return the model's coordinates; the mean where it merges several into one."""
        return self.spread.T @ vector / self.spread.sum(axis=0)

    def whole(self, own: Float[np.ndarray, "own"]) -> Float[np.ndarray, "coordinates"]:
        """Return the fitted model's coordinates."""
        return self.at + self.spread @ own

    def moved(
        self, name: str, factor: float, vector: Float[np.ndarray, "coordinates"]
    ) -> Float[np.ndarray, "coordinates"]:
        """Return the fitted model's coordinates with a parameter at this multiple of its initial value."""
        moved = self.own(vector)
        for index, start in ((index, float(self.box.start[index])) for index in self.places[name].tolist()):
            moved[index] = self._bounded(index, factor * float(self._param(index).from_coordinate(start, np)))
        return self.whole(moved)

    def restrict(self, evaluate: Evaluate) -> Evaluate:
        """Return the objective as a function of the model's coordinates."""

        def of_own(own: Float[np.ndarray, "own"]) -> NormalEquations:
            loss, gradient, hessian, begun = evaluate(self.whole(own))
            return NormalEquations(loss, self.spread.T @ gradient, self.spread.T @ hessian @ self.spread, begun)

        return of_own

    def contained(self) -> Iterator["Part"]:
        """Yield the nested models that known values do not exclude."""
        for name, within in self.law.contains.items():
            if (part := self._narrow(get_model(name), within)) is not None:
                yield part

    def _narrow(self, law: type[FrictionModel], within: Within) -> "Part | None":
        """Return the part of a nested model; None where known values exclude it."""
        base, groups = self.box.start, {}
        used = np.zeros(len(base), bool)
        for name, own in self.places.items():
            rule = within.get(name, name)
            if isinstance(rule, str) and rule in law.dimensions:
                groups.setdefault(rule, []).append(own)
            elif not callable(rule):  # fixed at a number, or at its start if it has no effect
                base[own] = base[own] if isinstance(rule, str) else [self._bounded(row, rule) for row in own.tolist()]
            used[own] = not callable(rule)
        for name, value in self.known.items():  # has to be the nested model's value
            rule = within.get(name, name)
            if not callable(rule) and not (rule == name if isinstance(rule, str) else (value == rule).all()):
                return None
        for alike in groups.values():  # coordinates to merge are equal in number and have the same scale
            scales = {self._param(index).scale for indices in alike for index in indices.tolist()}
            if not len({len(indices) for indices in alike}) == len(scales) == 1:
                return None
        columns = [[row] for row in np.flatnonzero(~used)]
        places = {}
        for name, alike in groups.items():
            places[name] = len(columns) + np.arange(len(alike[0]))
            columns += np.stack(alike, axis=1).tolist()
        narrow = np.zeros((len(base), len(columns)))
        for row, merged in enumerate(columns):
            narrow[merged, row], base[merged] = 1.0, 0.0
        known = {name: value for name, value in self.known.items() if name in law.dimensions}
        return Part(law, self.space, self.whole(base), self.spread @ narrow, places, known)

    def _param(self, own: int) -> Param:
        row = int(np.argmax(self.spread[:, own]))
        return self.space.params[self.space.labels[row].partition("/")[0]]

    def _bounded(self, own: int, value: float) -> float:
        """Return the coordinate of a value, clipped to the bounds."""
        param, bounds = self._param(own), [side[own] for side in self.box[1:]]
        low, high = (float(param.from_coordinate(bound, np)) for bound in bounds)
        return bounds[0] if value <= low else bounds[1] if value >= high else float(param.to_coordinate(value, np))
