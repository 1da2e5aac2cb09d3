"""The language's expressions as SymPy expressions.

Takes: `Expr`. Gives: `sympy.Expr`, by building nodes; no text is ever parsed by SymPy.
Guarantees: functions whose SymPy versions would search for simplifications (min, max, if, …) stay opaque.
Does not: know clocks or crossings.
"""

from __future__ import annotations

from collections.abc import Callable

import sympy

from apc.compiler.expression import (
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
)

# Smooth functions are SymPy's own; the others are opaque heads that only `functions` gives a meaning.
SMOOTH: dict[str, Callable[[sympy.Expr], sympy.Expr]] = {
    "sqrt": sympy.sqrt,
    "exp": sympy.exp,
    "log": sympy.log,
    "sin": sympy.sin,
    "cos": sympy.cos,
    "tanh": sympy.tanh,
}
OPAQUE = ("min", "max", "abs", "sign", "floor")
COMPARISONS = {
    "<": "less",
    "<=": "less_or_equal",
    ">": "more",
    ">=": "more_or_equal",
    "==": "equal",
    "!=": "unequal",
}


def head(name: str) -> sympy.core.function.UndefinedFunction:
    """Return the opaque function of this name."""
    return sympy.Function(name)


def symbol(name: str) -> sympy.Symbol:
    """Return the real symbol of this name; the same name always gives the same symbol."""
    return sympy.Symbol(name, real=True)


def derivative_symbol(name: str) -> sympy.Symbol:
    """Return the symbol for the time derivative of a variable."""
    return symbol(f"der({name})")


def to_sympy(expression: Expr, differentiate: Callable[[sympy.Expr], sympy.Expr]) -> sympy.Expr:
    """Build the SymPy expression; `differentiate` gives the time derivative of one, for `der`."""

    def build(node: Expr) -> sympy.Expr:
        match node:
            case Number(value=value):
                return sympy.Rational(value.numerator, value.denominator)
            case Name(parts=parts):
                return symbol(".".join(parts))
            case Negate(operand=operand):
                return -build(operand)
            case Binary(operator=operator, left=left, right=right):
                return _binary(operator, build(left), build(right))
            case Compare(operator=operator, left=left, right=right):
                return head(COMPARISONS[operator])(build(left), build(right))
            case Logic(operator=operator, left=left, right=right):
                return head(operator)(build(left), build(right))
            case Not(operand=operand):
                return head("not")(build(operand))
            case Conditional(condition=condition, then=then, otherwise=otherwise):
                return head("if")(build(condition), build(then), build(otherwise))
            case Call(function="der", arguments=arguments):
                return differentiate(build(arguments[0]))
            case Call(function=function, arguments=arguments):
                values = [build(argument) for argument in arguments]
                smooth = SMOOTH.get(function)
                return smooth(*values) if smooth else head(function)(*values)
        raise AssertionError(f"no SymPy form of {node!r}")

    return build(expression)


def _binary(operator: str, left: sympy.Expr, right: sympy.Expr) -> sympy.Expr:
    match operator:
        case "+":
            return left + right
        case "-":
            return left - right
        case "*":
            return left * right
        case "/":
            return left / right
    return left**right


def is_opaque_in(expression: sympy.Expr, unknown: sympy.Symbol) -> bool:
    """Return whether the unknown stands inside an opaque function of the expression."""
    return any(unknown in call.free_symbols for call in expression.atoms(sympy.core.function.AppliedUndef))
