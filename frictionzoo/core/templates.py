"""The package's templates: pages, cards, and files for other programs."""

from collections.abc import Callable, Mapping
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template


def open_template(path: str, filters: Mapping[str, Callable[..., Any]] | None = None, html: bool = False) -> Template:
    """A template that misses nothing silently.

    Args:
        path: Of its file, relative to the package.
        filters: What it may use besides jinja's own, by name.
        html: Whether text is escaped.
    """
    environment = Environment(
        loader=PackageLoader("frictionzoo", ""),
        autoescape=html,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= dict(filters or {})
    return environment.get_template(path)
