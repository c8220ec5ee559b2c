"""JSON schemas of files, written from the records of their content: `python docs/write_schema.py`."""

import ast
import inspect
import json
import re
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec

from frictionzoo.core.records import Record
from frictionzoo.result.comparison.drift import Drift
from frictionzoo.result.comparison.types import Comparison
from frictionzoo.result.types import Result

TYPES = {"result": Result, "comparison": Comparison, "drift": Drift}  # NAME.schema.json is next to the type's file


def make_schema(name: str) -> dict[str, Any]:
    """Return the schema of NAME.json.

    Objects used in one place are described there, others under `$defs`.

    Args:
        name: Key of `TYPES`.
    """
    kind = TYPES[name]
    _, objects = msgspec.json.schema_components([kind], ref_template="{name}")
    texts = {cls.__name__: dict(_read_texts(cls)) for cls in _list_records(Record)}
    for title, schema in objects.items():
        fields = schema["properties"]
        schema["properties"] = {key: _describe(texts[title].get(key), field) for key, field in fields.items()}
    uses = Counter(_list_references(list(objects.values())))
    shared = {title: re.sub(r"(?<=[a-z])(?=[A-Z])", "_", title).lower() for title, count in uses.items() if count > 1}
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"{name}.json"}
    root = head | _tidy(objects[kind.__name__], objects, shared)
    return root | {"$defs": {shared[title]: _tidy(objects[title], objects, shared) for title in shared}}


def find_path(name: str) -> Path:
    """Return the path of the schema.

    Args:
        name: Key of `TYPES`.
    """
    return Path(inspect.getfile(TYPES[name])).with_name(f"{name}.schema.json")


def lay_out(value: Any, indent: str = "") -> str:
    """Format a value as JSON, with values that hold no object on one line.

    Args:
        value: Value to format.
        indent: Indentation of its first line.
    """
    inner = list(value.values() if isinstance(value, Mapping) else value if isinstance(value, list) else ())
    if not any(isinstance(part, Mapping) for part in inner):
        return json.dumps(value, ensure_ascii=False)
    deeper, (begin, end) = indent + "  ", "{}" if isinstance(value, Mapping) else "[]"
    keys = [f"{json.dumps(key)}: " for key in value] if isinstance(value, Mapping) else [""] * len(inner)
    lines = [f"{deeper}{key}{lay_out(part, deeper)}" for key, part in zip(keys, inner, strict=True)]
    return "\n".join([begin, ",\n".join(lines), indent + end])


def _describe(text: str | None, field: Mapping[str, Any]) -> dict[str, Any]:
    return {"description": text, **field} if text else dict(field)


def _list_references(node: Any) -> Iterator[str]:
    """Yield the name of an object for each of its uses."""
    if isinstance(node, Mapping) and "$ref" in node:
        yield node["$ref"]
    for part in node.values() if isinstance(node, Mapping) else node if isinstance(node, list) else ():
        yield from _list_references(part)


def _tidy(node: Any, objects: Mapping[str, Any], shared: Mapping[str, str]) -> Any:
    """Return a schema of msgspec in the form of the files: no titles, one object in the place of its only use."""
    if not isinstance(node, Mapping):
        return [_tidy(part, objects, shared) for part in node] if isinstance(node, list) else node
    node = {key: part for key, part in node.items() if key != "title" or not isinstance(part, str)}
    if "description" in node and isinstance(node["description"], str):
        node["description"] = " ".join(node["description"].split())
    if (name := node.pop("$ref", None)) in shared:
        return {**node, "$ref": f"#/$defs/{shared[name]}"}
    if name is not None:
        return _tidy({**objects[name], **node}, objects, shared)
    if len(node.get("enum", ())) == 1:
        (node["const"],) = node.pop("enum")
    if "anyOf" in node:
        first, *others = _tidy(node.pop("anyOf"), objects, shared)
        if others == [{"type": "null"}] and "type" in first:
            return {**first, **node, "type": [first["type"], "null"]}
        return {**node, "oneOf": [first, *others]}
    return {key: _tidy(part, objects, shared) for key, part in node.items()}


def _list_records(cls: type[Record]) -> Iterator[type[Record]]:
    for record in cls.__subclasses__():
        yield record
        yield from _list_records(record)


def _read_texts(cls: type[Record]) -> Iterator[tuple[str, str]]:
    """Yield the fields of a record that have a text below them, and the text."""
    for parent in reversed(cls.__mro__):
        if not (issubclass(parent, Record) and parent.__module__.startswith("frictionzoo.")):
            continue
        (node,) = ast.parse(inspect.getsource(parent)).body
        assert isinstance(node, ast.ClassDef)
        for key, text in pairwise(node.body):
            if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr):
                yield ast.unparse(key.target), " ".join(ast.literal_eval(text.value).split())


if __name__ == "__main__":
    for file in TYPES:
        find_path(file).write_text(lay_out(make_schema(file)) + "\n")
