"""Specialisation: trace a function, fold its operations one by one, and make a function of the rest."""

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.extend import core as jax_core
from jax.interpreters import partial_eval
from jaxtyping import Array

from frictionzoo.simulation.fold.expression import OPERATIONS, CannotSpecialiseError, Expression, is_number
from frictionzoo.simulation.fold.polynomial import Expander
from frictionzoo.simulation.fold.primitives import PRIMITIVES
from frictionzoo.simulation.fold.simplify import Simplifier

_WORTH_EXPANDING = 700  # largest number of operations for which multiplying out is tried: one or two joints
_WRAPPERS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint"}

Slopes = dict[tuple[Any, ...], Any]
"""Derivatives of an entry that are not 0, by argument and index of the entry they are with respect to."""


class Specialised:
    """Specialised function, called with arrays in the shapes of the examples, of any floating-point type.

    Attributes:
        outputs: Entries of each output.
        order: All expressions, each after its arguments.
        operations: Number of remaining scalar operations.
    """

    def __init__(self, outputs: list[np.ndarray], structure: Any, slopes: Mapping[int, Slopes] | None = None) -> None:
        self.outputs: list[np.ndarray] = outputs
        self._structure = structure
        entries = [entry for output in outputs for entry in output.ravel()]
        self.order: list[Expression] = _sorted_by_dependence(entries)
        self.operations: int = sum(expression.operation != "input" for expression in self.order)
        self._slopes = slopes
        if slopes is not None:
            slope_entries = [slope for entry in entries for slope in slopes.get(id(entry), {}).values()]
            self._with_slopes = _sorted_by_dependence([*entries, *slope_entries])
            self._smooth = jax.custom_jvp(self._value)
            self._smooth.defjvp(self._value_and_tangent)

    def __call__(self, *arguments: Any) -> Any:
        """Return the function's value, in the structure of the traced function."""
        leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(arguments)]
        return self._value(*leaves) if self._slopes is None else self._smooth(*leaves)

    def _value(self, *leaves: Array) -> Any:
        return self._assemble(self._reader(leaves, self.order))

    def _value_and_tangent(self, leaves: tuple[Array, ...], tangents: tuple[Array, ...]) -> tuple[Any, Any]:
        """Return value and tangent; slopes are computed once for all tangents."""
        read, tangent_of = self._reader(leaves, self._with_slopes), {}

        def tangent(entry: Any) -> Any:
            if id(entry) not in tangent_of:
                slopes = (self._slopes or {}).get(id(entry), {})
                terms = [read(slope) * tangents[leaf][index] for (leaf, index), slope in slopes.items()]
                tangent_of[id(entry)] = sum(terms[1:], terms[0]) if terms else read(0.0)
            return tangent_of[id(entry)]

        return self._assemble(read), self._assemble(tangent)

    def _reader(self, leaves: Sequence[Array], order: Sequence[Expression]) -> Callable[[Any], Any]:
        """Return a function from an entry to its value."""
        dtype = jnp.result_type(*leaves) if leaves else jnp.result_type(float)
        value: dict[int, Any] = {}

        def read(entry: Any) -> Any:
            if isinstance(entry, Expression):
                return value[id(entry)]
            return np.asarray(entry, bool if isinstance(entry, (bool, np.bool_)) else dtype)

        for expression in order:
            if expression.operation == "input":
                leaf, index = expression.arguments
                value[id(expression)] = leaves[leaf][index].astype(dtype)
            else:
                value[id(expression)] = OPERATIONS[expression.operation][0](*map(read, expression.arguments))
        return read

    def _assemble(self, read: Callable[[Any], Any]) -> Any:
        outputs = [
            jnp.stack([read(entry) for entry in output.ravel()]).reshape(output.shape) if output.size else output
            for output in self.outputs
        ]
        return jax.tree.unflatten(self._structure, outputs)


def specialise(function: Callable[..., Any], *examples: Any, moving: Sequence[int] = ()) -> Specialised:
    """Trace a function and fold everything that does not depend on its arguments.

    Args:
        function: The function to specialise.
        examples: Its arguments, trees of arrays.
        moving: Numbers of array arguments for which slopes are folded too, so that they are computed once for many
            tangents. There are then no other derivatives: the other arguments count as constants.

    Raises:
        CannotSpecialiseError: The function uses an operation without a rule (a loop, a sort, random numbers).
    """
    with jax.enable_x64(True):
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
        jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
        consts = [np.asarray(const) for const in closed.consts]
        structure = jax.tree.structure(shapes)

        def fold(simplifier: Simplifier) -> Specialised:
            inputs = [simplifier.inputs(place, np.shape(leaf)) for place, leaf in enumerate(jax.tree.leaves(examples))]
            outputs = [simplifier.finish(output) for output in _evaluate(simplifier, jaxpr, consts, inputs)]
            if not moving:
                return Specialised(outputs, structure)
            order = _sorted_by_dependence([entry for output in outputs for entry in output.ravel()])
            places = [len(jax.tree.leaves(examples[:number])) for number in moving]
            return Specialised(outputs, structure, _slopes_of(simplifier.plain, order, places))

        plain = fold(Simplifier())
        if plain.operations > _WORTH_EXPANDING:
            return plain
        expanded = fold(Expander())
    return min(plain, expanded, key=lambda candidate: candidate.operations)


def _slopes_of(simplifier: Simplifier, order: Sequence[Expression], moving: Sequence[int]) -> dict[int, Slopes]:
    """Return the slopes of every expression, by identity, with respect to the entries of the arguments `moving`.

    `order` has each expression after its arguments; `simplifier` made them. CannotSpecialiseError for an operation
    without a rule here.
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


def _sorted_by_dependence(entries: Sequence[Any]) -> list[Expression]:
    """Return every expression that these entries need, each after its arguments."""
    order: list[Expression] = []
    visited: set[int] = set()
    for root in entries:
        stack = [(root, False)]
        while stack:
            entry, ready = stack.pop()
            if not isinstance(entry, Expression) or (id(entry) in visited and not ready):
                continue
            if ready:
                order.append(entry)
                continue
            visited.add(id(entry))
            stack.append((entry, True))
            if entry.operation != "input":
                stack.extend((argument, False) for argument in entry.arguments)
    return order


def _evaluate(simplifier: Simplifier, jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[np.ndarray]:
    """Evaluate a jaxpr over arrays: of numbers if all are known, else of entries (dtype object)."""
    values: dict[Any, np.ndarray] = dict(zip(jaxpr.constvars, consts, strict=True))
    values |= dict(zip(jaxpr.invars, arguments, strict=True))

    def read(variable: Any) -> np.ndarray:
        return np.asarray(variable.val) if isinstance(variable, jax_core.Literal) else values[variable]

    for equation in jaxpr.eqns:
        outputs = _apply(simplifier, equation, [read(variable) for variable in equation.invars])
        for variable, output in zip(equation.outvars, outputs, strict=True):
            values[variable] = _numbers_if_known(output, variable.aval.dtype)
    return [read(variable) for variable in jaxpr.outvars]


def _apply(simplifier: Simplifier, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
    name, params = equation.primitive.name, equation.params
    if name in _WRAPPERS:
        inner = params.get("jaxpr") or params.get("call_jaxpr") or params.get("fun_jaxpr")
        consts = [np.asarray(const) for const in getattr(inner, "consts", ())]
        return _evaluate(simplifier, getattr(inner, "jaxpr", inner), consts, inputs)
    if name in OPERATIONS:
        return [simplifier.elementwise(name, *inputs)]
    if name in PRIMITIVES:
        return [PRIMITIVES[name](simplifier, inputs, params)]
    if name == "split":
        return list(np.split(inputs[0], np.cumsum(params["sizes"])[:-1], axis=params["axis"]))
    if name == "unstack":  # JAX 0.11 indexes and unpacks arrays with it
        axis = params["axis"]
        return [part.squeeze(axis) for part in np.split(inputs[0], inputs[0].shape[axis], axis)]
    if any(array.dtype == object for array in inputs):
        raise CannotSpecialiseError(name)
    with jax.ensure_compile_time_eval():
        results = equation.primitive.bind(*map(jnp.asarray, inputs), **params)
    return [np.asarray(array) for array in (results if equation.primitive.multiple_results else [results])]


def _numbers_if_known(array: np.ndarray, dtype: Any) -> np.ndarray:
    array = np.asarray(array)
    if array.dtype != object or any(isinstance(entry, Expression) for entry in array.ravel()):
        return array
    return np.array(array.tolist(), dtype).reshape(array.shape)
