"""Entries of folded arrays: numbers where the model fixes them, expressions of the inputs elsewhere."""

from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
from jax import lax


class CannotSpecialiseError(Exception):
    """Function with an operation that has no rule here; the message names it."""


class Expression:
    """One scalar operation on expressions and constants; equal ones are the same object.

    Attributes:
        operation: A key of `OPERATIONS`, `input`, or `polynomial`.
        arguments: Expressions and constants; for `input` the argument and entry; for `polynomial` its terms.
        serial: Order of creation, the sort key of arguments: memory addresses would change rounding from run to run.
    """

    __slots__ = ("arguments", "operation", "serial")

    def __init__(self, operation: str, arguments: tuple[Any, ...], serial: int) -> None:
        self.operation: str = operation
        self.arguments: tuple[Any, ...] = arguments
        self.serial: int = serial


OPERATIONS: Mapping[str, tuple[Callable[..., Any], Callable[..., Any]]] = {
    "add": (lax.add, np.add),
    "sub": (lax.sub, np.subtract),
    "mul": (lax.mul, np.multiply),
    "div": (lax.div, np.divide),
    "max": (lax.max, np.maximum),
    "min": (lax.min, np.minimum),
    "pow": (lax.pow, np.power),
    "rem": (lax.rem, np.fmod),
    "atan2": (lax.atan2, np.arctan2),
    "eq": (lax.eq, np.equal),
    "ne": (lax.ne, np.not_equal),
    "lt": (lax.lt, np.less),
    "le": (lax.le, np.less_equal),
    "gt": (lax.gt, np.greater),
    "ge": (lax.ge, np.greater_equal),
    "and": (lax.bitwise_and, np.bitwise_and),
    "or": (lax.bitwise_or, np.bitwise_or),
    "not": (lax.bitwise_not, np.bitwise_not),
    "select": (lax.select, np.where),
    "neg": (lax.neg, np.negative),
    "abs": (lax.abs, np.abs),
    "sign": (lax.sign, np.sign),
    "floor": (lax.floor, np.floor),
    "sqrt": (lax.sqrt, np.sqrt),
    "rsqrt": (lax.rsqrt, lambda x: 1 / np.sqrt(x)),
    "exp": (lax.exp, np.exp),
    "log": (lax.log, np.log),
    "log1p": (lax.log1p, np.log1p),
    "sin": (lax.sin, np.sin),
    "cos": (lax.cos, np.cos),
    "tan": (lax.tan, np.tan),
    "asin": (lax.asin, np.arcsin),
    "acos": (lax.acos, np.arccos),
    "tanh": (lax.tanh, np.tanh),
    "logistic": (lax.logistic, lambda x: 1 / (1 + np.exp(-x))),
    "is_finite": (lax.is_finite, np.isfinite),
}
"""JAX and numpy function of each operation of an expression."""


def rank(entry: Any) -> tuple[Any, ...]:
    """Return a key that distinguishes and sorts entries, constants first."""
    return (1, entry.serial, "") if isinstance(entry, Expression) else (0, entry, type(entry).__name__)


def is_number(entry: Any, number: float) -> bool:
    """Return whether an entry is this number."""
    return not isinstance(entry, Expression) and entry == number


def is_result_of(entry: Any, operation: str) -> bool:
    """Return whether an entry is an expression of this operation."""
    return isinstance(entry, Expression) and entry.operation == operation


def as_entries(array: Any) -> np.ndarray:
    """Convert an array to one of any entries (dtype object)."""
    entries = np.empty(np.shape(array), object)
    entries[...] = array
    return entries
