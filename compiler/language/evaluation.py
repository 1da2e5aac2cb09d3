"""The value of an expression, in any arithmetic, and of an expression of parameters.

Takes: an `Expr` tree, and an arithmetic or what the tree's names stand for.
Gives: `Arithmetic`, `compute`; `Value`, `evaluate`.
Guarantees: of `evaluate`: exact as long as every operation is rational; exact rationals stay below 2^4096, so
that evaluating always ends soon; a value is finite.
Does not: know units, or values that change with time or with the peers.
"""

from __future__ import annotations

import math
import operator
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any, NoReturn, Protocol, TypeVar

from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.language.expression import (
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
    children,
    format_expression,
)
from apc.compiler.words import cut

MAX_BITS = 4096  # of an exact numerator or denominator; beyond it a float takes over

Operation = Negate | Binary | Compare | Not | Call
Value = Fraction | float | bool
V = TypeVar("V")

# What the operators mean wherever Python's own do; a power means something else in every arithmetic.
OPERATORS: dict[str, Callable[[Any, Any], Any]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "<": operator.lt,
    "<=": operator.le,
    ">": operator.gt,
    ">=": operator.ge,
    "==": operator.eq,
    "!=": operator.ne,
}


class Arithmetic(Protocol[V]):
    """What an expression is computed in: its numbers, its conditions and its operations.

    Exact numbers, rows of numbers, quotients of polynomials and symbols each have one of their own.
    """

    def literal(self, value: Fraction, /) -> V:
        """Return a number of the text."""

    def named(self, node: Name, /) -> V:
        """Return what a name stands for."""

    def operation(self, node: Operation, /) -> Callable[..., V]:
        """Return what computes an operator or a function from its operands; raise if there is no such."""

    def joined(self, node: Logic, left: V, right: Callable[[], V], /) -> V:
        """Return the conjunction or disjunction of two conditions, the second computed when it is called."""

    def chosen(
        self, node: Conditional, condition: V, then: Callable[[], V], otherwise: Callable[[], V], /
    ) -> V:
        """Return what a condition chooses; a branch is computed when it is called."""


def compute(expr: Expr, arithmetic: Arithmetic[V]) -> V:
    """Return the value of an expression in an arithmetic."""

    def value(node: Expr) -> V:
        match node:
            case Number():
                return arithmetic.literal(node.value)
            case Name():
                return arithmetic.named(node)
            case Logic():
                return arithmetic.joined(node, value(node.left), lambda: value(node.right))
            case Conditional():
                condition = value(node.condition)
                return arithmetic.chosen(
                    node, condition, lambda: value(node.then), lambda: value(node.otherwise)
                )
            case _:
                operation = arithmetic.operation(node)
                return operation(*(value(operand) for operand in children(node)))

    return value(expr)


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
    return compute(expr, _Exact(lookup, place or Place("an expression")))


def _root(value: Fraction | float) -> Fraction | float:
    """Return √value, exact when the value is the square of a rational."""
    if isinstance(value, Fraction) and value >= 0:
        numerator, denominator = math.isqrt(value.numerator), math.isqrt(value.denominator)
        if numerator**2 == value.numerator and denominator**2 == value.denominator:
            return Fraction(numerator, denominator)
    return math.sqrt(value)


_FUNCTIONS: dict[str, Callable[[Fraction | float], Fraction | float]] = {
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
class _Exact:
    """Exact rationals, floats where there is no rational, and truth values."""

    lookup: Callable[[tuple[str, ...]], Value | int]
    place: Place

    def literal(self, value: Fraction) -> Value:
        return value

    def named(self, node: Name) -> Value:
        try:
            value = self.lookup(node.parts)
        except KeyError:
            self.fail(node, "E330", f"{'.'.join(node.parts)} has no value here")
        if isinstance(value, bool):
            return value
        return self.checked(node, value if isinstance(value, float) else Fraction(value))

    def operation(self, node: Operation) -> Callable[..., Value]:
        match node:
            case Not():
                return lambda operand: not self.condition(node.operand, operand)
            case Compare():
                compare = OPERATORS[node.operator]
                return lambda *operands: bool(compare(*self.numbers(node, operands)))
            case Call("max" | "min"):
                extreme = max if node.function == "max" else min
                return self.guarded(node, lambda *operands: extreme(operands))
            case Call() if node.function in _FUNCTIONS:
                return self.guarded(node, _FUNCTIONS[node.function])
            case Call():
                what = f"{node.function}(…) changes with time or with the peers: a parameter cannot hold it"
                return self.fail(node, "E332", what)
            case Negate():
                return self.guarded(node, operator.neg)
            case Binary("^"):
                return self.guarded(node, _power)
            case Binary():
                return self.guarded(node, OPERATORS[node.operator])

    def joined(self, node: Logic, left: Value, right: Callable[[], Value]) -> Value:
        # Of `and` a false left side decides, of `or` a true one.
        if self.condition(node.left, left) != (node.operator == "and"):
            return left
        return self.condition(node.right, right())

    def chosen(
        self, node: Conditional, condition: Value, then: Callable[[], Value], otherwise: Callable[[], Value]
    ) -> Value:
        return then() if self.condition(node.condition, condition) else otherwise()

    def guarded(self, node: Operation, function: Callable[..., Fraction | float]) -> Callable[..., Value]:
        """Return a function of numbers whose value is checked, and whose failures name the node."""

        def value(*operands: Value) -> Value:
            numbers = self.numbers(node, operands)
            try:
                return self.checked(node, function(*numbers))
            except ZeroDivisionError:
                self.fail(node, "E331", f"{cut(format_expression(node))} divides by zero")
            except OverflowError:
                self.fail(node, "E331", f"{cut(format_expression(node))} is too large for a number")
            except ValueError:
                self.fail(node, "E331", f"{cut(format_expression(node))} has no real value")

        return value

    def numbers(self, node: Operation, operands: tuple[Value, ...]) -> list[Fraction | float]:
        """Return the operands, each of which has to be a number."""
        found: list[Fraction | float] = []
        for operand, value in zip(children(node), operands, strict=True):
            if isinstance(value, bool):
                shown = cut(format_expression(operand))
                self.fail(operand, "E327", f"{shown} is a condition, and a number is due here")
            found.append(value)
        return found

    def condition(self, node: Expr, value: Value) -> bool:
        if not isinstance(value, bool):
            shown = cut(format_expression(node))
            self.fail(node, "E327", f"{shown} is a number, and a condition is due here")
        return value

    def checked(self, node: Expr, value: Fraction | float) -> Fraction | float:
        """Return a value that is a finite float or could be one, and exact only while that is cheap."""
        try:
            rounded = float(value)
        except OverflowError:
            rounded = math.inf
        if not math.isfinite(rounded):
            self.fail(node, "E331", f"{cut(format_expression(node))} is too large for a number")
        return value if isinstance(value, Fraction) and _bits(value) <= MAX_BITS else rounded

    def fail(self, node: Expr, code: str, what: str) -> NoReturn:
        # Without the text we can only trust a column that exists.
        line = self.place.source_line
        fits = not line or self.place.column + node.start <= len(line)
        raise ApcError(Mistake(code, self.place.shifted(node.start) if fits else self.place, what))


def _bits(value: Fraction) -> int:
    return max(value.numerator.bit_length(), value.denominator.bit_length())


def _power(base: Fraction | float, exponent: Fraction) -> Fraction | float:
    """Return base^exponent; exact when the exponent is whole, or when it is a half and the base a square."""
    if exponent.denominator == 2 and isinstance(base, Fraction):
        base, exponent = _root(base), exponent * 2
    if exponent.denominator == 1:
        whole = exponent.numerator
        exact = isinstance(base, Fraction) and _bits(base) * abs(whole) <= 2 * MAX_BITS
        return (base if exact else float(base)) ** whole
    return math.pow(base, exponent)
