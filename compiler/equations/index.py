"""Index reduction: equations differentiated until every derivative can be solved for, and states chosen.

Takes: residuals in variables and their derivatives (see `derivatives`). Gives: `IndexReduction`, whose result
are the equations to solve, their unknowns, and the states.
Guarantees: as many equations as unknowns; the states are independent and chosen once and for all.
Does not: solve anything (see `blt_solver`).

Two masses joined rigidly have one position: `a.x = b.x` is a constraint between states, and the force between
the masses follows only from its second derivative. Pantelides (SIAM J. Sci. Stat. Comput. 1988) finds which
equations to differentiate; the method of dummy derivatives (Mattsson and Söderlind, SIAM J. Sci. Comput.
1993) keeps the equation and its derivatives, and makes an unknown of as many derivatives as there are
constraints, so that no constraint drifts.

Among the choices of states it prefers variables with a declared start value, then those named first. The
start value of a chosen state counts; the variables that depend on it follow, whatever their own start values.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence, Set

import sympy

from apc.compiler.equations.blt_solver import balanced
from apc.compiler.equations.derivatives import TIME, Derivative, DifferentiatedNames
from apc.compiler.equations.elimination import Elimination
from apc.compiler.equations.matching import match
from apc.compiler.equations.solution import Problem, Residual
from apc.compiler.equations.terms import (
    NoDerivativeError,
    Symbol,
    Term,
    derivative,
    in_order,
    linear_form,
    size,
    text_of,
)
from apc.compiler.language.values import AlreadyReportedError

# More derivatives than this of one variable: no mechanical model needs them (a constraint on a position
# needs two), so the equations do not end.
HIGHEST_ORDER = 8

# Nodes of a derivative, at most: that of a product is about as many times longer as the product has factors.
LARGEST = 100_000


# Equations to solve, their unknowns, and the states: x, and der(x) where der(der(x)) is solved.
Reduced = tuple[list[Residual], list[Symbol], list[Symbol]]


class IndexReduction:
    """The equations during index reduction: a derivative of an equation replaces it in the matching.

    Parameters
    ----------
    residuals
        The equations.
    orders
        Their variables, in order of preference as states, and the number of derivatives required of each even
        if no equation has them.
    moving
        Provides the derivatives of the variables.
    problem
        Their names. Raised are E502 unmatched equations or unknowns, or redundant constraints, E508 the
        derivative of a discontinuous value, E509 a state selection that would vary.
    """

    def __init__(
        self,
        residuals: Iterable[Residual],
        orders: Mapping[str, int],
        moving: DifferentiatedNames,
        problem: Problem,
    ) -> None:
        self.moving = moving
        self.problem = problem
        self.order = dict(orders)  # the highest of each variable
        self.residuals: list[Residual] = []
        self.held: list[dict[str, int]] = []  # for each equation, its variables and their highest orders
        self.integral: dict[int, int] = {}  # of each derivative, the equation it is of
        for residual in residuals:
            self._add(residual)

    def reduced(self, started: Set[Symbol]) -> Reduced:
        """Reduce the index by differentiation and select the states.

        `started` are the variables and derivatives with a declared start value.
        """
        balanced(self.residuals, self.held, list(self.order), self.problem)
        self._differentiate_constraints()
        dummies = self._choose_dummies(started)
        states: list[Symbol] = []
        unknowns: list[Symbol] = []
        for name, top in self.order.items():
            # The orders made unknowns of begin here; the one below is solved for as a state's derivative.
            first = min((k for k in range(top + 1) if (name, k) in dummies), default=top + 1)
            split = max(first - 1, 0)
            states += [derivative(name, k) for k in range(split)]
            unknowns += [derivative(name, k) for k in range(split, top + 1)]
        return self.residuals, unknowns, states

    def _add(self, residual: Residual) -> None:
        self.residuals.append(residual)
        self.held.append(dict(sorted(self.moving.derivatives(residual.expression).values())))
        self.order |= {name: max(self.order[name], order) for name, order in self.held[-1].items()}

    # ---- Pantelides ----

    def _differentiate_constraints(self) -> None:
        """Match every equation to a highest derivative, differentiating those without an unknown to match."""
        while True:
            newest = sorted({*range(len(self.residuals))} - {*self.integral.values()})
            held = [[x for x, order in self.held[i].items() if order == self.order[x]] for i in newest]
            left_over, (rows, names), *_ = match(held, list(self.order))
            if not left_over:
                return
            self._pass_on([newest[i] for i in rows], names)

    def _pass_on(self, rows: Sequence[int], names: Sequence[str]) -> None:
        """Differentiate an overdetermined set of equations, and increase the order of its unknowns."""
        blocking = [self.residuals[row] for row in rows]
        for row, residual in zip(rows, blocking, strict=True):
            if not self._moves_on(row):
                message = (
                    "holds no unknown once what the connections and other equations say is put in: "
                    "it says what they say already, or contradicts them"
                )
                raise self.problem.fault("E502", [residual], f"{residual.shown} {message}")
        for name in names:
            self.order[name] += 1
        # Each factor of a product is multiplied by the derivatives of all the others.
        grown = (
            sum(size(term) ** 2 for term in sympy.Add.make_args(residual.expression)) for residual in blocking
        )
        if any(self.order[name] > HIGHEST_ORDER for name in names) or max(grown) > LARGEST:
            shown = ", ".join(dict.fromkeys(residual.shown for residual in blocking))
            message = f"no number of derivatives of these equations determines what they hold: {shown}"
            raise self.problem.fault("E509", blocking, message)
        for row, residual in zip(rows, blocking, strict=True):
            try:
                expression = self.moving.differentiate(residual.expression)
            except NoDerivativeError as missing:
                raise self.problem.no_derivative(residual, missing) from missing
            self.integral[len(self.residuals)] = row
            self._add(Residual(expression, residual.equation))

    def _moves_on(self, row: int) -> bool:
        """Return whether an equation contains an unknown that its derivative may determine.

        One that holds nothing has cancelled. One whose derivatives hold nothing new, though conditions were
        passed by that hold higher ones, asks for its unknowns in conditions only.
        """
        held, same = self.held[row], 0
        while (before := self.integral.get(row)) is not None and self.held[before] == held:
            row, same = before, same + 1
        return bool(held) and same <= max(held.values())

    # ---- dummy derivatives ----

    def _choose_dummies(self, started: Set[Symbol]) -> set[Derivative]:
        """Return the derivatives that become unknowns, level by level from the highest order down.

        At each level as many as there are constraints, so that the constraints' Jacobian in them is regular.
        """
        rank = {name: j for j, name in enumerate(self.order)}
        chosen: set[Derivative] = set()
        rows = [row for row in self.integral if row not in self.integral.values()]
        candidates = [(name, order) for name, order in self.order.items() if order]
        while rows:
            candidates.sort(key=lambda it: (derivative(it[0], it[1] - 1) in started, -it[1], -rank[it[0]]))
            level = self._regular_columns(rows, candidates)
            chosen |= set(level)
            rows = [self.integral[row] for row in rows if self.integral[row] in self.integral]
            candidates = [(name, order - 1) for name, order in level if order > 1]
        return chosen

    def _regular_columns(self, rows: Sequence[int], candidates: Sequence[Derivative]) -> list[Derivative]:
        """Return the first columns, in the order given, in which the rows' Jacobian is regular.

        Elimination column by column; a factor that moves, such as 2·x, may vanish and is no pivot.
        """
        where, divisors = self.problem.where, self.problem.divisors
        symbols = {derivative(*candidate): candidate for candidate in candidates}
        constraints = [self.residuals[row] for row in rows]
        linear: list[Mapping[Term, Term]] = []
        for constraint in constraints:
            form = linear_form(constraint.expression, symbols.keys())
            if form is None:  # else a derivative is linear in the highest derivatives
                shown = constraint.shown
                message = f"in the constraint {shown} a condition hangs on a derivative that it ties down"
                hint = "a condition on positions, parameters or time"
                raise self.problem.fault("E509", [constraint], f"{where}: {message}", hint)
            linear.append(form[0])
        system = Elimination(linear, divisors, "", LARGEST)
        chosen = []
        for s, candidate in symbols.items():
            fixed = [
                (not row[s].is_number, len(row), i)
                for i, row in system.rows.items()
                if s in row and not self._moves(row[s]) and not divisors.vanishes(row[s])
            ]
            if fixed:
                system.clear(min(fixed)[-1], s)
                chosen.append(candidate)
        for i, entries in system.rows.items():
            message = f"the constraint {constraints[i].shown} says what other constraints say already"
            code, hint = "E502", ""
            if not all(divisors.vanishes(factor) for factor in entries.values()):
                factors = ", ".join(
                    f"{symbols[s][0]} (by the factor {text_of(entries[s])})" for s in in_order(entries)
                )
                message = f"no variable follows from the constraint {constraints[i].shown} in every position"
                message, code = f"{message}, since the factor moves and may vanish: {factors}", "E509"
                hint = "the constraint with an angle or another coordinate that gives every position"
            self.problem.mistakes.take(
                self.problem.fault(code, [constraints[i]], f"{where}: {message}", hint)
            )
        if system.rows:
            raise AlreadyReportedError
        return chosen

    def _moves(self, factor: Term) -> bool:
        return TIME in factor.free_symbols or bool(self.moving.derivatives(factor))
