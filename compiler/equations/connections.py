"""Connectors that meet, and the equations of their meeting.

Takes: the parts of one kind of peer. Gives: `connection_equations`.
Guarantees: potentials that meet are equal, flows that meet sum to zero; at the ground potentials are zero and
flows whatever they must be.
Does not: write out the parts' own equations (see `flatten`).
"""

from __future__ import annotations

import functools
from collections.abc import Iterator, Sequence
from fractions import Fraction

from apc.compiler.components.parts import GROUND
from apc.compiler.errors import Mistakes, Place
from apc.compiler.language.expression import (
    Binary,
    Expr,
    Name,
    Number,
)
from apc.compiler.scene.instances import Part

Terminal = tuple[str, str]  # (part, connector)
Meeting = tuple[Expr, Expr, Place]  # an equation, and where what meets is joined


def connection_equations(parts: list[Part], mistakes: Mistakes) -> Iterator[Meeting]:
    """Yield, for each set of connectors that meet: potentials equal, flows summing to zero.

    In a set with the ground the potentials are zero and the flows are whatever they must be.
    """
    here = {part.name: part for part in parts}
    passed: dict[Terminal, list[Terminal]] = {}
    for part in parts:
        for connector, inner, its in part.component.passed:
            passed.setdefault((part.name, connector), []).append((f"{part.name}.{inner}", its))
    for members in _meeting(parts, here, passed, mistakes):
        grounded = (GROUND, "") in members
        joined = [node for node in members if node[0] != GROUND and node not in passed]
        first_part, first_connector = joined[0]
        type_ = dict(here[first_part].component.connectors)[first_connector]
        place = here[joined[-1][0]].place
        for variable in type_.potentials:
            names = [_whole_name(node, variable.name) for node in joined]
            if grounded:
                for name in names:
                    yield name, Number(Fraction(0)), place
            else:
                for name in names[1:]:
                    yield name, names[0], place
        if grounded:
            continue
        for variable in type_.flows:
            total = _sum([_whole_name(node, variable.name) for node in joined])
            yield total, Number(Fraction(0)), place


def _sum(terms: Sequence[Expr]) -> Expr:
    """Return a sum as a tree of little depth, so that a thousand parts may meet at one flange."""
    if len(terms) <= 16:  # few read best as they are written, one after the other
        return functools.reduce(lambda total, term: Binary("+", total, term), terms)
    half = len(terms) // 2
    return Binary("+", _sum(terms[:half]), _sum(terms[half:]))


def _whole_name(node: Terminal, variable: str) -> Name:
    return Name((*node[0].split("."), node[1], variable))


def _meeting(
    parts: list[Part], here: dict[str, Part], passed: dict[Terminal, list[Terminal]], mistakes: Mistakes
) -> Iterator[list[Terminal]]:
    """Yield the sets of connectors that meet, each read from what is joined to outwards."""
    sets: dict[Terminal, list[Terminal]] = {}
    for part in parts:
        for connector, _ in part.component.connectors:
            sets[(part.name, connector)] = [(part.name, connector)]

    def join(one: Terminal, two: Terminal) -> None:
        mine, other = sets[one], sets[two]
        if mine is not other:
            # What is joined to comes first, so that a set reads from the mass outwards.
            other.extend(mine)
            for member in mine:
                sets[member] = other

    for outer, inside in passed.items():
        for inner in inside:
            join(outer, inner)
    for part in parts:
        for connector, other, its_connector in part.connections:
            own = (part.name, connector)
            if other == GROUND:
                if (GROUND, "") not in sets[own]:
                    sets[own].append((GROUND, ""))  # each set has its own: the ground joins nothing
            elif other not in here:
                what = f"{part.name} is at groups where {other}, which it joins, is not"
                hint = f"at: the same groups at both {part.name} and {other}"
                mistakes.add("E210", part.place, what, hint=hint)
            else:
                join(own, (other, its_connector))
    seen: set[int] = set()
    for members in sets.values():
        if id(members) not in seen:
            seen.add(id(members))
            yield members
