"""The package's templates: pages, cards, and files for other programs."""

from collections.abc import Callable, Mapping
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, Template, Undefined


class Code(str):
    """Text that is Python code; every other text reaches a Python file as a string literal."""

    __slots__ = ()


def write_literal(value: Any) -> str:
    """Write a value as Python reads it back: `Code` unchanged, text in double quotes where it has none."""
    if isinstance(value, Code):
        return value
    if isinstance(value, str):
        text = repr(str(value))
        return text if '"' in value else f'"{text[1:-1]}"'
    if isinstance(value, list):
        return f"[{', '.join(map(write_literal, value))}]"
    if isinstance(value, tuple):
        return f"({', '.join(map(write_literal, value))}{',' if len(value) == 1 else ''})"
    if isinstance(value, Mapping):
        return f"{{{', '.join(f'{write_literal(key)}: {write_literal(part)}' for key, part in value.items())}}}"
    return repr(float(value)) if isinstance(value, float) else repr(value)


def write_yaml(value: str | list[str]) -> str:
    """Write text, or a list of it, as YAML reads it back: in double quotes, on one line."""
    return yaml.safe_dump(value, default_style='"', default_flow_style=True, width=float("inf")).rstrip("\n")


def open_template(path: str, filters: Mapping[str, Callable[..., Any]] | None = None, html: bool = False) -> Template:
    """A template that misses nothing silently.

    In a template of a Python file, `NAME.py.jinja`, each value becomes a literal, as autoescaping does for HTML: text
    cannot get into the code. What is code is of the type `Code`, or goes through the filter `code`.

    Args:
        path: Of its file, relative to the package.
        filters: What it may use besides jinja's own, by name.
        html: Whether text is escaped.
    """
    environment = Environment(
        loader=PackageLoader("frictionzoo", ""),
        autoescape=html,
        undefined=StrictUndefined,
        finalize=_finalize if path.endswith(".py.jinja") else None,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"code": Code, **(filters or {})}
    return environment.get_template(path)


def _finalize(value: Any) -> str:
    return str(value) if isinstance(value, Undefined) else write_literal(value)  # which raises
