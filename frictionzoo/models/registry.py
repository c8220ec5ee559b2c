"""Friction models by name, from this package and from other packages."""

from collections.abc import Callable

from frictionzoo.core.errors import ModelError, UnknownModelError
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.models.base import FrictionModel

REGISTRY = Registry(KINDS["models"], FrictionModel, "terms", ModelError, UnknownModelError)

register_model = REGISTRY.register
"""Class decorator that registers a friction model under its name in the literature; see `Registry.register`."""

get_model: Callable[[str], type[FrictionModel]] = REGISTRY.get
"""Return the friction model with this name; see `Registry.get`."""

model_names: Callable[[], list[str]] = REGISTRY.names
"""Return the names of all friction models, sorted."""
