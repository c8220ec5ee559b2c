"""Friction models by name: those of this package, and those that other packages bring."""

from collections.abc import Callable

from frictionzoo.core.errors import ModelError, UnknownModelError
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.models.base import FrictionModel

REGISTRY = Registry(KINDS["models"], FrictionModel, "terms", ModelError, UnknownModelError)

register_model = REGISTRY.register
"""Class decorator that makes a friction law available under its name in the literature, as `Registry.register`."""

get_model: Callable[[str], type[FrictionModel]] = REGISTRY.get
"""The friction law of that name, as `Registry.get`."""

model_names: Callable[[], list[str]] = REGISTRY.names
"""Names of all friction laws, sorted."""
