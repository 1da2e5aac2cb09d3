"""Index reduction: differentiation of equations until every derivative is determined, and choice of states.

Takes: residuals in variables and their derivatives (see `derivatives`). Gives: `IndexReduction`, whose result
are the equations to solve, their unknowns, and the states.
Guarantees: as many equations as unknowns; the states are independent, and their choice is fixed.
Does not: solve anything (see `blt_solver`).

Two rigidly connected masses have the same position: `a.x = b.x` is a constraint between states, and the force
between the masses follows only from its second derivative. The algorithm of Pantelides (SIAM J. Sci. Stat.
Comput. 1988) determines the equations to differentiate; the method of dummy derivatives (Mattsson and
Söderlind, SIAM J. Sci. Comput. 1993) retains the equation and its derivatives, and makes as many derivatives
unknowns as there are constraints, so that no constraint drifts.

Variables with a declared start value are preferred as states, then variables that come first. The start value
of a chosen state is used; the start values of the variables that depend on the state are ignored.
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

# The highest order of a derivative. A constraint on a position requires order two; a higher order than this
# means that the differentiation does not terminate.
HIGHEST_ORDER = 8

# The largest number of nodes of a derivative: a derivative of a product with n factors is about n times
# longer.
LARGEST = 100_000


# Equations to solve, their unknowns, and the states: x, and der(x) if der(der(x)) is an unknown.
Reduced = tuple[list[Residual], list[Symbol], list[Symbol]]


class IndexReduction:
    """The equations during index reduction: a derivative of an equation replaces the equation in the
    matching.

    Parameters
    ----------
    residuals
        The equations.
    orders
        The variables of the equations, in order of preference as states, with the order of the derivatives
        that are required even if no equation contains them.
    time_varying
        The names of the time-varying quantities, by which terms are differentiated.
    problem
        The context of the equations. Errors are E502 unmatched equations or unknowns, or redundant
        constraints, E508 the derivative of a discontinuous value, E509 states that would have to change with
        the position.
    """

    def __init__(
        self,
        residuals: Iterable[Residual],
        orders: Mapping[str, int],
        time_varying: DifferentiatedNames,
        problem: Problem,
    ) -> None:
        self.time_varying = time_varying
        self.problem = problem
        self.order = dict(orders)  # the highest order of each variable
        self.residuals: list[Residual] = []
        self.held: list[dict[str, int]] = []  # for each equation, its variables and their highest orders
        self.original: dict[
            int, int
        ] = {}  # for the index of each derived equation, that of the equation it is the derivative of
        for residual in residuals:
            self._add(residual)

    def reduced(self, started: Set[Symbol]) -> Reduced:
        """Return the equations after index reduction, their unknowns, and the states.

        `started` are the variables and derivatives with a declared start value.
        """
        balanced(self.residuals, self.held, list(self.order), self.problem)
        self._differentiate_constraints()
        dummies = self._choose_dummies(started)
        states: list[Symbol] = []
        unknowns: list[Symbol] = []
        for name, top in self.order.items():
            # Derivatives of this order and higher are dummy derivatives; the order below is the derivative of
            # a state, which is an unknown as well.
            first = min((k for k in range(top + 1) if (name, k) in dummies), default=top + 1)
            split = max(first - 1, 0)
            states += [derivative(name, k) for k in range(split)]
            unknowns += [derivative(name, k) for k in range(split, top + 1)]
        return self.residuals, unknowns, states

    def _add(self, residual: Residual) -> None:
        """Add an equation, with its variables and their highest orders."""
        self.residuals.append(residual)
        self.held.append(dict(sorted(self.time_varying.derivatives(residual.expression).values())))
        self.order |= {name: max(self.order[name], order) for name, order in self.held[-1].items()}

    # ---- Pantelides ----

    def _differentiate_constraints(self) -> None:
        """Differentiate equations until each equation is matched to a derivative of highest order."""
        while True:
            newest = sorted({*range(len(self.residuals))} - {*self.original.values()})
            incidence = [[x for x, order in self.held[i].items() if order == self.order[x]] for i in newest]
            unmatched, (rows, names), *_ = match(incidence, list(self.order))
            if not unmatched:
                return
            self._differentiate([newest[i] for i in rows], names)

    def _differentiate(self, rows: Sequence[int], names: Sequence[str]) -> None:
        """Differentiate an overdetermined set of equations, and increase the order of its unknowns."""
        blocking = [self.residuals[row] for row in rows]
        for row, residual in zip(rows, blocking, strict=True):
            if not self._can_determine(row):
                message = (
                    "has no unknown after substitution of the connections and other equations: "
                    "it is redundant or contradicts them"
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
            message = (
                "the equations are singular; no number of differentiations determines their unknowns: "
                f"{shown}"
            )
            raise self.problem.fault("E509", blocking, message)
        for row, residual in zip(rows, blocking, strict=True):
            try:
                expression = self.time_varying.differentiate(residual.expression)
            except NoDerivativeError as missing:
                raise self.problem.no_derivative(residual, missing) from missing
            self.original[len(self.residuals)] = row
            self._add(Residual(expression, residual.equation))

    def _can_determine(self, row: int) -> bool:
        """Return whether the derivative of an equation may determine an unknown of the equation.

        An equation without unknowns cannot. An equation whose repeated derivatives contain the same unknowns
        at the same orders cannot either: its unknowns occur only in conditions, which have no derivative.
        """
        orders, repetitions = self.held[row], 0
        while (previous := self.original.get(row)) is not None and self.held[previous] == orders:
            row, repetitions = previous, repetitions + 1
        return bool(orders) and repetitions <= max(orders.values())

    # ---- dummy derivatives ----

    def _choose_dummies(self, started: Set[Symbol]) -> set[Derivative]:
        """Return the dummy derivatives, level by level from the highest order downwards.

        At each level there are as many as constraints, and the Jacobian of the constraints with respect to
        them is regular.
        """
        rank = {name: j for j, name in enumerate(self.order)}
        chosen: set[Derivative] = set()
        rows = [row for row in self.original if row not in self.original.values()]
        candidates = [(name, order) for name, order in self.order.items() if order]
        while rows:
            candidates.sort(key=lambda it: (derivative(it[0], it[1] - 1) in started, -it[1], -rank[it[0]]))
            level = self._regular_columns(rows, candidates)
            chosen |= set(level)
            rows = [self.original[row] for row in rows if self.original[row] in self.original]
            candidates = [(name, order - 1) for name, order in level if order > 1]
        return chosen

    def _regular_columns(self, rows: Sequence[int], candidates: Sequence[Derivative]) -> list[Derivative]:
        """Return the first candidates for which the Jacobian of the constraints `rows` is a regular square
        matrix.

        The method is elimination column by column; a time-varying factor, such as 2·x, may be zero and is no
        pivot. Raises an error if no such candidates exist.
        """
        where, divisors = self.problem.where, self.problem.divisors
        symbols = {derivative(*candidate): candidate for candidate in candidates}
        constraints = [self.residuals[row] for row in rows]
        linear: list[Mapping[Term, Term]] = []
        for constraint in constraints:
            form = linear_form(constraint.expression, symbols.keys())
            if form is None:  # without conditions, a derivative is linear in the highest derivatives
                shown = constraint.shown
                message = (
                    f"in the constraint {shown} a condition depends on a derivative that is determined by it"
                )
                advice = "use a condition on positions, parameters or time"
                raise self.problem.fault("E509", [constraint], f"{where}: {message}", advice)
            linear.append(form[0])
        system = Elimination(linear, divisors, "", LARGEST)
        chosen = []
        for s, candidate in symbols.items():
            pivots = [
                (not row[s].is_number, len(row), i)
                for i, row in system.rows.items()
                if s in row and not self._varies(row[s]) and not divisors.vanishes(row[s])
            ]
            if pivots:
                system.clear(min(pivots)[-1], s)
                chosen.append(candidate)
        for i, entries in system.rows.items():
            message = f"the constraint {constraints[i].shown} is redundant"
            code, advice = "E502", ""
            if not all(divisors.vanishes(factor) for factor in entries.values()):
                factors = ", ".join(
                    f"{symbols[s][0]} (by the factor {text_of(entries[s])})" for s in in_order(entries)
                )
                message = f"{constraints[i].shown} does not determine a variable in every position"
                message, code = f"{message}, since a factor may become zero: {factors}", "E509"
                advice = "write it in an angle or another coordinate that is valid in every position"
            fault = self.problem.fault(code, [constraints[i]], f"{where}: {message}", advice)
            self.problem.mistakes.take(fault)
        if system.rows:
            raise AlreadyReportedError
        return chosen

    def _varies(self, factor: Term) -> bool:
        """Return whether a factor varies with time."""
        return TIME in factor.free_symbols or bool(self.time_varying.derivatives(factor))
