"""What a number comes to that follows from others: exactly, or in any kind of number.

Takes: a `Formula` or its function, and the values of what it names.
Gives: `exact_value`; `computed`, by any rules; `exactly`, `carrying`, `FaultError`: what fails, and where.
Guarantees: exact as long as every operation is rational; exact rationals stay below 2^4096, so that computing
always ends soon; a value is finite. What fails in a branch that isn't taken does no harm.
Does not: read text (see `language.evaluation`), or know whose values are asked for.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

from apc.compiler.compiled import Formula
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.plain import ROUNDED, RULES, PlainFunction, walk
from apc.compiler.words import cut

MAX_BITS = 4096  # of an exact numerator or denominator; beyond it a float takes over


class FaultError(Exception):
    """A value of a function, by its place, is none: what is wrong with it, and why."""

    def __init__(self, place: int, cause: Exception) -> None:
        words = "has no real value"
        if isinstance(cause, ArithmeticError):
            by_zero = isinstance(cause, ZeroDivisionError)
            words = "divides by zero" if by_zero else "is too large for a number"
        super().__init__(words)
        self.place, self.words, self.cause = place, words, cause


@dataclass(frozen=True, slots=True, eq=False)
class _Fault:
    """What an operation gives that has no value, carried on until it is known whether it is asked for."""

    cause: ArithmeticError | ValueError


def exact_value(name: str, formula: Formula, values: Sequence[Fraction]) -> Fraction:
    """Return what a number comes to; beyond rational operations, the float it was rounded to.

    Parameters
    ----------
    name
        The number's, for messages.
    formula, values
        What it follows from, and the values of `Formula.names`.

    Raises
    ------
    ApcError
        E331 it has no finite real value.
    """
    try:
        return Fraction(exactly(formula.function, [*values, *formula.numbers]))
    except FaultError as fault:
        start, end = formula.spans[fault.place]
        place = Place(name, 1, 1, formula.text).shifted(start)
        raise ApcError(Mistake("E331", place, f"{cut(formula.text[start:end])} {fault.words}")) from None


def computed(formula: Formula, values: Sequence[Any], rule: Callable[[str], Callable[..., Any]]) -> Any:
    """Return what a number comes to by other rules (see `plain.walk`); numbers of its text are floats."""
    found = walk(formula.function, [*values, *map(float, formula.numbers)], rule)
    return found[formula.function.results[0][0]]


def exactly(
    function: PlainFunction,
    values: Sequence[Any],
    rule: Callable[[str], Callable[..., Any]] | None = None,
) -> Any:
    """Return the only value of a function: of rationals and floats, a finite one of them.

    Parameters
    ----------
    function, values
        The function, and all values it takes.
    rule
        Those of another kind of number, from `carrying`.

    Raises
    ------
    FaultError
        It has none.
    """
    found = walk(function, [_carried(_kept, value) for value in values], rule or _exact)
    [[wanted]] = function.results
    result = found[wanted]
    if isinstance(result, _Fault):
        raise FaultError(next(k for k, one in enumerate(found) if one is result), result.cause)
    return result


def carrying(word: str, rule: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation that carries on what has no value, unless a condition says it isn't asked for."""

    def operation(first: Any, *others: Any) -> Any:
        if not isinstance(first, _Fault):
            if word == "if_else_zero":
                return others[0] if first != 0 else Fraction(0)
            if (word == "and" and first == 0) or (word == "or" and first != 0):
                return first
        for operand in (first, *others):
            if isinstance(operand, _Fault):
                return operand
        return _carried(rule, first, *others)

    return operation


def _carried(rule: Callable[..., Any], *operands: Any) -> Any:
    try:
        return rule(*operands)
    except (ArithmeticError, ValueError) as cause:
        return _Fault(cause)


def _kept(value: Any) -> Any:
    """Return a value of Python's that is a finite float or could be one, exact only while that is cheap."""
    if not isinstance(value, int | float | Fraction):
        return value
    rounded = float(value)
    if not math.isfinite(rounded):
        raise OverflowError
    if isinstance(value, float):
        return value
    exact = Fraction(value)
    return exact if _bits(exact) <= MAX_BITS else rounded


def _bits(value: Fraction) -> int:
    return max(value.numerator.bit_length(), value.denominator.bit_length())


def _root(value: Fraction | float) -> Fraction | float:
    """Return √value, exact when the value is the square of a rational."""
    if isinstance(value, Fraction) and value >= 0:
        numerator, denominator = math.isqrt(value.numerator), math.isqrt(value.denominator)
        if numerator**2 == value.numerator and denominator**2 == value.denominator:
            return Fraction(numerator, denominator)
    return math.sqrt(value)


def _power(base: Fraction | float, exponent: Fraction | float) -> Fraction | float:
    """Return base^exponent; exact when the exponent is whole, or when it is a half and the base a square."""
    power = Fraction(exponent)
    if power.denominator == 2 and isinstance(base, Fraction):
        base, power = _root(base), power * 2
    if power.denominator == 1:
        whole = power.numerator
        exact = isinstance(base, Fraction) and _bits(base) * abs(whole) <= 2 * MAX_BITS
        return (base if exact else float(base)) ** whole
    return math.pow(base, power)


# All that an expression of parameters is made of.
EXACT: dict[str, Callable[..., Any]] = {
    **{word: RULES[word] for word in ("neg", "add", "sub", "mul", "div", "fabs", "sign", "floor")},
    **{word: RULES[word] for word in ("fmin", "fmax", "lt", "le", "eq", "ne", "and", "or", "not")},
    "if_else_zero": RULES["if_else_zero"],
    **ROUNDED,
    "sqrt": _root,
    "pow": _power,
}


@functools.cache
def _exact(word: str) -> Callable[..., Any]:
    return carrying(word, lambda *operands: _kept(EXACT[word](*operands)))
