"""Friction models by name: those of this package, and those that other packages bring."""

from collections.abc import Callable

from frictionzoo.core.errors import ModelError, UnknownModelError
from frictionzoo.core.registry import Registry, dotted_name
from frictionzoo.models.base import FrictionModel

REGISTRY = Registry(
    *("friction model", FrictionModel, "terms", "register_model", "frictionzoo.models"),
    *(ModelError, UnknownModelError),
)


def register_model(name: str) -> Callable[[type[FrictionModel]], type[FrictionModel]]:
    """Class decorator that makes a friction law available under its name in the literature.

    Args:
        name: Lower case with underscores.

    Raises:
        ModelError: The name is taken or not lower case with underscores, or the class is not a complete
            `FrictionModel` or has a name already.
    """
    return lambda cls: REGISTRY.add(name, cls)


def get_model(name: str) -> type[FrictionModel]:
    """The friction law of that name.

    Args:
        name: As registered, here or by a package with an entry point in the group `frictionzoo.models`.

    Raises:
        UnknownModelError: No such name; the message names the closest.
        ModelError: Two packages bring the name, or the one that does is broken.
    """
    return REGISTRY.get(name)


def model_names() -> list[str]:
    """Names of all friction laws, sorted."""
    return REGISTRY.names()


def registered_models() -> dict[str, type[FrictionModel]]:
    """The laws that were registered in this process, by the dotted name of their class, as `_target_` has it."""
    return {dotted_name(cls): cls for cls in REGISTRY.entries.values()}
