"""Who hears what in a frame of all peers, told as a list of operations on columns of packets.

Takes: the members of a population, the exchange between them, the routes over unreliable links.
Gives: `ExchangeProgram`, `hearing_of`; the operations `CompleteGraphSum`, `WeightedSum`, `Deliver`,
`PairwiseReduction`; what they read, `PacketKey` and `Arrived`.
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
from scipy.sparse import csr_array

from apc.compiler.weights import sum_weights
from apc.frame.exchange import CommunicationGraph, check_mean
from apc.frame.schedule import CouplingTerm, ReceivedSample, SentSample, UncertainSample
from apc.network.timetable import Route
from apc.simulation.pairs import Pairwise
from apc.simulation.program import GroupProgram

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PacketKey:
    """The packet `key` as all peers sent it `lag` frames ago."""

    key: int
    lag: int


@dataclass(frozen=True, slots=True)
class Arrived:
    """What is in effect on a route's ways: a channel, 0 where it is missing, or, last, 1 where it is."""

    route: int
    row: int


Source = PacketKey | Arrived


@dataclass(frozen=True, slots=True)
class CompleteGraphSum:
    """A row of what a member hears is the sum of a packet over `ranges` of columns, over `divisor`.

    Its own packet is left out if `own` says that it sends one.
    """

    member: int
    row: int
    packet: PacketKey
    ranges: tuple[tuple[int, int], ...]  # columns from one up to another
    own: bool
    divisor: float


@dataclass(frozen=True, slots=True, eq=False)
class WeightedSum:
    """A row of what a member hears is `weights` (peers, columns of the source) times its source."""

    member: int
    row: int
    source: Source
    weights: csr_array


@dataclass(frozen=True, slots=True)
class Deliver:
    """The packets that a route's tick of this frame is the first to see come in effect."""

    route: int
    tick: int


@dataclass(frozen=True, slots=True, eq=False)
class PairwiseReduction:
    """A row of what a member hears is a function of itself and of each sender, evaluated arc by arc.

    `function` is a place among `ExchangeProgram.functions`; `pairwise` says what of the member it takes. What
    is heard are the columns `senders` of the `sources`, a channel each, `missing` says which of them are
    (None: none). The values are joined by the `operator`, with those of the arcs before unless it is the
    `first`.
    """

    member: int
    row: int
    function: int
    pairwise: Pairwise
    operator: str
    first: bool
    sources: tuple[Source, ...]
    missing: Arrived | None
    senders: Integers
    receivers: Integers
    weights: Floats


Operation = CompleteGraphSum | WeightedSum | Deliver | PairwiseReduction


@dataclass(frozen=True, slots=True, eq=False)
class ExchangeProgram:
    """What is sent and heard in a frame.

    `first` (members + 1,) are the members' first columns and the number of all, `column_of` (N,) the column
    of each peer of the scene. `keys` are the packets, `sent` those of each member's rows; `ring` frames of
    them are kept; `start` (keys, columns) is what they hold at time 0. Of each of `routes`, `channels` are
    the keys of each channel's slots, `held` (channels + 1, ways) what is in effect at time 0. `segments` are
    the operations before each segment of the members' programs.
    """

    first: Integers
    column_of: Integers
    keys: tuple[SentSample, ...]
    sent: tuple[tuple[int, ...], ...]
    ring: int
    start: Floats
    routes: tuple[Route, ...]
    channels: tuple[Integers, ...]
    held: tuple[Floats, ...]
    functions: tuple[object, ...]  # casadi.Function
    segments: tuple[tuple[Operation, ...], ...]


def hearing_of(
    exchange: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route]
) -> ExchangeProgram:
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
    return _Listing(exchange, members, routes).hearing()


@dataclass(frozen=True, slots=True, eq=False)
class _Arcs:
    """Who of a member's peers hears whom, arc by arc (M,).

    `senders` are columns of packets, or ways of an unreliable link; `receivers` places among those peers.
    """

    senders: Integers
    receivers: Integers
    weights: Floats


class _Listing:
    """Collects the operations; what several of them use is found once."""

    def __init__(
        self, exchange: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route]
    ) -> None:
        self.exchange, self.members, self.routes = exchange, members, tuple(routes)
        self.route_of = {(route.link, route.clock): place for place, route in enumerate(routes)}
        self.first = np.cumsum([0, *(member.count for member in members)])
        self.member_of = np.empty(exchange.peers, np.int64)  # of each peer of the scene
        self.place_in = np.empty(exchange.peers, np.int64)  # among that member's peers
        for number, member in enumerate(members):
            self.member_of[member.peers] = number
            self.place_in[member.peers] = np.arange(member.count)
        self.column_of = self.first[self.member_of] + self.place_in
        self.keys = tuple(sorted({sent for member in members for sent in member.program.schedule.sent}))
        self.key_of = {sent: place for place, sent in enumerate(self.keys)}
        self.channels = [
            sorted({sent.channel for sent in self.keys if sent.link == route.link}) for route in routes
        ]
        self.sending = {
            link: np.array([any(send.link == link for send in m.program.kind.sends) for m in members])
            for link in exchange.links
        }
        self.functions: dict[int, tuple[int, object]] = {}
        self.arcs: dict[tuple[int, CouplingTerm, str], _Arcs] = {}

    def hearing(self) -> ExchangeProgram:
        start = np.zeros((len(self.keys), self.exchange.peers))
        for g, member in enumerate(self.members):
            for key, sent in enumerate(self.keys):
                start[key, self.first[g] : self.first[g + 1]] = _first_packet(member, sent.link, sent.channel)
        channels = tuple(
            np.array([
                [self.key_of[SentSample(route.link, c, slot)] for slot in range(route.slots)] for c in channel
            ])
            for route, channel in zip(self.routes, self.channels, strict=True)
        )  # fmt: skip
        depths = [depth for member in self.members for depth in member.program.schedule.depths]
        segments = tuple(self._segment(i) for i in range(len(self.members[0].program.segments)))
        return ExchangeProgram(
            first=self.first,
            column_of=self.column_of,
            keys=self.keys,
            sent=tuple(
                tuple(self.key_of[sent] for sent in member.program.schedule.sent) for member in self.members
            ),
            ring=1 + max([*depths, *(route.frames for route in self.routes)], default=0),
            start=start,
            routes=self.routes,
            channels=channels,
            held=tuple(
                np.vstack([
                    start[keys[:, 0]][:, self.column_of[route.pairs[:, 0]]], np.zeros(len(route.pairs))
                ])
                for keys, route in zip(channels, self.routes, strict=True)
            ),
            functions=tuple(function for _, function in self.functions.values()),
            segments=segments,
        )  # fmt: skip

    def _segment(self, index: int) -> tuple[Operation, ...]:
        """Return what is done before a segment: all that is heard in it was sent before it began."""
        operations: list[Operation] = []
        late: dict[tuple[int, int], list[Operation]] = {}  # by the tick of a route that it hears
        before: dict[tuple[int, int], list[Operation]] = {}  # what the tick before heard is still there
        for g, member in enumerate(self.members):
            segment, received = member.program.segments[index], member.program.schedule.received
            pairs = [
                (received[row], self._heard(g, place, received[row]))
                for place, row in enumerate(segment.heard)
            ]
            for place, pairwise in enumerate(segment.pairs, len(segment.heard)):
                rows = [received[row] for row in pairwise.heard]
                pairs += [(rows[0], look) for look in self._looks(g, place, pairwise, rows)]
            for heard, operation in pairs:
                if isinstance(heard, UncertainSample):
                    group = before if heard.way.before else late
                    group.setdefault((self.route_of[heard.way.link, heard.clock], heard.tick), []).append(
                        operation
                    )
                else:
                    operations.append(operation)
        for route, tick in sorted({*late, *before}):
            operations += [*before.get((route, tick), ()), Deliver(route, tick), *late.get((route, tick), ())]
        return tuple(operations)

    def _source(self, row: ReceivedSample | UncertainSample) -> Source:
        """Return what a row of the schedule reads."""
        if isinstance(row, ReceivedSample):
            return PacketKey(self.key_of[row.sent], row.lag)
        route = self.route_of[row.way.link, row.clock]
        channel = self.channels[route]
        return Arrived(route, len(channel) if row.gap else channel.index(row.channel))

    def _heard(self, listener: int, place: int, row: ReceivedSample | UncertainSample) -> Operation:
        """Return what makes a row of a plain sum or mean."""
        way, source = row.way, self._source(row)
        if isinstance(source, Arrived) or not self.exchange.is_complete(way.link):
            arcs = self._arcs(listener, row)
            width = (
                len(self.routes[source.route].pairs) if isinstance(source, Arrived) else self.exchange.peers
            )
            shape = (self.members[listener].count, width)
            weights = csr_array((arcs.weights, (arcs.receivers, arcs.senders)), shape=shape)
            return WeightedSum(listener, place, source, weights)
        sending, group = self.sending[way.link], self.members[listener].group
        senders = [
            h
            for h in np.flatnonzero(sending).tolist()
            if self.exchange.delay(way.link, self.members[h].group, group) == way.delay
        ]
        divisor = 1.0
        if way.operator == "mean":
            divisor = float(np.diff(self.first)[sending].sum() - int(sending[listener]))
        ranges = tuple((int(self.first[h]), int(self.first[h + 1])) for h in senders)
        return CompleteGraphSum(listener, place, source, ranges, listener in senders, divisor)

    def _looks(
        self, listener: int, place: int, pairwise: Pairwise, rows: Sequence[ReceivedSample | UncertainSample]
    ) -> list[Operation]:
        """Return what makes a row of what a member makes of each pair, one delay after the other."""
        function, _ = self.functions.setdefault(
            id(pairwise.function), (len(self.functions), pairwise.function)
        )
        looks: list[Operation] = []
        for delay in dict.fromkeys(row.way.delay for row in rows):
            listed = [row for row in rows if row.way.delay == delay]
            arcs = self._arcs(listener, listed[0])
            gaps = [self._source(row) for row in listed if isinstance(row, UncertainSample) and row.gap]
            looks.append(
                PairwiseReduction(
                    member=listener,
                    row=place,
                    function=function,
                    pairwise=pairwise,
                    operator=listed[0].way.operator,
                    first=not looks,
                    sources=tuple(
                        self._source(row) for row in listed if isinstance(row, ReceivedSample) or not row.gap
                    ),
                    missing=next((source for source in gaps if isinstance(source, Arrived)), None),
                    senders=arcs.senders,
                    receivers=arcs.receivers,
                    weights=arcs.weights,
                )
            )
        return looks

    # ---- who hears whom

    def _arcs(self, listener: int, row: ReceivedSample | UncertainSample) -> _Arcs:
        """Return whom each peer of a member hears on a way, and what it weighs them by."""
        way, clock = row.way, row.clock if isinstance(row, UncertainSample) else ""
        key = (listener, way, clock)
        if key not in self.arcs:
            senders, receivers, weights, members = self._all_arcs(listener, way.link, clock)
            if way.operator != "sum":
                totals = self._checked(listener, way, receivers, weights)
                weights = weights / totals[receivers] if way.operator == "mean" else weights
            group = self.members[listener].group
            delays = [self.exchange.delay(way.link, member.group, group) for member in self.members]
            late = np.array([delay == way.delay for delay in delays])[members]
            self.arcs[key] = _Arcs(senders[late], receivers[late], weights[late])
        return self.arcs[key]

    def _all_arcs(self, listener: int, link: str, clock: str) -> tuple[Integers, Integers, Floats, Integers]:
        """Return senders, receivers and weights of the arcs over a link, and the senders' members.

        Over an unreliable link, heard at a `clock`, each arc is a way with packets of its own.
        """
        if clock:
            route = self.routes[self.route_of[link, clock]]
            ways = np.flatnonzero(self.member_of[route.pairs[:, 1]] == listener)
            pairs = route.pairs[ways]
            return ways, self.place_in[pairs[:, 1]], route.weights[ways], self.member_of[pairs[:, 0]]
        if self.exchange.is_complete(link):
            peers = np.stack(
                np.meshgrid(np.arange(self.exchange.peers), self.members[listener].peers), axis=-1
            )
            pairs = peers.reshape(-1, 2)
            pairs = pairs[pairs[:, 0] != pairs[:, 1]]
            weights = np.ones(len(pairs))
        else:
            pairs, weights = self.exchange.arcs(link)
        used = self.sending[link][self.member_of[pairs[:, 0]]] & (self.member_of[pairs[:, 1]] == listener)
        pairs = pairs[used]
        return (
            self.column_of[pairs[:, 0]],
            self.place_in[pairs[:, 1]],
            weights[used],
            self.member_of[pairs[:, 0]],
        )

    def _checked(self, listener: int, way: CouplingTerm, receivers: Integers, weights: Floats) -> Floats:
        """Return what the weights of each peer of a member add up to.

        Refuses a mean, maximum or minimum over nobody, or a mean whose weights add up to 0.
        """
        member = self.members[listener]
        hears = np.bincount(receivers, minlength=member.count) > 0
        totals = sum_weights(receivers, weights, member.count).astype(np.float64)
        enough = hears & (totals != 0) if way.operator == "mean" else hears
        for place in np.flatnonzero(~enough).tolist():
            peer = int(member.peers[place])
            check_mean(self.exchange, peer, way.link, way.operator, bool(hears[place]), Fraction(0))
        return np.asarray(totals)


def _first_packet(member: GroupProgram, link: str, channel: str) -> Floats:
    """Return what each peer of a member sends at the start (count,), 0 where it sends nothing."""
    sent = next((send.channels for send in member.program.kind.sends if send.link == link), ())
    if channel not in sent:
        return np.zeros(member.count)
    return member.each(member.sends[link][:, sent.index(channel)])
