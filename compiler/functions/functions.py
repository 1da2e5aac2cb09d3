"""Explicit equations to CasADi functions, and the exchange between sites as structure.

Takes: `SortedSystem`. Gives: `Model`.
Guarantees: a kind's functions hold only what its states, its samples and what it sends depend on; what the
scene named but nothing reads is listed in `dropped`. One is an SX function, unless it needs a nonlinear loop:
then it is an MX function that calls SX functions, with a Newton solver for each loop between them.
Does not: write files, or put numbers in the place of parameters.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import casadi

from apc.compiler.cache import Origin
from apc.compiler.compiled import (
    Axis,
    ClockPartition,
    ForcePorts,
    Hold,
    Limit,
    Model,
    PeerType,
    Receive,
    Replaced,
    SendPartition,
    State,
)
from apc.compiler.components.component import OTHERS
from apc.compiler.components.parts import GROUND
from apc.compiler.equations.derivatives import TIME
from apc.compiler.equations.flatten import HEARD_AGE, FlatVariable, HoldCrossing, PreviousCrossing
from apc.compiler.equations.reductions import PeerReduction
from apc.compiler.equations.solution import Definition, ImplicitBlock
from apc.compiler.equations.structure import SortedPeerType, SortedSystem
from apc.compiler.equations.terms import Symbol, symbol
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.functions.casadi_writer import CasadiWriter
from apc.compiler.functions.scene_data import (
    Timings,
    all_parameters,
    check_links,
    compiled_groups,
    followers_of,
    used_clocks,
    used_links,
    with_rounded,
)
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import format_expression, names
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.scene.instances import PartInstance
from apc.compiler.scene.oddities import warning_texts

WORK = Dimension((("kg", 1), ("m", 2), ("s", -2)))  # the joule


def build_functions(system: SortedSystem, origin: Origin, *, linear: SortedSystem | None = None) -> Model:
    """Write every kind as CasADi functions, and the network between the peers as data.

    Parameters
    ----------
    system, origin
        The sorted equations, and the texts they are from.
    linear
        The sorted equations of linear analyses, where those differ.
    """
    scene = system.scene
    timings = Timings(scene)
    writers, received = _followed(system)
    kinds = []
    if linear is None:
        kinds = [_kind(writer, received, timings) for writer in writers]
    else:
        linear_writers, linear_received = _followed(linear)
        for writer, other in zip(writers, linear_writers, strict=True):
            for name in {**writer.parameters, **other.parameters}:  # one vector serves both
                writer.parameter(name)
                other.parameter(name)
            replaced = tuple(_replaced(writer.kind))
            kind = _kind(writer, received, timings)
            if replaced:
                of_analysis = _kind(other, linear_received, timings)
                _check_states(writer.kind, kind, of_analysis)
                symbols = _symbols(writer.kind)
                kind = replace(kind, linear=of_analysis, replaced=replaced, symbols=symbols)
            kinds.append(kind)
    dropped = []
    for ordered, writer in zip(system.kinds, writers, strict=True):
        unread = (hold.variable for hold in ordered.clocked.holds if symbol(hold.symbol) not in writer.known)
        dropped += [(name, "nobody reads this held value") for name in unread]
        dropped += [(send.name, "nobody hears it") for send in ordered.sends if send.name not in received]
    numbers = {group: i for i, kind in enumerate(system.kinds) for group in kind.clocked.flat.groups}
    places = [numbers[group.name] for group in scene.groups]
    check_links(scene, kinds, places)
    links = used_links(scene, kinds, timings)
    clocks = used_clocks(scene, kinds, links, timings)
    used = {link.name for link in links} | {clock.name for clock in clocks}  # no link has the name of a clock
    dropped += [
        (link.name, "nobody hears what it would carry") for link in scene.links if link.name not in used
    ]
    dropped += [(clock.name, "nothing ticks with it") for clock in scene.clocks if clock.name not in used]
    parameters = all_parameters(scene, kinds, links)
    groups = compiled_groups(scene, kinds, places, links, timings)
    return Model(
        scene.name,
        scene.about,
        clocks,
        links,
        timings.found,
        parameters,
        tuple(with_rounded(scene, kind, links) for kind in kinds),
        groups,
        tuple(dict.fromkeys(dropped)),
        origin,
        scene.experiment,
        scene.region,
        scene.tune,
        followers_of(parameters, timings.found, groups),
        warning_texts(scene.warnings),
        tuple(
            Axis(f"{link.name}.delay", *link.within, link.place.line, link.place.column)
            for link in scene.links
            if link.within and link.name in used
        ),
    )


def _followed(system: SortedSystem) -> tuple[list[CasadiWriter], list[str]]:
    """Return a writer of each kind, with all that is needed written, and the names that are received."""
    writers = [CasadiWriter(kind) for kind in system.kinds]
    before, received = -1, list[str]()
    while before < (before := sum(len(writer.known) for writer in writers)):  # until nothing new is read
        for writer in writers:
            writer.follow(received)
        receives = (number for writer in writers for number in writer.read(writer.kind.receives))
        received = list(dict.fromkeys(name for receive in receives for name in receive.sends))
    return writers, received


def _replaced(kind: SortedPeerType) -> Iterable[Replaced]:
    """Yield the parts of a kind that other equations represent in a linear analysis."""
    for part in kind.clocked.flat.parts:
        if (linearized := part.component.linearized) is not None:
            texts = (
                f"{format_expression(equation.left)} = {format_expression(equation.right)}"
                for equation in linearized.equations
            )
            yield Replaced(part.name, tuple(texts), linearized.valid)


def _symbols(kind: SortedPeerType) -> tuple[tuple[str, str], ...]:
    """Return the symbols of published conditions by full parameter name, none unless every part has some."""
    result = []
    for part in kind.clocked.flat.parts:
        if part.section == "hands":
            continue
        if not part.component.symbols:
            return ()
        clocks = dict(part.references)
        result += [
            (symbol, f"{clocks[name]}.period" if name in clocks else f"{part.name}.{name}")
            for symbol, name in part.component.symbols
        ]
    return tuple(result)


def _check_states(kind: SortedPeerType, full: PeerType, linear: PeerType) -> None:
    """Refuse equations of a linear analysis that have other states, held or sent values."""
    for nonlinear, own in (
        ([state.name for state in full.states], [state.name for state in linear.states]),
        ([hold.name for hold in full.holds], [hold.name for hold in linear.holds]),
        (
            [name for send in full.sends for name in send.channels],
            [name for send in linear.sends for name in send.channels],
        ),
    ):
        if nonlinear != own:
            part = next(part for part in kind.clocked.flat.parts if part.component.linearized is not None)
            names = ", ".join(sorted(set(nonlinear) ^ set(own)))
            what = f"linearized of {part.component.name}: {names} would be in one set of equations only"
            hint = "equations that keep the same states, held and sent values"
            raise ApcError(Diagnostic("E514", part.component.place, what, hint=hint))


def _kind(writer: CasadiWriter, heard: Iterable[str], timings: Timings) -> PeerType:
    """Write a kind's functions; `heard` are the names of the sends that any kind hears."""
    kind, flat = writer.kind, writer.kind.clocked.flat
    holds, previous = writer.read(kind.clocked.holds), writer.read(kind.clocked.previous)
    sends = {send.name: send for send in kind.sends}
    units = {variable.name: format_dimension(variable.dimension) for variable in flat.variables}
    channels: dict[str, list[str]] = {}  # over each link, what is heard of this kind
    for name in (name for name in heard if name in sends):
        channels.setdefault(sends[name].link, []).append(name)
    outputs: dict[str, dict[str, None]] = {part.clock: {} for part in kind.partitions[1:]}
    switched: list[HoldCrossing | PreviousCrossing] = [*holds, *previous]
    for item in switched:
        outputs[item.clock][item.variable] = None
    parameters = tuple(sorted(writer.parameters))

    around = (
        {"x": writer.column(kind.states), "u": writer.column(hold.symbol for hold in holds)},
        {"p": casadi.vertcat(casadi.SX(0, 1), *map(writer.parameter, parameters)), "t": writer.known[TIME]},
    )

    def function(name: str, output: str, value: Any, between: Mapping[str, Any]) -> Any:
        return writer.function(name, {**around[0], **between, **around[1]}, output, value)

    def edge(heard: PeerReduction, m: Any, r: Any) -> Any | None:
        """Write what a reduction runs over, for one peer that hears and one that is heard, if anything."""
        if heard.edge is None:
            return None
        theirs = [f"{OTHERS}.{name}" for name in channels[heard.link]]
        sent = writer.column([*theirs, HEARD_AGE] if heard.age == "edge" else theirs)
        value = writer.write(heard.edge)
        if casadi.depends_on(value, r):
            what = f"{heard.symbol} asks of each other peer what depends on all that are heard"
            expected = "a mean or sum that is linear in what the others send"
            raise ApcError(Diagnostic("E506", heard.place, what, expected))
        return function("edge", "value", value, {"m": m, "s": sent})

    def clock(name: str, computed: Sequence[str]) -> ClockPartition:
        """Write what one clock's tick computes, from what is remembered and heard as well."""
        received = [number for number in writer.read(kind.receives) if number.clock == name]
        remembered = [previous_crossing for previous_crossing in previous if previous_crossing.clock == name]
        m, r = (writer.column(item.symbol for item in some) for some in (remembered, received))
        return ClockPartition(
            name,
            tuple(computed),
            tuple(units[output] for output in computed),
            tuple(computed.index(previous_crossing.variable) for previous_crossing in remembered),
            tuple(previous_crossing.variable for previous_crossing in remembered),
            tuple(
                Receive(
                    *(heard.symbol, heard.operator, heard.link, channels[heard.link].index(heard.send)),
                    *(edge(heard, m, r), heard.age, heard.before),
                )
                for heard in received
            ),
            function(f"tick_{name}", "y", writer.column(computed), {"m": m, "r": r}),
        )

    def send(link: str, names: Sequence[str]) -> SendPartition:
        values = [writer.write(sends[name].expression) for name in names]
        written = function(f"send_{link}", "s", casadi.densify(casadi.vertcat(*values)), {})
        return SendPartition(link, tuple(names), tuple(sends[name].unit for name in names), written)

    def limit(variable: FlatVariable) -> Limit:
        """Write a variable that has a limit, unless it is a state."""
        name, (part, _, own) = variable.name, variable.name.rpartition(".")
        if any(name in clocked.variables for clocked in kind.clocked.partitions[1:]):
            assert variable.declared is not None
            what = f"{name} has a limit and is computed at ticks; a limit is of what holds at every moment"
            hint = f"acting = hold({whole_and_index(own)[0]}), with the limit of acting"
            raise ApcError(Diagnostic("E513", variable.declared.place, what, hint=hint))
        value = None if name in kind.states else function("limited", "value", writer.column([name]), {})
        return Limit(name, units[name], f"{part}.{variable.limit}", value)

    held = [hold.variable for hold in holds]
    hands = [part for part in flat.parts if part.section == "hands"]
    rates = writer.column(f"der({name})" for name in kind.states)
    ports = [port for port in _held_ports(kind) if port[3] <= writer.known.keys()]
    acting = writer.column([*(port[1] for port in ports), *(port[2] for port in ports)])
    port = function("port", "potentials_flows", acting, {})
    return PeerType(
        flat.name,
        tuple(State(name, units[name], name) for name in kind.states),
        tuple(
            Hold(
                hold.variable if held.count(hold.variable) == 1 else hold.symbol,
                hold.clock,
                list(outputs[hold.clock]).index(hold.variable),
                timings.delay(hold, flat),
            )
            for hold in holds
        ),
        parameters,
        function("derivative", "dx", rates, {}),
        tuple(clock(name, list(computed)) for name, computed in outputs.items() if computed),
        tuple(send(link, channel) for link, channel in channels.items()),
        ForcePorts(tuple(part for part, *_ in ports), port) if ports else None,
        hands=tuple(part.name for part in hands if "." not in part.name and _answers(part)),
        limits=tuple(limit(variable) for variable in flat.variables if variable.limit),
        held=tuple(
            dict.fromkeys(other for part in hands for _, other, _ in part.connections if other != GROUND)
        )
        or tuple(part.name for part in flat.parts if part.component.grips),
    )


def _held_ports(kind: SortedPeerType) -> Iterable[tuple[str, str, str, set[Symbol]]]:
    """Yield (part, potential, flow into it, what these follow from) where a part's own hold gives the flow.

    The work a part does at a port over an interval in which nothing switches is, exactly, minus the flow
    into it times the change of the potential.
    """
    definitions = kind.definitions
    held = {symbol(hold.symbol): hold.variable.rpartition(".")[0] for hold in kind.clocked.holds}
    moving = {*map(symbol, kind.states), TIME}
    for part in kind.clocked.flat.parts:
        passed = {outer for outer, _, _ in part.component.passed}
        for name, connector in part.component.connectors if part.name in held.values() else ():
            for pair in zip(connector.potentials, connector.flows, strict=False):
                if name in passed or pair[0].unit.dimension.multiply(pair[1].unit.dimension) != WORK:
                    continue  # it makes no work, or is the inner part's
                potential, flow = (f"{part.name}.{name}.{variable.name}" for variable in pair)
                at, through = (_follows_from(symbol(text), definitions) for text in (potential, flow))
                own = {s for s in through if held.get(s) == part.name}
                if own and not (through - own) & (moving | held.keys()) and not at & held.keys():
                    yield part.name, potential, flow, at | through


def _follows_from(wanted: Symbol, definitions: Mapping[Symbol, Definition]) -> set[Symbol]:
    """Return the states, holds and parameters that give a symbol; a loop's unknown stands for itself."""
    seen, ends = [wanted], set[Symbol]()
    for s in seen:
        definition = definitions.get(s)
        if definition is None or isinstance(definition, ImplicitBlock):
            ends.add(s)
        else:
            seen += definition.free_symbols.difference(seen)
    return ends


def _answers(part: PartInstance) -> bool:
    """Say whether a hand answers to how it is moved; one that only pushes changes no stability."""
    component = part.component
    moved = {
        (name, potential.name)
        for name, connector in component.connectors
        for potential in connector.potentials
    }
    sides = [side for equation in component.equations for side in (equation.left, equation.right)]
    return bool(component.inner) or any(name.parts in moved for side in sides for name in names(side))
