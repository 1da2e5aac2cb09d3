"""Alias elimination: equations a = b, a = -b and a = 0 taken out, and what stands for what.

Takes: residuals and the symbols of their variables. Gives: `Aliases`.
Guarantees: of two names that mean the same the one to be preferred as a state is kept, and of both one value.
Does not: look at equations of more than two unknowns.
"""

from __future__ import annotations

from collections.abc import Sequence, Set

from sympy import Add

from apc.compiler.equations.derivatives import Derivative, Derivatives
from apc.compiler.equations.residuals import Residual
from apc.compiler.equations.solution import Assignment
from apc.compiler.equations.terms import ZERO, Term


class Aliases:
    """The equations a = b, a = -b and a = 0 between unknowns taken out, and what stands for what.

    Of two, the one with a start value stays; then the one a component declares, not the connector's:
    `device.x`, not `device.flange.x`; then the one named first. The equations der(x) = v are taken out too:
    v is then the name of the derivative, so that masses with one position are seen to have one velocity.
    """

    def __init__(self, derivatives: Derivatives, names: Sequence[str], started: Set[str]) -> None:
        self.derivatives = derivatives
        self.names = names
        self.rank = {name: (name not in started, name.count("."), j) for j, name in enumerate(names)}
        self.parent: dict[str, tuple[str, int]] = {}  # name -> ± another; sign 0: zero
        self.velocities: dict[str, str] = {}  # x -> v
        self._position: dict[str, str] = {}  # v -> x
        self._row: dict[str, int] = {}  # x -> the row that says der(x) = v

    @property
    def kept(self) -> list[str]:
        """The names that stand for themselves."""
        return [name for name in self.names if name not in self.parent]

    @property
    def assignments(self) -> tuple[Assignment, ...]:
        """What each of the other names stands for."""
        return tuple((name, self._stands_for(name, 0)) for name in self.names if name in self.parent)

    def substitute(self, expression: Term) -> Term:
        """Return the expression in the names kept."""
        derivatives = self.derivatives.derivatives(expression)
        other = {
            s: one for s, derivative in derivatives.items() if (one := self._stands_for(*derivative)) is not s
        }
        return expression.xreplace(other) if other else expression  # putting it together anew takes longest

    def remove(self, residuals: Sequence[Residual]) -> list[Residual]:
        """Take the alias equations out, pass by pass until none is left; return the others, rewritten."""
        rows = dict(enumerate(residuals))
        changed = True
        while changed:
            changed = False
            said = set(self._row.values())
            for row, residual in list(rows.items()):
                if row in said:
                    continue
                expression = self.substitute(residual.expression)
                rows[row] = Residual(expression, residual.equation)
                match self._pair(expression):
                    case ((one, 0), (two, 0), sign):
                        said -= self._join(one, two, sign)
                        del rows[row]
                        changed = True
                    case ((x, 1), (v, 0), 1) | ((v, 0), (x, 1), 1) if self._can_name(x, v):
                        self.velocities[x], self._position[v], self._row[x] = v, x, row
                        said.add(row)
                        changed = True
        said = set(self._row.values())
        return [residual for row, residual in rows.items() if row not in said]

    def _pair(self, expression: Term) -> tuple[Derivative, Derivative, int] | None:
        """Return a, b and the sign of a = ±b; for a = 0, a twice and the sign 0; else None."""
        if expression == 0 or len(expression.args) > 2:
            return None
        derivatives = self.derivatives.derivatives(expression)
        parts = [part.as_coeff_Mul() for part in Add.make_args(expression)]
        if not all(name in derivatives for _, name in parts):
            return None
        (factor, one), (other_factor, two) = parts[0], parts[-1]
        if len(parts) == 1:
            return derivatives[one], derivatives[one], 0
        if abs(factor) != abs(other_factor):
            return None
        return derivatives[one], derivatives[two], -1 if factor == other_factor else 1

    def _join(self, one: str, two: str, sign: int) -> set[int]:
        """Let one name stand for the other; return the rows der(x) = v to be read again in the new names."""
        goes, stays = (one, two) if self.rank[one] >= self.rank[two] else (two, one)
        self.parent[goes] = (stays, sign)
        reopened = set()
        for x in [name for name in (goes, self._position.get(goes)) if name in self._row]:
            assert x is not None
            del self._position[self.velocities.pop(x)]
            reopened.add(self._row.pop(x))
        return reopened

    def _can_name(self, x: str, v: str) -> bool:
        """Return whether v may be the name of der(x): each once, and not in a circle."""
        if x in self.velocities or v in self._position:
            return False
        follows = v
        while follows in self.velocities:
            follows = self.velocities[follows]
        return follows != x

    def _stands_for(self, name: str, order: int) -> Term:
        sign = 1
        while sign:
            if name in self.parent:
                name, its_sign = self.parent[name]
                sign *= its_sign
            elif order and name in self.velocities:
                name, order = self.velocities[name], order - 1
            else:
                found = self.derivatives.symbol(name, order)
                return found if sign == 1 else -found
        return ZERO
