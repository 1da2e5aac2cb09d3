"""Explicit equations to CasADi functions, and the exchange between sites as structure.

Takes: `SortedSystem`. Gives: `CompiledSystem`.
Guarantees: a kind's functions hold only what its states, its samples and what it sends depend on; what the
scene named but nothing reads is listed in `dropped`. One is an SX function, unless it needs a nonlinear loop:
then it is an MX function that calls SX functions, with a Newton solver for each loop between them.
Does not: write files, or put numbers in the place of parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi

from apc.compiler.cache import Origin
from apc.compiler.compiled import (
    ClockPartition,
    CompiledSystem,
    Hold,
    Kind,
    Limit,
    Ports,
    Receive,
    SendPartition,
    State,
)
from apc.compiler.components.component import OTHERS
from apc.compiler.components.parts import GROUND
from apc.compiler.equations.clocks import HEARD_AGE, HoldCrossing, ReceiveCrossing
from apc.compiler.equations.solution import ImplicitBlock
from apc.compiler.equations.structure import SortedKind, SortedSystem
from apc.compiler.equations.symbolic import derivative_symbol
from apc.compiler.equations.terms import Symbol, Term, symbol
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.functions.casadi_writer import Writer
from apc.compiler.functions.exchange import (
    Timings,
    all_parameters,
    check_channels,
    check_heard,
    compiled_groups,
    followers_of,
    used_clocks,
    used_links,
    with_rounded,
)
from apc.compiler.functions.reached import Reached, reached_together
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import names
from apc.compiler.language.recordings import TimeTable
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.scene.instances import Part
from apc.compiler.scene.oddities import warning_texts
from apc.compiler.scene.scene import Scene

WORK = Dimension((("kg", 1), ("m", 2), ("s", -2)))  # the joule


def build_functions(system: SortedSystem, origin: Origin) -> CompiledSystem:
    """Write every kind as CasADi functions, and what lies between the sites beside them."""
    scene = system.scene
    timings = Timings(scene)
    limited = [_limited(scene, kind) for kind in system.kinds]
    builders = [
        _KindBuilder(scene, one, timings, own)
        for one, own in zip(reached_together(system.kinds, limited), limited, strict=True)
    ]
    rows = _shared_rows([builder.reached for builder in builders])
    kinds = [builder.build(rows) for builder in builders]
    check_channels(scene, kinds)
    numbers = {group: i for i, kind in enumerate(system.kinds) for group in kind.clocked.flat.groups}
    check_heard(scene, {group: kinds[place] for group, place in numbers.items()})
    dropped = [item for builder in builders for item in builder.dropped]
    links, unheard = used_links(scene, kinds, timings)
    clocks, silent = used_clocks(scene, kinds, links, timings)
    parameters = all_parameters(scene, kinds, links)
    groups = compiled_groups(scene, kinds, numbers, links, timings)
    return CompiledSystem(
        scene.name,
        scene.about,
        tuple(clocks),
        tuple(links),
        timings.found,
        parameters,
        tuple(with_rounded(scene, kind, links) for kind in kinds),
        groups,
        tuple(dict.fromkeys([*dropped, *unheard, *silent])),
        origin,
        scene.experiment,
        scene.region,
        followers_of(parameters, timings.found, groups),
        warning_texts(scene.warnings),
    )


@dataclass(frozen=True, slots=True)
class _Limited:
    """The limit of a variable, a parameter's name, and where the variable is declared."""

    limit: str
    place: Place


def _limited(scene: Scene, kind: SortedKind) -> dict[str, _Limited]:
    """Return the limits of a kind, by the variables that have one."""
    return {
        f"{part.name}.{variable.name}": _Limited(f"{part.name}.{variable.limit}", variable.place)
        for part in scene.parts
        if part.name in kind.clocked.flat.parts
        for variable in part.component.variables
        if variable.limit
    }


def _shared_rows(kinds: Sequence[Reached]) -> dict[str, str]:
    """Return, for each send that some kind hears, the send whose row it travels in.

    Two sends over one link share a row when every kind sends the same under both names.
    """
    rows: dict[str, str] = {}
    for kind in kinds:
        for name in kind.heard:
            if name not in rows:
                known = dict.fromkeys(rows.values())
                rows[name] = next((row for row in known if _same_everywhere(name, row, kinds)), name)
    return rows


def _same_everywhere(name: str, other: str, kinds: Sequence[Reached]) -> bool:
    for kind in kinds:
        one, two = kind.sends.get(name), kind.sends.get(other)
        if one is None and two is None:
            continue
        if one is None or two is None or one.link != two.link or one.expression != two.expression:
            return False
    return True


@dataclass(frozen=True, slots=True)
class _Inputs:
    """The columns that every function of a kind takes: states, held values, parameters, and the time."""

    x: Any
    u: Any
    p: Any
    t: Any


_Channels = dict[str, tuple[str, int]]  # of each send: its link, and its row in what the kind sends over it


class _KindBuilder:
    """One kind's functions: what is read of it was found before, and is written."""

    def __init__(
        self, scene: Scene, reached: Reached, timings: Timings, limited: Mapping[str, _Limited]
    ) -> None:
        kind = reached.kind
        self.limited = limited
        self.kind = kind
        self.scene = scene
        self.tables: dict[str, TimeTable] = {
            f"{part.name}.{table.name}": table
            for part in scene.parts
            if part.name in kind.clocked.flat.parts
            for table in part.tables
        }
        self.timings = timings
        self.dimensions = {one.name: one.dimension for one in kind.clocked.flat.variables}
        self.dropped: list[tuple[str, str]] = []
        self.reached = reached

    def build(self, rows: dict[str, str]) -> Kind:
        """Write the kind's functions; `rows` says in which row each send that is heard travels."""
        reached = self.reached
        self.dropped += [(hold.variable, "nobody reads this held value") for hold in reached.idle_holds]
        self.dropped += [(name, "nobody hears it") for name in reached.sends if name not in rows]
        names = reached.parameters(self.tables)
        writer, inputs = self._writer(names)
        channels = self._channels(rows)
        outputs = reached.outputs
        return Kind(
            self.kind.clocked.flat.name,
            tuple(State(name, self._unit(name), name) for name in self.kind.states),
            self._holds(outputs),
            tuple(names),
            self._function(
                "derivative",
                writer,
                inputs,
                "dx",
                writer.column(writer.write(derivative_symbol(name)) for name in self.kind.states),
            ),
            tuple(
                self._clock(part.clock, outputs[part.clock], channels, writer, inputs)
                for part in self.kind.partitions[1:]
                if outputs[part.clock]
            ),
            tuple(
                self._send(link, channels, writer, inputs)
                for link in dict.fromkeys(link for link, _ in channels.values())
            ),
            self._ports(writer, inputs),
            hands=tuple(
                part.name
                for part in self.scene.parts
                if part.section == "hands"
                and "." not in part.name
                and part.name in self.kind.clocked.flat.parts
                and _answers(part)
            ),
            limits=tuple(self._limit(*one, writer, inputs) for one in self.limited.items()),
            held=tuple(
                dict.fromkeys(
                    other
                    for part in self.scene.parts
                    if part.section == "hands" and part.name in self.kind.clocked.flat.parts
                    for _, other, _ in part.connections
                    if other != GROUND
                )
            ),
        )

    def _limit(self, name: str, limited: _Limited, writer: Writer, inputs: _Inputs) -> Limit:
        """Write a variable that has a limit, unless it is a state."""
        if symbol(name) in self.reached.clocked:
            what = f"{name} has a limit and is computed at ticks; a limit is of what holds at every moment"
            own = whole_and_index(name.rpartition(".")[2])[0]
            hint = f"acting = hold({own}), with the limit of acting"
            raise ApcError(Mistake("E513", limited.place, what, hint=hint))
        value = None
        if name not in self.kind.states:
            column = writer.column([writer.translate(self.reached.watched[name])])
            value = self._function("limited", writer, inputs, "value", column)
        return Limit(name, self._unit(name), limited.limit, value)

    def _writer(self, names: Iterable[str]) -> tuple[Writer, _Inputs]:
        """Return a writer of continuous quantities, and the inputs they are written in."""
        reached = self.reached
        x = {symbol(name): casadi.SX.sym(name) for name in self.kind.states}
        u = {s: casadi.SX.sym(hold.symbol) for s, hold in reached.holds.items()}
        p = {name: casadi.SX.sym(name) for name in names}
        time = casadi.SX.sym("time")
        # A start value has the name of its variable; the name itself is what is computed.
        computed = {*reached.continuous, *reached.clocked}
        known = {symbol(name): value for name, value in p.items() if symbol(name) not in computed}
        known |= {symbol(f"initial({name})"): value for name, value in p.items()}
        known |= {**x, **u, symbol("time"): time}
        writer = Writer(known, {**reached.continuous, **reached.samples}, self.tables, p)
        inputs = _Inputs(
            writer.column(x.values()), writer.column(u.values()), writer.column(p.values()), time
        )
        return writer, inputs

    def _holds(self, outputs: dict[str, list[str]]) -> tuple[Hold, ...]:
        """Return the held values that are read, each with the delay from which it acts."""
        holds = list(self.reached.holds.values())
        return tuple(
            Hold(
                _hold_name(hold, holds),
                hold.clock,
                outputs[hold.clock].index(hold.variable),
                self.timings.delay(hold, self.kind.clocked.flat),
            )
            for hold in holds
        )

    def _ports(self, writer: Writer, inputs: _Inputs) -> Ports | None:
        """Write where held values act, of those that anything reads."""
        written = writer.known.keys()
        found = [port for port in _held_ports(self.scene, self.kind) if port.symbols <= written]
        if not found:
            return None
        rows = [port.potential for port in found] + [port.flow for port in found]
        values = writer.column(writer.translate(row) for row in rows)
        port = self._function("port", writer, inputs, "potentials_flows", values)
        return Ports(tuple(port.part for port in found), port)

    def _function(
        self,
        name: str,
        writer: Writer,
        inputs: _Inputs,
        output: str,
        value: Any,
        between: dict[str, Any] | None = None,
    ) -> Any:
        """Return a function of what all take and, between the held values and the parameters, of more."""
        columns = {"x": inputs.x, "u": inputs.u, **(between or {}), "p": inputs.p, "t": inputs.t}
        return writer.function(name, columns, output, value)

    def _unit(self, name: str) -> str:
        return format_dimension(self.dimensions[name])

    def _channels(self, rows: dict[str, str]) -> _Channels:
        """Return for each send that is heard its link and its row among what this kind sends over it."""
        sends = self.reached.sends
        own = [name for name in rows if name in sends]
        by_link: dict[str, list[str]] = {}
        for name in own:
            listed = by_link.setdefault(sends[name].link, [])
            if rows[name] not in listed:
                listed.append(rows[name])
        return {name: (sends[name].link, by_link[sends[name].link].index(rows[name])) for name in own}

    def _clock(
        self, clock: str, outputs: list[str], channels: _Channels, writer: Writer, inputs: _Inputs
    ) -> ClockPartition:
        """Write what one clock's tick computes, from what is remembered and heard as well."""
        reached = self.reached
        heard = {s: receive for s, receive in reached.receives.items() if receive.clock == clock}
        remembered = {s: previous for s, previous in reached.previous.items() if previous.clock == clock}
        r = {s: casadi.SX.sym(s.name) for s in heard}
        m = {s: casadi.SX.sym(s.name) for s in remembered}
        own = writer.extended({**r, **m}, reached.clocked)
        alone = writer.extended(m, reached.clocked)  # what one pair of peers knows: nothing that is heard
        remembering = own.column(m.values())
        heard_now = own.column(r.values())
        values = own.column(own.write(symbol(name)) for name in outputs)
        tick = self._function(f"tick_{clock}", own, inputs, "y", values, {"m": remembering, "r": heard_now})
        return ClockPartition(
            clock,
            tuple(outputs),
            tuple(self._unit(name) for name in outputs),
            tuple(outputs.index(previous.variable) for previous in remembered.values()),
            tuple(previous.variable for previous in remembered.values()),
            tuple(
                Receive(
                    receive.symbol,
                    receive.operator,
                    receive.link,
                    channels[receive.of.send][1],
                    self._edge(receive, channels, alone, remembering, inputs),
                    self._age(receive),
                    receive.of.before,
                )
                for receive in heard.values()
            ),
            tick,
        )

    def _age(self, receive: ReceiveCrossing) -> str:
        """Return what of a receive is the age of what is heard (see `Receive`)."""
        edge = self.reached.edges.get(symbol(receive.symbol))
        if edge is not None:
            return "edge" if symbol(HEARD_AGE) in edge.free_symbols else ""
        return "" if not receive.of.aged else "factor" if receive.of.value else "alone"

    def _edge(
        self, receive: ReceiveCrossing, channels: _Channels, writer: Writer, remembering: Any, inputs: _Inputs
    ) -> Any | None:
        """Write what a reduction runs over, for one peer that hears and one that is heard, if anything."""
        expression = self.reached.edges.get(symbol(receive.symbol))
        if expression is None:
            return None
        rows = {name: row for name, (link, row) in channels.items() if link == receive.link}
        aged = self._age(receive) == "edge"
        sent = casadi.SX.sym("s", 1 + max(rows.values()) + aged)
        theirs = {symbol(f"{OTHERS}.{name}"): sent[row] for name, row in rows.items()}
        if aged:
            theirs[symbol(HEARD_AGE)] = sent[sent.numel() - 1]
        pair = writer.extended(theirs, {})
        value = pair.translate(expression)
        return self._function("edge", pair, inputs, "value", value, {"m": remembering, "s": sent})

    def _send(self, link: str, channels: _Channels, writer: Writer, inputs: _Inputs) -> SendPartition:
        """Write what the kind sends over one link, a row for each send that travels in its own."""
        sends = self.reached.sends
        first: dict[int, str] = {}
        for name, (its_link, row) in channels.items():
            if its_link == link:
                first.setdefault(row, name)
        names = [first[row] for row in sorted(first)]
        values = writer.column(writer.translate(sends[name].expression) for name in names)
        send = self._function(f"send_{link}", writer, inputs, "s", values)
        return SendPartition(link, tuple(names), tuple(sends[name].unit for name in names), send)


def _hold_name(hold: HoldCrossing, holds: Sequence[HoldCrossing]) -> str:
    """Return the name of what is held; with its delay, where one value is held twice."""
    same = sum(other.variable == hold.variable for other in holds)
    return hold.variable if same == 1 else hold.symbol


@dataclass(frozen=True, slots=True)
class _Port:
    """A connector of part `part`: its potential, and the flow into the part, as expressions."""

    part: str
    potential: Term
    flow: Term

    @property
    def symbols(self) -> set[Symbol]:
        """What the port is written in."""
        return set(self.potential.free_symbols | self.flow.free_symbols)


def _held_ports(scene: Scene, kind: SortedKind) -> tuple[_Port, ...]:
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
                found.append(_Port(part.name, at, through))
    return tuple(found)


def _answers(part: Part) -> bool:
    """Say whether a hand answers to how it is moved; one that only pushes changes no stability."""
    component = part.component
    moved = {
        (name, potential.name)
        for name, connector in component.connectors
        for potential in connector.potentials
    }
    sides = [side for equation in component.equations for side in (equation.left, equation.right)]
    return bool(component.inner) or any(name.parts in moved for side in sides for name in names(side))


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


def _whole(wanted: Symbol, known: dict[Symbol, Term]) -> Term | None:
    """Return a symbol in terms of states, holds and parameters; None if a loop decides it."""
    expression: Term = wanted
    for _ in range(len(known) + 1):
        replaceable = expression.free_symbols & known.keys()
        if not replaceable:
            return expression
        expression = expression.xreplace({s: known[s] for s in replaceable})
    return None
