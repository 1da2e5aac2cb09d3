"""Construction of schedules: the events of one frame in their order, and the values stored between frames.

Takes: a `Model`, its timings as exact rationals, the structural patterns of its peer types.
Gives: `build_schedules`, `newest`.
Guarantees: the state at the start of a frame is minimal: a hold that acts immediately adds no state, a link
adds the packets of a sender that are still to be received.
Does not: use parameters other than times.
"""

from __future__ import annotations

import functools
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np

from apc.compiler.compiled import Clock, Link, Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import no_more
from apc.frame.communication_graph import CommunicationGraph, build_exchange
from apc.frame.hyperperiod import ClockGrid, Times, times_in_use
from apc.frame.linear_subsystem import LinearSubsystem
from apc.frame.liveness import ReceptionPattern, live_holds, live_outputs, live_receives, reception_of
from apc.frame.schedule import (
    HELD,
    ORDER,
    ClockedValue,
    CouplingTerm,
    Event,
    HoldUpdate,
    Propagate,
    ReceivedSample,
    RepeatedEvents,
    Schedule,
    SendEvent,
    SentSample,
    Tick,
    UncertainSample,
    discrete_states_of,
    shifted,
)

# Cached schedules of models.
CACHE_SIZE = 16

# Repeated events are searched in sequences of at most the first number; a sequence is composed once and
# squared if it then needs at least the second number of times fewer operations.
MOST_REPEATED = 64
WORTH = 1.5

MOST_PACKETS = 100_000  # of one peer: each has a name
MOST_HELD = (
    1000  # values of one peer, computed but not yet active: each is a row and a column of the frame map
)

# An event in time: the instant, its rank among coincident events, and the event; None only stops the
# propagation there.
_Happening = tuple[int, int, Event | None]
# The receptions of each receive of a clock partition at each tick, by (partition, tick).
_Rows = dict[tuple[int, int], tuple[tuple[ReceivedSample | UncertainSample, ...], ...]]


def build_schedules(
    system: Model,
    timings: Mapping[str, Fraction],
    patterns: Sequence[LinearSubsystem],
    *,
    order: Sequence[str] = ORDER,
    stored: Mapping[str, int] | None = None,
) -> tuple[Schedule, ...]:
    """Return the schedule of every group over the common frame; equal schedules are one object.

    Parameters
    ----------
    system
        The compiled model.
    timings
        Seconds by the name of the timing.
    patterns
        The structural pattern of each peer type (`SubsystemJacobians.pattern`).
    order
        The order of coincident events, a permutation of `ORDER`. With "act" before "tick", a value without
        delay misses the switch and acts one tick later; likewise "deliver" before "send" for packets, and
        "tick" before "deliver" for a packet that arrives exactly at a tick.
    stored
        For each unreliable link, by name, the number of frames for which its packets are stored: each tick
        selects among them, in rows of its own. None: every link is as reliable as its delay.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over no peers; E805 too many ticks, packets or delayed values.
    """
    assert sorted(order) == sorted(ORDER), f"an order is a permutation of {ORDER}"
    return _schedules(
        _Timed(
            clocks=system.clocks,
            links=system.links,
            peer_types=system.peer_types,
            groups=tuple((group.name, group.count, group.peer_type) for group in system.groups),
            timings=tuple(timings.items()),
            order=tuple(order),
            stored=tuple((stored or {}).items()),
            known=tuple(map(id, patterns)),
            system=system,
            patterns=tuple(patterns),
        )
    )


@dataclass(frozen=True, slots=True)
class _Timed:
    """The data that determines schedules: models that differ in other parameters only have the same key.

    `known` are the identities of the patterns, which this object keeps alive.
    """

    clocks: tuple[Clock, ...]
    links: tuple[Link, ...]
    peer_types: tuple[PeerType, ...]
    groups: tuple[tuple[str, int, int], ...]
    timings: tuple[tuple[str, Fraction], ...]
    order: tuple[str, ...]
    stored: tuple[tuple[str, int], ...]
    known: tuple[int, ...]
    system: Model = field(compare=False)
    patterns: tuple[LinearSubsystem, ...] = field(compare=False)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _schedules(of: _Timed) -> tuple[Schedule, ...]:
    """Return the schedules, see `build_schedules`."""
    system, patterns, timings, order, stored = (
        of.system,
        of.patterns,
        dict(of.timings),
        of.order,
        dict(of.stored),
    )
    rank = {name: index for index, name in enumerate(order)}
    exchange = build_exchange(system, timings)
    live = [live_outputs(pattern) for pattern in patterns]
    read = [live_receives(pattern, outputs) for pattern, outputs in zip(patterns, live, strict=True)]
    reception = [reception_of(system, patterns, exchange, group, read) for group in range(len(system.groups))]
    times = times_in_use(system, timings, patterns, live, reception)

    _check_holds(system, patterns, live, times)
    known: dict[tuple[int, ReceptionPattern], _Rows] = {}
    depth: dict[SentSample, int] = {}
    for group, local in zip(system.groups, reception, strict=True):
        if (group.peer_type, local) not in known:
            received = _received_at_ticks(
                patterns[group.peer_type], exchange, live[group.peer_type], local, times, rank, stored
            )
            known[group.peer_type, local] = received
            for item in (item for row in received.values() for receive in row for item in receive):
                if isinstance(item, UncertainSample):
                    link = item.coupling_term.link
                    slots = times.frame // times.clocks[exchange.links[link].clock].period
                    depth |= {SentSample(link, item.channel, k): stored[link] for k in range(slots)}
                else:
                    depth[item.sent] = max(depth.get(item.sent, 0), item.lag)
    _check_depth(system, depth)
    built = {
        (peer_type, local): _build(patterns[peer_type], system, live[peer_type], received, depth, times, rank)
        for (peer_type, local), received in known.items()
    }
    return tuple(built[group.peer_type, local] for group, local in zip(system.groups, reception, strict=True))


def _check_holds(
    system: Model,
    patterns: Sequence[LinearSubsystem],
    live: Sequence[frozenset[tuple[int, int]]],
    times: Times,
) -> None:
    """Raise an error for force delays so long that the values computed meanwhile exceed the limit."""
    for pattern, outputs in zip(patterns, live, strict=True):
        held: dict[str, int] = {}
        for hold, used in zip(pattern.peer_type.holds, live_holds(pattern, outputs), strict=True):
            if used:
                period = times.clocks[hold.clock].period
                held[hold.delay] = held.get(hold.delay, 0) + times.delays[hold.delay] // period
        number = sum(held.values())
        if number <= MOST_HELD:
            continue
        longest = max(held, key=lambda name: held[name])
        seconds = times.delays[longest] * times.quantum
        message = (
            f"with {longest} = {float(seconds):.6g} s each peer keeps {number:,} values that are computed "
            f"and do not act yet; at most {MOST_HELD:,} can be analysed"
        )
        left = MOST_HELD - (number - held[longest])
        most = no_more(seconds * left / held[longest], 3)
        fits = f"{longest.rpartition('.')[2]}: {most} s, or a slower clock" if left > 0 else ""
        hint = fits or "shorter delays of all forces, or a slower clock"
        raise ApcError(Diagnostic("E805", SourceLocation(system.origin.topology), message, hint=hint))


def _check_depth(system: Model, depth: Mapping[SentSample, int]) -> None:
    """Raise an error for delays beyond any plausible value."""
    packets = sum(depth.values())
    if packets > MOST_PACKETS:
        links = ", ".join(sorted({sent.link for sent in depth}))
        message = (
            f"with these delays each peer keeps {packets:,} numbers on their way over {links}; "
            f"at most {MOST_PACKETS:,} can be named"
        )
        raise ApcError(
            Diagnostic(
                "E805",
                SourceLocation(system.origin.topology),
                message,
                hint="a shorter delay, or a slower link clock",
            )
        )


def _received_at_ticks(
    pattern: LinearSubsystem,
    exchange: CommunicationGraph,
    live: frozenset[tuple[int, int]],
    reception: ReceptionPattern,
    times: Times,
    rank: Mapping[str, int],
    stored: Mapping[str, int],
) -> _Rows:
    """Return, for every (partition, tick) of the frame, the receptions of each receive of the partition."""
    received: _Rows = {}

    def rows(
        coupling_term: CouplingTerm, channel: str, clock: str, index: int
    ) -> tuple[ReceivedSample | UncertainSample, ...]:
        if coupling_term.link not in stored:
            instant = times.clocks[clock].at(index - coupling_term.before)
            return (newest(coupling_term, channel, exchange.links[coupling_term.link], instant, times, rank),)
        row = UncertainSample(coupling_term, channel, clock, index)
        law = exchange.links[coupling_term.link].channel
        return (row, replace(row, gap=True)) if law is not None and law.on_loss == "zero" else (row,)

    for p in sorted({partition for partition, _ in live}):
        clock = pattern.peer_type.clocks[p].clock
        for index in range(times.frame // times.clocks[clock].period):
            received[p, index] = tuple(
                tuple(
                    row
                    for coupling_term, channel in receive
                    for row in rows(coupling_term, channel, clock, index)
                )
                for receive in reception[p]
            )
    return received


def newest(
    coupling_term: CouplingTerm, channel: str, link: Link, instant: int, times: Times, rank: Mapping[str, int]
) -> ReceivedSample:
    """Return the newest packet of a coupling term that a tick at an instant receives.

    Parameters
    ----------
    coupling_term, channel, link
        The coupling term, its channel of the link, and the link.
    instant
        The instant of the tick, in quanta.
    times
        The times of the model in quanta.
    rank
        The rank of each event type among coincident events.
    """
    delay, grid = times.delays[coupling_term.delay], times.clocks[link.clock]
    missed = 1 if delay == 0 and rank["deliver"] < rank["send"] else 0
    number = grid.newest(instant - delay, strictly=rank["tick"] < rank["deliver"]) - missed
    frames, slot = divmod(number, times.frame // grid.period)  # a negative number belongs to an earlier frame
    return ReceivedSample(coupling_term, SentSample(coupling_term.link, channel, slot), -frames)


def _build(
    pattern: LinearSubsystem,
    system: Model,
    live: frozenset[tuple[int, int]],
    received_at: _Rows,
    depth: Mapping[SentSample, int],
    times: Times,
    rank: Mapping[str, int],
) -> Schedule:
    """Return one schedule from the receptions of all peers."""
    peer_type = pattern.peer_type
    grid_of = {link.name: times.clocks.get(link.clock) for link in system.links}
    every = {item for row in received_at.values() for receive in row for item in receive}
    received = tuple(sorted(received for received in every if isinstance(received, ReceivedSample)))
    selected = tuple(sorted(selected for selected in every if isinstance(selected, UncertainSample)))
    channels = {sending.link: sending.channels for sending in peer_type.sends}
    sent = tuple(sorted(sent for sent in depth if sent.channel in channels.get(sent.link, ())))
    active_at_start, switches = _switches(pattern, live, times, rank)
    sample_times = _sample_times(times)
    events = _in_order(
        [
            *_computations(pattern, received_at, received + selected, times, rank["tick"]),
            *_sendings(pattern, grid_of, sent, times.frame, rank["send"]),
            *switches,
            *((mark, 0, None) for mark in sample_times),  # so that propagation stops there
        ]
    )
    ticks = tuple(
        times.frame // times.clocks[partition.clock].period if partition.clock in times.clocks else 0
        for partition in peer_type.clocks
    )
    discrete_states = _discrete_states(pattern, live, events, active_at_start, ticks)
    return Schedule(
        quantum=times.quantum,
        frame=times.frame,
        events=events,
        active_at_start=tuple(active_at_start),
        discrete_states=discrete_states,
        received=received,
        sent=sent,
        depths=tuple(depth[item] for item in sent),
        ticks=ticks,
        sample_times=sample_times,
        value_names=tuple(_value_name(pattern, value, times) for value in discrete_states),
        sent_names=tuple(f"{item.channel} sent" for item in sent),
        sent_times=tuple(_slot_time(item, grid_of) for item in sent),
        selected=selected,
        repeats=_repeats(pattern, live, events, discrete_states, ticks),
    )


def _sample_times(times: Times) -> tuple[int, ...]:
    """Return the instants of the fastest clock's ticks, the frame's start and its end."""
    fastest = min(times.clocks.values(), key=lambda grid: grid.period)
    ticks = {fastest.at(index) for index in range(times.frame // fastest.period)}
    return tuple(sorted({0, times.frame} | ticks))


def _in_order(happenings: Sequence[_Happening]) -> tuple[Event, ...]:
    """Return the events sorted by time and rank, with propagation in the gaps."""
    events: list[Event] = []
    now = 0
    for instant, _, event in sorted(happenings, key=lambda item: item[:2]):
        if instant > now:
            events.append(Propagate(instant - now))
            now = instant
        if event is not None:
            events.append(event)
    return tuple(events)


def _computations(
    pattern: LinearSubsystem,
    received_at: _Rows,
    input_rows: Sequence[ReceivedSample | UncertainSample],
    times: Times,
    rank: int,
) -> Iterator[_Happening]:
    """Yield the ticks of a peer's clocks in a frame, with the rows of r that each receive adds."""
    index_of = {item: index for index, item in enumerate(input_rows)}
    for (p, index), row in received_at.items():
        indices = tuple(tuple(index_of[item] for item in receive) for receive in row)
        partition = pattern.peer_type.clocks[p]
        variant = partition.variants[index % len(partition.variants)] if partition.variants else None
        yield times.clocks[partition.clock].at(index), rank, Tick(p, index, indices, variant)


def _sendings(
    pattern: LinearSubsystem,
    grid_of: Mapping[str, ClockGrid | None],
    sent: Sequence[SentSample],
    frame: int,
    rank: int,
) -> Iterator[_Happening]:
    """Yield the send events of a peer in a frame."""
    for p, sending in enumerate(pattern.peer_type.sends):
        grid = grid_of[sending.link]
        for slot in range(frame // grid.period if grid else 0):
            rows = tuple(
                (sending.channels.index(item.channel), index)
                for index, item in enumerate(sent)
                if item.link == sending.link and item.slot == slot
            )
            if rows:
                assert grid is not None
                yield grid.at(slot), rank, SendEvent(p, rows)


def _switches(
    pattern: LinearSubsystem, live: frozenset[tuple[int, int]], times: Times, rank: Mapping[str, int]
) -> tuple[list[ClockedValue | None], list[_Happening]]:
    """Return each hold's value as the frame begins, None if the hold is unused, and its switch events."""
    peer_type = pattern.peer_type
    partition_of = {partition.clock: index for index, partition in enumerate(peer_type.clocks)}
    active_at_start: list[ClockedValue | None] = []
    happenings: list[_Happening] = []
    for h, (hold, used) in enumerate(zip(peer_type.holds, live_holds(pattern, live), strict=True)):
        if not used:
            active_at_start.append(None)
            continue
        grid, delay, p = times.clocks[hold.clock], times.delays[hold.delay], partition_of[hold.clock]
        missed = 1 if delay == 0 and rank["act"] < rank["tick"] else 0
        first = grid.newest(-delay, strictly=True)  # switched before the frame begins
        active_at_start.append(ClockedValue(p, hold.output, first - missed))
        for index in range(first + 1, grid.newest(times.frame - delay, strictly=True) + 1):
            switch = HoldUpdate(h, ClockedValue(p, hold.output, index - missed))
            happenings.append((grid.at(index) + delay, rank["act"], switch))
    return active_at_start, happenings


def _slot_time(sent: SentSample, grid_of: Mapping[str, ClockGrid | None]) -> int:
    """Return the instant at which a slot is sent, in quanta from the frame's start."""
    grid = grid_of[sent.link]
    assert grid is not None
    return grid.at(sent.slot)


def _discrete_states(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    active_at_start: Sequence[ClockedValue | None],
    ticks: Sequence[int],
) -> tuple[ClockedValue, ...]:
    """Return the values of earlier frames that this frame reads, and those to be read later."""
    return discrete_states_of(_demanded(pattern, live, events, active_at_start), ticks)


def _demanded(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    active_at_start: Sequence[ClockedValue | None],
) -> set[ClockedValue]:
    """Return the values that events read."""
    peer_type = pattern.peer_type
    now = list(active_at_start)
    demanded: set[ClockedValue] = set()
    used = np.flatnonzero(pattern.b.any(axis=0)).tolist()
    sent = [[channel.nonzero()[0].tolist() for channel in send.u] for send in pattern.sends]
    computed, recalled = [], []
    for partition, tick in enumerate(pattern.ticks):
        outputs = sorted(o for p, o in live if p == partition)
        computed.append(np.flatnonzero(tick.u[outputs].any(axis=0)).tolist())
        recalled.append(np.flatnonzero(tick.m[outputs].any(axis=0)).tolist())

    def read(row: Iterable[int]) -> None:
        demanded.update(value for h in row if (value := now[h]) is not None)

    for event in events:
        match event:
            case HoldUpdate(hold, value):
                now[hold] = value
            case Propagate():
                read(used)
            case SendEvent(partition, rows):
                for channel, _ in rows:
                    read(sent[partition][channel])
            case Tick(partition, index):
                read(computed[partition])
                memories = peer_type.clocks[partition].memories
                demanded.update(ClockedValue(partition, memories[m], index - 1) for m in recalled[partition])
    return demanded


def _repeats(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    discrete_states: Sequence[ClockedValue],
    ticks: Sequence[int],
) -> RepeatedEvents | None:
    """Return the longest sequence of repeated events, such as a clock's ticks between packets."""
    counted = [*_counted(events, len(ticks))]
    first, length, count = _longest_run([_form(*pair) for pair in zip(events, counted, strict=False)])
    work = sum(isinstance(event, Tick | Propagate) for event in events[first : first + length])
    if (count - 1) * work < WORTH * (count.bit_length() + count.bit_count() - 1):
        return None
    begin, repeated, end = (counted[first + length * times] for times in (0, 1, count))
    local = tuple(after - before for before, after in zip(begin, repeated, strict=True))
    holds = [ClockedValue(HELD, hold, -1) for hold in range(pattern.b.shape[1])]
    once = (*local, 1)  # the output of a hold belongs to the time before: its partition is the last
    body = [_moved(event, begin) for event in events[first : first + length]]
    rest = [_moved(event, end) for event in events[first + length * count :]]
    needed = {
        *_demanded(pattern, live, body, holds),
        *_demanded(pattern, live, rest, holds),
        *(_earlier(shifted(value, ticks), end) for value in discrete_states),
    }
    switched = {event.hold for event in body if isinstance(event, HoldUpdate)}
    stays = {
        value
        for value in needed
        if (value.output not in switched if value.partition == HELD else not local[value.partition])
    }
    staying = tuple(sorted(value for value in stays if value.index < 0))
    return RepeatedEvents(first, length, count, local, discrete_states_of(needed - stays, once), staying)


def _counted(events: Sequence[Event], clocks: int) -> Iterator[tuple[int, ...]]:
    """Yield the number of ticks before each event, by clock partition, and the total."""
    counts = [0] * clocks
    for event in events:
        yield tuple(counts)
        if isinstance(event, Tick):
            counts[event.partition] += 1
    yield tuple(counts)


def _form(event: Event, by: Sequence[int]) -> Hashable:
    """Return a key that is equal for events that repeat a few ticks apart; None if an event never repeats."""
    match event:
        case Tick(partition, index, received, variant):
            return "tick", partition, index - by[partition], received, variant
        case HoldUpdate(hold, value):
            return "act", hold, value.partition, value.output, value.index - by[value.partition]
        case Propagate(duration):
            return duration
    return None  # each send is another packet


def _moved(event: Event, by: Sequence[int]) -> Event:
    """Return an event with its tick indices reduced by an offset."""
    match event:
        case Tick(partition, index):
            return replace(event, index=index - by[partition])
        case HoldUpdate(hold, value):
            return HoldUpdate(hold, _earlier(value, by))
    return event


def _earlier(value: ClockedValue, by: Sequence[int]) -> ClockedValue:
    return ClockedValue(value.partition, value.output, value.index - by[value.partition])


def _longest_run(forms: Sequence[Hashable]) -> tuple[int, int, int]:
    """Return the first index, the length and the count of the best repetition; None never repeats."""
    numbers: dict[Hashable, int] = {}
    codes = np.array(
        [
            -index - 1 if form is None else numbers.setdefault(form, len(numbers))
            for index, form in enumerate(forms)
        ]
    )
    best, result = 0, (0, 1, 1)
    for length in range(1, min(len(codes) // 2, MOST_REPEATED) + 1):
        same = np.concatenate([[False], codes[length:] == codes[:-length], [False]])
        edges = np.flatnonzero(same[1:] != same[:-1])
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            count = (end - start) // length + 1
            if (count - 1) * length > best:
                best, result = (count - 1) * length, (start, length, count)
    return result


def _value_name(pattern: LinearSubsystem, value: ClockedValue, times: Times) -> str:
    """Return `name(-1 ms)`: the text for a value at a time before the frame."""
    partition = pattern.peer_type.clocks[value.partition]
    seconds = times.clocks[partition.clock].at(value.index) * times.quantum
    return f"{partition.outputs[value.output]}({float(seconds * 1000):.6g} ms)"
