"""What of a kind is ever read: the motion of its states, through all crossings, depends on it.

Takes: `SortedKind`s. Gives: `Reached`, `reached_together`.
Guarantees: what a state's derivative depends on is reached, however many samples, ticks, holds, sends and
peers lie between; nothing else is.
Does not: write functions (see `functions`).
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from dataclasses import dataclass

from apc.compiler.components.component import OTHERS
from apc.compiler.equations.clocks import HEARD_AGE, HoldCrossing, PreviousCrossing, ReceiveCrossing
from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.structure import SortedKind, SortedSend
from apc.compiler.equations.symbolic import derivative_symbol, no_derivative, to_term
from apc.compiler.equations.terms import Symbol, Term, symbol
from apc.compiler.functions.casadi_writer import Definition


class Reached:
    """One kind: what defines each symbol, which crossings there are, and which symbols are read.

    `heard` are names of sends that other kinds hear: what this kind sends under them is read, too, and so are
    the variables `watched`, where there are such.
    `holds`, `previous` and `receives` are the crossings that are read, by their symbols; `edges` what a
    reduction runs over, for those that do; `sends` everything the kind could send.
    """

    def __init__(self, kind: SortedKind, heard: Collection[str] = (), watched: Collection[str] = ()) -> None:
        self.kind = kind
        self.continuous: dict[Symbol, Definition] = kind.partitions[0].definitions
        self.clocked: dict[Symbol, Definition] = {
            s: definition for part in kind.partitions[1:] for s, definition in part.definitions.items()
        }
        self.samples = {symbol(name): expression for name, _, expression in kind.samples}
        self.sends: dict[str, SortedSend] = {send.name: send for send in kind.sends}
        self.edges = {
            symbol(receive.symbol): to_term(receive.edge, no_derivative)
            for receive in kind.receives
            if receive.edge is not None
        }
        self._known = _Crossings(
            {symbol(hold.symbol): hold for hold in kind.holds},
            {symbol(previous.symbol): previous for previous in kind.previous},
            {symbol(receive.symbol): receive for receive in kind.receives},
        )
        told = [s for name in self.sends if name in heard for s in self.sends[name].expression.free_symbols]
        aliases = dict(kind.aliases)
        self.watched = {name: aliases.get(name, symbol(name)) for name in watched}
        shown = [s for value in self.watched.values() for s in value.free_symbols]
        self.symbols = self._closure([*(derivative_symbol(name) for name in kind.states), *told, *shown])
        self.holds = {s: hold for s, hold in self._known.holds.items() if s in self.symbols}
        self.previous = {s: one for s, one in self._known.previous.items() if s in self.symbols}
        self.receives = {s: receive for s, receive in self._known.receives.items() if s in self.symbols}

    @property
    def idle_holds(self) -> list[HoldCrossing]:
        """The held values that nothing reads."""
        return [hold for s, hold in self._known.holds.items() if s not in self.symbols]

    @property
    def heard(self) -> list[str]:
        """The names this kind hears of the others, each once."""
        found: dict[str, None] = {}
        for s, receive in self.receives.items():
            found[receive.of.send] = None
            found.update(dict.fromkeys(_others(self.edges.get(s))))
        return list(found)

    @property
    def outputs(self) -> dict[str, list[str]]:
        """What each clock computes that is held or remembered."""
        found: dict[str, dict[str, None]] = {part.clock: {} for part in self.kind.partitions[1:]}
        for hold in self.holds.values():
            found[hold.clock][hold.variable] = None
        for previous in self.previous.values():
            found[previous.clock][previous.variable] = None
        return {clock: list(names) for clock, names in found.items()}

    @property
    def loops(self) -> list[ImplicitBlock]:
        """The nonlinear loops that the kind's functions have to solve."""
        tables = (self.continuous, self.clocked)
        found = (table[s] for s in self.symbols for table in tables if s in table)
        return [definition for definition in found if isinstance(definition, ImplicitBlock)]

    def parameters(self, others: Iterable[str]) -> list[str]:
        """Return the parameters of the kind: those its functions read, and its start values.

        `others` are names that are read and are no parameters: those of tables.
        """
        defined = {*self.continuous, *self.clocked, *self.samples, symbol("time"), *map(symbol, others)}
        defined |= {*self._known.holds, *self._known.previous, *self._known.receives}
        defined |= {symbol(name) for name in self.kind.states}
        free = {s.name for s in self.symbols - defined if not s.name.startswith(f"{OTHERS}.")}
        starts = set(self.kind.states)
        starts |= {previous.variable for previous in self.previous.values()}
        starts |= {name[8:-1] for name in free if name.startswith("initial(")}
        guessed = {name for loop in self.loops for name in loop.tearing}
        starts |= {v.name for v in self.kind.clocked.flat.variables if v.start and v.name in guessed}
        return sorted({name for name in free if not name.startswith("initial(")} | starts)

    def _closure(self, wanted: Iterable[Symbol]) -> set[Symbol]:
        """Return these symbols and every symbol that they depend on."""
        seen: set[Symbol] = set()
        work = list(wanted)
        while work:
            s = work.pop()
            if s not in seen:
                seen.add(s)
                work += self._read_by(s)
        return seen

    def _read_by(self, s: Symbol) -> Iterable[Symbol]:
        """Yield what a symbol's value is computed from, on the other side of a crossing if it is one."""
        for table in (self.continuous, self.clocked, self.samples, self.edges):
            if s in table:
                yield from table[s].free_symbols
        if s in self._known.holds:
            yield symbol(self._known.holds[s].variable)
        if s in self._known.previous:
            yield symbol(self._known.previous[s].variable)
        if s in self._known.receives:
            for name in (self._known.receives[s].of.send, *_others(self.edges.get(s))):
                if name in self.sends:
                    yield from self.sends[name].expression.free_symbols


def reached_together(
    kinds: Sequence[SortedKind], watched: Sequence[Collection[str]] | None = None
) -> list[Reached]:
    """Return what is read of each kind, its `watched` too, where each sends what any of them hears."""
    heard: set[str] = set()
    while True:
        found = [
            Reached(kind, heard, own) for kind, own in zip(kinds, watched or [()] * len(kinds), strict=True)
        ]
        now = {name for one in found for name in one.heard}
        if now <= heard or len(kinds) == 1:  # what a kind hears itself is reached as it is
            return found
        heard |= now


@dataclass(frozen=True, slots=True)
class _Crossings:
    """Every crossing of a kind, by its symbol."""

    holds: dict[Symbol, HoldCrossing]
    previous: dict[Symbol, PreviousCrossing]
    receives: dict[Symbol, ReceiveCrossing]


def _others(expression: Term | None) -> list[str]:
    """Return what an expression reads of another peer."""
    if expression is None:
        return []
    prefix = f"{OTHERS}."
    found = (s.name for s in expression.free_symbols if s.name.startswith(prefix) and s.name != HEARD_AGE)
    return sorted(name.removeprefix(prefix) for name in found)
