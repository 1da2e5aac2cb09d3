"""The symbols of variables and of their time derivatives, both ways, and differentiation by them.

Takes: names of variables, and which values jump. Gives: `Derivative`, `derivative`, `Moving`.
Guarantees: one symbol for each derivative of each variable: `x`, `der(x)`, `der(der(x))`.
Does not: choose states (see `index`).
"""

from __future__ import annotations

from collections.abc import Set
from dataclasses import dataclass

from apc.compiler.equations.symbolic import differential
from apc.compiler.equations.terms import ONE, ZERO, NoDerivativeError, Symbol, Term, in_order, symbol

TIME = symbol("time")
Derivative = tuple[str, int]  # a variable and how often it is differentiated


def derivative(name: str, order: int = 1) -> Symbol:
    """Return the symbol of a time derivative of a variable."""
    return symbol("der(" * order + name + ")" * order)


@dataclass(frozen=True, slots=True)
class Moving:
    """The names of what moves: `variables`, and those of held forces, which jump."""

    variables: Set[str]
    jumping: Set[str]

    def derivatives(self, expression: Term) -> dict[Symbol, Derivative]:
        """Return the variables and derivatives an expression holds, in the order of their names."""
        found = {}
        for s in in_order(expression.free_symbols):
            order = s.name.count("der(")
            name = s.name[4 * order : len(s.name) - order]
            if name in self.variables:
                found[s] = (name, order)
        return found

    def differentiate(self, expression: Term) -> Term:
        """Return the time derivative. Raises NoDerivativeError if a held force would have to give it."""
        held = self.derivatives(expression)

        def rate(s: Symbol) -> Term:
            if s.name in self.jumping:
                raise NoDerivativeError(s.name, "a force that jumps at its ticks")
            if s in held:
                name, order = held[s]
                return derivative(name, order + 1)
            return ONE if s is TIME else ZERO

        return differential(expression, rate)
