"""Index reduction: equations differentiated until every derivative can be solved for, and states chosen.

Takes: residuals in variables and their derivatives (see `derivatives`). Gives: `reduce_index`: the equations
to solve, their unknowns, and the states.
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

from collections.abc import Iterable, Sequence, Set
from dataclasses import dataclass

from apc.compiler.equations.derivatives import TIME, Derivative, Derivatives
from apc.compiler.equations.matching import alternating, match_columns
from apc.compiler.equations.residuals import SCENE, Residual, report_singular
from apc.compiler.equations.symbolic import linear_form
from apc.compiler.equations.terms import ZERO, NoDerivativeError, Symbol, Term, size, text_of
from apc.compiler.equations.zero_test import NOTHING_VANISHES, Vanishing, ZeroTest
from apc.compiler.errors import Mistakes, Place

# More derivatives than this of one variable: no mechanical model needs them (a constraint on a position
# needs two), so the equations do not end.
HIGHEST_ORDER = 8

# Nodes of a derivative: that of a product of nonlinear factors is longer than the product. The derivatives
# of the joints of a mechanism have some hundreds of them.
LARGEST = 20_000


@dataclass(frozen=True, slots=True)
class Reduced:
    """Equations to solve for the unknowns. `states` are x, and der(x) where der(der(x)) is solved."""

    residuals: tuple[Residual, ...]
    unknowns: tuple[Symbol, ...]
    states: tuple[Symbol, ...]


def reduce_index(
    residuals: Sequence[Residual],
    names: Sequence[str],
    started: Set[str],
    derivatives: Derivatives,
    where: str,
    mistakes: Mistakes,
    vanishes: Vanishing = NOTHING_VANISHES,
    place: Place = SCENE,
) -> Reduced | None:
    """Differentiate what must be and choose the states; None if the equations can't be solved.

    Parameters
    ----------
    residuals, names
        The equations, and the variables they hold, in the order of preference as states.
    started
        The variables with a declared start value.
    derivatives
        Knows the symbols of `names` and of their derivatives.
    where
        What to call the equations in a message.
    mistakes
        Takes E502 equations or unknowns left over or constraints that say the same, E508 the derivative of a
        value that jumps, E509 states that can't be chosen once and for all.
    vanishes
        Whether an expression is zero with the scene's numbers.
    place
        Where to point when there is no equation left.
    """
    column = {name: j for j, name in enumerate(names)}
    incidence = [
        sorted({column[n] for n, _ in derivatives.derivatives(r.expression).values()}) for r in residuals
    ]
    match = match_columns(incidence, len(names))
    if len(residuals) != len(names) or None in match:
        report_singular(residuals, names, incidence, match, where, mistakes, place)
        return None
    system = _System(residuals, names, derivatives, vanishes)
    if not system.differentiate_constraints(mistakes):
        return None
    dummies = system.choose_dummies(started, where, mistakes)
    if dummies is None:
        return None
    states: list[Symbol] = []
    unknowns: list[Symbol] = []
    for name in names:
        top = system.order[name]
        # The orders made unknowns of begin here; the one below is solved for as the derivative of a state.
        first = min((k for k in range(top + 1) if (name, k) in dummies), default=top + 1)
        split = max(first - 1, 0)
        states += [derivatives.symbol(name, k) for k in range(split)]
        unknowns += [derivatives.symbol(name, k) for k in range(split, top + 1)]
    return Reduced(tuple(system.residuals), tuple(unknowns), tuple(states))


class _System:
    """The equations as they grow: each may have a derivative, which then takes its place in the matching."""

    def __init__(
        self,
        residuals: Sequence[Residual],
        names: Sequence[str],
        derivatives: Derivatives,
        vanishes: Vanishing,
    ) -> None:
        self.vanishes = vanishes
        self.residuals = list(residuals)
        self.names = names
        self.derivatives = derivatives
        self.held: list[dict[str, int]] = []  # for each equation, its variables and their highest orders
        self.derivative: dict[int, int] = {}  # equation -> its derivative
        self.integral: dict[int, int] = {}  # and back
        # A derivative with a name of its own is asked for, even if no equation holds it.
        self.order = {name: derivatives.named_order(name) for name in names}
        for residual in residuals:
            self._hold(residual)
        for orders in self.held:
            for name, order in orders.items():
                self.order[name] = max(self.order[name], order)

    def _hold(self, residual: Residual) -> None:
        orders: dict[str, int] = {}
        for name, order in self.derivatives.derivatives(residual.expression).values():
            orders[name] = max(orders.get(name, 0), order)
        self.held.append(orders)

    # ---- Pantelides ----

    def differentiate_constraints(self, mistakes: Mistakes) -> bool:
        """Match every equation to a highest derivative, differentiating those that hold none of their own."""
        column = {name: j for j, name in enumerate(self.names)}
        while True:
            newest = [row for row in range(len(self.residuals)) if row not in self.derivative]
            incidence = [
                [column[name] for name, order in self.held[row].items() if order == self.order[name]]
                for row in newest
            ]
            match = match_columns(incidence, len(column))
            partner = {j: i for j, i in enumerate(match) if i is not None}
            left = sorted(set(range(len(newest))) - set(partner.values()))
            if not left:
                return True
            passed: set[int] = set()
            for start in left:
                blocked, columns = alternating([start], incidence, partner)
                if passed.isdisjoint(columns):
                    passed.update(columns)
                    names = [self.names[j] for j in columns]
                    if not self._pass_on([newest[i] for i in blocked], names, mistakes):
                        return False

    def _pass_on(self, rows: Sequence[int], names: Sequence[str], mistakes: Mistakes) -> bool:
        """Differentiate equations that block one another, and with them the order of what they hold."""
        if still := [row for row in rows if not self._moves_on(row)]:
            self._report_empty(still[0], mistakes)
            return False
        for name in names:
            self.order[name] += 1
            if self.order[name] > HIGHEST_ORDER:
                self._report_endless(rows, mistakes)
                return False
        return all(self._differentiate(row, mistakes) for row in rows)

    def _differentiate(self, row: int, mistakes: Mistakes) -> bool:
        residual = self.residuals[row]
        try:
            expression = self.derivatives.differentiate(residual.expression)
        except NoDerivativeError as missing:
            report_no_derivative(residual, missing, mistakes)
            return False
        self.derivative[row], self.integral[len(self.residuals)] = len(self.residuals), row
        if size(expression) > LARGEST:
            self._report_endless([row], mistakes)
            return False
        made = Residual(expression, residual.equation)
        self.residuals.append(made)
        self._hold(made)
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

    def _report_empty(self, row: int, mistakes: Mistakes) -> None:
        """Say that what an equation holds cancels, in itself or in its derivative."""
        residual = self.residuals[row]
        what = (
            f"{residual.shown} holds no unknown once what the connections and other equations say is put in: "
            "it says what they say already, or contradicts them"
        )
        mistakes.add("E502", residual.equation.place, what)

    def _report_endless(self, rows: Iterable[int], mistakes: Mistakes) -> None:
        roots = list(dict.fromkeys(self.residuals[row].equation for row in rows))
        texts = ", ".join(f"`{equation.text}` ({equation.origin})" for equation in roots)
        what = f"no number of derivatives of these equations determines what they hold: {texts}"
        mistakes.add("E509", roots[0].place, what)

    # ---- dummy derivatives ----

    def choose_dummies(self, started: Set[str], where: str, mistakes: Mistakes) -> set[Derivative] | None:
        """Return the derivatives that become unknowns, level by level from the highest order down.

        At each level as many as there are constraints, so that the constraints' Jacobian in them is regular.
        """
        rank = {name: j for j, name in enumerate(self.names)}

        def wanted_last(derivative: Derivative) -> tuple[bool, int, int]:
            name, order = derivative
            return self.derivatives.symbol(name, order - 1).name in started, -order, -rank[name]

        chosen: set[Derivative] = set()
        rows = [row for row in self.integral if row not in self.derivative]
        candidates: Iterable[Derivative] = [(name, order) for name, order in self.order.items() if order]
        while rows:
            level = self._regular_columns(rows, sorted(candidates, key=wanted_last), where, mistakes)
            if level is None:
                return None
            chosen |= set(level)
            rows = [self.integral[row] for row in rows if self.integral[row] in self.integral]
            candidates = [(name, order - 1) for name, order in level if order > 1]
        return chosen

    def _regular_columns(
        self, rows: Sequence[int], candidates: Sequence[Derivative], where: str, mistakes: Mistakes
    ) -> list[Derivative] | None:
        """Return the first columns, in the order given, in which the rows' Jacobian is regular.

        Elimination column by column; a factor that moves, such as 2·x, may vanish and is no pivot.
        """
        symbols = {self.derivatives.symbol(*derivative): derivative for derivative in candidates}
        is_zero = ZeroTest()
        matrix: dict[int, dict[Derivative, Term]] = {}
        for row in rows:
            form = linear_form(self.residuals[row].expression, symbols.keys())
            if form is None:  # else a derivative is linear in the highest derivatives
                self._report_condition(row, where, mistakes)
                return None
            matrix[row] = {symbols[s]: c for s, c in form[0].items() if not is_zero(c)}
        columns: dict[Derivative, dict[int, None]] = {derivative: {} for derivative in candidates}
        for row, entries in matrix.items():
            for derivative in entries:
                columns[derivative][row] = None
        chosen: list[Derivative] = []
        for derivative in candidates:
            still = [row for row in columns[derivative] if row in matrix and derivative in matrix[row]]
            fixed = [
                row
                for row in still
                if not self._moves(matrix[row][derivative]) and not self.vanishes(matrix[row][derivative])
            ]
            if not fixed:
                continue
            pivot = min(
                fixed,
                key=lambda row: (not matrix[row][derivative].is_number, len(matrix[row]), row),
            )
            entries = matrix.pop(pivot)
            chosen.append(derivative)
            for row in still:
                if row == pivot:
                    continue
                factor = matrix[row][derivative] / entries[derivative]
                for other, value in entries.items():
                    left = matrix[row].get(other, ZERO) - factor * value
                    if other == derivative or is_zero(left):
                        matrix[row].pop(other, None)
                    else:
                        matrix[row][other] = left
                        columns[other][row] = None
        if matrix:
            self._report_no_choice(matrix, where, mistakes)
            return None
        return chosen

    def _moves(self, expression: Term) -> bool:
        return TIME in expression.free_symbols or bool(self.derivatives.derivatives(expression))

    def _report_condition(self, row: int, where: str, mistakes: Mistakes) -> None:
        """Say that a branch of a constraint is chosen by what the constraint's derivatives would give."""
        residual = self.residuals[row]
        what = (
            f"{where}: in the constraint {residual.shown} a condition hangs on a derivative that it ties down"
        )
        mistakes.add(
            "E509", residual.equation.place, what, hint="a condition on positions, parameters or time"
        )

    def _report_no_choice(
        self, matrix: dict[int, dict[Derivative, Term]], where: str, mistakes: Mistakes
    ) -> None:
        """Say which constraints are left without a variable that follows from them."""
        for row, entries in matrix.items():
            residual = self.residuals[row]
            if entries and not all(self.vanishes(c) for c in entries.values()):
                factors = ", ".join(
                    f"{name} (by the factor {text_of(entries[name, order])})"
                    for name, order in sorted(entries)
                )
                what = (
                    f"{where}: no variable follows from the constraint {residual.shown} in every position, "
                    f"since the factor moves and may vanish: {factors}"
                )
                hint = "the constraint with an angle or another coordinate that gives every position"
                mistakes.add("E509", residual.equation.place, what, hint=hint)
            else:
                what = f"{where}: the constraint {residual.shown} says what other constraints say already"
                mistakes.add("E502", residual.equation.place, what)


def report_no_derivative(residual: Residual, missing: NoDerivativeError, mistakes: Mistakes) -> None:
    """Add the mistake E508: an equation's derivative is needed, and what it holds has none."""
    what = f"{residual.shown} needs the derivative of {missing}"
    why = "a position follows such a force only through a mass"
    mistakes.add("E508", residual.equation.place, f"{what}; {why}")
