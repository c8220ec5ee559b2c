"""Expansion of sums of products, so that terms cancel, and their return to few operations."""

from collections import Counter
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from frictionzoo.simulation.fold.expression import Expression
from frictionzoo.simulation.fold.simplify import Simplifier

_MOST_TERMS = 64
_ROUNDING = 1e-14

Monomial = tuple[tuple[Expression, int], ...]
"""Factors with their powers, sorted by serial."""


class Expander(Simplifier):
    """Simplifier that multiplies sums out: rotations are polynomials in sines and cosines of half angles.

    cos^2 becomes 1 - sin^2, which makes the polynomials canonical. A product with too many terms stays a product.
    """

    def __init__(self) -> None:
        super().__init__()
        self.plain = Simplifier()  # separate, so that its products stay apart from the expanded ones
        self._lowered: dict[int, Any] = {}

    def make(self, name: str, *entries: Any) -> Any:
        """See `Simplifier.make`."""
        if name not in ("add", "sub", "mul", "neg") or not any(isinstance(entry, Expression) for entry in entries):
            return super().make(name, *entries)
        first, *others = map(_terms, entries)
        if name == "neg":
            return self._gather([(-coefficient, monomial) for monomial, coefficient in first.items()])
        (second,) = others
        if name == "mul":
            small = len(first) * len(second) <= _MOST_TERMS
            return self._gather(self._products(first, second)) if small else self.keep(name, entries)
        if len(first) + len(second) > _MOST_TERMS:
            return self.keep(name, entries)
        sign = 1.0 if name == "add" else -1.0
        signed = [(sign * coefficient, monomial) for monomial, coefficient in second.items()]
        return self._gather([*((coefficient, monomial) for monomial, coefficient in first.items()), *signed])

    def finish(self, output: np.ndarray) -> np.ndarray:
        """See `Simplifier.finish`."""
        finished = np.empty(output.shape, object)
        for index, entry in np.ndenumerate(output):
            finished[index] = self._lower(entry)
        return finished

    def _lower(self, entry: Any) -> Any:
        if not isinstance(entry, Expression):
            return entry
        if entry.serial not in self._lowered:
            if entry.operation == "input":
                lowered = self.plain.input(entry.arguments)
            elif entry.operation == "polynomial":
                lowered = self._nest(dict(entry.arguments))
            else:
                lowered = self.plain.make(entry.operation, *map(self._lower, entry.arguments))
            self._lowered[entry.serial] = lowered
        return self._lowered[entry.serial]

    def _nest(self, terms: Mapping[Monomial, float]) -> Any:
        """Write a polynomial by Horner's rule: factor out the most frequent factor, recursively."""
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
        product = self.plain.make("mul", self._lower(factor), self._nest(inside))
        return self.plain.make("add", product, self._nest(outside)) if outside else product

    def _products(self, left: Mapping[Monomial, float], right: Mapping[Monomial, float]) -> list:
        return [
            (sign * a * b, monomial)
            for one, a in left.items()
            for other, b in right.items()
            for sign, monomial in self._reduce(Counter(dict(one)) + Counter(dict(other)))
        ]

    def _reduce(self, powers: Mapping[Expression, int]) -> list[tuple[float, Monomial]]:
        """Return a monomial without squares of cosines, as terms."""
        for factor, power in powers.items():
            if factor.operation == "cos" and power >= 2:
                sine = self.keep("sin", factor.arguments)
                rest = Counter(powers) - Counter({factor: 2})
                squared = self._reduce(rest + Counter({sine: 2}))
                return [*self._reduce(rest), *((-coefficient, monomial) for coefficient, monomial in squared)]
        return [(1.0, tuple(sorted(powers.items(), key=lambda item: item[0].serial)))]

    def _gather(self, terms: Sequence[tuple[float, Monomial]]) -> Any:
        """Return the sum of terms as the simplest entry; rounding after a cancellation counts as 0."""
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
        return self._once(key, "polynomial", tuple(ordered))


def _terms(entry: Any) -> Mapping[Monomial, float]:
    if not isinstance(entry, Expression):
        return {(): float(entry)}
    return dict(entry.arguments) if entry.operation == "polynomial" else {((entry, 1),): 1.0}
