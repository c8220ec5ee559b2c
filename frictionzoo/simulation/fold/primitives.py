"""JAX's array operations, applied to arrays of entries."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax

from frictionzoo.simulation.fold.expression import CannotSpecialiseError, as_entries
from frictionzoo.simulation.fold.simplify import Simplifier


def _common(arrays: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    return [as_entries(array) for array in arrays] if any(array.dtype == object for array in arrays) else arrays


def _broadcast(array: np.ndarray, shape: Sequence[Any], dimensions: Sequence[Any]) -> np.ndarray:
    sizes = np.ones(len(shape), int)
    sizes[list(dimensions)] = array.shape
    return np.broadcast_to(array.reshape(sizes), shape)


def _reduce(simplifier: Simplifier, name: str, array: np.ndarray, axes: Sequence[Any], start: Any) -> np.ndarray:
    kept = [size for axis, size in enumerate(array.shape) if axis not in axes]
    count = math.prod(array.shape[axis] for axis in axes)
    total = np.full(kept, start)
    for row in np.moveaxis(array, axes, range(len(axes))).reshape(count, *kept):
        total = simplifier.elementwise(name, total, row)
    return total


def _cumulate(simplifier: Simplifier, name: str, array: np.ndarray, axis: int, reverse: bool) -> np.ndarray:
    rows = list(np.moveaxis(array, axis, 0))[:: -1 if reverse else 1]
    for position in range(1, len(rows)):
        rows[position] = simplifier.elementwise(name, rows[position - 1], rows[position])
    return np.moveaxis(np.stack(rows[:: -1 if reverse else 1]), 0, axis)


def _contract(simplifier: Simplifier, left: np.ndarray, right: np.ndarray, dimension_numbers: Any) -> np.ndarray:
    (left_sum, right_sum), (left_batch, right_batch) = dimension_numbers

    def arrange(array: np.ndarray, batch: Sequence[Any], summed: Sequence[Any]) -> tuple[np.ndarray, list[int]]:
        """Merge batch, free and summed dimensions to one each, and return the free sizes too."""
        free = [axis for axis in range(array.ndim) if axis not in (*batch, *summed)]
        sizes = [math.prod(array.shape[axis] for axis in axes) for axes in (batch, free, summed)]
        return array.transpose(*batch, *free, *summed).reshape(sizes), [array.shape[axis] for axis in free]

    rows, left_free = arrange(left, left_batch, left_sum)
    columns, right_free = arrange(right, right_batch, right_sum)
    terms = simplifier.elementwise("mul", rows[:, :, :, None], columns.transpose(0, 2, 1)[:, None])
    batch_shape = [left.shape[axis] for axis in left_batch]
    return _reduce(simplifier, "add", terms, (2,), 0.0).reshape((*batch_shape, *left_free, *right_free))


def _power(simplifier: Simplifier, base: np.ndarray, exponent: int) -> np.ndarray:
    if exponent == 0:
        return np.ones(base.shape)
    product = base
    for _ in range(abs(exponent) - 1):
        product = simplifier.elementwise("mul", product, base)
    return product if exponent > 0 else simplifier.elementwise("div", np.asarray(1.0), product)


def _scatter(simplifier: Simplifier, inputs: Sequence[np.ndarray], params: Mapping[str, Any], add: bool) -> np.ndarray:
    array, indices, updates = inputs
    if indices.dtype == object:
        raise CannotSpecialiseError("an index that depends on the state")

    def put(moved: Any) -> Any:
        zeros = jnp.zeros(array.shape)
        return lax.scatter_add(zeros, jnp.asarray(indices), moved, params["dimension_numbers"], mode=params["mode"])

    with jax.ensure_compile_time_eval():  # the gradient of the entries' numbers is the number to which an update goes
        _, pull = jax.vjp(put, jnp.zeros(updates.shape))
        (places,) = pull(jnp.arange(1.0, array.size + 1).reshape(array.shape))
    written = as_entries(array).ravel()
    for place, update in zip(np.asarray(places, int).ravel() - 1, as_entries(updates).ravel(), strict=True):
        if place >= 0:  # XLA drops entries outside
            written[place] = simplifier.make("add", written[place], update) if add else update
    return written.reshape(array.shape)


MOVES: Mapping[str, int] = {"gather": 1, "dynamic_slice": 1, "dynamic_update_slice": 2, "pad": 2}
"""Primitives that only move entries, with the number of inputs that have entries; the further ones are indices."""


def move(primitive: Any, inputs: Sequence[np.ndarray], params: Mapping[str, Any]) -> np.ndarray:
    """Apply a primitive of `MOVES` to arrays of entries: JAX applies it to the entries' numbers."""
    count = MOVES[primitive.name]
    if any(index.dtype == object for index in inputs[count:]):
        raise CannotSpecialiseError("an index that depends on the state")
    entries = np.concatenate([as_entries(array).ravel() for array in inputs[:count]])
    firsts = np.cumsum([0, *(array.size for array in inputs[:count])])
    numbers = [
        first + np.arange(array.size).reshape(array.shape)
        for first, array in zip(firsts[:-1], inputs[:count], strict=True)
    ]
    with jax.ensure_compile_time_eval():
        places = np.asarray(primitive.bind(*map(jnp.asarray, (*numbers, *inputs[count:])), **params))
    if (places < 0).any():
        raise CannotSpecialiseError("an index out of bounds")
    return entries[places]


PRIMITIVES: Mapping[str, Callable[[Simplifier, list[np.ndarray], Mapping[str, Any]], np.ndarray]] = {
    "square": lambda simplifier, x, _: _power(simplifier, x[0], 2),
    "integer_pow": lambda simplifier, x, p: _power(simplifier, x[0], p["y"]),
    "convert_element_type": lambda _, x, p: x[0] if x[0].dtype == object else x[0].astype(p["new_dtype"]),
    **dict.fromkeys(("stop_gradient", "copy", "copy_p"), lambda _, x, __: x[0]),
    "select_n": lambda simplifier, x, _: as_entries(np.frompyfunc(simplifier.choose, len(x), 1)(*x)),
    "clamp": lambda simplifier, x, _: simplifier.elementwise("min", simplifier.elementwise("max", x[1], x[0]), x[2]),
    "broadcast_in_dim": lambda _, x, p: _broadcast(x[0], p["shape"], p["broadcast_dimensions"]),
    "reshape": lambda _, x, p: x[0].reshape(p["new_sizes"]),
    "squeeze": lambda _, x, p: np.squeeze(x[0], tuple(p["dimensions"])),
    "expand_dims": lambda _, x, p: np.expand_dims(x[0], tuple(p["dimensions"])),
    "transpose": lambda _, x, p: x[0].transpose(p["permutation"]),
    "rev": lambda _, x, p: np.flip(x[0], p["dimensions"]),
    "concatenate": lambda _, x, p: np.concatenate(_common(x), p["dimension"]),
    "stack": lambda _, x, p: np.stack(_common(x), p["axis"]),
    "tile": lambda _, x, p: np.tile(x[0], p["reps"]),
    "slice": lambda _, x, p: x[0][
        tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * x[0].ndim))
    ],
    "scatter": lambda simplifier, x, p: _scatter(simplifier, x, p, add=False),
    **dict.fromkeys(("scatter-add", "scatter_add"), lambda simplifier, x, p: _scatter(simplifier, x, p, add=True)),
    "dot_general": lambda simplifier, x, p: _contract(simplifier, x[0], x[1], p["dimension_numbers"]),
    "reduce_sum": lambda simplifier, x, p: _reduce(simplifier, "add", x[0], p["axes"], 0.0),
    "reduce_max": lambda simplifier, x, p: _reduce(simplifier, "max", x[0], p["axes"], -np.inf),
    "reduce_min": lambda simplifier, x, p: _reduce(simplifier, "min", x[0], p["axes"], np.inf),
    "reduce_and": lambda simplifier, x, p: _reduce(simplifier, "and", x[0], p["axes"], True),
    "reduce_or": lambda simplifier, x, p: _reduce(simplifier, "or", x[0], p["axes"], False),
    "cumsum": lambda simplifier, x, p: _cumulate(simplifier, "add", x[0], p["axis"], p["reverse"]),
}
"""Function of each primitive on arrays of entries: (simplifier, inputs, params) to the output."""
