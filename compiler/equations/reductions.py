"""What a peer hears of the others: reductions, and linear ones taken apart.

Takes: expressions that read `others`. Gives: `REDUCTIONS`, `hears_others`, `affine_in_others`.
Guarantees: c₀ + Σ cₖ·others.k has the value of the expression it was taken from.
Does not: know clocks or links.

A mean or sum of such a form is that of each others.k by itself, so that N peers cost N, not N².
"""

from __future__ import annotations

from fractions import Fraction

from apc.compiler.components.component import OTHERS
from apc.compiler.language.expression import (
    Binary,
    Call,
    Expr,
    Name,
    Negate,
    Number,
    names,
)

REDUCTIONS = ("mean", "sum", "max", "min", "count")


def hears_others(call: Call) -> bool:
    """Return whether a call reduces the other peers to one value; max(a, b) is of two values, and doesn't."""
    return (
        call.function in REDUCTIONS
        and len(call.arguments) == 1
        and any(name.parts[0] == OTHERS for name in names(call))
    )


Affine = tuple[Expr | None, dict[str, Expr | None]]  # constant and coefficients; None: 0, and 1


def affine_in_others(expression: Expr) -> Affine | None:
    """Return an expression as c₀ + Σ cₖ·others.k, or None when it is not of that form.

    c₀ is None for 0, cₖ None for 1; k is the name of what is sent.
    """
    if not any(name.parts[0] == OTHERS for name in names(expression)):
        return expression, {}
    match expression:
        case Name(parts=parts):
            return None, {".".join(parts[1:]): None}
        case Negate(operand=operand):
            inside = affine_in_others(operand)
            return None if inside is None else _scaled(inside, Number(Fraction(-1)), "*")
        case Binary(operator="+" | "-" as operator, left=left, right=right):
            one, two = affine_in_others(left), affine_in_others(right)
            if one is None or two is None:
                return None
            return _added(one, two if operator == "+" else _scaled(two, Number(Fraction(-1)), "*"))
        case Binary(operator="*" | "/" as operator, left=left, right=right):
            one, two = affine_in_others(left), affine_in_others(right)
            if one is None or two is None:
                return None
            if not two[1]:
                return _scaled(one, right, operator)
            return _scaled(two, left, "*") if operator == "*" and not one[1] else None
    return None


def _scaled(affine: Affine, factor: Expr, operator: str) -> Affine:
    def scaled(expression: Expr | None) -> Expr:
        if expression is None:
            return factor if operator == "*" else Binary("/", Number(Fraction(1)), factor)
        return Binary(operator, expression, factor)

    constant, terms = affine
    return (None if constant is None else scaled(constant)), {name: scaled(c) for name, c in terms.items()}


def _added(one: Affine, two: Affine) -> Affine:
    def added(a: Expr | None, b: Expr | None, nothing: Expr) -> Expr:
        return Binary("+", a or nothing, b or nothing)

    unit = Number(Fraction(1))
    constant = one[0] if two[0] is None else two[0] if one[0] is None else Binary("+", one[0], two[0])
    terms = dict(one[1])
    for name, coefficient in two[1].items():
        terms[name] = added(terms[name], coefficient, unit) if name in terms else coefficient
    return constant, terms
