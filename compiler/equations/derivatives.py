"""The time-varying symbols of a term, and time derivatives of terms.

Takes: names of variables, and of values with jumps. Gives: `Derivative`, `DifferentiatedNames`.
Guarantees: the derivative of a value with jumps raises an error.
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
Derivative = tuple[str, int]  # a variable and the order of its derivative


@dataclass(frozen=True, slots=True)
class DifferentiatedNames:
    """The names of time-varying quantities: `variables`, and `jumping`, the held forces, which jump
    at ticks.
    """

    variables: Collection[str]
    jumping: Collection[str]

    def derivatives(self, expression: Term) -> dict[Symbol, Derivative]:
        """Return the symbols of an expression that are variables or derivatives, sorted, with name
        and order.
        """
        orders = {s: s.name.count("der(") for s in in_order(expression.free_symbols)}
        result = {s: (s.name[4 * order : len(s.name) - order], order) for s, order in orders.items()}
        return {s: pair for s, pair in result.items() if pair[0] in self.variables}

    def differentiate(self, expression: Term) -> Term:
        """Return the time derivative of an expression.

        Raises NoDerivativeError if it contains a held force.
        """
        variables = self.derivatives(expression)

        def rate(s: Symbol) -> Term:
            """Return the time derivative of a symbol."""
            if s.name in self.jumping:
                raise NoDerivativeError(f"{s.name}, a force that is discontinuous at its ticks")
            if s in variables:
                name, order = variables[s]
                return derivative(name, order + 1)
            return ONE if s is TIME else ZERO

        return differential(expression, rate)
