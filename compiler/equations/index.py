"""Index reduction: equations differentiated until every derivative can be solved for, and states chosen.

Takes: residuals in variables and their derivatives (see `derivatives`). Gives: `IndexReduction`, whose result
are the equations to solve, their unknowns, and the states.
Guarantees: as many equations as unknowns; the states are independent and chosen once and for all.
Does not: solve anything (see `blocks`).

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
from dataclasses import dataclass

from apc.compiler.equations.derivatives import TIME, Derivative, Moving, derivative
from apc.compiler.equations.elimination import Elimination
from apc.compiler.equations.matching import alternating, match_columns
from apc.compiler.equations.residuals import Residual, report_no_derivative, report_singular
from apc.compiler.equations.symbolic import derivative_size, linear_form
from apc.compiler.equations.terms import NoDerivativeError, Symbol, Term, text_of
from apc.compiler.equations.zero_test import Divisors
from apc.compiler.errors import Mistakes, Place

# More derivatives than this of one variable: no mechanical model needs them (a constraint on a position
# needs two), so the equations do not end.
HIGHEST_ORDER = 8

# Nodes a derivative may have, at most: that of a product of nonlinear factors is longer than the product. The
# derivatives of the joints of a mechanism have some hundreds of them.
LARGEST = 100_000


@dataclass(frozen=True, slots=True)
class Reduced:
    """Equations to solve for the unknowns. `states` are x, and der(x) where der(der(x)) is solved."""

    residuals: tuple[Residual, ...]
    unknowns: tuple[Symbol, ...]
    states: tuple[Symbol, ...]


class IndexReduction:
    """The equations as they grow: each may have a derivative, which then takes its place in the matching.

    Parameters
    ----------
    residuals
        The equations.
    orders
        The variables they hold, in the order of preference as states, and how many derivatives of each are
        asked for even if no equation holds them.
    moving
        Knows the derivatives of the variables.
    where
        What to call the equations in a message.
    mistakes
        Takes E502 equations or unknowns left over or constraints that say the same, E508 the derivative of a
        value that jumps, E509 states that can't be chosen once and for all.
    divisors
        What may be divided by.
    """

    def __init__(
        self,
        residuals: Sequence[Residual],
        orders: Mapping[str, int],
        moving: Moving,
        where: str,
        mistakes: Mistakes,
        divisors: Divisors,
    ) -> None:
        self.moving = moving
        self.where = where
        self.mistakes = mistakes
        self.divisors = divisors
        self.order = dict(orders)  # the highest of each variable
        self.residuals: list[Residual] = []
        self.held: list[dict[str, int]] = []  # for each equation, its variables and their highest orders
        self.integral: dict[int, int] = {}  # of each derivative, the equation it is of
        for residual in residuals:
            self._add(residual)
            for name, order in self.held[-1].items():
                self.order[name] = max(self.order[name], order)

    def reduced(self, started: Set[Symbol], place: Place) -> Reduced | None:
        """Differentiate what must be and choose the states; None if the equations can't be solved.

        Parameters
        ----------
        started
            The variables and derivatives with a declared start value.
        place
            Where to point when there is no equation left.
        """
        names = list(self.order)
        incidence = [[j for j, name in enumerate(names) if name in held] for held in self.held]
        match = match_columns(incidence, len(names))
        if len(self.residuals) != len(names) or None in match:
            report_singular(self.residuals, names, incidence, match, self.where, self.mistakes, place)
            return None
        dummies = self.choose_dummies(started) if self.differentiate_constraints() else None
        if dummies is None:
            return None
        states: list[Symbol] = []
        unknowns: list[Symbol] = []
        for name, top in self.order.items():
            # The orders made unknowns of begin here; the one below is solved for as a state's derivative.
            first = min((k for k in range(top + 1) if (name, k) in dummies), default=top + 1)
            split = max(first - 1, 0)
            states += [derivative(name, k) for k in range(split)]
            unknowns += [derivative(name, k) for k in range(split, top + 1)]
        return Reduced(tuple(self.residuals), tuple(unknowns), tuple(states))

    def _add(self, residual: Residual) -> None:
        self.residuals.append(residual)
        self.held.append({})
        for name, order in self.moving.derivatives(residual.expression).values():
            self.held[-1][name] = max(self.held[-1].get(name, 0), order)

    # ---- Pantelides ----

    def differentiate_constraints(self) -> bool:
        """Match every equation to a highest derivative, differentiating those that hold none of their own."""
        names = list(self.order)
        column = {name: j for j, name in enumerate(names)}
        while True:
            done = set(self.integral.values())
            newest = [row for row in range(len(self.residuals)) if row not in done]
            incidence = [
                [column[name] for name, order in self.held[row].items() if order == self.order[name]]
                for row in newest
            ]
            partner = {j: i for j, i in enumerate(match_columns(incidence, len(names))) if i is not None}
            left = sorted(set(range(len(newest))) - set(partner.values()))
            if not left:
                return True
            passed: set[int] = set()
            for start in left:
                rows, columns = alternating([start], incidence, partner)
                if passed.isdisjoint(columns):
                    passed.update(columns)
                    if not self._pass_on([newest[i] for i in rows], [names[j] for j in columns]):
                        return False

    def _pass_on(self, rows: Sequence[int], names: Sequence[str]) -> bool:
        """Differentiate equations that block one another, and with them the order of what they hold."""
        for row in rows:
            if not self._moves_on(row):
                what = (
                    "holds no unknown once what the connections and other equations say is put in: "
                    "it says what they say already, or contradicts them"
                )
                self._report("E502", row, f"{self.residuals[row].shown} {what}")
                return False
        for name in names:
            self.order[name] += 1
        if any(self.order[name] > HIGHEST_ORDER for name in names):
            return self._report_endless(rows)
        return all(self._differentiate(row) for row in rows)

    def _differentiate(self, row: int) -> bool:
        residual = self.residuals[row]
        if derivative_size(residual.expression) > LARGEST:
            return self._report_endless([row])
        try:
            expression = self.moving.differentiate(residual.expression)
        except NoDerivativeError as missing:
            report_no_derivative(residual, missing, self.mistakes)
            return False
        self.integral[len(self.residuals)] = row
        self._add(Residual(expression, residual.equation))
        return True

    def _moves_on(self, row: int) -> bool:
        """Return whether an equation holds what a derivative of it may determine.

        One that holds nothing has cancelled. One whose derivatives hold nothing new, though conditions were
        passed by that hold higher ones, asks for its unknowns in conditions only.
        """
        held, same = self.held[row], 0
        while (before := self.integral.get(row)) is not None and self.held[before] == held:
            row, same = before, same + 1
        return bool(held) and same <= max(held.values())

    def _report_endless(self, rows: Iterable[int]) -> bool:
        shown = list(dict.fromkeys(self.residuals[row].shown for row in rows))
        what = f"no number of derivatives of these equations determines what they hold: {', '.join(shown)}"
        self._report("E509", next(iter(rows)), what)
        return False

    def _report(self, code: str, row: int, what: str, hint: str = "") -> None:
        self.mistakes.add(code, self.residuals[row].equation.place, what, hint=hint)

    # ---- dummy derivatives ----

    def choose_dummies(self, started: Set[Symbol]) -> set[Derivative] | None:
        """Return the derivatives that become unknowns, level by level from the highest order down.

        At each level as many as there are constraints, so that the constraints' Jacobian in them is regular.
        """
        rank = {name: j for j, name in enumerate(self.order)}
        chosen: set[Derivative] = set()
        done = set(self.integral.values())
        rows = [row for row in self.integral if row not in done]
        candidates = [(name, order) for name, order in self.order.items() if order]
        while rows:
            candidates.sort(key=lambda it: (derivative(it[0], it[1] - 1) in started, -it[1], -rank[it[0]]))
            level = self._regular_columns(rows, candidates)
            if level is None:
                return None
            chosen |= set(level)
            rows = [self.integral[row] for row in rows if self.integral[row] in self.integral]
            candidates = [(name, order - 1) for name, order in level if order > 1]
        return chosen

    def _regular_columns(
        self, rows: Sequence[int], candidates: Sequence[Derivative]
    ) -> list[Derivative] | None:
        """Return the first columns, in the order given, in which the rows' Jacobian is regular.

        Elimination column by column; a factor that moves, such as 2·x, may vanish and is no pivot.
        """
        symbols = {derivative(*one): one for one in candidates}
        forms = [linear_form(self.residuals[row].expression, frozenset(symbols)) for row in rows]
        linear = [form[0] for form in forms if form is not None]
        if len(linear) < len(rows):  # else a derivative is linear in the highest derivatives
            row = rows[forms.index(None)]
            what = "a condition hangs on a derivative that it ties down"
            what = f"{self.where}: in the constraint {self.residuals[row].shown} {what}"
            self._report("E509", row, what, "a condition on positions, parameters or time")
            return None
        system = Elimination(linear, self.divisors, "", LARGEST)
        chosen = []
        for s, one in symbols.items():
            fixed = [
                (not system.rows[i][s].is_number, len(system.rows[i]), i)
                for i in system.holders[s]
                if self._stays(system.rows[i][s])
            ]
            if fixed:
                system.clear(min(fixed)[-1], s)
                chosen.append(one)
        for i, entries in system.rows.items():
            self._report_no_choice(rows[i], entries)
        return None if system.rows else chosen

    def _stays(self, factor: Term) -> bool:
        still = TIME not in factor.free_symbols and not self.moving.derivatives(factor)
        return still and not self.divisors.vanishes(factor)

    def _report_no_choice(self, row: int, entries: Mapping[Term, Term]) -> None:
        """Say that from a constraint no variable follows."""
        constraint = f"the constraint {self.residuals[row].shown}"
        if all(self.divisors.vanishes(factor) for factor in entries.values()):
            self._report("E502", row, f"{self.where}: {constraint} says what other constraints say already")
            return
        named = self.moving.derivatives(sum(entries))
        factors = ", ".join(f"{x} (by the factor {text_of(entries[s])})" for s, (x, _) in named.items())
        what = (
            f"{self.where}: no variable follows from {constraint} in every position, "
            f"since the factor moves and may vanish: {factors}"
        )
        self._report(
            "E509", row, what, "the constraint with an angle or another coordinate that gives every position"
        )
