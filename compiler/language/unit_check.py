"""Dimension check of expressions and equations.

Takes: `Expr` and `Equation`, and the dimension of every name.
Gives: `dimension_of`, the dimension of an expression; `check_equation`.
Guarantees: every term with a wrong dimension is reported once, at its own column; a part of unknown dimension
causes no error.
Does not: handle scales (all numbers are in SI units), or resolve names.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from fractions import Fraction

from apc.compiler.errors import Mistakes, SourceLocation, location_in
from apc.compiler.language.dimensions import DIMENSIONLESS, SECOND, Dimension
from apc.compiler.language.expression import (
    CONDITIONS,
    FUNCTIONS,
    SMOOTH,
    Call,
    Equation,
    Expr,
    Name,
    NumberLiteral,
    as_written,
)
from apc.compiler.language.unit_text import format_dimension

ANY = Dimension((("any", 1),))
"""The dimension of the literal 0, which agrees with every dimension."""

_HALF = NumberLiteral(Fraction(1, 2))

# Functions whose arguments after the first are times, and the expectation shown in errors.
_TIMES = {"hold": "s, as a delay", "interpolate": "s, as tables are over time"}
Lookup = Callable[[Name], Dimension | None]


def dimension_of(expr: Expr, lookup: Lookup, text: str, location: SourceLocation) -> Dimension | None:
    """Return the dimension of an expression, after checking the dimensions of all its terms.

    Parameters
    ----------
    expr
        The tree; its offsets refer to `text`.
    lookup
        The function that returns the dimension of a name, None if unknown.
    text, location
        The text, and its location.

    Returns
    -------
    Dimension or None
        `ANY` for a literal 0, `DIMENSIONLESS` for every other literal and for a condition; None if it depends
        on a name without a dimension. A sum with one term of known dimension has the dimension of this term.

    Raises
    ------
    ApcError
        E402 different dimensions in a sum, E403 an argument that is not dimensionless, E404 different
        dimensions of branches, arguments or sides of a comparison, E405 a delay that is not a time.
    """
    checker = _Checker(lookup, text, location)
    dimension = checker.dimension(expr)
    checker.mistakes.raise_if_any()
    return dimension


def check_equation(equation: Equation, lookup: Lookup) -> None:
    """Check that both sides of an equation, and all terms in them, have the same dimension.

    The terms of both sides are compared together, so that the wrong term in `m*der(v) = f - d*x` is reported.

    Raises
    ------
    ApcError
        E401 a term that doesn't fit the equation; and those of `dimension_of`.
    """
    checker = _Checker(lookup, equation.text, equation.location)
    checker.agree("E401", [*_terms(equation.left), *_terms(equation.right)])
    checker.mistakes.raise_if_any()


def _terms(expr: Expr) -> list[Expr]:
    """Return the terms of a sum, without their signs and parentheses."""
    match expr:
        case Call("+" | "-" | "neg", parts):
            return [term for part in parts for term in _terms(part)]
    return [expr]


def _dimension_text(dimension: Dimension) -> str:
    """Return the text of a dimension in messages."""
    return "a plain number" if dimension == DIMENSIONLESS else format_dimension(dimension)


class _Checker:
    """The check of one text: returns dimensions and collects errors.

    A part with an error has an unknown dimension.
    """

    def __init__(self, lookup: Lookup, text: str, location: SourceLocation) -> None:
        self.lookup, self.text, self.location = lookup, text, location
        self.mistakes = Mistakes()

    def expression_text(self, expr: Expr) -> str:
        """Return the text of a part of the expression, at most 60 characters."""
        written = as_written(expr, self.text)
        return written if len(written) <= 60 else written[:57] + "…"

    def add(self, code: str, expr: Expr, expected: str, got: Dimension) -> None:
        """Record an error located at a part of the expression, with the dimension of the part."""
        location = location_in(self.location, self.text, expr.start)
        self.mistakes.add(
            code, location, self.expression_text(expr), expected=expected, got=_dimension_text(got)
        )

    def agree(self, code: str, parts: Sequence[Expr]) -> Dimension | None:
        """Return the dimension of most parts, the first of them in a tie.

        Record the parts with another dimension.

        The result is `ANY` if all parts are 0, None if no dimension is known.
        """
        pairs = [(part, self.dimension(part)) for part in parts]
        known = [(part, dimension) for part, dimension in pairs if dimension not in (None, ANY)]
        if not known:
            return None if any(dimension is None for _, dimension in pairs) else ANY
        typical = Counter(dimension for _, dimension in known).most_common(1)[0][0]
        fitting = [part for part, dimension in known if dimension == typical]
        others = "the other terms" if len(known) - 1 == len(fitting) > 1 else self.expression_text(fitting[0])
        for part, dimension in known:
            if dimension and typical and (dimension != typical or dimension.clashes(typical)):
                self.add(code, part, f"{_dimension_text(typical)}, the unit of {others}", dimension)
        return typical

    def fits(self, expr: Expr, required: Dimension, code: str, expected: str) -> None:
        """Record an argument whose dimension is not the required one (`required`)."""
        dimension = self.dimension(expr)
        if dimension is not None and dimension not in (ANY, required):
            self.add(code, expr, expected, dimension)

    def factor(self, expr: Expr) -> Dimension | None:
        """Return the dimension of a factor of a product, in which the literal 0 is dimensionless."""
        dimension = self.dimension(expr)
        return DIMENSIONLESS if dimension == ANY else dimension

    def dimension(self, expr: Expr) -> Dimension | None:
        """Return the dimension of an expression; None after an error, `ANY` for the literal 0."""
        if isinstance(expr, NumberLiteral):
            return DIMENSIONLESS if expr.value else ANY
        if isinstance(expr, Name):
            return self.lookup(expr)
        word, parts = expr.function, expr.arguments
        if word in ("+", "-", "neg"):
            return self.agree("E402", _terms(expr))
        if word in ("*", "/", "dot", "cross", "^"):
            return self.product(word, *parts)
        if word == "sqrt":
            return self.product("^", parts[0], _HALF)
        if word in ("floor", *SMOOTH):
            self.fits(parts[0], DIMENSIONLESS, "E403", "a plain number")
            return DIMENSIONLESS
        if word in ("and", "or", "not", "if"):
            conditions, parts = (parts[:1], parts[1:]) if word == "if" else (parts, ())
            for condition in conditions:
                self.dimension(condition)
        # Branches, sides and entries have the same dimension, and so have the arguments of max, min and
        # atan2.
        equal = word not in FUNCTIONS or word in ("max", "min", "atan2")
        result = self.agree("E404", parts) if equal else self.dimension(parts[0])
        for time in parts[1:] if word in _TIMES else ():
            self.fits(time, SECOND, "E405", _TIMES[word])
        if word in ("atan2", "sign", "count", *CONDITIONS):
            return DIMENSIONLESS
        if word == "der" and result != ANY:
            return result and result.divide(SECOND)
        # The other functions, such as max, hold or sample, have the dimension of their arguments.
        return SECOND if word == "age" else result

    def product(self, word: str, left: Expr, right: Expr) -> Dimension | None:
        """Return the dimension of a product, quotient or power; None if it is unknown."""
        base = self.factor(left)
        if word == "^" and isinstance(right, NumberLiteral):
            return base and base.power(right.value)
        if word == "^":
            for part in (right, left):  # x^n has a unit only for a written n
                self.fits(part, DIMENSIONLESS, "E403", "a plain number")
            return DIMENSIONLESS
        other = self.factor(right)
        if base is None or other is None:
            return None
        return base.divide(other) if word == "/" else base.multiply(other)
