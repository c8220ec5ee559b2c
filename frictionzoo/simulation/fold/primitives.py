"""JAX's array operations, applied to arrays of entries."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from jax import lax

from frictionzoo.simulation.fold.expression import CannotSpecialiseError, as_entries
from frictionzoo.simulation.fold.simplify import Simplifier


def _common(arrays: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    return [as_entries(array) for array in arrays] if any(array.dtype == object for array in arrays) else arrays


def _spread(array: np.ndarray, rank: int, dimensions: Sequence[Any]) -> np.ndarray:
    """Reshape an array to `rank` dimensions, with its sizes at these places."""
    shape = np.ones(rank, int)
    shape[list(dimensions)] = array.shape
    return array.reshape(shape)


def _broadcast(array: np.ndarray, shape: Sequence[Any], dimensions: Sequence[Any]) -> np.ndarray:
    return np.broadcast_to(_spread(array, len(shape), dimensions), shape)


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


def _pad(array: np.ndarray, filling: np.ndarray, config: Sequence[Any]) -> np.ndarray:
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        raise CannotSpecialiseError("pad with negative or inner padding")
    array, filling = _common([array, filling])
    padded = np.full([low + size + high for (low, high, _), size in zip(config, array.shape, strict=True)], filling)
    padded[tuple(slice(low, low + size) for (low, _, _), size in zip(config, array.shape, strict=True))] = array
    return padded


def _dynamic_slice(array: np.ndarray, starts: Sequence[np.ndarray], sizes: Sequence[Any]) -> tuple[slice, ...]:
    if any(start.dtype == object for start in starts):
        raise CannotSpecialiseError("an index that depends on the state")
    begins = [
        min(max(int(start), 0), limit - size) for start, limit, size in zip(starts, array.shape, sizes, strict=True)
    ]
    return tuple(slice(start, start + size) for start, size in zip(begins, sizes, strict=True))


def _update_slice(array: np.ndarray, update: np.ndarray, *starts: np.ndarray) -> np.ndarray:
    array, update = _common([array, update])
    written = array.copy()
    written[_dynamic_slice(array, starts, update.shape)] = update
    return written


def _windows(
    shape: Sequence[Any], indices: np.ndarray, sizes: Sequence[Any], numbers: lax.GatherDimensionNumbers, clip: bool
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """Return the operand's index of each window entry, one array a dimension, and whether its window lies inside."""
    if indices.dtype == object:
        raise CannotSpecialiseError("an index that depends on the state")
    places, batching = indices.shape[:-1], numbers.operand_batching_dims
    kept = [dim for dim in range(len(shape)) if dim not in (*numbers.collapsed_slice_dims, *batching)]
    rank = len(places) + len(kept)
    place_dims = [dim for dim in range(rank) if dim not in numbers.offset_dims]
    inside = np.ones(places, bool)
    indices_by_dim = []
    for dim, limit in enumerate(shape):
        start = np.zeros(places, int)
        if dim in numbers.start_index_map:
            start = indices[..., numbers.start_index_map.index(dim)].astype(int)
        elif dim in batching:
            start = _broadcast(np.arange(limit), places, [numbers.start_indices_batching_dims[batching.index(dim)]])
        if clip:
            start = np.clip(start, 0, limit - sizes[dim])
        inside = inside & (start >= 0) & (start + sizes[dim] <= limit)
        index = _spread(np.asarray(start), rank, place_dims)
        if dim in kept:
            index = index + _spread(np.arange(sizes[dim]), rank, [numbers.offset_dims[kept.index(dim)]])
        indices_by_dim.append(index)
    *indices_by_dim, inside = np.broadcast_arrays(*indices_by_dim, _spread(np.asarray(inside), rank, place_dims))
    return tuple(indices_by_dim), inside


def _gather(array: np.ndarray, indices: np.ndarray, params: Mapping[str, Any]) -> np.ndarray:
    clip = params["mode"] != lax.GatherScatterMode.FILL_OR_DROP
    places, inside = _windows(array.shape, indices, params["slice_sizes"], params["dimension_numbers"], clip)
    if not inside.all():
        raise CannotSpecialiseError("an index out of bounds")
    return array[places]


def _scatter(simplifier: Simplifier, inputs: Sequence[np.ndarray], params: Mapping[str, Any], add: bool) -> np.ndarray:
    array, indices, updates = inputs
    numbers = params["dimension_numbers"]
    alike = lax.GatherDimensionNumbers(
        offset_dims=numbers.update_window_dims,
        collapsed_slice_dims=numbers.inserted_window_dims,
        start_index_map=numbers.scatter_dims_to_operand_dims,
        operand_batching_dims=numbers.operand_batching_dims,
        start_indices_batching_dims=numbers.scatter_indices_batching_dims,
    )
    kept = [d for d in range(array.ndim) if d not in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)]
    sizes = [1] * array.ndim
    for dim, along in zip(kept, numbers.update_window_dims, strict=True):
        sizes[dim] = updates.shape[along]
    places, inside = _windows(array.shape, indices, sizes, alike, clip=False)
    array, updates = _common([array, updates])
    written = array.copy()
    for entry in np.argwhere(inside):  # XLA drops entries outside
        entry = tuple(entry)
        place = tuple(int(index[entry]) for index in places)
        written[place] = simplifier.make("add", written[place], updates[entry]) if add else updates[entry]
    return written


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
    "iota": lambda _, __, p: _broadcast(
        np.arange(p["shape"][p["dimension"]], dtype=p["dtype"]), p["shape"], [p["dimension"]]
    ),
    "concatenate": lambda _, x, p: np.concatenate(_common(x), p["dimension"]),
    "stack": lambda _, x, p: np.stack(_common(x), p["axis"]),
    "tile": lambda _, x, p: np.tile(x[0], p["reps"]),
    "pad": lambda _, x, p: _pad(x[0], x[1], p["padding_config"]),
    "slice": lambda _, x, p: x[0][
        tuple(map(slice, p["start_indices"], p["limit_indices"], p["strides"] or [1] * x[0].ndim))
    ],
    "dynamic_slice": lambda _, x, p: x[0][_dynamic_slice(x[0], x[1:], p["slice_sizes"])],
    "dynamic_update_slice": lambda _, x, __: _update_slice(*x),
    "gather": lambda _, x, p: _gather(x[0], x[1], p),
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
