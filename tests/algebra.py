"""The compiler's terms as SymPy has them where it has a function of its own, for tests."""

from __future__ import annotations

import sympy

from apc.compiler.equations.terms import Max, Min, Term


def as_sympy(term: Term) -> sympy.Expr:
    """Return the same with SymPy's functions."""
    return term.replace(Min, sympy.Min).replace(Max, sympy.Max)
