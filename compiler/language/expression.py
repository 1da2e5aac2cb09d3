"""The nodes of an expression's tree, walking and changing them, and their text.

Takes: `Expr` trees.
Gives: the node types, `Equation`, `format_expression`, `interval_of`, `operation`, `children`, `rebuild`,
`walk`, `names`, `transform`, `fold`.
Guarantees: plain frozen data; the text has no more parentheses than the tree needs.
Does not: read text (see `grammar`), or know what a name means, or its unit.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field, replace
from decimal import Context, Decimal, Inexact
from enum import IntEnum
from fractions import Fraction
from typing import Any, TypeVar

from apc.compiler.errors import Place


@dataclass(frozen=True, slots=True, kw_only=True)
class Spanned:
    """A node of a tree, abstract: `start` and `end` are offsets into the parsed text, in no comparison."""

    start: int = field(default=0, compare=False, repr=False)
    end: int = field(default=0, compare=False, repr=False)


@dataclass(frozen=True, slots=True)
class Number(Spanned):
    """A number without a unit, exact."""

    value: Fraction


@dataclass(frozen=True, slots=True)
class Name(Spanned):
    """`object.x` is `("object", "x")`; an index stays with its segment, `("finger[2]", "x")`."""

    parts: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class Negate(Spanned):
    """−operand."""

    operand: Expr


@dataclass(frozen=True, slots=True)
class Binary(Spanned):
    """`operator` is one of + - * / ^; the right side of ^ is a `Number`, maybe negative or a fraction."""

    operator: str
    left: Expr
    right: Expr


@dataclass(frozen=True, slots=True)
class Compare(Spanned):
    """A condition; `operator` is one of < <= > >= == !=."""

    operator: str
    left: Expr
    right: Expr


@dataclass(frozen=True, slots=True)
class Logic(Spanned):
    """A condition of two conditions; `operator` is `and` or `or`."""

    operator: str
    left: Expr
    right: Expr


@dataclass(frozen=True, slots=True)
class Not(Spanned):
    """The opposite of a condition."""

    operand: Expr


@dataclass(frozen=True, slots=True)
class Call(Spanned):
    """A function of `FUNCTIONS` and its arguments."""

    function: str
    arguments: tuple[Expr, ...]


@dataclass(frozen=True, slots=True)
class Conditional(Spanned):
    """`if condition then then else otherwise`; an `elseif` is a `Conditional` in `otherwise`."""

    condition: Expr
    then: Expr
    otherwise: Expr


@dataclass(frozen=True, slots=True)
class Vector(Spanned):
    """`{a, b}`: a vector by its entries; none is left behind `vectors`."""

    entries: tuple[Expr, ...]


_EXACT = Context(prec=5000, traps=[Inexact])  # of more digits than any number in a text has
INTERVAL = "interval("  # how the name of a clock's period begins, see `interval_of`
V = TypeVar("V")

PI = Fraction("3.1415926535897932384626433832795028841971693993751")  # OEIS A000796; the name `pi`

Expr = Number | Name | Negate | Binary | Compare | Logic | Not | Call | Conditional | Vector


@dataclass(frozen=True, slots=True)
class Equation:
    """`left = right`; `text` starts at `place`, and the offsets of both sides count from there."""

    left: Expr
    right: Expr
    text: str
    place: Place


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


class Level(IntEnum):
    """How tightly an operator binds; an operand must bind tighter than what it stands in."""

    OR = 1
    AND = 2
    NOT = 3
    COMPARE = 4
    SUM = 5
    PRODUCT = 6
    SIGN = 7
    POWER = 8
    ATOM = 9


LEVELS = {
    "or": Level.OR,
    "and": Level.AND,
    **dict.fromkeys(COMPARISONS, Level.COMPARE),
    **dict.fromkeys("+-", Level.SUM),
    **dict.fromkeys("*/", Level.PRODUCT),
    "^": Level.POWER,
}


def format_expression(expr: Expr) -> str:
    """Return the text of a tree, with no more parentheses than it needs.

    A `Number` no parsed text can hold (1/3, −2) prints as the operation that gives it.
    """
    return _format(expr)[0]


def _format(expr: Expr) -> tuple[str, int]:
    """Return a text and how tightly it binds."""
    match expr:
        case Number():
            return _format_number(expr.value)
        case Name():
            return ".".join(expr.parts), Level.ATOM
        case Negate():
            return "-" + _inside(expr.operand, Level.SIGN), Level.SIGN
        case Binary("^", base, exponent):
            return f"{_inside(base, Level.ATOM)}^{_inside(exponent, Level.ATOM)}", Level.POWER
        case Binary() | Logic() | Compare():
            level = LEVELS[expr.operator]
            # Both sides of a comparison bind tighter than it: a < b < c is not in the language.
            left = _inside(expr.left, level + isinstance(expr, Compare))
            right = _inside(expr.right, level + 1)
            space = "" if level == Level.PRODUCT else " "
            return f"{left}{space}{expr.operator}{space}{right}", level
        case Not():
            return "not " + _inside(expr.operand, Level.NOT), Level.NOT
        case Call():
            arguments = ", ".join(_format(argument)[0] for argument in expr.arguments)
            return f"{expr.function}({arguments})", Level.ATOM
        case Conditional():
            parts = f"if {_format(expr.condition)[0]} then {_format(expr.then)[0]}"
            return f"{parts} else {_format(expr.otherwise)[0]}", 0
        case Vector():
            return f"{{{', '.join(_format(entry)[0] for entry in expr.entries)}}}", Level.ATOM


def _inside(expr: Expr, level: int) -> str:
    text, binds = _format(expr)
    return text if binds >= level else f"({text})"


def _format_number(value: Fraction) -> tuple[str, int]:
    """Return the shortest exact decimal, or a quotient when there is none."""
    if value == PI:
        return "pi", Level.ATOM
    sign, level = ("-", Level.SIGN) if value < 0 else ("", Level.ATOM)
    try:
        number = _EXACT.divide(Decimal(abs(value.numerator)), Decimal(value.denominator)).normalize(_EXACT)
    except Inexact:
        return f"{sign}{abs(value.numerator)}/{value.denominator}", Level.PRODUCT
    _, digits, exponent = number.as_tuple()
    assert isinstance(exponent, int)
    # An exponent stands for more than four zeros behind the point, and in a number of more than 16 digits.
    if exponent + len(digits) < -4 or (exponent > 0 and exponent + len(digits) > 16):
        return f"{sign}{''.join(map(str, digits))}e{exponent}", level
    return f"{sign}{number:f}", level


_PARTS: dict[type[Spanned], tuple[str, ...]] = {
    Negate: ("operand",),
    Not: ("operand",),
    **dict.fromkeys((Binary, Compare, Logic), ("left", "right")),
    Call: ("arguments",),
    Conditional: ("condition", "then", "otherwise"),
    Vector: ("entries",),
}


def operation(expr: Expr) -> str:
    """Return what a node does: its operator, its function, or else the name of its type."""
    match expr:
        case Binary() | Compare() | Logic():
            return expr.operator
        case Call():
            return expr.function
    return type(expr).__name__


def children(expr: Expr) -> tuple[Expr, ...]:
    """Return the sub-expressions of a node, left to right."""
    parts = [getattr(expr, name) for name in _PARTS.get(type(expr), ())]
    several: tuple[Expr, ...] = parts[0] if isinstance(expr, Call | Vector) else tuple(parts)
    return several


def rebuild(expr: Expr, parts: tuple[Expr, ...]) -> Expr:
    """Return the node with other sub-expressions, in the order of `children`."""
    values: tuple[Any, ...] = (parts,) if isinstance(expr, Call | Vector) else parts
    changed: dict[str, Any] = dict(zip(_PARTS.get(type(expr), ()), values, strict=True))
    return replace(expr, **changed)


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
        The tree; a part in which nothing is replaced is returned as it is.
    function
        Gives a node's replacement, into which nothing descends, or None to go on with its sub-expressions.
    """
    replacement = function(expr)
    if replacement is not None:
        return replacement
    parts = children(expr)
    changed = tuple(transform(part, function) for part in parts)
    same = all(new is old for new, old in zip(changed, parts, strict=True))
    return expr if same else rebuild(expr, changed)


def fold(expr: Expr, leaf: Callable[[Name | Number], V], operation: Callable[..., V]) -> V:
    """Return what a tree comes to.

    Parameters
    ----------
    expr
        The tree.
    leaf
        Gives what a name or a number comes to.
    operation
        Gives what any other node comes to, from the node and what its sub-expressions come to.
    """
    if isinstance(expr, Name | Number):
        return leaf(expr)
    return operation(expr, *(fold(part, leaf, operation) for part in children(expr)))
