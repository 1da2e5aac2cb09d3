"""Evaluation of expressions of parameters: exact, or in any number type.

Takes: an `Expr` tree or a `Formula`, and the values of its names.
Gives: `formula_of`; `evaluate`, `constant_value`, `exact_value`; `exactly` and `computed`, by the rules of
another number type; `EvaluationError`.
Guarantees: exact as long as every operation is rational; exact rationals stay below 2^4096, so that computing
always ends soon; a value is finite. A branch that is not taken is not evaluated.
Does not: know units, or values that change with time or with the peers.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from functools import lru_cache, reduce
from typing import Any, NoReturn

from apc.compiler.compiled import Formula
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.expression_data import ROUNDED, RULES
from apc.compiler.language.expression import (
    FUNCTIONS,
    SMOOTH,
    Call,
    Expr,
    Name,
    NumberLiteral,
    children,
    fold,
    format_expression,
    names,
    walk,
)
from apc.compiler.language.grammar import parse_expression
from apc.compiler.wording import cut

Value = Fraction | float
Lookup = Callable[[tuple[str, ...]], Any]  # of the parts of a name
Rule = Callable[[str], Callable[..., Any]]

MAX_BITS = 4096  # of an exact numerator or denominator; beyond it a float takes over

# The operations of `expression_data` by the operators and functions of the language.
_OPERATIONS = {
    "+": "add",
    "-": "sub",
    "*": "mul",
    "/": "div",
    "^": "pow",
    "<": "lt",
    "<=": "le",
    ">": "lt",
    ">=": "le",
    "==": "eq",
    "!=": "ne",
    "and": "and",
    "or": "or",
    "abs": "fabs",
    "max": "fmax",
    "min": "fmin",
    **{name: name for name in ("neg", "not", "sign", "floor", "sqrt", "atan2", *SMOOTH)},
}


class EvaluationError(Exception):
    """A node of an expression has no value: the error in words, and its reason."""

    def __init__(self, node: Expr, cause: Exception) -> None:
        words = "has no real value"
        if isinstance(cause, ArithmeticError):
            by_zero = isinstance(cause, ZeroDivisionError)
            words = "divides by zero" if by_zero else "is too large for a number"
        super().__init__(words)
        self.node, self.words, self.cause = node, words, cause


def formula_of(expr: Expr) -> Formula:
    """Return an expression of parameters, which has a value, as a formula."""
    return Formula(
        format_expression(expr), tuple(dict.fromkeys(".".join(name.parts) for name in names(expr)))
    )


def evaluate(expr: Expr, lookup: Lookup, location: SourceLocation) -> Value:
    """Return the value of an expression of parameters.

    Parameters
    ----------
    expr
        The tree.
    lookup
        Returns the value of a name's parts.
    location
        The location of the text of `expr`, for messages.

    Returns
    -------
    Value
        An exact `Fraction` as long as every operation is rational and its numbers stay below 2^4096; a finite
        `float` after `sqrt`, `exp`, … (the square root of a square is exact). A condition that holds is 1.

    Raises
    ------
    ApcError
        E331 no finite real value, E332 a function that has none in a parameter.
    """
    for node in walk(expr):
        if isinstance(node, Call) and node.function in FUNCTIONS.keys() - _OPERATIONS.keys():
            message = f"{node.function}(…) changes with time or with the peers: a parameter cannot hold it"
            _fail(location, node, "E332", message)
    try:
        value: Value = _exactly(expr, lookup, EXACT.__getitem__)
    except EvaluationError as fault:
        _fail(location, fault.node, "E331", f"{cut(format_expression(fault.node))} {fault.words}")
    return value


def constant_value(expr: Expr) -> Value | None:
    """Return the value of an expression without names, None if it varies with time or between peers.

    Raises
    ------
    EvaluationError
        It has no finite real value.
    """
    if any(isinstance(node, Call) and node.function not in {*_OPERATIONS, "if"} for node in walk(expr)):
        return None
    if any(True for _ in names(expr)):
        return None
    value: Value = _exactly(expr, lambda _: 0, EXACT.__getitem__)
    return value


def exact_value(name: str, formula: Formula, values: Sequence[Fraction]) -> Fraction:
    """Return the value of a number; beyond rational operations, its rounded float.

    Parameters
    ----------
    name
        The number's, for messages.
    formula, values
        Its formula, and the values of `Formula.names`.

    Raises
    ------
    ApcError
        E331 it has no finite real value.
    """
    text, lookup = formula.text, _lookup(formula, values)
    return Fraction(evaluate(_tree(text), lookup, SourceLocation(name, 1, 1, text)))


def exactly(formula: Formula, values: Sequence[Any], rule: Rule) -> Any:
    """Return a formula's value by the rules of exact numbers of another kind.

    Parameters
    ----------
    formula, values
        The formula, and the values of `Formula.names`.
    rule
        The operations of `expression_data` for this number type.

    Raises
    ------
    EvaluationError
        It has none.
    """
    return _exactly(_tree(formula.text), _lookup(formula, values), rule)


def computed(formula: Formula, values: Sequence[Any], rule: Rule) -> Any:
    """Return a formula's value in numbers that may be arrays: both branches are computed, numbers are floats.

    Parameters
    ----------
    formula, values
        The formula, and the values of `Formula.names`.
    rule
        The operations of `expression_data` for this number type.
    """
    lookup = _lookup(formula, values)

    def leaf(expr: Name | NumberLiteral) -> Any:
        return float(expr.value) if isinstance(expr, NumberLiteral) else lookup(expr.parts)

    def apply(word: str, *operands: Any) -> Any:
        if word != "if":
            return _apply(word, operands, rule)
        holds, then, otherwise = operands
        branches = (holds, then), (rule("not")(holds), otherwise)
        return rule("add")(*(rule("if_else_zero")(*branch) for branch in branches))

    return fold(_tree(formula.text), leaf, apply)


def _lookup(formula: Formula, values: Sequence[Any]) -> Lookup:
    by_name = dict(zip(formula.names, values, strict=True))
    return lambda parts: by_name[".".join(parts)]


def _exactly(expr: Expr, lookup: Lookup, rule: Rule) -> Any:
    """Return the value of an expression, evaluated only as far as needed. Raises FaultError."""

    def value(expr: Expr) -> Any:
        match expr:
            case Call("if", (condition, then, otherwise)):
                return value(then if value(condition) != 0 else otherwise)
            case Call("and" | "or" as word, (left, right)):
                first = value(left)
                return first if (first != 0) == (word == "or") else value(right)
        operands = [value(part) for part in children(expr)]
        try:
            if isinstance(expr, Call):
                return _apply(expr.function, operands, rule)
            return _finite(expr.value if isinstance(expr, NumberLiteral) else lookup(expr.parts))
        except (ArithmeticError, ValueError) as cause:
            raise EvaluationError(expr, cause) from None

    return value(expr)


def _apply(word: str, operands: Sequence[Any], rule: Rule) -> Any:
    """Return the value of an operator or function."""
    operation = rule(_OPERATIONS[word])
    if word in ("max", "min"):
        return reduce(operation, operands)
    return operation(*(operands[::-1] if word in (">", ">=") else operands))


def _fail(location: SourceLocation, node: Expr, code: str, message: str) -> NoReturn:
    # Without the text we can only trust a column that exists.
    fits = not location.source_line or location.column + node.start <= len(location.source_line)
    raise ApcError(Diagnostic(code, location.shifted(node.start) if fits else location, message))


@lru_cache(maxsize=1024)
def _tree(text: str) -> Expr:
    return parse_expression(text, SourceLocation("a formula", 1, 1, text))


def _finite(value: Any) -> Any:
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


def _root(value: Value) -> Value:
    """Return √value, exact when the value is the square of a rational."""
    if isinstance(value, Fraction) and value >= 0:
        numerator, denominator = math.isqrt(value.numerator), math.isqrt(value.denominator)
        if numerator**2 == value.numerator and denominator**2 == value.denominator:
            return Fraction(numerator, denominator)
    return math.sqrt(value)


def _power(base: Value, exponent: Value) -> Value:
    """Return base^exponent; exact when the exponent is whole, or when it is a half and the base a square."""
    power = Fraction(exponent)
    if power.denominator == 2 and isinstance(base, Fraction):
        base, power = _root(base), power * 2
    if power.denominator == 1:
        whole = power.numerator
        exact = isinstance(base, Fraction) and _bits(base) * abs(whole) <= 2 * MAX_BITS
        return (base if exact else float(base)) ** whole
    return math.pow(base, power)


def _require_finite(rule: Callable[..., Any]) -> Callable[..., Any]:
    return lambda *operands: _finite(rule(*operands))


# Exact where an operation is rational, and finite.
_EXACT: dict[str, Callable[..., Any]] = {**RULES, **ROUNDED, "sqrt": _root, "pow": _power}
EXACT = {word: _require_finite(rule) for word, rule in _EXACT.items()}
