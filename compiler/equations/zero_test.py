"""Whether a symbolic expression is zero: for all values of its symbols, or with the scene's numbers.

Takes: SymPy expressions. Gives: `ZeroTest`, `Vanishing`, `NOTHING_VANISHES`.
Guarantees: an expression that is zero is found to be; one that is not is taken for zero with a probability
below its degree/2⁶¹; the same expressions give the same answers.
Does not: simplify or expand anything.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence, Set
from fractions import Fraction
from math import prod

import sympy


class ZeroTest:
    """Says whether a rational expression is zero for all values of its symbols.

    Each symbol, and each function value, gets a random residue modulo the prime 2⁶¹ − 1; an expression that
    isn't zero vanishes there with probability below its degree/2⁶¹ (Schwartz 1980, Zippel 1979). Expansion
    would decide the same at a cost that grows with the number of terms. The generator is seeded.

    With `nonzero`, all other symbols are taken as zero: whether an expression is zero then. With `values`,
    these symbols have their values: whether it is zero for all values of the others.
    """

    _PRIME = 2**61 - 1

    def __init__(
        self,
        nonzero: Set[sympy.Symbol] | None = None,
        values: Mapping[sympy.Symbol, Fraction] | None = None,
    ) -> None:
        self._nonzero = nonzero
        self._values: dict[sympy.Expr, int] = {
            name: value.numerator * pow(value.denominator, -1, self._PRIME) % self._PRIME
            for name, value in (values or {}).items()
        }
        self._random = random.Random(0)

    def define(self, name: sympy.Symbol, expression: sympy.Expr) -> None:
        """Let a symbol stand for an expression."""
        self._values[name] = self._value(expression)

    def __call__(self, expression: sympy.Expr) -> bool:
        """Return whether the expression is zero."""
        return expression.is_zero is True or (not expression.is_Number and self._value(expression) == 0)

    def _value(self, node: sympy.Expr) -> int:
        known = self._values.get(node)
        if known is None:
            known = self._values[node] = self._compute(node)
        return known

    def _compute(self, node: sympy.Expr) -> int:
        prime = self._PRIME
        if node.is_Symbol and self._nonzero is not None and node not in self._nonzero:
            return 0
        if node.is_Rational:
            return int(node.p) * pow(int(node.q), -1, prime) % prime
        if node.is_Add:
            return sum(self._value(term) for term in node.args) % prime
        if node.is_Mul:
            return prod(self._value(factor) for factor in node.args) % prime
        if node.is_Pow and node.exp.is_Integer and (base := self._value(node.base)):
            return pow(base, int(node.exp), prime)
        return self._random.randrange(1, prime)


class Vanishing:
    """Says whether an expression is zero with the numbers of some group of peers.

    What is divided by must not be, even though other numbers would do.
    """

    def __init__(self, numbers: Sequence[Mapping[sympy.Symbol, Fraction]]) -> None:
        self._tests = [ZeroTest(values=values) for values in numbers]

    def define(self, name: sympy.Symbol, expression: sympy.Expr) -> None:
        """Let a symbol stand for an expression."""
        for test in self._tests:
            test.define(name, expression)

    def __call__(self, expression: sympy.Expr) -> bool:
        """Return whether the expression is zero for one of the groups."""
        return any(test(expression) for test in self._tests)


NOTHING_VANISHES = Vanishing(())
