"""Construction of schedules: the events of one frame in their order, and the values stored between frames.

Takes: a `Model`, its timings as exact rationals, the structural patterns of its peer types.
Gives: `build_schedules`, `newest`.
Guarantees: the state at the start of a frame is minimal: a hold that acts immediately adds no state, a link
adds the packets of a sender that are still to be received.
Does not: use parameters other than times.
"""

from __future__ import annotations

import functools
from collections.abc import Collection, Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np

from apc.compiler.compiled import Clock, Link, Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import no_more
from apc.linearization.linear_subsystem import LinearSubsystem
from apc.timing.communication_graph import CommunicationGraph, build_comm_graph
from apc.timing.hyperperiod import Times, times_in_use
from apc.timing.liveness import ReceptionPattern, live_holds, live_outputs, live_receives, reception_of
from apc.timing.schedule import (
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
_TimedEvent = tuple[int, int, Event | None]
# The receptions of each receive of a clock partition at each tick, by (partition, tick).
_Receptions = dict[tuple[int, int], tuple[tuple[ReceivedSample | UncertainSample, ...], ...]]


def build_schedules(
    model: Model,
    timings: Mapping[str, Fraction],
    patterns: Sequence[LinearSubsystem],
    *,
    order: Sequence[str] = ORDER,
    stored: Mapping[str, int] | None = None,
) -> tuple[Schedule, ...]:
    """Return the schedule of every group over the common frame; equal schedules are one object.

    Parameters
    ----------
    model
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
        _ScheduleKey(
            clocks=model.clocks,
            links=model.links,
            peer_types=model.peer_types,
            groups=tuple((group.name, group.count, group.peer_type) for group in model.groups),
            timings=tuple(timings.items()),
            order=tuple(order),
            stored=tuple((stored or {}).items()),
            known=tuple(map(id, patterns)),
            model=model,
            patterns=tuple(patterns),
        )
    )


@dataclass(frozen=True, slots=True)
class _ScheduleKey:
    """The data that determine schedules: models that differ in other parameters only have the same key.

    `order` is the order of coincident events; `stored` is the number of frames for which an unreliable link's
    packets are stored, by link. `known` are the identities of the patterns, which this object keeps alive.
    """

    clocks: tuple[Clock, ...]
    links: tuple[Link, ...]
    peer_types: tuple[PeerType, ...]
    groups: tuple[tuple[str, int, int], ...]
    timings: tuple[tuple[str, Fraction], ...]
    order: tuple[str, ...]
    stored: tuple[tuple[str, int], ...]
    known: tuple[int, ...]
    model: Model = field(compare=False)
    patterns: tuple[LinearSubsystem, ...] = field(compare=False)


@functools.lru_cache(maxsize=CACHE_SIZE)
def _schedules(key: _ScheduleKey) -> tuple[Schedule, ...]:
    """Return the schedules of every group, cached (see `build_schedules`)."""
    model, patterns, timings, order, stored = (
        key.model,
        key.patterns,
        dict(key.timings),
        key.order,
        dict(key.stored),
    )
    rank = {name: index for index, name in enumerate(order)}
    comm_graph = build_comm_graph(model, timings)
    live = [live_outputs(pattern) for pattern in patterns]
    read = [live_receives(pattern, outputs) for pattern, outputs in zip(patterns, live, strict=True)]
    reception = [reception_of(model, patterns, comm_graph, group, read) for group in range(len(model.groups))]
    times = times_in_use(model, timings, patterns, live, reception)

    _check_holds(model, patterns, live, times)
    receptions: dict[tuple[int, ReceptionPattern], _Receptions] = {}
    depth: dict[SentSample, int] = {}
    for group, group_reception in zip(model.groups, reception, strict=True):
        if (group.peer_type, group_reception) not in receptions:
            received = _received_at_ticks(
                patterns[group.peer_type],
                comm_graph,
                live[group.peer_type],
                group_reception,
                times,
                rank,
                stored,
            )
            receptions[group.peer_type, group_reception] = received
            for item in (item for row in received.values() for receive in row for item in receive):
                if isinstance(item, UncertainSample):
                    term = item.coupling_term
                    link = comm_graph.links[term.link]
                    slots = times.frame // times.clocks[term.clock or link.clock].period
                    depth |= {term.sample(item.channel, k): stored[link.name] for k in range(slots)}
                else:
                    depth[item.sent] = max(depth.get(item.sent, 0), item.lag)
    _check_depth(model, depth)
    built = {
        (peer_type, group_reception): _build_schedule(
            patterns[peer_type], model, live[peer_type], received, depth, times, rank
        )
        for (peer_type, group_reception), received in receptions.items()
    }
    return tuple(
        built[group.peer_type, group_reception]
        for group, group_reception in zip(model.groups, reception, strict=True)
    )


def _check_holds(
    model: Model,
    patterns: Sequence[LinearSubsystem],
    live: Sequence[frozenset[tuple[int, int]]],
    times: Times,
) -> None:
    """Raise ApcError E805 for force delays so long that the values computed meanwhile exceed the limit.

    `patterns` and `live` are the structural pattern and the live outputs of each peer type.
    """
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
            f"with {longest} = {float(seconds):.6g} s each peer stores {number:,} computed values that "
            "are not "
            f"yet applied; the limit is {MOST_HELD:,}"
        )
        left = MOST_HELD - (number - held[longest])
        most = no_more(seconds * left / held[longest], 3)
        fix = f"{longest.rpartition('.')[2]}: {most} s" if left > 0 else ""
        advice = "slow down the clock" if fix else "shorten the delays of all forces, or slow down the clock"
        location = SourceLocation(model.origin.topology)
        raise ApcError(Diagnostic("E805", location, message, fix=fix, advice=advice))


def _check_depth(model: Model, depth: Mapping[SentSample, int]) -> None:
    """Raise ApcError E805 for delays so long that the packets stored for a peer exceed the limit."""
    packets = sum(depth.values())
    if packets > MOST_PACKETS:
        links = ", ".join(sorted({sent.link for sent in depth}))
        message = (
            f"with these delays each peer has {packets:,} numbers in transit over {links}; "
            f"the limit is {MOST_PACKETS:,}"
        )
        raise ApcError(
            Diagnostic(
                "E805",
                SourceLocation(model.origin.topology),
                message,
                advice="shorten the delay, or slow down the link clock",
            )
        )


def _received_at_ticks(
    pattern: LinearSubsystem,
    comm_graph: CommunicationGraph,
    live: frozenset[tuple[int, int]],
    reception: ReceptionPattern,
    times: Times,
    rank: Mapping[str, int],
    stored: Mapping[str, int],
) -> _Receptions:
    """Return, for every (partition, tick) of the frame, the receptions of each receive of the partition.

    Parameters
    ----------
    pattern, live
        The structural pattern of the peer type, and its live outputs.
    comm_graph, reception
        The communication graph, and the coupling terms of the group's receives.
    times, rank
        All times in quanta, and the rank of each event type among coincident events.
    stored
        The number of frames for which an unreliable link's packets are stored, by its name.
    """
    received: _Receptions = {}

    def rows(
        coupling_term: CouplingTerm, channel: str, clock: str, index: int
    ) -> tuple[ReceivedSample | UncertainSample, ...]:
        """Return the entries of r that a tick receives over one coupling term."""
        if coupling_term.link not in stored:
            instant = times.clocks[clock].at(index - coupling_term.before)
            return (
                newest(coupling_term, channel, comm_graph.links[coupling_term.link], instant, times, rank),
            )
        row = UncertainSample(coupling_term, channel, clock, index)
        law = comm_graph.links[coupling_term.link].channel_at(coupling_term.delay)
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
    """Return the newest packet of a coupling term that a tick at the given instant receives.

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
    delay, grid = times.delays[coupling_term.delay], times.clocks[coupling_term.clock or link.clock]
    missed = 1 if delay == 0 and rank["deliver"] < rank["send"] else 0
    strictly = rank["tick"] < rank["deliver"] or (link.after and delay == 0)
    number = grid.newest(instant - delay, strictly=strictly) - missed
    frames, slot = divmod(number, times.frame // grid.period)  # a negative number belongs to an earlier frame
    return ReceivedSample(coupling_term, coupling_term.sample(channel, slot), -frames)


def _build_schedule(
    pattern: LinearSubsystem,
    model: Model,
    live: frozenset[tuple[int, int]],
    received_at: _Receptions,
    depth: Mapping[SentSample, int],
    times: Times,
    rank: Mapping[str, int],
) -> Schedule:
    """Return the schedule of a peer type from its receptions.

    Parameters
    ----------
    pattern, model, live
        The structural pattern of the peer type, the model, and the live outputs.
    received_at
        The receptions of each receive at each tick.
    depth
        The number of frames for which each sent sample is stored.
    times, rank
        All times in quanta, and the rank of each event type among coincident events.
    """
    peer_type = pattern.peer_type
    clock_of = {link.name: link.clock for link in model.links}
    after = {link.name for link in model.links if link.after}
    receptions = {item for row in received_at.values() for receive in row for item in receive}
    received = tuple(sorted(received for received in receptions if isinstance(received, ReceivedSample)))
    selected = tuple(sorted(selected for selected in receptions if isinstance(selected, UncertainSample)))
    channels = {sending.link: sending.channels for sending in peer_type.sends}
    sent = tuple(sorted(sent for sent in depth if sent.channel in channels.get(sent.link, ())))
    active_at_start, switches = _hold_updates(pattern, live, times, rank)
    sample_times = _sample_times(times)
    events = _sorted_events(
        [
            *_tick_events(pattern, received_at, received + selected, times, rank["tick"]),
            *_send_events(pattern, clock_of, sent, times, rank["send"], after),
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
        sent_names=tuple(f"{item.channel} sent{f' at {item.clock}' * bool(item.clock)}" for item in sent),
        sent_times=tuple(times.clocks[item.clock or clock_of[item.link]].at(item.slot) for item in sent),
        selected=selected,
        repeats=_repeated_events(pattern, live, events, discrete_states, ticks),
    )


def _sample_times(times: Times) -> tuple[int, ...]:
    """Return the instants of the fastest clock's ticks, the frame's start and its end."""
    fastest = min(times.clocks.values(), key=lambda grid: grid.period)
    ticks = {fastest.at(index) for index in range(times.frame // fastest.period)}
    return tuple(sorted({0, times.frame} | ticks))


def _sorted_events(timed_events: Sequence[_TimedEvent]) -> tuple[Event, ...]:
    """Return the events sorted by time and rank, with propagation between them."""
    events: list[Event] = []
    time = 0
    for instant, _, event in sorted(timed_events, key=lambda item: item[:2]):
        if instant > time:
            events.append(Propagate(instant - time))
            time = instant
        if event is not None:
            events.append(event)
    return tuple(events)


def _tick_events(
    pattern: LinearSubsystem,
    received_at: _Receptions,
    input_rows: Sequence[ReceivedSample | UncertainSample],
    times: Times,
    rank: int,
) -> Iterator[_TimedEvent]:
    """Yield the ticks of a peer's clocks in a frame, with the rows of r that each receive adds.

    Parameters
    ----------
    pattern, received_at
        The structural pattern of the peer type, and the receptions of each receive at each tick.
    input_rows
        The received samples, in the order of the rows of r.
    times, rank
        All times in quanta, and the rank of ticks among coincident events.
    """
    index_of = {item: index for index, item in enumerate(input_rows)}
    for (p, index), row in received_at.items():
        indices = tuple(tuple(index_of[item] for item in receive) for receive in row)
        partition = pattern.peer_type.clocks[p]
        variant = partition.variants[index % len(partition.variants)] if partition.variants else None
        yield times.clocks[partition.clock].at(index), rank, Tick(p, index, indices, variant)


def _send_events(
    pattern: LinearSubsystem,
    clock_of: Mapping[str, str],
    sent: Sequence[SentSample],
    times: Times,
    rank: int,
    after: Collection[str],
) -> Iterator[_TimedEvent]:
    """Yield the send events of a peer in a frame, those without a packet to be received left out.

    Parameters
    ----------
    pattern, clock_of
        The structural pattern of the peer type, and the clock of each link.
    sent
        The samples that the peer sends and other peers receive, in the order of the rows of s.
    times, rank
        All times in quanta, and the rank of send events among coincident events.
    after
        The links whose packets take the values after all other events at an instant.
    """
    for send_index, sending in enumerate(pattern.peer_type.sends):
        rows: dict[tuple[str, int], list[tuple[int, int]]] = {}
        for index, item in enumerate(sent):
            if item.link == sending.link:
                row = sending.channels.index(item.channel), index
                rows.setdefault((item.clock or clock_of[item.link], item.slot), []).append(row)
        is_after = sending.link in after
        for clock, slot in sorted(rows):
            event = SendEvent(send_index, tuple(rows[clock, slot]), is_after)
            yield times.clocks[clock].at(slot), len(ORDER) if is_after else rank, event


def _hold_updates(
    pattern: LinearSubsystem, live: frozenset[tuple[int, int]], times: Times, rank: Mapping[str, int]
) -> tuple[list[ClockedValue | None], list[_TimedEvent]]:
    """Return the value of each hold at the start of the frame, and the updates of all holds in the frame.

    Parameters
    ----------
    pattern, live
        The structural pattern of the peer type, and its live outputs.
    times, rank
        All times in quanta, and the rank of each event type among coincident events.

    Returns
    -------
    list of ClockedValue or None
        The value of each hold at the start, None if the hold is unused.
    list of _TimedEvent
        The updates, unsorted.
    """
    peer_type = pattern.peer_type
    partition_of = {partition.clock: index for index, partition in enumerate(peer_type.clocks)}
    active_at_start: list[ClockedValue | None] = []
    timed_events: list[_TimedEvent] = []
    for hold_index, (hold, used) in enumerate(zip(peer_type.holds, live_holds(pattern, live), strict=True)):
        if not used:
            active_at_start.append(None)
            continue
        grid, delay, p = times.clocks[hold.clock], times.delays[hold.delay], partition_of[hold.clock]
        missed = 1 if delay == 0 and rank["act"] < rank["tick"] else 0
        newest_index = grid.newest(-delay, strictly=True)  # switched before the frame begins
        active_at_start.append(ClockedValue(p, hold.output, newest_index - missed))
        for index in range(newest_index + 1, grid.newest(times.frame - delay, strictly=True) + 1):
            switch = HoldUpdate(hold_index, ClockedValue(p, hold.output, index - missed))
            timed_events.append((grid.at(index) + delay, rank["act"], switch))
    return active_at_start, timed_events


def _discrete_states(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    active_at_start: Sequence[ClockedValue | None],
    ticks: Sequence[int],
) -> tuple[ClockedValue, ...]:
    """Return the values computed in earlier frames that this or a later frame reads.

    Parameters
    ----------
    pattern, live
        The structural pattern of the peer type, and its live outputs.
    events, active_at_start
        The events of a frame, and the value of each hold at its start.
    ticks
        The number of ticks of each clock partition in a frame.
    """
    return discrete_states_of(_values_read(pattern, live, events, active_at_start), ticks)


def _values_read(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    active_at_start: Sequence[ClockedValue | None],
) -> set[ClockedValue]:
    """Return the values that events read.

    Parameters
    ----------
    pattern, live
        The structural pattern of the peer type, and its live outputs.
    events
        The events of a frame, in order.
    active_at_start
        The value of each hold before the events.
    """
    peer_type = pattern.peer_type
    active = list(active_at_start)
    values_read: set[ClockedValue] = set()
    used = np.flatnonzero(pattern.b.any(axis=0)).tolist()
    sent = [[channel.nonzero()[0].tolist() for channel in send.u] for send in pattern.sends]
    computed, memories_read = [], []
    for partition, tick in enumerate(pattern.ticks):
        outputs = sorted(o for p, o in live if p == partition)
        computed.append(np.flatnonzero(tick.u[outputs].any(axis=0)).tolist())
        memories_read.append(np.flatnonzero(tick.m[outputs].any(axis=0)).tolist())

    def read(row: Iterable[int]) -> None:
        """Add the active values of some holds."""
        values_read.update(value for h in row if (value := active[h]) is not None)

    for event in events:
        match event:
            case HoldUpdate(hold, value):
                active[hold] = value
            case Propagate():
                read(used)
            case SendEvent(partition, rows):
                for channel, _ in rows:
                    read(sent[partition][channel])
            case Tick(partition, index):
                read(computed[partition])
                memories = peer_type.clocks[partition].memories
                values_read.update(
                    ClockedValue(partition, memories[m], index - 1) for m in memories_read[partition]
                )
    return values_read


def _repeated_events(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    discrete_states: Sequence[ClockedValue],
    ticks: Sequence[int],
) -> RepeatedEvents | None:
    """Return the repeated events with the most work, such as a clock's ticks between packets.

    The result is None if composing a repetition once saves too few operations.

    Parameters
    ----------
    pattern, live
        The structural pattern of the peer type, and its live outputs.
    events, discrete_states
        The events of a frame, and the values of earlier frames that they read.
    ticks
        The number of ticks of each clock partition in a frame.
    """
    counted = [*_tick_counts(events, len(ticks))]
    first, length, count = _longest_run(
        [_repetition_key(*pair) for pair in zip(events, counted, strict=False)]
    )
    work = sum(isinstance(event, Tick | Propagate) for event in events[first : first + length])
    if (count - 1) * work < WORTH * (count.bit_length() + count.bit_count() - 1):
        return None
    begin, repeated, end = (counted[first + length * times] for times in (0, 1, count))
    ticks_of_one = tuple(after - before for before, after in zip(begin, repeated, strict=True))
    holds = [ClockedValue(HELD, hold, -1) for hold in range(pattern.b.shape[1])]
    ticks_with_holds = (
        *ticks_of_one,
        1,
    )  # the output of a hold belongs to the time before: its partition is the last
    body = [_with_index_offset(event, begin) for event in events[first : first + length]]
    events_after = [_with_index_offset(event, end) for event in events[first + length * count :]]
    needed = {
        *_values_read(pattern, live, body, holds),
        *_values_read(pattern, live, events_after, holds),
        *(_value_at_offset(shifted(value, ticks), end) for value in discrete_states),
    }
    switched = {event.hold for event in body if isinstance(event, HoldUpdate)}
    unchanged = {
        value
        for value in needed
        if (value.output not in switched if value.partition == HELD else not ticks_of_one[value.partition])
    }
    staying = tuple(sorted(value for value in unchanged if value.index < 0))
    return RepeatedEvents(
        first, length, count, ticks_of_one, discrete_states_of(needed - unchanged, ticks_with_holds), staying
    )


def _tick_counts(events: Sequence[Event], clocks: int) -> Iterator[tuple[int, ...]]:
    """Yield the number of ticks before each event, by clock partition, and then the totals."""
    counts = [0] * clocks
    for event in events:
        yield tuple(counts)
        if isinstance(event, Tick):
            counts[event.partition] += 1
    yield tuple(counts)


def _repetition_key(event: Event, offset: Sequence[int]) -> Hashable:
    """Return a key that is equal for events that repeat with an offset of ticks.

    None if an event never repeats.
    """
    match event:
        case Tick(partition, index, received, variant):
            return "tick", partition, index - offset[partition], received, variant
        case HoldUpdate(hold, value):
            return "act", hold, value.partition, value.output, value.index - offset[value.partition]
        case Propagate(duration):
            return duration
    return None  # each send is another packet


def _with_index_offset(event: Event, offset: Sequence[int]) -> Event:
    """Return an event with its tick indices reduced by an offset."""
    match event:
        case Tick(partition, index):
            return replace(event, index=index - offset[partition])
        case HoldUpdate(hold, value):
            return HoldUpdate(hold, _value_at_offset(value, offset))
    return event


def _value_at_offset(value: ClockedValue, offset: Sequence[int]) -> ClockedValue:
    """Return a value's symbol with its tick index reduced by an offset."""
    return ClockedValue(value.partition, value.output, value.index - offset[value.partition])


def _longest_run(keys: Sequence[Hashable]) -> tuple[int, int, int]:
    """Return the first index, the length and the count of the longest repetition.

    A key None never repeats.
    """
    code_of: dict[Hashable, int] = {}
    codes = np.array(
        [
            -index - 1 if key is None else code_of.setdefault(key, len(code_of))
            for index, key in enumerate(keys)
        ]
    )
    longest, run = 0, (0, 1, 1)
    for length in range(1, min(len(codes) // 2, MOST_REPEATED) + 1):
        is_equal = np.concatenate([[False], codes[length:] == codes[:-length], [False]])
        edges = np.flatnonzero(is_equal[1:] != is_equal[:-1])
        for start, end in zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True):
            count = (end - start) // length + 1
            if (count - 1) * length > longest:
                longest, run = (count - 1) * length, (start, length, count)
    return run


def _value_name(pattern: LinearSubsystem, value: ClockedValue, times: Times) -> str:
    """Return `name(-1 ms)`: the text for a value at a time before the frame."""
    partition = pattern.peer_type.clocks[value.partition]
    seconds = times.clocks[partition.clock].at(value.index) * times.quantum
    return f"{partition.outputs[value.output]}({float(seconds * 1000):.6g} ms)"
