"""Friction models, one per file, found without a list."""

from frictionzoo.core.params import Parameter
from frictionzoo.models.base import FrictionModel, Params, TorchFriction, Values
from frictionzoo.models.registry import REGISTRY, get_model, model_names, register_model

__all__ = [
    "FrictionModel",
    "Parameter",
    "Params",
    "TorchFriction",
    "Values",
    "get_model",
    "model_names",
    "register_model",
]


def __getattr__(name: str) -> type[FrictionModel]:
    """Return a model class by its class name, as in `_target_`; for static types import it from its module."""
    return REGISTRY.find_class(name)
