"""CasADi functions of the explicit equations, and the communication structure between sites.

Takes: `SortedSystem`. Gives: `build_functions`, the `Model`.
Guarantees: the functions of a peer type contain only the dependencies of its states, samples and sends;
unused items of the topology are listed in `dropped`. A function is an SX function, unless it has a nonlinear
loop: then it is an MX function that calls SX functions, with a Newton solver for each loop between them.
Does not: write files, or substitute parameter values.
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
from apc.compiler.equations.causalization import SortedPeerType, SortedSystem
from apc.compiler.equations.derivatives import TIME
from apc.compiler.equations.flatten import RECEIVED_AGE, FlatVariable, HoldCrossing, PreviousCrossing
from apc.compiler.equations.linear_decomposition import PeerReduction
from apc.compiler.equations.solution import Definition, ImplicitBlock
from apc.compiler.equations.terms import Symbol, symbol
from apc.compiler.errors import ApcError, Diagnostic
from apc.compiler.functions.casadi_writer import CasadiWriter
from apc.compiler.functions.topology_data import (
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
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.topology_warnings import warning_texts

WORK = Dimension((("kg", 1), ("m", 2), ("s", -2)))  # the joule


def build_functions(system: SortedSystem, origin: Origin, *, linear: SortedSystem | None = None) -> Model:
    """Write every peer type as CasADi functions, and the network between the peers as data.

    Parameters
    ----------
    system, origin
        The sorted equations, and the texts they are from.
    linear
        The sorted equations of linear analyses, where those differ.
    """
    topology = system.topology
    timings = Timings(topology)
    writers, received_names = _followed(system)
    peer_types = []
    if linear is None:
        peer_types = [_peer_type(writer, received_names, timings) for writer in writers]
    else:
        linear_writers, linear_received = _followed(linear)
        for writer, other in zip(writers, linear_writers, strict=True):
            for name in {**writer.parameters, **other.parameters}:  # one vector serves both
                writer.parameter(name)
                other.parameter(name)
            replaced = tuple(_replaced(writer.peer_type))
            peer_type = _peer_type(writer, received_names, timings)
            if replaced:
                of_analysis = _peer_type(other, linear_received, timings)
                _check_states(writer.peer_type, peer_type, of_analysis)
                symbols = _symbols(writer.peer_type)
                peer_type = replace(peer_type, linear=of_analysis, replaced=replaced, symbols=symbols)
            peer_types.append(peer_type)
    dropped = []
    for ordered, writer in zip(system.peer_types, writers, strict=True):
        unread = (hold.variable for hold in ordered.clocked.holds if symbol(hold.symbol) not in writer.known)
        dropped += [(name, "nobody reads this held value") for name in unread]
        dropped += [
            (send.name, "nobody hears it") for send in ordered.sends if send.name not in received_names
        ]
    numbers = {
        group: i for i, peer_type in enumerate(system.peer_types) for group in peer_type.clocked.flat.groups
    }
    locations = [numbers[group.name] for group in topology.groups]
    check_links(topology, peer_types, locations)
    links = used_links(topology, peer_types, timings)
    clocks = used_clocks(topology, peer_types, links, timings)
    used = {link.name for link in links} | {clock.name for clock in clocks}  # no link has the name of a clock
    dropped += [
        (link.name, "nobody hears what it would carry") for link in topology.links if link.name not in used
    ]
    dropped += [(clock.name, "nothing ticks with it") for clock in topology.clocks if clock.name not in used]
    parameters = all_parameters(topology, peer_types, links)
    groups = compiled_groups(topology, peer_types, locations, links, timings)
    return Model(
        topology.name,
        topology.description,
        clocks,
        links,
        timings.result,
        parameters,
        tuple(with_rounded(topology, peer_type, links) for peer_type in peer_types),
        groups,
        tuple(dict.fromkeys(dropped)),
        origin,
        topology.experiment,
        topology.region,
        topology.tune,
        followers_of(parameters, timings.result, groups),
        warning_texts(topology.warnings),
        tuple(
            Axis(f"{link.name}.delay", *link.within, link.location.line, link.location.column)
            for link in topology.links
            if link.within and link.name in used
        ),
    )


def _followed(system: SortedSystem) -> tuple[list[CasadiWriter], list[str]]:
    """Return a writer of each peer type, with all that is needed written, and the names that are received."""
    writers = [CasadiWriter(peer_type) for peer_type in system.peer_types]
    before, received_names = -1, list[str]()
    while before < (before := sum(len(writer.known) for writer in writers)):  # until nothing new is read
        for writer in writers:
            writer.follow(received_names)
        receives = (number for writer in writers for number in writer.read(writer.peer_type.receives))
        received_names = list(dict.fromkeys(name for receive in receives for name in receive.sends))
    return writers, received_names


def _replaced(peer_type: SortedPeerType) -> Iterable[Replaced]:
    """Yield the parts of a peer type that other equations represent in a linear analysis."""
    for part in peer_type.clocked.flat.parts:
        if (linearized := part.component.linearized) is not None:
            texts = (
                f"{format_expression(equation.left)} = {format_expression(equation.right)}"
                for equation in linearized.equations
            )
            yield Replaced(part.name, tuple(texts), linearized.valid)


def _symbols(peer_type: SortedPeerType) -> tuple[tuple[str, str], ...]:
    """Return the symbols of published conditions by full parameter name, none unless every part has some."""
    result = []
    for part in peer_type.clocked.flat.parts:
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


def _check_states(peer_type: SortedPeerType, full: PeerType, linear: PeerType) -> None:
    """Refuse equations of a linear analysis that have other states, held or sent values."""
    for nonlinear, local in (
        ([state.name for state in full.states], [state.name for state in linear.states]),
        ([hold.name for hold in full.holds], [hold.name for hold in linear.holds]),
        (
            [name for send in full.sends for name in send.channels],
            [name for send in linear.sends for name in send.channels],
        ),
    ):
        if nonlinear != local:
            part = next(
                part for part in peer_type.clocked.flat.parts if part.component.linearized is not None
            )
            names = ", ".join(sorted(set(nonlinear) ^ set(local)))
            message = f"linearized of {part.component.name}: {names} would be in one set of equations only"
            hint = "equations that keep the same states, held and sent values"
            raise ApcError(Diagnostic("E514", part.component.location, message, hint=hint))


def _peer_type(writer: CasadiWriter, received: Iterable[str], timings: Timings) -> PeerType:
    """Write the functions of a peer type; `received` are the names of the sends that any type receives."""
    peer_type, flat = writer.peer_type, writer.peer_type.clocked.flat
    holds, previous = writer.read(peer_type.clocked.holds), writer.read(peer_type.clocked.previous)
    sends = {send.name: send for send in peer_type.sends}
    units = {variable.name: format_dimension(variable.dimension) for variable in flat.variables}
    channels: dict[str, list[str]] = {}  # for each link, the received sends of this type
    for name in (name for name in received if name in sends):
        channels.setdefault(sends[name].link, []).append(name)
    outputs: dict[str, dict[str, None]] = {part.clock: {} for part in peer_type.partitions[1:]}
    switched: list[HoldCrossing | PreviousCrossing] = [*holds, *previous]
    for item in switched:
        outputs[item.clock][item.variable] = None
    parameters = tuple(sorted(writer.parameters))

    around = (
        {"x": writer.column(peer_type.states), "u": writer.column(hold.symbol for hold in holds)},
        {"p": casadi.vertcat(casadi.SX(0, 1), *map(writer.parameter, parameters)), "t": writer.known[TIME]},
    )

    def function(name: str, output: str, value: Any, between: Mapping[str, Any]) -> Any:
        return writer.function(name, {**around[0], **between, **around[1]}, output, value)

    def edge(received: PeerReduction, m: Any, r: Any) -> Any | None:
        """Write the edge function of a reduction, for one receiver and one sender, if any."""
        if received.edge is None:
            return None
        theirs = [f"{OTHERS}.{name}" for name in channels[received.link]]
        sent = writer.column([*theirs, RECEIVED_AGE] if received.age == "edge" else theirs)
        value = writer.write(received.edge)
        if casadi.depends_on(value, r):
            message = f"{received.symbol} asks of each other peer what depends on all that are heard"
            expected = "a mean or sum that is linear in what the others send"
            raise ApcError(Diagnostic("E506", received.location, message, expected))
        return function("edge", "value", value, {"m": m, "s": sent})

    def clock(name: str, computed: Sequence[str]) -> ClockPartition:
        """Write the tick function of one clock, also of stored and received values."""
        received_names = [number for number in writer.read(peer_type.receives) if number.clock == name]
        stored = [previous_crossing for previous_crossing in previous if previous_crossing.clock == name]
        m, r = (writer.column(item.symbol for item in some) for some in (stored, received_names))
        return ClockPartition(
            name,
            tuple(computed),
            tuple(units[output] for output in computed),
            tuple(computed.index(previous_crossing.variable) for previous_crossing in stored),
            tuple(previous_crossing.variable for previous_crossing in stored),
            tuple(
                Receive(
                    *(
                        received.symbol,
                        received.operator,
                        received.link,
                        channels[received.link].index(received.send),
                    ),
                    *(edge(received, m, r), received.age, received.before),
                )
                for received in received_names
            ),
            function(f"tick_{name}", "y", writer.column(computed), {"m": m, "r": r}),
        )

    def send(link: str, names: Sequence[str]) -> SendPartition:
        values = [writer.write(sends[name].expression) for name in names]
        written = function(f"send_{link}", "s", casadi.densify(casadi.vertcat(*values)), {})
        return SendPartition(link, tuple(names), tuple(sends[name].unit for name in names), written)

    def limit(variable: FlatVariable) -> Limit:
        """Write a variable that has a limit, unless it is a state."""
        name, (part, _, local) = variable.name, variable.name.rpartition(".")
        if any(name in clocked.variables for clocked in peer_type.clocked.partitions[1:]):
            assert variable.declared is not None
            message = f"{name} has a limit and is computed at ticks; a limit is of what holds at every moment"
            hint = f"acting = hold({whole_and_index(local)[0]}), with the limit of acting"
            raise ApcError(Diagnostic("E513", variable.declared.location, message, hint=hint))
        value = None if name in peer_type.states else function("limited", "value", writer.column([name]), {})
        return Limit(name, units[name], f"{part}.{variable.limit}", value)

    held = [hold.variable for hold in holds]
    hands = [part for part in flat.parts if part.section == "hands"]
    rates = writer.column(f"der({name})" for name in peer_type.states)
    ports = [port for port in _held_ports(peer_type) if port[3] <= writer.known.keys()]
    acting = writer.column([*(port[1] for port in ports), *(port[2] for port in ports)])
    port = function("port", "potentials_flows", acting, {})
    return PeerType(
        flat.name,
        tuple(State(name, units[name], name) for name in peer_type.states),
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


def _held_ports(peer_type: SortedPeerType) -> Iterable[tuple[str, str, str, set[Symbol]]]:
    """Yield (part, potential, flow into it, what these follow from) where a part's own hold gives the flow.

    The work a part does at a port over an interval in which nothing switches is, exactly, minus the flow
    into it times the change of the potential.
    """
    definitions = peer_type.definitions
    held = {symbol(hold.symbol): hold.variable.rpartition(".")[0] for hold in peer_type.clocked.holds}
    moving = {*map(symbol, peer_type.states), TIME}
    for part in peer_type.clocked.flat.parts:
        passed = {outer for outer, _, _ in part.component.passed}
        for name, connector in part.component.connectors if part.name in held.values() else ():
            for pair in zip(connector.potentials, connector.flows, strict=False):
                if name in passed or pair[0].unit.dimension.multiply(pair[1].unit.dimension) != WORK:
                    continue  # it makes no work, or is the inner part's
                potential, flow = (f"{part.name}.{name}.{variable.name}" for variable in pair)
                at, through = (_follows_from(symbol(text), definitions) for text in (potential, flow))
                local = {s for s in through if held.get(s) == part.name}
                if local and not (through - local) & (moving | held.keys()) and not at & held.keys():
                    yield part.name, potential, flow, at | through


def _follows_from(requested: Symbol, definitions: Mapping[Symbol, Definition]) -> set[Symbol]:
    """Return the states, holds and parameters of a symbol; a loop's unknown represents itself."""
    observed, ends = [requested], set[Symbol]()
    for s in observed:
        definition = definitions.get(s)
        if definition is None or isinstance(definition, ImplicitBlock):
            ends.add(s)
        else:
            observed += definition.free_symbols.difference(observed)
    return ends


def _answers(part: PartInstance) -> bool:
    """Return whether a hand reacts to its motion; a pure force input does not change stability."""
    component = part.component
    moved = {
        (name, potential.name)
        for name, connector in component.connectors
        for potential in connector.potentials
    }
    sides = [side for equation in component.equations for side in (equation.left, equation.right)]
    return bool(component.inner) or any(name.parts in moved for side in sides for name in names(side))
