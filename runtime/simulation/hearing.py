"""Who hears what in a frame of all peers, told as a list of operations on columns of packets.

Takes: the members of a population, the exchange between them, the routes over unreliable links.
Gives: `Hearing`, `hearing_of`; the operations `Total`, `Complete`, `Weighed`, `Deliver`, `OnWays`, `Look`;
`Sparse`.
Guarantees: sums and means over a complete graph cost one addition a peer, over any other graph one product
an arc; a reduction that looks at each pair of peers costs one evaluation a pair; who sends nothing counts in
no mean. A sender is heard by the packet that the schedule says, or, on an unreliable link, the timetable;
before a packet arrives a receiver holds the sender's start values.
Does not: carry them out (see `stepwise`, `machine`).

A packet, one channel of one slot as all peers send it, is a row of numbers: a column a peer, the members one
after the other. Packets of as many frames are kept as any may be heard after.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.weights import sum_weights
from apc.frame.exchange import Exchange, check_mean
from apc.frame.schedule import Heard, Schedule, Selected, Sent, Way
from apc.network.timetable import Route
from apc.simulation.pairs import Pairwise
from apc.simulation.program import Member

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Ranges = tuple[tuple[int, int], ...]  # columns from one up to another


@dataclass(frozen=True, slots=True, eq=False)
class Sparse:
    """What each of some receivers weighs: it hears `columns[starts[i]:starts[i + 1]]`, with `weights`."""

    starts: Integers
    columns: Integers
    weights: Floats


@dataclass(frozen=True, slots=True)
class Total:
    """total[place] = the sum of packet `key`, sent `lag` frames ago, over columns."""

    place: int
    key: int
    lag: int
    ranges: Ranges


@dataclass(frozen=True, slots=True)
class Complete:
    """A row of what a member hears is total[total], less its own packet if it sends one, over `divisor`."""

    member: int
    row: int
    total: int
    key: int  # −1: it sends none
    lag: int
    divisor: float


@dataclass(frozen=True, slots=True, eq=False)
class Weighed:
    """A row of what a member hears is the packet `key`, sent `lag` frames ago, weighed."""

    member: int
    row: int
    key: int
    lag: int
    weights: Sparse


@dataclass(frozen=True, slots=True)
class Deliver:
    """The packets that a route's tick of this frame is the first to see come in effect."""

    route: int
    tick: int


@dataclass(frozen=True, slots=True, eq=False)
class OnWays:
    """A row of what a member hears is what is in effect on a route's ways, weighed, or what is missing."""

    member: int
    row: int
    route: int
    channel: int
    gap: bool
    weights: Sparse


@dataclass(frozen=True, slots=True, eq=False)
class Look:
    """A row of what a member hears is a function of itself and of each sender, evaluated arc by arc.

    `function` is a place among `Hearing.functions`; `pairwise` says what of the member it takes. Of what is
    heard each channel is joined from `sources` (key, lag, ranges), or it is what is in effect on the ways of
    `route` (−1: none), `channels` of it, missing ones told if `gap`. `senders` are places in it.
    """

    member: int
    row: int
    function: int
    pairwise: Pairwise
    operator: str
    sources: tuple[tuple[tuple[int, int, Ranges], ...], ...]
    route: int
    channels: tuple[int, ...]
    gap: bool
    width: int
    senders: Integers
    receivers: Integers
    weights: Floats


Operation = Total | Complete | Weighed | Deliver | OnWays | Look


@dataclass(frozen=True, slots=True, eq=False)
class Hearing:
    """What is sent and heard in a frame.

    `first` (members + 1,) are the members' first columns and the number of all, `column_of` (N,) the column
    of each peer of the scene. `keys` are the packets, `sent` those of each member's rows; `ring` frames of
    them are kept; `start` (keys, columns) is what they hold at time 0. Of each of `routes`, `channels` are
    the keys of each channel's slots, `held` (channels, ways) what is in effect at time 0. `segments` are the
    operations before each segment of the members' programs.
    """

    first: Integers
    column_of: Integers
    keys: tuple[Sent, ...]
    sent: tuple[tuple[int, ...], ...]
    ring: int
    start: Floats
    routes: tuple[Route, ...]
    channels: tuple[Integers, ...]
    held: tuple[Floats, ...]
    totals: int
    functions: tuple[object, ...]  # casadi.Function
    segments: tuple[tuple[Operation, ...], ...]


def hearing_of(exchange: Exchange, members: Sequence[Member], routes: Sequence[Route]) -> Hearing:
    """Find out what is sent and heard in a frame.

    Parameters
    ----------
    exchange
        Who hears whom.
    members
        What each group brings, in the scene's order.
    routes
        The unreliable links.

    Raises
    ------
    ApcError
        E801 a mean over nobody, E802 a mean whose weights add up to 0.
    """
    return _Listing(exchange, members, routes).found()


@dataclass(frozen=True, slots=True, eq=False)
class _Arcs:
    """Who of a member's peers hears whom, arc by arc (M,): `receivers` are places among those peers.

    `senders` are places in what is heard, which is `width` packets wide.
    """

    senders: Integers
    receivers: Integers
    weights: Floats
    width: int

    def chosen(self, which: NDArray[np.bool_]) -> _Arcs:
        """Return some of the arcs."""
        return _Arcs(self.senders[which], self.receivers[which], self.weights[which], self.width)

    def averaging(self, count: int) -> _Arcs:
        """Return the same arcs with the weights of a mean: those of each of `count` peers add up to 1."""
        totals = sum_weights(self.receivers, self.weights, count).floats
        return _Arcs(self.senders, self.receivers, self.weights / totals[self.receivers], self.width)

    def sparse(self, count: int) -> Sparse:
        """Return the arcs receiver by receiver."""
        order = np.argsort(self.receivers, kind="stable")
        starts = np.concatenate([[0], np.cumsum(np.bincount(self.receivers, minlength=count))])
        return Sparse(starts.astype(np.int64), self.senders[order], self.weights[order])


class _Listing:
    """Collects the operations; what several of them use is found once."""

    def __init__(self, exchange: Exchange, members: Sequence[Member], routes: Sequence[Route]) -> None:
        self.exchange, self.members, self.routes = exchange, members, tuple(routes)
        self.route_of = {(one.link, one.clock): place for place, one in enumerate(routes)}
        self.first = np.cumsum([0, *(one.count for one in members)])
        self.member_of = np.empty(exchange.peers, np.int64)  # of each peer of the scene
        self.place_in = np.empty(exchange.peers, np.int64)  # among that member's peers
        for number, member in enumerate(members):
            self.member_of[member.peers] = number
            self.place_in[member.peers] = np.arange(member.count)
        schedules = [member.program.schedule for member in members]
        self.keys = tuple(sorted({one for schedule in schedules for one in schedule.sent}))
        self.key_of = {one: place for place, one in enumerate(self.keys)}
        self.channels = [
            sorted({one.channel for one in self.keys if one.link == route.link}) for route in routes
        ]
        self.sending = {
            link: [any(one.link == link for one in m.program.kind.sends) for m in members]
            for link in exchange.links
        }
        self.totals: dict[tuple[int, int, Ranges], int] = {}
        self.functions: dict[int, tuple[int, object]] = {}
        self.weights: dict[tuple[int, Way, str], Sparse] = {}
        self.looked: dict[object, _Arcs] = {}

    def found(self) -> Hearing:
        segments = tuple(self._segment(i) for i in range(len(self.members[0].program.segments)))
        start = np.zeros((len(self.keys), self.exchange.peers))
        for g, member in enumerate(self.members):
            for key, one in enumerate(self.keys):
                start[key, self.first[g] : self.first[g + 1]] = _first_packet(member, one.link, one.channel)
        column_of = self.first[self.member_of] + self.place_in
        channels = tuple(
            np.array(
                [[self.key_of[Sent(route.link, c, slot)] for slot in range(route.slots)] for c in listed]
            )
            for route, listed in zip(self.routes, self.channels, strict=True)
        )
        depths = [depth for member in self.members for depth in member.program.schedule.depths]
        return Hearing(
            first=self.first,
            column_of=column_of,
            keys=self.keys,
            sent=tuple(
                tuple(self.key_of[one] for one in member.program.schedule.sent) for member in self.members
            ),
            ring=1 + max([*depths, *(one.frames for one in self.routes)], default=0),
            start=start,
            routes=self.routes,
            channels=channels,
            held=tuple(
                start[keys[:, 0]][:, column_of[route.pairs[:, 0]]]
                for keys, route in zip(channels, self.routes, strict=True)
            ),
            totals=len(self.totals),
            functions=tuple(function for _, function in self.functions.values()),
            segments=segments,
        )

    def _segment(self, index: int) -> tuple[Operation, ...]:
        """Return what is done before a segment: all that is heard in it was sent before it began."""
        found: list[Operation] = []
        late: dict[tuple[int, int], list[Operation]] = {}  # by the tick of a route that it hears
        before: dict[tuple[int, int], list[Operation]] = {}  # what the tick before heard is still there
        for g, member in enumerate(self.members):
            segment, schedule = member.program.segments[index], member.program.schedule
            for place, row in enumerate(segment.heard):
                one = schedule.received[row]
                if isinstance(one, Selected):
                    listed = before if one.way.before else late
                    listed.setdefault(self._tick(one), []).append(self._on_ways(g, place, one))
                else:
                    found += self._heard(g, place, one)
            for place, pairwise in enumerate(segment.pairs, len(segment.heard)):
                look = self._look(g, place, pairwise, schedule)
                heard = schedule.received[pairwise.heard[0]]
                if isinstance(heard, Selected):
                    late.setdefault(self._tick(heard), []).append(look)
                else:
                    found.append(look)
        for route, tick in sorted({*late, *before}):
            found += [*before.get((route, tick), ()), Deliver(route, tick), *late.get((route, tick), ())]
        return tuple(found)

    def _tick(self, row: Selected) -> tuple[int, int]:
        return self.route_of[row.way.link, row.clock], row.tick

    def _heard(self, listener: int, place: int, row: Heard) -> list[Operation]:
        """Return what makes a row of a plain sum or mean over a reliable link."""
        way, key = row.way, self.key_of[row.sent]
        if not self.exchange.is_complete(way.link):
            return [Weighed(listener, place, key, row.lag, self._weights(listener, way))]
        senders = self._senders(listener, way.link, way.delay)
        wanted = (key, row.lag, self._ranges(senders))
        before: list[Operation] = []
        if wanted not in self.totals:
            self.totals[wanted] = len(self.totals)
            before.append(Total(self.totals[wanted], *wanted))
        divisor = 1.0
        if way.operator == "mean":
            listed = zip(self.members, self.sending[way.link], strict=True)
            everybody = sum(member.count for member, does in listed if does)
            divisor = float(everybody - int(self.sending[way.link][listener]))
        own = key if listener in senders else -1
        return [*before, Complete(listener, place, self.totals[wanted], own, row.lag, divisor)]

    def _on_ways(self, listener: int, place: int, row: Selected) -> OnWays:
        route, _ = self._tick(row)
        channel = 0 if row.gap else self.channels[route].index(row.channel)
        weights = self._weights(listener, row.way, row.clock)
        return OnWays(listener, place, route, channel, row.gap, weights)

    def _look(self, listener: int, place: int, pairwise: Pairwise, schedule: Schedule) -> Look:
        """Return what makes a row of what a member makes of each pair."""
        rows = [schedule.received[row] for row in pairwise.heard]
        way, count = rows[0].way, self.members[listener].count
        clock = rows[0].clock if isinstance(rows[0], Selected) else ""
        delays = tuple(dict.fromkeys(one.way.delay for one in rows))
        key = (listener, way.operator, way.link, clock, delays)
        if key not in self.looked:
            arcs = (
                self._unreliable(listener, way.link, clock)
                if clock
                else _joined([self._reliable(listener, way.link, delay) for delay in delays])
            )
            self._check(listener, way.link, way.operator, arcs)
            self.looked[key] = arcs.averaging(count) if way.operator == "mean" else arcs
        arcs = self.looked[key]
        # Each way has one delay; a tick's rows over an unreliable link hold all ways, whatever the delay they
        # are named by.
        selected = [one for one in rows if isinstance(one, Selected) and one.way.delay == delays[0]]
        route = self._tick(selected[0])[0] if selected else -1
        function, _ = self.functions.setdefault(
            id(pairwise.function), (len(self.functions), pairwise.function)
        )
        return Look(
            member=listener,
            row=place,
            function=function,
            pairwise=pairwise,
            operator=way.operator,
            sources=() if selected else self._sources(listener, rows, delays),
            route=route,
            channels=tuple(self.channels[route].index(one.channel) for one in selected if not one.gap),
            gap=any(one.gap for one in selected),
            width=arcs.width,
            senders=arcs.senders,
            receivers=arcs.receivers,
            weights=arcs.weights,
        )

    def _sources(
        self, listener: int, rows: Sequence[Heard | Selected], delays: Sequence[str]
    ) -> tuple[tuple[tuple[int, int, Ranges], ...], ...]:
        """Return where the channels stand of which a member's pairs are made, channel by channel."""
        of_delay = []
        for delay in delays:
            ranges = self._ranges(self._senders(listener, rows[0].way.link, delay))
            listed = [one for one in rows if isinstance(one, Heard) and one.way.delay == delay]
            of_delay.append([(self.key_of[one.sent], one.lag, ranges) for one in listed])
        return tuple(zip(*of_delay, strict=True))

    # ---- who hears whom

    def _ranges(self, members: Sequence[int]) -> Ranges:
        return tuple((int(self.first[h]), int(self.first[h + 1])) for h in members)

    def _senders(self, listener: int, link: str, delay: str | None = None) -> list[int]:
        """Return the members that a member can hear over a reliable link with some delay, or any."""
        own = self.members[listener].group
        return [
            h
            for h, does in enumerate(self.sending[link])
            if does and (delay is None or self.exchange.delay(link, self.members[h].group, own) == delay)
        ]

    def _weights(self, listener: int, way: Way, clock: str = "") -> Sparse:
        """Return what each peer of a member weighs what it hears on a way by.

        What is heard are packets, or what is in effect on the ways of an unreliable link.
        """
        key = (listener, way, clock)
        if key not in self.weights:
            link, count = way.link, self.members[listener].count
            every = self._unreliable(listener, link, clock) if clock else self._reliable(listener, link)
            if way.operator == "mean":  # over all delays
                self._check(listener, link, "mean", every)
                every = every.averaging(count)
            if clock:
                pairs = self.routes[self.route_of[link, clock]].pairs[every.senders]
                groups = np.searchsorted(self.exchange.starts, pairs[:, 0], side="right") - 1
            else:
                ranges = self._ranges(self._senders(listener, link))
                columns = np.concatenate([np.arange(*one) for one in ranges])[every.senders]
                every = _Arcs(columns, every.receivers, every.weights, self.exchange.peers)
                member = np.searchsorted(self.first, columns, side="right") - 1
                groups = np.array([one.group for one in self.members])[member]
            own = self.members[listener].group
            late = np.array([
                self.exchange.delay(link, group, own) == way.delay
                for group in range(len(self.exchange.groups))
            ])  # fmt: skip
            self.weights[key] = every.chosen(late[groups]).sparse(count)
        return self.weights[key]

    def _unreliable(self, listener: int, link: str, clock: str) -> _Arcs:
        """Return the arcs over an unreliable link, each of which has packets of its own."""
        route = self.routes[self.route_of[link, clock]]
        mine = np.flatnonzero(self.member_of[route.pairs[:, 1]] == listener)
        receivers = self.place_in[route.pairs[mine, 1]]
        return _Arcs(mine, receivers, route.weights[mine], len(route.pairs))

    def _reliable(self, listener: int, link: str, delay: str | None = None) -> _Arcs:
        """Return the arcs over a reliable link from those who send over it, with some delay or any."""
        senders = self._senders(listener, link, delay)
        widths = [self.members[h].count for h in senders]
        first = np.zeros(len(self.members), np.int64)
        first[senders] = np.cumsum([0, *widths])[:-1]
        if self.exchange.is_complete(link):
            hearing = self.members[listener].peers
            numbers = np.concatenate([self.members[h].peers for h in senders])
            places, receivers = (one.ravel() for one in np.indices((len(numbers), len(hearing))))
            others = numbers[places] != hearing[receivers]
            return _Arcs(places, receivers, np.ones(len(places)), len(numbers)).chosen(others)
        pairs, weights = self.exchange.arcs(link)
        group_of, receiver_of = self.member_of[pairs[:, 0]], self.member_of[pairs[:, 1]]
        used = np.isin(group_of, senders) & (receiver_of == listener)
        places = first[group_of[used]] + self.place_in[pairs[used, 0]]
        return _Arcs(places, self.place_in[pairs[used, 1]], weights[used], sum(widths))

    def _check(self, listener: int, link: str, operator: str, arcs: _Arcs) -> None:
        """Refuse a mean, maximum or minimum over nobody, or a mean whose weights add up to 0."""
        if operator == "sum":
            return
        member = self.members[listener]
        hears = np.bincount(arcs.receivers, minlength=member.count) > 0
        totals = sum_weights(arcs.receivers, arcs.weights, member.count).floats
        enough = hears & (totals != 0) if operator == "mean" else hears
        for place in np.flatnonzero(~enough).tolist():
            peer = int(member.peers[place])
            check_mean(self.exchange, peer, link, operator, bool(hears[place]), Fraction(0))


def _joined(parts: Sequence[_Arcs]) -> _Arcs:
    """Return the arcs of one delay after those of another."""
    first = np.cumsum([0, *(one.width for one in parts)])
    return _Arcs(
        np.concatenate([one.senders + start for one, start in zip(parts, first[:-1], strict=True)]),
        np.concatenate([one.receivers for one in parts]),
        np.concatenate([one.weights for one in parts]),
        int(first[-1]),
    )


def _first_packet(member: Member, link: str, channel: str) -> Floats:
    """Return what each peer of a member sends at the start (count,), 0 where it sends nothing."""
    sent = next((one.channels for one in member.program.kind.sends if one.link == link), ())
    if channel not in sent:
        return np.zeros(member.count)
    return member.each(member.sends[link][:, sent.index(channel)])
