"""Log formats by name: those of this package, and those that other packages bring."""

from collections.abc import Callable

from frictionzoo.core.registry import KINDS, Registry
from frictionzoo.logs.formats.base import Format

REGISTRY = Registry(KINDS["formats"], Format, "parse")

register_format = REGISTRY.register
"""Class decorator that makes a format available as `data.format=NAME`, as `Registry.register`."""


def get_format(name: str) -> Format:
    """The format of that name.

    Raises:
        ConfigError: No such name, two packages bring it, or the one that does is broken.
    """
    return REGISTRY.get(name)()


format_names: Callable[[], list[str]] = REGISTRY.names
"""Names of all formats, sorted."""
