"""Which equation computes which unknown, in which order, and how each block of them is solved.

Takes: equations as residuals, and the unknowns. Gives: `solve_blocks`: assignments and `ImplicitBlock`s.
Guarantees: every unknown is assigned once, from what was assigned before; linear blocks come out explicit.
Does not: differentiate anything (see `index`), or know of states and clocks.

Matched and sorted by `matching`; a block of linear equations is solved by `elimination`, a nonlinear loop is
left to an iteration over the few unknowns that `tearing` chooses.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence

import sympy

from apc.compiler.equations.elimination import ZeroTests, eliminate
from apc.compiler.equations.matching import match_columns, strong_components
from apc.compiler.equations.residuals import (
    MOST_LISTED,
    SCENE,
    Residual,
    listed,
    report_no_number,
    report_singular,
)
from apc.compiler.equations.solution import Assignment, ImplicitBlock, Step
from apc.compiler.equations.symbolic import determinant_of, is_no_number, linear_form, slope, smooth_pieces
from apc.compiler.equations.tearing import tear
from apc.compiler.equations.terms import ZERO, NoDerivativeError, Symbol, Term, symbol
from apc.compiler.equations.zero_test import NOTHING_VANISHES, Vanishing, ZeroTest
from apc.compiler.errors import Mistakes, Place

# A loop of more guesses, or with more pieces between its corners, is not asked whether it has one solution.
MOST_GUESSES, MOST_PIECES = 3, 64


def solve_blocks(
    residuals: Sequence[Residual],
    unknowns: Sequence[Symbol],
    where: str,
    mistakes: Mistakes,
    *,
    nonzero: Collection[Symbol] = (),
    vanishes: Vanishing = NOTHING_VANISHES,
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
        equations that depend on each other.
    nonzero
        Parameters that no number can make zero; divisors stay when all others are zero, where possible.
    vanishes
        Whether an expression is zero with the scene's numbers; what is divided by must not be.
    place
        Where to point when there is no equation.
    """
    columns = {unknown: j for j, unknown in enumerate(unknowns)}
    incidence = [sorted(columns[s] for s in r.expression.free_symbols & columns.keys()) for r in residuals]
    match = match_columns(incidence, len(unknowns))
    if len(residuals) != len(unknowns) or None in match:
        report_singular(residuals, [u.name for u in unknowns], incidence, match, where, mistakes, place)
        return ()
    computes = {row: column for column, row in enumerate(match) if row is not None}
    # Row i computes column computes[i]; it needs the rows that compute its other unknowns.
    needs = [
        [row for j in columns_of if (row := match[j]) is not None and row != i]
        for i, columns_of in enumerate(incidence)
    ]
    tests = ZeroTests(ZeroTest(), ZeroTest(frozenset(nonzero)), vanishes)
    solver = _Solver(where, mistakes, tests)
    steps: list[Step] = []
    for block in strong_components(needs):
        rows = sorted(block)
        own = [unknowns[column] for column in sorted(computes[row] for row in rows)]
        steps += solver.checked([residuals[row] for row in rows], own)
    return tuple(steps)


class _Solver:
    """Solves blocks; keeps what they share: the zero tests, and where mistakes go."""

    def __init__(self, where: str, mistakes: Mistakes, tests: ZeroTests) -> None:
        self.where = where
        self.mistakes = mistakes
        self.tests = tests

    def checked(self, block: Sequence[Residual], unknowns: Sequence[Symbol]) -> list[Step]:
        """Solve one block; its expressions must be numbers: what was divided may cancel."""
        steps = self.solve(block, unknowns)
        expressions = (
            expression
            for step in steps
            for expression in (
                (*step.residuals, *(value for _, value in step.inner))
                if isinstance(step, ImplicitBlock)
                else (step[1],)
            )
        )
        if any(is_no_number(expression) for expression in expressions):
            report_no_number([residual.shown for residual in block], block[0].equation.place, self.mistakes)
            return []
        return steps

    def solve(self, block: Sequence[Residual], unknowns: Sequence[Symbol]) -> list[Step]:
        """Return what gives the unknowns of one block, explicit where it is linear in them."""
        known = frozenset(unknowns)
        forms = [linear_form(residual.expression, known) for residual in block]
        linear = [form for form in forms if form is not None]
        if len(linear) < len(forms):
            return self._loop(block, unknowns)
        if len(block) > 1:
            steps, free = eliminate(linear, unknowns, self.tests)
            if free:
                self._report_dependent(block, free)
            return list(steps)
        [(coefficients, rest)] = linear
        coefficient = coefficients.get(unknowns[0], ZERO)
        if self.tests.is_zero(coefficient) or self.tests.vanishes(coefficient):
            self._report_dependent(block, unknowns)
            return []
        return [(unknowns[0].name, -rest / coefficient)]

    def _loop(self, block: Sequence[Residual], unknowns: Sequence[Symbol]) -> list[Step]:
        """Tear a nonlinear block; every residual of it must be one that the guesses can make zero."""
        made = tear(block, unknowns, self.tests.is_zero)
        residuals = [_put_in(residual, made.inner) for residual in made.residuals]
        if not all(residual.free_symbols for residual in residuals):
            self._report_loop(block, made, "hold a loop without an unknown left to solve for")
            return []
        if self._is_open(residuals, [symbol(name) for name in made.tearing]):
            self._report_loop(block, made, "hold a loop that many values solve, or none")
            return []
        return [made]

    def _is_open(self, residuals: Sequence[Term], guesses: Sequence[Symbol]) -> bool:
        """Return whether between corners the residuals don't depend on the guesses, or only on some."""
        if len(guesses) > MOST_GUESSES:
            return False
        pieces = smooth_pieces(residuals, MOST_PIECES)
        for piece in pieces or ():
            try:
                slopes = [[slope(one, guess) for guess in guesses] for one in piece]
            except NoDerivativeError:
                continue
            determinant = determinant_of(sympy.Matrix(slopes))
            if self.tests.is_zero(determinant) or self.tests.vanishes(determinant):
                return True
        return False

    def _report_loop(self, block: Sequence[Residual], made: ImplicitBlock, fault: str) -> None:
        what = f"{self.where} {fault}: {made.chain}, by {listed(made.equations)}"
        self.mistakes.add("E503", block[0].equation.place, what)

    def _report_dependent(self, block: Sequence[Residual], unknowns: Sequence[Symbol]) -> None:
        what = (
            f"{self.where} depend on each other and don't determine {listed([u.name for u in unknowns])}: "
            f"{listed([residual.shown for residual in block])}"
        )
        self.mistakes.add("E511", block[0].equation.place, what)


def _put_in(residual: Term, inner: Sequence[Assignment]) -> Term:
    """Return a residual with the inner values put in, when they are few."""
    if len(inner) <= MOST_LISTED:
        for name, expression in reversed(inner):
            residual = residual.xreplace({symbol(name): expression})
    return residual
