"""Symbolic expressions of the compiler: SymPy expressions of real symbols and exact numbers.

Takes: the language's expressions, and names. Gives: `Term`, `to_term`, `text_of`, `size`; `symbol`,
`derivative`, `in_order`; `slope`, `differential`, `linear_form`, `is_no_number` of terms,
`NoDerivativeError`; `PiecewiseFunction`, `If`, `Abs`.
Guarantees: a name has one symbol, and each of its time derivatives has one: `x`, `der(x)`, `der(der(x))`;
expressions with a choice (kinks, jumps) remain as written.
Does not: simplify expressions beyond SymPy's automatic simplification.

A choice is the application of a function defined here: SymPy's Piecewise, Max and Min attempt to decide
comparisons at every step, which takes milliseconds each. Undefined values, 1/0 or sqrt(-1), are SymPy's `zoo`
or `nan`, or have an imaginary part.
"""

from __future__ import annotations

import functools
import math
import operator
import sys
from collections.abc import Callable, Iterable, Sequence, Set
from fractions import Fraction
from typing import Any, TypeAlias

import sympy

from apc.compiler.language.evaluation import EvaluationError, constant_value
from apc.compiler.language.expression import (
    CONDITIONS,
    SMOOTH,
    Call,
    Expr,
    Name,
    NumberLiteral,
    fold,
    format_expression,
    transform,
)
from apc.compiler.language.expression import walk as expressions

Term: TypeAlias = Any  # sympy.Expr, which has no complete types
Symbol: TypeAlias = Any  # sympy.Symbol
# The coefficients and the constant of Σ coefficient·unknown + constant.
LinearForm: TypeAlias = tuple[dict[Symbol, Term], Term]

ZERO, ONE, HALF = sympy.S.Zero, sympy.S.One, sympy.S.Half
LARGEST = int(sys.float_info.max)
LONG = 12  # nodes of the longest exact constant: SymPy's assumption queries on longer ones are slow
FLOAT_DIGITS = 17  # decimal digits that identify a float


class NoDerivativeError(Exception):
    """The derivative of a value with jumps or without a derivative is required.

    The text names the value and the reason.
    """


class PiecewiseFunction(sympy.Function):  # type: ignore[misc]  # SymPy has no types
    """A function with corners or jumps (abstract base class)."""

    is_extended_real = True


class Condition(PiecewiseFunction):
    """A comparison or a combination of conditions (abstract base class): it has a value and no derivative."""


class If(PiecewiseFunction):
    """One of two values by a condition; its derivative is the derivative of the selected branch."""

    @classmethod
    def between(cls, condition: Term, then: Term, otherwise: Term) -> Term:
        """Return the choice between two values, or their common value if they are equal."""
        return then if then == otherwise else cls(condition, then, otherwise)

    def _eval_derivative(self, by: Symbol) -> Term:
        """Return the choice between the derivatives of the branches (SymPy calls this method)."""
        condition, then, otherwise = self.args
        return self.between(condition, then.diff(by), otherwise.diff(by))


class Abs(PiecewiseFunction):
    """The absolute value; SymPy's own has no derivative for arguments not known to be real, such as x/y."""

    @classmethod
    def eval(cls, value: Term) -> Term | None:
        """Return the absolute value of a number.

        The result is None if the argument contains symbols. SymPy calls this method.
        """
        number = rounded(value)
        if number.is_Rational:
            return -value if number < 0 else value
        return value if value.is_number and value.is_extended_real is not True else None

    def _eval_power(self, exponent: Term) -> Term | None:
        """Return an even power without the absolute value.

        The result is None for other powers. SymPy calls this method.
        """
        return self.args[0] ** exponent if exponent.is_even else None

    def _eval_derivative(self, by: Symbol) -> Term:
        """Return the derivative by a symbol: sign times slope of the argument (SymPy calls this method)."""
        return sympy.sign(self.args[0]) * self.args[0].diff(by)


class Max(PiecewiseFunction):
    """The largest of the arguments."""

    selected_if = ">="  # the relation of the selected argument to the next one

    def _eval_derivative(self, by: Symbol) -> Term:
        """Return the derivative by a symbol: that of the selected argument (SymPy calls this method)."""
        best, slope = self.args[0], self.args[0].diff(by)
        for argument in self.args[1:]:
            slope = If.between(FUNCTIONS[self.selected_if](best, argument), slope, argument.diff(by))
            best = self.func(best, argument)
        return slope


class Min(Max):
    """The smallest of the arguments."""

    selected_if = "<="


class Interpolate(PiecewiseFunction):
    """The value of a time series at a time, with linear interpolation between its rows."""

    def _eval_derivative(self, by: Symbol) -> Term:
        """Raise NoDerivativeError: a time series has no derivative (SymPy calls this method)."""
        del by
        raise NoDerivativeError(f"{text_of(self)}, which has none")


def rounded(value: Term) -> Term:
    """Return a constant as a rational number: the nearest float unless it is rational; other terms unchanged.

    SymPy's own floor and sign of e^700 compute hundreds of digits, or fail.
    """
    if not value.is_number or value.is_Rational or value.is_extended_real is False or value is sympy.nan:
        return value
    number = value.evalf(FLOAT_DIGITS)
    return sympy.Rational(float(number)) if number.is_Float else value


def _of_rounded(function: Any) -> Callable[[Term], Term]:
    """Return the function applied to the rounded argument."""
    return lambda value: function(rounded(value))


FUNCTIONS: dict[str, Any] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "^": operator.pow,
    "neg": operator.neg,
    "if": If,
    "max": Max,
    "min": Min,
    "interpolate": Interpolate,
    "abs": Abs,
    "sqrt": sympy.sqrt,
    "sign": _of_rounded(sympy.sign),
    "floor": _of_rounded(sympy.floor),
    **{name: getattr(sympy, name) for name in ("atan2", *SMOOTH)},
    **{name: type(name, (Condition,), {}) for name in CONDITIONS},
}
_ROUNDED = {"sqrt", "atan2", "max", "min", "abs", *SMOOTH}
NAMES = {
    sympy.Abs: "abs",
    sympy.sign: "sign",
    sympy.floor: "floor",
    **{function: name for name, function in FUNCTIONS.items()},
}


@functools.cache
def symbol(name: str) -> Symbol:
    """Return the SymPy symbol of a name, a real number."""
    return sympy.Symbol(name, real=True)


def derivative(name: str, order: int = 1) -> Symbol:
    """Return the symbol of the time derivative of a variable, of a given order."""
    return symbol("der(" * order + name + ")" * order)


def in_order(symbols: Iterable[Symbol]) -> list[Symbol]:
    """Return symbols sorted by name: the order of a set is not reproducible."""
    return sorted(symbols, key=lambda s: s.name)


def size(term: Term) -> int:
    """Return the number of nodes of a term."""
    return sum(1 for _ in sympy.preorder_traversal(term))


def to_term(expression: Expr, differentiate: Callable[[Term], Term] | None = None) -> Term:
    """Return an expression as a term.

    `differentiate` returns the time derivative of the argument of `der`.
    """

    def leaf(node: Name | NumberLiteral) -> Term:
        """Return the term of a name or a number."""
        if isinstance(node, Name):
            return symbol(".".join(node.parts))
        return sympy.Rational(node.value.numerator, node.value.denominator)

    def term(name: str, *operands: Term) -> Term:
        """Return the term of a function or operator applied to terms."""
        if name == "der":
            assert differentiate is not None, operands
            return differentiate(*operands)
        if name in _ROUNDED and not all(operand.is_Rational for operand in operands):
            operands = tuple(map(rounded, operands))  # for nested constants
        if name in ("max", "min") and all(operand.is_Rational for operand in operands):
            return (max if name == "max" else min)(operands)
        if name == "atan2" and _is_wide(operands):
            return sympy.Rational(math.atan2(*map(float, operands)))
        return FUNCTIONS[name](*operands)

    return fold(transform(expression, _short_constant), leaf, term)


def _short_constant(node: Expr) -> Expr | None:
    """Return a long irrational constant as the nearest float, a constant choice as its value.

    The result is None for other nodes.

    A constant without a real value is replaced by 1/0.
    """
    if not isinstance(node, Call):
        return None
    is_choice = node.function == "if"
    if not is_choice and sum(1 for _ in expressions(node)) <= LONG:
        return None
    try:
        value = constant_value(node)
    except EvaluationError:
        return Call("/", (NumberLiteral(Fraction(1)), NumberLiteral(Fraction(0))))
    return (
        NumberLiteral(Fraction(value))
        if isinstance(value, float) or (is_choice and value is not None)
        else None
    )


def _is_wide(operands: Sequence[Term]) -> bool:
    """Return whether the ratio of two rational numbers is outside the range of floats."""
    if not all(operand.is_Rational and operand for operand in operands):
        return False
    ratio = abs(operands[0] / operands[1])
    return bool(max(ratio, 1 / ratio) > LARGEST)


# ---- properties of terms ----


def is_no_number(expression: Term) -> bool:
    """Return whether an expression contains a constant that is not a float: 1/0, sqrt(-1), 1e300^2."""
    return any(map(_is_undefined, sympy.preorder_traversal(expression)))


def _is_undefined(node: Term) -> bool:
    """Return whether a node is a constant that is not a finite real float."""
    if node.is_Rational:
        return bool(abs(node.p) > LARGEST * node.q)
    if node is sympy.nan or isinstance(node, sympy.AccumBounds):
        return True
    return bool(node.is_number) and (node.is_extended_real is False or node.is_finite is False)


def slope(expression: Term, by: Symbol) -> Term:
    """Return the derivative of an expression by a symbol.

    A choice has the derivative of the selected branch; a function with jumps is constant between them.
    """
    result = expression.diff(by)
    jumps = result.atoms(sympy.DiracDelta, sympy.Derivative, sympy.Subs)
    return result.xreplace(dict.fromkeys(jumps, ZERO)) if jumps else result


def differential(expression: Term, rate: Callable[[Symbol], Term]) -> Term:
    """Return Σ ∂expression/∂s · rate(s) over the symbols s, by the chain rule.

    Raises NoDerivativeError for a time series at a varying time, or by `rate`.
    """
    parts = (
        partial * rate(s)
        for term in sympy.Add.make_args(expression)
        for s in in_order(term.free_symbols)
        if (partial := slope(term, s)) != 0
    )
    return sympy.Add(*parts)


def linear_form(expression: Term, unknowns: Set[Symbol]) -> LinearForm | None:
    """Return the coefficients and the constant of Σ coefficient·unknown + constant, or None if it is not
    linear.
    """
    functions = (atom for atom in expression.atoms(sympy.Function) if not isinstance(atom, If))
    if any(not unknowns.isdisjoint(function.free_symbols) for function in functions):
        return None
    slopes: dict[Symbol, list[Term]] = {}
    for term in sympy.Add.make_args(expression):
        for unknown in in_order(term.free_symbols & unknowns):
            slopes.setdefault(unknown, []).append(slope(term, unknown))
    coefficients = {unknown: sympy.Add(*parts) for unknown, parts in slopes.items()}
    if any(not unknowns.isdisjoint(coefficient.free_symbols) for coefficient in coefficients.values()):
        return None
    return coefficients, expression.xreplace(dict.fromkeys(coefficients, ZERO))


# ---- terms as text ----


def text_of(term: Term) -> str:
    """Return a term as text in the language of equations."""
    return format_expression(_written(term))


def _is_negative(term: Term) -> bool:
    """Return whether a term has a negative coefficient."""
    return bool(term.as_coeff_Mul()[0].is_negative)


def _written(term: Term) -> Expr:
    """Return a term as an expression of the language."""
    if term.is_Symbol:
        return Name((term.name,))
    if term.is_Rational:
        return NumberLiteral(Fraction(term.p, term.q))
    if term.is_Add:
        first, *others = sorted(term.args, key=_is_negative)
        total = _written(first)
        for part in others:
            minus = _is_negative(part)
            total = Call("-" if minus else "+", (total, _written(-part if minus else part)))
        return total
    if term.is_Mul and _is_negative(term):
        return Call("neg", (_written(-term),))
    if term.is_Mul or (term.is_Pow and term.exp.is_negative):
        return _written_product(term)
    if term.is_Pow and term.exp != HALF:
        return Call("^", tuple(map(_written, term.args)))
    if term.is_Pow:
        return Call("sqrt", (_written(term.base),))
    return Call(NAMES.get(term.func, term.func.__name__), tuple(map(_written, term.args)))


def _written_product(term: Term) -> Expr:
    """Return a product as a quotient, with the number as the first factor."""
    number, factors = term.as_coeff_Mul()
    denominator = [
        factor for factor in sympy.Mul.make_args(factors) if factor.is_Pow and factor.exp.is_negative
    ]
    numerator = [
        item for item in (number, *sympy.Mul.make_args(factors)) if item != 1 and item not in denominator
    ]
    quotient = _times(numerator or [ONE])
    return Call("/", (quotient, _times(1 / item for item in denominator))) if denominator else quotient


def _times(factors: Iterable[Term]) -> Expr:
    """Return the product of factors as an expression of the language."""
    return functools.reduce(lambda item, other: Call("*", (item, other)), map(_written, factors))
