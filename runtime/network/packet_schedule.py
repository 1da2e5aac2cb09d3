"""Reception times of all packets on unreliable links: the packet in effect at each tick and directed link.

Takes: a `Model` with its parameter values, the communication graph, the frame and the quantum of its
schedules, a seed.
Gives: `Route`, `routes_of`; `ArrivalProcess`, `arrival_process_of`; `Timetable`, `LinkReceiver`,
`DeliveredPackets`, `START`; `instant_of`.
Guarantees: without loss and jitter the packet in effect at a tick equals that of `scheduling`. All clocks of
a receiver observe the same arrivals of a directed link. The result is independent of the partition of time
into calls. Memory use is bounded in time.
Does not: transport values. Reliable links are not included and cost nothing here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.network.channel import ChannelLaw, PacketSource, channel_law
from apc.support.memory import refuse_beyond
from apc.timing.communication_graph import CommunicationGraph

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Largest number of directed peer pairs, each with packets in transit, and the bytes stored per pair.
MOST_ARCS, ARC_BYTES = 2_000_000, 200
PACKET = 100  # bytes per packet in transit, including NumPy's copies

START = -1  # the "packet" before the first: the sender's start values

# Arrival times are resolved to this part of a quantum; all tick times are integer quanta. A delay of an
# integer number of quanta, given as a float of seconds, is then represented exactly.
FINENESS = 2**20
# The largest delay or frame in quanta: integers of their parts would overflow beyond it.
LONGEST = 2**40


def instant_of(seconds: float, quantum: Fraction) -> Fraction:
    """Return the time given as a float of seconds, rounded to the resolution of arrival times."""
    return round(Fraction(seconds) / quantum * FINENESS) * quantum / FINENESS


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """The samples received over one unreliable link at the ticks of one clock.

    `sent_by` is the pairs' own clock, whose ticks send the packets; empty for that of the link. `pairs`
    (M, 2) are the peers (sender, receiver), counted from 0, receiver by receiver, `weights` (M,) the graph's
    weights; `longest` is the link's longest time in seconds from a packet's sample to its arrival. A frame
    has `ticks` ticks of the clock and `slots` sending slots; packets are stored for `frames` frames. `zero`
    states whether a receiver substitutes its own value for a missing sample.
    """

    link: str
    clock: str
    sent_by: str
    pairs: Integers
    weights: Floats
    longest: float
    ticks: int
    slots: int
    frames: int
    zero: bool


@dataclass(frozen=True, slots=True, eq=False)
class DeliveredPackets:
    """The packets in effect at the ticks on M directed links.

    `packets` (ticks, M) are the numbers of the packets in effect, counted from 0, `START` for the start
    values. `missing` (ticks, M) marks detected losses for which the receiver substitutes its own value: from
    the nominal arrival tick of a lost packet until a packet sent after it is in effect.
    """

    packets: Integers
    missing: Flags


@dataclass(frozen=True, slots=True, eq=False)
class ArrivalProcess:
    """The arrival process of a route's directed links; times in quanta of `quantum` seconds.

    `laws` are the channel laws, one per delay of pairs of groups, and `law_of` (M,) the index of each
    directed link's law; `nominal` (M,) are the delays in quanta. Packet k is sent at phase + k*period, tick k
    is at tick_phase + k*tick_period. `newest` and `least` as in `LinkReceiver`.
    """

    laws: tuple[ChannelLaw, ...]
    law_of: Integers
    nominal: Integers
    phase: int
    period: int
    tick_phase: int
    tick_period: int
    quantum: Fraction
    newest: bool
    least: int

    @property
    def zero(self) -> Flags:
        """Whether the receiver of each directed link substitutes its own value for a missing sample (M,)."""
        return np.array([law.zero for law in self.laws], np.bool_)[self.law_of]

    def stored(self, route: Route) -> int:
        """Return an upper bound of the number of packets stored for each directed link."""
        return route.slots * (self.latest(route) // (route.ticks * self.tick_period) + 3)

    def latest(self, route: Route) -> int:
        """Return the time in quanta after which a packet of a directed link has arrived or is lost."""
        longest = max((law.delay for law in self.laws), default=0.0)
        return math.ceil(max(route.longest, longest) / float(self.quantum)) + 1


def arrival_process_of(
    model: Model,
    timings: Mapping[str, Fraction],
    comm_graph: CommunicationGraph,
    route: Route,
    quantum: Fraction,
) -> ArrivalProcess:
    """Return the arrival process of a route.

    Parameters
    ----------
    model
        The model, with the parameter values to use (see `overrides.apply`).
    timings
        Seconds by the name of the timing.
    comm_graph
        The communication graph.
    route
        The route.
    quantum
        The time step in seconds: every period, phase and delay in use is an integer multiple of it.

    Raises
    ------
    ApcError
        E891 a group sets its own value for a link parameter; E892 too many packets in transit, or times
        of too many quanta.
    """
    link = comm_graph.links[route.link]
    assert link.channel is not None
    grids = {
        clock.name: (timings[clock.phase] / quantum, timings[clock.period] / quantum)
        for clock in model.clocks
    }
    sending_clock = grids[route.sent_by or link.clock]
    groups, group_pair_of = _group_pairs(comm_graph, route.pairs)
    least = int(link.after)
    pair_delays = [comm_graph.delay(link.name, *pair) for pair in groups]
    delays = [*dict.fromkeys(pair_delays)]
    law_of = np.array([delays.index(delay) for delay in pair_delays], np.int64)[group_pair_of]
    arrival_process = ArrivalProcess(
        laws=tuple(channel_law(model, link, delay) for delay in delays),
        law_of=law_of,
        nominal=np.array([max(int(timings[delay] / quantum), least) for delay in delays], np.int64)[law_of],
        phase=int(sending_clock[0]),
        period=int(sending_clock[1]),
        tick_phase=int(grids[route.clock][0]),
        tick_period=int(grids[route.clock][1]),
        quantum=quantum,
        newest=link.channel.reorder == "newest",
        least=least,
    )
    _check_arrival_process(model, route, arrival_process)
    return arrival_process


def _check_arrival_process(model: Model, route: Route, arrival_process: ArrivalProcess) -> None:
    """Raise ApcError E892 for too many packets in transit, or for times of too many quanta."""
    latest, arcs = arrival_process.latest(route), len(route.pairs)
    if max(latest, route.ticks * arrival_process.tick_period) > LONGEST:
        message = (
            f"{route.link} is unreliable; its times are multiples of "
            f"{float(arrival_process.quantum):.6g} s, of which periods, phases and delays are whole "
            "multiples: at most "
            f"{LONGEST} of them"
        )
        raise ApcError(
            Diagnostic(
                "E892",
                SourceLocation(model.origin.topology),
                message,
                advice="use periods and delays in whole µs",
            )
        )
    packets = arrival_process.stored(route) * arcs
    message = (
        f"{packets:,} packets stored for {arcs:,} directed connections of the unreliable link {route.link}"
    )
    advice = "shorten the delay or jitter, reduce the number of peers, or use graph: ring"
    refuse_beyond(
        ARC_BYTES * arcs + PACKET * packets, "E892", SourceLocation(model.origin.topology), message, advice
    )


class LinkReceiver:
    """The packets in effect on a set of directed links at successive ticks, in the order of time."""

    def __init__(
        self,
        source: PacketSource,
        *,
        phase: int,
        period: int,
        delay: int,
        quantum: Fraction,
        newest: bool,
        least: int = 0,
    ) -> None:
        """Start before the first packet.

        Parameters
        ----------
        source
            The source of the packets.
        phase, period
            Packet k of every directed link is sent at phase + k*period, in quanta.
        delay
            The nominal delay in quanta.
        quantum
            Seconds per quantum; all ticks are at integer multiples.
        newest
            Whether the most recently sent packet is in effect; otherwise the most recently arrived packet (of
            simultaneous arrivals, the packet sent last).
        least
            The least number of quanta from sending to reception: 1 if a packet is sent after the ticks at its
            instant.
        """
        self.source = source
        self.phase = phase
        self.period = period
        self.delay = delay
        self.quantum = float(quantum)
        self.newest, self.least = newest, least
        self._effective = np.full(source.arcs, START, np.int64)
        # The newest lost packets whose nominal arrival is past.
        self._gap = np.full(source.arcs, START, np.int64)
        # Lost packets before their nominal arrival: directed link and packet number.
        self._due = np.zeros((2, 0), np.int64)
        # Packets in transit: directed link, number, first tick time of reception in quanta, fraction of a
        # quantum between arrival and that time.
        self._in_flight = np.zeros((4, 0), np.int64)

    @property
    def stored(self) -> int:
        """The number of packets in transit, or lost before their nominal arrival, on all directed links."""
        return self._in_flight.shape[1] + self._due.shape[1]

    def receive(self, ticks: Integers) -> DeliveredPackets:
        """Return the packets in effect at the ticks (n,), in quanta, ascending, after the ticks of all
        earlier calls.
        """
        if not len(ticks):
            empty_shape = (0, self.source.arcs)
            return DeliveredPackets(np.zeros(empty_shape, np.int64), np.zeros(empty_shape, np.bool_))
        self._send_until(int(ticks[-1]))
        arcs, numbers, reception_times, _ = self._in_flight
        arrived = reception_times <= ticks[-1]
        packets = self._in_effect(ticks, self._in_flight[:, arrived])
        missing = self._gaps(ticks) > packets
        self._effective = packets[-1].copy()
        remaining = ~arrived & (numbers > self._effective[arcs]) if self.newest else ~arrived
        self._in_flight = self._in_flight[:, remaining]
        return DeliveredPackets(packets, missing)

    def _send_until(self, until: int) -> None:
        """Add all packets sent up to a time in quanta, with their delays drawn, to those lost or in transit.

        Packets sent later have not arrived by then.
        """
        first_number = self.source.used
        count = max((until - self.phase) // self.period + 1 - first_number, 0)
        delays = self.source.take(count) / self.quantum
        lost = ~(delays < LONGEST)  # infinite if lost
        delay_parts = np.rint(np.where(lost, 0.0, delays) * FINENESS).astype(np.int64)
        arcs, numbers = np.indices(delays.shape)
        numbers += first_number
        # The delay rounded up to quanta, and by how much.
        reception_times = (
            self.phase + self.period * numbers + np.maximum(-(-delay_parts // FINENESS), self.least)
        )
        part_before = -delay_parts % FINENESS
        sent = np.stack([arcs, numbers, reception_times, part_before])
        self._due = np.concatenate([self._due, sent[:2, lost]], axis=1)
        self._in_flight = np.concatenate([self._in_flight, sent[:, ~lost]], axis=1)

    def _in_effect(self, ticks: Integers, arrived: Integers) -> Integers:
        """Return, for each tick and directed link (n, M), the arrived packet that was sent last, or
        arrived last.
        """
        arcs, numbers, reception_times, part_before = arrived
        if self.newest:
            return _highest_rank(ticks, arcs, reception_times, numbers, self._effective)
        order = np.lexsort((numbers, -part_before, reception_times))
        rank = np.arange(len(order))
        latest = _highest_rank(
            ticks, arcs[order], reception_times[order], rank, np.full(self.source.arcs, -1)
        )
        return np.where(latest < 0, self._effective, np.append(numbers[order], START)[latest])

    def _gaps(self, ticks: Integers) -> Integers:
        """Return, for each tick and directed link (n, M), the newest lost packet whose nominal arrival
        is past.
        """
        arcs, numbers = self._due
        due_times = self.phase + self.period * numbers + self.delay
        due = due_times <= ticks[-1]
        gaps = _highest_rank(ticks, arcs[due], due_times[due], numbers[due], self._gap)
        self._due, self._gap = self._due[:, ~due], gaps[-1].copy()
        return gaps


class Timetable:
    """The packets of all unreliable links of a model, from time 0 on, in the order of time."""

    def __init__(
        self,
        routes: Sequence[Route],
        arrival_processes: Sequence[ArrivalProcess],
        *,
        seed: int = 0,
        run: int = 0,
    ) -> None:
        """Start at time 0.

        Parameters
        ----------
        routes, arrival_processes
            The unreliable links (see `routes_of`), and the arrival process of each (see
            `arrival_process_of`).
        seed, run
            The seed of the experiment and the index of the run.
        """
        self.routes, self._arrival_processes = tuple(routes), tuple(arrival_processes)
        self._receivers = [
            _link_receivers(route, arrival_process, seed, run)
            for route, arrival_process in zip(routes, arrival_processes, strict=True)
        ]
        self._now = 0

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return the packets in effect at each route's ticks, from the end of the last call to `until`, in
        quanta.
        """
        delivered = []
        for route, arrival_process, receivers in zip(
            self.routes, self._arrival_processes, self._receivers, strict=True
        ):
            phase, period = arrival_process.tick_phase, arrival_process.tick_period
            first = -(-(self._now - phase) // period)
            ticks = phase + period * np.arange(max(first, 0), -(-(until - phase) // period), dtype=np.int64)
            packets = np.empty((len(ticks), len(route.pairs)), np.int64)
            missing = np.empty(packets.shape, np.bool_)
            for arcs, receiver in receivers:
                received = receiver.receive(ticks)
                packets[:, arcs], missing[:, arcs] = (
                    received.packets,
                    received.missing & receiver.source.law.zero,
                )
            delivered.append(DeliveredPackets(packets, missing))
        self._now = until
        return tuple(delivered)


def _link_receivers(
    route: Route, arrival_process: ArrivalProcess, seed: int, run: int
) -> list[tuple[Integers, LinkReceiver]]:
    """Return a receiver for each channel law of a route, with the indices of its directed links."""
    pairs = []
    for index, law in enumerate(arrival_process.laws):
        arcs = np.flatnonzero(arrival_process.law_of == index)
        receiver = LinkReceiver(
            PacketSource(law, route.link, route.pairs[arcs], seed=seed, run=run),
            phase=arrival_process.phase,
            period=arrival_process.period,
            delay=int(arrival_process.nominal[arcs[0]]),
            quantum=arrival_process.quantum,
            newest=arrival_process.newest,
            least=arrival_process.least,
        )
        pairs.append((arcs, receiver))
    return pairs


def routes_of(
    model: Model, timings: Mapping[str, Fraction], comm_graph: CommunicationGraph, frame_s: Fraction
) -> tuple[Route, ...]:
    """Return the routes: one per unreliable link, per clock that receives from it, and per clock that sends.

    Parameters
    ----------
    model, timings, comm_graph
        As for `arrival_process_of`.
    frame_s
        The length of a frame in seconds.

    Raises
    ------
    ApcError
        E891 a group sets its own value for a link parameter; E892 too many directed peer pairs.
    """
    unreliable = [link for link in model.links if link.channel is not None]
    result = [_routes_over(model, timings, comm_graph, frame_s, link) for link in unreliable]
    return tuple(route for routes in result for route in routes)


def _routes_over(
    model: Model,
    timings: Mapping[str, Fraction],
    comm_graph: CommunicationGraph,
    frame_s: Fraction,
    link: Link,
) -> list[Route]:
    """Return the routes of a link: its directed links, grouped by the clocks of receivers and of packets."""
    peers = comm_graph.peers
    if link.graph.shape == "complete" and peers * (peers - 1) > MOST_ARCS:
        message = (
            f"{link.name} is unreliable; {peers} completely connected peers have "
            f"{peers * (peers - 1)} directed connections; the limit is {MOST_ARCS}"
        )
        raise ApcError(Diagnostic("E892", SourceLocation(model.origin.topology), message, fix="graph: ring"))
    peer_type_of = np.repeat([group.peer_type for group in model.groups], np.diff(comm_graph.starts))
    pairs, weights = comm_graph.arcs(link.name)
    order = np.lexsort((pairs[:, 0], pairs[:, 1]))  # receiver by receiver
    pairs, weights = pairs[order], weights[order]
    sends = np.array(
        [any(send.link == link.name for send in peer_type.sends) for peer_type in model.peer_types]
    )
    used: dict[tuple[str, str], tuple[Integers, Floats]] = {}
    for clock in model.clocks:
        receives = np.array([_receives(peer_type, link.name, clock.name) for peer_type in model.peer_types])
        arcs = sends[peer_type_of[pairs[:, 0]]] & receives[peer_type_of[pairs[:, 1]]]
        sent_by = _own_clocks(comm_graph, link, pairs)
        for name in sorted({*sent_by[arcs].tolist()}):
            of_clock = arcs & (sent_by == name)
            used[clock.name, name] = pairs[of_clock], weights[of_clock]
    groups = {pair for clock_pairs, _ in used.values() for pair in _group_pairs(comm_graph, clock_pairs)[0]}
    delays = {comm_graph.delay(link.name, *pair) for pair in groups}
    longest = max((channel_law(model, link, delay).longest for delay in delays), default=0.0)
    periods = {clock.name: timings[clock.period] for clock in model.clocks}
    return [
        Route(
            link=link.name,
            clock=clock,
            sent_by=sent_by,
            pairs=clock_pairs,
            weights=clock_weights,
            longest=longest,
            ticks=int(frame_s / periods[clock]),
            slots=int(frame_s / periods[sent_by or link.clock]),
            # A packet is received at most one tick after it arrives, and a clock ticks in every frame.
            frames=math.ceil(longest / float(frame_s)) + 1,
            zero=any(channel.on_loss == "zero" for channel in link.channels),
        )
        for (clock, sent_by), (clock_pairs, clock_weights) in used.items()
    ]


def _own_clocks(comm_graph: CommunicationGraph, link: Link, pairs: Integers) -> NDArray[np.str_]:
    """Return the own clock (M,) of each directed link, empty for that of the link."""
    groups, of_pair = _group_pairs(comm_graph, pairs)
    clocks = [link.own_clock(comm_graph.delay(link.name, *pair)) for pair in groups]
    return np.array(clocks, np.str_)[of_pair]


def _receives(peer_type: PeerType, link: str, clock: str) -> bool:
    """Return whether a clock of a peer type receives over a link."""
    partitions = [partition for partition in peer_type.clocks if partition.clock == clock]
    return any(receive.link == link for partition in partitions for receive in partition.receives)


def _group_pairs(comm_graph: CommunicationGraph, pairs: Integers) -> tuple[list[tuple[int, int]], Integers]:
    """Return the distinct (sender, receiver) pairs of groups, and the index (M,) of each pair of peers."""
    groups = np.searchsorted(comm_graph.starts, pairs, side="right") - 1
    count = len(comm_graph.groups)
    distinct, of_pair = np.unique(groups[:, 0] * count + groups[:, 1], return_inverse=True)
    return [divmod(item, count) for item in distinct.tolist()], of_pair


def _highest_rank(
    ticks: Integers, arcs: Integers, times: Integers, ranks: Integers, first: Integers
) -> Integers:
    """Return, for each tick and directed link (n, M), the highest rank of the events up to that tick.

    Parameters
    ----------
    ticks
        The ticks (n,), rising.
    arcs, times, ranks
        The events (K,): the index among the M directed links, the time (not later than the last tick), the
        rank.
    first
        The ranks (M,) at the beginning.
    """
    indices = np.full((len(ticks), len(first)), START, np.int64)
    indices[0] = first
    np.maximum.at(indices.reshape(-1), np.searchsorted(ticks, times) * len(first) + arcs, ranks)
    return np.maximum.accumulate(indices, axis=0)
