"""Bounds on constants in equations, checked before any exact computation.

Takes: the sides of equations. Gives: `check_constants`; `undefined_constant`, for a message.
Guarantees: a checked equation has no constant whose exact value has more than MOST_BITS bits, and no constant
outside the range of floats.
Does not: refuse constants without a real value, such as 1/0 in a branch that is never selected (see
`equations.terms`).
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from fractions import Fraction

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, location_in
from apc.compiler.language.evaluation import EvaluationError, constant_value
from apc.compiler.language.expression import (
    Call,
    Expr,
    Name,
    NumberLiteral,
    as_written,
    children,
    format_expression,
)
from apc.compiler.source.reading import brief

# The largest number of bits of the coefficients of powers and products: nested powers can reach 2^10^6.
MOST_BITS = 1 << 15
LEAST = 2.0**-1022  # the smallest normal float
RANGE = "constants between 2.2e-308 and 1.8e308"
POWERS = ("^", "*", "/", "exp", "sinh", "cosh")


def check_constants(expression: Expr, text: str, location: SourceLocation) -> None:
    """Raise ApcError for constants that are too large, too small or too long.

    Parameters
    ----------
    expression
        One side of an equation.
    text, location
        The equation as written, and its location.

    Raises
    ------
    ApcError
        E331 a constant out of bounds.
    """

    def refuse(node: Expr, why: str) -> None:
        """Raise ApcError (E331) located at a node."""
        message = f"{brief(format_expression(node))} {why}"
        raise ApcError(Diagnostic("E331", location_in(location, text, node.start), message, RANGE))

    def bits(node: Expr) -> float:
        """Return a bound on the bits of the coefficients of a subexpression."""
        if isinstance(node, NumberLiteral):
            return float(node.value.numerator.bit_length() + node.value.denominator.bit_length())
        if isinstance(node, Name):
            return 0.0
        inner = [bits(part) for part in children(node)]
        total = sum(inner)
        if node.function == "^" and isinstance(exponent := node.arguments[1], NumberLiteral):
            total = inner[0] * abs(float(exponent.value)) + inner[1]
        if total > MOST_BITS:
            refuse(node, f"leads to a coefficient of more than {MOST_BITS} bits")
        return total

    def is_constant(node: Expr) -> bool:
        """Return whether a subexpression is constant; checks the range of constants from the inside out."""
        if not isinstance(node, Call):
            return isinstance(node, NumberLiteral)
        constant = [is_constant(part) for part in children(node)]  # no generator: all parts are checked
        if not all(constant):
            return False
        try:
            value = constant_value(node)
        except EvaluationError as error:
            if isinstance(error.cause, OverflowError):
                refuse(node, "is too large for a float")
            return False  # a constant without a real value is never computed
        if value is None:
            return False
        if node.function in POWERS and _is_tiny(value):
            refuse(node, "is too small for a float")
        return True

    bits(expression)
    is_constant(expression)


def undefined_constant(expression: Expr, text: str) -> tuple[Expr, str] | None:
    """Return the first constant without a finite real value, from the inside out, and the reason as text.

    The result is None if each constant has a value as written.

    Parameters
    ----------
    expression, text
        One side of an equation, and the equation as written.
    """
    for part in children(expression):
        if (found := undefined_constant(part, text)) is not None:
            return found
    if not isinstance(expression, Call):
        return None
    try:
        constant_value(expression)
        if expression.function == "/" and constant_value(expression.arguments[1]) == 0:
            return expression, f"{_shown(expression, text)} divides by zero"
    except EvaluationError as error:
        return error.node, f"{_shown(error.node, text)} {error.words}"
    factors = [factor for factor in _factors(expression) if isinstance(factor, NumberLiteral)]
    if math.prod(factor.value for factor in factors) > sys.float_info.max:
        shown = "*".join(map(format_expression, factors))
        return factors[0], f"{brief(shown)} is too large for a number"
    return None


def _shown(expression: Expr, text: str) -> str:
    """Return the text of a part of an equation without enclosing parentheses."""
    written = as_written(expression, text)
    return brief(format_expression(expression) if written.startswith("(") else written)


def _factors(expression: Expr) -> Iterator[Expr]:
    """Yield the factors of a product, in order; signs are omitted."""
    if isinstance(expression, Call) and expression.function in ("*", "neg"):
        for part in expression.arguments:
            yield from _factors(part)
    else:
        yield expression


def _is_tiny(value: Fraction | float) -> bool:
    """Return whether a value is smaller than the smallest normal float, or a float that underflowed
    to zero.
    """
    return abs(float(value)) < LEAST and (value != 0 or isinstance(value, float)) and math.isfinite(value)
