"""What a fit moves: coordinates, and the physical values that they stand for."""

from collections.abc import Iterable, Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np
from jax.flatten_util import ravel_pytree
from jaxtyping import Array, Float, Shaped

from frictionzoo.bench import Bench
from frictionzoo.core.params import Param
from frictionzoo.models import FrictionModel
from frictionzoo.simulate import Values
from frictionzoo.simulate.bridge import to_jax


class Space:
    """The coordinates that an optimiser moves, and the physical values that they stand for.

    A parameter's coordinate is its logarithm or its value over its scale, as its `Param` says; a network's weights are
    their own coordinates. Known parameters have none.

    Attributes:
        params: The identified physical parameters by their full name, `bench.armature`.
        names: All that is identified, physical parameters first, then a network's weights.
        weights: The network's weights among them.
        labels: Name of each coordinate of a physical parameter: its full name; of several joints with `/` and a number.
        start: Coordinates of the initial values, as one vector.
        low: Lower bound of each coordinate; minus infinity where there is none.
        high: Upper bound of each coordinate.

    Args:
        bench: Its parameters come first.
        model: The friction model; its present values are the initial ones.
        dtype: JAX type of the coordinates.
    """

    def __init__(self, bench: Bench, model: FrictionModel, dtype: Any) -> None:
        bench_values = {name: jnp.asarray(value, dtype) for name, value in bench.initial_values().items()}
        self._values = {"bench": bench_values, "friction": to_jax(model, dtype)}
        specs = {f"bench.{name}": param for name, param in bench.params.items()}
        specs |= {f"friction.{name}": param for name, param in model.params.items()}
        self.params: dict[str, Param] = {name: param for name, param in specs.items() if param.identify}
        free = [f"friction.{name}" for name, tensor in model.named_parameters() if tensor.requires_grad]
        self.weights: list[str] = [name for name in free if name not in specs]
        self.names: list[str] = [*self.params, *self.weights]
        coordinates = [self._to_coordinate(name, self._get(self._values, name)) for name in self.names]
        sizes = {name: coordinate.size for name, coordinate in zip(self.names, coordinates, strict=True)}
        self.labels: list[str] = [
            name if sizes[name] == 1 else f"{name}/{joint}" for name in self.params for joint in range(sizes[name])
        ]
        start, self._unravel = ravel_pytree(coordinates)
        self.start: Array = jnp.asarray(start, dtype)  # of no coordinates, ravel_pytree makes float32
        self.low: Array = ravel_pytree(self._bounds(coordinates, "low"))[0]
        self.high: Array = ravel_pytree(self._bounds(coordinates, "high"))[0]

    def values(self, vector: Float[Array, "coordinates"]) -> Values:
        """Physical values of all parameters, identified and known, by owner and name."""
        values = {owner: dict(named) for owner, named in self._values.items()}
        for name, coordinate in self._split(vector):
            owner, _, key = name.partition(".")
            values[owner][key] = self._from_coordinate(name, coordinate)
        return values

    def identified(self, vector: Float[Array, "coordinates"]) -> dict[str, Float[Array, "nv"]]:
        """Physical values of the identified parameters by full name; a network's weights are left out."""
        values = self.values(vector)
        return {name: self._get(values, name) for name in self.params}

    def split(self, vector: Shaped[np.ndarray, "coordinates ..."]) -> dict[str, Shaped[np.ndarray, "nv ..."]]:
        """Entries of an array with one row a coordinate, by the full name of the physical parameter they belong to."""
        sizes = [len(entries) for _, entries in self._split(self.start)]
        ends = np.cumsum(sizes)[: len(self.params)]
        return dict(zip(self.params, np.split(np.asarray(vector), ends), strict=False))

    def first_nonfinite(self, vector: Float[np.ndarray, "coordinates"]) -> str | None:
        """Name of the first parameter whose entry in this vector (a gradient, say) is not finite."""
        for name, entries in self._split(jnp.asarray(vector)):
            if not np.isfinite(entries).all():
                return name
        return None

    def farthest(self, vector: Float[np.ndarray, "coordinates"], origin: Float[np.ndarray, "coordinates"]) -> str:
        """Name of the parameter whose coordinate in `vector` is farthest from that in `origin`."""
        distances = self._split(jnp.nan_to_num(jnp.abs(jnp.asarray(vector) - jnp.asarray(origin)), nan=jnp.inf))
        return max(distances, key=lambda named: float(named[1].max()))[0]

    def _split(self, vector: Array) -> Iterable[tuple[str, Array]]:
        return zip(self.names, self._unravel(vector), strict=True)

    def _bounds(self, coordinates: list[Array], side: str) -> list[Array]:
        infinite = -np.inf if side == "low" else np.inf
        ends = [
            self.params[name].to_coordinate(getattr(self.params[name], side), np) if name in self.params else infinite
            for name in self.names
        ]
        return [jnp.full_like(coordinate, end) for coordinate, end in zip(coordinates, ends, strict=True)]

    def _to_coordinate(self, name: str, value: Array) -> Array:
        return self.params[name].to_coordinate(value, jnp) if name in self.params else value

    def _from_coordinate(self, name: str, coordinate: Array) -> Array:
        return self.params[name].from_coordinate(coordinate, jnp) if name in self.params else coordinate

    @staticmethod
    def _get(values: Mapping[str, Mapping[str, Array]], name: str) -> Array:
        owner, _, key = name.partition(".")
        return values[owner][key]
