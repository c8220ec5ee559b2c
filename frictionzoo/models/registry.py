"""Friction models by name: those of this package, and those that other packages bring."""

from frictionzoo.core.errors import ModelError, UnknownModelError
from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.models.base import FrictionModel

REGISTRY = Registry(KINDS["models"], FrictionModel, "terms", ModelError, UnknownModelError)

register_model = REGISTRY.register
"""Class decorator that makes a friction law available under its name in the literature, as `Registry.register`."""


def get_model(name: str) -> type[FrictionModel]:
    """The friction law of that name.

    Args:
        name: As registered, here or by a package with an entry point in the group `frictionzoo.models`.

    Raises:
        UnknownModelError: No such name; the message names the closest.
        ModelError: Two packages bring the name, or the one that does is broken.
    """
    return REGISTRY.get(name)


model_names = REGISTRY.names
"""Names of all friction laws, sorted."""
