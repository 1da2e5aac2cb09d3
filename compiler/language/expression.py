"""The nodes of an expression's tree, walking and changing them, and their text.

Takes: `Expr` trees.
Gives: the nodes `NumberLiteral`, `Name`, `Call`; `Equation`; `format_expression`, `as_written`,
`interval_of`; `children`, `walk`, `names`, `transform`, `fold`.
Guarantees: plain frozen data; the text has no more parentheses than the tree needs.
Does not: read text (see `grammar`), or know what a name means, or its unit.
"""

from __future__ import annotations

import operator
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from decimal import Context, Decimal, Inexact
from fractions import Fraction
from typing import TypeVar

from apc.compiler.errors import SourceLocation


@dataclass(frozen=True, slots=True, kw_only=True)
class Spanned:
    """A node of a tree, abstract: `start` and `end` are offsets into the parsed text, in no comparison."""

    start: int = field(default=0, compare=False, repr=False)
    end: int = field(default=0, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class NumberLiteral(Spanned):
    """A number without a unit, exact."""

    value: Fraction


@dataclass(frozen=True, slots=True)
class Name(Spanned):
    """`object.x` is `("object", "x")`; an index stays with its segment, `("finger[2]", "x")`."""

    parts: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Call(Spanned):
    """An operator or a function, with its arguments.

    `function` is one of `FUNCTIONS` or an operator: `neg` of -x; ^, whose right side is a `NumberLiteral`,
    maybe negative or a fraction; `if` of a condition, a value and another, where an `elseif` is an `if` in
    its place; `{` of the entries of a vector, of which none is left behind `vectors`.
    """

    function: str
    arguments: tuple[Expr, ...]


_EXACT = Context(prec=5000, traps=[Inexact])  # of more digits than any number in a text has
INTERVAL = "interval("  # how the name of a clock's period begins, see `interval_of`
V = TypeVar("V")

PI = Fraction("3.1415926535897932384626433832795028841971693993751")  # OEIS A000796; the name `pi`

Expr = NumberLiteral | Name | Call


@dataclass(frozen=True, slots=True)
class Equation:
    """`left = right`; `text` starts at `location`, and the offsets of both sides count from there."""

    left: Expr
    right: Expr
    text: str
    location: SourceLocation


# Smooth functions of a number, as Modelica has them (Language Specification 3.6, section 3.7.3).
SMOOTH = ("exp", "log", "sin", "cos", "tan", "asin", "acos", "atan", "sinh", "cosh", "tanh")

# function -> (fewest arguments, most arguments)
FUNCTIONS: dict[str, tuple[int, int]] = {
    **dict.fromkeys(
        ("der", "previous", "initial", "age", "mean", "sum", "count", "interval", "norm"), (1, 1)
    ),
    **dict.fromkeys(("abs", "sign", "sqrt", "floor", *SMOOTH), (1, 1)),
    **dict.fromkeys(("atan2", "interpolate", "dot", "cross"), (2, 2)),
    "sample": (1, 2),
    "hold": (1, 2),
    "max": (1, 16),
    "min": (1, 16),
}

KEYWORDS = frozenset(("if", "then", "elseif", "else", "and", "or", "not"))


COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
CONDITIONS = (*COMPARISONS, "and", "or", "not")

# Operators by precedence: an operand must bind tighter than its operator.
_BINDING = (("if",), ("or",), ("and",), ("not",), COMPARISONS, ("+", "-"), ("*", "/"), ("neg",), ("^",))
LEVELS = {word: level for level, words in enumerate(_BINDING) for word in words}
PRODUCT, SIGN, ATOM = LEVELS["*"], LEVELS["neg"], len(_BINDING)
_FORMS = {"if": "if {} then {} else {}", "neg": "-{}", "not": "not {}"} | {
    word: f"{{}}{word}{{}}" for word in "*/^"
}


def format_expression(expr: Expr) -> str:
    """Return the text of a tree, with no more parentheses than it needs.

    A `NumberLiteral` no parsed text can hold (1/3, −2) prints as the operation that gives it.
    """
    return _format(expr)[0]


def as_written(expr: Expr, text: str) -> str:
    """Return a part as written in a text, or as it would be if from another source."""
    return text[expr.start : expr.end] or format_expression(expr)


def _format(expr: Expr) -> tuple[str, int]:
    """Return a text and how tightly it binds."""
    if isinstance(expr, NumberLiteral):
        return _format_number(expr.value)
    if isinstance(expr, Name):
        return ".".join(expr.parts), ATOM
    word, parts = expr.function, [_format(argument) for argument in expr.arguments]
    if word not in LEVELS:
        arguments = ", ".join(text for text, _ in parts)
        return f"{{{arguments}}}" if word == "{" else f"{word}({arguments})", ATOM
    level = LEVELS[word]
    # Both sides of a comparison bind tighter than it: a < b < c is not in the language.
    least = {"if": (0, 0, 0), "^": (ATOM, ATOM)}.get(word, (level + (word in COMPARISONS), level + 1))
    texts = [text if binds >= due else f"({text})" for (text, binds), due in zip(parts, least, strict=False)]
    return _FORMS.get(word, f"{{}} {word} {{}}").format(*texts), level


def _format_number(value: Fraction) -> tuple[str, int]:
    """Return the shortest exact decimal, or a quotient when there is none."""
    if value == PI:
        return "pi", ATOM
    sign, level = ("-", SIGN) if value < 0 else ("", ATOM)
    try:
        number = _EXACT.divide(Decimal(abs(value.numerator)), Decimal(value.denominator)).normalize(_EXACT)
    except Inexact:
        return f"{sign}{abs(value.numerator)}/{value.denominator}", PRODUCT
    _, digits, exponent = number.as_tuple()
    assert isinstance(exponent, int)
    # An exponent is used for more than four zeros after the point, and in a number of more than 16 digits.
    if exponent + len(digits) < -4 or (exponent > 0 and exponent + len(digits) > 16):
        return f"{sign}{''.join(map(str, digits))}e{exponent}", level
    return f"{sign}{number:f}", level


def children(expr: Expr) -> tuple[Expr, ...]:
    """Return the sub-expressions of a node, left to right."""
    return expr.arguments if isinstance(expr, Call) else ()


def interval_of(clock: str) -> str:
    """Return the name by which a component's equations have the period of one of its clocks."""
    return f"{INTERVAL}{clock})"


def walk(expr: Expr) -> Iterator[Expr]:
    """Give every node, parents first, left to right."""
    stack = [expr]
    while stack:
        node = stack.pop()
        yield node
        stack.extend(reversed(children(node)))


def names(expr: Expr) -> Iterator[Name]:
    """Give every `Name` node, left to right, repetitions included."""
    return (node for node in walk(expr) if isinstance(node, Name))


def transform(expr: Expr, function: Callable[[Expr], Expr | None]) -> Expr:
    """Replace nodes, from the top down.

    Parameters
    ----------
    expr
        The tree; a part in which nothing is replaced is returned unchanged.
    function
        Returns a node's replacement, which is final, or None to continue with its sub-expressions.
    """
    replacement = function(expr)
    if replacement is not None or not isinstance(expr, Call):
        return replacement or expr
    changed = tuple(transform(part, function) for part in expr.arguments)
    same = all(map(operator.is_, changed, expr.arguments))
    return expr if same else replace(expr, arguments=changed)


def fold(expr: Expr, leaf: Callable[[Name | NumberLiteral], V], apply: Callable[..., V]) -> V:
    """Return the value of a tree under a fold.

    Parameters
    ----------
    expr
        The tree.
    leaf
        Returns the value of a name or a number.
    apply
        Returns the value of an operator or function, from its name and its arguments.
    """
    if not isinstance(expr, Call):
        return leaf(expr)
    return apply(expr.function, *(fold(part, leaf, apply) for part in expr.arguments))
