"""JSON schemas of files, written from the types of their content: `python docs/write_schema.py`."""

import ast
import inspect
import json
import sys
from collections import Counter
from collections.abc import Iterator, Mapping
from itertools import pairwise
from pathlib import Path
from types import NoneType, UnionType
from typing import Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints, is_typeddict

from frictionzoo.result.comparison.types import Comparison
from frictionzoo.result.types import Result

TYPES = {"result": Result, "comparison": Comparison}  # NAME.schema.json is next to the type's file
PLAIN = {str: "string", int: "integer", float: "number", bool: "boolean", NoneType: "null"}


def make_schema(name: str) -> dict[str, Any]:
    """Return the schema of NAME.json.

    Objects used in one place are described there, others under `$defs`.

    Args:
        name: Key of `TYPES`.
    """
    root = TYPES[name]
    places = Counter(_find_objects(root, set()))
    shared = {cls: cls.__name__.removesuffix("Row").lower() for cls, count in places.items() if count > 1}
    head = {"$schema": "https://json-schema.org/draft/2020-12/schema", "title": f"{name}.json"}
    definitions = {kind: _describe_object(cls, shared) for cls, kind in shared.items()}
    return head | _describe_object(root, shared) | {"$defs": definitions}


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


def _find_objects(hint: Any, seen: set[type]) -> Iterator[type]:
    """Yield the object types in a type, once for each use."""
    if is_typeddict(hint):
        yield hint
        inner = () if hint in seen else get_type_hints(hint, include_extras=True).values()
        seen.add(hint)
    else:
        inner = get_args(hint)
    for part in inner:
        yield from _find_objects(part, seen)


def _describe_object(cls: type, shared: Mapping[type, str]) -> dict[str, Any]:
    fields = {key: _describe(hint, shared) for key, hint in get_type_hints(cls, include_extras=True).items()}
    for key, text in _read_texts(cls).items():
        fields[key].pop("description", None)
        fields[key] = {"description": text, **fields[key]}
    shape = {"type": "object", "additionalProperties": False, "required": [*fields], "properties": fields}
    return {"description": _flow(cls.__doc__), **shape} if cls.__doc__ else shape


def _describe(hint: Any, shared: Mapping[type, str]) -> dict[str, Any]:
    if hint in shared:
        return {"$ref": f"#/$defs/{shared[hint]}"}
    if is_typeddict(hint):
        return _describe_object(hint, shared)
    origin, args = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _describe(args[0], shared) | dict(hint.__metadata__)
    if origin is Literal:
        return {"const": args[0]} if len(args) == 1 else {"enum": [*args]}
    if origin is list:
        return {"type": "array", "items": _describe(args[0], shared)}
    if origin is dict:
        named = {} if args[1] is Any else {"additionalProperties": _describe(args[1], shared)}
        return {"type": "object", **named}
    if origin in (Union, UnionType):
        variants = [_describe(part, shared) for part in args]
        if len(args) == 2 and args[1] is NoneType and "type" in variants[0]:
            return variants[0] | {"type": [variants[0]["type"], "null"]}
        return {"oneOf": variants}
    return {"type": PLAIN[hint]}


def _read_texts(cls: type) -> dict[str, str]:
    """Return the text below each key of a class that has one."""
    tree = ast.parse(inspect.getsource(sys.modules[cls.__module__]))
    bodies = (node.body for node in tree.body if isinstance(node, ast.ClassDef) and node.name == cls.__name__)
    lines = next(bodies, [])
    found = {}
    for key, text in pairwise(lines):
        if isinstance(key, ast.AnnAssign) and isinstance(text, ast.Expr):
            found[ast.unparse(key.target)] = _flow(ast.literal_eval(text.value))
    return found


def _flow(text: str) -> str:
    return " ".join(text.split())


if __name__ == "__main__":
    for file in TYPES:
        find_path(file).write_text(lay_out(make_schema(file)) + "\n")
