"""A law's formula as text: its own methods and the functions that they call, for modules that stand alone."""

import ast
import inspect
import math
import numbers
import textwrap
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from types import FunctionType, ModuleType
from typing import Any

import numpy as np
import torch
from jaxtyping import Float

from frictionzoo.core.errors import ExportError
from frictionzoo.core.state import DriveState, FrictionTerms
from frictionzoo.core.templates import Code, write_literal
from frictionzoo.models import FrictionModel

INLINE = 64  # numbers up to which an array is written as text; a larger one, of a network, goes into a file beside
_PROVIDED = (DriveState, FrictionTerms)
_MODULES: Mapping[ModuleType, str] = {np: "numpy", math: "math"}


@dataclass
class Source:
    """What a module needs so that methods of an object can be called there.

    Attributes:
        imports: Import statements.
        functions: Text of each function that is called, by name, of each constant, and of the class of each law in it.
        methods: Text of each method, by name.
        attributes: Value of each attribute that the methods read, as text, by name.
    """

    imports: dict[str, str] = field(default_factory=dict)
    functions: dict[str, str] = field(default_factory=dict)
    methods: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, str] = field(default_factory=dict)

    def take(self, other: "Source") -> None:
        """What another needs around its class, too.

        Raises:
            ExportError: The two call different things by one name.
        """
        for name, text in other.functions.items():
            if self.functions.setdefault(name, text) != text:
                raise ExportError(f"{name}: two functions of this name, expected one; rename the law's")
        self.imports.update(other.imports)

    def as_class(self, name: str, docstring: str) -> Code:
        """A class of this name with these methods and attributes; neither the name nor the docstring is a user's."""
        lines = [f"{key} = {value}" for key, value in self.attributes.items()]
        body = [f'"""{docstring}"""', *(["\n".join(lines)] if lines else []), *self.methods.values()]
        return Code(f"class {name}:\n" + textwrap.indent("\n\n".join(body), 4 * " ") + "\n")


def read_source(owner: Any, *methods: str) -> Source:
    """What stands behind methods of a friction or an actuator law, in numbers and Python over an array namespace.

    Raises:
        ExportError: A method needs something that cannot be written down: another package, a closure, an object.
    """
    source = Source()
    for method in methods:
        _add_method(source, owner, method)
    return source


def merge(*sources: Source) -> Source:
    """What all of them need around their classes.

    Raises:
        ExportError: Two of them call different things by one name.
    """
    merged = Source()
    for source in sources:
        merged.take(source)
    return merged


def write_values(values: Mapping[str, Float[np.ndarray, "..."]]) -> tuple[Code, dict[str, np.ndarray]]:
    """Values by name as the text of a dictionary over `np`, and those that are too large for it."""
    arrays = {name: np.asarray(value) for name, value in values.items()}
    large = {name: array for name, array in arrays.items() if array.size > INLINE}
    small = {write_literal(name): array.tolist() for name, array in arrays.items() if name not in large}
    lines = [f"    {name}: np.array({numbers!r})," for name, numbers in small.items()]
    return Code("\n".join(["{", *lines, "}"])), large


def _add_method(source: Source, owner: Any, name: str) -> None:
    if name in source.methods:
        return
    function = inspect.unwrap(getattr(type(owner), name))
    text, tree = _read(function)
    source.methods[name] = text
    for attribute in sorted(_own_attributes(tree)):
        found = getattr(owner, attribute, None)
        if inspect.ismethod(found):
            _add_method(source, owner, attribute)
        elif isinstance(found, tuple) and any(isinstance(part, FrictionModel) for part in found):
            source.attributes[attribute] = _add_laws(source, found)
        else:
            source.attributes[attribute] = _write_attribute(owner, attribute, found)
    _add_globals(source, function, tree)


def _add_laws(source: Source, laws: Sequence[FrictionModel]) -> str:
    """Laws that a law is made of, a class each; as text, an object of each."""
    names = []
    for number, law in enumerate(laws, 1):
        own = read_source(law, "terms", "settle", "advance")
        names.append(f"Law{number}")
        source.take(own)
        source.functions[names[-1]] = own.as_class(names[-1], "The friction law of some of the joints.")
    return f"({', '.join(f'{name}()' for name in names)},)"


def _read(function: Any) -> tuple[str, ast.FunctionDef]:
    try:
        text = textwrap.dedent(inspect.getsource(function)).rstrip()
        tree = ast.parse(text).body[0]
    except (OSError, TypeError, SyntaxError) as error:
        raise ExportError(f"{function}: its source cannot be read ({error}); define it in a file") from None
    if not isinstance(tree, ast.FunctionDef) or tree.decorator_list or function.__closure__:
        raise ExportError(
            f"{function.__qualname__}: expected a plain function without decorators and closures; write it as one"
        )
    return text, tree


def _own_attributes(tree: ast.FunctionDef) -> set[str]:
    """What a method reads of the object that it belongs to."""
    own = tree.args.args[0].arg
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == own
    }


def _add_globals(source: Source, function: FunctionType, tree: ast.FunctionDef) -> None:
    body = (node for statement in tree.body for node in ast.walk(statement))  # annotations are not evaluated
    for name in dict.fromkeys(node.id for node in body if isinstance(node, ast.Name)):
        if name not in function.__globals__ or name in source.functions or name in source.imports:
            continue
        value = function.__globals__[name]
        if isinstance(value, FunctionType):
            _add_function(source, name, inspect.unwrap(value))
        elif isinstance(value, ModuleType) and value in _MODULES:
            source.imports[name] = f"import {_MODULES[value]} as {name}"
        elif not any(value is known for known in _PROVIDED):
            source.functions[name] = f"{name} = {_write_attribute(function.__qualname__, name, value)}"


def _add_function(source: Source, name: str, function: Any) -> None:
    text, tree = _read(function)
    if function.__name__ != name:
        raise ExportError(f"{name}: another name of the function {function.__name__}, expected its own; use that")
    source.functions[name] = ""  # holds the place, in case it calls itself
    _add_globals(source, function, tree)
    source.functions[name] = text


def _write_attribute(owner: Any, name: str, value: Any) -> str:
    """A number, a text, a collection of them, or modules, of which only the number counts."""
    if isinstance(value, torch.nn.ModuleList):
        return f"{len(value)} * [None]"
    if _is_plain(value):
        return write_literal(value)
    label = owner if isinstance(owner, str) else type(owner).__name__
    raise ExportError(
        f"{label}: {name} is a {type(value).__name__}, expected a number, a text or a function of the same file; keep "
        "arrays among the law's parameters or buffers, where `values` has them"
    )


def _is_plain(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return all(map(_is_plain, value))
    return isinstance(value, numbers.Number | str | bool | type(None))
