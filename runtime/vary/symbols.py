"""Expressions of parameters as CasADi's.

Takes: a tree, and the values of its names: numbers, or symbols of CasADi.
Gives: `compute_symbols`.
Guarantees: the same operations as in floats.
Does not: write the equations of a scene (see `casadi_writer`).
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi

from apc.compiler.language.evaluation import OPERATORS, Operation, compute
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
)


def compute_symbols(tree: Expr, value_of: Callable[[str], Any]) -> Any:
    """Return an expression's value, of names some of which are symbols; `value_of` gives a name's."""
    return compute(tree, _Symbols(value_of))


@dataclass(frozen=True, slots=True)
class _Symbols:
    """CasADi's expressions as an arithmetic."""

    value_of: Callable[[str], Any]

    def literal(self, value: Fraction) -> Any:
        return casadi.SX(float(value))

    def named(self, node: Name) -> Any:
        return self.value_of(".".join(node.parts))

    def operation(self, node: Operation) -> Callable[..., Any]:
        match node:
            case Negate():
                return lambda one: -one
            case Not():
                return casadi.logic_not
            case Binary("^"):
                return casadi.power
            case Binary() | Compare():
                return OPERATORS[node.operator]
            case Call():
                return _FUNCTIONS[node.function]

    def joined(self, node: Logic, left: Any, right: Callable[[], Any]) -> Any:
        return (casadi.logic_and if node.operator == "and" else casadi.logic_or)(left, right())

    def chosen(
        self, node: Conditional, condition: Any, then: Callable[[], Any], otherwise: Callable[[], Any]
    ) -> Any:
        return casadi.if_else(condition, then(), otherwise())


def _folded(pair: Callable[[Any, Any], Any]) -> Callable[..., Any]:
    def fold(first: Any, *others: Any) -> Any:
        for one in others:
            first = pair(first, one)
        return first

    return fold


_FUNCTIONS: dict[str, Callable[..., Any]] = {
    "max": _folded(casadi.fmax),
    "min": _folded(casadi.fmin),
    "abs": casadi.fabs,
    "sign": casadi.sign,
    "floor": casadi.floor,
    "sqrt": casadi.sqrt,
    "exp": casadi.exp,
    "log": casadi.log,
    "sin": casadi.sin,
    "cos": casadi.cos,
    "tanh": casadi.tanh,
}
