"""Source text of a model's formula, with all functions that it calls, for self-contained modules."""

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

INLINE = 64  # largest size of an array written as text; larger ones, such as weights, go into a separate file
_PROVIDED = (DriveState, FrictionTerms)
_MODULES: Mapping[ModuleType, str] = {np: "numpy", math: "math"}


@dataclass
class SourceText:
    """Source text of an object's methods and all dependencies, by name.

    Attributes:
        imports: Import statements.
        functions: Text of each called function, constant, and class of a contained model.
        methods: Text of each method.
        attributes: Value of each attribute that the methods read, as text.
    """

    imports: dict[str, str] = field(default_factory=dict)
    functions: dict[str, str] = field(default_factory=dict)
    methods: dict[str, str] = field(default_factory=dict)
    attributes: dict[str, str] = field(default_factory=dict)

    def take(self, other: "SourceText") -> None:
        """Add imports and functions of another source.

        Raises:
            ExportError: Both have different functions of the same name.
        """
        for name, text in other.functions.items():
            if self.functions.setdefault(name, text) != text:
                raise ExportError(f"{name}: two functions of this name, expected one; rename the law's")
        self.imports.update(other.imports)

    def as_class(self, name: str, docstring: str) -> Code:
        """Write a class with these methods and attributes; name and docstring must not come from a user."""
        lines = [f"{key} = {value}" for key, value in self.attributes.items()]
        body = [f'"""{docstring}"""', *(["\n".join(lines)] if lines else []), *self.methods.values()]
        return Code(f"class {name}:\n" + textwrap.indent("\n\n".join(body), 4 * " ") + "\n")


def read_source(owner: Any, *methods: str) -> SourceText:
    """Read the source of methods of a friction or actuator model.

    Raises:
        ExportError: A method needs something that cannot be written as text: another package, a closure, an object.
    """
    source = SourceText()
    for method in methods:
        _add_method(source, owner, method)
    return source


def write_values(values: Mapping[str, Float[np.ndarray, "..."]]) -> tuple[Code, dict[str, np.ndarray]]:
    """Write values as the text of a dictionary of `np` arrays; also return the arrays too large for it."""
    arrays = {name: np.asarray(value) for name, value in values.items()}
    large = {name: array for name, array in arrays.items() if array.size > INLINE}
    small = {write_literal(name): array.tolist() for name, array in arrays.items() if name not in large}
    lines = [f"    {name}: np.array({numbers!r})," for name, numbers in small.items()]
    return Code("\n".join(["{", *lines, "}"])), large


def _add_method(source: SourceText, owner: Any, name: str) -> None:
    if name in source.methods:
        return
    function = inspect.unwrap(getattr(type(owner), name))
    text, tree = _read(function)
    source.methods[name] = text
    for attribute in sorted(_own_attributes(tree)):
        value = getattr(owner, attribute, None)
        if inspect.ismethod(value):
            _add_method(source, owner, attribute)
        elif isinstance(value, tuple) and any(isinstance(part, FrictionModel) for part in value):
            source.attributes[attribute] = _add_laws(source, value)
        else:
            source.attributes[attribute] = _write_attribute(owner, attribute, value)
    _add_globals(source, function, tree)


def _add_laws(source: SourceText, laws: Sequence[FrictionModel]) -> str:
    """Add a class for each contained model; return the text of a tuple with an object of each."""
    names = []
    for number, law in enumerate(laws, 1):
        law_source = read_source(law, "terms", "settle", "advance", "advance_midway")
        names.append(f"Law{number}")
        source.take(law_source)
        source.functions[names[-1]] = law_source.as_class(names[-1], "The friction law of some of the joints.")
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
    self_name = tree.args.args[0].arg
    return {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == self_name
    }


def _add_globals(source: SourceText, function: Any, tree: ast.FunctionDef) -> None:
    body = (node for statement in tree.body for node in ast.walk(statement))  # annotations are not evaluated
    for name in dict.fromkeys(node.id for node in body if isinstance(node, ast.Name)):
        if name not in function.__globals__ or name in source.functions or name in source.imports:
            continue
        value = function.__globals__[name]
        if isinstance(value, FunctionType):
            called = inspect.unwrap(value)
            text, called_tree = _read(called)
            if called.__name__ != name:
                raise ExportError(f"{name}: another name of the function {called.__name__}, expected its own; use that")
            source.functions[name] = ""  # placeholder, in case the function calls itself
            _add_globals(source, called, called_tree)
            source.functions[name] = text
        elif isinstance(value, ModuleType) and value in _MODULES:
            source.imports[name] = f"import {_MODULES[value]} as {name}"
        elif not any(value is provided for provided in _PROVIDED):
            source.functions[name] = f"{name} = {_write_attribute(function.__qualname__, name, value)}"


def _write_attribute(owner: Any, name: str, value: Any) -> str:
    """Write a number, a text, or a list of them; of a list of torch modules only its length matters."""
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
