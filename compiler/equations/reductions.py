"""What a peer hears of the others: reductions, and linear ones taken apart.

Takes: expressions that read `others`. Gives: `REDUCTIONS`, `hears_others`, `of_others`; `Of`,
`affine_in_others`.
Guarantees: c₀ + Σ cₖ·heardₖ has the value of the expression it was taken from.
Does not: know clocks or links.

What is heard is others.k, previous(others.k), the age of its packet, or age times others.k. A mean or sum of
such a form is that of each by itself, so that N peers cost N, not N².
"""

from __future__ import annotations

from dataclasses import dataclass, replace
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


def of_others(call: Call) -> bool:
    """Return whether a call is of one value that each other peer sends: its age, or what it was before."""
    argument = call.arguments[0]
    return call.function in ("age", "previous") and isinstance(argument, Name) and argument.parts[0] == OTHERS


@dataclass(frozen=True, slots=True)
class Of:
    """What is heard of the send `send`: its value unless `value` is False, times its age if `aged`.

    With `before` it is what was heard at the tick before.
    """

    send: str
    value: bool = True
    aged: bool = False
    before: bool = False

    @property
    def expression(self) -> Expr:
        """It as the language has it."""
        name = Name((OTHERS, *self.send.split(".")))
        value: Expr = Call("previous", (name,)) if self.before else name
        if not self.aged:
            return value
        age = Call("age", (name,))
        return Binary("*", age, value) if self.value else age


Affine = tuple[Expr | None, dict[Of, Expr | None]]  # constant and coefficients; None: 0, and 1


def affine_in_others(expression: Expr) -> Affine | None:
    """Return an expression as c₀ + Σ cₖ·heardₖ, or None when it is not of that form.

    c₀ is None for 0, cₖ None for 1.
    """
    if not any(name.parts[0] == OTHERS for name in names(expression)):
        return expression, {}
    match expression:
        case Name(parts=parts):
            return None, {Of(".".join(parts[1:])): None}
        case Call("age" | "previous", (Name(parts=parts),)):
            aged = expression.function == "age"
            return None, {Of(".".join(parts[1:]), value=not aged, aged=aged, before=not aged): None}
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
            if operator == "*":
                return _scaled(two, left, "*") if not one[1] else _product(one, two)
    return None


def _product(one: Affine, two: Affine) -> Affine | None:
    """Return the product of two forms that both hear: one hears nothing but ages, the other no age."""
    if all(not of.value for of in two[1]):
        one, two = two, one
    if any(of.value for of in one[1]) or any(of.aged or of.before for of in two[1]):
        return None
    found: Affine = (None, {})
    for of, factor in one[1].items():
        terms: dict[Of, Expr | None] = {replace(heard, aged=True): c for heard, c in two[1].items()}
        if two[0] is not None:
            terms[of] = two[0]
        found = _added(found, (None, terms) if factor is None else _scaled((None, terms), factor, "*"))
    return found if one[0] is None else _added(found, _scaled(two, one[0], "*"))


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
