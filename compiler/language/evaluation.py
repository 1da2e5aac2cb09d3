"""Evaluation of expressions of parameters: exact, or in any number type.

Takes: an `Expr` tree or a `Formula`, and the values of its names.
Gives: `formula_of`; `evaluate`, `constant_value`, `exact_value`; `exactly` and `computed`, with the
operations of another number type; `EvaluationError`.
Guarantees: the value is exact if every operation is rational; exact rationals are below 2^4096, which limits
the computing time; a value is finite. A branch that is not selected is not evaluated.
Does not: handle units, or values that vary with time or between peers.
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
from apc.compiler.wording import cut

Value = Fraction | float
Lookup = Callable[[tuple[str, ...]], Any]  # the value of a name, from its parts
Rule = Callable[[str], Callable[..., Any]]

MAX_BITS = 4096  # of an exact numerator or denominator; longer numbers are rounded to floats

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
    """A node of an expression has no value: `words` is the text of the error, `cause` the exception."""

    def __init__(self, node: Expr, cause: Exception) -> None:
        """Create the error of a node; the text depends on the exception."""
        words = "has no real value"
        if isinstance(cause, ArithmeticError):
            by_zero = isinstance(cause, ZeroDivisionError)
            words = "divides by zero" if by_zero else "is too large for a number"
        super().__init__(words)
        self.node, self.words, self.cause = node, words, cause


def formula_of(expr: Expr) -> Formula:
    """Return an expression of parameters as a formula: its text and its names."""
    return Formula(
        format_expression(expr), tuple(dict.fromkeys(".".join(name.parts) for name in names(expr)))
    )


def evaluate(expr: Expr, lookup: Lookup, location: SourceLocation) -> Value:
    """Return the value of an expression of parameters, exact if possible.

    Parameters
    ----------
    expr
        The tree.
    lookup
        The function that returns the value of a name, from its parts.
    location
        The location of the text of `expr`, for messages.

    Returns
    -------
    Value
        An exact `Fraction` as long as every operation is rational and its numbers stay below 2^4096; a finite
        `float` after `sqrt`, `exp`, … (the square root of a square is exact). A true condition is 1.

    Raises
    ------
    ApcError
        E331 no finite real value, E332 a function whose value varies with time or between peers.
    """
    for node in walk(expr):
        if isinstance(node, Call) and node.function in FUNCTIONS.keys() - _OPERATIONS.keys():
            message = f"{node.function}(…) depends on time or on other peers and can't be used in a parameter"
            _fail(location, node, "E332", message)
    try:
        value: Value = _exactly(expr, lookup, EXACT.__getitem__)
    except EvaluationError as fault:
        _fail(location, fault.node, "E331", f"{cut(format_expression(fault.node))} {fault.words}")
    return value


def constant_value(expr: Expr) -> Value | None:
    """Return the value of an expression without names.

    The result is None if the expression has names or varies with time or between peers.

    Raises
    ------
    EvaluationError
        The expression has no finite real value.
    """
    if any(isinstance(node, Call) and node.function not in {*_OPERATIONS, "if"} for node in walk(expr)):
        return None
    if any(True for _ in names(expr)):
        return None
    value: Value = _exactly(expr, lambda _: 0, EXACT.__getitem__)
    return value


def exact_value(name: str, formula: Formula, values: Sequence[Fraction]) -> Fraction:
    """Return the value of a number from its formula.

    The value is rounded to a float after an operation that is not rational.

    Parameters
    ----------
    name
        The name of the number, for messages.
    formula, values
        The formula, and the values of `Formula.names`.

    Raises
    ------
    ApcError
        E331 the formula has no finite real value.
    """
    text, lookup = formula.text, _lookup(formula, values)
    return Fraction(evaluate(_tree(text), lookup, SourceLocation(name, 1, 1, text)))


def exactly(formula: Formula, values: Sequence[Any], rule: Rule) -> Any:
    """Return the value of a formula with the operations of another exact number type.

    Parameters
    ----------
    formula, values
        The formula, and the values of `Formula.names`.
    rule
        The operations of `expression_data` for this number type.

    Raises
    ------
    EvaluationError
        The formula has no value.
    """
    return _exactly(_tree(formula.text), _lookup(formula, values), rule)


def computed(formula: Formula, values: Sequence[Any], rule: Rule) -> Any:
    """Return the value of a formula with the operations of a number type whose values may be arrays.

    Both branches of a choice are computed; literals are floats.

    Parameters
    ----------
    formula, values
        The formula, and the values of `Formula.names`.
    rule
        The operations of `expression_data` for this number type.
    """
    lookup = _lookup(formula, values)

    def leaf(expr: Name | NumberLiteral) -> Any:
        """Return the value of a name or a number."""
        return float(expr.value) if isinstance(expr, NumberLiteral) else lookup(expr.parts)

    def apply(word: str, *operands: Any) -> Any:
        """Return the value of an operator or function."""
        if word != "if":
            return _apply(word, operands, rule)
        condition, then, otherwise = operands
        branches = (condition, then), (rule("not")(condition), otherwise)
        return rule("add")(*(rule("if_else_zero")(*branch) for branch in branches))

    return fold(_tree(formula.text), leaf, apply)


def _lookup(formula: Formula, values: Sequence[Any]) -> Lookup:
    """Return a function from the parts of a name to its value."""
    by_name = dict(zip(formula.names, values, strict=True))
    return lambda parts: by_name[".".join(parts)]


def _exactly(expr: Expr, lookup: Lookup, rule: Rule) -> Any:
    """Return the value of an expression; only selected branches are evaluated. Raises EvaluationError."""

    def value(expr: Expr) -> Any:
        """Return the value of a subexpression."""
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
    """Return the value of an operator or function, with the operations of a number type."""
    operation = rule(_OPERATIONS[word])
    if word in ("max", "min"):
        return reduce(operation, operands)
    return operation(*(operands[::-1] if word in (">", ">=") else operands))


def _fail(location: SourceLocation, node: Expr, code: str, message: str) -> NoReturn:
    """Raise ApcError located at a node."""
    # The text of the expression is not available: the column is used only if it exists in the source line.
    fits = not location.source_line or location.column + node.start <= len(location.source_line)
    raise ApcError(Diagnostic(code, location.shifted(node.start) if fits else location, message))


@lru_cache(maxsize=1024)
def _tree(text: str) -> Expr:
    """Return the parsed text of a formula, cached."""
    from apc.compiler.language.grammar import parse_expression  # a slow import; few models have formulas

    return parse_expression(text, SourceLocation("a formula", 1, 1, text))


def _finite(value: Any) -> Any:
    """Return a number if it is in the range of floats, else raise OverflowError.

    Exact numbers longer than `MAX_BITS` are rounded to a float; values of other types are returned unchanged.
    """
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
    """Return the number of bits of the longer of numerator and denominator."""
    return max(value.numerator.bit_length(), value.denominator.bit_length())


def _root(value: Value) -> Value:
    """Return the square root, exact if the value is the square of a rational number."""
    if isinstance(value, Fraction) and value >= 0:
        numerator, denominator = math.isqrt(value.numerator), math.isqrt(value.denominator)
        if numerator**2 == value.numerator and denominator**2 == value.denominator:
            return Fraction(numerator, denominator)
    return math.sqrt(value)


def _power(base: Value, exponent: Value) -> Value:
    """Return base^exponent, exact for an integer exponent, and for a half if the base is a square."""
    power = Fraction(exponent)
    if power.denominator == 2 and isinstance(base, Fraction):
        base, power = _root(base), power * 2
    if power.denominator == 1:
        integer = power.numerator
        exact = isinstance(base, Fraction) and _bits(base) * abs(integer) <= 2 * MAX_BITS
        return (base if exact else float(base)) ** integer
    return math.pow(base, power)


def _require_finite(rule: Callable[..., Any]) -> Callable[..., Any]:
    """Return an operation whose result is checked by `_finite`."""
    return lambda *operands: _finite(rule(*operands))


# The exact operations: rational if possible, with finite results.
_EXACT: dict[str, Callable[..., Any]] = {**RULES, **ROUNDED, "sqrt": _root, "pow": _power}
EXACT = {word: _require_finite(rule) for word, rule in _EXACT.items()}
