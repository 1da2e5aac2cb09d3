"""A nonlinear loop torn: few unknowns guessed, the others computed from them one by one.

Takes: the equations of a loop and its unknowns. Gives: `tear`, an `ImplicitBlock`.
Guarantees: an unknown that is computed stands linearly in its equation, with a factor that is free of the
loop's unknowns and isn't zero for all values.
Does not: find the fewest guesses there could be (that is NP-hard), or iterate.

Tearing: Elmqvist and Otter, Methods for tearing systems of equations in object-oriented modeling, 1994.
"""

from __future__ import annotations

import functools
from collections.abc import Sequence

from apc.compiler.equations.residuals import Residual
from apc.compiler.equations.solution import Assignment, ImplicitBlock
from apc.compiler.equations.symbolic import linear_form
from apc.compiler.equations.terms import Symbol, Term
from apc.compiler.equations.zero_test import Divisors


def tear(block: Sequence[Residual], unknowns: Sequence[Symbol], divisors: Divisors) -> ImplicitBlock:
    """Guess as few unknowns as simply found, so that the others follow one by one.

    When no equation computes an unknown, the open unknown in most of the open equations is torn, of several
    the one that fewest of them could compute.

    Parameters
    ----------
    block, unknowns
        As many equations as unknowns, of one strongly connected component.
    divisors
        What may be divided by.
    """
    members = frozenset(unknowns)
    holds = [residual.expression.free_symbols & members for residual in block]

    @functools.cache
    def solved(i: int, unknown: Symbol) -> Term | None:
        """Return an unknown by an equation, None where it can't be told from that."""
        form = linear_form(block[i].expression, frozenset((unknown,)))
        factor = form and form[0].get(unknown)
        if not form or factor is None or factor.free_symbols & members or divisors.is_zero(factor):
            return None
        return -form[1] / factor

    def gain(unknown: Symbol) -> tuple[int, int]:
        rows = [i for i in left if unknown in holds[i]]
        return len(rows), -sum(solved(i, unknown) is not None for i in rows)

    left, remaining = dict.fromkeys(range(len(block))), dict.fromkeys(unknowns)
    inner: list[Assignment] = []
    torn: list[Symbol] = []
    while remaining:
        single = ((i, *still) for i in left if len(still := holds[i] & remaining.keys()) == 1)
        ready = next(((i, unknown) for i, unknown in single if solved(i, unknown) is not None), None)
        if ready is None:
            torn.append(max(remaining, key=gain))
            del remaining[torn[-1]]
        else:
            inner.append((ready[1].name, solved(*ready)))
            del left[ready[0]], remaining[ready[1]]
    return ImplicitBlock(
        tuple(u.name for u in unknowns),
        tuple(u.name for u in torn),
        tuple(inner),
        tuple(block[i].expression for i in left),
        tuple(residual.shown for residual in block),
    )
