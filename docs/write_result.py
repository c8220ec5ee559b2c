"""Writes the pages of JSON files from their schemas, docs/result.md for one: `python docs/write_result.py`."""

import json
from collections.abc import Iterable, Iterator, Mapping
from pathlib import Path
from typing import Any

from frictionzoo.card import record as card
from frictionzoo.comparison import record as comparison
from frictionzoo.inspect import survey
from frictionzoo.result import record as result

DOCS = Path(__file__).parent
SCHEMAS = {  # docs/NAME.md is made from the schema of NAME.json
    "result": result.read_schema,
    "comparison": comparison.read_schema,
    "card": card.read_schema,
    "inspect": survey.read_schema,
}
HEAD = """# `{name}.json`

<!-- Made from its JSON schema by `make docs`; change types.py beside that, or where there is none the schema. -->

{description}

The schema that the file is validated against ships with the package:

```python
from {module} import read_schema
```

Every key below is always present. In a path, `[]` stands for each entry of a list, `*` for each key of an object
whose keys are names.
"""
TABLE = "| key | type | meaning |\n|---|---|---|\n"


def render(name: str) -> str:
    """The page as Markdown.

    Args:
        name: One of `SCHEMAS`.
    """
    schema = SCHEMAS[name]()
    definitions = schema.get("$defs", {})
    references = json.dumps(schema)
    single, sections = [], []
    for key, field in schema["properties"].items():
        rows = list(_rows(key, field, definitions))
        if len(rows) == 1:
            single += rows
        else:
            sections += [f"## `{key}`\n", rows[0][2] + "\n", _table(rows[1:])]
    for kind, field in definitions.items():
        if "properties" in field and f'"#/$defs/{kind}"' in references:
            inner = (row for key, value in field["properties"].items() for row in _rows(key, value, definitions))
            sections += [f"## Objects of the kind *{kind}*\n", field["description"] + "\n", _table(inner)]
    head = HEAD.format(name=name, module=SCHEMAS[name].__module__, description=schema["description"])
    return "\n".join([head, "## Single values\n", _table(single), *sections])


def _rows(path: str, field: Mapping[str, Any], definitions: Mapping[str, Any]) -> Iterator[tuple[str, str, str]]:
    """Path, type and meaning of a field and of what is inside it, but for objects that have a section of their own."""
    kind = field.get("$ref", "").rpartition("/")[2]
    if "properties" in definitions.get(kind, {}):
        yield path, f"*{kind}*", field.get("description", definitions[kind].get("description", ""))
        return
    field = {**definitions.get(kind, {}), **field}
    yield path, _type(field), field.get("description", "")
    inside = next((variant for variant in field.get("oneOf", []) if "properties" in variant), field)
    if "properties" in inside.get("items", {}):
        inside, path = inside["items"], f"{path}[]"
    elif "properties" in (named := inside.get("additionalProperties") or {}):
        inside, path = named, f"{path}.*"
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
    for page in SCHEMAS:
        (DOCS / f"{page}.md").write_text(render(page))
