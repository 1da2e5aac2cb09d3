"""One peer apart from the others: what it measures and hears, computes, sends, and moves by itself.

Takes: a `CompiledSystem`, which of its peers, how its states move between events.
Gives: `Peer`, `peer_of`, `sites_of`, `group_of`, `lines_of`, `first_packet`, `has_edge`, `refused`;
its parts `Instant`, `Act`, `Line`, `Sender`, `Force`, `Move`.
Guarantees: the functions, transitions and instants are those that `simulate` plays; what stands in no finite
list of arithmetic is refused, by the name of what moves or is computed so.
Does not: write anything (see `c_text`), or carry packets from peer to peer (see `scene_text`).

A peer's states fall into sets that equations tie to each other. The set that a hand holds is a device; where
no hand says so, the one with a mass that others are not told of, since what they are told of is a copy of
what all hold. A device moves by itself, and what is computed from it is measured; a copy moves in the peer's
computer. A device that is tied to a copy by more than forces computed at ticks can't be told apart from it.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import casadi
import numpy as np

from apc.compiler.compiled import CompiledSystem, Kind
from apc.compiler.errors import ApcError, Mistake, Place, nearest
from apc.compiler.interpolation import jacobian
from apc.compiler.language.vectors import whole_and_index
from apc.frame import schedule as frames
from apc.frame.devices import Device, find_device
from apc.frame.discretize import moved_together
from apc.frame.exact import evaluate_exact
from apc.frame.exchange import Exchange
from apc.frame.jacobians import SiteJacobians, edge_name, structural_pattern
from apc.frame.parameters import exact_numbers
from apc.frame.schedule import Schedule
from apc.frame.start import start_arguments, start_values
from apc.simulation.flow import flow_of, rows_to_move, state_scales
from apc.simulation.propagate import rates, transition_rows
from apc.simulation.settings import Method
from apc.simulation.signals import LocalSignal, local_signals
from apc.simulation.simulation import Plan

NO_DEVICE = "none"  # the word for a peer that moves nothing outside its computer
MOST_HEARD = 20_000  # peers that one hears: each is a line of the text
STEPS = "--method rk4:0.1ms"  # a method that is arithmetic, whatever moves


@dataclass(frozen=True, slots=True)
class Act:
    """Hold `hold` puts out output `output` of clock partition `partition`, computed `lag` ticks ago."""

    hold: int
    partition: int
    output: int
    lag: int


@dataclass(frozen=True, slots=True)
class Instant:
    """What happens at once, in this order; then nothing for the `move`-th of the peer's lengths of time.

    `sends` and `ticks` are partitions.
    """

    sends: tuple[int, ...]
    ticks: tuple[int, ...]
    acts: tuple[Act, ...]
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
class Line:
    """A link as one peer has it: what is told over it, who is heard, whether it can miss a packet.

    `sending` is the peer's own send partition, −1 if it sends nothing there; `complete` says that everybody
    hears everybody.
    """

    link: str
    channels: tuple[str, ...]
    units: tuple[str, ...]
    sending: int
    senders: tuple[Sender, ...]
    missing: bool
    complete: bool


@dataclass(frozen=True, slots=True)
class Force:
    """What pushes a device along an axis, in N: `terms` are (hold, factor). `state` is the axis' position."""

    state: int
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
class Peer:
    """A peer. `number` counts from 0 over all groups; `parameters` (n_p,) are its kind's.

    `outside` are the states that its computer does not move, `measured` those of them that it looks at.
    `channels` are, for each receive of each clock partition, the places of what it hears among those of its
    line; no place for a receive that nothing reads. `start` are the states', `memories` those of each clock
    partition's remembered outputs.
    """

    system: CompiledSystem
    name: str
    number: int
    kind: Kind
    schedule: Schedule
    parameters: Any
    outside: frozenset[int]
    measured: tuple[int, ...]
    forces: tuple[Force, ...]
    lines: tuple[Line, ...]
    channels: tuple[tuple[tuple[int, ...], ...], ...]
    instants: tuple[Instant, ...]
    moves: tuple[Move, ...]
    start: tuple[float, ...]
    memories: tuple[tuple[float, ...], ...]

    @property
    def signals(self) -> tuple[LocalSignal, ...]:
        """What there is to look at: of the states those that its computer moves."""
        every = local_signals(self.kind, self.schedule)
        return tuple(one for one in every if one.role != "state" or one.place[0] not in self.outside)

    def line(self, link: str) -> Line:
        """Return what it has of a link."""
        return next(one for one in self.lines if one.link == link)


def peer_of(plan: Plan, number: int, method: Method, *, device: str | None = NO_DEVICE) -> Peer:
    """Take a peer apart from the others.

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

    Raises
    ------
    ApcError
        E960 it does what is not arithmetic, or has no ticks; E961 no device, or one that can't be told apart.
    """
    system, exchange = plan.system, plan.exchange
    group = group_of(plan, number)
    place = system.groups[group].kind
    kind, site, schedule = system.kinds[place], plan.sites[place], plan.schedules[group]
    row = int(plan.numbers.rows[group][number - int(exchange.starts[group])])
    vector = plan.numbers.parameters[group][row]
    name = exchange.peer_name(number)
    _refuse_what_iterates(system, name, kind)
    outside = _outside(system, name, site, device)
    numbers = [
        own
        for one, listed in zip(system.groups, plan.numbers.parameters, strict=True)
        if one.kind == place
        for own in listed
    ]
    instants, lengths = _instants(schedule)
    lines, channels = lines_of(plan, number)
    x, _, memories = start_values(site, [float(one) for one in vector])
    return Peer(
        system=system,
        name=name,
        number=number,
        kind=kind,
        schedule=schedule,
        parameters=vector,
        outside=outside,
        measured=tuple(sorted(outside & _read(kind))),
        forces=_forces(system, name, site, vector, outside),
        lines=lines,
        channels=channels,
        instants=instants,
        moves=_moves(system, name, site, schedule, outside, lengths, method, vector, numbers),
        start=tuple(float(one) for one in x),
        memories=tuple(tuple(float(one) for one in own) for own in memories),
    )


def group_of(plan: Plan, number: int) -> int:
    """Return the group of a peer, counted from 0 over all groups."""
    return int(np.searchsorted(plan.exchange.starts, number, side="right")) - 1


def sites_of(plan: Plan) -> tuple[int, ...]:
    """Return of every peer the first one that is like it: of its group and numbers, and hears as many."""
    first: dict[Any, int] = {}
    found = []
    for group, rows in enumerate(plan.numbers.rows):
        begin = int(plan.exchange.starts[group])
        for place, row in enumerate(rows.tolist()):
            number = begin + place
            heard = tuple(
                (link, tuple(weight for _, weight in _heard(plan.system, plan.exchange, link, number)))
                for link in plan.exchange.links
                if not plan.exchange.is_complete(link)
            )
            found.append(first.setdefault((group, row, heard), number))
    return tuple(found)


def refused(system: CompiledSystem, what: str, hint: str = "") -> ApcError:
    """Return the message (E960) of what can't be written as C."""
    return ApcError(Mistake("E960", Place(system.origin.topology), what, hint=hint))


def _refuse_what_iterates(system: CompiledSystem, name: str, kind: Kind) -> None:
    """Refuse a peer of which something is solved by Newton's method."""
    for partition in kind.clocks:
        if not partition.tick.is_a("SXFunction"):
            outputs = ", ".join(partition.outputs)
            what = (
                f"{name}: at a tick of {partition.clock} {outputs} are solved for by iteration, which is not"
            )
            raise refused(system, f"{what} written as C", "equations that can be solved for these")
    for one in kind.sends:
        if not one.send.is_a("SXFunction"):
            what = (
                f"{name}: {', '.join(one.channels)} of {one.link} are solved for by iteration, which is not"
            )
            raise refused(system, f"{what} written as C", "equations that can be solved for these")
    if not kind.clocks:
        raise refused(
            system, f"{name} computes nothing at any tick of a clock: there is nothing to write as C"
        )


# ---- what moves outside


def _outside(system: CompiledSystem, name: str, site: SiteJacobians, device: str | None) -> frozenset[int]:
    """Return the states that the peer's computer does not move."""
    kind, place = site.kind, Place(system.origin.topology)
    if device == NO_DEVICE:
        return frozenset()
    parts = [whole_and_index(one.name)[0].rpartition(".")[0] for one in kind.states]
    masses = {part for row, part in enumerate(parts) if _is_position(kind, site, row)}
    told = {parts[int(row)] for send in site.pattern.sends for row in np.flatnonzero(send.x.any(axis=0))}
    tied = [
        set(one.tolist())
        for one in moved_together(structural_pattern(kind.derivative.jac_sparsity(0, 0)).astype(float))
    ]
    held = _held(kind)
    if device is not None:
        chosen = {one.strip() for one in device.split(",")}
        for one in sorted(chosen - masses):
            what = f"--device: no mass of {name} is called {one[:40] or 'so'}"
            raise ApcError(
                Mistake(
                    "E961",
                    place,
                    what,
                    hint=f"--device {nearest(one, masses) or min(masses, default=NO_DEVICE)}",
                )
            )
    elif held:
        hands = tuple(f"{hand}." for hand in kind.hands)
        chosen = {parts[row] for own in tied if own & held for row in own} & masses
        chosen -= {part for part in masses if f"{part}.".startswith(hands)}
        chosen -= told if chosen - told else set()
    else:
        chosen = masses - told
    if not chosen:
        what = f"{name} has no device: others are told of every mass of it"
        mass = min(masses, default=NO_DEVICE)
        hint = f"--device {NO_DEVICE} if its computer moves them all, or --device {mass}"
        raise ApcError(Mistake("E961", place, what, hint=hint))
    if device is None and not held and len(chosen) > 1:
        listed = sorted(chosen)
        what = f"{name}: {' and '.join(listed)} may be devices, or copies that its computer moves"
        raise ApcError(
            Mistake("E961", place, what, hint=f"--device {','.join(listed)} or --device {listed[0]}")
        )
    found: set[int] = set()
    for own in tied:
        inside = {parts[row] for row in own}
        if not inside & chosen:
            continue
        if copies := sorted((inside & told) - chosen):
            moving, copied = " and ".join(sorted(inside & chosen)), " and ".join(copies)
            what = (
                f"{name}: {moving} and {copied} are tied to each other between ticks: no computer can move "
                f"{copied} where {moving} moves by itself"
            )
            hint = f"a part with a clock between them, as SampledSpringDamper, or --device {NO_DEVICE}"
            raise ApcError(Mistake("E961", place, what, hint=hint))
        found |= own
    return frozenset(found)


def _held(kind: Kind) -> frozenset[int]:
    """Return the states whose rates depend on a number of what the scene calls a hand."""
    inputs: Any = kind.derivative.sx_in() if kind.derivative.is_a("SXFunction") else kind.derivative.mx_in()
    rates_of, p = kind.derivative(*inputs), inputs[2]
    hands = tuple(f"{hand}." for hand in kind.hands)
    own = [p[place] for place, one in enumerate(kind.parameters) if hands and one.startswith(hands)]
    if not own or not rates_of.numel():
        return frozenset()
    slopes = casadi.jacobian(rates_of, casadi.vertcat(*own)) if rates_of.is_column() else rates_of
    return frozenset(slopes.sparsity().get_triplet()[0])


def _is_position(kind: Kind, site: SiteJacobians, row: int) -> bool:
    """Say whether a state is a place whose rate is another state, as of a mass."""
    return kind.states[row].unit == "m" and site.pattern.a[row].sum() == 1 and not site.pattern.b[row].any()


def _read(kind: Kind) -> frozenset[int]:
    """Return the states that anything computed at an instant looks at."""
    functions = [one.tick for one in kind.clocks] + [one.send for one in kind.sends]
    functions += [receive.edge for one in kind.clocks for receive in one.receives if receive.edge is not None]
    found: set[int] = set()
    for function in functions:
        x = function.sx_in()[0]
        if x.numel():
            everything = casadi.vertcat(*map(casadi.vec, function.call(function.sx_in())))
            found |= set(np.flatnonzero(casadi.which_depends(everything, x, 1, False)).tolist())
    return frozenset(found)


def _forces(
    system: CompiledSystem, name: str, site: SiteJacobians, vector: Any, outside: frozenset[int]
) -> tuple[Force, ...]:
    """Return what pushes the devices, as sums of what holds put out."""
    kind = site.kind
    if not outside:
        return ()
    unit_of = {one.name: one.unit for one in system.parameters}
    x, u, p, t = kind.derivative.sx_in()
    slopes = jacobian(kind.derivative(x, u, p, t), u)
    varying = casadi.vertcat(x, u, t)
    numbers = start_arguments(site, exact_numbers(kind, vector), Fraction, None)
    found = []
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
            raise ApcError(Mistake("E961", Place(system.origin.topology), what, hint=hint))
        device = find_device(site, vector, unit_of, part=state)
        if not isinstance(device, Device):
            why = device or f"{state} is no mass"
            raise ApcError(Mistake("E961", Place(system.origin.topology), f"{name}: {why}"))
        function = casadi.Function("slopes", [x, u, p, t], [casadi.densify(axis)])
        values = evaluate_exact(function, [numbers[0], numbers[1], numbers[4], numbers[5]])[0]
        terms = tuple((h, float(one / device.inverse)) for h, one in enumerate(values) if one)
        part, _, own = state.rpartition(".")
        found.append(Force(row, f"{part}.f{own.removeprefix(whole_and_index(own)[0])}", terms))
    return tuple(found)


# ---- what moves inside


def _moves(
    system: CompiledSystem,
    name: str,
    site: SiteJacobians,
    schedule: Schedule,
    outside: frozenset[int],
    lengths: Sequence[int],
    method: Method,
    vector: Any,
    numbers: Sequence[Any],
) -> tuple[Move, ...]:
    """Return what the computer's states do in every length of time."""
    kind = site.kind
    flowing = [row for row in rows_to_move(kind, method) if row not in outside]
    names = ", ".join(kind.states[row].name for row in flowing)
    if flowing and method.step is None:
        what = f"{name}: between ticks {names} move by CVODES, which is not written as C"
        raise refused(system, what, STEPS)
    if flowing and not kind.derivative.is_a("SXFunction"):
        what = f"{name}: the rates of {names} are solved for by iteration, which is not written as C"
        raise refused(system, what, "equations that can be solved for these")
    flow = flow_of(kind, method, flowing, state_scales(system, kind, site, numbers))
    linear = rates(kind, [*sorted(outside), *flowing])
    if linear.timed:
        g = linear.rate(*linear.rate.sx_in())
        pushed = ", ".join(
            kind.states[row].name
            for row in range(g.numel())
            if casadi.depends_on(g[row], linear.rate.sx_in()[1])
        )
        what = f"{name}: {pushed} is pushed by a force that changes with time between ticks"
        raise refused(system, f"{what}; its exact integral is not written as C", STEPS)
    seconds = [length * schedule.quantum for length in lengths]
    found = transition_rows(linear, vector[None], seconds)
    moves = []
    for length, duration, matrix in zip(lengths, seconds, found, strict=True):
        function = flow.over(duration) if flow is not None else None
        if function is not None and not function.is_a("SXFunction"):
            what = (
                f"{name}: {names} take too many steps of {method} from one instant to the next to be written"
            )
            raise refused(system, what, STEPS)
        moves.append(Move(length, matrix[0], tuple(flowing), function))
    return tuple(moves)


def _instants(schedule: Schedule) -> tuple[tuple[Instant, ...], tuple[int, ...]]:
    """Return the instants of a frame, and the lengths of time between them in quanta."""
    lengths = sorted({one.duration for one in schedule.events if isinstance(one, frames.Propagate)})
    ticked = dict.fromkeys(range(len(schedule.ticks)), 0)
    found: list[Instant] = []
    sends: list[int] = []
    ticks: list[int] = []
    acts: list[Act] = []
    for event in schedule.events:
        match event:
            case frames.Send(partition):
                sends.append(partition)
            case frames.Tick(partition):
                ticks.append(partition)
                ticked[partition] += 1
            case frames.Act(hold, value):
                lag = ticked[value.partition] - 1 - value.index
                acts.append(Act(hold, value.partition, value.output, lag))
            case frames.Propagate(duration):
                found.append(Instant(tuple(sends), tuple(ticks), tuple(acts), lengths.index(duration)))
                sends, ticks, acts = [], [], []
    assert not (sends or ticks or acts), "a frame ends with a length of time"
    return tuple(found), tuple(lengths)


# ---- what is heard


def lines_of(plan: Plan, number: int) -> tuple[tuple[Line, ...], tuple[tuple[tuple[int, ...], ...], ...]]:
    """Return the links of a peer, and for every receive the places of its channels on its line."""
    system, exchange, group = plan.system, plan.exchange, group_of(plan, number)
    site, schedule = plan.sites[system.groups[group].kind], plan.schedules[group]
    kind = site.kind
    live = {
        (event.partition, place)
        for event in schedule.events
        if isinstance(event, frames.Tick)
        for place, rows in enumerate(event.heard)
        if rows
    }
    own = {one.link: place for place, one in enumerate(kind.sends)}
    sent = {link: {one.channel for one in schedule.sent if one.link == link} for link in exchange.links}
    found = []
    for link in exchange.links:
        hears = {
            channel
            for p, place in live
            if kind.clocks[p].receives[place].link == link
            for channel in site.pattern.ticks[p].channels[place]
        }
        sending = [one for one in (kind, *system.kinds) if any(s.link == link for s in one.sends)]
        if not hears and not sent[link]:
            continue
        known = next(one for one in sending[0].sends if one.link == link)
        used = [i for i, name in enumerate(known.channels) if i in hears or name in sent[link]]
        channels = tuple(known.channels[i] for i in used)
        senders = [*_heard(system, exchange, link, number)] if hears else []
        if len(senders) > MOST_HEARD:
            what = (
                f"{exchange.peer_name(number)} hears {len(senders):,} peers over {link}; {MOST_HEARD:,} fit"
            )
            raise refused(system, f"{what} a text of C", "fewer peers, or a graph that is not complete")
        law = exchange.links[link].channel
        found.append(
            Line(
                link=link,
                channels=channels,
                units=tuple(known.units[i] for i in used),
                sending=own[link] if sent[link] else -1,
                senders=tuple(
                    Sender(one, exchange.peer_name(one), weight, first_packet(plan, link, one, channels))
                    for one, weight in senders
                ),
                missing=law is not None and law.on_loss == "zero" and bool(senders),
                complete=exchange.is_complete(link),
            )
        )
    line_of = {one.link: one for one in found}
    places = tuple(
        tuple(
            tuple(_places(system, kind, receive.link, line_of[receive.link], tick.channels[place]))
            if (p, place) in live
            else ()
            for place, receive in enumerate(partition.receives)
        )
        for p, (partition, tick) in enumerate(zip(kind.clocks, site.pattern.ticks, strict=True))
    )
    return tuple(found), places


def _places(
    system: CompiledSystem, kind: Kind, link: str, line: Line, channels: Sequence[int]
) -> Iterator[int]:
    """Yield where channels of a link stand on a line."""
    known = next(s for one in (kind, *system.kinds) for s in one.sends if s.link == link)
    for channel in channels:
        yield line.channels.index(known.channels[channel])


def first_packet(plan: Plan, link: str, number: int, channels: Sequence[str]) -> tuple[float, ...]:
    """Return what is heard of a peer over a link before any packet of it arrives, channel by channel."""
    group = group_of(plan, number)
    row = int(plan.numbers.rows[group][number - int(plan.exchange.starts[group])])
    site = plan.sites[plan.system.groups[group].kind]
    known = next((one for one in site.kind.sends if one.link == link), None)
    if known is None:
        return (0.0,) * len(channels)
    vector = [float(one) for one in plan.numbers.parameters[group][row]]
    x, u, _ = start_values(site, vector)
    sent = np.asarray(known.send(x, u, vector, 0.0), np.float64).ravel()
    return tuple(float(sent[known.channels.index(one)]) if one in known.channels else 0.0 for one in channels)


def _heard(system: CompiledSystem, exchange: Exchange, link: str, number: int) -> Iterator[tuple[int, float]]:
    """Yield the peers that one hears over a link, with their weights, in the scene's order."""
    sends = [any(one.link == link for one in system.kinds[group.kind].sends) for group in system.groups]
    if exchange.is_complete(link):
        listed = [(one, 1.0) for one in range(exchange.peers) if one != number]
    else:
        pairs, weights = exchange.arcs(link)
        mine = np.flatnonzero(pairs[:, 1] == number)
        listed = sorted(zip(pairs[mine, 0].tolist(), weights[mine].tolist(), strict=True))
    for one, weight in listed:
        if sends[int(np.searchsorted(exchange.starts, one, side="right")) - 1]:
            yield one, weight


def has_edge(kind: Kind, partition: int, receive: int) -> bool:
    """Say whether a receive looks at each sender by itself."""
    clock = kind.clocks[partition]
    return bool(edge_name(clock, clock.receives[receive]))
