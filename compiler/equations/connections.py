"""Connected connectors and their connection equations.

Takes: the parts of one peer type. Gives: `connection_equations`.
Guarantees: connected potentials are equal, connected flows sum to zero; at the ground potentials are zero and
flows are unconstrained.
Does not: expand the parts' own equations (see `flatten`).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from fractions import Fraction

from apc.compiler.components.parts import GROUND
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.language.expression import Call, Expr, Name, NumberLiteral
from apc.compiler.topology.instances import PartInstance
from apc.compiler.wording import enumerated

Terminal = tuple[str, str]  # (part, connector)
ZERO = NumberLiteral(Fraction(0))


def connection_equations(
    parts: Sequence[PartInstance], groups: Sequence[str], mistakes: Mistakes
) -> Iterator[tuple[Expr, Expr, SourceLocation]]:
    """Yield the equations (left, right, location) of each set of connected connectors.

    In each set the connector of a mass comes before the connectors connected to it. Connections to the ground
    are separate sets: the ground connects nothing. A connection to a part that the peers of `groups` do not
    have is recorded.
    """
    by_name = {part.name: part for part in parts}
    connectors = {(part.name, name): type_ for part in parts for name, type_ in part.component.connectors}
    set_of = {terminal: [terminal] for terminal in connectors}

    def merge(terminal: Terminal, other: Terminal) -> None:
        """Merge the sets of two connectors."""
        moved, merged = set_of[terminal], set_of[other]
        if moved is not merged:
            merged.extend(moved)
            set_of.update(dict.fromkeys(moved, merged))

    passed, grounded = set(), set()
    for part in parts:
        for connector, inner, other_connector in part.component.passed:
            passed.add((part.name, connector))
            merge((part.name, connector), (f"{part.name}.{inner}", other_connector))
    for part in parts:
        for connector, other, other_connector in part.connections:
            if other == GROUND:
                grounded.add((part.name, connector))
            elif other in by_name:
                merge((part.name, connector), (other, other_connector))
            else:
                where = f"{'group' if len(groups) == 1 else 'groups'} {enumerated(groups)}"
                message = f"{part.name} is connected to {other}, missing in {where}"
                advice = "use the same at: for both"
                mistakes.add("E210", part.location, message, advice=advice)
    for members in dict.fromkeys(map(tuple, set_of.values())):
        terminals = [terminal for terminal in members if terminal not in passed]
        location, type_ = by_name[terminals[-1][0]].location, connectors[terminals[0]]
        is_free = grounded.isdisjoint(members)
        for potential in type_.potentials:
            terms = [_name(terminal, potential.name) for terminal in terminals]
            yield from ((name, terms[0] if is_free else ZERO, location) for name in terms[is_free:])
        for flow in type_.flows if is_free else ():
            yield _sum([_name(terminal, flow.name) for terminal in terminals]), ZERO, location


def _name(terminal: Terminal, variable: str) -> Name:
    """Return the name of a variable of a connector in the expression of a peer type."""
    return Name((*terminal[0].split("."), terminal[1], variable))


def _sum(terms: Sequence[Expr]) -> Expr:
    """Return a sum as a balanced tree, so that a thousand parts can be connected at one connector."""
    if len(terms) == 1:
        return terms[0]
    half = len(terms) // 2 if len(terms) > 16 else -1  # short sums keep their order
    return Call("+", (_sum(terms[:half]), _sum(terms[half:])))
