"""The compiler's terms as SymPy's expressions, for tests: an algebra that is not ours."""

from __future__ import annotations

import sympy

from apc.compiler.equations.terms import Function, Number, Product, Sum, Symbol, Term
from apc.compiler.language.expression import SMOOTH

SAME = {"abs": sympy.Abs, "atan2": sympy.atan2, **{name: getattr(sympy, name) for name in SMOOTH}}
SAME |= {"min": sympy.Min, "max": sympy.Max, "sign": sympy.sign, "floor": sympy.floor}


def as_sympy(term: Term) -> sympy.Expr:
    """Return the same in SymPy, of real symbols."""
    match term:
        case Symbol():
            return sympy.Symbol(term.name, real=True)
        case Number():
            return sympy.Rational(term.value)
        case Sum():
            terms = (sympy.Rational(factor) * as_sympy(one) for one, factor in term.terms)
            return sympy.Add(sympy.Rational(term.constant), *terms)
        case Product():
            powers = (as_sympy(base) ** sympy.Rational(exponent) for base, exponent in term.powers)
            return sympy.Mul(sympy.Rational(term.coefficient), *powers)
        case Function():
            make = SAME.get(term.name, sympy.Function(term.name))
            return make(*map(as_sympy, term.arguments))
    raise AssertionError(term)
