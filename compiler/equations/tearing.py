"""A nonlinear loop torn: few unknowns guessed, the others computed from them one by one.

Takes: the equations of a loop and its unknowns. Gives: `tear`, an `ImplicitBlock`.
Guarantees: an unknown that is computed stands linearly in its equation, with a factor that is free of the
loop's unknowns and isn't zero for all values.
Does not: find the fewest guesses there could be (that is NP-hard), or iterate.

Tearing: Elmqvist and Otter, Methods for tearing systems of equations in object-oriented modeling, 1994.
"""

from __future__ import annotations

from collections.abc import Sequence

from apc.compiler.equations.residuals import Residual
from apc.compiler.equations.solution import Assignment, ImplicitBlock
from apc.compiler.equations.symbolic import linear_form
from apc.compiler.equations.terms import Symbol, Term
from apc.compiler.equations.zero_test import ZeroTest


def tear(block: Sequence[Residual], unknowns: Sequence[Symbol], is_zero: ZeroTest) -> ImplicitBlock:
    """Guess as few unknowns as simply found, so that the others follow one by one.

    When no equation computes an unknown, the open unknown in most of the open equations is torn, of several
    the one that fewest of them could compute.

    Parameters
    ----------
    block, unknowns
        As many equations as unknowns, of one strongly connected component.
    is_zero
        Whether an expression is zero for all values.
    """
    loop = _Loop(block, unknowns, is_zero)
    while loop.open:
        loop.compute()
        if loop.open:
            loop.guess()
    assert len(loop.left) == len(loop.torn), "a matched block has as many equations as unknowns"
    return ImplicitBlock(
        tuple(u.name for u in unknowns),
        tuple(u.name for u in loop.torn),
        tuple(loop.inner),
        tuple(block[i].expression for i in loop.left),
        tuple(residual.shown for residual in block),
    )


class _Loop:
    """The equations that are left, the unknowns that are open, and what was computed and guessed so far."""

    def __init__(self, block: Sequence[Residual], unknowns: Sequence[Symbol], is_zero: ZeroTest) -> None:
        self.block = block
        members = frozenset(unknowns)
        self.holds = [set(residual.expression.free_symbols & members) for residual in block]  # open ones
        self.standing: dict[Symbol, list[int]] = {u: [] for u in unknowns}
        for i, these in enumerate(self.holds):
            for u in these:
                self.standing[u].append(i)
        self.ready = [i for i, these in enumerate(self.holds) if len(these) == 1]
        self.left = dict.fromkeys(range(len(block)))
        self.open = dict.fromkeys(unknowns)
        self.inner: list[Assignment] = []
        self.torn: list[Symbol] = []

        def solvable(coefficient: Term) -> bool:
            return members.isdisjoint(coefficient.free_symbols) and not is_zero(coefficient)

        self.computable: dict[Symbol, set[int]] = {u: set() for u in unknowns}
        for i, residual in enumerate(block):
            for u in self.holds[i]:
                form = linear_form(residual.expression, frozenset((u,)))
                if form is not None and u in form[0] and solvable(form[0][u]):
                    self.computable[u].add(i)

    def compute(self) -> None:
        """Compute every unknown that is the only open one of an equation that can compute it."""
        while self.ready:
            i = self.ready.pop(0)
            if i not in self.left or len(self.holds[i]) != 1:
                continue
            [unknown] = self.holds[i]
            if i not in self.computable[unknown]:
                continue
            form = linear_form(self.block[i].expression, frozenset((unknown,)))
            assert form is not None
            self.inner.append((unknown.name, -form[1] / form[0][unknown]))
            del self.left[i]
            self._close(unknown)

    def guess(self) -> None:
        """Tear the unknown that helps most."""
        unknown = max(self.open, key=self._gain)
        self.torn.append(unknown)
        self._close(unknown)

    def _gain(self, unknown: Symbol) -> tuple[int, int]:
        rows = [i for i in self.standing[unknown] if i in self.left]
        return len(rows), -sum(i in self.computable[unknown] for i in rows)

    def _close(self, unknown: Symbol) -> None:
        del self.open[unknown]
        for i in self.standing[unknown]:
            self.holds[i].discard(unknown)
            if i in self.left and len(self.holds[i]) == 1:
                self.ready.append(i)
