"""Zero test of an expression: for all values of its symbols, with the parameter values, or with zeros.

Takes: terms, and parameter values. Gives: `Divisors`.
Guarantees: a rational expression that is zero is always detected. A nonzero expression is reported as zero
with a probability below its degree/2⁶¹. Results are reproducible. If random numbers are inconclusive, SymPy
tests identities between function values, such as sin(x)² + cos(x)² = 1.
Does not: expand expressions; detect every identity, or search one in expressions of more than `MOST` nodes.
"""

from __future__ import annotations

import math
import random
from collections.abc import Collection, Mapping, Sequence
from fractions import Fraction
from math import prod
from typing import Any, TypeAlias

import numpy as np
import sympy
from numpy.typing import NDArray

from apc.compiler.equations.terms import NAMES, Abs, PiecewiseFunction, Symbol, Term, in_order, size
from apc.compiler.expression_data import ROUNDED

# A number of the topology: one for all peers, one per peer (count,), or an expression over other numbers.
Given: TypeAlias = Fraction | NDArray[np.float64] | Term
Residue: TypeAlias = (
    Any  # an integer, or an array with one per peer of Python's integers, as products exceed 64 bits
)
PRIME = (1 << 61) - 1
MOST = 200  # largest number of nodes of an expression tested for identities: simplification is slow
MOST_BITS = 256  # of a number in an expression tested for identities
NEARLY = 1e-20  # largest value of an identity at a point, relative to its largest term, with 30 digits


class Divisors:
    """The zero tests that decide whether a term may be a divisor.

    `nonzero` are the parameters that cannot be zero; `numbers` has the numbers of each group of peers, by
    symbol.
    """

    def __init__(self, nonzero: Collection[Symbol], numbers: Sequence[Mapping[Symbol, Given]]) -> None:
        """Prepare the three tests: with arbitrary values, with zeros, and with the numbers of each group."""
        self._any = _Residues({})
        self._least = _Residues({}, nonzero)
        self._groups = [_Residues(values) for values in numbers]

    def define(self, name: Symbol, expression: Term) -> None:
        """Define a symbol as an abbreviation of an expression."""
        for item in (self._any, self._least, *self._groups):
            item.known[name] = item(expression)

    def is_zero(self, expression: Term) -> bool:
        """Return whether an expression is zero for all values of its symbols."""
        return self._any.vanishes(expression)

    def can_vanish(self, expression: Term) -> bool:
        """Return whether an expression is zero if all parameters that can be zero are zero."""
        return bool(self._least(expression) == 0)

    def vanishes(self, expression: Term) -> bool:
        """Return whether an expression is zero with the numbers of at least one peer."""
        return any(group.vanishes(expression) for group in self._groups)


class _Residues:
    """The values of expressions modulo the prime 2⁶¹ − 1.

    A symbol of `given` has its value; other symbols and function values have random residues. A nonzero
    expression has the residue zero with a probability below its degree/2⁶¹ (Schwartz 1980, Zippel 1979).
    Expansion would give the same decision at a cost that grows with the number of terms. The generator has a
    fixed seed. With `nonzero`, all other symbols are zero.
    """

    def __init__(self, given: Mapping[Symbol, Given], nonzero: Collection[Symbol] | None = None) -> None:
        """Store the values of the symbols in `given`, and the symbols that are not zero."""
        self.given = given
        self.nonzero = nonzero
        self.known: dict[Term, Residue] = {}
        self.random = random.Random(0)

    def vanishes(self, expression: Term) -> bool:
        """Return whether an expression is zero for at least one peer."""
        if np.any(np.equal(self(expression), 0)):
            return True
        if not expression.has(sympy.Function) or _is_long(expression):
            return False
        numbers = {
            s: sympy.Rational(number) for s, number in self.given.items() if isinstance(number, Fraction)
        }
        return _is_identity(expression.xreplace(numbers))

    def __call__(self, node: Term) -> Residue:
        """Return the residue of an expression."""
        if node in self.known:
            return self.known[node]
        value = self._value(node)
        if isinstance(value, int) or node.is_Symbol:  # an array for a million peers would take 40 MB per node
            self.known[node] = value
        return value

    def _value(self, node: Term) -> Residue:
        """Return the residue of an expression from the residues of its arguments."""
        if node in self.given:
            value = self.given[node]
            return self(value) if isinstance(value, sympy.Expr) else _MODULAR(value)
        if node.is_Rational:
            return _MODULAR(node)
        if node.is_Add:
            return sum(map(self, node.args)) % PRIME
        if node.is_Mul:
            return prod(map(self, node.args)) % PRIME
        random_residue = self.random.randrange(1, PRIME)
        if node.is_Pow and node.exp.is_Integer:  # the random residue replaces the inverse of zero
            return _POWER(self(node.base), int(node.exp), random_residue)
        return (
            0 if self.nonzero is not None and node.is_Symbol and node not in self.nonzero else random_residue
        )


def _is_long(expression: Term) -> bool:
    """Return whether an expression has a number of more than `MOST_BITS` bits, which SymPy would factor."""
    return any(
        max(abs(number.p), number.q).bit_length() > MOST_BITS for number in expression.atoms(sympy.Rational)
    )


def _modular(value: Fraction | float | Term) -> int:
    """Return the residue of a number modulo `PRIME`."""
    exact = Fraction(value) if isinstance(value, float) else value
    return int(exact.numerator * pow(exact.denominator, -1, PRIME) % PRIME)


def _power(base: int, exponent: int, inverse_of_zero: int) -> int:
    """Return a power modulo `PRIME`; `inverse_of_zero` is the value of zero to a negative power."""
    return pow(base, exponent, PRIME) if base or exponent > 0 else inverse_of_zero


# `_modular` and `_power` for a number or for each element of an array.
_MODULAR: Any = np.frompyfunc(_modular, 1, 1)
_POWER: Any = np.frompyfunc(_power, 3, 1)


def _float_at(node: Term, point: Mapping[Symbol, float]) -> float:
    """Return the value of an expression at a point as a float. Raises the errors of Python's arithmetic."""
    if node.is_Symbol:
        return point[node]
    if node.is_Rational:
        return float(node)
    values = [_float_at(part, point) for part in node.args]
    if node.is_Add:
        return math.fsum(values)
    if node.is_Mul:
        return prod(values)
    if node.is_Pow:
        return float(values[0] ** values[1])
    name = NAMES[node.func]
    return abs(values[0]) if name == "abs" else ROUNDED[name](*values)


def _is_identity(expression: Term) -> bool:
    """Return whether an expression is zero for all values of its symbols, by function identities."""
    expression = expression.replace(Abs, sympy.Abs)
    if expression == 0:
        return True
    if expression.is_Mul:
        return any(map(_is_identity, expression.args))
    if expression.is_Pow:
        return bool(expression.exp.is_positive) and _is_identity(expression.base)
    if size(expression) > MOST or expression.has(PiecewiseFunction):
        return bool(expression == 0)
    generator = random.Random(0)
    point = {s: sympy.Rational(generator.randrange(1, 999), 499) for s in in_order(expression.free_symbols)}
    try:
        _float_at(expression, {s: float(number) for s, number in point.items()})
    except (ArithmeticError, ValueError, KeyError, TypeError):  # the value at the point is not a float
        return False
    terms = [
        abs(complex(term.xreplace(point).evalf(30, maxn=60))) for term in sympy.Add.make_args(expression)
    ]
    if not abs(complex(expression.xreplace(point).evalf(30, maxn=60))) < NEARLY * max(terms):
        return False
    return any(sympy.simplify(item) == 0 for item in (expression, expression.rewrite(sympy.exp)))
