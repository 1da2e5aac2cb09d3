"""Which equation computes which unknown, in which order, and how each block of them is solved.

Takes: equations as residuals, and the unknowns. Gives: `solve_blocks`: assignments and `ImplicitBlock`s.
Guarantees: every unknown is assigned once, from what was assigned before; linear blocks come out explicit.
Does not: differentiate anything (see `index`), or know of states and clocks.

Matched and sorted by `matching`, the usual way of Modelica compilers (Cellier and Kofman, Continuous System
Simulation, ch. 7); a block of linear equations is solved by `elimination`, a nonlinear loop is left to an
iteration over the few unknowns that `tearing` chooses.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import sympy
from sympy.matrices import dotprodsimp

from apc.compiler.equations.elimination import eliminate
from apc.compiler.equations.matching import match_columns, strong_components
from apc.compiler.equations.residuals import (
    MOST_LISTED,
    SCENE,
    Residual,
    listed,
    report_no_number,
    report_singular,
)
from apc.compiler.equations.solution import Step, expressions
from apc.compiler.equations.symbolic import is_no_number, linear_form, slope, smooth_pieces
from apc.compiler.equations.tearing import tear
from apc.compiler.equations.terms import NoDerivativeError, Symbol, Term, symbol
from apc.compiler.equations.zero_test import Divisors
from apc.compiler.errors import Mistakes, Place

# A loop of more guesses, or with more pieces between its corners, is not asked whether it has one solution.
MOST_GUESSES, MOST_PIECES = 3, 64


def solve_blocks(
    residuals: Sequence[Residual],
    unknowns: Sequence[Symbol],
    where: str,
    mistakes: Mistakes,
    divisors: Divisors | None = None,
    place: Place = SCENE,
) -> tuple[Step, ...]:
    """Match, sort and solve.

    Parameters
    ----------
    residuals, unknowns
        As many equations as unknowns; a mistake if not.
    where
        What to call the equations in a message: "the continuous equations".
    mistakes
        Takes E502 equations or unknowns left over, E503 a loop without an unknown to solve for, E511 linear
        equations that depend on each other, E512 what is no number.
    divisors
        What may be divided by.
    place
        Where to point when there is no equation.
    """
    columns = {unknown: j for j, unknown in enumerate(unknowns)}
    incidence = [sorted(columns[s] for s in r.expression.free_symbols & columns.keys()) for r in residuals]
    match = match_columns(incidence, len(unknowns))
    if len(residuals) != len(unknowns) or None in match:
        report_singular(residuals, [u.name for u in unknowns], incidence, match, where, mistakes, place)
        return ()
    # Row i needs the rows that compute its other unknowns.
    needs = [
        [row for j in held if (row := match[j]) is not None and row != i] for i, held in enumerate(incidence)
    ]
    solver = _Solver(where, mistakes, divisors or Divisors())
    steps: list[Step] = []
    for block in map(set, strong_components(needs)):
        own = [unknown for unknown, row in zip(unknowns, match, strict=True) if row in block]
        steps += solver.checked([residuals[row] for row in sorted(block)], own)
    return tuple(steps)


@dataclass(frozen=True, slots=True)
class _Solver:
    """Solves blocks; keeps what they share: what may be divided by, and where mistakes go."""

    where: str
    mistakes: Mistakes
    divisors: Divisors

    def checked(self, block: Sequence[Residual], unknowns: Sequence[Symbol]) -> list[Step]:
        """Solve one block; its expressions must be numbers: what was divided may cancel."""
        steps = self.solve(block, unknowns)
        if any(is_no_number(expression) for step in steps for expression in expressions(step)):
            report_no_number(block, self.mistakes)
            return []
        return steps

    def solve(self, block: Sequence[Residual], unknowns: Sequence[Symbol]) -> list[Step]:
        """Return what gives the unknowns of one block, explicit where it is linear in them."""
        known = frozenset(unknowns)
        forms = [linear_form(residual.expression, known) for residual in block]
        linear = [form for form in forms if form is not None]
        if len(linear) < len(forms):
            return self._loop(block, unknowns)
        steps, free = eliminate(linear, unknowns, self.divisors)
        if free:
            what = f"depend on each other and don't determine {listed([u.name for u in free])}"
            self._report("E511", block, f"{what}: {listed([residual.shown for residual in block])}")
        return list(steps)

    def _loop(self, block: Sequence[Residual], unknowns: Sequence[Symbol]) -> list[Step]:
        """Tear a nonlinear block; every residual of it must be one that the guesses can make zero."""
        made = tear(block, unknowns, self.divisors)
        residuals = made.residuals
        if len(made.inner) <= MOST_LISTED:
            for name, value in reversed(made.inner):
                residuals = tuple(residual.xreplace({symbol(name): value}) for residual in residuals)
        fault = ""
        if not all(residual.free_symbols for residual in residuals):
            fault = "hold a loop without an unknown left to solve for"
        elif self._is_open(residuals, [symbol(name) for name in made.tearing]):
            fault = "hold a loop that many values solve, or none"
        if fault:
            self._report("E503", block, f"{fault}: {made.chain}, by {listed(made.equations)}")
        return [] if fault else [made]

    def _is_open(self, residuals: Sequence[Term], guesses: Sequence[Symbol]) -> bool:
        """Return whether between corners the residuals don't depend on the guesses, or only on some."""
        if len(guesses) > MOST_GUESSES:
            return False
        for piece in smooth_pieces(residuals, MOST_PIECES) or ():
            try:
                slopes = sympy.Matrix([[slope(one, guess) for guess in guesses] for one in piece])
            except NoDerivativeError:
                continue
            with dotprodsimp(False):  # which would expand it
                determinant = slopes.det(method="laplace")
            if not self.divisors.allow(determinant):
                return True
        return False

    def _report(self, code: str, block: Sequence[Residual], what: str) -> None:
        self.mistakes.add(code, block[0].equation.place, f"{self.where} {what}")
