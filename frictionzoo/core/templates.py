"""Templates of the package: pages, cards, and files for other programs."""

from collections.abc import Callable, Mapping
from typing import Any

import yaml
from jinja2 import Environment, PackageLoader, StrictUndefined, Template, Undefined


class Code(str):
    """Python code; any other text reaches a Python file as a string literal."""

    __slots__ = ()


def write_literal(value: Any) -> str:
    """Write a value as a Python literal: `Code` unchanged, text in double quotes unless it contains one."""
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
    """Write text or a list of texts as YAML, in double quotes, on one line."""
    return yaml.safe_dump(value, default_style='"', default_flow_style=True, width=float("inf")).rstrip("\n")


def open_template(path: str, filters: Mapping[str, Callable[..., Any]] | None = None, html: bool = False) -> Template:
    """Open a template, by its path in the package, that raises for undefined names; `filters` extend jinja's.

    In a template of a Python file, `NAME.py.jinja`, each value becomes a literal, unless it is `Code` or passes through
    the filter `code`: text cannot become code.
    """

    def finalize(value: Any) -> str:
        return str(value) if isinstance(value, Undefined) else write_literal(value)  # str() raises if undefined

    environment = Environment(
        loader=PackageLoader("frictionzoo", ""),
        autoescape=html,
        undefined=StrictUndefined,
        finalize=finalize if path.endswith(".py.jinja") else None,
        trim_blocks=True,
        lstrip_blocks=True,
        keep_trailing_newline=True,
    )
    environment.filters |= {"code": Code, **(filters or {})}
    return environment.get_template(path)
