"""Parts from sections of a configuration."""

import importlib
from collections.abc import Mapping
from importlib.metadata import entry_points
from typing import Any

from frictionzoo.core.errors import ConfigError


def build(section: Mapping[str, Any], **more: Any) -> Any:
    """Construct what a section's `_target_` names, with the section's other keys as arguments.

    Nested sections with a `_target_` are built first. Only classes of frictionzoo, of packages that bring friction
    models, and registered friction models are built, so that a configuration from elsewhere cannot run arbitrary code.

    Args:
        section: `_target_` and constructor arguments.
        more: Further arguments, which the configuration does not know.

    Raises:
        ConfigError: The target is not one of these classes, or does not take these arguments.
    """
    arguments = {
        name: build(value) if isinstance(value, Mapping) and "_target_" in value else value
        for name, value in section.items()
        if name != "_target_"
    }
    target = str(section["_target_"])
    try:
        return _find(target)(**arguments, **more)
    except TypeError as error:
        raise ConfigError(f"{target}: {' '.join(str(error).split())}; compare the section with conf/") from error


def _find(target: str) -> Any:
    if not target.startswith("frictionzoo."):
        # Imported here, so that what needs no law does not wait for torch.
        from frictionzoo.models.registry import registered_models

        if target in (registered := registered_models()):  # also laws of the program that runs, of a notebook say
            return registered[target]
    packages = {"frictionzoo", *(point.module.partition(".")[0] for point in entry_points(group="frictionzoo.models"))}
    module, _, name = target.rpartition(".")
    if module.partition(".")[0] not in packages:
        raise ConfigError(f"_target_={target}; expected a class of {' or '.join(sorted(packages))}")
    try:
        found = getattr(importlib.import_module(module), name)
    except (ModuleNotFoundError, AttributeError):
        raise ConfigError(f"_target_={target}; expected a class that exists; compare with conf/") from None
    # A module may also hold what it imported from elsewhere.
    if not isinstance(found, type) or found.__module__.partition(".")[0] not in packages:
        raise ConfigError(f"_target_={target}; expected a class of {' or '.join(sorted(packages))}")
    return found
