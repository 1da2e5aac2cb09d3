"""A block of linear equations solved by Gaussian elimination with sparse symbolic rows.

Takes: the linear forms of a block's equations, its unknowns, and the tests of what may be divided by.
Gives: `ZeroTests`, `eliminate`.
Guarantees: what is divided by is never zero with the scene's numbers; a long entry gets a name of its own, so
that a chain of a thousand equations stays as long as it was.
Does not: know sizes: numbers come in when a model runs.

The next pivot is one that stays when every parameter that may be zero is, if there is one; of these the one
that fills in least (Markowitz, Management Science 1957), and of several a number. Where none stays and few
equations are left, they are solved by Cramer's rule, which divides by nothing but their determinant: the
inertia of a mechanism is regular in every position, and each of its entries may vanish in some.
"""

from __future__ import annotations

import heapq
from collections.abc import Sequence
from dataclasses import dataclass

import sympy

from apc.compiler.equations.solution import Assignment
from apc.compiler.equations.symbolic import LinearForm, determinant_of
from apc.compiler.equations.terms import ZERO, Symbol, Term, size, symbol
from apc.compiler.equations.zero_test import Vanishing, ZeroTest

# An entry with more nodes than this gets a name of its own: substituted into one another, the entries of a
# chain of a thousand equations would grow without end.
LARGEST_ENTRY = 40
MOST_BY_CRAMER = 3  # equations: the terms of a determinant grow with the factorial

_Cost = tuple[bool, bool, int, bool, int, int]  # ends with the row and the place of the unknown


@dataclass(frozen=True, slots=True)
class ZeroTests:
    """What is asked of a coefficient before it is divided by.

    `is_zero`: whether it is zero for all values; `can_vanish`: when every parameter that may be zero is;
    `vanishes`: with the scene's numbers.
    """

    is_zero: ZeroTest
    can_vanish: ZeroTest
    vanishes: Vanishing

    def define(self, name: Symbol, expression: Term) -> None:
        """Let a symbol stand for an expression."""
        self.is_zero.define(name, expression)
        self.can_vanish.define(name, expression)
        self.vanishes.define(name, expression)


def eliminate(
    forms: Sequence[LinearForm], unknowns: Sequence[Symbol], tests: ZeroTests
) -> tuple[list[Assignment], list[Symbol]]:
    """Solve as many linear equations as unknowns.

    Parameters
    ----------
    forms
        For each equation the coefficients of the unknowns and the rest; their sum is zero.
    unknowns
        What to solve for.
    tests
        What may be divided by.

    Returns
    -------
    assignments
        The named entries, then the unknowns, each from those before it; later pivots are assigned first.
    free
        The unknowns that the equations leave open; if there are any, nothing is assigned.
    """
    system = _Elimination(forms, unknowns, tests)
    solved: list[Assignment] = []
    while not solved and (pivot := system.next_pivot()) is not None:
        if pivot[1] and len(system.open) <= MOST_BY_CRAMER:
            solved = system.by_cramer()
        if not solved:
            system.clear_column(*pivot[-2:])
    if solved or not system.open:
        return system.named + solved + system.solution(), []
    pivots = {j for _, j in system.pivots}
    return [], [unknown for j, unknown in enumerate(unknowns) if j not in pivots]


class _Elimination:
    """The rows as they are eliminated: `rows[i][j]` is the coefficient of unknown j in equation i."""

    def __init__(self, forms: Sequence[LinearForm], unknowns: Sequence[Symbol], tests: ZeroTests) -> None:
        place = {unknown: j for j, unknown in enumerate(unknowns)}
        self.unknowns = unknowns
        self.tests = tests
        self.rows = [
            {place[u]: c for u, c in coefficients.items() if not tests.is_zero(c)}
            for coefficients, _ in forms
        ]
        self.right = [-rest for _, rest in forms]
        self.open = dict.fromkeys(range(len(forms)))
        self.holders: list[set[int]] = [set() for _ in unknowns]  # the open rows that hold a column
        for i, row in enumerate(self.rows):
            for j in row:
                self.holders[j].add(i)
        self.named: list[Assignment] = []
        self.pivots: list[tuple[int, int]] = []
        self.heap = [self._cost(i, j) for i, row in enumerate(self.rows) for j in row]
        heapq.heapify(self.heap)

    def next_pivot(self) -> _Cost | None:
        """Return the row and column to go on with; None when there is nothing left to divide by."""
        while self.heap:
            entry = heapq.heappop(self.heap)
            i, j = entry[-2:]
            if i not in self.holders[j]:
                continue
            if (current := self._cost(i, j)) <= entry:
                return None if current[0] else current
            heapq.heappush(self.heap, current)  # the pattern has filled in since
        return None

    def clear_column(self, i: int, j: int) -> None:
        """Take unknown j out of every other open row, by row i."""
        self.pivots.append((i, j))
        del self.open[i]
        for column in self.rows[i]:
            self.holders[column].discard(i)
        for other in sorted(self.holders[j]):
            factor = self._named(self.rows[other].pop(j) / self.rows[i][j])
            for column, value in self.rows[i].items():
                if column != j:
                    self._subtract(other, column, factor * value)
            self.right[other] = self._named(self.right[other] - factor * self.right[i])
        self.holders[j].clear()

    def by_cramer(self) -> list[Assignment]:
        """Solve the open rows by their determinant; nothing where that is zero."""
        columns = sorted({column for i in self.open for column in self.rows[i]})
        if len(columns) < len(self.open):
            return []
        matrix = sympy.Matrix([[self.rows[i].get(j, ZERO) for j in columns] for i in self.open])
        determinant = determinant_of(matrix)
        if self.tests.is_zero(determinant) or self.tests.vanishes(determinant):
            return []
        divisor, right = self._named(determinant), sympy.Matrix([self.right[i] for i in self.open])
        solved = []
        for place, j in enumerate(columns):
            matrix_of_it = matrix.copy()
            matrix_of_it[:, place] = right
            solved.append((self.unknowns[j].name, determinant_of(matrix_of_it) / divisor))
        return solved

    def solution(self) -> list[Assignment]:
        """Return what gives each unknown of a pivot, by back substitution."""
        solved = []
        for i, j in reversed(self.pivots):
            others = (value * self.unknowns[column] for column, value in self.rows[i].items() if column != j)
            solved.append((self.unknowns[j].name, (self.right[i] - sympy.Add(*others)) / self.rows[i][j]))
        return solved

    def _cost(self, i: int, j: int) -> _Cost:
        entry, fill = self.rows[i][j], (len(self.rows[i]) - 1) * (len(self.holders[j]) - 1)
        vanishes, can_vanish = self.tests.vanishes(entry), self.tests.can_vanish(entry)
        return (vanishes, can_vanish, fill, not entry.is_number, i, j)

    def _subtract(self, row: int, column: int, value: Term) -> None:
        left = self._named(self.rows[row].get(column, ZERO) - value)
        if self.tests.is_zero(left):
            self.rows[row].pop(column, None)
            self.holders[column].discard(row)
        else:
            self.rows[row][column] = left
            self.holders[column].add(row)
            heapq.heappush(self.heap, self._cost(row, column))

    def _named(self, entry: Term) -> Term:
        """Return an entry, or the name it gets when it is long."""
        if size(entry) <= LARGEST_ENTRY:
            return entry
        short = symbol(f"{self.unknowns[0].name} by elimination {len(self.named) + 1}")
        self.tests.define(short, entry)
        self.named.append((short.name, entry))
        return short
