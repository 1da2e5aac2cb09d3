"""Expressions of parameters as formulas, and what they come to.

Takes: an `Expr` tree, and what its names stand for.
Gives: `formula_of`; `Value`, `evaluate`.
Guarantees: a formula has an operation or a few for each node, and keeps the exact numbers of its text;
`evaluate` computes by the same operations.
Does not: know units, or values that change with time or with the peers.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from functools import reduce
from typing import Any, NoReturn

from apc.compiler.compiled import Formula
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.formula import FaultError, exactly
from apc.compiler.language.expression import (
    SMOOTH,
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
    fold,
    format_expression,
    walk,
)
from apc.compiler.language.grammar import parse_expression
from apc.compiler.plain import PlainFunction
from apc.compiler.words import cut

Value = Fraction | float

_OPERATORS = {
    "+": "add",
    "-": "sub",
    "*": "mul",
    "/": "div",
    "^": "pow",
    "<": "lt",
    "<=": "le",
    "==": "eq",
    "!=": "ne",
    "and": "and",
    "or": "or",
}
_TURNED = {">": "lt", ">=": "le"}  # the same with its sides exchanged
_FUNCTIONS = {
    "abs": "fabs",
    "max": "fmax",
    "min": "fmin",
    **{name: name for name in ("sign", "floor", "sqrt", "atan2", *SMOOTH)},
}


def formula_of(expr: Expr) -> Formula:
    """Return an expression as a formula.

    Raises
    ------
    ApcError
        E332 a function that has no value in a parameter.
    """
    text = format_expression(expr)
    place = Place("an expression", 1, 1, text)
    listed = _listed(parse_expression(text, place), place)
    spans = tuple((node.start, node.end) for node in listed.nodes)
    return Formula(text, listed.names, listed.numbers, listed.function, spans)


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
        `float` after `sqrt`, `exp`, … (the square root of a square is exact). A condition that holds is 1.

    Raises
    ------
    ApcError
        E330 a name without a value, E331 no finite real value, E332 a function that has none in a parameter.
    """
    where = place or Place("an expression")
    listed = _listed(expr, where)
    values: list[Any] = []
    for name, node in zip(listed.names, listed.nodes, strict=False):
        try:
            values.append(lookup(tuple(name.split("."))))
        except KeyError:
            _fail(where, node, "E330", f"{name} has no value here")
    try:
        found: Value = exactly(listed.function, [*values, *listed.numbers])
    except FaultError as fault:
        node = listed.nodes[fault.place]
        _fail(where, node, "E331", f"{cut(format_expression(node))} {fault.words}")
    return found


def _fail(place: Place, node: Expr, code: str, what: str) -> NoReturn:
    # Without the text we can only trust a column that exists.
    line = place.source_line
    fits = not line or place.column + node.start <= len(line)
    raise ApcError(Mistake(code, place.shifted(node.start) if fits else place, what))


@dataclass(frozen=True, slots=True)
class _Listed:
    """A function of an expression's names and numbers, and the node of each value, these first."""

    names: tuple[str, ...]
    numbers: tuple[Fraction, ...]
    function: PlainFunction
    nodes: tuple[Expr, ...]


def _listed(expr: Expr, place: Place) -> _Listed:
    """Return the operations of an expression, in the order in which they stand."""
    names: dict[str, Expr] = {}
    numbers: dict[Fraction, Expr] = {}
    for node in walk(expr):
        if isinstance(node, Name):
            names.setdefault(".".join(node.parts), node)
        elif isinstance(node, Number):
            numbers.setdefault(node.value, node)
    place_of = {key: k for k, key in enumerate((*names, *numbers))}
    nodes: list[Expr] = [*names.values(), *numbers.values()]
    operations: list[tuple[Any, ...]] = []

    def leaf(node: Name | Number) -> int:
        return place_of[".".join(node.parts) if isinstance(node, Name) else node.value]

    def operation(node: Expr, *operands: int) -> int:
        def add(word: str, *places: int) -> int:
            operations.append((word, *places))
            nodes.append(node)
            return len(nodes) - 1

        match node:
            case Negate():
                return add("neg", *operands)
            case Not():
                return add("not", *operands)
            case Compare() if node.operator in _TURNED:
                return add(_TURNED[node.operator], *reversed(operands))
            case Binary() | Compare() | Logic():
                return add(_OPERATORS[node.operator], *operands)
            case Call() if node.function in _FUNCTIONS:
                word = _FUNCTIONS[node.function]
                if node.function in ("max", "min"):
                    return reduce(lambda one, other: add(word, one, other), operands)
                return add(word, *operands)
            case Conditional():
                holds, then, otherwise = operands
                taken, left = add("if_else_zero", holds, then), add("not", holds)
                return add("add", taken, add("if_else_zero", left, otherwise))
        assert isinstance(node, Call)
        what = f"{node.function}(…) changes with time or with the peers: a parameter cannot hold it"
        return _fail(place, node, "E332", what)

    result = fold(expr, leaf, operation)
    inputs = (("p", len(names)), ("c", len(numbers)))
    function = PlainFunction(inputs, (), tuple(operations), ((result,),))
    return _Listed(tuple(names), tuple(numbers), function, tuple(nodes))
