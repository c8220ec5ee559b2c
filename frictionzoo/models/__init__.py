"""Friction laws, one a file; the files are looked through, not listed."""

from frictionzoo.models.base import FrictionModel, Params, Values
from frictionzoo.models.registry import REGISTRY, get_model, model_names, register_model
from frictionzoo.models.torch_friction import TorchFriction

__all__ = ["FrictionModel", "Params", "TorchFriction", "Values", "get_model", "model_names", "register_model"]


def __getattr__(name: str) -> type[FrictionModel]:
    """A law by the name of its class, as `_target_` has it; its own module has its type."""
    return REGISTRY.find_class(name)
