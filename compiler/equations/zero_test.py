"""Whether a symbolic expression is zero: for all values of its symbols, or with the scene's numbers.

Takes: terms. Gives: `ZeroTest`, `Vanishing`, `NOTHING_VANISHES`.
Guarantees: a rational expression that is zero is found to be; one that is not is taken for zero with a
probability below its degree/2⁶¹; the same expressions give the same answers.
Does not: simplify or expand anything; what function values have in common, as sin(x)² + cos(x)² = 1, is asked
of `identities`.
"""

from __future__ import annotations

import random
from collections.abc import Mapping, Sequence, Set
from fractions import Fraction
from math import prod
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from apc.compiler.equations.identities import is_identity
from apc.compiler.equations.terms import ZERO, Number, Product, Ratio, Sum, Symbol, Term, number

# A number of the scene: one for all peers, one a peer (count,), or an expression over other numbers.
Given: TypeAlias = Fraction | NDArray[np.float64] | Term
# A residue, or one a peer: an array of Python's integers, whose products outgrow 64 bits.
Residue: TypeAlias = int | NDArray[np.object_]
BITS = 61
PRIME = (1 << BITS) - 1
DIGITS = 53  # binary ones of a float


class ZeroTest:
    """Says whether a rational expression is zero for all values of its symbols.

    Each symbol, and each function value, gets a random residue modulo the prime 2⁶¹ − 1; an expression that
    isn't zero vanishes there with probability below its degree/2⁶¹ (Schwartz 1980, Zippel 1979). Expansion
    would decide the same at a cost that grows with the number of terms. The generator is seeded.

    With `nonzero`, all other symbols are taken as zero: whether an expression is zero then. With `values`,
    these symbols have their values: whether it is zero for all values of the others, and for one of the peers
    where values differ from peer to peer.
    """

    def __init__(
        self,
        nonzero: Set[Symbol] | None = None,
        values: Mapping[Symbol, Given] | None = None,
    ) -> None:
        self._nonzero = nonzero
        self._given = dict(values or {})
        self._values: dict[Term, Residue] = {}
        self._arbitrary: dict[Term, int] = {}
        self._random = random.Random(0)

    def define(self, name: Symbol, expression: Term) -> None:
        """Let a symbol stand for an expression."""
        self._values[name] = self._value(expression)

    def __call__(self, expression: Term) -> bool:
        """Return whether the expression is zero."""
        if isinstance(expression, Number):
            return expression == ZERO
        if np.any(np.equal(self._value(expression), 0)):
            return True
        if self._nonzero is not None:
            return False
        numbers = {name: number(given) for name, given in self._given.items() if isinstance(given, Fraction)}
        known = expression.replace(numbers) if numbers else expression
        return known == ZERO or is_identity(known)

    def _value(self, node: Term) -> Residue:
        known = self._values.get(node)
        if known is None:
            known = self._compute(node)
            # Of what differs from peer to peer symbols alone are kept: a million peers' take 40 MB each.
            if isinstance(node, Symbol) or isinstance(known, int):
                self._values[node] = known
        return known

    def _compute(self, node: Term) -> Residue:
        if isinstance(node, Symbol):
            if node in self._given:
                return self._residue(self._given[node])
            return self._any(node) if self._nonzero is None or node in self._nonzero else 0
        if isinstance(node, Number):
            return _modular(node.value)
        if isinstance(node, Sum):
            terms = (_modular(factor) * self._value(term) for term, factor in node.terms)
            return sum(terms, start=_modular(node.constant)) % PRIME
        if isinstance(node, Product):
            return prod((self._power(*one) for one in node.powers), start=_modular(node.coefficient)) % PRIME
        return self._any(node)

    def _power(self, base: Term, exponent: Ratio) -> Residue:
        if exponent == 1:
            return self._value(base)
        whole = Product(1, ((base, exponent),))
        if exponent.denominator != 1:
            return self._any(whole)
        value, times = self._value(base), int(exponent)
        if isinstance(value, int):
            return pow(value, times, PRIME) if value else self._any(whole)
        return np.array(
            [pow(one, times, PRIME) if one else self._any(whole) for one in value], dtype=np.object_
        )

    def _any(self, node: Term) -> int:
        """Return the random residue of a node, the same each time."""
        if node not in self._arbitrary:
            self._arbitrary[node] = self._random.randrange(1, PRIME)
        return self._arbitrary[node]

    def _residue(self, given: Given) -> Residue:
        if isinstance(given, Term):
            return self._value(given)
        if isinstance(given, Fraction):
            return _modular(given)
        fractions, exponents = np.frexp(given)
        whole = np.ldexp(fractions, DIGITS).astype(np.int64).astype(np.object_)
        # 2⁶¹ ≡ 1: a power of two is that of its exponent modulo 61, be it negative.
        residues: NDArray[np.object_] = whole << ((exponents - DIGITS) % BITS).astype(np.object_)
        residues %= PRIME
        return residues


def _modular(value: Ratio) -> int:
    """Return the residue of a rational number."""
    if value.denominator == 1:
        return value.numerator
    return value.numerator * pow(value.denominator, -1, PRIME) % PRIME


class Vanishing:
    """Says whether an expression is zero with the numbers of some group of peers.

    What is divided by must not be, even though other numbers would do.
    """

    def __init__(self, numbers: Sequence[Mapping[Symbol, Given]]) -> None:
        self._tests = [ZeroTest(values=values) for values in numbers]
        self._known: dict[Term, bool] = {}

    def define(self, name: Symbol, expression: Term) -> None:
        """Let a symbol stand for an expression."""
        for test in self._tests:
            test.define(name, expression)

    def __call__(self, expression: Term) -> bool:
        """Return whether the expression is zero for one of the peers."""
        if expression not in self._known:
            self._known[expression] = any(test(expression) for test in self._tests)
        return self._known[expression]


NOTHING_VANISHES = Vanishing(())
