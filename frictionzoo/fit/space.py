"""Scaled coordinates of the optimiser, and their physical values."""

import copy
from collections.abc import Iterable, Mapping
from typing import Any, NamedTuple

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Bool, Float, Int, Shaped

from frictionzoo.bench import Bench
from frictionzoo.core.errors import ConfigError
from frictionzoo.core.params import Param
from frictionzoo.models import FrictionModel
from frictionzoo.simulation import Values
from frictionzoo.simulation.bridge import to_jax


class Coordinates(NamedTuple):
    """Relation between the joints and the coordinates of a physical parameter.

    Attributes:
        members: Index of each joint that has the parameter.
        joints: Index of each joint whose value is identified.
        group: For each of `joints`, the number of its coordinate; joints that share a value have the same.
        first: Index of the first joint of each coordinate.
        names: Name of each coordinate: the joint's, or the shared name of its joints.
    """

    members: Int[np.ndarray, "members"]
    joints: Int[np.ndarray, "identified"]
    group: Int[np.ndarray, "identified"]
    first: Int[np.ndarray, "own"]
    names: tuple[str, ...]

    def among_members(self, joints: Int[np.ndarray, "_"]) -> Int[np.ndarray, "_"]:
        """Return the positions of these joints in an array with one value per member."""
        return np.searchsorted(self.members, joints)


class Box(NamedTuple):
    """Initial coordinates and their bounds."""

    start: Float[np.ndarray, "coordinates"]
    low: Float[np.ndarray, "coordinates"]
    high: Float[np.ndarray, "coordinates"]


class Space:
    """Bounded, scaled coordinates of the optimiser, and their map to physical values.

    A parameter's coordinate is its logarithm or its value over its scale, as its `Param` defines. There is one per
    joint, or one for all joints that share a value. A network's weights are their own coordinates; known values have
    none.

    Attributes:
        params: The physical parameters identified in any joint, by full name such as `bench.armature`.
        places: Relation of their coordinates to the joints, by the same names.
        names: Names of everything identified: physical parameters, then a network's weights.
        weights: Names of the network's weights.
        labels: Name of each coordinate of a physical parameter: its full name, followed by `/` and the name of its
            joint or group of joints unless all joints share it.
        start: Coordinates of the initial values, as one vector.
        low: Lower bound of each coordinate; minus infinity where there is none.
        high: Upper bound of each coordinate; infinity where there is none.

    Args:
        bench: The test stand; its parameters come first.
        model: The friction model; its present values are the initial ones.

    Raises:
        ConfigError: Joints that share a value differ in its initial value, its bounds, or in whether it is identified.
    """

    def __init__(self, bench: Bench, model: FrictionModel, dtype: Any) -> None:
        bench_values = {name: jnp.asarray(value, dtype) for name, value in bench.initial_values().items()}
        self._values = {"bench": bench_values, "friction": to_jax(model, dtype)}
        self.bench: Bench = bench
        self._nv = bench.nv
        specs = {f"bench.{name}": param for name, param in bench.params.items()}
        specs |= {f"friction.{name}": param for name, param in model.params.items()}
        self.params: dict[str, Param] = {name: param for name, param in specs.items() if param.is_identified}
        free = [f"friction.{name}" for name, tensor in model.named_parameters() if tensor.requires_grad]
        self.places: dict[str, Coordinates] = {
            name: _place(name, param, bench, np.asarray(self._get(self._values, name)))
            for name, param in self.params.items()
        }
        self.weights: list[str] = [name for name in free if name not in specs]
        self.names: list[str] = [*self.params, *self.weights]
        coordinates = [self._to_coordinate(name, self._get(self._values, name)) for name in self.names]
        self.labels: list[str] = [
            name if np.sum(place.group == number) == len(place.members) else f"{name}/{place.names[number]}"
            for name, place in self.places.items()
            for number in range(len(place.names))
        ]
        start, self._unravel = ravel_pytree(coordinates)
        self.start: Array = jnp.asarray(start, dtype)  # without coordinates, ravel_pytree returns float32
        self.low: Array = ravel_pytree(self._bounds(coordinates, "low"))[0]
        self.high: Array = ravel_pytree(self._bounds(coordinates, "high"))[0]

    @property
    def box(self) -> Box:
        """Initial coordinates and bounds in float64."""
        return Box(*(np.asarray(side, np.float64) for side in (self.start, self.low, self.high)))

    def starting(self, vector: Float[np.ndarray, "coordinates"]) -> "Space":
        """Return this space with other initial coordinates, clipped to the bounds."""
        other = copy.copy(self)
        other.start = jnp.clip(jnp.asarray(vector, self.start.dtype), self.low, self.high)
        return other

    def values(self, vector: Float[Array, "coordinates"]) -> Values:
        """Return the physical values of all parameters, identified and known, by owner and name."""
        values = {owner: dict(named) for owner, named in self._values.items()}
        for name, coordinate in self._split(vector):
            owner, _, key = name.partition(".")
            values[owner][key] = self._from_coordinate(name, coordinate)
        return values

    def identified(self, vector: Float[Array, "coordinates"]) -> dict[str, Float[Array, "nv"]]:
        """Return values of identified physical parameters by full name; NaN where a joint does not have one."""
        values, by_name = self.values(vector), {}
        for name, place in self.places.items():
            value = self._get(values, name)
            complete = len(place.members) == self._nv
            by_name[name] = value if complete else jnp.full(self._nv, jnp.nan, value.dtype).at[place.members].set(value)
        return by_name

    def pick(self, rows: Mapping[str, Shaped[np.ndarray, "nv ..."]]) -> dict[str, Shaped[np.ndarray, "..."]]:
        """Return the row of each coordinate by its label, from arrays with a row per joint, by full name, if given."""
        joints = [(name, joint) for name, place in self.places.items() for joint in place.first.tolist()]
        return {
            label: rows[name][joint] for label, (name, joint) in zip(self.labels, joints, strict=True) if name in rows
        }

    def split(self, vector: Shaped[np.ndarray, "coordinates ..."]) -> dict[str, Shaped[np.ndarray, "own ..."]]:
        """Split an array with one row per coordinate by physical parameter, by full name."""
        ends = np.cumsum([len(place.first) for place in self.places.values()])
        return dict(zip(self.params, np.split(np.asarray(vector), ends), strict=False))

    def spread(
        self, name: str, rows: Shaped[np.ndarray, "own ..."], known: float | bool = np.nan
    ) -> Shaped[np.ndarray, "nv ..."]:
        """Return the rows of a parameter's coordinates as rows of the joints; `known` where it is not identified."""
        place = self.places[name]
        spread = np.full((self._nv, *rows.shape[1:]), known, rows.dtype)
        spread[place.joints] = rows[place.group]
        return spread

    def physical(self, vector: Shaped[np.ndarray, "coordinates ..."]) -> dict[str, Shaped[np.ndarray, "nv ..."]]:
        """Return physical values by full name, in float64; NaN where known.

        They are clipped to the bounds, because the exponential of a bound's logarithm can round beyond the bound.
        """
        by_name = {}
        for name, rows in self.split(np.asarray(vector, np.float64)).items():
            values = self.spread(name, self.params[name].from_coordinate(rows, np))
            low, high = (self.params[name].each(side, self._nv) for side in ("low", "high"))
            column = (slice(None), *[None] * (values.ndim - 1))
            by_name[name] = np.clip(values, low[column], high[column])
        return by_name

    def limits(self) -> dict[str, str]:
        """Return unit and widest bounds of each physical parameter in words, by full name."""
        limits = {}
        for name, param in self.params.items():
            joints = self.places[name].joints
            low, high = (param.each(side, self._nv)[joints] for side in ("low", "high"))
            unit = param.unit(self.bench.joint_type)
            limits[name] = f"{'' if unit == '1' else f'{unit}, '}{low.min():g} to {high.max():g}"
        return limits

    def at_bound(self, vector: Float[np.ndarray, "coordinates"]) -> Bool[np.ndarray, "own"]:
        """Return whether each coordinate of a physical parameter has reached a bound."""
        reached = [np.zeros(0, bool)]
        for name, value in self.physical(vector).items():
            initial = self.params[name].each("init", self._nv)
            value = np.where(np.isnan(value), initial, value)
            reached.append(np.broadcast_to(self.params[name].is_at_bound(value), self._nv)[self.places[name].first])
        return np.concatenate(reached)

    def first_nonfinite(self, vector: Float[np.ndarray, "coordinates"]) -> str | None:
        """Return the name of the first parameter with a non-finite entry in this vector, such as a gradient."""
        for name, entries in self._split(jnp.asarray(vector)):
            if not np.isfinite(entries).all():
                return name
        return None

    def farthest(self, vector: Float[np.ndarray, "coordinates"], origin: Float[np.ndarray, "coordinates"]) -> str:
        """Return the name of the parameter whose coordinate moved farthest from `origin` to `vector`."""
        distances = self._split(jnp.nan_to_num(jnp.abs(jnp.asarray(vector) - jnp.asarray(origin)), nan=jnp.inf))
        return max(distances, key=lambda named: float(named[1].max()))[0]

    def _split(self, vector: Array) -> Iterable[tuple[str, Array]]:
        return zip(self.names, self._unravel(vector), strict=True)

    def _bounds(self, coordinates: list[Array], side: str) -> list[Array]:
        infinite = -np.inf if side == "low" else np.inf

        def ends(name: str) -> Any:
            if name not in self.params:
                return infinite
            param = self.params[name]
            return param.to_coordinate(np.asarray(param.each(side, self._nv), np.float64)[self.places[name].first], np)

        return [
            jnp.broadcast_to(jnp.asarray(ends(name), coordinate.dtype), coordinate.shape)
            for name, coordinate in zip(self.names, coordinates, strict=True)
        ]

    def _to_coordinate(self, name: str, value: Array) -> Array:
        if name not in self.params:
            return value
        place = self.places[name]
        return self.params[name].to_coordinate(value[place.among_members(place.first)], jnp)

    def _from_coordinate(self, name: str, coordinate: Array) -> Array:
        """Return a parameter's values in all its joints: identified ones from coordinates, known ones unchanged."""
        if name not in self.params:
            return coordinate
        place, value = self.places[name], self.params[name].from_coordinate(coordinate, jnp)
        if len(place.joints) == len(place.members):
            return value if len(place.first) == len(place.members) else value[place.group]
        return self._get(self._values, name).at[place.among_members(place.joints)].set(value[place.group])

    @staticmethod
    def _get(values: Mapping[str, Mapping[str, Array]], name: str) -> Array:
        owner, _, key = name.partition(".")
        return values[owner][key]


def _place(name: str, param: Param, bench: Bench, values: Float[np.ndarray, "nv"]) -> Coordinates:
    groups, nv, members = bench.groups(param), bench.nv, param.members(bench.nv)
    free = np.flatnonzero(param.each("identify", nv))
    numbers: dict[str, int] = {}
    group = np.array([numbers.setdefault(groups[joint], len(numbers)) for joint in free.tolist()], int)
    first = free[[int(np.argmax(group == number)) for number in range(len(numbers))]].astype(int)
    alike = {**{key: param.each(key, nv) for key in ("low", "high", "identify")}, "init": param.spread(values, nv)}
    for joint in members:
        tie = groups[joint]
        other = next(first for first in members if groups[first] == tie)
        for key, rows in alike.items():
            if rows[joint] != rows[other]:
                clash = f"{rows[other]:g} of {bench.joints[other]} and {rows[joint]:g} of {bench.joints[joint]}"
                raise ConfigError(
                    f"{name}.{key}: {clash}, which share a value ({tie}); expected the same, or another tie"
                )
    return Coordinates(np.array(members), free, group, first, tuple(numbers))
