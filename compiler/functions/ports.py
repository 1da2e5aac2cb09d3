"""Where held forces act: the connectors through which a part's held values push on what moves.

Takes: `SortedKind` and its scene. Gives: `Port`, `held_ports`.
Guarantees: the flow of a port depends on the part's own held values and on parameters alone, so that it is
constant from event to event; potential and flow together give work.
Does not: write functions.
"""

from __future__ import annotations

from dataclasses import dataclass

import sympy

from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.structure import SortedKind
from apc.compiler.equations.symbolic import symbol
from apc.compiler.language.dimensions import Dimension
from apc.compiler.scene.instances import Part
from apc.compiler.scene.scene import Scene

WORK = Dimension((("kg", 1), ("m", 2), ("s", -2)))  # the joule


@dataclass(frozen=True, slots=True)
class Port:
    """A connector of part `part`: its potential, and the flow into the part, as expressions."""

    part: str
    potential: sympy.Expr
    flow: sympy.Expr

    @property
    def symbols(self) -> set[sympy.Symbol]:
        """What the port is written in."""
        return set(self.potential.free_symbols | self.flow.free_symbols)


def held_ports(scene: Scene, kind: SortedKind) -> tuple[Port, ...]:
    """Return the ports of a kind: those whose flow follows from what their own part holds.

    The work a part does at a port over an interval in which nothing switches is, exactly, minus the flow
    into it times the change of the potential.
    """
    known = {
        symbol(step[0]): step[1]
        for step in kind.partitions[0].assignments
        if not isinstance(step, ImplicitBlock)
    }
    known |= {symbol(name): expression for name, expression in kind.aliases}
    held = {symbol(hold.symbol): hold.variable.rpartition(".")[0] for hold in kind.holds}
    moving = {symbol(name) for name in kind.states} | {symbol("time")}
    found = []
    for part in scene.parts:
        if part.name not in kind.clocked.flat.parts or part.name not in held.values():
            continue
        for potential, flow in _connector_pairs(part):
            through, at = _whole(symbol(flow), known), _whole(symbol(potential), known)
            if through is None or at is None:
                continue
            own = {s for s in through.free_symbols if held.get(s) == part.name}
            others = {s for s in through.free_symbols if s in moving or held.get(s, part.name) != part.name}
            if own and not others and not at.free_symbols & held.keys():
                found.append(Port(part.name, at, through))
    return tuple(found)


def _connector_pairs(part: Part) -> list[tuple[str, str]]:
    """Return the names of potential and flow of a part's own connectors, where they make work."""
    passed = {outer for outer, _, _ in part.component.passed}
    return [
        (f"{part.name}.{name}.{potential.name}", f"{part.name}.{name}.{flow.name}")
        for name, connector in part.component.connectors
        if name not in passed
        for potential, flow in zip(connector.potentials, connector.flows, strict=False)
        if potential.unit.dimension.multiply(flow.unit.dimension) == WORK
    ]


def _whole(wanted: sympy.Symbol, known: dict[sympy.Symbol, sympy.Expr]) -> sympy.Expr | None:
    """Return a symbol in terms of states, holds and parameters; None if a loop decides it."""
    expression = wanted
    for _ in range(len(known) + 1):
        replaceable = expression.free_symbols & known.keys()
        if not replaceable:
            return expression
        expression = expression.xreplace({s: known[s] for s in replaceable})
    return None
