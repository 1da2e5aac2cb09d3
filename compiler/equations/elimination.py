"""A block of linear equations solved by Gaussian elimination with sparse symbolic rows.

Takes: linear forms, and the tests of divisors. Gives: `Elimination`, `eliminate`.
Guarantees: a divisor is never zero with the parameter values; a long entry gets a name of its own,
so that a chain of a thousand equations stays as long as it was.
Does not: know sizes: numbers come in when a model runs.

The next pivot is one that stays when every parameter that may be zero is, if there is one; of these one of a
short row and column, which fills in little (Markowitz, Management Science 1957), and of several a number.
Where none stays and few equations are left, they are solved by Cramer's rule, which divides by nothing but
their determinant: the inertia of a mechanism is regular in every position, and each of its entries may vanish
in some.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence

import sympy
from sympy.matrices import dotprodsimp

from apc.compiler.equations.divisor_test import Divisors
from apc.compiler.equations.solution import Assignment
from apc.compiler.equations.terms import ONE, ZERO, LinearForm, Symbol, Term, size, symbol

# An entry with more nodes than this gets a name of its own: substituted into one another, the entries of a
# chain of a thousand equations would grow without end.
LARGEST_ENTRY = 40
MOST_BY_CRAMER = 3  # equations: the terms of a determinant grow with the factorial


class Elimination:
    """Open rows Σ coefficient·unknown + rest = 0, the rest under `ONE`, and the pivots taken out of them.

    `longest` is the largest number of nodes of an unnamed entry. A longer entry gets a name that begins
    with `name`.
    """

    def __init__(
        self, rows: Iterable[Mapping[Term, Term]], divisors: Divisors, name: str, longest: int
    ) -> None:
        self.divisors = divisors
        self.name = name
        self.longest = longest
        self.named: list[Assignment] = []
        self.pivots: list[tuple[Symbol, dict[Term, Term]]] = []
        self.rows: dict[int, dict[Term, Term]] = {}
        for i, row in enumerate(rows):
            self.rows[i] = {}
            for column, value in row.items():
                self._put(self.rows[i], column, value)

    def next_pivot(self, *, stays: bool) -> tuple[int, Symbol] | None:
        """Return the shortest row that may be divided by a coefficient, and of these the one in fewest rows.

        With `stays` only by what stays when every parameter is zero that may be. None if there is nothing.
        """
        for i in sorted(self.rows, key=lambda i: len(self.rows[i])):
            usable = [
                (sum(unknown in row for row in self.rows.values()), not factor.is_number, unknown.name)
                for unknown, factor in self.rows[i].items()
                if unknown is not ONE and not self.divisors.vanishes(factor)
                if not (stays and self.divisors.can_vanish(factor))
            ]
            if usable:
                return i, symbol(min(usable)[-1])
        return None

    def clear(self, i: int, unknown: Symbol) -> None:
        """Take an unknown out of every other open row, by row i."""
        pivot = self.rows.pop(i)
        self.pivots.append((unknown, pivot))
        for row in (row for row in self.rows.values() if unknown in row):
            factor = self._short(row.pop(unknown) / pivot[unknown])
            for column in (column for column in pivot if column is not unknown):
                self._put(row, column, row.pop(column, ZERO) - factor * pivot[column])

    def by_cramer(self) -> list[Assignment]:
        """Solve the open rows by their determinant; nothing where that is zero."""
        rows = list(self.rows.values())
        columns = list(dict.fromkeys(column for row in rows for column in row if column is not ONE))
        if len(columns) != len(rows):
            return []
        with dotprodsimp(False):
            matrix = sympy.Matrix([[row.get(column, ZERO) for column in columns] for row in rows])
            determinant = matrix.det(method="laplace")
            if self.divisors.is_zero(determinant) or self.divisors.vanishes(determinant):
                return []
            right = sympy.Matrix([-row.get(ONE, ZERO) for row in rows])
            solved = matrix.adjugate(method="laplace") * right
        divisor = self._short(determinant)
        return [(column.name, value / divisor) for column, value in zip(columns, solved, strict=True)]

    def solution(self) -> list[Assignment]:
        """Return the solution for each unknown of a pivot, by back substitution."""
        return [
            (unknown.name, -sympy.Add(*(c * u for u, c in row.items() if u is not unknown)) / row[unknown])
            for unknown, row in reversed(self.pivots)
        ]

    def _put(self, row: dict[Term, Term], column: Term, value: Term) -> None:
        value = self._short(value)
        if not self.divisors.is_zero(value):
            row[column] = value

    def _short(self, entry: Term) -> Term:
        """Return an entry, or the name it gets when it is long."""
        if size(entry) <= self.longest:
            return entry
        short = symbol(f"{self.name} by elimination {len(self.named) + 1}")
        self.divisors.define(short, entry)
        self.named.append((short.name, entry))
        return short


def eliminate(
    forms: Sequence[LinearForm], unknowns: Sequence[Symbol], divisors: Divisors
) -> tuple[list[Assignment], list[Symbol]]:
    """Solve as many linear equations as unknowns.

    Parameters
    ----------
    forms
        For each equation the coefficients of the unknowns and the rest; their sum is zero.
    unknowns
        The unknowns.
    divisors
        The test of divisors.

    Returns
    -------
    assignments
        The named entries, then the unknowns, each from those before it; later pivots are assigned first.
    free
        The unknowns that the equations leave open; if there are any, nothing is assigned.
    """
    longest = LARGEST_ENTRY if len(unknowns) > 1 else sys.maxsize  # what is not put into another may be long
    rows = ({**coefficients, ONE: rest} for coefficients, rest in forms)
    system = Elimination(rows, divisors, unknowns[0].name, longest)
    solved: list[Assignment] = []
    while system.rows and not solved:
        pivot = system.next_pivot(stays=True)
        if pivot is None and 1 < len(system.rows) <= MOST_BY_CRAMER:
            solved = system.by_cramer()
        pivot = pivot or system.next_pivot(stays=False)
        if pivot is None or solved:
            break
        system.clear(*pivot)
    if system.rows and not solved:
        known = {unknown for unknown, _ in system.pivots}
        return [], [unknown for unknown in unknowns if unknown not in known]
    return system.named + solved + system.solution(), []
