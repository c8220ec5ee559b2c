"""Log formats by name: those of this package, and those that other packages bring."""

from collections.abc import Callable

from frictionzoo.core.errors import ConfigError
from frictionzoo.core.registry import Registry
from frictionzoo.logs.formats.base import Format

REGISTRY = Registry(
    *("log format", Format, "parse", "register_format", "frictionzoo.formats"), *(ConfigError, ConfigError)
)


def register_format(name: str) -> Callable[[type[Format]], type[Format]]:
    """Class decorator that makes a format available as `data.format=NAME`.

    Args:
        name: Lower case with underscores.

    Raises:
        ConfigError: The name is taken or not lower case with underscores, or the class is not a complete `Format` or
            has a name already.
    """
    return lambda cls: REGISTRY.add(name, cls)


def get_format(name: str) -> Format:
    """The format of that name.

    Raises:
        ConfigError: No such name, two packages bring it, or the one that does is broken.
    """
    return REGISTRY.get(name)()


def format_names() -> list[str]:
    """Names of all formats, sorted."""
    return REGISTRY.names()
