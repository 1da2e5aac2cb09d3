"""Expressions of parameters over many values at once.

Takes: a tree, and the values of its names: numbers, or rows of numbers (k,), real or complex.
Gives: `compute_rows`.
Guarantees: floats; of complex steps the imaginary part comes out as the derivative.
Does not: check values, or choose what is computed with (see `rows`).
"""

from __future__ import annotations

import functools
import operator
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np

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


def compute_rows(tree: Expr, value_of: Callable[[str], Any]) -> Any:
    """Return an expression's value for all values of its names at once; `value_of` gives a name's."""
    with np.errstate(all="ignore"):
        return compute(tree, _Rows(value_of))


@dataclass(frozen=True, slots=True)
class _Rows:
    """NumPy's numbers and arrays as an arithmetic: both branches are computed, then chosen from."""

    value_of: Callable[[str], Any]

    def literal(self, value: Fraction) -> Any:
        return float(value)

    def named(self, node: Name) -> Any:
        return self.value_of(".".join(node.parts))

    def operation(self, node: Operation) -> Callable[..., Any]:
        match node:
            case Negate():
                return operator.neg
            case Not():
                return np.logical_not
            case Binary("/"):
                return np.true_divide
            case Binary("^"):
                return _power
            case Binary() | Compare():
                return OPERATORS[node.operator]
            case Call() if node.function in _EXTREMES:
                return lambda *operands: functools.reduce(_EXTREMES[node.function], operands)
            case Call():
                return _FUNCTIONS[node.function]

    def joined(self, node: Logic, left: Any, right: Callable[[], Any]) -> Any:
        return (np.logical_and if node.operator == "and" else np.logical_or)(left, right())

    def chosen(
        self, node: Conditional, condition: Any, then: Callable[[], Any], otherwise: Callable[[], Any]
    ) -> Any:
        return np.where(condition, then(), otherwise())


_EXTREMES: dict[str, Callable[[Any, Any], Any]] = {"max": np.maximum, "min": np.minimum}

_FUNCTIONS: dict[str, Callable[[Any], Any]] = {
    # Of a complex step, the imaginary part is a derivative and follows the real part.
    "abs": lambda value: np.where(np.real(value) < 0, -value, value),
    "sign": lambda value: np.sign(np.real(value)),
    "floor": lambda value: np.floor(np.real(value)),
    "sqrt": np.sqrt,
    "exp": np.exp,
    "log": np.log,
    "sin": np.sin,
    "cos": np.cos,
    "tanh": np.tanh,
}


def _power(base: Any, exponent: Any) -> Any:
    """Return base^exponent; of a complex step, with the derivative as imaginary part."""
    value = np.float_power(np.real(base), np.real(exponent))
    if not (np.iscomplexobj(base) or np.iscomplexobj(exponent)):
        return value
    b, e = np.real(base), np.real(exponent)
    slope = e * np.float_power(b, e - 1) * np.imag(base)
    growing = np.imag(exponent)
    if np.any(growing):
        slope = slope + value * np.log(b) * growing
    return value + 1j * slope
