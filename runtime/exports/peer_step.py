"""One peer separately: its inputs, computations, packets and continuous dynamics.

Takes: a `Model`, a peer of it, an integration method between events.
Gives: `ExportedPeer`, `peer_of`, `subsystems_of`, `lines_of`, `first_packet`, `received_by`, `has_edge`,
`instant_functions`, `refused`; its parts `Instant`, `ForceUpdate`, `PeerLink`, `Sender`, `Force`, `Move`.
Guarantees: the functions, transitions and instants are those of `simulate`. Computations other than finite
arithmetic are refused, with the name of the state or variable.
Does not: write anything (see `c_text`), or transfer packets between peers (see `topology_text`).

A peer's states form sets coupled by equations. The hand-held set is the device. Without a hand it is the set
with a mass that is not sent to other peers, since a set that is sent is an object copy. A device is physical
and measured; a copy is integrated in the peer's computer. A device coupled to a copy by more than forces
computed at ticks cannot be separated from it.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from itertools import groupby
from operator import itemgetter
from typing import Any

import casadi
import numpy as np

from apc.compiler.compiled import Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.interpolation import jacobian
from apc.compiler.language.vectors import whole_and_index
from apc.exports.identifiers import identifier, prefixed
from apc.lifting.devices import Device, coupled_directly, find_device, find_devices
from apc.lifting.discretize import coupled_states
from apc.linearization.jacobians import SubsystemJacobians, edge_name, structural_pattern
from apc.linearization.linearize import start_arguments, start_values
from apc.parameter_values.exact_arithmetic import evaluate_exact
from apc.parameter_values.parameters import rationals
from apc.simulation.flow import flow_of, rows_to_move, state_scales
from apc.simulation.program import timed_events
from apc.simulation.propagate import rates, transition_rows
from apc.simulation.settings import Method
from apc.simulation.signals import LocalSignal, local_signals
from apc.simulation.simulation import SimulationPlan
from apc.timing import schedule as frames
from apc.timing.communication_graph import CommunicationGraph
from apc.timing.schedule import Schedule

NO_DEVICE = "none"  # the name of the device of a peer whose states are all in its computer
MOST_RECEIVED = 20_000  # senders to one peer: each is a line of the text
STEPS = "--method rk4:0.1ms"  # a method of finite arithmetic for any equations


@dataclass(frozen=True, slots=True)
class ForceUpdate:
    """Hold `hold` outputs the value computed `lag` ticks ago."""

    hold: int
    lag: int


@dataclass(frozen=True, slots=True)
class Instant:
    """The simultaneous events of an instant, in order, followed by interval `move` of the peer.

    `sends` and `ticks` are partitions.
    """

    sends: tuple[int, ...]
    ticks: tuple[int, ...]
    acts: tuple[ForceUpdate, ...]
    move: int


@dataclass(frozen=True, slots=True)
class Sender:
    """Another peer that sends to this one: its number and name, and the weight of its packets.

    `start` are the values used before its first packet arrives, one number per channel.
    """

    peer: int
    name: str
    weight: float
    start: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PacketEntry:
    """An entry of a packet: its channel's name, its unit, and its C name."""

    name: str
    unit: str
    member: str


@dataclass(frozen=True, slots=True)
class PeerLink:
    """A link of one peer: packet contents, senders, and whether packets can be missing.

    Its C name is `name`. `sending` is the peer's own send partition, −1 if it does not send; `complete`
    states whether the graph is complete.
    """

    link: str
    name: str
    packet: tuple[PacketEntry, ...]
    sending: int
    senders: tuple[Sender, ...]
    missing: bool
    complete: bool

    @property
    def channels(self) -> tuple[str, ...]:
        """The names of a packet's channels."""
        return tuple(entry.name for entry in self.packet)


@dataclass(frozen=True, slots=True)
class Force:
    """The force on a device along an axis, in N: `terms` are (hold, factor)."""

    name: str
    terms: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """The motion of the computer's states over `quanta`: x⁺ = matrix · (x, u, 1) row by row, or by `flow`.

    `flow` (x, u, p, t) -> x⁺ is the transition of the states `flowing`.
    """

    quanta: int
    matrix: Any  # (n_x, n_x + n_u + 1)
    flowing: tuple[int, ...]
    flow: Any | None  # casadi.Function


@dataclass(frozen=True, slots=True, eq=False)
class ExportedPeer:
    """A peer. `number` is its zero-based index over all groups; `parameters` (n_p,) are those of its type.

    Its C name is `identifier`. `outside` are the states that its computer does not integrate, `measured` the
    measured states of these by C name, and `forces` the forces on them by C name. `channels` are, by clock
    partition and receive, the indices of the received channels in the packet; an unused receive has none.
    `start` are the start states, `memories` the start values of each clock partition's stored outputs.
    `settable` are the indices of the parameters used only in ticks (see `_settable`).
    """

    model: Model
    name: str
    identifier: str
    number: int
    peer_type: PeerType
    schedule: Schedule
    parameters: Any
    outside: frozenset[int]
    measured: dict[int, str]
    forces: dict[str, Force]
    lines: tuple[PeerLink, ...]
    channels: dict[tuple[int, int], tuple[int, ...]]
    instants: tuple[Instant, ...]
    moves: tuple[Move, ...]
    start: tuple[float, ...]
    memories: tuple[tuple[float, ...], ...]
    settable: tuple[int, ...]

    @property
    def signals(self) -> tuple[LocalSignal, ...]:
        """The readable variables: integrated states, computed values, values still to take effect."""
        outside = {("state", (row,)) for row in self.outside}
        all_signals = local_signals(self.peer_type, self.schedule)
        return tuple(
            local_signal
            for local_signal in all_signals
            if local_signal.role != "limited" and (local_signal.role, local_signal.index) not in outside
        )

    @property
    def sending(self) -> tuple[PeerLink, ...]:
        """The links over which the peer sends."""
        return tuple(line for line in self.lines if line.sending >= 0)

    def line(self, link: str) -> PeerLink:
        """Return the peer's data of a link."""
        return next(line for line in self.lines if line.link == link)


def peer_of(
    plan: SimulationPlan, number: int, method: Method, *, device: str | None = NO_DEVICE, name: str = ""
) -> ExportedPeer:
    """Return a peer of a model, with the equations and packets of its own computer.

    Parameters
    ----------
    plan
        The frame plan of all peers.
    number
        The zero-based index over all groups.
    method
        The integration method of states without an exact transition.
    device
        The part outside the computer, `NO_DEVICE` without one; None: the states that are not sent to others.
    name
        The C name; by default derived from the peer's name.

    Raises
    ------
    ApcError
        E960 the peer is not finite arithmetic, or has no ticks; E961 no device, or one that cannot be
        separated.
    """
    model, group = plan.model, plan.comm_graph.group_of(number)
    index = model.groups[group].peer_type
    peer_type, subsystem, schedule = model.peer_types[index], plan.subsystems[index], plan.schedules[group]
    vector, label = _parameters(plan, number), plan.comm_graph.peer_name(number)
    _refuse_iterations(model, label, peer_type)
    outside = _external_states(model, label, subsystem, vector, device)
    instants, lengths = _instants(schedule)
    lines, channels = lines_of(plan, number)
    evaluated_at = sorted(outside & _states_read(peer_type))
    measured = prefixed("measured", (peer_type.states[row].name for row in evaluated_at))
    forces = _forces(model, label, subsystem, vector, outside)
    force_names = prefixed("force", (force.name for force in forces))
    x, _, memories = start_values(subsystem, [float(item) for item in vector])
    return ExportedPeer(
        model=model,
        name=label,
        identifier=name or identifier(label),
        number=number,
        peer_type=peer_type,
        schedule=schedule,
        parameters=vector,
        outside=outside,
        measured=dict(zip(evaluated_at, measured, strict=True)),
        forces=dict(zip(force_names, forces, strict=True)),
        lines=lines,
        channels=channels,
        instants=instants,
        moves=_transitions(plan, label, group, outside, lengths, method, vector),
        start=tuple(x),
        memories=tuple(map(tuple, memories)),
        settable=_settable(peer_type),
    )


def _parameters(plan: SimulationPlan, number: int) -> Any:
    """Return the parameters (n_p,) of a peer."""
    group = plan.comm_graph.group_of(number)
    row = plan.numbers.rows[group][number - int(plan.comm_graph.starts[group])]
    return plan.numbers.parameters[group][int(row)]


def _settable(peer_type: PeerType) -> tuple[int, ...]:
    """Return the indices of the parameters that can be set while the exported peer runs.

    They are used only in ticks, not in derivatives, sent values or start values.
    """
    tick_functions = [
        function
        for clock in peer_type.clocks
        for function in (clock.tick, *(each.edge for each in clock.receives))
        if function
    ]
    motion_functions = [peer_type.derivative, *(sending.send for sending in peer_type.sends)]
    start_parameters = {state.start for state in peer_type.states} | {
        start for clock in peer_type.clocks for start in clock.starts
    }
    # The parameters are the second-to-last argument of each function.
    used_in_ticks, used_elsewhere = (
        np.any(
            [
                structural_pattern(function.jac_sparsity(0, function.n_in() - 2)).any(axis=0)
                for function in functions
            ],
            axis=0,
        )
        for functions in (tick_functions, motion_functions)
    )
    indices = np.flatnonzero(used_in_ticks & ~used_elsewhere).tolist()
    return tuple(index for index in indices if peer_type.parameters[index] not in start_parameters)


def subsystems_of(plan: SimulationPlan) -> tuple[int, ...]:
    """Return, for each peer, the first peer of its group with equal parameters and weights."""
    first: dict[Any, int] = {}
    numbers = []
    graphs = [link for link in plan.comm_graph.links if not plan.comm_graph.is_complete(link)]
    for number in range(plan.comm_graph.peers):
        received = tuple(
            tuple(weight for _, weight in received_by(plan.model, plan.comm_graph, link, number))
            for link in graphs
        )
        key = plan.comm_graph.group_of(number), _parameters(plan, number).tobytes(), received
        numbers.append(first.setdefault(key, number))
    return tuple(numbers)


def refused(model: Model, message: str, fix: str = "", code: str = "E960", *, advice: str = "") -> ApcError:
    """Return the error for a peer that cannot be exported as C.

    Parameters
    ----------
    model
        The model.
    message, fix, code, advice
        The fields of the diagnostic.
    """
    return ApcError(Diagnostic(code, SourceLocation(model.origin.topology), message, fix=fix, advice=advice))


def _refuse_iterations(model: Model, name: str, peer_type: PeerType) -> None:
    """Raise ApcError E960 for a peer with equations solved by Newton's method, or without ticks.

    A peer that sends after its ticks is refused, too.
    """
    if after := [link.name for link in model.links if link.after]:
        message = f"packets of {after[0]} take the values after the ticks (order: after)"
        advice = "use order: before, or apc run"
        raise refused(model, f"{message}, which is not exported to C", advice=advice)
    if several := [link.name for link in model.links if len(link.clocks) > 1]:
        message = f"pairs of groups of {several[0]} have different clocks, which is not exported to C"
        raise refused(
            model,
            message,
            advice="use one link for each clock, whose means are then separate, or apc simulate",
        )
    for function, when, message, where in instant_functions(peer_type):
        if not function.is_a("SXFunction"):
            message = f"{name}: {when}{message}{where} need an iteration, which is not exported to C"
            raise refused(model, message, advice="write equations that can be solved for them")
    if not peer_type.clocks:
        message = f"{name} computes nothing at ticks of a clock, so there is no C code"
        raise refused(model, message)


# ---- states outside the computer


def _external_states(
    model: Model, name: str, subsystem: SubsystemJacobians, vector: Any, device: str | None
) -> frozenset[int]:
    """Return the states that the peer's computer does not integrate: those of its devices.

    Raises
    ------
    ApcError
        E961 no such part, no device, several possible devices, or a device coupled to an object copy.
    """
    peer_type = subsystem.peer_type
    if device == NO_DEVICE:
        return frozenset()
    parts = [whole_and_index(state.name)[0].rpartition(".")[0] for state in peer_type.states]
    masses = {part for row, part in enumerate(parts) if _is_position(peer_type, subsystem, row)}
    sent = {parts[int(row)] for send in subsystem.pattern.sends for row in np.flatnonzero(send.x.any(axis=0))}
    pattern = structural_pattern(peer_type.derivative.jac_sparsity(0, 0)).astype(float)
    coupled_sets = [set(rows.tolist()) for rows in coupled_states(pattern)]
    if device is not None:
        chosen = {part.strip() for part in device.split(",")}
        for mass in sorted(chosen - masses):
            near = nearest(mass, masses) or min(masses, default=NO_DEVICE)
            message = f"--device: unknown mass {mass[:40]!r} of {name}"
            raise refused(model, message, f"--device {near}", "E961")
    else:
        unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
        devices = find_devices(subsystem, vector, unit_of, direct=coupled_directly(model.peer_types))
        chosen = {text.rpartition(".")[0] if text.endswith("]") else text for text in devices}
    if not chosen:
        fix = f"--device {NO_DEVICE}, or --device {min(masses, default=NO_DEVICE)}"
        message = f"{name} has no device: each of its masses is sent to other peers"
        raise refused(model, message, fix, "E961")
    listed = sorted(chosen)
    if device is None and not peer_type.held and len(listed) > 1:
        message = f"{name}: {' and '.join(listed)} may be devices or object copies"
        raise refused(model, message, f"--device {','.join(listed)}, or --device {listed[0]}", "E961")
    outside: set[int] = set()
    for rows in coupled_sets:
        inside = {parts[row] for row in rows}
        if not inside & chosen:
            continue
        if copies := sorted((inside & sent) - chosen):
            moving, copied = " and ".join(sorted(inside & chosen)), " and ".join(copies)
            message = (
                f"{name}: {moving} and {copied} are coupled between ticks, so {copied} can't be computed "
                f"while {moving} is a physical device"
            )
            advice = "connect them by a part with a clock, such as SampledSpringDamper"
            raise refused(model, message, f"--device {NO_DEVICE}", "E961", advice=advice)
        outside |= rows
    return frozenset(outside)


def _is_position(peer_type: PeerType, subsystem: SubsystemJacobians, row: int) -> bool:
    """Return whether a state is the position of a mass: its rate is another state."""
    return (
        peer_type.states[row].unit == "m"
        and subsystem.pattern.a[row].sum() == 1
        and not subsystem.pattern.b[row].any()
    )


def _states_read(peer_type: PeerType) -> frozenset[int]:
    """Return the states that any function evaluated at an instant depends on."""
    reads = [
        structural_pattern(function.jac_sparsity(0, 0)).any(axis=0)
        for function, *_ in instant_functions(peer_type)
    ]
    return frozenset(np.flatnonzero(np.any(reads, axis=0)).tolist())


def _forces(
    model: Model, name: str, subsystem: SubsystemJacobians, vector: Any, outside: frozenset[int]
) -> tuple[Force, ...]:
    """Return the forces on the devices, as sums of hold outputs times factors."""
    peer_type = subsystem.peer_type
    if not outside:
        return ()
    unit_of = {parameter.name: parameter.unit for parameter in model.parameters}
    x, u, p, t = peer_type.derivative.sx_in()
    slopes = jacobian(peer_type.derivative(x, u, p, t), u)
    varying = casadi.vertcat(x, u, t)
    numbers = start_arguments(subsystem, rationals(vector), Fraction, None)
    forces = []
    for row in sorted(outside):
        if not _is_position(peer_type, subsystem, row):
            continue
        velocity = int(np.flatnonzero(subsystem.pattern.a[row])[0])
        if not subsystem.pattern.b[velocity].any():
            continue
        state = peer_type.states[row].name
        axis = slopes[velocity, :]
        if casadi.depends_on(axis, varying):
            message = f"{name}: the force on {state} is not a sum of values computed at ticks"
            advice = "use a motor without a limit; the real motor has one"
            raise refused(model, message, code="E961", advice=advice)
        device = find_device(subsystem, vector, unit_of, part=state)
        if not isinstance(device, Device):
            raise refused(model, f"{name}: {device or f'{state} is not a mass'}", code="E961")
        function = casadi.Function("slopes", [x, u, p, t], [casadi.densify(axis)])
        values = evaluate_exact(function, [numbers[0], numbers[1], numbers[4], numbers[5]])[0]
        terms = tuple((h, float(value / device.inverse)) for h, value in enumerate(values) if value)
        part, _, state_suffix = state.rpartition(".")
        forces.append(Force(f"{part}.f{state_suffix.removeprefix(whole_and_index(state_suffix)[0])}", terms))
    return tuple(forces)


# ---- states of the computer


def _transitions(
    plan: SimulationPlan,
    name: str,
    group: int,
    outside: frozenset[int],
    lengths: Sequence[int],
    method: Method,
    vector: Any,
) -> tuple[Move, ...]:
    """Return the transitions of the computer's states for every interval length in quanta."""
    model, index = plan.model, plan.model.groups[group].peer_type
    peer_type, subsystem, quantum = (
        model.peer_types[index],
        plan.subsystems[index],
        plan.schedules[group].quantum,
    )
    flowing = [row for row in rows_to_move(peer_type, method) if row not in outside]
    names = ", ".join(peer_type.states[row].name for row in flowing)
    if flowing and method.step is None:
        message = f"{name}: {names} are integrated by CVODES between ticks, which is not exported to C"
        raise refused(model, message, STEPS)
    if flowing and not peer_type.derivative.is_a("SXFunction"):
        message = f"{name}: the rates of {names} need an iteration, which is not exported to C"
        raise refused(model, message, advice="write equations that can be solved for them")
    groups_with_rows = zip(model.groups, plan.numbers.parameters, strict=True)
    numbers = [row for item, rows in groups_with_rows if item.peer_type == index for row in rows]
    flow = flow_of(peer_type, method, flowing, state_scales(model, peer_type, subsystem, numbers))
    linear = rates(peer_type, [*sorted(outside), *flowing])
    if linear.timed:
        inputs = linear.rate.sx_in()
        g = linear.rate(*inputs)
        rows = [row for row in range(g.numel()) if casadi.depends_on(g[row], inputs[1])]
        pushed = ", ".join(peer_type.states[row].name for row in rows)
        message = f"{name}: the force on {pushed} depends on time between ticks"
        raise refused(model, f"{message}; its exact integral is not exported to C", STEPS)
    seconds = [length * quantum for length in lengths]
    matrices = transition_rows(linear, vector[None], seconds)
    moves = []
    for length, duration, matrix in zip(lengths, seconds, matrices, strict=True):
        function = flow.over(duration) if flow is not None else None
        if function is not None and not function.is_a("SXFunction"):
            message = f"{name}: {names} need too many steps of {method} between two events"
            raise refused(model, message, STEPS)
        moves.append(Move(length, matrix[0], tuple(flowing), function))
    return tuple(moves)


def _instants(schedule: Schedule) -> tuple[tuple[Instant, ...], tuple[int, ...]]:
    """Return the instants of a frame, and the distinct interval lengths between them in quanta."""
    lengths = sorted({event.duration for event in schedule.events if isinstance(event, frames.Propagate)})
    ticked: Counter[int] = Counter()
    instants = []
    for _, group in groupby(timed_events(schedule), itemgetter(0)):  # each group ends with a propagation
        *simultaneous, move = (event for _, event in group)
        assert isinstance(move, frames.Propagate), "an instant is over when time goes on"
        ticks = tuple(tick.partition for tick in simultaneous if isinstance(tick, frames.Tick))
        ticked.update(ticks)
        acts = [(act.hold, act.value) for act in simultaneous if isinstance(act, frames.HoldUpdate)]
        instants.append(
            Instant(
                tuple(send.partition for send in simultaneous if isinstance(send, frames.SendEvent)),
                ticks,
                tuple(ForceUpdate(hold, ticked[value.partition] - 1 - value.index) for hold, value in acts),
                lengths.index(move.duration),
            )
        )
    return tuple(instants), tuple(lengths)


# ---- received values


def lines_of(
    plan: SimulationPlan, number: int
) -> tuple[tuple[PeerLink, ...], dict[tuple[int, int], tuple[int, ...]]]:
    """Return the links of a peer, and for each receive the indices of its channels in the packet."""
    model, comm_graph, group = plan.model, plan.comm_graph, plan.comm_graph.group_of(number)
    subsystem, schedule = plan.subsystems[model.groups[group].peer_type], plan.schedules[group]
    peer_type = subsystem.peer_type
    read = {
        (event.partition, index): peer_type.clocks[event.partition].receives[index].link
        for event in schedule.events
        if isinstance(event, frames.Tick)
        for index, rows in enumerate(event.input_rows)
        if rows
    }
    lines: list[PeerLink] = []
    indices: dict[tuple[int, int], tuple[int, ...]] = {}
    for name, (link, declared) in zip(
        prefixed("link", comm_graph.links), comm_graph.links.items(), strict=True
    ):
        sent = {sent.channel for sent in schedule.sent if sent.link == link}
        channels_by_receive = {
            key: subsystem.pattern.ticks[key[0]].channels[key[1]]
            for key, text in read.items()
            if text == link
        }
        receives = {channel for channels in channels_by_receive.values() for channel in channels}
        if not receives and not sent:
            continue
        index, send_partition = next(
            (index, send)
            for each in (peer_type, *model.peer_types)
            for index, send in enumerate(each.sends)
            if send.link == link
        )
        used_channels = [
            i for i, channel in enumerate(send_partition.channels) if i in receives or channel in sent
        ]
        indices |= {
            key: tuple(map(used_channels.index, channels)) for key, channels in channels_by_receive.items()
        }
        channels = tuple(send_partition.channels[i] for i in used_channels)
        members = prefixed("value", channels)
        senders = [*received_by(plan.model, plan.comm_graph, link, number)] if receives else []
        if len(senders) > MOST_RECEIVED:
            message = f"{comm_graph.peer_name(number)} receives from {len(senders):,} peers over {link}"
            message = f"{message}; the limit of the C export is {MOST_RECEIVED:,}"
            raise refused(model, message, advice="reduce the number of peers, or use a sparse graph")
        lines.append(
            PeerLink(
                link=link,
                name=name,
                packet=tuple(
                    map(PacketEntry, channels, [send_partition.units[i] for i in used_channels], members)
                ),
                sending=index if sent else -1,
                senders=tuple(
                    Sender(
                        sender,
                        comm_graph.peer_name(sender),
                        weight,
                        first_packet(plan, link, sender, channels),
                    )
                    for sender, weight in senders
                ),
                missing=bool(senders) and any(channel.on_loss == "zero" for channel in declared.channels),
                complete=comm_graph.is_complete(link),
            )
        )
    return tuple(lines), indices


def first_packet(plan: SimulationPlan, link: str, number: int, channels: Sequence[str]) -> tuple[float, ...]:
    """Return the values used for a sender before its first packet arrives, one per channel."""
    subsystem = plan.subsystems[plan.model.groups[plan.comm_graph.group_of(number)].peer_type]
    sent: dict[str, float] = {}
    for sending in subsystem.peer_type.sends:
        if sending.link == link:
            vector = [float(parameter) for parameter in _parameters(plan, number)]
            x, u, _ = start_values(subsystem, vector)
            values = np.asarray(sending.send(x, u, vector, 0.0), np.float64).ravel().tolist()
            sent = dict(zip(sending.channels, values, strict=True))
    return tuple(sent.get(channel, 0.0) for channel in channels)


def received_by(
    model: Model, comm_graph: CommunicationGraph, link: str, number: int
) -> Iterator[tuple[int, float]]:
    """Yield the senders to a peer over a link, with their weights, in the order of peers."""
    if comm_graph.is_complete(link):
        senders = [(index, 1.0) for index in range(comm_graph.peers) if index != number]
    else:
        pairs, weights = comm_graph.arcs(link)
        own_rows = np.flatnonzero(pairs[:, 1] == number)
        senders = sorted(zip(pairs[own_rows, 0].tolist(), weights[own_rows].tolist(), strict=True))
    peer_types = [model.peer_types[group.peer_type] for group in model.groups]
    sends = [any(sending.link == link for sending in peer_type.sends) for peer_type in peer_types]
    return ((sender, weight) for sender, weight in senders if sends[comm_graph.group_of(sender)])


def instant_functions(peer_type: PeerType) -> list[tuple[Any, str, str, str]]:
    """Return all functions of a peer evaluated at instants: function, time, results and link in words."""
    result = [
        (clock.tick, f"at a tick of {clock.clock} ", ", ".join(clock.outputs), "")
        for clock in peer_type.clocks
    ]
    edges = [each.edge for clock in peer_type.clocks for each in clock.receives if each.edge is not None]
    result += [(edge, "", "an edge function", "") for edge in edges]
    return [
        *result,
        *((send.send, "", ", ".join(send.channels), f" of {send.link}") for send in peer_type.sends),
    ]


def has_edge(peer_type: PeerType, partition: int, receive: int) -> bool:
    """Return whether a receive has an edge function."""
    clock = peer_type.clocks[partition]
    return bool(edge_name(clock, clock.receives[receive]))
