"""The symbols of variables and of their time derivatives, both ways, and differentiation by them.

Takes: names of variables, and which of them are others' derivatives. Gives: `Derivative`, `Derivatives`.
Guarantees: one symbol for each derivative of each variable.
Does not: choose states (see `index`).
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping

from apc.compiler.equations.symbolic import derivative_symbol, differential
from apc.compiler.equations.terms import ONE, ZERO, NoDerivativeError, Symbol, Term, in_order, symbol

TIME = symbol("time")
Derivative = tuple[str, int]  # a variable and how often it is differentiated


class Derivatives:
    """The symbols of variables and of their derivatives, `x`, `der(x)`, `der(der(x))`, both ways.

    `velocities` gives derivatives their own names: with {x: v} they are `x`, `v`, `der(v)`, and v is no
    variable of its own. `jumping` are the symbols of held forces.
    """

    def __init__(
        self, names: Iterable[str], jumping: Iterable[str], velocities: Mapping[str, str] | None = None
    ) -> None:
        velocities = velocities or {}
        derived = set(velocities.values())
        self.names = [name for name in names if name not in derived]
        self._derivatives: dict[Symbol, Derivative] = {}
        self._named: dict[str, int] = {}
        for name in self.names:
            self._derivatives[symbol(name)] = (name, 0)
            own, order = name, 0
            while own in velocities:
                own, order = velocities[own], order + 1
                self._derivatives[symbol(own)] = (name, order)
                self._named[name] = order
        self._symbols = {derivative: s for s, derivative in self._derivatives.items()}
        self._jumping = {symbol(name) for name in jumping}

    def renamed(self, names: Iterable[str], velocities: Mapping[str, str]) -> Derivatives:
        """Return the derivatives of some of the variables, where `velocities` name derivatives."""
        kept = Derivatives(names, (), velocities)
        kept._jumping = self._jumping
        for name, order in self._symbols:
            if symbol(name) in kept._derivatives:
                root, first = kept._derivatives[symbol(name)]
                kept.symbol(root, first + order)
        return kept

    def named_order(self, name: str) -> int:
        """Return how many derivatives of a variable have names of their own."""
        return self._named.get(name, 0)

    def add(self, name: str) -> Symbol:
        """Add a variable and return its symbol."""
        self.names.append(name)
        return self.symbol(name, 0)

    def symbol(self, name: str, order: int) -> Symbol:
        """Return the symbol of a derivative of a variable."""
        known = self._symbols.get((name, order))
        if known is None:
            known = derivative_symbol(self.symbol(name, order - 1).name) if order else symbol(name)
            self._derivatives[known] = (name, order)
            self._symbols[name, order] = known
        return known

    def derivatives(self, expression: Term) -> dict[Symbol, Derivative]:
        """Return the variables and derivatives an expression holds, in the order of their names."""
        held = expression.free_symbols & self._derivatives.keys()
        return {s: self._derivatives[s] for s in in_order(held)}

    def differentiate(self, expression: Term) -> Term:
        """Return the time derivative. Raises NoDerivativeError if a held force would have to give it."""
        return differential(expression, self._rate)

    def _rate(self, s: Symbol) -> Term:
        if s in self._jumping:
            raise NoDerivativeError(s.name, "a force that jumps at its ticks")
        if s in self._derivatives:
            name, order = self._derivatives[s]
            return self.symbol(name, order + 1)
        return ONE if s == TIME else ZERO
