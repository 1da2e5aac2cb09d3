"""When what happens in one frame, in what order, and what must be remembered from frame to frame.

Takes: a `Model`, its timings as exact rationals, the structural patterns of its kinds.
Gives: `build_schedules`, `newest`.
Guarantees: the state at the start of a frame is what is demanded and nothing else: a hold that acts at once
adds none, a link adds a sender's packets that are still to be heard.
Does not: look at numbers other than times.
"""

from __future__ import annotations

import functools
from collections.abc import Hashable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction

import numpy as np

from apc.compiler.compiled import Clock, Link, Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.words import no_more
from apc.frame.exchange import CommunicationGraph, build_exchange
from apc.frame.hyperperiod import ClockGrid, Times, times_in_use
from apc.frame.liveness import ReceptionPattern, hearing_of, live_holds, live_outputs, live_receives
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
    remembered,
    shifted,
)
from apc.frame.site import LinearSubsystem

# Schedules of scenes that are remembered.
KEPT = 16

# Events that repeat are looked for in rows of up to so many; they are put together as one and that is squared
# where so many times less is to be done.
MOST_REPEATED = 64
WORTH = 1.5

MOST_PACKETS = 100_000  # of one peer: each has a name
MOST_HELD = (
    1000  # values of one peer, computed and not acting yet: each is a row and a column of the frame's map
)

# What happens when: the instant, the rank of its like among what happens at once, and itself; None only stops
# the propagation there.
_Happening = tuple[int, int, Event | None]
# What each receive of a clock partition hears at each of its ticks, by (partition, tick).
_Rows = dict[tuple[int, int], tuple[tuple[ReceivedSample | UncertainSample, ...], ...]]


def build_schedules(
    system: Model,
    timings: Mapping[str, Fraction],
    patterns: Sequence[LinearSubsystem],
    *,
    order: Sequence[str] = ORDER,
    kept: Mapping[str, int] | None = None,
) -> tuple[Schedule, ...]:
    """Build the schedule of every group, over the frame they share; equal ones are one object.

    Parameters
    ----------
    system
        The compiled scene.
    timings
        Seconds by the name of the timing.
    patterns
        The structural pattern of each kind (`SubsystemJacobians.pattern`).
    order
        The order of coincident events, a permutation of `ORDER`. With "act" before "tick", a value that acts
        at once misses the switch and acts a tick later; likewise "deliver" before "send" for packets, and
        "tick" before "deliver" for a packet that arrives exactly at a tick.
    kept
        For how many frames the packets are kept of each link of which it stays open which of them is heard,
        by name: each tick selects of them, in rows of its own. None: every link is as reliable as its delay
        says.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over nobody; E805 too many ticks, packets or delayed values.
    """
    assert sorted(order) == sorted(ORDER), f"an order is a permutation of {ORDER}"
    return _schedules(
        _Timed(
            clocks=system.clocks,
            links=system.links,
            kinds=system.kinds,
            groups=tuple((group.name, group.count, group.kind) for group in system.groups),
            timings=tuple(timings.items()),
            order=tuple(order),
            kept=tuple((kept or {}).items()),
            known=tuple(map(id, patterns)),
            system=system,
            patterns=tuple(patterns),
        )
    )


@dataclass(frozen=True, slots=True)
class _Timed:
    """All that schedules follow from: scenes that differ in other numbers only are the same.

    `known` are the identities of the patterns, which are kept here.
    """

    clocks: tuple[Clock, ...]
    links: tuple[Link, ...]
    kinds: tuple[PeerType, ...]
    groups: tuple[tuple[str, int, int], ...]
    timings: tuple[tuple[str, Fraction], ...]
    order: tuple[str, ...]
    kept: tuple[tuple[str, int], ...]
    known: tuple[int, ...]
    system: Model = field(compare=False)
    patterns: tuple[LinearSubsystem, ...] = field(compare=False)


@functools.lru_cache(maxsize=KEPT)
def _schedules(of: _Timed) -> tuple[Schedule, ...]:
    """Build the schedules, see `build_schedules`."""
    system, patterns, timings, order, kept = of.system, of.patterns, dict(of.timings), of.order, dict(of.kept)
    rank = {name: place for place, name in enumerate(order)}
    exchange = build_exchange(system, timings)
    live = [live_outputs(pattern) for pattern in patterns]
    read = [live_receives(pattern, outputs) for pattern, outputs in zip(patterns, live, strict=True)]
    hearing = [hearing_of(system, patterns, exchange, group, read) for group in range(len(system.groups))]
    times = times_in_use(system, timings, patterns, live, hearing)

    _check_held(system, patterns, live, times)
    known: dict[tuple[int, ReceptionPattern], _Rows] = {}
    depth: dict[SentSample, int] = {}
    for group, own in zip(system.groups, hearing, strict=True):
        if (group.kind, own) not in known:
            heard = _heard_at_ticks(patterns[group.kind], exchange, live[group.kind], own, times, rank, kept)
            known[group.kind, own] = heard
            for item in (item for row in heard.values() for receive in row for item in receive):
                if isinstance(item, UncertainSample):
                    link = item.way.link
                    slots = times.frame // times.clocks[exchange.links[link].clock].period
                    depth |= {SentSample(link, item.channel, k): kept[link] for k in range(slots)}
                else:
                    depth[item.sent] = max(depth.get(item.sent, 0), item.lag)
    _check_depth(system, depth)
    built = {
        (kind, own): _build(patterns[kind], system, live[kind], heard, depth, times, rank)
        for (kind, own), heard in known.items()
    }
    return tuple(built[group.kind, own] for group, own in zip(system.groups, hearing, strict=True))


def _check_held(
    system: Model,
    patterns: Sequence[LinearSubsystem],
    live: Sequence[frozenset[tuple[int, int]]],
    times: Times,
) -> None:
    """Refuse delays of forces so long that all that is computed meanwhile can't be remembered."""
    for pattern, outputs in zip(patterns, live, strict=True):
        held: dict[str, int] = {}
        for hold, used in zip(pattern.kind.holds, live_holds(pattern, outputs), strict=True):
            if used:
                period = times.clocks[hold.clock].period
                held[hold.delay] = held.get(hold.delay, 0) + times.delays[hold.delay] // period
        number = sum(held.values())
        if number <= MOST_HELD:
            continue
        longest = max(held, key=lambda name: held[name])
        seconds = times.delays[longest] * times.quantum
        what = (
            f"with {longest} = {float(seconds):.6g} s each peer keeps {number:,} values that are computed "
            f"and do not act yet; at most {MOST_HELD:,} can be analysed"
        )
        left = MOST_HELD - (number - held[longest])
        most = no_more(seconds * left / held[longest], 3)
        fits = f"{longest.rpartition('.')[2]}: {most} s, or a slower clock" if left > 0 else ""
        hint = fits or "shorter delays of all forces, or a slower clock"
        raise ApcError(Diagnostic("E805", SourceLocation(system.origin.topology), what, hint=hint))


def _check_depth(system: Model, depth: Mapping[SentSample, int]) -> None:
    """Refuse delays so long that nobody can have meant them."""
    packets = sum(depth.values())
    if packets > MOST_PACKETS:
        links = ", ".join(sorted({sent.link for sent in depth}))
        what = (
            f"with these delays each peer keeps {packets:,} numbers on their way over {links}; "
            f"at most {MOST_PACKETS:,} can be named"
        )
        raise ApcError(
            Diagnostic(
                "E805",
                SourceLocation(system.origin.topology),
                what,
                hint="a shorter delay, or a slower link clock",
            )
        )


def _heard_at_ticks(
    pattern: LinearSubsystem,
    exchange: CommunicationGraph,
    live: frozenset[tuple[int, int]],
    hearing: ReceptionPattern,
    times: Times,
    rank: Mapping[str, int],
    kept: Mapping[str, int],
) -> _Rows:
    """Return, for every (partition, tick) of the frame, what each receive of the partition hears."""
    heard: _Rows = {}

    def rows(
        way: CouplingTerm, channel: str, clock: str, index: int
    ) -> tuple[ReceivedSample | UncertainSample, ...]:
        if way.link not in kept:
            instant = times.clocks[clock].at(index - way.before)
            return (newest(way, channel, exchange.links[way.link], instant, times, rank),)
        row = UncertainSample(way, channel, clock, index)
        law = exchange.links[way.link].channel
        return (row, replace(row, gap=True)) if law is not None and law.on_loss == "zero" else (row,)

    for p in sorted({partition for partition, _ in live}):
        clock = pattern.kind.clocks[p].clock
        for index in range(times.frame // times.clocks[clock].period):
            heard[p, index] = tuple(
                tuple(row for way, channel in receive for row in rows(way, channel, clock, index))
                for receive in hearing[p]
            )
    return heard


def newest(
    way: CouplingTerm, channel: str, link: Link, instant: int, times: Times, rank: Mapping[str, int]
) -> ReceivedSample:
    """Return the newest packet on a way that a tick at an instant sees.

    Parameters
    ----------
    way, channel, link
        The way, what of the link's is heard on it, and the link.
    instant
        When the tick is, in quanta.
    times
        The scene's times in quanta.
    rank
        The place of each kind of event among those that coincide.
    """
    delay, grid = times.delays[way.delay], times.clocks[link.clock]
    missed = 1 if delay == 0 and rank["deliver"] < rank["send"] else 0
    number = grid.newest(instant - delay, strictly=rank["tick"] < rank["deliver"]) - missed
    frames, slot = divmod(number, times.frame // grid.period)  # a negative number is of an earlier frame
    return ReceivedSample(way, SentSample(way.link, channel, slot), -frames)


def _build(
    pattern: LinearSubsystem,
    system: Model,
    live: frozenset[tuple[int, int]],
    heard_at: _Rows,
    depth: Mapping[SentSample, int],
    times: Times,
    rank: Mapping[str, int],
) -> Schedule:
    """Build one schedule, once it is known what the whole system hears."""
    kind = pattern.kind
    grid_of = {link.name: times.clocks.get(link.clock) for link in system.links}
    every = {item for row in heard_at.values() for receive in row for item in receive}
    heard = tuple(sorted(heard for heard in every if isinstance(heard, ReceivedSample)))
    selected = tuple(sorted(selected for selected in every if isinstance(selected, UncertainSample)))
    channels = {sending.link: sending.channels for sending in kind.sends}
    sent = tuple(sorted(sent for sent in depth if sent.channel in channels.get(sent.link, ())))
    acting, switches = _switches(pattern, live, times, rank)
    marks = _marks(times)
    events = _in_order(
        [
            *_computations(pattern, heard_at, heard + selected, times, rank["tick"]),
            *_sendings(pattern, grid_of, sent, times.frame, rank["send"]),
            *switches,
            *((mark, 0, None) for mark in marks),  # so that propagation stops there
        ]
    )
    ticks = tuple(
        times.frame // times.clocks[partition.clock].period if partition.clock in times.clocks else 0
        for partition in kind.clocks
    )
    carried = _carried(pattern, live, events, acting, ticks)
    return Schedule(
        quantum=times.quantum,
        frame=times.frame,
        events=events,
        acting=tuple(acting),
        carried=carried,
        heard=heard,
        sent=sent,
        depths=tuple(depth[item] for item in sent),
        ticks=ticks,
        marks=marks,
        value_names=tuple(_value_name(pattern, value, times) for value in carried),
        sent_names=tuple(f"{item.channel} sent" for item in sent),
        sent_times=tuple(_slot_time(item, grid_of) for item in sent),
        selected=selected,
        repeats=_repeats(pattern, live, events, carried, ticks),
    )


def _marks(times: Times) -> tuple[int, ...]:
    """Return the instants of the fastest clock's ticks, the frame's start and its end."""
    fastest = min(times.clocks.values(), key=lambda grid: grid.period)
    ticks = {fastest.at(index) for index in range(times.frame // fastest.period)}
    return tuple(sorted({0, times.frame} | ticks))


def _in_order(happenings: Sequence[_Happening]) -> tuple[Event, ...]:
    """Return the events in the order of time and of their ranks, with propagation in the gaps."""
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
    heard_at: _Rows,
    received: Sequence[ReceivedSample | UncertainSample],
    times: Times,
    rank: int,
) -> Iterator[_Happening]:
    """Yield when a site's clocks tick in a frame, and the rows of r that each receive adds up."""
    place_of = {item: index for index, item in enumerate(received)}
    for (p, index), row in heard_at.items():
        places = tuple(tuple(place_of[item] for item in receive) for receive in row)
        partition = pattern.kind.clocks[p]
        variant = partition.variants[index % len(partition.variants)] if partition.variants else None
        yield times.clocks[partition.clock].at(index), rank, Tick(p, index, places, variant)


def _sendings(
    pattern: LinearSubsystem,
    grid_of: Mapping[str, ClockGrid | None],
    sent: Sequence[SentSample],
    frame: int,
    rank: int,
) -> Iterator[_Happening]:
    """Yield when a site sends what in a frame."""
    for p, sending in enumerate(pattern.kind.sends):
        grid = grid_of[sending.link]
        for slot in range(frame // grid.period if grid else 0):
            rows = tuple(
                (sending.channels.index(item.channel), place)
                for place, item in enumerate(sent)
                if item.link == sending.link and item.slot == slot
            )
            if rows:
                assert grid is not None
                yield grid.at(slot), rank, SendEvent(p, rows)


def _switches(
    pattern: LinearSubsystem, live: frozenset[tuple[int, int]], times: Times, rank: Mapping[str, int]
) -> tuple[list[ClockedValue | None], list[_Happening]]:
    """Return what each hold holds as the frame begins, None if nobody feels it, and when it switches."""
    kind = pattern.kind
    partition_of = {partition.clock: index for index, partition in enumerate(kind.clocks)}
    acting: list[ClockedValue | None] = []
    happenings: list[_Happening] = []
    for h, (hold, used) in enumerate(zip(kind.holds, live_holds(pattern, live), strict=True)):
        if not used:
            acting.append(None)
            continue
        grid, delay, p = times.clocks[hold.clock], times.delays[hold.delay], partition_of[hold.clock]
        missed = 1 if delay == 0 and rank["act"] < rank["tick"] else 0
        first = grid.newest(-delay, strictly=True)  # switched before the frame begins
        acting.append(ClockedValue(p, hold.output, first - missed))
        for index in range(first + 1, grid.newest(times.frame - delay, strictly=True) + 1):
            switch = HoldUpdate(h, ClockedValue(p, hold.output, index - missed))
            happenings.append((grid.at(index) + delay, rank["act"], switch))
    return acting, happenings


def _slot_time(sent: SentSample, grid_of: Mapping[str, ClockGrid | None]) -> int:
    """Return when a slot is sent, in quanta from the frame's start."""
    grid = grid_of[sent.link]
    assert grid is not None
    return grid.at(sent.slot)


def _carried(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    acting: Sequence[ClockedValue | None],
    ticks: Sequence[int],
) -> tuple[ClockedValue, ...]:
    """Return the values of earlier frames that this frame reads, and those still to be read later."""
    return remembered(_demanded(pattern, live, events, acting), ticks)


def _demanded(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    acting: Sequence[ClockedValue | None],
) -> set[ClockedValue]:
    """Return the values that events read."""
    kind = pattern.kind
    now = list(acting)
    demanded: set[ClockedValue] = set()
    felt = np.flatnonzero(pattern.b.any(axis=0)).tolist()
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
                read(felt)
            case SendEvent(partition, rows):
                for channel, _ in rows:
                    read(sent[partition][channel])
            case Tick(partition, index):
                read(computed[partition])
                memories = kind.clocks[partition].memories
                demanded.update(ClockedValue(partition, memories[m], index - 1) for m in recalled[partition])
    return demanded


def _repeats(
    pattern: LinearSubsystem,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    carried: Sequence[ClockedValue],
    ticks: Sequence[int],
) -> RepeatedEvents | None:
    """Return the longest row of events that come again and again, as of a clock's ticks between packets."""
    counted = [*_counted(events, len(ticks))]
    first, length, count = _longest_run([_form(*pair) for pair in zip(events, counted, strict=False)])
    work = sum(isinstance(event, Tick | Propagate) for event in events[first : first + length])
    if (count - 1) * work < WORTH * (count.bit_length() + count.bit_count() - 1):
        return None
    begin, again, end = (counted[first + length * times] for times in (0, 1, count))
    own = tuple(after - before for before, after in zip(begin, again, strict=True))
    holds = [ClockedValue(HELD, hold, -1) for hold in range(pattern.b.shape[1])]
    once = (*own, 1)  # what a hold puts out is of the time before: its partition is the last
    body = [_moved(event, begin) for event in events[first : first + length]]
    rest = [_moved(event, end) for event in events[first + length * count :]]
    needed = {
        *_demanded(pattern, live, body, holds),
        *_demanded(pattern, live, rest, holds),
        *(_earlier(shifted(value, ticks), end) for value in carried),
    }
    switched = {event.hold for event in body if isinstance(event, HoldUpdate)}
    stays = {
        value
        for value in needed
        if (value.output not in switched if value.partition == HELD else not own[value.partition])
    }
    staying = tuple(sorted(value for value in stays if value.index < 0))
    return RepeatedEvents(first, length, count, own, remembered(needed - stays, once), staying)


def _counted(events: Sequence[Event], clocks: int) -> Iterator[tuple[int, ...]]:
    """Yield how many ticks there are before each event, by clock partition, and in all."""
    counts = [0] * clocks
    for event in events:
        yield tuple(counts)
        if isinstance(event, Tick):
            counts[event.partition] += 1
    yield tuple(counts)


def _form(event: Event, by: Sequence[int]) -> Hashable:
    """Return what is the same of events that do the same a few ticks apart; None of what never is."""
    match event:
        case Tick(partition, index, heard, variant):
            return "tick", partition, index - by[partition], heard, variant
        case HoldUpdate(hold, value):
            return "act", hold, value.partition, value.output, value.index - by[value.partition]
        case Propagate(duration):
            return duration
    return None  # what is sent is another packet each time


def _moved(event: Event, by: Sequence[int]) -> Event:
    """Return an event with its ticks counted from later ones."""
    match event:
        case Tick(partition, index):
            return replace(event, index=index - by[partition])
        case HoldUpdate(hold, value):
            return HoldUpdate(hold, _earlier(value, by))
    return event


def _earlier(value: ClockedValue, by: Sequence[int]) -> ClockedValue:
    return ClockedValue(value.partition, value.output, value.index - by[value.partition])


def _longest_run(forms: Sequence[Hashable]) -> tuple[int, int, int]:
    """Return the first place, length and number of times of what repeats most; None never does."""
    numbers: dict[Hashable, int] = {}
    codes = np.array(
        [
            -place - 1 if form is None else numbers.setdefault(form, len(numbers))
            for place, form in enumerate(forms)
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
    """Return `name(-1 ms)`: a value as it was at a time before the frame."""
    partition = pattern.kind.clocks[value.partition]
    seconds = times.clocks[partition.clock].at(value.index) * times.quantum
    return f"{partition.outputs[value.output]}({float(seconds * 1000):.6g} ms)"
