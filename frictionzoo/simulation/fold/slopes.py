"""Derivatives of folded expressions, entry by entry, without those that are 0."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from frictionzoo.simulation.fold.expression import CannotSpecialiseError, Expression, is_number
from frictionzoo.simulation.fold.simplify import Simplifier

Slopes = dict[tuple[Any, ...], Any]
"""Derivatives of an entry that are not 0, by argument and index of the entry they are with respect to."""


def slopes_of(simplifier: Simplifier, order: Sequence[Expression], moving: Sequence[int]) -> dict[int, Slopes]:
    """Return the slopes of every expression, by identity, with respect to the entries of the arguments `moving`.

    `order` has each expression after its arguments; `simplifier` made them.

    Raises:
        CannotSpecialiseError: An operation that depends on these arguments has no rule here.
    """
    by_expression: dict[int, Slopes] = {}
    for expression in order:
        if expression.operation == "input":
            by_expression[id(expression)] = {expression.arguments: 1.0} if expression.arguments[0] in moving else {}
            continue
        inner = [by_expression[id(entry)] if isinstance(entry, Expression) else {} for entry in expression.arguments]
        slopes: Slopes = {}
        if any(inner):
            if expression.operation not in _RULES:
                raise CannotSpecialiseError(f"a derivative of {expression.operation}")
            factors = _RULES[expression.operation](simplifier.make, expression.arguments)
            for factor, argument_slopes in zip(factors, inner, strict=True):
                for place, slope in argument_slopes.items():
                    term = simplifier.make("mul", factor, slope)
                    slopes[place] = simplifier.make("add", slopes[place], term) if place in slopes else term
        by_expression[id(expression)] = {place: slope for place, slope in slopes.items() if not is_number(slope, 0.0)}
    return by_expression


_RULES: Mapping[str, Callable[[Callable[..., Any], Sequence[Any]], Sequence[Any]]] = {
    "add": lambda make, x: (1.0, 1.0),
    "sub": lambda make, x: (1.0, -1.0),
    "mul": lambda make, x: (x[1], x[0]),
    "neg": lambda make, x: (-1.0,),
    "sin": lambda make, x: (make("cos", x[0]),),
    "cos": lambda make, x: (make("neg", make("sin", x[0])),),
}
"""Derivative of an operation with respect to each of its arguments."""
