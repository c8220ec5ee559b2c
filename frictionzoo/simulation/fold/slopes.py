"""Derivatives of folded expressions, entry by entry, without those that are 0."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

from frictionzoo.simulation.fold.expression import CannotSpecialiseError, Expression, is_number
from frictionzoo.simulation.fold.simplify import Simplifier

Slopes = dict[tuple[Any, ...], Any]
"""Derivative of an entry with respect to entries of arguments, by argument and index, without those that are 0."""


def slopes_of(simplifier: Simplifier, order: Sequence[Expression], moving: Sequence[int]) -> dict[int, Slopes]:
    """Return the slopes of every expression, by its identity, with respect to the entries of some arguments.

    Args:
        simplifier: Simplifier that made the expressions.
        order: Expressions, each after its arguments.
        moving: Numbers of the arguments.

    Raises:
        CannotSpecialiseError: An operation that depends on these arguments has no rule here.
    """
    found: dict[int, Slopes] = {}
    for expression in order:
        if expression.operation == "input":
            found[id(expression)] = {expression.arguments: 1.0} if expression.arguments[0] in moving else {}
            continue
        inner = [found[id(entry)] if isinstance(entry, Expression) else {} for entry in expression.arguments]
        slopes: Slopes = {}
        if any(inner):
            if expression.operation not in _RULES:
                raise CannotSpecialiseError(f"a derivative of {expression.operation}")
            factors = _RULES[expression.operation](simplifier.make, expression.arguments)
            for factor, own in zip(factors, inner, strict=True):
                for place, slope in own.items():
                    term = simplifier.make("mul", factor, slope)
                    slopes[place] = simplifier.make("add", slopes[place], term) if place in slopes else term
        found[id(expression)] = {place: slope for place, slope in slopes.items() if not is_number(slope, 0.0)}
    return found


_RULES: Mapping[str, Callable[[Callable[..., Any], Sequence[Any]], Sequence[Any]]] = {
    "add": lambda make, x: (1.0, 1.0),
    "sub": lambda make, x: (1.0, -1.0),
    "mul": lambda make, x: (x[1], x[0]),
    "neg": lambda make, x: (-1.0,),
    "sin": lambda make, x: (make("cos", x[0]),),
    "cos": lambda make, x: (make("neg", make("sin", x[0])),),
}
"""Derivative of an operation with respect to each of its arguments."""
