"""A block of linear equations solved by Gaussian elimination with sparse symbolic rows.

Takes: linear forms, and the tests of divisors. Gives: `Elimination`, `eliminate`.
Guarantees: a divisor is never zero with the parameter values; a long entry is replaced by a named symbol, so
that the size of the equations of a long chain of parts remains proportional to its length.
Does not: compare magnitudes for pivoting: numbers are inserted when a model is run.

The next pivot is, if possible, nonzero for every value of the parameters, including zero; of these a pivot
with a short row and column, which causes little fill-in (Markowitz, Management Science 1957), and then a
number. If no pivot is always nonzero and few equations remain, they are solved by Cramer's rule, which
divides only by the determinant: the inertia matrix of a mechanism is regular in every position, while each of
its entries may be zero in some positions.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable, Mapping, Sequence

import sympy
from sympy.matrices import dotprodsimp

from apc.compiler.equations.divisor_test import Divisors
from apc.compiler.equations.solution import Assignment
from apc.compiler.equations.terms import ONE, ZERO, LinearForm, Symbol, Term, size, symbol

# An entry with more nodes than this is replaced by a named symbol: repeated substitution into each other
# would let the entries of a chain of a thousand equations grow without limit.
LARGEST_ENTRY = 40
MOST_BY_CRAMER = 3  # equations: the terms of a determinant grow with the factorial


class Elimination:
    """The remaining rows Σ coefficient·unknown + constant = 0, with the constant under `ONE`, and the
    eliminated pivots.

    `longest` is the largest number of nodes of an unnamed entry. A longer entry is replaced by a symbol whose
    name begins with `name`; `named` has these symbols.
    """

    def __init__(
        self, rows: Iterable[Mapping[Term, Term]], divisors: Divisors, name: str, longest: int
    ) -> None:
        """Store the rows of the equations, with long entries replaced by symbols.

        Parameters
        ----------
        rows
            The coefficients of each equation by unknown, and the constant under `ONE`.
        divisors
            The test of divisors.
        name
            The first word of the symbols for long entries.
        longest
            The largest number of nodes of an unnamed entry.
        """
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
        """Return the row and the unknown of the next pivot, None if there is none.

        The row is the shortest with a nonzero coefficient, the unknown is in the fewest rows. With `stays`,
        the coefficient must be nonzero even if every parameter that can be zero is zero.
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
        """Eliminate an unknown from all other remaining rows by means of row i."""
        pivot = self.rows.pop(i)
        self.pivots.append((unknown, pivot))
        for row in (row for row in self.rows.values() if unknown in row):
            factor = self._short(row.pop(unknown) / pivot[unknown])
            for column in (column for column in pivot if column is not unknown):
                self._put(row, column, row.pop(column, ZERO) - factor * pivot[column])

    def by_cramer(self) -> list[Assignment]:
        """Return the solution of the remaining rows by Cramer's rule; empty if their determinant is zero."""
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
        """Return the values of the unknowns of all pivots, by back substitution."""
        return [
            (unknown.name, -sympy.Add(*(c * u for u, c in row.items() if u is not unknown)) / row[unknown])
            for unknown, row in reversed(self.pivots)
        ]

    def _put(self, row: dict[Term, Term], column: Term, value: Term) -> None:
        """Set an entry of a row unless it is zero."""
        value = self._short(value)
        if not self.divisors.is_zero(value):
            row[column] = value

    def _short(self, entry: Term) -> Term:
        """Return an entry, or the symbol that represents a long entry."""
        if size(entry) <= self.longest:
            return entry
        short = symbol(f"{self.name} by elimination {len(self.named) + 1}")
        self.divisors.define(short, entry)
        self.named.append((short.name, entry))
        return short


def eliminate(
    forms: Sequence[LinearForm], unknowns: Sequence[Symbol], divisors: Divisors
) -> tuple[list[Assignment], list[Symbol]]:
    """Return the solution of as many linear equations as unknowns, by Gaussian elimination.

    Parameters
    ----------
    forms
        For each equation the coefficients of the unknowns, and the constant; the sum of all terms is zero.
    unknowns
        The unknowns.
    divisors
        The test of divisors.

    Returns
    -------
    assignments
        The named entries, then the unknowns; each value depends only on earlier ones; later pivots are first.
    free
        The unknowns that the equations do not determine; if there are any, `assignments` is empty.
    """
    # The entries of a single equation are never substituted.
    longest = LARGEST_ENTRY if len(unknowns) > 1 else sys.maxsize
    rows = ({**coefficients, ONE: constant} for coefficients, constant in forms)
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
