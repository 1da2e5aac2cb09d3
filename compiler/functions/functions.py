"""CasADi functions of the explicit equations, and the communication structure between peers.

Takes: `SortedSystem`. Gives: `build_functions`, the `Model`.
Guarantees: the functions of a peer type contain only dependencies of its states, samples and sends;
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
)
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.expression import format_expression, names
from apc.compiler.language.unit_text import format_dimension
from apc.compiler.language.vectors import whole_and_index
from apc.compiler.peer_counts import refuse_equal_sums
from apc.compiler.topology.instances import PartInstance
from apc.compiler.topology.topology_warnings import warning_texts

WORK = Dimension((("kg", 1), ("m", 2), ("s", -2)))  # the joule


def build_functions(system: SortedSystem, origin: Origin, *, linear: SortedSystem | None = None) -> Model:
    """Return the compiled model: every peer type as CasADi functions, the network between peers as data.

    Parameters
    ----------
    system, origin
        The sorted equations, and the texts they are from.
    linear
        The sorted equations of linear analyses, None if they are the same.
    """
    topology = system.topology
    timings = Timings(topology)
    writers, received_names = _writers(system)
    peer_types = []
    if linear is None:
        peer_types = [_peer_type(writer, received_names, timings) for writer in writers]
    else:
        linear_writers, linear_received = _writers(linear)
        for writer, linear_writer in zip(writers, linear_writers, strict=True):
            for name in {
                **writer.parameters,
                **linear_writer.parameters,
            }:  # both have the same parameter vector
                writer.parameter(name)
                linear_writer.parameter(name)
            replaced = tuple(_linearized_parts(writer.peer_type))
            peer_type = _peer_type(writer, received_names, timings)
            if replaced:
                linear_type = _peer_type(linear_writer, linear_received, timings)
                _check_states(writer.peer_type, peer_type, linear_type)
                symbols = _symbols(writer.peer_type)
                peer_type = replace(peer_type, linear=linear_type, replaced=replaced, symbols=symbols)
            peer_types.append(peer_type)
    dropped = []
    for sorted_type, writer in zip(system.peer_types, writers, strict=True):
        unread = (
            hold.variable for hold in sorted_type.clocked.holds if symbol(hold.symbol) not in writer.known
        )
        dropped += [(name, "this held value is not used") for name in unread]
        dropped += [
            (send.name, "it is not received") for send in sorted_type.sends if send.name not in received_names
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
        (link.name, "its packets are not received") for link in topology.links if link.name not in used
    ]
    dropped += [(clock.name, "it is not used") for clock in topology.clocks if clock.name not in used]
    parameters = all_parameters(topology, peer_types, links)
    groups = compiled_groups(topology, peer_types, locations, links, timings)
    refuse_equal_sums(
        peer_types, links, topology.peers, {link.name: link.location for link in topology.links}
    )
    return Model(
        topology.name,
        topology.description,
        clocks,
        links,
        timings.result,
        parameters,
        tuple(peer_types),
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


def _writers(system: SortedSystem) -> tuple[list[CasadiWriter], list[str]]:
    """Return a writer for each peer type, and the names of the received sends.

    All required definitions are translated.
    """
    writers = [CasadiWriter(peer_type) for peer_type in system.peer_types]
    before, received_names = -1, list[str]()
    while before < (before := sum(len(writer.known) for writer in writers)):  # until no symbol is added
        for writer in writers:
            writer.follow(received_names)
        receives = (crossing for writer in writers for crossing in writer.read(writer.peer_type.receives))
        received_names = list(dict.fromkeys(name for receive in receives for name in receive.sends))
    return writers, received_names


def _linearized_parts(peer_type: SortedPeerType) -> Iterable[Replaced]:
    """Yield the parts of a peer type that have other equations in a linear analysis."""
    for part in peer_type.clocked.flat.parts:
        if (linearized := part.component.linearized) is not None:
            texts = (
                f"{format_expression(equation.left)} = {format_expression(equation.right)}"
                for equation in linearized.equations
            )
            yield Replaced(part.name, tuple(texts), linearized.valid)


def _symbols(peer_type: SortedPeerType) -> tuple[tuple[str, str], ...]:
    """Return the symbols of published wall conditions with the qualified names of their parameters.

    The result is empty if a part other than a hand has no symbols.
    """
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
    """Raise ApcError (E514) if the linear equations have other states, held or sent values."""
    for nonlinear, linearized in (
        ([state.name for state in full.states], [state.name for state in linear.states]),
        ([hold.name for hold in full.holds], [hold.name for hold in linear.holds]),
        (
            [name for send in full.sends for name in send.channels],
            [name for send in linear.sends for name in send.channels],
        ),
    ):
        if nonlinear != linearized:
            part = next(
                part for part in peer_type.clocked.flat.parts if part.component.linearized is not None
            )
            names = ", ".join(sorted(set(nonlinear) ^ set(linearized)))
            message = (
                f"linearized of {part.component.name}: {names} would occur in only one of the two sets "
                "of equations"
            )
            advice = "write equations with the same states, held and sent values"
            raise ApcError(Diagnostic("E514", part.component.location, message, advice=advice))


def _peer_type(writer: CasadiWriter, received: Iterable[str], timings: Timings) -> PeerType:
    """Return a peer type with its functions.

    `received` are the names of the sends that any peer type receives.
    """
    peer_type, flat = writer.peer_type, writer.peer_type.clocked.flat
    holds, previous = writer.read(peer_type.clocked.holds), writer.read(peer_type.clocked.previous)
    sends = {send.name: send for send in peer_type.sends}
    units = {variable.name: format_dimension(variable.dimension) for variable in flat.variables}
    channels: dict[str, list[str]] = {}  # for each link, the received sends of this type
    for name in (name for name in received if name in sends):
        channels.setdefault(sends[name].link, []).append(name)
    outputs: dict[str, dict[str, None]] = {part.clock: {} for part in peer_type.partitions[1:]}
    clocked_values: list[HoldCrossing | PreviousCrossing] = [*holds, *previous]
    for item in clocked_values:
        outputs[item.clock][item.variable] = None
    parameters = tuple(sorted(writer.parameters))

    common_inputs = (
        {"x": writer.column(peer_type.states), "u": writer.column(hold.symbol for hold in holds)},
        {"p": casadi.vertcat(casadi.SX(0, 1), *map(writer.parameter, parameters)), "t": writer.known[TIME]},
    )

    def function(name: str, output: str, value: Any, between: Mapping[str, Any]) -> Any:
        """Return a CasADi function of the states, holds, the inputs `between`, parameters and time."""
        return writer.function(name, {**common_inputs[0], **between, **common_inputs[1]}, output, value)

    def edge(received: PeerReduction, m: Any, r: Any) -> Any | None:
        """Return the edge function of a reduction for one receiver and one sender.

        The result is None if the reduction has no edge term.
        """
        if received.edge is None:
            return None
        sent_names = [f"{OTHERS}.{name}" for name in channels[received.link]]
        sent = writer.column([*sent_names, RECEIVED_AGE] if received.age == "edge" else sent_names)
        value = writer.write(received.edge)
        if casadi.depends_on(value, r):
            message = (
                f"{received.symbol} requests of each other peer a value that depends on all received values"
            )
            expected = "a mean or sum that is linear in the received values"
            raise ApcError(Diagnostic("E506", received.location, message, expected))
        return function("edge", "value", value, {"m": m, "s": sent})

    def clock(name: str, computed: Sequence[str]) -> ClockPartition:
        """Return the partition of one clock: outputs, stored values, receptions and the tick function."""
        receptions = [crossing for crossing in writer.read(peer_type.receives) if crossing.clock == name]
        stored = [crossing for crossing in previous if crossing.clock == name]
        m, r = (writer.column(item.symbol for item in items) for items in (stored, receptions))
        return ClockPartition(
            name,
            tuple(computed),
            tuple(units[output] for output in computed),
            tuple(computed.index(crossing.variable) for crossing in stored),
            tuple(crossing.variable for crossing in stored),
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
                for received in receptions
            ),
            function(f"tick_{name}", "y", writer.column(computed), {"m": m, "r": r}),
        )

    def send(link: str, names: Sequence[str]) -> SendPartition:
        """Return the values sent over one link, with the function that computes them."""
        values = [writer.write(sends[name].expression) for name in names]
        written = function(f"send_{link}", "s", casadi.densify(casadi.vertcat(*values)), {})
        return SendPartition(link, tuple(names), tuple(sends[name].unit for name in names), written)

    def limit(variable: FlatVariable) -> Limit:
        """Return the limit of a variable, with the function that computes the variable unless it is
        a state.
        """
        name, (part, _, local) = variable.name, variable.name.rpartition(".")
        if any(name in clocked.variables for clocked in peer_type.clocked.partitions[1:]):
            assert variable.declared is not None
            message = f"limit of {name}: expected a continuous variable, got one computed at ticks"
            advice = f"add acting = hold({whole_and_index(local)[0]}) and declare the limit of acting"
            raise ApcError(Diagnostic("E513", variable.declared.location, message, advice=advice))
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
        hands=tuple(part.name for part in hands if "." not in part.name and _reacts(part)),
        limits=tuple(limit(variable) for variable in flat.variables if variable.limit),
        held=tuple(
            dict.fromkeys(other for part in hands for _, other, _ in part.connections if other != GROUND)
        )
        or tuple(part.name for part in flat.parts if part.component.grips),
        joining=tuple(part.name for part in flat.parts if part.joins_at_mean),
    )


def _held_ports(peer_type: SortedPeerType) -> Iterable[tuple[str, str, str, set[Symbol]]]:
    """Yield the ports of parts whose flow is given by the part's own hold: (part, potential, flow,
    dependencies).

    Over an interval without switching of holds, the work done by the part is exactly minus the flow into it
    times the change of the potential.
    """
    definitions = peer_type.definitions
    hold_parts = {symbol(hold.symbol): hold.variable.rpartition(".")[0] for hold in peer_type.clocked.holds}
    time_varying = {*map(symbol, peer_type.states), TIME}
    for part in peer_type.clocked.flat.parts:
        passed = {outer for outer, _, _ in part.component.passed}
        for name, connector in part.component.connectors if part.name in hold_parts.values() else ():
            for pair in zip(connector.potentials, connector.flows, strict=False):
                if name in passed or pair[0].unit.dimension.multiply(pair[1].unit.dimension) != WORK:
                    continue  # potential times flow is not a work, or the connector belongs to an inner part
                potential, flow = (f"{part.name}.{name}.{variable.name}" for variable in pair)
                of_potential, of_flow = (
                    _dependencies(symbol(text), definitions) for text in (potential, flow)
                )
                own_holds = {s for s in of_flow if hold_parts.get(s) == part.name}
                if (
                    own_holds
                    and not (of_flow - own_holds) & (time_varying | hold_parts.keys())
                    and not of_potential & hold_parts.keys()
                ):
                    yield part.name, potential, flow, of_potential | of_flow


def _dependencies(unknown: Symbol, definitions: Mapping[Symbol, Definition]) -> set[Symbol]:
    """Return the states, holds and parameters that a symbol depends on.

    An unknown of a loop is its own dependency.
    """
    visited, result = [unknown], set[Symbol]()
    for s in visited:
        definition = definitions.get(s)
        if definition is None or isinstance(definition, ImplicitBlock):
            result.add(s)
        else:
            visited += definition.free_symbols.difference(visited)
    return result


def _reacts(part: PartInstance) -> bool:
    """Return whether the force of a hand depends on its motion.

    A pure force input does not change stability.
    """
    component = part.component
    positions = {
        (name, potential.name)
        for name, connector in component.connectors
        for potential in connector.potentials
    }
    sides = [side for equation in component.equations for side in (equation.left, equation.right)]
    return bool(component.inner) or any(name.parts in positions for side in sides for name in names(side))
