"""The time-varying symbols of a term, and time derivatives of terms.

Takes: names of variables, and which values jump. Gives: `Derivative`, `DifferentiatedNames`.
Guarantees: a derivative that doesn't exist is refused.
Does not: choose states (see `index`).
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass

from apc.compiler.equations.terms import (
    ONE,
    ZERO,
    NoDerivativeError,
    Symbol,
    Term,
    derivative,
    differential,
    in_order,
    symbol,
)

TIME = symbol("time")
Derivative = tuple[str, int]  # a variable and how often it is differentiated


@dataclass(frozen=True, slots=True)
class DifferentiatedNames:
    """The names of time-varying quantities: `variables`, and held forces, which jump."""

    variables: Collection[str]
    jumping: Collection[str]

    def derivatives(self, expression: Term) -> dict[Symbol, Derivative]:
        """Return the variables and derivatives an expression holds, in the order of their names."""
        orders = {s: s.name.count("der(") for s in in_order(expression.free_symbols)}
        result = {s: (s.name[4 * order : len(s.name) - order], order) for s, order in orders.items()}
        return {s: pair for s, pair in result.items() if pair[0] in self.variables}

    def differentiate(self, expression: Term) -> Term:
        """Return the time derivative. Raises NoDerivativeError if a held force would have to give it."""
        held = self.derivatives(expression)

        def rate(s: Symbol) -> Term:
            if s.name in self.jumping:
                raise NoDerivativeError(f"{s.name}, a force that jumps at its ticks")
            if s in held:
                name, order = held[s]
                return derivative(name, order + 1)
            return ONE if s is TIME else ZERO

        return differential(expression, rate)
