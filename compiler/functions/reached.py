"""What of a kind is ever read: the motion of its states, through all crossings, depends on it.

Takes: `SortedKind`s. Gives: `Reached`, `reached_together`.
Guarantees: what a state's derivative depends on is reached, however many samples, ticks, holds, sends and
peers lie between; nothing else is.
Does not: write functions (see `functions`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from apc.compiler.components.component import OTHERS
from apc.compiler.equations.flatten import HEARD_AGE, HoldCrossing, PreviousCrossing
from apc.compiler.equations.reductions import Heard
from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.structure import SortedKind
from apc.compiler.equations.terms import Symbol, derivative, symbol
from apc.compiler.functions.casadi_writer import Definition


@dataclass(frozen=True, slots=True)
class Reached:
    """One kind, and what of it is read.

    `definitions` say what unknowns and samples follow from; `holds`, `previous` and `receives` are the
    crossings that are read; `parameters` are those that the functions read, and start values.
    """

    kind: SortedKind
    definitions: Mapping[Symbol, Definition]
    holds: tuple[HoldCrossing, ...]
    previous: tuple[PreviousCrossing, ...]
    receives: tuple[Heard, ...]
    parameters: tuple[str, ...]


def reached_together(kinds: Sequence[SortedKind]) -> list[Reached]:
    """Return what is read of each kind, which sends what any hears; what has a limit is read as well."""
    definitions: list[dict[Symbol, Definition]] = []
    reads: dict[tuple[int, Symbol], list[tuple[int, Symbol]]] = {}
    work: list[tuple[int, Symbol]] = []
    sent = [(place, send) for place, kind in enumerate(kinds) for send in kind.sends]
    for place, kind in enumerate(kinds):
        definitions.append({s: one for part in kind.partitions for s, one in part.definitions.items()})
        definitions[place] |= {symbol(name): value for name, value in (*kind.aliases, *kind.samples)}
        reads |= {(place, s): [(place, t) for t in one.free_symbols] for s, one in definitions[place].items()}
        crossings: list[HoldCrossing | PreviousCrossing] = [*kind.clocked.holds, *kind.clocked.previous]
        reads |= {(place, symbol(one.symbol)): [(place, symbol(one.variable))] for one in crossings}
        for heard in kind.receives:
            edge = () if heard.edge is None else heard.edge.free_symbols
            names = sends_of(heard)
            reads[place, symbol(heard.symbol)] = [
                *((place, s) for s in edge),
                *(
                    (other, s)
                    for other, one in sent
                    if one.name in names
                    for s in one.expression.free_symbols
                ),
            ]
        work += ((place, derivative(name)) for name in kind.states)
        work += ((place, symbol(one.name)) for one in kind.clocked.flat.variables if one.limit)
    read: set[tuple[int, Symbol]] = set()
    while work:
        one = work.pop()
        work += reads.get(one, ()) if one not in read else ()
        read.add(one)
    found = []
    for place, kind in enumerate(kinds):
        holds = tuple(one for one in kind.clocked.holds if (place, symbol(one.symbol)) in read)
        previous = tuple(one for one in kind.clocked.previous if (place, symbol(one.symbol)) in read)
        receives = tuple(one for one in kind.receives if (place, symbol(one.symbol)) in read)
        free = {s.name for other, s in read if other == place and (other, s) not in reads}
        starts = {*kind.states, *(one.variable for one in previous)}
        starts |= {name[8:-1] for name in free if name.startswith("initial(")}
        loops = [one for s, one in definitions[place].items() if (place, s) in read]
        guessed = {name for one in loops if isinstance(one, ImplicitBlock) for name in one.tearing}
        starts |= {one.name for one in kind.clocked.flat.variables if one.start and one.name in guessed}
        tables = {f"{part.name}.{table.name}" for part in kind.clocked.flat.parts for table in part.tables}
        free = {name for name in free if not name.startswith(("initial(", f"{OTHERS}."))} - tables - {"time"}
        parameters = tuple(sorted(free | starts))
        found.append(Reached(kind, definitions[place], holds, previous, receives, parameters))
    return found


def sends_of(heard: Heard) -> list[str]:
    """Return the names of what is read of each other peer."""
    symbols = () if heard.edge is None else heard.edge.free_symbols
    others = sorted(s.name for s in symbols if s.name.startswith(f"{OTHERS}.") and s.name != HEARD_AGE)
    return list(dict.fromkeys([heard.send, *(name.removeprefix(f"{OTHERS}.") for name in others)]))
