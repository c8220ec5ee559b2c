"""Partial evaluation: a JAX function of a few numbers to the flat list of scalar operations that it comes down to.

MJX computes with arrays over bodies, joints and coordinates, and most of their entries are fixed by the model. Here the
function is traced once, and its operations are carried out on arrays of expressions instead of numbers: what the model
fixes becomes a constant, equal expressions become one, and what is left runs elementwise over any batch.
"""

import itertools
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax import lax
from jax.extend import core as jax_core
from jax.interpreters import partial_eval


class CannotSpecialiseError(Exception):
    """The function uses an operation that has no rule here; the message names it."""


class Expression:
    """One scalar operation on expressions and constants; equal ones are the same object.

    Attributes:
        operation: A key of `_EMITTED`, `input`, or `polynomial`.
        arguments: Expressions and constants; for `input` which argument and entry; for `polynomial` its terms.
        serial: Position in the order in which expressions were made. It orders arguments, and not their place in
            memory, because another order rounds otherwise and runs could not be repeated bit by bit.
    """

    __slots__ = ("arguments", "operation", "serial")

    def __init__(self, operation: str, arguments: tuple[Any, ...], serial: int) -> None:
        self.operation = operation
        self.arguments = arguments
        self.serial = serial


class Specialised:
    """A function that was specialised; call it with arrays of the shapes of the examples, of any floating-point type.

    Attributes:
        operations: Number of scalar operations that are left.
    """

    def __init__(self, outputs: list[np.ndarray], structure: Any) -> None:
        self._outputs = outputs
        self._structure = structure
        self._order = _sorted_by_dependence([entry for output in outputs for entry in output.ravel()])
        self.operations = sum(expression.operation != "input" for expression in self._order)

    def __call__(self, *arguments: Any) -> Any:
        """The function's value, with the structure that it returned when it was traced."""
        leaves = [jnp.asarray(leaf) for leaf in jax.tree.leaves(arguments)]
        dtype = jnp.result_type(float) if not leaves else jnp.result_type(*leaves)
        value: dict[int, Any] = {}

        def read(entry: Any) -> Any:
            if isinstance(entry, Expression):
                return value[id(entry)]
            return np.asarray(entry, bool if isinstance(entry, (bool, np.bool_)) else dtype)

        for expression in self._order:
            if expression.operation == "input":
                leaf, index = expression.arguments
                value[id(expression)] = leaves[leaf][index].astype(dtype)
            else:
                value[id(expression)] = _EMITTED[expression.operation](*map(read, expression.arguments))
        outputs = [
            jnp.stack([read(entry) for entry in output.ravel()]).reshape(output.shape) if output.size else output
            for output in self._outputs
        ]
        return jax.tree.unflatten(self._structure, outputs)


def specialise(function: Callable[..., Any], *examples: Any) -> Specialised:
    """Trace a function and fold everything that does not depend on its arguments.

    Args:
        function: Pure, from pytrees of arrays to a pytree of arrays.
        examples: Arguments whose shapes are taken.

    Raises:
        CannotSpecialiseError: The function uses an operation without a rule (a loop, a sort, random numbers).
    """
    with jax.enable_x64(True):
        closed, shapes = jax.make_jaxpr(function, return_shape=True)(*examples)
        jaxpr, _ = partial_eval.dce_jaxpr(closed.jaxpr, [True] * len(closed.jaxpr.outvars), instantiate=True)
        consts = [np.asarray(const) for const in closed.consts]
        structure = jax.tree.structure(shapes)

        def fold(folder: _Folder) -> Specialised:
            inputs = [folder.inputs(place, np.shape(leaf)) for place, leaf in enumerate(jax.tree.leaves(examples))]
            outputs = folder.evaluate(jaxpr, consts, inputs)
            return Specialised([folder.finish(output) for output in outputs], structure)

        plain = fold(_Folder())
        if plain.operations > _WORTH_EXPANDING:
            return plain
        expanded = fold(_Expander())
    return min(plain, expanded, key=lambda found: found.operations)


def _sorted_by_dependence(entries: Sequence[Any]) -> list[Expression]:
    """Every expression that these need, each after what it needs itself."""
    order: list[Expression] = []
    seen: set[int] = set()
    for root in entries:
        stack = [(root, False)]
        while stack:
            entry, ready = stack.pop()
            if not isinstance(entry, Expression) or (id(entry) in seen and not ready):
                continue
            if ready:
                order.append(entry)
                continue
            seen.add(id(entry))
            stack.append((entry, True))
            if entry.operation != "input":
                stack.extend((argument, False) for argument in entry.arguments)
    return order


_EMITTED: Mapping[str, Callable[..., Any]] = {
    "add": lax.add,
    "sub": lax.sub,
    "mul": lax.mul,
    "div": lax.div,
    "max": lax.max,
    "min": lax.min,
    "pow": lax.pow,
    "rem": lax.rem,
    "atan2": lax.atan2,
    "eq": lax.eq,
    "ne": lax.ne,
    "lt": lax.lt,
    "le": lax.le,
    "gt": lax.gt,
    "ge": lax.ge,
    "and": lax.bitwise_and,
    "or": lax.bitwise_or,
    "not": lax.bitwise_not,
    "select": lax.select,
    "neg": lax.neg,
    "abs": lax.abs,
    "sign": lax.sign,
    "floor": lax.floor,
    "sqrt": lax.sqrt,
    "rsqrt": lax.rsqrt,
    "exp": lax.exp,
    "log": lax.log,
    "sin": lax.sin,
    "cos": lax.cos,
    "tan": lax.tan,
    "asin": lax.asin,
    "acos": lax.acos,
    "tanh": lax.tanh,
    "logistic": lax.logistic,
    "is_finite": lax.is_finite,
}
"""What each operation of an expression becomes."""

_NUMERIC: Mapping[str, Callable[..., Any]] = {
    "add": np.add,
    "sub": np.subtract,
    "mul": np.multiply,
    "div": np.divide,
    "max": np.maximum,
    "min": np.minimum,
    "pow": np.power,
    "rem": np.fmod,
    "atan2": np.arctan2,
    "eq": np.equal,
    "ne": np.not_equal,
    "lt": np.less,
    "le": np.less_equal,
    "gt": np.greater,
    "ge": np.greater_equal,
    "and": np.bitwise_and,
    "or": np.bitwise_or,
    "not": np.bitwise_not,
    "neg": np.negative,
    "abs": np.abs,
    "sign": np.sign,
    "floor": np.floor,
    "sqrt": np.sqrt,
    "rsqrt": lambda x: 1 / np.sqrt(x),
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tan": np.tan,
    "asin": np.arcsin,
    "acos": np.arccos,
    "tanh": np.tanh,
    "logistic": lambda x: 1 / (1 + np.exp(-x)),
    "is_finite": np.isfinite,
}
"""The same on numbers."""

_COMMUTATIVE = {"add", "mul", "max", "min", "eq", "ne", "and", "or"}
_WORTH_EXPANDING = 700
"""Operations up to which it is tried whether multiplying out leaves fewer: one joint or two."""
_MOST_TERMS = 64
_ROUNDING = 1e-14
_WRAPPERS = {"jit", "pjit", "closed_call", "core_call", "custom_jvp_call", "custom_vjp_call", "remat", "checkpoint"}


class _Folder:
    """Evaluates a jaxpr over numpy arrays: of numbers where all is known, of expressions (dtype object) elsewhere."""

    def __init__(self) -> None:
        self._known: dict[tuple, Expression] = {}
        self._made = itertools.count()

    def finish(self, output: np.ndarray) -> np.ndarray:
        """An output's entries in the operations of `_EMITTED`."""
        return np.asarray(output, object)

    def inputs(self, leaf: int, shape: tuple[int, ...]) -> np.ndarray:
        """Expressions for the entries of one argument."""
        array = np.empty(shape, object)
        for index in np.ndindex(shape):
            array[index] = Expression("input", (leaf, index), next(self._made))
        return array

    def evaluate(self, jaxpr: Any, consts: Sequence[Any], arguments: Sequence[Any]) -> list[np.ndarray]:
        """The jaxpr's outputs."""
        values: dict[Any, np.ndarray] = dict(zip(jaxpr.constvars, consts, strict=True))
        values |= dict(zip(jaxpr.invars, arguments, strict=True))

        def read(variable: Any) -> np.ndarray:
            return np.asarray(variable.val) if isinstance(variable, jax_core.Literal) else values[variable]

        for equation in jaxpr.eqns:
            outputs = self._apply(equation, [read(variable) for variable in equation.invars])
            for variable, output in zip(equation.outvars, outputs, strict=True):
                values[variable] = _numbers_if_known(output, variable.aval.dtype)
        return [read(variable) for variable in jaxpr.outvars]

    def _apply(self, equation: Any, inputs: list[np.ndarray]) -> list[np.ndarray]:
        name, params = equation.primitive.name, equation.params
        if name in _WRAPPERS:
            inner = params.get("jaxpr") or params.get("call_jaxpr") or params.get("fun_jaxpr")
            consts = [np.asarray(const) for const in getattr(inner, "consts", ())]
            return self.evaluate(getattr(inner, "jaxpr", inner), consts, inputs)
        if name in _NUMERIC:
            return [self._elementwise(name, *inputs)]
        if name in _RULES:
            return [_RULES[name](self, inputs, params)]
        if name == "split":
            borders = np.cumsum(params["sizes"])[:-1]
            return list(np.split(inputs[0], borders, axis=params["axis"]))
        if any(array.dtype == object for array in inputs):
            raise CannotSpecialiseError(name)
        with jax.ensure_compile_time_eval():
            known = equation.primitive.bind(*map(jnp.asarray, inputs), **params)
        return [np.asarray(array) for array in (known if equation.primitive.multiple_results else [known])]

    def _elementwise(self, name: str, *operands: Any) -> np.ndarray:
        inputs = [np.asarray(operand) for operand in operands]
        if all(array.dtype != object for array in inputs):
            with np.errstate(all="ignore"):  # branches that a mask leaves out may divide by 0
                if name == "div" and np.issubdtype(np.result_type(*inputs), np.integer):
                    return np.asarray(np.trunc(np.divide(*inputs)).astype(inputs[0].dtype))
                return np.asarray(_NUMERIC[name](*inputs))
        return _as_object(np.frompyfunc(lambda *entries: self.make(name, *entries), len(inputs), 1)(*inputs))

    def make(self, name: str, *entries: Any) -> Any:
        """The simplest entry that this operation on entries comes down to."""
        entries = tuple(entry if isinstance(entry, Expression) else np.asarray(entry).item() for entry in entries)
        if not any(isinstance(entry, Expression) for entry in entries):
            with np.errstate(all="ignore"):
                return _NUMERIC[name](*map(np.asarray, entries)).item()
        simpler = _SIMPLER.get(name)
        found = simpler(self, *entries) if simpler else None
        return self._intern(name, entries) if found is None else found

    def _intern(self, name: str, entries: tuple[Any, ...]) -> Expression:
        if name in _COMMUTATIVE:
            entries = tuple(sorted(entries, key=_rank))
        key = (name, *map(_rank, entries))
        if key not in self._known:
            self._known[key] = Expression(name, entries, next(self._made))
        return self._known[key]

    # Simplifications: None where there is none.

    def _add(self, a: Any, b: Any) -> Any:
        if _is(a, 0):
            return b
        if _is(b, 0):
            return a
        if _has(b, "neg"):
            return self.make("sub", a, b.arguments[0])
        if _has(a, "neg"):
            return self.make("sub", b, a.arguments[0])
        return None

    def _sub(self, a: Any, b: Any) -> Any:
        if a is b:
            return 0.0
        if _is(b, 0):
            return a
        if _is(a, 0):
            return self.make("neg", b)
        if _has(b, "neg"):
            return self.make("add", a, b.arguments[0])
        return None

    def _mul(self, a: Any, b: Any) -> Any:
        if isinstance(a, Expression) and not isinstance(b, Expression):
            a, b = b, a
        if not isinstance(a, Expression):
            if a == 0:
                return 0.0
            if a == 1:
                return b
            if a == -1:
                return self.make("neg", b)
            if _has(b, "neg"):
                return self.make("mul", -a, b.arguments[0])
            if _has(b, "mul") and not isinstance(b.arguments[0], Expression):
                return self.make("mul", a * b.arguments[0], b.arguments[1])
            return self._intern("mul", (a, b))
        for one, other in ((a, b), (b, a)):
            if _has(one, "neg"):
                return self.make("neg", self.make("mul", one.arguments[0], other))
            if _has(one, "mul") and not isinstance(one.arguments[0], Expression):
                return self.make("mul", one.arguments[0], self.make("mul", one.arguments[1], other))
        return None

    def _div(self, a: Any, b: Any) -> Any:
        if not isinstance(b, Expression):
            return self.make("mul", 1 / b, a) if b else None
        if _is(a, 0):
            return 0.0
        return None

    def _neg(self, a: Any) -> Any:
        if a.operation == "neg":
            return a.arguments[0]
        if a.operation == "sub":
            return self.make("sub", a.arguments[1], a.arguments[0])
        if a.operation == "mul" and not isinstance(a.arguments[0], Expression):
            return self.make("mul", -a.arguments[0], a.arguments[1])
        return None

    def _max(self, a: Any, b: Any) -> Any:
        return _other_of(a, b, -np.inf)

    def _min(self, a: Any, b: Any) -> Any:
        return _other_of(a, b, np.inf)

    def _and(self, a: Any, b: Any) -> Any:
        for one, other in ((a, b), (b, a)):
            if isinstance(one, bool):
                return other if one else False
        return None

    def _or(self, a: Any, b: Any) -> Any:
        for one, other in ((a, b), (b, a)):
            if isinstance(one, bool):
                return True if one else other
        return None

    # Operations on whole arrays.

    def select(self, predicate: np.ndarray, cases: Sequence[np.ndarray]) -> np.ndarray:
        """Entries of the case that the predicate counts out; for False and True where it is not known."""

        def choose(which: Any, *entries: Any) -> Any:
            if not isinstance(which, Expression):
                return entries[int(which)]
            if entries[0] is entries[1] or _rank(entries[0]) == _rank(entries[1]):
                return entries[0]
            return self._intern("select", (which, entries[1], entries[0]))

        return _as_object(np.frompyfunc(choose, 1 + len(cases), 1)(predicate, *cases))

    def reduce(self, name: str, array: np.ndarray, axes: Sequence[Any], start: Any) -> np.ndarray:
        """A reduction over axes by a binary operation."""
        kept = [size for axis, size in enumerate(array.shape) if axis not in axes]
        count = int(np.prod([array.shape[axis] for axis in axes]))
        rows = np.moveaxis(array, axes, range(len(axes))).reshape(count, *kept)
        total = np.full(rows.shape[1:], start)
        for row in rows:
            total = self._elementwise(name, total, row)
        return total

    def cumulate(self, name: str, array: np.ndarray, axis: int, reverse: bool) -> np.ndarray:
        """A running reduction along an axis."""
        rows = list(np.moveaxis(array, axis, 0))
        rows = rows[::-1] if reverse else rows
        for position in range(1, len(rows)):
            rows[position] = self._elementwise(name, rows[position - 1], rows[position])
        return np.moveaxis(np.stack(rows[::-1] if reverse else rows), 0, axis)

    def contract(self, left: np.ndarray, right: np.ndarray, dimension_numbers: Any) -> np.ndarray:
        """XLA's dot_general."""
        (left_sum, right_sum), (left_batch, right_batch) = dimension_numbers

        def arrange(array: np.ndarray, batch: Sequence[Any], summed: Sequence[Any], last: bool) -> np.ndarray:
            free = [axis for axis in range(array.ndim) if axis not in (*batch, *summed)]
            sizes = [int(np.prod([array.shape[axis] for axis in axes])) for axes in (batch, free, summed)]
            ordered = array.transpose(*batch, *free, *summed).reshape(sizes)
            return ordered if last else ordered.transpose(0, 2, 1)

        rows, columns = arrange(left, left_batch, left_sum, True), arrange(right, right_batch, right_sum, False)
        terms = self._elementwise("mul", rows[:, :, :, None], columns[:, None, :, :])
        free = [
            [array.shape[axis] for axis in range(array.ndim) if axis not in (*batch, *summed)]
            for array, batch, summed in ((left, left_batch, left_sum), (right, right_batch, right_sum))
        ]
        batch_shape = [left.shape[axis] for axis in left_batch]
        return self.reduce("add", terms, (2,), 0.0).reshape(*batch_shape, *free[0], *free[1])

    def power(self, base: np.ndarray, exponent: int) -> np.ndarray:
        """An integer power by multiplication."""
        product = base
        for _ in range(abs(exponent) - 1):
            product = self._elementwise("mul", product, base)
        return product if exponent > 0 else self._elementwise("div", np.asarray(1.0), product)


_SIMPLER: Mapping[str, Callable[..., Any]] = {
    "add": _Folder._add,
    "sub": _Folder._sub,
    "mul": _Folder._mul,
    "div": _Folder._div,
    "neg": _Folder._neg,
    "max": _Folder._max,
    "min": _Folder._min,
    "and": _Folder._and,
    "or": _Folder._or,
}


Monomial = tuple[tuple[Expression, int], ...]
"""Factors with their powers, in the order of their serials."""


class _Expander(_Folder):
    """Multiplies sums out, so that what cancels does: rotations are polynomials in sines and cosines of half angles.

    cos^2 becomes 1 - sin^2, which makes the polynomials canonical. A product with too many terms stays a product.
    """

    def make(self, name: str, *entries: Any) -> Any:
        """See `_Folder.make`."""
        if name in ("add", "sub", "mul", "neg") and any(isinstance(entry, Expression) for entry in entries):
            first, *others = map(_terms, entries)
            if name == "mul":
                small = len(first) * len(others[0]) <= _MOST_TERMS
                return self._gather(self._products(first, others[0])) if small else self._intern(name, entries)
            if name == "neg":
                return self._gather([(-coefficient, monomial) for monomial, coefficient in first.items()])
            if len(first) + len(others[0]) <= _MOST_TERMS:
                sign = 1.0 if name == "add" else -1.0
                more = [(sign * coefficient, monomial) for monomial, coefficient in others[0].items()]
                return self._gather([*((c, m) for m, c in first.items()), *more])
            return self._intern(name, entries)
        return super().make(name, *entries)

    def finish(self, output: np.ndarray) -> np.ndarray:
        """See `_Folder.finish`; a new folder keeps the products apart from those that were multiplied out."""
        if not hasattr(self, "_plain"):
            self._plain, self._lowered = _Folder(), dict[int, Any]()
        finished = np.empty(output.shape, object)
        for index, entry in np.ndenumerate(output):
            finished[index] = self._lower(entry)
        return finished

    def _lower(self, entry: Any) -> Any:
        if not isinstance(entry, Expression):
            return entry
        if entry.serial not in self._lowered:
            if entry.operation == "input":
                lowered = Expression("input", entry.arguments, next(self._plain._made))
            elif entry.operation == "polynomial":
                lowered = self._nest(dict(entry.arguments))
            else:
                lowered = self._plain.make(entry.operation, *map(self._lower, entry.arguments))
            self._lowered[entry.serial] = lowered
        return self._lowered[entry.serial]

    def _nest(self, terms: Mapping[Monomial, float]) -> Any:
        """A polynomial by Horner's rule: the factor of most terms is taken out of them, and so on."""
        uses = Counter(factor.serial for monomial in terms for factor, _ in monomial)
        if not uses:
            return terms.get((), 0.0)
        serial = min(uses, key=lambda serial: (-uses[serial], serial))
        factor = next(factor for monomial in terms for factor, _ in monomial if factor.serial == serial)
        inside: dict[Monomial, float] = {}
        outside: dict[Monomial, float] = {}
        for monomial, coefficient in terms.items():
            powers = dict(monomial)
            if factor in powers:
                powers[factor] -= 1
                monomial = tuple((other, power) for other, power in powers.items() if power)
                inside[monomial] = coefficient
            else:
                outside[monomial] = coefficient
        product = self._plain.make("mul", self._lower(factor), self._nest(inside))
        return self._plain.make("add", product, self._nest(outside)) if outside else product

    def _products(self, left: Mapping[Monomial, float], right: Mapping[Monomial, float]) -> list:
        return [
            (sign * a * b, monomial)
            for one, a in left.items()
            for other, b in right.items()
            for sign, monomial in self._reduce(Counter(dict(one)) + Counter(dict(other)))
        ]

    def _reduce(self, powers: Mapping[Expression, int]) -> list[tuple[float, Monomial]]:
        """A monomial without squares of cosines, as terms."""
        for factor, power in powers.items():
            if factor.operation == "cos" and power >= 2:
                sine = self._intern("sin", factor.arguments)
                rest = Counter(powers) - Counter({factor: 2})
                squared = self._reduce(rest + Counter({sine: 2}))
                return [*self._reduce(rest), *((-coefficient, monomial) for coefficient, monomial in squared)]
        return [(1.0, tuple(sorted(powers.items(), key=lambda item: item[0].serial)))]

    def _gather(self, terms: Sequence[tuple[float, Monomial]]) -> Any:
        """The sum of terms as the simplest entry; what is left of a cancellation but for rounding is nothing."""
        total: dict[Monomial, float] = {}
        size: dict[Monomial, float] = {}
        for coefficient, monomial in terms:
            total[monomial] = total.get(monomial, 0.0) + coefficient
            size[monomial] = size.get(monomial, 0.0) + abs(coefficient)
        kept = {monomial: c for monomial, c in total.items() if abs(c) > _ROUNDING * size[monomial]}
        if not kept:
            return 0.0
        if list(kept) == [()]:
            return kept[()]
        monomial, coefficient = next(iter(kept.items()))
        if len(kept) == 1 and coefficient == 1 and len(monomial) == 1 and monomial[0][1] == 1:
            return monomial[0][0]
        ordered = sorted(kept.items(), key=lambda term: [(factor.serial, power) for factor, power in term[0]])
        key = ("polynomial", *((tuple((f.serial, p) for f, p in monomial), c) for monomial, c in ordered))
        if key not in self._known:
            self._known[key] = Expression("polynomial", tuple(ordered), next(self._made))
        return self._known[key]


def _terms(entry: Any) -> Mapping[Monomial, float]:
    if not isinstance(entry, Expression):
        return {(): float(entry)}
    return dict(entry.arguments) if entry.operation == "polynomial" else {((entry, 1),): 1.0}


def _is(entry: Any, number: Any) -> bool:
    return not isinstance(entry, Expression) and entry == number


def _has(entry: Any, operation: str) -> bool:
    return isinstance(entry, Expression) and entry.operation == operation


def _rank(entry: Any) -> tuple:
    """A key that tells entries apart and orders them, constants first."""
    return (1, entry.serial, "") if isinstance(entry, Expression) else (0, entry, type(entry).__name__)


def _other_of(a: Any, b: Any, neutral: Any) -> Any:
    if a is b or _is(b, neutral):
        return a
    return b if _is(a, neutral) else None


def _as_object(array: Any) -> np.ndarray:
    found = np.empty(np.shape(array), object)
    found[...] = array
    return found


def _numbers_if_known(array: np.ndarray, dtype: Any) -> np.ndarray:
    """An array of numbers instead of objects where no entry is an expression."""
    array = np.asarray(array)
    if array.dtype != object or any(isinstance(entry, Expression) for entry in array.ravel()):
        return array
    return np.array(array.tolist(), dtype).reshape(array.shape)


def _common(arrays: Sequence[np.ndarray]) -> Sequence[np.ndarray]:
    """The same arrays, all of objects if one of them is."""
    return [_as_object(array) for array in arrays] if any(array.dtype == object for array in arrays) else arrays


def _broadcast(array: np.ndarray, shape: Sequence[Any], dimensions: Sequence[Any]) -> np.ndarray:
    inner = np.ones(len(shape), int)
    inner[list(dimensions)] = array.shape
    return np.broadcast_to(array.reshape(inner), shape)


def _pad(array: np.ndarray, filling: np.ndarray, config: Sequence[Any]) -> np.ndarray:
    if any(low < 0 or high < 0 or inner for low, high, inner in config):
        raise CannotSpecialiseError("pad with negative or inner padding")
    array, filling = _common([array, filling])
    padded = np.full([low + size + high for (low, high, _), size in zip(config, array.shape, strict=True)], filling)
    padded[tuple(slice(low, low + size) for (low, _, _), size in zip(config, array.shape, strict=True))] = array
    return padded


def _dynamic_slice(array: np.ndarray, starts: Sequence[np.ndarray], sizes: Sequence[Any]) -> tuple[slice, ...]:
    if any(start.dtype == object for start in starts):
        raise CannotSpecialiseError("an index that depends on the state")
    first = [
        min(max(int(start), 0), whole - size) for start, whole, size in zip(starts, array.shape, sizes, strict=True)
    ]
    return tuple(slice(start, start + size) for start, size in zip(first, sizes, strict=True))


def _windows(
    shape: Sequence[Any],
    indices: np.ndarray,
    sizes: Sequence[Any],
    window_dims: Sequence[Any],
    collapsed: Sequence[Any],
    index_map: Sequence[Any],
    batching: Sequence[Any],
    indices_batching: Sequence[Any],
    clip: bool,
) -> tuple[tuple[np.ndarray, ...], np.ndarray]:
    """For XLA's gather and scatter: the operand's index of each entry of the windows, one array a dimension.

    Besides, whether that entry's window lies inside the operand.
    """
    if indices.dtype == object:
        raise CannotSpecialiseError("an index that depends on the state")
    places = indices.shape[:-1]
    kept = [dim for dim in range(len(shape)) if dim not in (*collapsed, *batching)]
    rank = len(places) + len(kept)
    place_dims = [dim for dim in range(rank) if dim not in window_dims]
    inside = np.ones(places, bool)
    found = []
    for dim, whole in enumerate(shape):
        start = np.zeros(places, int)
        if dim in index_map:
            start = indices[..., list(index_map).index(dim)].astype(int)
        elif dim in batching:
            along = indices_batching[list(batching).index(dim)]
            start = np.broadcast_to(
                np.expand_dims(np.arange(whole), [d for d in range(len(places)) if d != along]), places
            )
        if clip:
            start = np.clip(start, 0, whole - sizes[dim])
        inside = inside & (start >= 0) & (start + sizes[dim] <= whole)
        index = np.zeros([1] * rank, int) + _broadcast(np.asarray(start), _embed(rank, place_dims, places), place_dims)
        if dim in kept:
            along = window_dims[kept.index(dim)]
            index = index + _broadcast(np.arange(sizes[dim]), _embed(rank, [along], [sizes[dim]]), [along])
        found.append(index)
    inside = _broadcast(np.asarray(inside), _embed(rank, place_dims, places), place_dims)
    *found, inside = np.broadcast_arrays(*found, inside)
    return tuple(found), inside


def _embed(rank: int, dims: Sequence[Any], sizes: Sequence[Any]) -> list[int]:
    shape = [1] * rank
    for dim, size in zip(dims, sizes, strict=True):
        shape[dim] = size
    return shape


def _gather(array: np.ndarray, indices: np.ndarray, params: Mapping[str, Any]) -> np.ndarray:
    numbers = params["dimension_numbers"]
    clip = params["mode"] != lax.GatherScatterMode.FILL_OR_DROP
    places, inside = _windows(
        array.shape,
        indices,
        params["slice_sizes"],
        numbers.offset_dims,
        numbers.collapsed_slice_dims,
        numbers.start_index_map,
        numbers.operand_batching_dims,
        numbers.start_indices_batching_dims,
        clip,
    )
    if not inside.all():
        raise CannotSpecialiseError("an index out of bounds")
    return array[places]


def _scatter(folder: _Folder, inputs: Sequence[np.ndarray], params: Mapping[str, Any], add: bool) -> np.ndarray:
    array, indices, updates = inputs
    numbers = params["dimension_numbers"]
    kept = [d for d in range(array.ndim) if d not in (*numbers.inserted_window_dims, *numbers.operand_batching_dims)]
    sizes = [1] * array.ndim
    for dim, along in zip(kept, numbers.update_window_dims, strict=True):
        sizes[dim] = updates.shape[along]
    places, inside = _windows(
        array.shape,
        indices,
        sizes,
        numbers.update_window_dims,
        numbers.inserted_window_dims,
        numbers.scatter_dims_to_operand_dims,
        numbers.operand_batching_dims,
        numbers.scatter_indices_batching_dims,
        clip=False,
    )
    array, updates = _common([array, updates])
    written = array.copy()
    for entry in np.argwhere(inside):  # XLA drops what lies outside
        entry = tuple(entry)
        place = tuple(int(index[entry]) for index in places)
        written[place] = folder.make("add", written[place], updates[entry]) if add else updates[entry]
    return written


def _update_slice(inputs: Sequence[np.ndarray]) -> np.ndarray:
    array, update, *starts = inputs
    array, update = _common([array, update])
    written = array.copy()
    written[_dynamic_slice(array, starts, update.shape)] = update
    return written


_RULES: Mapping[str, Callable[[_Folder, list[np.ndarray], Mapping[str, Any]], np.ndarray]] = {
    "square": lambda folder, x, _: folder.power(x[0], 2),
    "integer_pow": lambda folder, x, p: folder.power(x[0], p["y"]) if p["y"] else np.ones(x[0].shape),
    "convert_element_type": lambda _, x, p: x[0] if x[0].dtype == object else x[0].astype(p["new_dtype"]),
    "stop_gradient": lambda _, x, __: x[0],
    "copy": lambda _, x, __: x[0],
    "copy_p": lambda _, x, __: x[0],
    "select_n": lambda folder, x, _: folder.select(x[0], x[1:]),
    "clamp": lambda folder, x, _: folder._elementwise("min", folder._elementwise("max", x[1], x[0]), x[2]),
    "broadcast_in_dim": lambda _, x, p: _broadcast(x[0], p["shape"], p["broadcast_dimensions"]),
    "reshape": lambda _, x, p: x[0].reshape(p["new_sizes"]),
    "squeeze": lambda _, x, p: np.squeeze(x[0], tuple(p["dimensions"])),
    "expand_dims": lambda _, x, p: np.expand_dims(x[0], tuple(p["dimensions"])),
    "transpose": lambda _, x, p: x[0].transpose(p["permutation"]),
    "rev": lambda _, x, p: np.flip(x[0], p["dimensions"]),
    "iota": lambda _, __, p: np.broadcast_to(
        np.expand_dims(
            np.arange(p["shape"][p["dimension"]]), [d for d in range(len(p["shape"])) if d != p["dimension"]]
        ),
        p["shape"],
    ).astype(p["dtype"]),
    "concatenate": lambda _, x, p: np.concatenate(_common(x), p["dimension"]),
    "stack": lambda _, x, p: np.stack(_common(x), p["axis"]),
    "tile": lambda _, x, p: np.tile(x[0], p["reps"]),
    "pad": lambda _, x, p: _pad(x[0], x[1], p["padding_config"]),
    "slice": lambda _, x, p: x[0][
        tuple(
            slice(start, stop, step)
            for start, stop, step in zip(
                p["start_indices"], p["limit_indices"], p["strides"] or [1] * x[0].ndim, strict=True
            )
        )
    ],
    "dynamic_slice": lambda _, x, p: x[0][_dynamic_slice(x[0], x[1:], p["slice_sizes"])],
    "dynamic_update_slice": lambda _, x, __: _update_slice(x),
    "gather": lambda _, x, p: _gather(x[0], x[1], p),
    "scatter": lambda folder, x, p: _scatter(folder, x, p, add=False),
    "scatter-add": lambda folder, x, p: _scatter(folder, x, p, add=True),
    "scatter_add": lambda folder, x, p: _scatter(folder, x, p, add=True),
    "dot_general": lambda folder, x, p: folder.contract(x[0], x[1], p["dimension_numbers"]),
    "reduce_sum": lambda folder, x, p: folder.reduce("add", x[0], p["axes"], 0.0),
    "reduce_max": lambda folder, x, p: folder.reduce("max", x[0], p["axes"], -np.inf),
    "reduce_min": lambda folder, x, p: folder.reduce("min", x[0], p["axes"], np.inf),
    "reduce_and": lambda folder, x, p: folder.reduce("and", x[0], p["axes"], True),
    "reduce_or": lambda folder, x, p: folder.reduce("or", x[0], p["axes"], False),
    "cumsum": lambda folder, x, p: folder.cumulate("add", x[0], p["axis"], p["reverse"]),
}
"""Operations on whole arrays: (folder, inputs, params) to the output."""
