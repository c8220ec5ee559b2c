"""Python files that hold configuration classes of other programs: written as text, and read without running them."""

import ast
from collections.abc import Sequence
from typing import Any, NamedTuple


class Field(NamedTuple):
    """A keyword of a configuration class.

    Attributes:
        name: Its name.
        value: As Python writes it.
        unit: For a comment; empty for none.
    """

    name: str
    value: str
    unit: str = ""


def write_module(docstring: str, imports: str, name: str, entries: Sequence[str]) -> str:
    """A Python module that holds one constant, a tuple or dict of these entries."""
    body = "\n".join(f"    {line}" if line else "" for entry in entries for line in entry.splitlines())
    opening, closing = ("{", "}") if entries and entries[0].startswith('"') else ("(", ")")
    return f'"""{docstring}"""\n\n{imports}\n\n{name} = {opening}\n{body}\n{closing}\n'


def write_call(cls: str, fields: Sequence[Field], key: str = "") -> str:
    """A call with one keyword a line, its unit beside it, as an entry of a tuple or of a dict under a key."""
    lines = [f"    {f.name}={f.value}," + (f"  # {f.unit}" if f.unit else "") for f in fields]
    head = f"{key}: {cls}(" if key else f"{cls}("
    return "\n".join([head, *lines, "),"])


def read_calls(text: str) -> list[tuple[str, dict[str, Any]]]:
    """Class and keywords of each outermost call in a module, without running it.

    Args:
        text: The module.
    """
    assigned = [node.value for node in ast.parse(text).body if isinstance(node, ast.Assign)]
    holders = [node.values if isinstance(node, ast.Dict) else getattr(node, "elts", []) for node in assigned]
    calls = [node for nodes in holders for node in nodes if isinstance(node, ast.Call)]
    return [(ast.unparse(call.func), {str(k.arg): ast.literal_eval(k.value) for k in call.keywords}) for call in calls]
