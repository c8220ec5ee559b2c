"""Parts from sections of a configuration."""

import importlib
from collections.abc import Mapping
from typing import Any

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.registry import find_registered, plug_in_packages


def build(section: Mapping[str, Any], **more: Any) -> Any:
    """Construct what a section's `_target_` names, with the section's other keys as arguments.

    Nested sections with a `_target_` are built first. Only classes of frictionzoo, of packages that bring plug-ins,
    and registered plug-ins are built, so that a configuration from elsewhere cannot run arbitrary code.

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
    if registered := find_registered(target):
        return registered
    packages = plug_in_packages()
    module, _, name = target.rpartition(".")
    stranger = ConfigError(f"_target_={target}; expected a class of {' or '.join(sorted(packages))}")
    if module.partition(".")[0] not in packages:
        raise stranger
    try:
        found = getattr(importlib.import_module(module), name)
    except (ModuleNotFoundError, AttributeError):
        raise ConfigError(f"_target_={target}; expected a class that exists; compare with conf/") from None
    # A module may also hold what it imported from elsewhere.
    if not isinstance(found, type) or found.__module__.partition(".")[0] not in packages:
        raise stranger
    return found
