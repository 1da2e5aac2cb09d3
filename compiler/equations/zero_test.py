"""Whether a symbolic expression is zero: for all values of its symbols, or with the scene's numbers.

Takes: SymPy expressions. Gives: `ZeroTest`, `Vanishing`, `NOTHING_VANISHES`.
Guarantees: a rational expression that is zero is found to be; one that is not is taken for zero with a
probability below its degree/2⁶¹; the same expressions give the same answers.
Does not: simplify or expand anything, or know how function values depend on each other: sin(x)² + cos(x)² − 1
is not found to be zero.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence, Set
from fractions import Fraction
from math import prod
from typing import TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray

# A number of the scene: one for all peers, one a peer (count,), or an expression over other numbers.
Given: TypeAlias = Fraction | NDArray[np.float64] | sympy.Expr
# A residue, or one a peer: an array of Python's integers, whose products outgrow 64 bits.
Residue: TypeAlias = int | NDArray[np.object_]


class ZeroTest:
    """Says whether a rational expression is zero for all values of its symbols.

    Each symbol, and each function value, gets a random residue modulo the prime 2⁶¹ − 1; an expression that
    isn't zero vanishes there with probability below its degree/2⁶¹ (Schwartz 1980, Zippel 1979). Expansion
    would decide the same at a cost that grows with the number of terms. The generator is seeded.

    With `nonzero`, all other symbols are taken as zero: whether an expression is zero then. With `values`,
    these symbols have their values: whether it is zero for all values of the others, and for one of the peers
    where values differ from peer to peer.
    """

    _PRIME = 2**61 - 1

    def __init__(
        self,
        nonzero: Set[sympy.Symbol] | None = None,
        values: Mapping[sympy.Symbol, Given] | None = None,
    ) -> None:
        self._nonzero = nonzero
        self._given = dict(values or {})
        self._values: dict[sympy.Expr, Residue] = {}
        self._arbitrary: dict[sympy.Expr, int] = {}
        self._random = random.Random(0)

    def define(self, name: sympy.Symbol, expression: sympy.Expr) -> None:
        """Let a symbol stand for an expression."""
        self._values[name] = self._value(expression)

    def __call__(self, expression: sympy.Expr) -> bool:
        """Return whether the expression is zero."""
        if expression.is_zero is True or expression.is_Number:
            return expression.is_zero is True
        return bool(np.any(np.equal(self._value(expression), 0)))

    def _value(self, node: sympy.Expr) -> Residue:
        known = self._values.get(node)
        if known is None:
            known = self._compute(node)
            # Of what differs from peer to peer symbols alone are kept: a million peers' take 40 MB each.
            if node.is_Symbol or isinstance(known, int):
                self._values[node] = known
        return known

    def _compute(self, node: sympy.Expr) -> Residue:
        prime = self._PRIME
        if node in self._given:
            return self._residue(self._given[node])
        if node.is_Symbol and self._nonzero is not None and node not in self._nonzero:
            return 0
        if node.is_Rational:
            return int(node.p) * pow(int(node.q), -1, prime) % prime
        if node.is_Add:
            return sum(self._value(term) for term in node.args) % prime
        if node.is_Mul:
            return prod(self._value(factor) for factor in node.args) % prime
        if node.is_Pow and node.exp.is_Integer:
            base, exponent = self._value(node.base), int(node.exp)
            if not isinstance(base, int):
                return np.array([self._power(node, one, exponent) for one in base], dtype=np.object_)
            return self._power(node, base, exponent)
        return self._any(node)

    def _power(self, node: sympy.Expr, base: int, exponent: int) -> int:
        return pow(base, exponent, self._PRIME) if base else self._any(node)

    def _any(self, node: sympy.Expr) -> int:
        """Return the random residue of a node, the same each time."""
        if node not in self._arbitrary:
            self._arbitrary[node] = self._random.randrange(1, self._PRIME)
        return self._arbitrary[node]

    def _residue(self, given: Given) -> Residue:
        if isinstance(given, sympy.Expr):
            return self._value(given)
        if isinstance(given, Fraction):
            return given.numerator * pow(given.denominator, -1, self._PRIME) % self._PRIME
        ratios = (float(one).as_integer_ratio() for one in given)
        # The denominator is a power of two, and 2⁶¹ ≡ 1: dividing by 2^k is multiplying by 2^(−k mod 61).
        residues = [(n << (1 - d.bit_length()) % 61) % self._PRIME for n, d in ratios]
        return np.array(residues, dtype=np.object_)


class Vanishing:
    """Says whether an expression is zero with the numbers of some group of peers.

    What is divided by must not be, even though other numbers would do.
    """

    def __init__(self, numbers: Sequence[Mapping[sympy.Symbol, Given]]) -> None:
        self._tests = [ZeroTest(values=values) for values in numbers]
        self._known: dict[sympy.Expr, bool] = {}

    def define(self, name: sympy.Symbol, expression: sympy.Expr) -> None:
        """Let a symbol stand for an expression."""
        for test in self._tests:
            test.define(name, expression)

    def __call__(self, expression: sympy.Expr) -> bool:
        """Return whether the expression is zero for one of the peers."""
        if expression not in self._known:
            self._known[expression] = any(test(expression) for test in self._tests)
        return self._known[expression]


NOTHING_VANISHES = Vanishing(())
