"""The language's expressions as SymPy expressions.

Takes: `Expr`. Gives: `sympy.Expr`, by building nodes; no text is ever parsed by SymPy.
Guarantees: functions whose SymPy versions would search for simplifications (min, max, if, …) stay opaque.
Does not: know clocks or crossings, or which symbols move (see `index`).
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Set

import sympy

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
    Number,
    fold,
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
ARITHMETIC: dict[str, Callable[[sympy.Expr, sympy.Expr], sympy.Expr]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "^": operator.pow,
}
COMPARISONS = {
    "<": "less",
    "<=": "less_or_equal",
    ">": "more",
    ">=": "more_or_equal",
    "==": "equal",
    "!=": "unequal",
}


LARGEST = int(sys.float_info.max)
NO_FLOATS = frozenset({sympy.zoo, sympy.nan, sympy.oo, -sympy.oo, sympy.I})


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

    def leaf(node: Name | Number) -> sympy.Expr:
        if isinstance(node, Name):
            return symbol(".".join(node.parts))
        return sympy.Rational(node.value.numerator, node.value.denominator)

    def operation(node: Expr, *operands: sympy.Expr) -> sympy.Expr:
        match node:
            case Negate():
                return -operands[0]
            case Binary():
                return ARITHMETIC[node.operator](*operands)
            case Compare():
                return head(COMPARISONS[node.operator])(*operands)
            case Not():
                return head("not")(*operands)
            case Logic():
                return head(node.operator)(*operands)
            case Conditional():
                return head("if")(*operands)
            case Call("der"):
                return differentiate(*operands)
        assert isinstance(node, Call)
        return (SMOOTH.get(node.function) or head(node.function))(*operands)

    return fold(expression, leaf, operation)


def is_no_number(expression: sympy.Expr) -> bool:
    """Return whether an expression holds a constant that no float can be: 1/0, sqrt(-1), 1e300^2."""
    return any(map(_no_float, sympy.preorder_traversal(expression)))


def _no_float(part: sympy.Basic) -> bool:
    """Return whether a part of an expression is by itself a constant that no float can be."""
    if part.is_Rational:
        return bool(abs(part.p) > LARGEST * part.q)
    if part.is_Pow:
        return bool(part.is_number and part.is_real is False)
    return part in NO_FLOATS


class NoDerivativeError(Exception):
    """A value was to be differentiated that has no derivative, because it jumps or bends: which, and why."""

    def __init__(self, what: str, why: str) -> None:
        super().__init__(f"{what}, {why}")


def differential(expression: sympy.Expr, rate: Callable[[sympy.Symbol], sympy.Expr]) -> sympy.Expr:
    """Return Σ ∂expression/∂s · rate(s) over the symbols s, by the chain rule.

    Where min, max, abs and if have a corner, the derivative is that of the branch taken; sign, floor and
    conditions are constant between their jumps. Raises NoDerivativeError for other opaque functions.
    """

    def go(node: sympy.Expr) -> sympy.Expr:
        if node.is_Symbol:
            return rate(node)
        if not node.args:
            return sympy.S.Zero
        if node.is_Add:
            return sympy.Add(*(go(term) for term in node.args))
        if node.is_Mul:
            return sympy.Add(
                *(
                    sympy.Mul(slope, *node.args[:place], *node.args[place + 1 :])
                    for place, factor in enumerate(node.args)
                    if (slope := go(factor)) != 0
                )
            )
        if node.is_Pow and node.exp.is_Number:
            return node.exp * node.base ** (node.exp - 1) * go(node.base)
        return of_function(node.func.__name__, node)

    def of_function(name: str, node: sympy.Expr) -> sympy.Expr:
        if name == "if":
            condition, then, otherwise = node.args
            return _choice(condition, go(then), go(otherwise))
        if name in ("min", "max"):
            best, slope = node.args[0], go(node.args[0])
            for argument in node.args[1:]:
                order = (best, argument) if name == "min" else (argument, best)
                slope = _choice(head("less_or_equal")(*order), slope, go(argument))
                best = head(name)(best, argument)
            return slope
        if name.lower() == "abs":
            slope = go(node.args[0])
            return slope and head("sign")(node.args[0]) * slope
        if name in SMOOTH:
            slope = go(node.args[0])
            return slope and node.fdiff(1) * slope
        if name in ("sign", "floor"):
            return sympy.S.Zero
        why = "a value that jumps at its ticks" if name in ("hold", "sample") else "which has none"
        raise NoDerivativeError(str(node), why)

    return go(expression)


def smooth_pieces(expression: sympy.Expr, most: int) -> list[sympy.Expr] | None:
    """Return what an expression may be between its corners and jumps, None if that is more than `most`.

    Each min and max is one of its arguments, each `if` one of its branches, abs(x) is x or −x; sign and floor
    are constant.
    """
    pieces = [expression]
    while True:
        bent = next((node for node in sympy.preorder_traversal(sympy.Tuple(*pieces)) if _is_bent(node)), None)
        if bent is None:
            return pieces
        match bent.func.__name__:
            case "if":
                choices = bent.args[1:]
            case "min" | "max":
                choices = bent.args
            case "abs" | "Abs":
                choices = (bent.args[0], -bent.args[0])
            case _:
                choices = (sympy.Dummy(real=True),)
        pieces = list(dict.fromkeys(one.xreplace({bent: choice}) for one in pieces for choice in choices))
        if len(pieces) > most:
            return None


def _is_bent(node: sympy.Basic) -> bool:
    return node.func.__name__ in ("if", "min", "max", "abs", "Abs", "sign", "floor")


def _choice(condition: sympy.Expr, then: sympy.Expr, otherwise: sympy.Expr) -> sympy.Expr:
    return then if then == otherwise else head("if")(condition, then, otherwise)


LinearForm = tuple[dict[sympy.Symbol, sympy.Expr], sympy.Expr]


def linear_form(expression: sympy.Expr, unknowns: Set[sympy.Symbol]) -> LinearForm | None:
    """Return the coefficients and the rest of Σ coefficient·unknown + rest, or None if it isn't linear.

    Reads the terms as they stand: no differentiation, no expansion, so its cost is the expression's size.
    """
    if unknowns.isdisjoint(expression.free_symbols):
        return {}, expression
    if expression.is_Symbol:
        return {expression: sympy.S.One}, sympy.S.Zero
    if expression.is_Add:
        forms = [linear_form(term, unknowns) for term in expression.args]
        if any(form is None for form in forms):
            return None
        known = [form for form in forms if form is not None]
        parts: dict[sympy.Symbol, list[sympy.Expr]] = {}
        for coefficients, _ in known:
            for unknown, coefficient in coefficients.items():
                parts.setdefault(unknown, []).append(coefficient)
        return {u: sympy.Add(*terms) for u, terms in parts.items()}, sympy.Add(*(rest for _, rest in known))
    if expression.is_Mul:
        moving = [factor for factor in expression.args if not unknowns.isdisjoint(factor.free_symbols)]
        form = linear_form(moving[0], unknowns) if len(moving) == 1 else None
        if form is None:
            return None
        scale = sympy.Mul(*(factor for factor in expression.args if factor is not moving[0]))
        return {u: scale * coefficient for u, coefficient in form[0].items()}, scale * form[1]
    if expression.func.__name__ == "if" and unknowns.isdisjoint(expression.args[0].free_symbols):
        condition, *branches = expression.args
        then, otherwise = (linear_form(branch, unknowns) for branch in branches)
        if then is None or otherwise is None:
            return None
        zero = sympy.S.Zero
        names = dict.fromkeys((*then[0], *otherwise[0]))
        return {
            u: _choice(condition, then[0].get(u, zero), otherwise[0].get(u, zero)) for u in names
        }, _choice(condition, then[1], otherwise[1])
    return None


def no_derivative(expression: sympy.Expr) -> sympy.Expr:
    """Stand in for `differentiate` where `der` can't occur."""
    raise AssertionError(f"der of {expression} stands in a clocked equation")
