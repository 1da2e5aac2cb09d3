"""One peer apart from the others: what it measures and hears, computes, sends, and moves by itself.

Takes: a `Model`, which of its peers, how its states move between events.
Gives: `ExportedPeer`, `peer_of`, `sites_of`, `lines_of`, `first_packet`, `heard_of`, `has_edge`, `computing`,
`refused`; its parts `Instant`, `ForceUpdate`, `PeerLink`, `Sender`, `Force`, `Move`.
Guarantees: the functions, transitions and instants are those that `simulate` plays; what stands in no finite
list of arithmetic is refused, by the name of what moves or is computed so.
Does not: write anything (see `c_text`), or carry packets from peer to peer (see `scene_text`).

A peer's states fall into sets that equations tie to each other. The set that a hand holds is a device; where
no hand says so, the one with a mass that others are not told of, since what they are told of is a copy of
what all hold. A device moves by itself, and what is computed from it is measured; a copy moves in the peer's
computer. A device that is tied to a copy by more than forces computed at ticks can't be told apart from it.
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
from apc.frame import schedule as frames
from apc.frame.devices import Device, coupled_directly, find_device, find_devices
from apc.frame.discretize import moved_together
from apc.frame.exact import evaluate_exact
from apc.frame.exchange import CommunicationGraph
from apc.frame.jacobians import SubsystemJacobians, edge_name, structural_pattern
from apc.frame.linearize import start_arguments, start_values
from apc.frame.parameters import exact_numbers
from apc.frame.schedule import Schedule
from apc.simulation.flow import flow_of, rows_to_move, state_scales
from apc.simulation.program import timed_events
from apc.simulation.propagate import rates, transition_rows
from apc.simulation.settings import Method
from apc.simulation.signals import LocalSignal, local_signals
from apc.simulation.simulation import SimulationPlan

NO_DEVICE = "none"  # the word for a peer that moves nothing outside its computer
MOST_HEARD = 20_000  # peers that one hears: each is a line of the text
STEPS = "--method rk4:0.1ms"  # a method that is arithmetic, whatever moves


@dataclass(frozen=True, slots=True)
class ForceUpdate:
    """Hold `hold` puts out what was computed for it `lag` ticks ago."""

    hold: int
    lag: int


@dataclass(frozen=True, slots=True)
class Instant:
    """What happens at once, in this order; then nothing for the `move`-th of the peer's lengths of time.

    `sends` and `ticks` are partitions.
    """

    sends: tuple[int, ...]
    ticks: tuple[int, ...]
    acts: tuple[ForceUpdate, ...]
    move: int


@dataclass(frozen=True, slots=True)
class Sender:
    """Another peer, by its number, that is heard: its name, what its packets are weighed by.

    `start` is what is heard of it before a packet arrives, a number a channel.
    """

    peer: int
    name: str
    weight: float
    start: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class PacketEntry:
    """An entry of a packet: its channel's name, its unit, and what it is called in C."""

    name: str
    unit: str
    member: str


@dataclass(frozen=True, slots=True)
class PeerLink:
    """A link as one peer has it: what a packet holds, who is heard, whether it can miss a packet.

    In C the line is called `name`. `sending` is the peer's own send partition, −1 if it sends nothing there;
    `complete` says that everybody hears everybody.
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
    """What pushes a device along an axis, in N: `terms` are (hold, factor)."""

    name: str
    terms: tuple[tuple[int, float], ...]


@dataclass(frozen=True, slots=True, eq=False)
class Move:
    """What the computer's states do in `quanta`: x⁺ = matrix · (x, u, 1) row by row, or by `flow`.

    `flow` (x, u, p, t) -> x⁺ is of the states `flowing`.
    """

    quanta: int
    matrix: Any  # (n_x, n_x + n_u + 1)
    flowing: tuple[int, ...]
    flow: Any | None  # casadi.Function


@dataclass(frozen=True, slots=True, eq=False)
class ExportedPeer:
    """A peer. `number` counts from 0 over all groups; `parameters` (n_p,) are its kind's.

    In C it is called `identifier`. `outside` are the states that its computer does not move, `measured` those
    of them that it looks at, by what they are called in C, and `forces` likewise. `channels` are, by clock
    partition and receive, the places of what is heard among those of its line; a receive that nothing reads
    has none. `start` are the states', `memories` those of each clock partition's remembered outputs.
    `settable` are the places of the parameters that only ticks read, see `_settable`.
    """

    system: Model
    name: str
    identifier: str
    number: int
    kind: PeerType
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
        """What there is to look at: states that its computer moves, what is computed, what acts later."""
        outside = {("state", (row,)) for row in self.outside}
        every = local_signals(self.kind, self.schedule)
        return tuple(
            local_signal
            for local_signal in every
            if local_signal.role != "limited" and (local_signal.role, local_signal.place) not in outside
        )

    @property
    def sending(self) -> tuple[PeerLink, ...]:
        """The lines over which it sends."""
        return tuple(line for line in self.lines if line.sending >= 0)

    def line(self, link: str) -> PeerLink:
        """Return what it has of a link."""
        return next(line for line in self.lines if line.link == link)


def peer_of(
    plan: SimulationPlan, number: int, method: Method, *, device: str | None = NO_DEVICE, name: str = ""
) -> ExportedPeer:
    """Take a peer out of its scene.

    Parameters
    ----------
    plan
        What the peers of the scene do in a frame.
    number
        Which, counted from 0 over all groups.
    method
        How the states move that no exact transition moves.
    device
        The part that moves outside the computer, `NO_DEVICE` if none does; None: what others are not told of.
    name
        What it is called in C; follows from its name in the scene if not given.

    Raises
    ------
    ApcError
        E960 it does what is not arithmetic, or has no ticks; E961 no device, or one that can't be told apart.
    """
    system, group = plan.system, plan.exchange.group_of(number)
    place = system.groups[group].kind
    kind, site, schedule = system.kinds[place], plan.sites[place], plan.schedules[group]
    vector, label = _parameters(plan, number), plan.exchange.peer_name(number)
    _refuse_what_iterates(system, label, kind)
    outside = _outside(system, label, site, vector, device)
    instants, lengths = _instants(schedule)
    lines, channels = lines_of(plan, number)
    looked_at = sorted(outside & _read(kind))
    measured = prefixed("measured", (kind.states[row].name for row in looked_at))
    forces = _forces(system, label, site, vector, outside)
    pushed = prefixed("force", (force.name for force in forces))
    x, _, memories = start_values(site, [float(item) for item in vector])
    return ExportedPeer(
        system=system,
        name=label,
        identifier=name or identifier(label),
        number=number,
        kind=kind,
        schedule=schedule,
        parameters=vector,
        outside=outside,
        measured=dict(zip(looked_at, measured, strict=True)),
        forces=dict(zip(pushed, forces, strict=True)),
        lines=lines,
        channels=channels,
        instants=instants,
        moves=_moves(plan, label, group, outside, lengths, method, vector),
        start=tuple(x),
        memories=tuple(map(tuple, memories)),
        settable=_settable(kind),
    )


def _parameters(plan: SimulationPlan, number: int) -> Any:
    """Return a peer's vector (n_p,) of parameters."""
    group = plan.exchange.group_of(number)
    row = plan.numbers.rows[group][number - int(plan.exchange.starts[group])]
    return plan.numbers.parameters[group][int(row)]


def _settable(kind: PeerType) -> tuple[int, ...]:
    """Return the places of the parameters that only ticks read: how states move, what they and packets start
    with, is the same whatever these are."""
    ticks = [
        function
        for clock in kind.clocks
        for function in (clock.tick, *(each.edge for each in clock.receives))
        if function
    ]
    others = [kind.derivative, *(sending.send for sending in kind.sends)]
    fixed = {state.start for state in kind.states} | {
        start for clock in kind.clocks for start in clock.starts
    }
    read, moves = (
        np.any(
            [
                structural_pattern(function.jac_sparsity(0, function.n_in() - 2)).any(axis=0)
                for function in functions
            ],
            axis=0,
        )
        for functions in (ticks, others)
    )
    places = np.flatnonzero(read & ~moves).tolist()
    return tuple(place for place in places if kind.parameters[place] not in fixed)


def sites_of(plan: SimulationPlan) -> tuple[int, ...]:
    """Return of every peer the first one of its group and numbers that hears others by the same weights."""
    first: dict[Any, int] = {}
    numbers = []
    graphs = [link for link in plan.exchange.links if not plan.exchange.is_complete(link)]
    for number in range(plan.exchange.peers):
        heard = tuple(
            tuple(weight for _, weight in heard_of(plan.system, plan.exchange, link, number))
            for link in graphs
        )
        key = plan.exchange.group_of(number), _parameters(plan, number).tobytes(), heard
        numbers.append(first.setdefault(key, number))
    return tuple(numbers)


def refused(system: Model, what: str, hint: str = "", code: str = "E960") -> ApcError:
    """Return the message of what can't be written as C."""
    return ApcError(Diagnostic(code, SourceLocation(system.origin.topology), what, hint=hint))


def _refuse_what_iterates(system: Model, name: str, kind: PeerType) -> None:
    """Refuse a peer of which something is solved by Newton's method."""
    for function, when, what, where in computing(kind):
        if not function.is_a("SXFunction"):
            what = f"{name}: {when}{what}{where} are solved for by iteration, which is not written as C"
            raise refused(system, what, "equations that can be solved for these")
    if not kind.clocks:
        what = f"{name} computes nothing at any tick of a clock: there is nothing to write as C"
        raise refused(system, what)


# ---- what moves outside


def _outside(
    system: Model, name: str, site: SubsystemJacobians, vector: Any, device: str | None
) -> frozenset[int]:
    """Return the states that the peer's computer does not move."""
    kind = site.kind
    if device == NO_DEVICE:
        return frozenset()
    parts = [whole_and_index(state.name)[0].rpartition(".")[0] for state in kind.states]
    masses = {part for row, part in enumerate(parts) if _is_position(kind, site, row)}
    sent = {parts[int(row)] for send in site.pattern.sends for row in np.flatnonzero(send.x.any(axis=0))}
    pattern = structural_pattern(kind.derivative.jac_sparsity(0, 0)).astype(float)
    tied = [set(rows.tolist()) for rows in moved_together(pattern)]
    if device is not None:
        chosen = {part.strip() for part in device.split(",")}
        for mass in sorted(chosen - masses):
            near = nearest(mass, masses) or min(masses, default=NO_DEVICE)
            what = f"--device: no mass of {name} is called {mass[:40] or 'so'}"
            raise refused(system, what, f"--device {near}", "E961")
    else:
        unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
        devices = find_devices(site, vector, unit_of, direct=coupled_directly(system.kinds))
        chosen = {device.rpartition(".")[0] if device.endswith("]") else device for device in devices}
    if not chosen:
        hint = f"--device {NO_DEVICE} if its computer moves them all, or --device "
        what = f"{name} has no device: others are told of every mass of it"
        raise refused(system, what, hint + min(masses, default=NO_DEVICE), "E961")
    listed = sorted(chosen)
    if device is None and not kind.held and len(listed) > 1:
        what = f"{name}: {' and '.join(listed)} may be devices, or copies that its computer moves"
        raise refused(system, what, f"--device {','.join(listed)} or --device {listed[0]}", "E961")
    outside: set[int] = set()
    for rows in tied:
        inside = {parts[row] for row in rows}
        if not inside & chosen:
            continue
        if copies := sorted((inside & sent) - chosen):
            moving, copied = " and ".join(sorted(inside & chosen)), " and ".join(copies)
            what = (
                f"{name}: {moving} and {copied} are tied to each other between ticks: no computer can move "
                f"{copied} where {moving} moves by itself"
            )
            hint = f"a part with a clock between them, as SampledSpringDamper, or --device {NO_DEVICE}"
            raise refused(system, what, hint, "E961")
        outside |= rows
    return frozenset(outside)


def _is_position(kind: PeerType, site: SubsystemJacobians, row: int) -> bool:
    """Say whether a state is a place whose rate is another state, as of a mass."""
    return kind.states[row].unit == "m" and site.pattern.a[row].sum() == 1 and not site.pattern.b[row].any()


def _read(kind: PeerType) -> frozenset[int]:
    """Return the states that anything computed at an instant looks at."""
    reads = [structural_pattern(function.jac_sparsity(0, 0)).any(axis=0) for function, *_ in computing(kind)]
    return frozenset(np.flatnonzero(np.any(reads, axis=0)).tolist())


def _forces(
    system: Model, name: str, site: SubsystemJacobians, vector: Any, outside: frozenset[int]
) -> tuple[Force, ...]:
    """Return what pushes the devices, as sums of what holds put out."""
    kind = site.kind
    if not outside:
        return ()
    unit_of = {parameter.name: parameter.unit for parameter in system.parameters}
    x, u, p, t = kind.derivative.sx_in()
    slopes = jacobian(kind.derivative(x, u, p, t), u)
    varying = casadi.vertcat(x, u, t)
    numbers = start_arguments(site, exact_numbers(kind, vector), Fraction, None)
    forces = []
    for row in sorted(outside):
        if not _is_position(kind, site, row):
            continue
        velocity = int(np.flatnonzero(site.pattern.a[row])[0])
        if not site.pattern.b[velocity].any():
            continue
        state = kind.states[row].name
        axis = slopes[velocity, :]
        if casadi.depends_on(axis, varying):
            what = f"{name}: what pushes {state} is no sum of what ticks compute: it bends with the motion"
            hint = "a motor without a limit, which the real one has"
            raise refused(system, what, hint, "E961")
        device = find_device(site, vector, unit_of, part=state)
        if not isinstance(device, Device):
            raise refused(system, f"{name}: {device or f'{state} is no mass'}", code="E961")
        function = casadi.Function("slopes", [x, u, p, t], [casadi.densify(axis)])
        values = evaluate_exact(function, [numbers[0], numbers[1], numbers[4], numbers[5]])[0]
        terms = tuple((h, float(value / device.inverse)) for h, value in enumerate(values) if value)
        part, _, own = state.rpartition(".")
        forces.append(Force(f"{part}.f{own.removeprefix(whole_and_index(own)[0])}", terms))
    return tuple(forces)


# ---- what moves inside


def _moves(
    plan: SimulationPlan,
    name: str,
    group: int,
    outside: frozenset[int],
    lengths: Sequence[int],
    method: Method,
    vector: Any,
) -> tuple[Move, ...]:
    """Return what the computer's states do in every length of time, in quanta."""
    system, place = plan.system, plan.system.groups[group].kind
    kind, site, quantum = system.kinds[place], plan.sites[place], plan.schedules[group].quantum
    flowing = [row for row in rows_to_move(kind, method) if row not in outside]
    names = ", ".join(kind.states[row].name for row in flowing)
    if flowing and method.step is None:
        what = f"{name}: between ticks {names} move by CVODES, which is not written as C"
        raise refused(system, what, STEPS)
    if flowing and not kind.derivative.is_a("SXFunction"):
        what = f"{name}: the rates of {names} are solved for by iteration, which is not written as C"
        raise refused(system, what, "equations that can be solved for these")
    every = zip(system.groups, plan.numbers.parameters, strict=True)
    numbers = [row for group, rows in every if group.kind == place for row in rows]
    flow = flow_of(kind, method, flowing, state_scales(system, kind, site, numbers))
    linear = rates(kind, [*sorted(outside), *flowing])
    if linear.timed:
        inputs = linear.rate.sx_in()
        g = linear.rate(*inputs)
        rows = [row for row in range(g.numel()) if casadi.depends_on(g[row], inputs[1])]
        pushed = ", ".join(kind.states[row].name for row in rows)
        what = f"{name}: {pushed} is pushed by a force that changes with time between ticks"
        raise refused(system, f"{what}; its exact integral is not written as C", STEPS)
    seconds = [length * quantum for length in lengths]
    matrices = transition_rows(linear, vector[None], seconds)
    moves = []
    for length, duration, matrix in zip(lengths, seconds, matrices, strict=True):
        function = flow.over(duration) if flow is not None else None
        if function is not None and not function.is_a("SXFunction"):
            what = f"{name}: {names} take too many steps of {method} from one instant to the next"
            raise refused(system, f"{what} to be written", STEPS)
        moves.append(Move(length, matrix[0], tuple(flowing), function))
    return tuple(moves)


def _instants(schedule: Schedule) -> tuple[tuple[Instant, ...], tuple[int, ...]]:
    """Return the instants of a frame, and the lengths of time between them in quanta."""
    lengths = sorted({event.duration for event in schedule.events if isinstance(event, frames.Propagate)})
    ticked: Counter[int] = Counter()
    instants = []
    for _, group in groupby(timed_events(schedule), itemgetter(0)):  # each ends with a length of time
        *listed, move = (event for _, event in group)
        assert isinstance(move, frames.Propagate), "an instant is over when time goes on"
        ticks = tuple(tick.partition for tick in listed if isinstance(tick, frames.Tick))
        ticked.update(ticks)
        acts = [(act.hold, act.value) for act in listed if isinstance(act, frames.HoldUpdate)]
        instants.append(
            Instant(
                tuple(send.partition for send in listed if isinstance(send, frames.SendEvent)),
                ticks,
                tuple(ForceUpdate(hold, ticked[value.partition] - 1 - value.index) for hold, value in acts),
                lengths.index(move.duration),
            )
        )
    return tuple(instants), tuple(lengths)


# ---- what is heard


def lines_of(
    plan: SimulationPlan, number: int
) -> tuple[tuple[PeerLink, ...], dict[tuple[int, int], tuple[int, ...]]]:
    """Return the links of a peer, and for every receive the places of its channels on its line."""
    system, exchange, group = plan.system, plan.exchange, plan.exchange.group_of(number)
    site, schedule = plan.sites[system.groups[group].kind], plan.schedules[group]
    kind = site.kind
    read = {
        (event.partition, place): kind.clocks[event.partition].receives[place].link
        for event in schedule.events
        if isinstance(event, frames.Tick)
        for place, rows in enumerate(event.heard)
        if rows
    }
    lines: list[PeerLink] = []
    places: dict[tuple[int, int], tuple[int, ...]] = {}
    for name, (link, declared) in zip(prefixed("link", exchange.links), exchange.links.items(), strict=True):
        sent = {sent.channel for sent in schedule.sent if sent.link == link}
        of = {key: site.pattern.ticks[key[0]].channels[key[1]] for key, text in read.items() if text == link}
        hears = {channel for channels in of.values() for channel in channels}
        if not hears and not sent:
            continue
        place, send_partition = next(
            (place, send)
            for each in (kind, *system.kinds)
            for place, send in enumerate(each.sends)
            if send.link == link
        )
        used = [i for i, channel in enumerate(send_partition.channels) if i in hears or channel in sent]
        places |= {key: tuple(map(used.index, channels)) for key, channels in of.items()}
        channels = tuple(send_partition.channels[i] for i in used)
        members = prefixed("value", channels)
        senders = [*heard_of(plan.system, plan.exchange, link, number)] if hears else []
        if len(senders) > MOST_HEARD:
            what = f"{exchange.peer_name(number)} hears {len(senders):,} peers over {link}"
            what = f"{what}; {MOST_HEARD:,} fit a text of C"
            raise refused(system, what, "fewer peers, or a graph that is not complete")
        law = declared.channel
        lines.append(
            PeerLink(
                link=link,
                name=name,
                packet=tuple(map(PacketEntry, channels, [send_partition.units[i] for i in used], members)),
                sending=place if sent else -1,
                senders=tuple(
                    Sender(
                        number, exchange.peer_name(number), weight, first_packet(plan, link, number, channels)
                    )
                    for number, weight in senders
                ),
                missing=law is not None and law.on_loss == "zero" and bool(senders),
                complete=exchange.is_complete(link),
            )
        )
    return tuple(lines), places


def first_packet(plan: SimulationPlan, link: str, number: int, channels: Sequence[str]) -> tuple[float, ...]:
    """Return what is heard of a peer over a link before any packet of it arrives, channel by channel."""
    site = plan.sites[plan.system.groups[plan.exchange.group_of(number)].kind]
    sent: dict[str, float] = {}
    for sending in site.kind.sends:
        if sending.link == link:
            vector = [float(matrix) for matrix in _parameters(plan, number)]
            x, u, _ = start_values(site, vector)
            values = np.asarray(sending.send(x, u, vector, 0.0), np.float64).ravel().tolist()
            sent = dict(zip(sending.channels, values, strict=True))
    return tuple(sent.get(channel, 0.0) for channel in channels)


def heard_of(
    system: Model, exchange: CommunicationGraph, link: str, number: int
) -> Iterator[tuple[int, float]]:
    """Yield the peers that one hears over a link, with their weights, in the scene's order."""
    if exchange.is_complete(link):
        listed = [(index, 1.0) for index in range(exchange.peers) if index != number]
    else:
        pairs, weights = exchange.arcs(link)
        mine = np.flatnonzero(pairs[:, 1] == number)
        listed = sorted(zip(pairs[mine, 0].tolist(), weights[mine].tolist(), strict=True))
    kinds = [system.kinds[group.kind] for group in system.groups]
    sends = [any(sending.link == link for sending in kind.sends) for kind in kinds]
    return ((number, weight) for number, weight in listed if sends[exchange.group_of(number)])


def computing(kind: PeerType) -> list[tuple[Any, str, str, str]]:
    """Return all that a peer computes at instants: each function, when, what it gives, over which link."""
    result = [
        (clock.tick, f"at a tick of {clock.clock} ", ", ".join(clock.outputs), "") for clock in kind.clocks
    ]
    edges = [each.edge for clock in kind.clocks for each in clock.receives if each.edge is not None]
    result += [(edge, "", "a look at others", "") for edge in edges]
    return [*result, *((send.send, "", ", ".join(send.channels), f" of {send.link}") for send in kind.sends)]


def has_edge(kind: PeerType, partition: int, receive: int) -> bool:
    """Say whether a receive looks at each sender by itself."""
    clock = kind.clocks[partition]
    return bool(edge_name(clock, clock.receives[receive]))
