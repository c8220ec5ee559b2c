"""Evaluation of a model's formula in torch and in JAX: values, and gradients by all arguments."""

from collections.abc import Callable, Iterator, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import torch

from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.models.base import FrictionModel, Values

Formula = Callable[[Any, Values, DriveState], dict[str, Any]]
DRAWS = 5  # of values, to check what holds for any values in bounds


def as_numpy(arrays: Mapping[str, Any]) -> dict[str, np.ndarray]:
    """Convert tensors and arrays to numpy arrays."""
    return {name: a.detach().numpy() if isinstance(a, torch.Tensor) else np.asarray(a) for name, a in arrays.items()}


def torch_values(model: FrictionModel, dtype: torch.dtype = torch.float64) -> dict[str, torch.Tensor]:
    """Return a copy of a model's parameters and buffers, with floating-point numbers as `dtype`."""
    state = {name: tensor.detach().clone() for name, tensor in model.state_dict().items()}
    return {name: tensor.to(dtype) if tensor.is_floating_point() else tensor for name, tensor in state.items()}


def torch_state(state: DriveState, dtype: torch.dtype = torch.float64) -> DriveState:
    """Return the state as tensors of this type."""
    return state.map(lambda signal: torch.tensor(signal, dtype=dtype))


def numpy_terms(model: FrictionModel, values: Mapping[str, torch.Tensor], samples: DriveState) -> FrictionTerms:
    """Return the terms of a model with these values, for numpy samples: computed in torch, converted to numpy."""
    return FrictionTerms(**as_numpy(model.terms(torch, values, torch_state(samples)).given()))


def draw_values(model: FrictionModel, weights: bool = False) -> Iterator[dict[str, torch.Tensor]]:
    """Yield a model's values, then `DRAWS` others: parameters between their bounds, and, if `weights`, new weights."""
    random, drawn = np.random.default_rng(0), torch_values(model)
    redrawn = [name for name, _ in model.named_parameters() if weights and name not in model.params]
    for _ in range(1 + DRAWS):
        yield drawn
        drawn = {**drawn, **{name: torch.tensor(random.normal(size=drawn[name].shape)) for name in redrawn}}
        for name, param in model.params.items():
            ends = (param.each(side, model.nv)[param.members(model.nv)] for side in ("low", "high"))
            low, high = (param.to_coordinate(end, np) for end in ends)
            drawn[name] = torch.tensor(param.from_coordinate(random.uniform(low, high), np))


def _weighted(terms: Mapping[str, Any], weights: Mapping[str, Any]) -> Any:
    """Return one number that depends on every entry of every term."""
    return sum((weights[name] * term).sum() for name, term in terms.items())


def _moving(model: FrictionModel, values: Values, state: DriveState) -> dict[str, Any]:
    """Return the arguments of a gradient: all parameters, and the state."""
    return {name: values[name] for name, _ in model.named_parameters()} | state.given()


def torch_slopes(
    model: FrictionModel, state: DriveState, formula: Formula, weights: Mapping[str, np.ndarray]
) -> tuple[dict[str, np.ndarray], dict[str, np.ndarray]]:
    """Return a formula's values in torch, and the gradient of their weighted sum."""
    values, drive = torch_values(model), torch_state(state)
    moving = _moving(model, values, drive)
    for tensor in moving.values():
        tensor.requires_grad_()
    result = formula(torch, values, drive)
    total = _weighted(result, {name: torch.tensor(weight) for name, weight in weights.items()})
    if not isinstance(total, torch.Tensor) or not total.requires_grad:
        return as_numpy(result), {name: np.zeros(tuple(tensor.shape)) for name, tensor in moving.items()}
    gradient = torch.autograd.grad(total, list(moving.values()), allow_unused=True, materialize_grads=True)
    return as_numpy(result), as_numpy(dict(zip(moving, gradient, strict=True)))


def jax_slopes(
    model: FrictionModel, states: list[DriveState], formula: Formula, weights: Mapping[str, np.ndarray]
) -> list[dict[str, np.ndarray]]:
    """Return the same as `torch_slopes` in JAX, with a first dimension for the states."""

    def slopes(values: Values, weights: Values, drive: DriveState) -> tuple[Any, Any]:
        def total(moving: dict[str, jax.Array]) -> tuple[jax.Array, dict[str, jax.Array]]:
            moved = drive._replace(**{name: moving[name] for name in drive.given()})
            result = formula(jnp, {**values, **moving}, moved)
            return jnp.zeros(()) + _weighted(result, weights), result

        gradient, result = jax.grad(total, has_aux=True)(_moving(model, values, drive))
        return result, gradient

    stacked = jax.tree.map(lambda *signals: np.stack(signals), *states)
    compiled = jax.jit(jax.vmap(slopes, in_axes=(None, None, 0)))
    return [as_numpy(part) for part in compiled(as_numpy(torch_values(model)), weights, stacked)]
