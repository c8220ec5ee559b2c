"""Writes docs/result.md from the JSON schema of result.json: `python docs/write_result.py`."""

from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from frictionzoo.output import write_atomically
from frictionzoo.report.result import read_schema

PAGE = Path(__file__).with_name("result.md")
HEAD = """# `result.json`

<!-- Made from frictionzoo/report/result.schema.json by `make docs`; change the schema, not this page. -->

{description}

A run writes this file last: where it exists, the run's other files do too. The schema that the file is validated
against ships with the package:

```python
from frictionzoo.report.result import read_schema
```

Every key below is always present. In a path, `[]` stands for each entry of a list.
"""
TABLE = "| key | type | meaning |\n|---|---|---|\n"


def render(schema: Mapping[str, Any]) -> str:
    """The page as Markdown.

    Args:
        schema: The JSON schema of `result.json`.
    """
    definitions = schema["$defs"]
    single, sections = [], []
    for name, field in schema["properties"].items():
        rows = list(_rows(name, field, definitions))
        if len(rows) == 1:
            single += rows
        else:
            sections += [f"## `{name}`\n", rows[0][2] + "\n", _table(rows[1:])]
    for name, field in definitions.items():
        if "properties" in field:
            opening = field.get("description", "One simulated drive beside another.")
            inner = (row for key, value in field["properties"].items() for row in _rows(key, value, definitions))
            sections += [f"## Objects of the kind *{name}*\n", f"{opening}\n", _table(inner)]
    return "\n".join([HEAD.format(description=schema["description"]), "## Single values\n", _table(single), *sections])


def _rows(path: str, field: Mapping[str, Any], definitions: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Path, type and meaning of a field and of what is inside it, but for objects that have a section of their own."""
    kind = field.get("$ref", "").rpartition("/")[2]
    if "properties" in definitions.get(kind, {}):
        yield path, f"*{kind}*", field["description"]
        return
    field = {**definitions.get(kind, {}), **field}
    yield path, _type(field), field.get("description", "")
    inside = next((variant for variant in field.get("oneOf", []) if "properties" in variant), field)
    if "properties" in inside.get("items", {}):
        inside, path = inside["items"], f"{path}[]"
    for name, inner in inside.get("properties", {}).items():
        yield from _rows(f"{path}.{name}", inner, definitions)


def _type(field: Mapping[str, Any]) -> str:
    if "const" in field:
        return f"`{field['const']}`"
    if "enum" in field:
        return " or ".join(f"`{value}`" for value in field["enum"])
    if "oneOf" in field:
        return " or ".join(_type(variant) for variant in field["oneOf"])
    kinds = [field["type"]] if isinstance(field["type"], str) else field["type"]
    return " or ".join(kinds)


def _table(rows: Iterable[tuple[str, str, str]]) -> str:
    lines = (f"| `{path}` | {kind} | {meaning} |" for path, kind, meaning in rows)
    return TABLE + "\n".join(lines) + "\n"


if __name__ == "__main__":
    write_atomically(PAGE, render(read_schema()).encode())
