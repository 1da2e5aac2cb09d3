"""Alias elimination: removal of equations a = b, a = -b and a = 0, and the resulting substitutions.

Takes: residuals, and the time-varying symbols. Gives: `Aliases`.
Guarantees: of two aliases the one preferred as a state is kept, with one start value.
Does not: use equations of more than two unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence, Set

from sympy import Add

from apc.compiler.equations.derivatives import Derivative, DifferentiatedNames
from apc.compiler.equations.solution import Assignment, Residual
from apc.compiler.equations.terms import Term, derivative, symbol


class Aliases:
    """The eliminated equations a = b, a = -b and a = 0 between unknowns, and the substitutions.

    Of two, the one with a start value stays; then the one a component declares, not the connector's:
    `device.x`, not `device.flange.x`; then the one named first. By der(x) = v, v is an alias of der(x), so
    that masses with one position have one velocity; it is printed by its name.
    """

    def __init__(self, moving: DifferentiatedNames, started: Set[str]) -> None:
        self.moving = moving
        self.names = sorted(moving.variables, key=lambda name: (name not in started, name.count(".")))
        self.rank = {name: index for index, name in enumerate(self.names)}
        self.replacements: dict[
            str, tuple[int, str, int]
        ] = {}  # name: ± (or 0 times) a derivative of another
        self.velocities: dict[Derivative, str] = {}  # derivatives that have names of their own

    def _velocities(self) -> dict[Derivative, str]:
        result: dict[Derivative, str] = {}
        for name in self.names:
            sign, x, order = self._meaning(name, 0)
            if sign == 1 and order:
                result.setdefault((x, order), name)
        return result

    def value(self, name: str, order: int = 0) -> Term:
        """Return the derivative of a variable, in the retained variables."""
        sign, name, order = self._meaning(name, order)
        return sign * derivative(name, order)

    def substitute(self, expression: Term) -> Term:
        """Return the expression in the names kept."""
        held = self.moving.derivatives(expression)
        return expression.xreplace(
            {s: self.value(*pair) for s, pair in held.items() if pair[0] in self.replacements}
        )

    def shown(self, expression: Term) -> Term:
        """Return an expression in which derivatives have their own names."""
        names = {}
        for s, (x, order) in self.moving.derivatives(expression).items():
            index = next((k for k in range(order, 0, -1) if (x, k) in self.velocities), 0)
            names[s] = derivative(self.velocities.get((x, index), x), order - index)
        return expression.xreplace(names)

    def assignments(self) -> tuple[Assignment, ...]:
        """Return the retained variable of each name that is not printed."""
        values = ((name, self.shown(self.value(name))) for name in self.moving.variables)
        return tuple((name, value) for name, value in values if value is not symbol(name))

    def remove(self, residuals: Sequence[Residual]) -> list[Residual]:
        """Take the alias equations out, pass by pass until none is left; return the others, rewritten."""
        before, left = -1, list(residuals)
        while before != len(left):
            before = len(left)
            left = [
                Residual(expression, residual.equation)
                for residual in left
                if not self._takes(expression := self.substitute(residual.expression))
            ]
        self.velocities = self._velocities()
        return left

    def _takes(self, expression: Term) -> bool:
        """Record a = ±b or a = 0, if an equation has this form and elimination is allowed."""
        held = self.moving.derivatives(expression)
        parts = [part.as_coeff_Mul() for part in Add.make_args(expression)]
        if len(parts) > 2 or any(name not in held for _, name in parts):
            return False
        (factor, item), (other, two) = parts[0], parts[-1]
        pair = sorted((held[item], held[two]), key=lambda it: (it[1], -self.rank[it[0]]))
        (goes, low), (stays, high) = pair
        sign = 0 if len(parts) == 1 else -1 if factor == other else 1
        named = sign == 1 or high == 0 or (stays, high) in self._velocities()
        if low or abs(factor) != abs(other) or not named or (goes == stays and sign):
            return False
        self.replacements[goes] = (sign, stays, high)
        return True

    def _meaning(self, name: str, order: int) -> tuple[int, str, int]:
        sign = 1
        while sign and name in self.replacements:
            factor, name, more = self.replacements[name]
            sign, order = sign * factor, order + more
        return sign, name, order
