"""The value of an expression of parameters, exact as long as every operation is rational.

Takes: an `Expr` tree and what its names stand for. Gives: `Value`, `evaluate`.
Guarantees: exact rationals stay below 2^4096, so evaluating always ends soon; a value is finite.
Does not: know units, or values that change with time or with the peers.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import NoReturn

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.expression import (
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
    cut,
    format_expression,
)

MAX_BITS = 4096  # of an exact numerator or denominator; beyond it a float takes over

Value = Fraction | float | bool


def evaluate(
    expr: Expr, lookup: Callable[[tuple[str, ...]], Value | int], place: Place | None = None
) -> Value:
    """Return the value of an expression of parameters.

    Parameters
    ----------
    expr
        The tree.
    lookup
        Gives the value of a name's parts; a `KeyError` from it becomes a mistake.
    place
        Where the text of `expr` starts, for messages.

    Returns
    -------
    Value
        An exact `Fraction` as long as every operation is rational and its numbers stay below 2^4096; a finite
        `float` after `sqrt`, `exp`, … (the square root of a square is exact); a `bool` for a condition.

    Raises
    ------
    ApcError
        E330 a name without a value, E331 no finite real value, E332 a function that has none in a parameter.
    """
    return _Evaluator(lookup, place or Place("an expression")).value(expr)


def _root(value: Fraction | float) -> Fraction | float:
    """Return √value, exact when the value is the square of a rational."""
    if isinstance(value, Fraction) and value >= 0:
        numerator, denominator = math.isqrt(value.numerator), math.isqrt(value.denominator)
        if numerator**2 == value.numerator and denominator**2 == value.denominator:
            return Fraction(numerator, denominator)
    return math.sqrt(value)


_SIMPLE: dict[str, Callable[[Fraction | float], Fraction | float]] = {
    "abs": lambda value: -value if value < 0 else value,
    "sign": lambda value: Fraction((value > 0) - (value < 0)),
    "floor": lambda value: Fraction(math.floor(value)),
    "sqrt": _root,
    "exp": math.exp,
    "log": math.log,
    "sin": math.sin,
    "cos": math.cos,
    "tanh": math.tanh,
}


@dataclass(frozen=True, slots=True)
class _Evaluator:
    lookup: Callable[[tuple[str, ...]], Value | int]
    place: Place

    def fail(self, expr: Expr, code: str, what: str) -> NoReturn:
        # Without the text we can only trust a column that exists.
        line = self.place.source_line
        fits = not line or self.place.column + expr.start <= len(line)
        raise ApcError(Mistake(code, self.place.shifted(expr.start) if fits else self.place, what))

    def value(self, expr: Expr) -> Value:
        match expr:
            case Number():
                return expr.value
            case Name():
                return self.named(expr)
            case Compare():
                return _compare(expr.operator, self.number(expr.left), self.number(expr.right))
            case Logic("and"):
                return self.condition(expr.left) and self.condition(expr.right)
            case Logic():
                return self.condition(expr.left) or self.condition(expr.right)
            case Not():
                return not self.condition(expr.operand)
            case Conditional():
                return self.value(expr.then if self.condition(expr.condition) else expr.otherwise)
            case Negate() | Binary() | Call():
                try:
                    return self.checked(expr, self.computed(expr))
                except ZeroDivisionError:
                    self.fail(expr, "E331", f"{cut(format_expression(expr))} divides by zero")
                except OverflowError:
                    self.fail(expr, "E331", f"{cut(format_expression(expr))} is too large for a number")
                except ValueError:
                    self.fail(expr, "E331", f"{cut(format_expression(expr))} has no real value")

    def named(self, expr: Name) -> Value:
        try:
            value = self.lookup(expr.parts)
        except KeyError:
            self.fail(expr, "E330", f"{'.'.join(expr.parts)} has no value here")
        if isinstance(value, bool):
            return value
        return self.checked(expr, value if isinstance(value, float) else Fraction(value))

    def number(self, expr: Expr) -> Fraction | float:
        value = self.value(expr)
        if isinstance(value, bool):
            self.fail(
                expr, "E327", f"{cut(format_expression(expr))} is a condition, and a number is due here"
            )
        return value

    def condition(self, expr: Expr) -> bool:
        value = self.value(expr)
        if not isinstance(value, bool):
            self.fail(
                expr, "E327", f"{cut(format_expression(expr))} is a number, and a condition is due here"
            )
        return value

    def checked(self, expr: Expr, value: Fraction | float) -> Fraction | float:
        """Return a value that is a finite float or could be one, and exact only while that is cheap."""
        try:
            rounded = float(value)
        except OverflowError:
            rounded = math.inf
        if not math.isfinite(rounded):
            self.fail(expr, "E331", f"{cut(format_expression(expr))} is too large for a number")
        return value if isinstance(value, Fraction) and _bits(value) <= MAX_BITS else rounded

    def computed(self, expr: Negate | Binary | Call) -> Fraction | float:
        match expr:
            case Negate():
                return -self.number(expr.operand)
            case Binary("^", base, Number(exponent)):
                return _power(self.number(base), exponent)
            case Binary():
                return _arithmetic(expr.operator, self.number(expr.left), self.number(expr.right))
            case Call("max" | "min" as function, arguments):
                values = [self.number(argument) for argument in arguments]
                return max(values) if function == "max" else min(values)
            case Call(function, (argument,)) if function in _SIMPLE:
                return _SIMPLE[function](self.number(argument))
            case Call():
                what = f"{expr.function}(…) changes with time or with the peers: a parameter cannot hold it"
                return self.fail(expr, "E332", what)


def _bits(value: Fraction) -> int:
    return max(value.numerator.bit_length(), value.denominator.bit_length())


def _arithmetic(operator: str, left: Fraction | float, right: Fraction | float) -> Fraction | float:
    match operator:
        case "+":
            return left + right
        case "-":
            return left - right
        case "*":
            return left * right
        case _:
            return left / right


def _power(base: Fraction | float, exponent: Fraction) -> Fraction | float:
    """Return base^exponent; exact when the exponent is whole, or when it is a half and the base a square."""
    if exponent.denominator == 2 and isinstance(base, Fraction):
        base, exponent = _root(base), exponent * 2
    if exponent.denominator == 1:
        whole = exponent.numerator
        exact = isinstance(base, Fraction) and _bits(base) * abs(whole) <= 2 * MAX_BITS
        return (base if exact else float(base)) ** whole
    return math.pow(base, exponent)


def _compare(operator: str, left: Fraction | float, right: Fraction | float) -> bool:
    match operator:
        case "<":
            return left < right
        case "<=":
            return left <= right
        case ">":
            return left > right
        case ">=":
            return left >= right
        case "==":
            return left == right
        case _:
            return left != right
