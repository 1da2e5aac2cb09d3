"""What the compiler thinks in: SymPy's expressions of real symbols and exact numbers.

Takes: names, and the names of the language's functions. Gives: `Term`, `symbol`, `FUNCTIONS`, `text_of`.
Guarantees: a name has one symbol; what bends or jumps by a choice stays as it is written.
Does not: simplify anything beyond what SymPy does when an expression is made.

A choice is an application of a function of our own: SymPy's Piecewise, Max and Min ask at every step
what is larger for all values, which takes milliseconds each. What no number can be, 1/0 or sqrt(-1), is
SymPy's `zoo` or `nan`, or has an imaginary part.
"""

from __future__ import annotations

import functools
from collections.abc import Iterable
from fractions import Fraction
from typing import Any, TypeAlias

import sympy

from apc.compiler.language.expression import (
    COMPARISONS,
    SMOOTH,
    Binary,
    Call,
    Compare,
    Conditional,
    Expr,
    Logic,
    Name,
    Negate,
    Not,
    Number,
    format_expression,
)

Term: TypeAlias = Any  # sympy.Expr, which has no complete types
Symbol: TypeAlias = Any  # sympy.Symbol

ZERO, ONE, HALF = sympy.S.Zero, sympy.S.One, sympy.S.Half


class NoDerivativeError(Exception):
    """A value was to be differentiated that has no derivative, because it jumps or bends: which, and why."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"{what}, {why}")


class Choice(sympy.Function):  # type: ignore[misc]  # SymPy has no types
    """A function with corners or jumps, abstract."""

    is_extended_real = True


class Condition(Choice):
    """A comparison, or conditions joined, abstract: it has a value, and no slope."""


class If(Choice):
    """One of two values by a condition; where it has a corner, its slope is that of the branch taken."""

    @classmethod
    def between(cls, condition: Term, then: Term, otherwise: Term) -> Term:
        """Return the choice, or the value that both branches have."""
        return then if then == otherwise else cls(condition, then, otherwise)

    def _eval_derivative(self, by: Symbol) -> Term:
        condition, then, otherwise = self.args
        return self.between(condition, then.diff(by), otherwise.diff(by))


class Abs(Choice):
    """The absolute value; SymPy's has no slope of what it doesn't know to be real, such as x/y."""

    @classmethod
    def eval(cls, value: Term) -> Term | None:
        """Return the value of a number."""
        return sympy.Abs(value) if value.is_number else None

    def _eval_power(self, exponent: Term) -> Term | None:
        return self.args[0] ** exponent if exponent.is_even else None

    def _eval_derivative(self, by: Symbol) -> Term:
        return sympy.sign(self.args[0]) * self.args[0].diff(by)


class Max(Choice):
    """The largest of its arguments."""

    stays = ">="  # what the best so far is to the next

    def _eval_derivative(self, by: Symbol) -> Term:
        best, slope = self.args[0], self.args[0].diff(by)
        for argument in self.args[1:]:
            slope = If.between(FUNCTIONS[self.stays](best, argument), slope, argument.diff(by))
            best = self.func(best, argument)
        return slope


class Min(Max):
    """The least of its arguments."""

    stays = "<="


class Interpolate(Choice):
    """The value of a table at a time, linear between its rows."""

    def _eval_derivative(self, by: Symbol) -> Term:
        del by
        raise NoDerivativeError(text_of(self), "which has none")


FUNCTIONS: dict[str, Any] = {
    "if": If,
    "max": Max,
    "min": Min,
    "interpolate": Interpolate,
    "abs": Abs,
    "sqrt": sympy.sqrt,
    **{name: getattr(sympy, name) for name in ("sign", "floor", "atan2", *SMOOTH)},
    **{name: type(name, (Condition,), {}) for name in (*COMPARISONS, "and", "or", "not")},
}
NAMES = {sympy.Abs: "abs", **{function: name for name, function in FUNCTIONS.items()}}


@functools.cache
def symbol(name: str) -> Symbol:
    """Return the symbol of a name, a real number."""
    return sympy.Symbol(name, real=True)


def in_order(symbols: Iterable[Symbol]) -> list[Symbol]:
    """Return symbols by their names: a set has no order that is the same each time."""
    return sorted(symbols, key=lambda s: s.name)


def size(term: Term) -> int:
    """Return how many nodes a term has."""
    return sum(1 for _ in sympy.preorder_traversal(term))


def text_of(term: Term) -> str:
    """Return a term in the language's own form."""
    return format_expression(_written(term))


def _is_negative(term: Term) -> bool:
    return bool(term.as_coeff_Mul()[0].is_negative)


def _written(term: Term) -> Expr:
    if term.is_Symbol:
        return Name((term.name,))
    if term.is_Rational:
        return Number(Fraction(term.p, term.q))
    if term.is_NumberSymbol:
        return Name(("pi",)) if term is sympy.pi else Call("exp", (Number(Fraction(1)),))
    if term.is_Add:
        first, *others = sorted(term.args, key=_is_negative)
        total = _written(first)
        for part in others:
            minus = _is_negative(part)
            total = Binary("-" if minus else "+", total, _written(-part if minus else part))
        return total
    if term.is_Mul:
        return Negate(_written(-term)) if _is_negative(term) else _written_product(term)
    if term.is_Pow:
        base, exponent = term.args
        if exponent.is_negative:
            return _written_product(term)
        root = exponent == HALF
        return Call("sqrt", (_written(base),)) if root else Binary("^", _written(base), _written(exponent))
    arguments = tuple(map(_written, term.args))
    name = NAMES.get(term.func, term.func.__name__)
    if name == "if":
        return Conditional(*arguments)
    if name in COMPARISONS:
        return Compare(name, *arguments)
    if name in ("and", "or"):
        return Logic(name, *arguments)
    return Not(*arguments) if name == "not" else Call(name, arguments)


def _written_product(term: Term) -> Expr:
    """Return a product as a quotient, the number in front first."""
    number, rest = term.as_coeff_Mul()
    factors = sympy.Mul.make_args(rest)
    below = [factor for factor in factors if factor.is_Pow and factor.exp.is_negative]
    above = [*([number] if number != 1 else []), *(one for one in factors if one not in below)]
    times = functools.partial(Binary, "*")
    whole = functools.reduce(times, map(_written, above or [ONE]))
    if not below:
        return whole
    return Binary("/", whole, functools.reduce(times, (_written(1 / factor) for factor in below)))
