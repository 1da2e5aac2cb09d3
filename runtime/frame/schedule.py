"""What happens in one frame, in what order, and what must be remembered from frame to frame.

Takes: a `CompiledSystem`, its timings as exact rationals, the structural patterns of its kinds.
Gives: `Schedule` and its events, `build_schedules`, `ORDER`; `common_divisor`.
Guarantees: exact time (integers of one quantum); the state at the start of a frame is what is demanded
and nothing else: a hold that acts at once adds none, a link adds a sender's packets that are still to be
heard. Does not: look at numbers other than times.

Every value a clock computes is one symbol, `Value(partition, output, index)`: what output `output` was at the
tick `index`, counted from the frame's first tick of that clock; a negative index is an earlier frame.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from apc.compiler.compiled import Clock, CompiledSystem, Link
from apc.compiler.errors import ApcError, Mistake, Place
from apc.runtime.frame.exchange import Exchange, build_exchange, check_mean
from apc.runtime.frame.linearize import LinearSite, edge_name

# The order of coincident events. Continuous variables are continuous, so sampling needs no place in it.
ORDER = ("send", "deliver", "tick", "act")

MOST_TICKS = 20_000  # in a frame: each is a step of the lifting
MOST_PACKETS = 100_000  # of one peer: each has a name


@dataclass(frozen=True, slots=True, order=True)
class Value:
    """Output `output` of clock partition `partition` as computed at tick `index` of the frame."""

    partition: int
    output: int
    index: int


@dataclass(frozen=True, slots=True, order=True)
class Sent:
    """A channel of a link as sent at the link clock's tick `slot` of a frame."""

    link: str
    channel: str
    slot: int


@dataclass(frozen=True, slots=True, order=True)
class Way:
    """A way from peer to peer, one weight for each pair of peers: `operator` over a link, delayed `delay`.

    Only those pairs of peers are on it whose delay is the timing `delay`. A receive that weighs every sender
    apart, by the slope of its edge function, has a way of its own for each channel: `edge` and `channel` name
    it, and are empty for a plain sum or mean.
    """

    operator: str
    link: str
    delay: str
    edge: str = ""
    channel: str = ""


@dataclass(frozen=True, slots=True, order=True)
class Heard:
    """What a site hears on `way`: the other peers' `sent`, of `lag` frames ago (0: this frame).

    On a way that loses or delays packets, each tick has a row of its own: tick `tick` of `clock` hears
    whichever packets of the channel it does, and `sent` and `lag` say nothing more. With `gap` the row is not
    what it hears but the weight of what it misses.
    """

    way: Way
    sent: Sent
    lag: int
    clock: str = ""
    tick: int = -1
    gap: bool = False


@dataclass(frozen=True, slots=True)
class Kept:
    """An unreliable link: its packets are kept for `frames` frames; with `gaps`, what is missing counts."""

    frames: int
    gaps: bool


@dataclass(frozen=True, slots=True)
class Propagate:
    """Nothing happens for `duration` quanta."""

    duration: int


@dataclass(frozen=True, slots=True)
class Send:
    """The site's send partition `partition` sends; `rows` are (channel, row of s) pairs."""

    partition: int
    rows: tuple[tuple[int, int], ...]


@dataclass(frozen=True, slots=True)
class Tick:
    """Clock partition `partition` computes, tick `index`; `heard` are each receive's rows of r, to add."""

    partition: int
    index: int
    heard: tuple[tuple[int, ...], ...]


@dataclass(frozen=True, slots=True)
class Act:
    """Hold `hold` switches to `value`."""

    hold: int
    value: Value


Event = Propagate | Send | Tick | Act

# What happens when: the instant, the rank of its like among what happens at once, and itself; None only stops
# the propagation there.
_Happening = tuple[int, int, Event | None]


@dataclass(frozen=True, slots=True)
class Schedule:
    """One frame of the peers of one group.

    `acting` is what each hold puts out as the frame begins (None for a hold nobody reads); `carried` are the
    values of earlier frames that this one needs, the remembered part of z after the continuous states;
    `heard` names r; `sent` names s and `depths` says how many frames each row of s must be kept; `ticks`
    counts a clock partition's ticks in a frame; `marks` are the instants, in quanta, of the fastest clock's
    ticks and the end.
    """

    quantum: Fraction
    frame: int
    events: tuple[Event, ...]
    acting: tuple[Value | None, ...]
    carried: tuple[Value, ...]
    heard: tuple[Heard, ...]
    sent: tuple[Sent, ...]
    depths: tuple[int, ...]
    ticks: tuple[int, ...]
    marks: tuple[int, ...]
    value_names: tuple[str, ...]
    sent_names: tuple[str, ...]
    sent_times: tuple[int, ...]  # in quanta from the frame's start

    @property
    def frame_s(self) -> Fraction:
        """The length of the frame in seconds."""
        return self.frame * self.quantum

    def ways(self, partition: int, receive: int) -> tuple[tuple[Way, str], ...]:
        """Return the ways and channels a receive of a clock partition hears, whatever the tick."""
        ticks = [one for one in self.events if isinstance(one, Tick) and one.partition == partition]
        heard = [self.heard[row] for tick in ticks for row in tick.heard[receive]]
        return tuple(dict.fromkeys((one.way, one.sent.channel) for one in heard))


@dataclass(frozen=True, slots=True)
class _Grid:
    """A clock in quanta: ticks at phase + k*period for every integer k, 0 <= phase < period."""

    phase: int
    period: int

    def at(self, index: int) -> int:
        return self.phase + index * self.period

    def newest(self, limit: int, *, strictly: bool = False) -> int:
        """Return the index of the last tick at or (strictly) before `limit`."""
        index = (limit - self.phase) // self.period
        return index - 1 if strictly and self.at(index) == limit else index


@dataclass(frozen=True, slots=True)
class _Times:
    """Every time of the system in quanta."""

    quantum: Fraction
    frame: int
    clocks: Mapping[str, _Grid]
    delays: Mapping[str, int]


def build_schedules(
    system: CompiledSystem,
    timings: Mapping[str, Fraction],
    patterns: Sequence[LinearSite],
    *,
    order: Sequence[str] = ORDER,
    kept: Mapping[str, Kept] | None = None,
) -> tuple[Schedule, ...]:
    """Build the schedule of every group, over the frame they share; equal ones are one object.

    Parameters
    ----------
    system
        The compiled scene.
    timings
        Seconds by the name of the timing.
    patterns
        The structural pattern of each kind (`SiteJacobians.pattern`).
    order
        The order of coincident events, a permutation of `ORDER`. With "act" before "tick", a value that acts
        at once misses the switch and acts a tick later; likewise "deliver" before "send" for packets, and
        "tick" before "deliver" for a packet that arrives exactly at a tick.
    kept
        The links whose packets get lost or come late, by name: all that is sent over them is kept, and each
        tick hears it in rows of its own. None: every link is as reliable as its delay says.

    Raises
    ------
    ApcError
        E801 a mean, maximum or minimum over nobody; E805 too many ticks or packets in a frame.
    """
    assert sorted(order) == sorted(ORDER), f"an order is a permutation of {ORDER}"
    rank = {name: place for place, name in enumerate(order)}
    kept = kept or {}
    exchange = build_exchange(system, timings)
    live = [_live_outputs(pattern) for pattern in patterns]
    read = [_live_receives(pattern, outputs) for pattern, outputs in zip(patterns, live, strict=True)]
    ears = [_ears(system, patterns, exchange, group, read) for group in range(len(system.groups))]
    times = _times(system, timings, patterns, live, ears)

    known: dict[tuple[int, _Ears], dict[tuple[int, int], tuple[tuple[Heard, ...], ...]]] = {}
    depth: dict[Sent, int] = {}
    for group, own in zip(system.groups, ears, strict=True):
        if (group.kind, own) not in known:
            heard = _heard_at_ticks(patterns[group.kind], exchange, live[group.kind], own, times, rank, kept)
            known[group.kind, own] = heard
            for one in (one for row in heard.values() for receive in row for one in receive):
                link = one.sent.link
                if link in kept:
                    slots = times.frame // times.clocks[exchange.links[link].clock].period
                    depth |= {Sent(link, one.sent.channel, k): kept[link].frames for k in range(slots)}
                else:
                    depth[one.sent] = max(depth.get(one.sent, 0), one.lag)
    _check_depth(system, depth)
    built = {
        (kind, own): _build(patterns[kind], system, live[kind], heard, depth, times, rank)
        for (kind, own), heard in known.items()
    }
    return tuple(built[group.kind, own] for group, own in zip(system.groups, ears, strict=True))


# For each clock partition and receive: the ways it hears, and the channel of the link on each.
_Ears = tuple[tuple[tuple[tuple[Way, str], ...], ...], ...]


def _ears(
    system: CompiledSystem,
    patterns: Sequence[LinearSite],
    exchange: Exchange,
    group: int,
    read: Sequence[frozenset[tuple[int, int]]],
) -> _Ears:
    """Return what the receives of a group hear."""
    pattern = patterns[system.groups[group].kind]
    everybody: list[tuple[tuple[tuple[Way, str], ...], ...]] = []
    for p, (partition, tick) in enumerate(zip(pattern.kind.clocks, pattern.ticks, strict=True)):
        own: list[tuple[tuple[Way, str], ...]] = []
        for place, (receive, channels) in enumerate(zip(partition.receives, tick.channels, strict=True)):
            if (p, place) not in read[system.groups[group].kind] or not channels:
                own.append(())
                continue
            names = _channels(system, group, receive.link)
            sending = [
                any(send.link == receive.link for send in system.kinds[one.kind].sends)
                for one in system.groups
            ]
            senders = exchange.hears(receive.link, group, sending)
            if not senders and receive.operator != "sum":
                peer = int(exchange.starts[group])
                check_mean(exchange, peer, receive.link, receive.operator, False, Fraction(0))
            delays = dict.fromkeys(exchange.delay(receive.link, sender, group) for sender in senders)
            edge = edge_name(partition, receive)
            own.append(
                tuple(
                    (
                        Way(receive.operator, receive.link, delay, edge, names[c] if edge else ""),
                        names[c],
                    )
                    for delay in delays
                    for c in channels
                )
            )
        everybody.append(tuple(own))
    return tuple(everybody)


def _channels(system: CompiledSystem, group: int, link: str) -> tuple[str, ...]:
    """Return the names of a link's channels, as the group's own kind sends them, or else some other kind."""
    own = system.groups[group].kind
    kinds = [system.kinds[own], *system.kinds]
    return next(send.channels for kind in kinds for send in kind.sends if send.link == link)


def _live_outputs(pattern: LinearSite) -> frozenset[tuple[int, int]]:
    """Return the (partition, output) pairs that can reach the motion or the network."""
    kind = pattern.kind
    clocks = {partition.clock: index for index, partition in enumerate(kind.clocks)}
    live: set[tuple[int, int]] = set()
    holds = {h for h in range(len(kind.holds)) if pattern.b[:, h].any()}
    holds |= {h for send in pattern.sends for h in range(len(kind.holds)) if send.u[:, h].any()}
    size = -1
    while size != len(live) + len(holds):
        size = len(live) + len(holds)
        live |= {(clocks[kind.holds[h].clock], kind.holds[h].output) for h in holds}
        for partition, output in tuple(live):
            tick = pattern.ticks[partition]
            memories = kind.clocks[partition].memories
            live |= {(partition, memories[m]) for m in tick.m[output].nonzero()[0]}
            holds |= set(tick.u[output].nonzero()[0].tolist())
    return frozenset(live)


def _live_holds(pattern: LinearSite, live: frozenset[tuple[int, int]]) -> tuple[bool, ...]:
    """Say of each hold whether anybody reads it."""
    return tuple(
        bool(
            pattern.b[:, h].any()
            or any(send.u[:, h].any() for send in pattern.sends)
            or any(pattern.ticks[partition].u[output, h] for partition, output in live)
        )
        for h in range(len(pattern.kind.holds))
    )


def _live_receives(pattern: LinearSite, live: frozenset[tuple[int, int]]) -> frozenset[tuple[int, int]]:
    """Return the (partition, receive) pairs that a live output reads."""
    return frozenset(
        (partition, int(row))
        for partition, output in live
        for row in pattern.ticks[partition].r[output].nonzero()[0]
    )


def _times(
    system: CompiledSystem,
    timings: Mapping[str, Fraction],
    patterns: Sequence[LinearSite],
    live: Sequence[frozenset[tuple[int, int]]],
    ears: Sequence[_Ears],
) -> _Times:
    """Find the quantum of which every period, phase and delay in use is a multiple, and the frame."""
    clock_of = {clock.name: clock for clock in system.clocks}
    link_of = {link.name: link for link in system.links}
    clocks: dict[str, Clock] = {}
    delays: dict[str, Fraction] = {}
    for pattern, outputs in zip(patterns, live, strict=True):
        for partition, _ in outputs:
            name = pattern.kind.clocks[partition].clock
            clocks[name] = clock_of[name]
        for hold, used in zip(pattern.kind.holds, _live_holds(pattern, outputs), strict=True):
            if used:
                delays[hold.delay] = timings[hold.delay]
    for way, _ in (pair for own in ears for partition in own for receive in partition for pair in receive):
        clock = link_of[way.link].clock
        clocks[clock] = clock_of[clock]
        delays[way.delay] = timings[way.delay]
    if not clocks:  # nothing is sampled: any frame will do
        clocks = dict(clock_of) or {"": Clock("", "", "")}
    period = {name: timings[clock.period] if name else Fraction(1) for name, clock in clocks.items()}
    phase = {
        name: timings[clock.phase] % period[name] if name else Fraction(0) for name, clock in clocks.items()
    }
    quantum = common_divisor([*period.values(), *phase.values(), *delays.values()])
    count = {name: int(value / quantum) for name, value in period.items()}
    frame = math.lcm(*count.values())
    _check_frame_length(system, period, count, frame, quantum)
    return _Times(
        quantum=quantum,
        frame=frame,
        clocks={name: _Grid(int(phase[name] / quantum), count[name]) for name in clocks},
        delays={name: int(value / quantum) for name, value in delays.items()},
    )


def _check_frame_length(
    system: CompiledSystem,
    period: Mapping[str, Fraction],
    count: Mapping[str, int],
    frame: int,
    quantum: Fraction,
) -> None:
    """Refuse clocks that stand as before only after too many ticks to step through."""
    ticks = sum(frame // number for number in count.values())
    if ticks > MOST_TICKS:
        clocks = ", ".join(f"{name} {float(value) * 1e3:.9g} ms" for name, value in period.items() if name)
        what = (
            f"all clocks stand as before only after {float(frame * quantum):.6g} s and {ticks} ticks "
            f"({clocks}); at most {MOST_TICKS} can be analysed"
        )
        hint = "periods that are simple multiples of one another"
        raise ApcError(Mistake("E805", Place(system.name), what, hint=hint))


def _check_depth(system: CompiledSystem, depth: Mapping[Sent, int]) -> None:
    """Refuse delays so long that nobody can have meant them."""
    packets = sum(depth.values())
    if packets > MOST_PACKETS:
        links = ", ".join(sorted({sent.link for sent in depth}))
        what = (
            f"with these delays each peer keeps {packets:,} numbers on their way over {links}; "
            f"at most {MOST_PACKETS:,} can be named"
        )
        raise ApcError(
            Mistake("E805", Place(system.name), what, hint="a shorter delay, or a slower link clock")
        )


def common_divisor(times: Iterable[Fraction]) -> Fraction:
    """Return the largest rational of which every time is a whole multiple."""
    listed = list(times)
    denominator = math.lcm(*(time.denominator for time in listed))
    return Fraction(math.gcd(*(int(time * denominator) for time in listed)), denominator)


def _heard_at_ticks(
    pattern: LinearSite,
    exchange: Exchange,
    live: frozenset[tuple[int, int]],
    ears: _Ears,
    times: _Times,
    rank: Mapping[str, int],
    kept: Mapping[str, Kept],
) -> dict[tuple[int, int], tuple[tuple[Heard, ...], ...]]:
    """Return, for every (partition, tick) of the frame, what each receive of the partition hears."""
    heard: dict[tuple[int, int], tuple[tuple[Heard, ...], ...]] = {}

    def rows(way: Way, channel: str, clock: str, index: int) -> tuple[Heard, ...]:
        if way.link not in kept:
            instant = times.clocks[clock].at(index)
            return (_newest(way, channel, exchange.links[way.link], instant, times, rank),)
        row = Heard(way, Sent(way.link, channel, 0), 0, clock, index)
        return (row, replace(row, gap=True)) if kept[way.link].gaps else (row,)

    for p in sorted({partition for partition, _ in live}):
        clock = pattern.kind.clocks[p].clock
        for index in range(times.frame // times.clocks[clock].period):
            heard[p, index] = tuple(
                tuple(row for way, channel in receive for row in rows(way, channel, clock, index))
                for receive in ears[p]
            )
    return heard


def _newest(
    way: Way, channel: str, link: Link, instant: int, times: _Times, rank: Mapping[str, int]
) -> Heard:
    """Return the newest packet on a way that a tick at `instant` sees."""
    delay, grid = times.delays[way.delay], times.clocks[link.clock]
    missed = 1 if delay == 0 and rank["deliver"] < rank["send"] else 0
    number = grid.newest(instant - delay, strictly=rank["tick"] < rank["deliver"]) - missed
    frames, slot = divmod(number, times.frame // grid.period)  # a negative number is of an earlier frame
    return Heard(way, Sent(way.link, channel, slot), -frames)


def _build(
    pattern: LinearSite,
    system: CompiledSystem,
    live: frozenset[tuple[int, int]],
    heard_at: Mapping[tuple[int, int], tuple[tuple[Heard, ...], ...]],
    depth: Mapping[Sent, int],
    times: _Times,
    rank: Mapping[str, int],
) -> Schedule:
    """Build one schedule, once it is known what the whole system hears."""
    kind, frame = pattern.kind, times.frame
    grid_of = {link.name: times.clocks.get(link.clock) for link in system.links}
    heard = tuple(sorted({one for row in heard_at.values() for receive in row for one in receive}))
    place_of = {one: index for index, one in enumerate(heard)}
    channels = {sending.link: sending.channels for sending in kind.sends}
    sent = tuple(sorted(one for one in depth if one.channel in channels.get(one.link, ())))

    # Everything that happens; propagation fills the gaps.
    happenings: list[_Happening] = []
    for (p, index), row in heard_at.items():
        places = tuple(tuple(place_of[one] for one in receive) for receive in row)
        instant = times.clocks[kind.clocks[p].clock].at(index)
        happenings.append((instant, rank["tick"], Tick(p, index, places)))
    happenings += _sendings(pattern, grid_of, sent, frame, rank["send"])
    acting, switches = _switches(pattern, live, times, rank)
    happenings += switches
    fastest = min(times.clocks.values(), key=lambda grid: grid.period)
    marks = sorted({0, frame} | {fastest.at(i) for i in range(frame // fastest.period)})
    happenings += [(mark, 0, None) for mark in marks]  # so that propagation stops there
    happenings.sort(key=lambda item: item[:2])

    events: list[Event] = []
    now = 0
    for instant, _, event in happenings:
        if instant > now:
            events.append(Propagate(instant - now))
            now = instant
        if event is not None:
            events.append(event)

    ticks = tuple(
        frame // times.clocks[partition.clock].period if partition.clock in times.clocks else 0
        for partition in kind.clocks
    )
    carried = _carried(pattern, live, events, acting, ticks)
    grids = [times.clocks.get(partition.clock) for partition in kind.clocks]
    return Schedule(
        quantum=times.quantum,
        frame=frame,
        events=tuple(events),
        acting=tuple(acting),
        carried=carried,
        heard=heard,
        sent=sent,
        depths=tuple(depth[one] for one in sent),
        ticks=ticks,
        marks=tuple(marks),
        value_names=tuple(
            _at_time(
                kind.clocks[value.partition].outputs[value.output],
                grids[value.partition].at(value.index) * times.quantum,  # type: ignore[union-attr] # it ticks
            )
            for value in carried
        ),
        sent_names=tuple(f"{one.channel} sent" for one in sent),
        sent_times=tuple(_slot_time(one, grid_of) for one in sent),
    )


def _sendings(
    pattern: LinearSite, grid_of: Mapping[str, _Grid | None], sent: Sequence[Sent], frame: int, rank: int
) -> Iterator[_Happening]:
    """Yield when a site sends what in a frame."""
    for p, sending in enumerate(pattern.kind.sends):
        grid = grid_of[sending.link]
        for slot in range(frame // grid.period if grid else 0):
            rows = tuple(
                (sending.channels.index(one.channel), place)
                for place, one in enumerate(sent)
                if one.link == sending.link and one.slot == slot
            )
            if rows:
                assert grid is not None
                yield grid.at(slot), rank, Send(p, rows)


def _switches(
    pattern: LinearSite, live: frozenset[tuple[int, int]], times: _Times, rank: Mapping[str, int]
) -> tuple[list[Value | None], list[_Happening]]:
    """Return what each hold holds as the frame begins, None if nobody feels it, and when it switches."""
    kind = pattern.kind
    partition_of = {partition.clock: index for index, partition in enumerate(kind.clocks)}
    acting: list[Value | None] = []
    happenings: list[_Happening] = []
    for h, (hold, used) in enumerate(zip(kind.holds, _live_holds(pattern, live), strict=True)):
        if not used:
            acting.append(None)
            continue
        grid, delay, p = times.clocks[hold.clock], times.delays[hold.delay], partition_of[hold.clock]
        missed = 1 if delay == 0 and rank["act"] < rank["tick"] else 0
        first = grid.newest(-delay, strictly=True)  # switched before the frame begins
        acting.append(Value(p, hold.output, first - missed))
        for index in range(first + 1, grid.newest(times.frame - delay, strictly=True) + 1):
            switch = Act(h, Value(p, hold.output, index - missed))
            happenings.append((grid.at(index) + delay, rank["act"], switch))
    return acting, happenings


def _slot_time(sent: Sent, grid_of: Mapping[str, _Grid | None]) -> int:
    """Return when a slot is sent, in quanta from the frame's start."""
    grid = grid_of[sent.link]
    assert grid is not None
    return grid.at(sent.slot)


def _carried(
    pattern: LinearSite,
    live: frozenset[tuple[int, int]],
    events: Sequence[Event],
    acting: Sequence[Value | None],
    ticks: Sequence[int],
) -> tuple[Value, ...]:
    """Return the values of earlier frames that this frame reads, and those still to be read later.

    A value read at index -j is, one frame on, the value of index n - j; if that is negative too, it is
    carried as well.
    """
    kind = pattern.kind
    now = list(acting)
    demanded: set[Value] = set()

    def read(row: Iterable[int]) -> None:
        demanded.update(value for h in row if (value := now[h]) is not None)

    for event in events:
        match event:
            case Act(hold, value):
                now[hold] = value
            case Propagate():
                read(np.flatnonzero(pattern.b.any(axis=0)).tolist())
            case Send(partition, rows):
                for channel, _ in rows:
                    read(pattern.sends[partition].u[channel].nonzero()[0].tolist())
            case Tick(partition, index, _):
                for output in (o for p, o in live if p == partition):
                    read(pattern.ticks[partition].u[output].nonzero()[0].tolist())
                    for m in pattern.ticks[partition].m[output].nonzero()[0]:
                        demanded.add(Value(partition, kind.clocks[partition].memories[m], index - 1))
    carried: set[Value] = set()
    for value in demanded:
        while value.index < 0:
            carried.add(value)
            value = Value(value.partition, value.output, value.index + ticks[value.partition])
    return tuple(sorted(carried))


def _at_time(name: str, seconds: Fraction) -> str:
    """Return `name(-1 ms)`: a value as it was at a time before the frame."""
    return f"{name}({float(seconds * 1000):.6g} ms)"
