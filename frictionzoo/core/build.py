"""Construction of objects from sections of a configuration."""

from collections.abc import Mapping
from typing import Any

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.registry import find_plugin, import_class, plug_in_packages

# Classes that a section may name in addition to plug-ins; a foreign configuration cannot import anything else.
_PARTS = (
    "frictionzoo.bench.Bench",
    "frictionzoo.bench.Robot",
    *(f"frictionzoo.fit.loggers.{name}" for name in ("Csv", "Mlflow", "TensorBoard", "Wandb")),
    "frictionzoo.data.clean.Cleaning",
    "frictionzoo.data.logs.InMemory",
)


def build(section: Any, base: type = object, /, **more: Any) -> Any:
    """Construct the class in a section's `_target_` with the section's other keys and `more` as arguments.

    Nested sections with a `_target_` are built first. The target derives from `base`, and is a registered plug-in or in
    `_PARTS`: a foreign section runs no other code.

    Raises:
        ConfigError: There is no section, its target is not such a class, or the class does not take the arguments.
    """
    if not isinstance(section, Mapping) or "_target_" not in section:
        raise ConfigError(f"{section!r:.80}: expected a section with _target_; compare it with conf/")
    target = section["_target_"]
    cls = _find(target)
    if not issubclass(cls, base):
        raise ConfigError(f"_target_={target}; expected a class derived from {base.__name__}; compare it with conf/")
    arguments = {
        name: build(value) if isinstance(value, Mapping) and "_target_" in value else value
        for name, value in section.items()
        if name != "_target_"
    }
    try:
        return cls(**arguments, **more)
    except TypeError as error:
        raise ConfigError(f"{target}: {' '.join(str(error).split())}; compare the section with conf/") from error


def _find(target: Any) -> type:
    if target in _PARTS:
        return import_class(target)
    if isinstance(target, str) and (cls := find_plugin(target)):
        return cls
    packages = " or ".join(sorted(plug_in_packages()))
    raise ConfigError(
        f"_target_={target}; expected a class of {packages} that is registered; python -m frictionzoo.list lists them"
    )
