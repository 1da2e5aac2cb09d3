"""The nodes of an expression tree, their traversal and transformation, and their text.

Takes: `Expr` trees.
Gives: the nodes `NumberLiteral`, `Name`, `Call`; `Equation`; `format_expression`, `as_written`,
`interval_of`; `children`, `walk`, `names`, `transform`, `fold`.
Guarantees: plain frozen data; the text has no more parentheses than the tree needs.
Does not: parse text (see `grammar`), or resolve names or units.
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
    """A node of a tree (abstract base class): `start` and `end` are offsets into the parsed text, ignored in
    comparisons.
    """

    start: int = field(default=0, compare=False, repr=False)
    end: int = field(default=0, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class NumberLiteral(Spanned):
    """An exact number without a unit."""

    value: Fraction


@dataclass(frozen=True, slots=True)
class Name(Spanned):
    """A name split at its dots: `object.x` is `("object", "x")`, `finger[2].x` is `("finger[2]", "x")`."""

    parts: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Call(Spanned):
    """An operator or a function, with its arguments.

    `function` is one of `FUNCTIONS` or an operator: `neg` of -x; `^`, whose exponent is a `NumberLiteral`,
    possibly negative or a fraction; `if` of a condition and two values, with an `elseif` as a nested `if`;
    `{` of the entries of a vector, which `vectors` removes.
    """

    function: str
    arguments: tuple[Expr, ...]


_EXACT = Context(prec=5000, traps=[Inexact])  # more digits than any number in a text
INTERVAL = "interval("  # prefix of the name of a clock's period, see `interval_of`
V = TypeVar("V")

MAX_LENGTH = 10_000  # characters of an expression
PI = Fraction("3.1415926535897932384626433832795028841971693993751")  # OEIS A000796; the name `pi`

Expr = NumberLiteral | Name | Call


@dataclass(frozen=True, slots=True)
class Equation:
    """An equation `left = right`; `text` starts at `location`, and the offsets of both sides refer to it."""

    left: Expr
    right: Expr
    text: str
    location: SourceLocation


# Smooth functions of a number, as in Modelica (Language Specification 3.6, section 3.7.3).
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

# The functions whose value varies with time or between peers: a parameter has none of them.
IN_EQUATIONS = frozenset(
    ("der", "previous", "initial", "age", "mean", "sum", "count", "interval", "interpolate", "sample", "hold")
)
KEYWORDS = frozenset(("if", "then", "elseif", "else", "and", "or", "not"))


COMPARISONS = ("<", "<=", ">", ">=", "==", "!=")
CONDITIONS = (*COMPARISONS, "and", "or", "not")

# Operators by precedence: an operand without parentheses has a higher precedence than its operator.
_BINDING = (("if",), ("or",), ("and",), ("not",), COMPARISONS, ("+", "-"), ("*", "/"), ("neg",), ("^",))
LEVELS = {word: level for level, words in enumerate(_BINDING) for word in words}
PRODUCT, SIGN, ATOM = LEVELS["*"], LEVELS["neg"], len(_BINDING)
_FORMS = {"if": "if {} then {} else {}", "neg": "-{}", "not": "not {}"} | {
    word: f"{{}}{word}{{}}" for word in "*/^"
}


def format_expression(expr: Expr) -> str:
    """Return the text of a tree, with the fewest possible parentheses.

    A `NumberLiteral` without a literal in the language (1/3, −2) is written as an operation with this value.
    """
    return _format(expr)[0]


def as_written(expr: Expr, text: str) -> str:
    """Return the text of a part in the original text; the formatted text if the part has no original text."""
    return text[expr.start : expr.end] or format_expression(expr)


def _format(expr: Expr) -> tuple[str, int]:
    """Return the text of a tree, and its precedence."""
    if isinstance(expr, NumberLiteral):
        return _format_number(expr.value)
    if isinstance(expr, Name):
        return ".".join(expr.parts), ATOM
    word, parts = expr.function, [_format(argument) for argument in expr.arguments]
    if word not in LEVELS:
        arguments = ", ".join(text for text, _ in parts)
        return f"{{{arguments}}}" if word == "{" else f"{word}({arguments})", ATOM
    level = LEVELS[word]
    # Both sides of a comparison have a higher precedence: a < b < c is not in the language.
    least = {"if": (0, 0, 0), "^": (ATOM, ATOM)}.get(word, (level + (word in COMPARISONS), level + 1))
    texts = [text if have >= need else f"({text})" for (text, have), need in zip(parts, least, strict=False)]
    return _FORMS.get(word, f"{{}} {word} {{}}").format(*texts), level


def _format_number(value: Fraction) -> tuple[str, int]:
    """Return the shortest exact decimal of a number, or a quotient if there is none, and its precedence."""
    if value == PI:
        return "pi", ATOM
    sign, level = ("-", SIGN) if value < 0 else ("", ATOM)
    try:
        number = _EXACT.divide(Decimal(abs(value.numerator)), Decimal(value.denominator)).normalize(_EXACT)
    except Inexact:
        return f"{sign}{abs(value.numerator)}/{value.denominator}", PRODUCT
    _, digits, exponent = number.as_tuple()
    assert isinstance(exponent, int)
    # Scientific notation is used for more than four zeros after the point, or more than 16 digits before it.
    if exponent + len(digits) < -4 or (exponent > 0 and exponent + len(digits) > 16):
        return f"{sign}{''.join(map(str, digits))}e{exponent}", level
    return f"{sign}{number:f}", level


def children(expr: Expr) -> tuple[Expr, ...]:
    """Return the subexpressions of a node, from left to right."""
    return expr.arguments if isinstance(expr, Call) else ()


def interval_of(clock: str) -> str:
    """Return the name of the period of a clock in the equations of a component."""
    return f"{INTERVAL}{clock})"


def walk(expr: Expr) -> Iterator[Expr]:
    """Yield every node, parents first, from left to right."""
    stack = [expr]
    while stack:
        node = stack.pop()
        yield node
        stack.extend(reversed(children(node)))


def names(expr: Expr) -> Iterator[Name]:
    """Yield every `Name` node from left to right, with repetitions."""
    return (node for node in walk(expr) if isinstance(node, Name))


def transform(expr: Expr, function: Callable[[Expr], Expr | None]) -> Expr:
    """Return a tree with nodes replaced, from the root downwards.

    Parameters
    ----------
    expr
        The tree; a part without replacements is returned unchanged.
    function
        The function that returns the replacement of a node, or None to continue with its subexpressions.
        Replacements are not transformed again.
    """
    replacement = function(expr)
    if replacement is not None or not isinstance(expr, Call):
        return replacement or expr
    changed = tuple(transform(part, function) for part in expr.arguments)
    unchanged = all(map(operator.is_, changed, expr.arguments))
    return expr if unchanged else replace(expr, arguments=changed)


def fold(expr: Expr, leaf: Callable[[Name | NumberLiteral], V], apply: Callable[..., V]) -> V:
    """Return the value of a tree, computed from its leaves upwards.

    Parameters
    ----------
    expr
        The tree.
    leaf
        The function that returns the value of a name or a number.
    apply
        The function that returns the value of an operator or function, from its name and the values of its
        arguments.
    """
    if not isinstance(expr, Call):
        return leaf(expr)
    return apply(expr.function, *(fold(part, leaf, apply) for part in expr.arguments))
