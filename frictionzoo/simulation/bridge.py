"""Bridge between torch and JAX: values cross through DLPack, and a JAX function becomes a torch operation."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from typing import Any

import jax
import jax.numpy as jnp
import torch
from torch.autograd.function import once_differentiable

from frictionzoo.core.errors import ConfigError, ModelError, closest


def to_jax(source: torch.nn.Module | Mapping[str, torch.Tensor], dtype: Any) -> dict[str, jax.Array]:
    """Copy a module's state, or a `state_dict`, to JAX's default device; floating-point values become `dtype`.

    An in-place step of a torch optimiser does not change the copies.

    Raises:
        ConfigError: `dtype` is float64 while JAX computes in 32 bits.
    """
    if jnp.dtype(dtype).itemsize > 4 and not _x64():
        raise ConfigError(f"dtype={jnp.dtype(dtype)}: JAX computes in 32 bits, expected x64; set jax_enable_x64")
    state = source.state_dict() if isinstance(source, torch.nn.Module) else source
    return {name: _to_array(tensor, dtype) for name, tensor in state.items()}


def load_from_jax(module: torch.nn.Module, arrays: Mapping[str, jax.Array]) -> None:
    """Write arrays into the module's state in place; other entries, dtypes and devices do not change.

    Raises:
        ModelError: A name or a shape does not fit; nothing is written.
    """
    state = module.state_dict()
    for name, array in arrays.items():
        if name not in state:
            raise ModelError(f"{name}: not in the state of {type(module).__name__}; {closest(name, state)}")
        if tuple(array.shape) != tuple(state[name].shape):
            raise ModelError(
                f"{name}: shape {tuple(array.shape)}, expected {tuple(state[name].shape)} as in "
                f"{type(module).__name__}; load the state of the same model"
            )
    with torch.no_grad():
        for name, array in arrays.items():
            state[name].copy_(_to_tensor(array, state[name].device))


def to_tensors(tree: Any) -> Any:
    """Copy a pytree's arrays to torch tensors in JAX's precision, on the GPU if both JAX and torch use one."""
    on_gpu = _default_device().platform == "gpu" and torch.cuda.is_available()
    device = torch.device("cuda" if on_gpu else "cpu")
    return jax.tree.map(lambda array: _to_tensor(jnp.asarray(array), device), tree)


def to_arrays(tree: Any) -> Any:
    """Copy a pytree's tensors to JAX's default device."""
    return jax.tree.map(_to_array, tree)


def as_torch_function(
    function: Callable[..., Any], compiler_options: Mapping[str, Any] | None = None
) -> Callable[..., Any]:
    """Make a pure JAX function a torch operation over pytrees of tensors, with JAX's reverse-mode gradient.

    It computes in x64 if one of the tensors is float64, else as JAX is configured. Second derivatives are not
    available. The outputs lie on the device of the first tensor; integer and boolean ones carry no gradient.
    """
    options = dict(compiler_options or {})
    linearise = jax.jit(partial(_linearise, function), static_argnums=(0, 1), compiler_options=options)
    pull_back = jax.jit(lambda pull, cotangents: pull(cotangents), compiler_options=options)

    def torch_function(*arguments: Any) -> Any:
        leaves, structure = jax.tree.flatten(arguments)
        call = _Call(linearise, pull_back, leaves, structure)
        outputs = _Bridged.apply(call, *(leaf for leaf in leaves if isinstance(leaf, torch.Tensor)))
        return jax.tree.unflatten(call.output_structure, outputs)

    return torch_function


def _linearise(
    function: Callable[..., Any], structure: Any, moving: tuple[int, ...], leaves: list[Any]
) -> tuple[Any, Any]:
    """Return the outputs, and a function that pulls cotangents of floating-point ones back to the moving leaves."""

    def of_moving(*moved: Any) -> tuple[list[Any], Any]:
        replaced = list(leaves)
        for index, leaf in zip(moving, moved, strict=True):
            replaced[index] = leaf
        outputs = function(*jax.tree.unflatten(structure, replaced))
        return [leaf for leaf in jax.tree.leaves(outputs) if _is_floating(leaf)], outputs

    _, pull, outputs = jax.vjp(of_moving, *(leaves[index] for index in moving), has_aux=True)
    return outputs, pull


@dataclass
class _Call:
    """One call: the input that autograd passes through unchanged, and the structure of the outputs.

    `linearise` is compiled once for each structure of the arguments and choice of moving leaves.
    """

    linearise: Callable[..., Any]
    pull_back: Callable[..., Any]
    leaves: list[Any]
    structure: Any
    output_structure: Any = None


class _Bridged(torch.autograd.Function):
    @staticmethod
    def forward(ctx: Any, call: _Call, *tensors: torch.Tensor) -> tuple[torch.Tensor, ...]:
        needed = iter(ctx.needs_input_grad[1:])
        are_tensors = [isinstance(leaf, torch.Tensor) for leaf in call.leaves]
        moving = tuple(index for index, is_tensor in enumerate(are_tensors) if is_tensor and next(needed))
        ctx.pull_back = call.pull_back
        ctx.devices = [tensor.device for tensor in tensors]
        # Stored, because the setting is local to a thread and backward may run in another.
        ctx.x64 = _x64() or any(tensor.dtype == torch.float64 for tensor in tensors)
        with jax.enable_x64(ctx.x64):
            leaves = [_to_array(leaf) if isinstance(leaf, torch.Tensor) else leaf for leaf in call.leaves]
            outputs, ctx.pull = call.linearise(call.structure, moving, leaves)
        arrays, call.output_structure = jax.tree.flatten(outputs)
        ctx.floating = [_is_floating(array) for array in arrays]
        results = tuple(_to_tensor(array, tensors[0].device) for array in arrays)
        ctx.mark_non_differentiable(*(r for r, floating in zip(results, ctx.floating, strict=True) if not floating))
        return results

    @staticmethod
    @once_differentiable
    def backward(  # pyright: ignore[reportIncompatibleMethodOverride] - the decorator hides the names
        ctx: Any, *cotangents: torch.Tensor
    ) -> tuple[torch.Tensor | None, ...]:
        with jax.enable_x64(ctx.x64):
            floating = [_to_array(c) for c, kept in zip(cotangents, ctx.floating, strict=True) if kept]
            pulled = iter(ctx.pull_back(ctx.pull, floating))
        needed = zip(ctx.needs_input_grad[1:], ctx.devices, strict=True)
        return (None, *(_to_tensor(next(pulled), device) if need else None for need, device in needed))


def _x64() -> bool:
    """Return whether JAX computes in 64 bits, globally or inside `jax.enable_x64`."""
    return jnp.result_type(float) == jnp.float64


def _is_floating(array: Any) -> bool:
    return jnp.issubdtype(jnp.result_type(array), jnp.inexact)


def _to_array(tensor: torch.Tensor, dtype: Any = None) -> jax.Array:
    # Torch makes the copy, in compact strides: `jnp.from_dlpack` shares memory, even if asked to copy.
    array = jnp.from_dlpack(tensor.detach().clone(memory_format=torch.contiguous_format))
    target = dtype if dtype is not None and _is_floating(array) else jax.dtypes.canonicalize_dtype(array.dtype)
    array = array if array.dtype == target else jnp.array(array, target)
    default = _default_device()
    return array if array.device == default else jax.device_put(array, default)


def _to_tensor(array: jax.Array, device: torch.device) -> torch.Tensor:
    """Copy an array to this device: JAX's arrays must not change, torch's may."""
    if device.type == "cpu" and array.device.platform != "cpu":
        array = jax.device_put(array, jax.devices("cpu")[0])
    return torch.from_dlpack(array).to(device).clone()


def _default_device() -> Any:
    chosen = jax.config.jax_default_device
    return chosen if isinstance(chosen, jax.Device) else jax.devices(chosen)[0]
