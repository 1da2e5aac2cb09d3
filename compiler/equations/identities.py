"""Whether an expression with functions in it is zero for all values, as sin(x)² + cos(x)² − 1 is.

Takes: terms. Gives: `is_identity`.
Guarantees: what is said to be zero is so by SymPy's simplification; SymPy is imported only for what numbers
at random can't tell from zero.
Does not: find every identity, or look at expressions of more than `MOST` nodes.
"""

from __future__ import annotations

import math
import random
from fractions import Fraction
from typing import Any

from apc.compiler.equations.terms import Function, Number, Product, Sum, Symbol, Term, constant, number
from apc.compiler.language.expression import SMOOTH

# Nodes beyond which no identity is looked for: simplifying takes its time.
MOST = 200

# Points at which it must vanish, and how nearly, beside the values of its parts.
POINTS, NEARLY = 4, 1e-9


def is_identity(expression: Term) -> bool:
    """Say whether an expression is zero for all values of its symbols, by what functions have in common.

    Parameters
    ----------
    expression
        One that isn't zero by its rational operations alone.
    """
    functions = [node for node in expression.walk() if isinstance(node, Function)]
    if expression.size > MOST or not functions or any(one.name not in SMOOTH for one in functions):
        return False
    chance = random.Random(0)
    symbols = sorted(expression.free_symbols, key=str)
    for _ in range(POINTS):
        values: dict[Any, Term] = {one: number(Fraction(chance.randrange(1, 999), 499)) for one in symbols}
        parts = expression.replace(values).parts or (expression.replace(values),)
        size = max((abs(constant(part)) for part in parts), default=0.0)
        found = constant(expression.replace(values))
        if not math.isfinite(found) or abs(found) > NEARLY * max(size, 1.0):
            return False
    import sympy  # for the few expressions that come so far

    asked = _to_sympy(expression, sympy)
    return any(sympy.simplify(one) == 0 for one in (asked, asked.rewrite(sympy.exp)))


def _to_sympy(term: Term, sympy: Any) -> Any:
    match term:
        case Symbol():
            return sympy.Symbol(str(term), real=True)
        case Number():
            return sympy.Rational(term.value.numerator, term.value.denominator)
        case Sum():
            whole = sympy.Rational(term.constant.numerator, term.constant.denominator)
            return whole + sum(
                sympy.Rational(factor.numerator, factor.denominator) * _to_sympy(part, sympy)
                for part, factor in term.terms
            )
        case Product():
            found = sympy.Rational(term.coefficient.numerator, term.coefficient.denominator)
            for base, exponent in term.powers:
                power = sympy.Rational(exponent.numerator, exponent.denominator)
                found *= _to_sympy(base, sympy) ** power
            return found
    assert isinstance(term, Function)
    return getattr(sympy, term.name)(*(_to_sympy(one, sympy) for one in term.arguments))
