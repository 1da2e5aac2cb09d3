"""Connectors that meet, and the equations of their meeting.

Takes: the parts of one peer type. Gives: `connection_equations`.
Guarantees: potentials that meet are equal, flows that meet sum to zero; at the ground potentials are zero and
flows whatever they must be.
Does not: write out the parts' own equations (see `flatten`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction

from apc.compiler.components.parts import GROUND
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.expression import Call, Expr, Name, NumberLiteral
from apc.compiler.topology.instances import PartInstance

Terminal = tuple[str, str]  # (part, connector)
ZERO = NumberLiteral(Fraction(0))


def connection_equations(
    parts: Sequence[PartInstance], mistakes: Mistakes
) -> Iterator[tuple[Expr, Expr, SourceLocation]]:
    """Yield the equations (left, right, place) of each set of connected connectors.

    Each set is ordered outwards: a mass's connector comes before those connected to it. The ground joins
    nothing: each set has its own.
    """
    by_name = {part.name: part for part in parts}
    connectors = {(part.name, local): type_ for part in parts for local, type_ in part.component.connectors}
    meeting = {terminal: [terminal] for terminal in connectors}

    def join(pair: Terminal, other: Terminal) -> None:
        joining, joined = meeting[pair], meeting[other]
        if joining is not joined:
            joined.extend(joining)
            meeting.update(dict.fromkeys(joining, joined))

    passed, grounded = set(), set()
    for part in parts:
        for connector, inner, connector_of_other in part.component.passed:
            passed.add((part.name, connector))
            join((part.name, connector), (f"{part.name}.{inner}", connector_of_other))
    for part in parts:
        for connector, other, connector_of_other in part.connections:
            if other == GROUND:
                grounded.add((part.name, connector))
            elif other in by_name:
                join((part.name, connector), (other, connector_of_other))
            else:
                message = f"{part.name} is at groups where {other}, which it joins, is not"
                hint = f"at: the same groups at both {part.name} and {other}"
                mistakes.add("E210", part.location, message, hint=hint)
    for members in {id(members): members for members in meeting.values()}.values():
        joined = [terminal for terminal in members if terminal not in passed]
        location, type_ = by_name[joined[-1][0]].location, connectors[joined[0]]
        is_free = grounded.isdisjoint(members)
        for potential in type_.potentials:
            terms = [_name(terminal, potential.name) for terminal in joined]
            yield from ((name, terms[0] if is_free else ZERO, location) for name in terms[is_free:])
        for flow in type_.flows if is_free else ():
            yield _sum([_name(terminal, flow.name) for terminal in joined]), ZERO, location


def _name(terminal: Terminal, variable: str) -> Name:
    return Name((*terminal[0].split("."), terminal[1], variable))


def _sum(terms: Sequence[Expr]) -> Expr:
    """Return a sum as a tree of little depth, so that a thousand parts may meet at one flange."""
    if len(terms) == 1:
        return terms[0]
    half = len(terms) // 2 if len(terms) > 16 else -1  # few read best as they are written
    return Call("+", (_sum(terms[:half]), _sum(terms[half:])))
