"""Scalar operations on entries: each becomes a number, an existing entry, or a new one."""

import itertools
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from frictionzoo.simulation.fold.expression import OPERATIONS, Expression, as_entries, is_number, is_result_of, rank

_COMMUTATIVE = {"add", "mul", "max", "min", "eq", "ne", "and", "or"}


class Simplifier:
    """Maker of expressions that makes equal ones only once.

    Attributes:
        plain: Simplifier for new expressions of finished ones.
    """

    def __init__(self) -> None:
        self.plain: Simplifier = self
        self._known: dict[tuple[Any, ...], Expression] = {}
        self._made = itertools.count()

    def inputs(self, leaf: int, shape: tuple[int, ...]) -> np.ndarray:
        """Make expressions for the entries of one argument."""
        array = np.empty(shape, object)
        for index in np.ndindex(shape):
            array[index] = self.input((leaf, index))
        return array

    def input(self, place: tuple[Any, ...]) -> Expression:
        """Make an expression for one entry of one argument."""
        return Expression("input", place, next(self._made))

    def finish(self, output: np.ndarray) -> np.ndarray:
        """Return an output's entries in the operations of `OPERATIONS`."""
        return np.asarray(output, object)

    def elementwise(self, name: str, *operands: Any) -> np.ndarray:
        """Apply an operation to arrays of numbers or entries."""
        inputs = [np.asarray(operand) for operand in operands]
        if all(array.dtype != object for array in inputs):
            with np.errstate(all="ignore"):  # branches that a mask discards may divide by 0
                if name == "div" and np.issubdtype(np.result_type(*inputs), np.integer):
                    return np.asarray(np.trunc(np.divide(*inputs)).astype(inputs[0].dtype))
                return np.asarray(OPERATIONS[name][1](*inputs))
        return as_entries(np.frompyfunc(lambda *entries: self.make(name, *entries), len(inputs), 1)(*inputs))

    def make(self, name: str, *entries: Any) -> Any:
        """Return the simplest entry for this operation on entries."""
        entries = tuple(entry if isinstance(entry, Expression) else np.asarray(entry).item() for entry in entries)
        if not any(isinstance(entry, Expression) for entry in entries):
            with np.errstate(all="ignore"):
                return OPERATIONS[name][1](*map(np.asarray, entries)).item()
        simpler = _SIMPLER[name](self, *entries) if name in _SIMPLER else None
        return self.keep(name, entries) if simpler is None else simpler

    def choose(self, which: Any, *entries: Any) -> Any:
        """Return the entry with index `which`; if that is unknown, select one of two, for False and True."""
        if not isinstance(which, Expression):
            return entries[int(which)]
        if entries[0] is entries[1] or rank(entries[0]) == rank(entries[1]):
            return entries[0]
        return self.keep("select", (which, entries[1], entries[0]))

    def keep(self, name: str, entries: tuple[Any, ...]) -> Expression:
        """Return the expression of this operation without simplification."""
        if name in _COMMUTATIVE:
            entries = tuple(sorted(entries, key=rank))
        return self._once((name, *map(rank, entries)), name, entries)

    def _once(self, key: tuple[Any, ...], name: str, arguments: tuple[Any, ...]) -> Expression:
        if key not in self._known:
            self._known[key] = Expression(name, arguments, next(self._made))
        return self._known[key]


# Simpler form of each operation; None if there is none.


def _add(simplifier: Simplifier, a: Any, b: Any) -> Any:
    for one, other in ((a, b), (b, a)):
        if is_number(one, 0.0):
            return other
    for one, other in ((a, b), (b, a)):
        if is_result_of(other, "neg"):
            return simplifier.make("sub", one, other.arguments[0])
    return None


def _sub(simplifier: Simplifier, a: Any, b: Any) -> Any:
    if a is b:
        return 0.0
    if is_number(b, 0.0):
        return a
    if is_number(a, 0.0):
        return simplifier.make("neg", b)
    if is_result_of(b, "neg"):
        return simplifier.make("add", a, b.arguments[0])
    return None


def _mul(simplifier: Simplifier, a: Any, b: Any) -> Any:
    make = simplifier.make
    if isinstance(a, Expression) and not isinstance(b, Expression):
        a, b = b, a
    if not isinstance(a, Expression):
        if a in (0, 1):
            return b if a else 0.0
        if a == -1:
            return make("neg", b)
        if is_result_of(b, "neg"):
            return make("mul", -a, b.arguments[0])
        if _is_scaled(b):
            return make("mul", a * b.arguments[0], b.arguments[1])
        return simplifier.keep("mul", (a, b))
    for one, other in ((a, b), (b, a)):
        if is_result_of(one, "neg"):
            return make("neg", make("mul", one.arguments[0], other))
        if _is_scaled(one):
            return make("mul", one.arguments[0], make("mul", one.arguments[1], other))
    return None


def _is_scaled(entry: Any) -> bool:
    """Return whether an entry is a number times an expression; the number is its first argument."""
    return is_result_of(entry, "mul") and not isinstance(entry.arguments[0], Expression)


def _div(simplifier: Simplifier, a: Any, b: Any) -> Any:
    if not isinstance(b, Expression):
        return simplifier.make("mul", 1 / b, a) if b else None
    return 0.0 if is_number(a, 0.0) else None


def _neg(simplifier: Simplifier, a: Expression) -> Any:
    if a.operation == "neg":
        return a.arguments[0]
    if a.operation == "sub":
        return simplifier.make("sub", a.arguments[1], a.arguments[0])
    if _is_scaled(a):
        return simplifier.make("mul", -a.arguments[0], a.arguments[1])
    return None


def _extreme(neutral: float) -> Callable[[Simplifier, Any, Any], Any]:
    def simpler(_: Simplifier, a: Any, b: Any) -> Any:
        if a is b or is_number(b, neutral):
            return a
        return b if is_number(a, neutral) else None

    return simpler


def _logical(neutral: bool) -> Callable[[Simplifier, Any, Any], Any]:
    def simpler(_: Simplifier, a: Any, b: Any) -> Any:
        for one, other in ((a, b), (b, a)):
            if isinstance(one, bool):
                return other if one is neutral else one
        return None

    return simpler


_SIMPLER: Mapping[str, Callable[..., Any]] = {
    "add": _add,
    "sub": _sub,
    "mul": _mul,
    "div": _div,
    "neg": _neg,
    "max": _extreme(-np.inf),
    "min": _extreme(np.inf),
    "and": _logical(True),
    "or": _logical(False),
}
