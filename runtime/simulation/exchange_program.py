"""The exchange of packets within a frame of all peers, as a list of operations on packet columns.

Takes: the members of a population, their communication graph, the routes over unreliable links.
Gives: `ExchangeProgram`, `exchange_program_of`; the operations `CompleteGraphSum`, `WeightedSum`, `Deliver`,
`PairwiseReduction`; their sources, `PacketKey` and `Arrived`.
Guarantees: sums and means over a complete graph cost one addition per peer, over any other graph one product
per arc; a pairwise reduction costs one evaluation per pair. Peers that send nothing do not count in means.
The packet in effect is that of the schedule or, on an unreliable link, of the timetable; before a packet
arrives a receiver holds the sender's start values.
Does not: execute them (see `interpreted_engine`, `compiled_engine`).

A packet (one channel of one slot, as sent by all peers) is a row of numbers with one column per peer, member
after member. Packets are stored for as many frames as they may be in use.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_array

from apc.compiler.weights import sum_weights
from apc.network.packet_schedule import Route
from apc.simulation.pairwise import Pairwise
from apc.simulation.program import GroupProgram
from apc.timing.communication_graph import CommunicationGraph, check_mean
from apc.timing.schedule import CouplingTerm, ReceivedSample, SentSample, UncertainSample

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class PacketKey:
    """The source that is packet number `key` of all peers, sent `lag` frames ago."""

    key: int
    lag: int


@dataclass(frozen=True, slots=True)
class Arrived:
    """The source that is in effect on a route's directed links: channel `row`, or, last, the flags of
    missing packets.
    """

    route: int
    row: int


Source = PacketKey | Arrived


@dataclass(frozen=True, slots=True)
class CompleteGraphSum:
    """The operation that sums a packet over `ranges` of columns, divided by `divisor`, for all peers of a
    member.

    `row` is that of the member's received values. `local`: the peer's own packet is subtracted.
    """

    member: int
    row: int
    packet: PacketKey
    ranges: tuple[tuple[int, int], ...]  # columns from one up to another
    local: bool
    divisor: float


@dataclass(frozen=True, slots=True, eq=False)
class WeightedSum:
    """The operation `weights` (peers, columns of the source) times the source, for all peers of a member."""

    member: int
    row: int
    source: Source
    weights: csr_array


@dataclass(frozen=True, slots=True)
class Deliver:
    """The operation that updates the values in effect on a route at one of its ticks in the frame."""

    route: int
    tick: int


@dataclass(frozen=True, slots=True, eq=False)
class PairwiseReduction:
    """The operation that evaluates a function of receiver and sender per arc, and reduces it at each
    receiver.

    `row` is that of the member's received values. `function` is an index into `ExchangeProgram.functions`;
    `pairwise` gives its arguments from the member. The received values are the columns `senders` of the
    `sources`, one per channel; `missing` marks missing packets (None: none). The `operator` combines the
    values, with those of the preceding arcs unless `first` is set.
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
    """The packets sent and received in a frame, and the operations on them.

    `first` (members + 1,) are the members' first columns and the total number, `column_of` (N,) the column of
    each peer of the model. `keys` are the packets, `sent` the packets of each member's sent rows; `ring`
    frames of packets are stored; `start` (keys, columns) are their values at time 0. For each of `routes`,
    `channels` are the keys of each channel's slots, `held` (channels + 1, links) the values in effect at time
    0. `segments` are the operations before each segment of the members' programs.
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
    comm_graph: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route]
) -> ExchangeProgram:
    """Return the exchange program of a frame.

    Parameters
    ----------
    comm_graph
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
    return _ExchangeBuilder(comm_graph, members, routes).exchange_program()


@dataclass(frozen=True, slots=True, eq=False)
class _Arcs:
    """The arcs (M,) to a member's peers: sender, receiver and weight of each.

    `senders` are columns of packets, or directed links of an unreliable link; `receivers` are indices of the
    member's peers.
    """

    senders: Integers
    receivers: Integers
    weights: Floats


class _ExchangeBuilder:
    """Builds the operations of all segments; common arcs and functions are built once."""

    def __init__(
        self, comm_graph: CommunicationGraph, members: Sequence[GroupProgram], routes: Sequence[Route]
    ) -> None:
        self.comm_graph, self.members, self.routes = comm_graph, members, tuple(routes)
        self.route_of = {
            (route.link, route.clock, route.sent_by): index for index, route in enumerate(routes)
        }
        self.first = np.cumsum([0, *(member.count for member in members)])
        self.member_of = np.empty(comm_graph.peers, np.int64)  # of each peer of the model
        self.index_in = np.empty(comm_graph.peers, np.int64)  # among that member's peers
        for number, member in enumerate(members):
            self.member_of[member.peers] = number
            self.index_in[member.peers] = np.arange(member.count)
        self.column_of = self.first[self.member_of] + self.index_in
        self.keys = tuple(sorted({sent for member in members for sent in member.program.schedule.sent}))
        self.key_of = {sent: index for index, sent in enumerate(self.keys)}
        self.channels = [
            sorted(
                {sent.channel for sent in self.keys if (sent.link, sent.clock) == (route.link, route.sent_by)}
            )
            for route in routes
        ]
        self.sending = {
            link: np.array([any(send.link == link for send in m.program.peer_type.sends) for m in members])
            for link in comm_graph.links
        }
        self.functions: dict[Any, int] = {}  # casadi.Function
        self.arcs: dict[tuple[int, CouplingTerm, str], _Arcs] = {}

    def exchange_program(self) -> ExchangeProgram:
        """Return the exchange program with the values at time 0."""
        start = np.zeros((len(self.keys), self.comm_graph.peers))
        for g, member in enumerate(self.members):
            for key, sent in enumerate(self.keys):
                start[key, self.first[g] : self.first[g + 1]] = _first_packet(member, sent.link, sent.channel)
        channels = tuple(
            np.array([
                [self.key_of[SentSample(route.link, c, k, route.sent_by)] for k in range(route.slots)]
                for c in channel
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
            functions=tuple(self.functions),
            segments=segments,
        )  # fmt: skip

    def _segment(self, index: int) -> tuple[Operation, ...]:
        """Return the operations before a segment; all received packets were sent before its start."""
        operations: list[Operation] = []
        after_delivery: dict[
            tuple[int, int], list[Operation]
        ] = {}  # updated at the tick of a receiving route
        before_delivery: dict[
            tuple[int, int], list[Operation]
        ] = {}  # values of the previous tick are unchanged
        for g, member in enumerate(self.members):
            segment, input_rows = member.program.segments[index], member.program.schedule.all_received
            pairs = [
                (input_rows[row], self._sum_operation(g, position, input_rows[row]))
                for position, row in enumerate(segment.received)
            ]
            for position, pairwise in enumerate(segment.pairs, len(segment.received)):
                rows = [input_rows[row] for row in pairwise.received]
                pairs += self._pairwise_reductions(g, position, pairwise, rows)
            for received, operation in pairs:
                if isinstance(received, UncertainSample):
                    group = before_delivery if received.coupling_term.before else after_delivery
                    group.setdefault((self._route(received), received.tick), []).append(operation)
                else:
                    operations.append(operation)
        for route, tick in sorted({*after_delivery, *before_delivery}):
            operations += [
                *before_delivery.get((route, tick), ()),
                Deliver(route, tick),
                *after_delivery.get((route, tick), ()),
            ]
        return tuple(operations)

    def _route(self, row: ReceivedSample | UncertainSample) -> int:
        """Return the index of the route of a received row of the schedule, −1 over a reliable link."""
        if isinstance(row, ReceivedSample):
            return -1
        return self.route_of[row.coupling_term.link, row.clock, row.coupling_term.clock]

    def _source(self, row: ReceivedSample | UncertainSample) -> Source:
        """Return the source of a received row of the schedule."""
        if isinstance(row, ReceivedSample):
            return PacketKey(self.key_of[row.sent], row.lag)
        route = self._route(row)
        channel = self.channels[route]
        return Arrived(route, len(channel) if row.gap else channel.index(row.channel))

    def _sum_operation(
        self, member_index: int, index: int, row: ReceivedSample | UncertainSample
    ) -> Operation:
        """Return the operation of a received row that is a plain sum or mean."""
        coupling_term, source = row.coupling_term, self._source(row)
        if isinstance(source, Arrived) or not self.comm_graph.is_complete(coupling_term.link):
            arcs = self._arcs(member_index, row)
            width = (
                len(self.routes[source.route].pairs) if isinstance(source, Arrived) else self.comm_graph.peers
            )
            shape = (self.members[member_index].count, width)
            weights = csr_array((arcs.weights, (arcs.receivers, arcs.senders)), shape=shape)
            return WeightedSum(member_index, index, source, weights)
        sending, group = self.sending[coupling_term.link], self.members[member_index].group
        senders = [
            member
            for member in np.flatnonzero(sending).tolist()
            if self.comm_graph.delay(coupling_term.link, self.members[member].group, group)
            == coupling_term.delay
        ]
        divisor = 1.0
        if coupling_term.operator == "mean":
            divisor = float(np.diff(self.first)[sending].sum() - int(sending[member_index]))
        ranges = tuple((int(self.first[member]), int(self.first[member + 1])) for member in senders)
        return CompleteGraphSum(member_index, index, source, ranges, member_index in senders, divisor)

    def _pairwise_reductions(
        self,
        member_index: int,
        index: int,
        pairwise: Pairwise,
        rows: Sequence[ReceivedSample | UncertainSample],
    ) -> list[tuple[ReceivedSample | UncertainSample, Operation]]:
        """Return the operations that compute one pairwise reduction of a member, one operation for each
        delay, in the order of routes, each with one of its received rows.

        Parameters
        ----------
        member_index
            The index of the member that receives.
        index
            The row of the result among the member's received values.
        pairwise
            The function of receiver and sender.
        rows
            The received rows of the schedule that it reads: for each delay those of all channels, and on an
            unreliable link that of the missing packets.
        """
        function_index = self.functions.setdefault(pairwise.function, len(self.functions))
        reductions: list[tuple[ReceivedSample | UncertainSample, Operation]] = []
        for delay in dict.fromkeys(row.coupling_term.delay for row in sorted(rows, key=self._route)):
            rows_of_delay = [row for row in rows if row.coupling_term.delay == delay]
            arcs = self._arcs(member_index, rows_of_delay[0])
            missing_sources = [
                self._source(row) for row in rows_of_delay if isinstance(row, UncertainSample) and row.gap
            ]
            reduction = PairwiseReduction(
                member=member_index,
                row=index,
                function=function_index,
                pairwise=pairwise,
                operator=rows_of_delay[0].coupling_term.operator,
                first=not reductions,
                sources=tuple(
                    self._source(row)
                    for row in rows_of_delay
                    if isinstance(row, ReceivedSample) or not row.gap
                ),
                missing=next((source for source in missing_sources if isinstance(source, Arrived)), None),
                senders=arcs.senders,
                receivers=arcs.receivers,
                weights=arcs.weights,
            )
            reductions.append((rows_of_delay[0], reduction))
        return reductions

    # ---- communication graph

    def _arcs(self, member_index: int, row: ReceivedSample | UncertainSample) -> _Arcs:
        """Return the arcs of a coupling term to the peers of a member, with their weights."""
        coupling_term, clock = row.coupling_term, row.clock if isinstance(row, UncertainSample) else ""
        key, link = (member_index, coupling_term, clock), coupling_term.link
        if key not in self.arcs:
            senders, receivers, weights, members = self._all_arcs(member_index, link, self._route(row))
            if coupling_term.operator != "sum":
                of_all = self._all_arcs(member_index, link)[
                    1:3
                ]  # the route may have some of the senders only
                totals = self._checked_weight_sums(member_index, coupling_term, *of_all)
                weights = weights / totals[receivers] if coupling_term.operator == "mean" else weights
            group = self.members[member_index].group
            delays = [self.comm_graph.delay(link, member.group, group) for member in self.members]
            of_delay = np.array([delay == coupling_term.delay for delay in delays])[members]
            self.arcs[key] = _Arcs(senders[of_delay], receivers[of_delay], weights[of_delay])
        return self.arcs[key]

    def _all_arcs(
        self, member_index: int, link: str, route_index: int = -1
    ) -> tuple[Integers, Integers, Floats, Integers]:
        """Return senders, receivers and weights of the arcs over a link, and the senders' members.

        With the index of a route, they are those of the route, whose directed links have separate packets.
        """
        if route_index >= 0:
            route = self.routes[route_index]
            arcs = np.flatnonzero(self.member_of[route.pairs[:, 1]] == member_index)
            pairs = route.pairs[arcs]
            return arcs, self.index_in[pairs[:, 1]], route.weights[arcs], self.member_of[pairs[:, 0]]
        if self.comm_graph.is_complete(link):
            peers = np.stack(
                np.meshgrid(np.arange(self.comm_graph.peers), self.members[member_index].peers), axis=-1
            )
            pairs = peers.reshape(-1, 2)
            pairs = pairs[pairs[:, 0] != pairs[:, 1]]
            weights = np.ones(len(pairs))
        else:
            pairs, weights = self.comm_graph.arcs(link)
        used = self.sending[link][self.member_of[pairs[:, 0]]] & (self.member_of[pairs[:, 1]] == member_index)
        pairs = pairs[used]
        return (
            self.column_of[pairs[:, 0]],
            self.index_in[pairs[:, 1]],
            weights[used],
            self.member_of[pairs[:, 0]],
        )

    def _checked_weight_sums(
        self, member_index: int, coupling_term: CouplingTerm, receivers: Integers, weights: Floats
    ) -> Floats:
        """Return the sum of the weights at each peer of a member.

        Raises an error for a mean, maximum or minimum over no peer, or a mean whose weights add up to 0.
        """
        member = self.members[member_index]
        receives = np.bincount(receivers, minlength=member.count) > 0
        totals = sum_weights(receivers, weights, member.count).astype(np.float64)
        is_valid = receives & (totals != 0) if coupling_term.operator == "mean" else receives
        for index in np.flatnonzero(~is_valid).tolist():
            peer = int(member.peers[index])
            check_mean(
                self.comm_graph,
                peer,
                coupling_term.link,
                coupling_term.operator,
                bool(receives[index]),
                Fraction(0),
            )
        return np.asarray(totals)


def _first_packet(member: GroupProgram, link: str, channel: str) -> Floats:
    """Return the values that each peer of a member sends at the start (count,), 0 without such a channel."""
    sent = next((send.channels for send in member.program.peer_type.sends if send.link == link), ())
    if channel not in sent:
        return np.zeros(member.count)
    return member.each(member.sends[link][:, sent.index(channel)])
