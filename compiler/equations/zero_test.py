"""Whether a symbolic expression is zero: for all values of its symbols, or with the scene's numbers.

Takes: terms. Gives: `ZeroTest`, `Vanishing`, `NOTHING_VANISHES`.
Guarantees: a rational expression that is zero is found to be; one that is not is taken for zero with a
probability below its degree/2⁶¹; the same expressions give the same answers. What function values have in
common, as sin(x)² + cos(x)² = 1, SymPy is asked, where numbers at random can't tell it from zero.
Does not: expand anything; find every identity, or look for one in expressions of more than `MOST` nodes.
"""

from __future__ import annotations

import itertools
import random
from collections.abc import Mapping, Sequence, Set
from fractions import Fraction
from math import prod
from typing import TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray

from apc.compiler.equations.terms import FUNCTIONS, Symbol, Term, in_order
from apc.compiler.language.expression import SMOOTH

# A number of the scene: one for all peers, one a peer (count,), or an expression over other numbers.
Given: TypeAlias = Fraction | NDArray[np.float64] | Term
# A residue, or one a peer: an array of Python's integers, whose products outgrow 64 bits.
Residue: TypeAlias = int | NDArray[np.object_]
BITS = 61
PRIME = (1 << BITS) - 1
DIGITS = 53  # binary ones of a float
MOST = 200  # nodes beyond which no identity is looked for: simplifying takes its time
POINTS, NEARLY = 4, 1e-20  # at which an identity must vanish, and how nearly, of 30 digits
SMOOTH_FUNCTIONS = tuple(FUNCTIONS[name] for name in SMOOTH)


class ZeroTest:
    """Says whether an expression is zero for all values of its symbols.

    Each symbol, and each function value, gets a random residue modulo the prime 2⁶¹ − 1; an expression that
    isn't zero vanishes there with probability below its degree/2⁶¹ (Schwartz 1980, Zippel 1979). Expansion
    would decide the same at a cost that grows with the number of terms. The generator is seeded.

    With `nonzero`, all other symbols are taken as zero: whether an expression is zero then. With `values`,
    these symbols have their values: whether it is zero for all values of the others, and for one of the peers
    where values differ from peer to peer.
    """

    def __init__(
        self, nonzero: Set[Symbol] | None = None, values: Mapping[Symbol, Given] | None = None
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
        if expression.is_Rational:
            return bool(expression.is_zero)
        if np.any(np.equal(self._value(expression), 0)):
            return True
        if self._nonzero is not None or not expression.has(sympy.Function):
            return False
        numbers = {
            name: sympy.Rational(value.numerator, value.denominator)
            for name, value in self._given.items()
            if isinstance(value, Fraction)
        }
        return _is_identity(expression.xreplace(numbers))

    def _value(self, node: Term) -> Residue:
        known = self._values.get(node)
        if known is None:
            known = self._compute(node)
            # Of what differs from peer to peer symbols alone are kept: a million peers' take 40 MB each.
            if node.is_Symbol or isinstance(known, int):
                self._values[node] = known
        return known

    def _compute(self, node: Term) -> Residue:
        if node in self._given:
            return self._residue(self._given[node])
        if node.is_Rational:
            return node.p * pow(node.q, -1, PRIME) % PRIME
        if node.is_Add:
            return sum(map(self._value, node.args)) % PRIME
        if node.is_Mul:
            return prod(map(self._value, node.args)) % PRIME
        if node.is_Pow and node.exp.is_Integer:
            value, times = self._value(node.base), int(node.exp)
            values = [value] if isinstance(value, int) else value
            raised = [pow(one, times, PRIME) if one else self._any(node) for one in values]
            return raised[0] if isinstance(value, int) else np.array(raised, dtype=np.object_)
        taken = self._nonzero is None or not node.is_Symbol or node in self._nonzero
        return self._any(node) if taken else 0

    def _any(self, node: Term) -> int:
        """Return the random residue of a node, the same each time."""
        if node not in self._arbitrary:
            self._arbitrary[node] = self._random.randrange(1, PRIME)
        return self._arbitrary[node]

    def _residue(self, given: Given) -> Residue:
        if isinstance(given, Fraction):
            return given.numerator * pow(given.denominator, -1, PRIME) % PRIME
        if not isinstance(given, np.ndarray):
            return self._value(given)
        fractions, exponents = np.frexp(given)
        whole = np.ldexp(fractions, DIGITS).astype(np.int64).astype(np.object_)
        # 2⁶¹ ≡ 1: a power of two is that of its exponent modulo 61, be it negative.
        residues: NDArray[np.object_] = whole << ((exponents - DIGITS) % BITS).astype(np.object_)
        residues %= PRIME
        return residues


def _is_identity(expression: Term) -> bool:
    """Say whether an expression is zero for all values of its symbols, by what functions have in common."""
    few = len(list(itertools.islice(sympy.preorder_traversal(expression), MOST + 1))) <= MOST
    functions = expression.atoms(sympy.Function)
    if not few or not all(isinstance(function, SMOOTH_FUNCTIONS) for function in functions):
        return bool(expression == 0)
    chance = random.Random(0)
    for _ in range(POINTS):
        point = {s: sympy.Rational(chance.randrange(1, 999), 499) for s in in_order(expression.free_symbols)}
        if not abs(complex(expression.xreplace(point).evalf(30, maxn=60))) < NEARLY:
            return False
    return any(sympy.simplify(one) == 0 for one in (expression, expression.rewrite(sympy.exp)))


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
