"""The language's expressions as terms, and what is asked of terms: derivatives, pieces, linear forms.

Takes: `Expr`. Gives: `Term`; `differential`, `smooth_pieces`, `linear_form` of one.
Guarantees: functions with a corner or a jump (min, max, if, …) stay as they are.
Does not: know clocks or crossings, or which symbols move (see `index`).
"""

from __future__ import annotations

import operator
import sys
from collections.abc import Callable, Iterable, Sequence, Set

import sympy

from apc.compiler.equations.terms import (
    FUNCTIONS,
    ZERO,
    Abs,
    If,
    Max,
    Symbol,
    Term,
    in_order,
    symbol,
)
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

LARGEST = int(sys.float_info.max)
OPERATORS: dict[str, Callable[[Term, Term], Term]] = {
    "+": operator.add,
    "-": operator.sub,
    "*": operator.mul,
    "/": operator.truediv,
    "^": operator.pow,
}
BENT = (Max, Abs, sympy.Abs, sympy.sign, sympy.floor)  # beside a choice


def derivative_symbol(name: str) -> Symbol:
    """Return the symbol for the time derivative of a variable."""
    return symbol(f"der({name})")


def to_term(expression: Expr, differentiate: Callable[[Term], Term]) -> Term:
    """Build the term; `differentiate` gives the time derivative of one, for `der`."""

    def leaf(node: Name | Number) -> Term:
        if isinstance(node, Name):
            return symbol(".".join(node.parts))
        return sympy.Rational(node.value.numerator, node.value.denominator)

    def operation(node: Expr, *operands: Term) -> Term:
        match node:
            case Binary():
                return OPERATORS[node.operator](*operands)
            case Negate():
                return -operands[0]
            case Call("der"):
                return differentiate(*operands)
            case Call():
                return FUNCTIONS[node.function](*operands)
            case Conditional():
                return If(*operands)
            case Not():
                return FUNCTIONS["not"](*operands)
        assert isinstance(node, Compare | Logic)
        return FUNCTIONS[node.operator](*operands)

    return fold(expression, leaf, operation)


def no_derivative(expression: Term) -> Term:
    """Stand in for `differentiate` where `der` can't occur."""
    raise AssertionError(f"der of {expression} stands in a clocked equation")


def is_no_number(expression: Term) -> bool:
    """Return whether an expression holds a constant that no float can be: 1/0, sqrt(-1), 1e300^2."""
    return any(map(_is_none, sympy.preorder_traversal(expression)))


def _is_none(node: Term) -> bool:
    if node.is_Rational:
        return bool(abs(node.p) > LARGEST * node.q)
    if node is sympy.nan or isinstance(node, sympy.AccumBounds):
        return True
    return bool(node.is_number) and (node.is_extended_real is False or node.is_finite is False)


def slope(expression: Term, by: Symbol) -> Term:
    """Return the derivative by a symbol, that of the branch taken; what jumps is constant between jumps."""
    found = expression.diff(by)
    jumps = found.atoms(sympy.DiracDelta, sympy.Derivative, sympy.Subs)
    return found.xreplace(dict.fromkeys(jumps, ZERO)) if jumps else found


def differential(expression: Term, rate: Callable[[Symbol], Term]) -> Term:
    """Return Σ ∂expression/∂s · rate(s) over the symbols s, by the chain rule.

    Raises NoDerivativeError where a table is looked up at what moves, or from `rate`.
    """
    parts = (
        along * rate(s)
        for term in sympy.Add.make_args(expression)
        for s in in_order(term.free_symbols)
        if (along := slope(term, s)) != 0
    )
    return sympy.Add(*parts)


def derivative_size(expression: Term) -> int:
    """Return how many nodes a derivative has at most, about: each factor's stands beside all the others."""
    return _sizes(expression)[1]


def _sizes(node: Term) -> tuple[int, int]:
    """Return how many nodes a term has, and its derivative."""
    if not node.args:
        return 1, int(node.is_Symbol)
    sizes, slopes = zip(*map(_sizes, node.args), strict=True)
    whole = 1 + sum(sizes)
    return whole, sum(slopes) + (0 if node.is_Add else len(sizes) * whole)


def smooth_pieces(expressions: Sequence[Term], most: int) -> list[tuple[Term, ...]] | None:
    """Return what expressions may be between their corners and jumps, None if that is more than `most`.

    Each min and max is one of its arguments, each `if` one of its branches, abs(x) is x or −x; sign and floor
    are constant.
    """
    pieces = [tuple(expressions)]
    while bent := next((node for piece in pieces for one in piece for node in _bent(one)), None):
        if isinstance(bent, If):
            choices = bent.args[1:]
        elif isinstance(bent, Max):
            choices = bent.args
        elif isinstance(bent, Abs | sympy.Abs):
            choices = (bent.args[0], -bent.args[0])
        else:
            choices = (symbol(f"constant {bent}"),)
        pieces = list(
            dict.fromkeys(
                tuple(one.xreplace({bent: choice}) for one in piece) for piece in pieces for choice in choices
            )
        )
        if len(pieces) > most:
            return None
    return pieces


def _bent(expression: Term) -> Iterable[Term]:
    return (node for node in sympy.preorder_traversal(expression) if isinstance(node, (If, *BENT)))


LinearForm = tuple[dict[Symbol, Term], Term]


def linear_form(expression: Term, unknowns: Set[Symbol]) -> LinearForm | None:
    """Return the coefficients and the rest of Σ coefficient·unknown + rest, or None if it isn't linear."""
    functions = (one for one in expression.atoms(sympy.Function) if not isinstance(one, If))
    if any(not unknowns.isdisjoint(one.free_symbols) for one in functions):
        return None
    slopes: dict[Symbol, list[Term]] = {}
    for term in sympy.Add.make_args(expression):
        for unknown in in_order(term.free_symbols & unknowns):
            slopes.setdefault(unknown, []).append(slope(term, unknown))
    coefficients = {unknown: sympy.Add(*parts) for unknown, parts in slopes.items()}
    if any(not unknowns.isdisjoint(coefficient.free_symbols) for coefficient in coefficients.values()):
        return None
    return coefficients, expression.xreplace(dict.fromkeys(coefficients, ZERO))
