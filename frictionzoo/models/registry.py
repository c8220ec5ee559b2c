"""Friction models by name: those of this package, and those that other packages bring."""

import inspect
from collections.abc import Callable
from importlib.metadata import EntryPoint, entry_points
from typing import Any

from frictionzoo.errors import ModelError, UnknownModelError, closest
from frictionzoo.models.base import FrictionModel

GROUP = "frictionzoo.models"
_models: dict[str, type[FrictionModel]] = {}


def register_model(name: str) -> Callable[[type[FrictionModel]], type[FrictionModel]]:
    """Class decorator that makes a friction law available under its name in the literature.

    Args:
        name: Lower case with underscores.

    Raises:
        ModelError: The name is taken or not lower case with underscores, or the class is not a complete
            `FrictionModel` or has a name already.
    """

    def register(cls: Any) -> type[FrictionModel]:
        if not (isinstance(cls, type) and issubclass(cls, FrictionModel)) or inspect.isabstract(cls):
            raise ModelError(f"{name}: {cls!r} is registered, expected a FrictionModel class with a `terms` method")
        if not name.isidentifier() or name != name.lower():
            raise ModelError(f"{name}: expected a name in lower case with underscores; rename the model")
        # A class that is defined again, as when a notebook's cell is run again, replaces its older self.
        if _place(_models.get(name, cls)) != _place(cls):
            raise ModelError(f"{name}: already registered by {_models[name].__qualname__}; choose another name")
        # A subclass inherits its parent's name, which is not its own.
        if vars(cls).get("name", name) != name:
            raise ModelError(f"{name}: {cls.__qualname__} is already registered as {cls.name}; one name a law")
        cls.name = name
        _models[name] = cls
        return cls

    return register


def get_model(name: str) -> type[FrictionModel]:
    """The friction law of that name.

    Args:
        name: As registered, here or by a package with an entry point in the group `frictionzoo.models`.

    Raises:
        UnknownModelError: No such name; the message names the closest.
        ModelError: Two packages bring the name, or the one that does is broken.
    """
    outside = _outside()
    if name not in _models and name not in outside:
        raise UnknownModelError(f"{name}: no such friction model; {closest(name, {*outside, *_models})}")
    if name in outside:
        _load(outside[name])
    return _models[name]


def model_names() -> list[str]:
    """Names of all friction laws, sorted."""
    return sorted({*_outside(), *_models})


def registered_models() -> dict[str, type[FrictionModel]]:
    """The laws that were registered in this process, by the dotted name of their class, as `_target_` has it."""
    return {_place(cls): cls for cls in _models.values()}


def _place(cls: type[FrictionModel]) -> str:
    """Dotted name of a class."""
    return f"{cls.__module__}.{cls.__qualname__}"


def _outside() -> dict[str, EntryPoint]:
    points: dict[str, EntryPoint] = {}
    for found in entry_points(group=GROUP):
        # The backport importlib_metadata takes discovery over where it is imported, with a class of its own.
        point = EntryPoint(found.name, found.value, found.group)
        if points.setdefault(point.name, point).value != point.value:
            raise ModelError(
                f"{point.name}: entry points {points[point.name].value} and {point.value} both bring it; "
                "uninstall one of the packages"
            )
    return points


def _load(point: EntryPoint) -> None:
    """Import what an entry point names and see that it registered the model itself, not one of the same name."""
    try:
        point.load()
    except (ImportError, AttributeError) as error:
        raise ModelError(f"{point.name}: its entry point {point.value} does not load ({error}); fix it") from error
    if point.name not in _models:
        raise ModelError(
            f"{point.name}: its entry point {point.value} registers no model of that name; "
            f'decorate it @register_model("{point.name}")'
        )
    owner = _models[point.name].__module__
    if owner.partition(".")[0] != point.module.partition(".")[0]:
        raise ModelError(f"{point.name}: brought by both {owner} and {point.value}; uninstall one or rename its model")
