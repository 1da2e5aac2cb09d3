"""The exchange of packets within a frame of all peers, as a list of operations on packet columns.

Takes: the members of a population, their communication graph, the routes over unreliable links.
Gives: `ExchangeProgram`, `exchange_program_of`; the operations `CompleteGraphSum`, `WeightedSum`, `Deliver`,
`PairwiseReduction`; what they read, `PacketKey` and `Arrived`.
Guarantees: sums and means over a complete graph cost one addition per peer, over any other graph one product
per arc; a pairwise reduction costs one evaluation per pair. Peers that send nothing are in no mean. The
packet in effect is that of the schedule or, on an unreliable link, of the timetable; before a packet arrives
a receiver holds the sender's start values.
Does not: execute them (see `interpreted_engine`, `compiled_engine`).

A packet (one channel of one slot, as sent by all peers) is a row of numbers with one column per peer, member
after member. Packets are stored for as many frames as they may be in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from apc.compiler.weights import sum_weights
from apc.frame.communication_graph import CommunicationGraph, check_mean
from apc.frame.schedule import CouplingTerm, ReceivedSample, SentSample, UncertainSample
from apc.network.packet_schedule import Route
from apc.simulation.pairwise import Pairwise
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
    """The data in effect on a route's directed links: a channel (0 if missing) or, last, a received flag."""

    route: int
    row: int


Source = PacketKey | Arrived


@dataclass(frozen=True, slots=True)
class CompleteGraphSum:
    """A row of a member's received values: the sum of a packet over `ranges` of columns, over `divisor`.

    The peer's own packet is excluded if `local` is set.
    """

    member: int
    row: int
    packet: PacketKey
    ranges: tuple[tuple[int, int], ...]  # columns from one up to another
    local: bool
    divisor: float


@dataclass(frozen=True, slots=True, eq=False)
class WeightedSum:
    """A row of a member's received values: `weights` (peers, columns of the source) times its source."""

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
    """A row of a member's received values: a function of the receiver and each sender, evaluated per arc.

    `function` is an index into `ExchangeProgram.functions`; `pairwise` gives its arguments from the member.
    The received values are the columns `senders` of the `sources`, one per channel; `missing` marks missing
    ones (None: none). The `operator` combines the values, with those of the preceding arcs unless it is the
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
    """The packets sent and received in a frame.

    `first` (members + 1,) are the members' first columns and the total number, `column_of` (N,) the column of
    each peer of the model. `keys` are the packets, `sent` those of each member's rows; `ring` frames of them
    are stored; `start` (keys, columns) are their values at time 0. For each of `routes`, `channels` are the
    keys of each channel's slots, `held` (channels + 1, links) the values in effect at time 0. `segments` are
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


def exchange_program_of(
    exchange: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route]
) -> ExchangeProgram:
    """Build the exchange program of a frame.

    Parameters
    ----------
    exchange
        The communication graph.
    members
        The members of each group, in the model's order.
    routes
        The unreliable links.

    Raises
    ------
    ApcError
        E801 a mean over no peers, E802 a mean whose weights add up to 0.
    """
    return _Listing(exchange, members, routes).exchange_program()


@dataclass(frozen=True, slots=True, eq=False)
class _Arcs:
    """The arcs (M,) to a member's peers: sender and receiver of each.

    `senders` are columns of packets, or directed links of an unreliable link; `receivers` are indices of
    those peers.
    """

    senders: Integers
    receivers: Integers
    weights: Floats


class _Listing:
    """Collects the operations; a common subexpression is computed once."""

    def __init__(
        self, exchange: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route]
    ) -> None:
        self.exchange, self.members, self.routes = exchange, members, tuple(routes)
        self.route_of = {(route.link, route.clock): index for index, route in enumerate(routes)}
        self.first = np.cumsum([0, *(member.count for member in members)])
        self.member_of = np.empty(exchange.peers, np.int64)  # of each peer of the model
        self.index_in = np.empty(exchange.peers, np.int64)  # among that member's peers
        for number, member in enumerate(members):
            self.member_of[member.peers] = number
            self.index_in[member.peers] = np.arange(member.count)
        self.column_of = self.first[self.member_of] + self.index_in
        self.keys = tuple(sorted({sent for member in members for sent in member.program.schedule.sent}))
        self.key_of = {sent: index for index, sent in enumerate(self.keys)}
        self.channels = [
            sorted({sent.channel for sent in self.keys if sent.link == route.link}) for route in routes
        ]
        self.sending = {
            link: np.array([any(send.link == link for send in m.program.peer_type.sends) for m in members])
            for link in exchange.links
        }
        self.functions: dict[int, tuple[int, object]] = {}
        self.arcs: dict[tuple[int, CouplingTerm, str], _Arcs] = {}

    def exchange_program(self) -> ExchangeProgram:
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
        """Return the operations before a segment: all its received packets were sent before its start."""
        operations: list[Operation] = []
        late: dict[tuple[int, int], list[Operation]] = {}  # updated at the tick of a receiving route
        before: dict[tuple[int, int], list[Operation]] = {}  # values of the previous tick are unchanged
        for g, member in enumerate(self.members):
            segment, input_rows = member.program.segments[index], member.program.schedule.all_received
            pairs = [
                (input_rows[row], self._received(g, position, input_rows[row]))
                for position, row in enumerate(segment.received)
            ]
            for position, pairwise in enumerate(segment.pairs, len(segment.received)):
                rows = [input_rows[row] for row in pairwise.received]
                pairs += [(rows[0], reduction) for reduction in self._reads(g, position, pairwise, rows)]
            for received, operation in pairs:
                if isinstance(received, UncertainSample):
                    group = before if received.coupling_term.before else late
                    group.setdefault(
                        (self.route_of[received.coupling_term.link, received.clock], received.tick), []
                    ).append(operation)
                else:
                    operations.append(operation)
        for route, tick in sorted({*late, *before}):
            operations += [*before.get((route, tick), ()), Deliver(route, tick), *late.get((route, tick), ())]
        return tuple(operations)

    def _source(self, row: ReceivedSample | UncertainSample) -> Source:
        """Return the source of a row of the schedule."""
        if isinstance(row, ReceivedSample):
            return PacketKey(self.key_of[row.sent], row.lag)
        route = self.route_of[row.coupling_term.link, row.clock]
        channel = self.channels[route]
        return Arrived(route, len(channel) if row.gap else channel.index(row.channel))

    def _received(self, listener: int, index: int, row: ReceivedSample | UncertainSample) -> Operation:
        """Return the operations of a row that is a plain sum or mean."""
        coupling_term, source = row.coupling_term, self._source(row)
        if isinstance(source, Arrived) or not self.exchange.is_complete(coupling_term.link):
            arcs = self._arcs(listener, row)
            width = (
                len(self.routes[source.route].pairs) if isinstance(source, Arrived) else self.exchange.peers
            )
            shape = (self.members[listener].count, width)
            weights = csr_array((arcs.weights, (arcs.receivers, arcs.senders)), shape=shape)
            return WeightedSum(listener, index, source, weights)
        sending, group = self.sending[coupling_term.link], self.members[listener].group
        senders = [
            h
            for h in np.flatnonzero(sending).tolist()
            if self.exchange.delay(coupling_term.link, self.members[h].group, group) == coupling_term.delay
        ]
        divisor = 1.0
        if coupling_term.operator == "mean":
            divisor = float(np.diff(self.first)[sending].sum() - int(sending[listener]))
        ranges = tuple((int(self.first[h]), int(self.first[h + 1])) for h in senders)
        return CompleteGraphSum(listener, index, source, ranges, listener in senders, divisor)

    def _reads(
        self, listener: int, index: int, pairwise: Pairwise, rows: Sequence[ReceivedSample | UncertainSample]
    ) -> list[Operation]:
        """Return the operations of a row that is a pairwise reduction, one delay after the other."""
        function, _ = self.functions.setdefault(
            id(pairwise.function), (len(self.functions), pairwise.function)
        )
        reads: list[Operation] = []
        for delay in dict.fromkeys(row.coupling_term.delay for row in rows):
            listed = [row for row in rows if row.coupling_term.delay == delay]
            arcs = self._arcs(listener, listed[0])
            gaps = [self._source(row) for row in listed if isinstance(row, UncertainSample) and row.gap]
            reads.append(
                PairwiseReduction(
                    member=listener,
                    row=index,
                    function=function,
                    pairwise=pairwise,
                    operator=listed[0].coupling_term.operator,
                    first=not reads,
                    sources=tuple(
                        self._source(row) for row in listed if isinstance(row, ReceivedSample) or not row.gap
                    ),
                    missing=next((source for source in gaps if isinstance(source, Arrived)), None),
                    senders=arcs.senders,
                    receivers=arcs.receivers,
                    weights=arcs.weights,
                )
            )
        return reads

    # ---- communication graph

    def _arcs(self, listener: int, row: ReceivedSample | UncertainSample) -> _Arcs:
        """Return the senders of each peer of a member for a coupling term, with their weights."""
        coupling_term, clock = row.coupling_term, row.clock if isinstance(row, UncertainSample) else ""
        key = (listener, coupling_term, clock)
        if key not in self.arcs:
            senders, receivers, weights, members = self._all_arcs(listener, coupling_term.link, clock)
            if coupling_term.operator != "sum":
                totals = self._checked(listener, coupling_term, receivers, weights)
                weights = weights / totals[receivers] if coupling_term.operator == "mean" else weights
            group = self.members[listener].group
            delays = [self.exchange.delay(coupling_term.link, member.group, group) for member in self.members]
            late = np.array([delay == coupling_term.delay for delay in delays])[members]
            self.arcs[key] = _Arcs(senders[late], receivers[late], weights[late])
        return self.arcs[key]

    def _all_arcs(self, listener: int, link: str, clock: str) -> tuple[Integers, Integers, Floats, Integers]:
        """Return senders, receivers and weights of the arcs over a link, and the senders' members.

        Over an unreliable link received at a `clock`, each arc is a directed link with separate packets.
        """
        if clock:
            route = self.routes[self.route_of[link, clock]]
            arcs = np.flatnonzero(self.member_of[route.pairs[:, 1]] == listener)
            pairs = route.pairs[arcs]
            return arcs, self.index_in[pairs[:, 1]], route.weights[arcs], self.member_of[pairs[:, 0]]
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
            self.index_in[pairs[:, 1]],
            weights[used],
            self.member_of[pairs[:, 0]],
        )

    def _checked(
        self, listener: int, coupling_term: CouplingTerm, receivers: Integers, weights: Floats
    ) -> Floats:
        """Return the sum of the weights of each peer of a member.

        Refuses a mean, maximum or minimum over nobody, or a mean whose weights add up to 0.
        """
        member = self.members[listener]
        receives = np.bincount(receivers, minlength=member.count) > 0
        totals = sum_weights(receivers, weights, member.count).astype(np.float64)
        enough = receives & (totals != 0) if coupling_term.operator == "mean" else receives
        for index in np.flatnonzero(~enough).tolist():
            peer = int(member.peers[index])
            check_mean(
                self.exchange,
                peer,
                coupling_term.link,
                coupling_term.operator,
                bool(receives[index]),
                Fraction(0),
            )
        return np.asarray(totals)


def _first_packet(member: GroupProgram, link: str, channel: str) -> Floats:
    """Return the values sent at the start by each peer of a member (count,), 0 if none."""
    sent = next((send.channels for send in member.program.peer_type.sends if send.link == link), ())
    if channel not in sent:
        return np.zeros(member.count)
    return member.each(member.sends[link][:, sent.index(channel)])
