"""Alias elimination: removal of equations a = b, a = -b and a = 0, and the resulting substitutions.

Takes: residuals, and the time-varying symbols. Gives: `Aliases`.
Guarantees: of two aliases the preferred state is retained, with one start value.
Does not: use equations with more than two unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence, Set

from sympy import Add

from apc.compiler.equations.derivatives import Derivative, DifferentiatedNames
from apc.compiler.equations.solution import Assignment, Residual
from apc.compiler.equations.terms import Term, derivative, symbol


class Aliases:
    """The eliminated equations a = b, a = -b and a = 0 between unknowns, and the substitutions.

    Of two unknowns the one with a start value is retained; else the one declared by a component instead of a
    connector (`device.x`, not `device.flange.x`); else the first. For der(x) = v, v is an alias of der(x), so
    that masses with the same position have the same velocity; der(x) is printed as v.
    """

    def __init__(self, time_varying: DifferentiatedNames, started: Set[str]) -> None:
        """Rank the variables for elimination; `started` are the variables with a start value."""
        self.time_varying = time_varying
        self.names = sorted(time_varying.variables, key=lambda name: (name not in started, name.count(".")))
        self.rank = {name: index for index, name in enumerate(self.names)}
        # By name of the eliminated variable: sign (or 0), retained variable, order of its derivative.
        self.replacements: dict[str, tuple[int, str, int]] = {}
        self.named_derivatives: dict[Derivative, str] = {}  # derivatives with a variable name

    def _named_derivatives(self) -> dict[Derivative, str]:
        """Return the variable that is the alias of each derivative, by variable and order."""
        result: dict[Derivative, str] = {}
        for name in self.names:
            sign, x, order = self._retained(name, 0)
            if sign == 1 and order:
                result.setdefault((x, order), name)
        return result

    def value(self, name: str, order: int = 0) -> Term:
        """Return the derivative of a variable as a term in the retained variables."""
        sign, name, order = self._retained(name, order)
        return sign * derivative(name, order)

    def substitute(self, expression: Term) -> Term:
        """Return an expression in the retained variables."""
        variables = self.time_varying.derivatives(expression)
        return expression.xreplace(
            {s: self.value(*pair) for s, pair in variables.items() if pair[0] in self.replacements}
        )

    def shown(self, expression: Term) -> Term:
        """Return an expression for printing: derivatives with a variable name have this name."""
        names = {}
        for s, (x, order) in self.time_varying.derivatives(expression).items():
            index = next((k for k in range(order, 0, -1) if (x, k) in self.named_derivatives), 0)
            names[s] = derivative(self.named_derivatives.get((x, index), x), order - index)
        return expression.xreplace(names)

    def assignments(self) -> tuple[Assignment, ...]:
        """Return the eliminated variables, each with its term in the retained variables."""
        values = ((name, self.shown(self.value(name))) for name in self.time_varying.variables)
        return tuple((name, value) for name, value in values if value is not symbol(name))

    def remove(self, residuals: Sequence[Residual]) -> list[Residual]:
        """Return the residuals that remain after elimination of all alias equations, in the retained
        variables.
        """
        previous_count, remaining = -1, list(residuals)
        while previous_count != len(remaining):
            previous_count = len(remaining)
            remaining = [
                Residual(expression, residual.equation)
                for residual in remaining
                if not self._eliminate(expression := self.substitute(residual.expression))
            ]
        self.named_derivatives = self._named_derivatives()
        return remaining

    def _eliminate(self, expression: Term) -> bool:
        """Record the substitution for an equation a = ±b or a = 0; return whether it was recorded."""
        variables = self.time_varying.derivatives(expression)
        terms = [part.as_coeff_Mul() for part in Add.make_args(expression)]
        if len(terms) > 2 or any(name not in variables for _, name in terms):
            return False
        (first_factor, first), (last_factor, last) = terms[0], terms[-1]
        pair = sorted((variables[first], variables[last]), key=lambda it: (it[1], -self.rank[it[0]]))
        (eliminated, low), (retained, high) = pair
        sign = 0 if len(terms) == 1 else -1 if first_factor == last_factor else 1
        named = sign == 1 or high == 0 or (retained, high) in self._named_derivatives()
        if low or abs(first_factor) != abs(last_factor) or not named or (eliminated == retained and sign):
            return False
        self.replacements[eliminated] = (sign, retained, high)
        return True

    def _retained(self, name: str, order: int) -> tuple[int, str, int]:
        """Return the sign, the retained variable and the order that represent a derivative of a variable."""
        sign = 1
        while sign and name in self.replacements:
            factor, name, extra_order = self.replacements[name]
            sign, order = sign * factor, order + extra_order
        return sign, name, order
