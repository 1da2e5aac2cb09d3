"""Every packet of a scene's unreliable links: which of them each tick sees, on each way from peer to peer.

Takes: a `Model` with its numbers, who hears whom, the frame and the quantum of its schedules, a
seed.
Gives: `Route`, `routes_of`; `ArrivalProcess`, `luck_of`; `Timetable`, `Listener`, `DeliveredPackets`,
`START`; `instant_of`.
Guarantees: without loss and jitter a tick sees the packet that `scheduling` says; a way is heard alike by all
clocks of a receiver; it does not matter how time is cut into pieces; what is remembered does not grow with
time.
Does not: carry values: reliable links are not in it, and cost nothing here.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.exchange import CommunicationGraph
from apc.memory import refuse_beyond
from apc.network.channel import ChannelLaw, PacketSource, channel_law

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

# Ways from peer to peer: of each some packets are on their way, and so many bytes are kept.
MOST_WAYS, WAY = 2_000_000, 200
PACKET = 100  # bytes of a packet on its way, with what NumPy copies

START = -1  # the "packet" before the first: the sender's start values

# Arrivals are told apart down to this part of a quantum; everything that happens at ticks happens at whole
# quanta. A delay of some whole quanta, written as a float of seconds, is then that number exactly.
FINENESS = 2**20
# No delay or frame is longer than so many quanta: integers of their parts would overflow.
LONGEST = 2**40


def instant_of(seconds: float, quantum: Fraction) -> Fraction:
    """Return when something happens that a float of seconds says, as finely as arrivals are told apart."""
    return round(Fraction(seconds) / quantum * FINENESS) * quantum / FINENESS


@dataclass(frozen=True, slots=True, eq=False)
class Route:
    """What is heard over one unreliable link at the ticks of one clock.

    `pairs` (M, 2) are the peers (sender, receiver), counted from 0, receiver by receiver, `weights` (M,) the
    graph's; `longest` is the link's longest time in seconds from a packet's sample to its arrival. A frame
    has so many `ticks` of the clock and `slots` of the link's; packets are kept for so many `frames`. `zero`
    says that the receiver's own value stands in for a missing one.
    """

    link: str
    clock: str
    pairs: Integers
    weights: Floats
    longest: float
    ticks: int
    slots: int
    frames: int
    zero: bool


@dataclass(frozen=True, slots=True, eq=False)
class DeliveredPackets:
    """What ticks see on M ways.

    `packets` (ticks, M) are the numbers of the packets in effect, counted from 0, `START` for the start
    values. `missing` (ticks, M) says where a packet is known to be missing: from the tick at which a lost
    packet should have been there, had it taken its nominal delay, until a packet that was sent after it is in
    effect.
    """

    packets: Integers
    missing: Flags


@dataclass(frozen=True, slots=True, eq=False)
class ArrivalProcess:
    """What chance does on the ways of a route, in numbers; times in quanta of `quantum` seconds.

    `law` is that of all ways but for their `delays` (M,), in seconds; `nominal` (M,) are the same in quanta.
    Packet k is sent at phase + k*period, tick k is at tick_phase + k*tick_period. `newest` as in `Listener`.
    """

    law: ChannelLaw
    delays: Floats
    nominal: Integers
    phase: int
    period: int
    tick_phase: int
    tick_period: int
    quantum: Fraction
    newest: bool

    def kept(self, route: Route) -> int:
        """Return how many packets of a way may be sent before the first of them is heard, or missed."""
        return route.slots * (self.latest(route) // (route.ticks * self.tick_period) + 3)

    def latest(self, route: Route) -> int:
        """Return the quanta within which a packet of a way has arrived, or is missed."""
        return math.ceil(max(route.longest, float(self.delays.max(initial=0.0))) / float(self.quantum)) + 1


def luck_of(
    system: Model,
    timings: Mapping[str, Fraction],
    exchange: CommunicationGraph,
    route: Route,
    quantum: Fraction,
) -> ArrivalProcess:
    """Return what chance does on the ways of a route.

    Parameters
    ----------
    system
        The compiled scene, with the numbers to use (see `overrides.apply`).
    timings
        Seconds by the name of the timing.
    exchange
        Who hears whom.
    route
        The route.
    quantum
        The time in seconds of which every period, phase and delay in use is a whole multiple.

    Raises
    ------
    ApcError
        E891 a group sets a number of the link for itself; E892 too many packets on their way, or times too
        long for so small a quantum.
    """
    link = exchange.links[route.link]
    assert link.channel is not None
    grids = {
        clock.name: (timings[clock.phase] / quantum, timings[clock.period] / quantum)
        for clock in system.clocks
    }
    groups, of_way = _groups(exchange, route.pairs)
    late = [timings[exchange.delay(link.name, *pair)] for pair in groups]
    luck = ArrivalProcess(
        law=channel_law(system, link, timings[link.delay]),
        delays=np.array([float(number) for number in late])[of_way],
        nominal=np.array([int(number / quantum) for number in late], np.int64)[of_way],
        phase=int(grids[link.clock][0]),
        period=int(grids[link.clock][1]),
        tick_phase=int(grids[route.clock][0]),
        tick_period=int(grids[route.clock][1]),
        quantum=quantum,
        newest=link.channel.reorder == "newest",
    )
    _check_luck(system, route, luck)
    return luck


def _check_luck(system: Model, route: Route, luck: ArrivalProcess) -> None:
    """Refuse what could not be followed: too many packets on their way, or too many quanta."""
    latest, ways = luck.latest(route), len(route.pairs)
    if max(latest, route.ticks * luck.tick_period) > LONGEST:
        what = (
            f"{route.link} is unreliable, and all its times are counted in parts of "
            f"{float(luck.quantum):.6g} s, of which periods, phases and delays are whole multiples: at most "
            f"{LONGEST} of them"
        )
        raise ApcError(
            Diagnostic(
                "E892", SourceLocation(system.origin.topology), what, hint="periods and delays in whole µs"
            )
        )
    packets = luck.kept(route) * ways
    what = f"{packets:,} packets kept on {ways:,} ways of {route.link}, which is unreliable,"
    hint = "a shorter delay or jitter, fewer peers, or graph: ring"
    refuse_beyond(WAY * ways + PACKET * packets, "E892", SourceLocation(system.origin.topology), what, hint)


class Listener:
    """What the receivers of some ways hear, tick by tick; time only goes forward."""

    def __init__(
        self, source: PacketSource, *, phase: int, period: int, delay: int, quantum: Fraction, newest: bool
    ) -> None:
        """Start before the first packet.

        Parameters
        ----------
        source
            The packets.
        phase, period
            Packet k of every way is sent at phase + k*period, in quanta.
        delay
            The nominal delay in quanta.
        quantum
            Seconds a quantum; all ticks are at whole ones.
        newest
            Whether the packet sent last is in effect, or else the one that arrived last (of several that
            arrive at once, the one sent last).
        """
        self.source = source
        self.phase = phase
        self.period = period
        self.delay = delay
        self.quantum = float(quantum)
        self.newest = newest
        self._effective = np.full(source.ways, START, np.int64)
        self._gap = np.full(source.ways, START, np.int64)  # the newest lost packets that should be there
        # Lost packets that should be there later: their ways and numbers.
        self._due = np.zeros((2, 0), np.int64)
        # On their way: ways, numbers, whole quanta from which they are seen, how much before they arrive.
        self._under_way = np.zeros((4, 0), np.int64)

    @property
    def remembered(self) -> int:
        """How many packets may yet come in effect, or be found missing, on all ways."""
        return self._under_way.shape[1] + self._due.shape[1]

    def hear(self, ticks: Integers) -> DeliveredPackets:
        """Return what the ticks (n,) see, in quanta, rising, all after those heard before."""
        if not len(ticks):
            nothing = (0, self.source.ways)
            return DeliveredPackets(np.zeros(nothing, np.int64), np.zeros(nothing, np.bool_))
        self._send_until(int(ticks[-1]))
        ways, numbers, seen, _ = self._under_way
        arrived = seen <= ticks[-1]
        packets = self._in_effect(ticks, self._under_way[:, arrived])
        missing = self._gaps(ticks) > packets
        self._effective = packets[-1].copy()
        keep = ~arrived & (numbers > self._effective[ways]) if self.newest else ~arrived
        self._under_way = self._under_way[:, keep]
        return DeliveredPackets(packets, missing)

    def _send_until(self, tick: int) -> None:
        """Send the packets up to a time; what is sent later can't have arrived."""
        first = self.source.taken
        count = max((tick - self.phase) // self.period + 1 - first, 0)
        delays = self.source.take(count) / self.quantum
        lost = ~(delays < LONGEST)
        fine = np.rint(np.where(lost, 0.0, delays) * FINENESS).astype(np.int64)
        ways, numbers = np.indices(delays.shape)
        numbers += first
        seen = self.phase + self.period * numbers - (-fine // FINENESS)
        before = -fine % FINENESS
        sent = np.stack([ways, numbers, seen, before])
        self._due = np.concatenate([self._due, sent[:2, lost]], axis=1)
        self._under_way = np.concatenate([self._under_way, sent[:, ~lost]], axis=1)

    def _in_effect(self, ticks: Integers, arrived: Integers) -> Integers:
        """Return the packets (n, M) sent last, or arrived last, of those that have arrived."""
        ways, numbers, seen, before = arrived
        if self.newest:
            return _highest(ticks, ways, seen, numbers, self._effective)
        order = np.lexsort((numbers, -before, seen))
        rank = np.arange(len(order))
        latest = _highest(ticks, ways[order], seen[order], rank, np.full(self.source.ways, -1))
        return np.where(latest < 0, self._effective, np.append(numbers[order], START)[latest])

    def _gaps(self, ticks: Integers) -> Integers:
        """Return the newest lost packets (n, M) that should be there."""
        ways, numbers = self._due
        when = self.phase + self.period * numbers + self.delay
        due = when <= ticks[-1]
        gaps = _highest(ticks, ways[due], when[due], numbers[due], self._gap)
        self._due, self._gap = self._due[:, ~due], gaps[-1].copy()
        return gaps


class Timetable:
    """The packets of all unreliable links of a scene, from time 0 on; time only goes forward."""

    def __init__(
        self, routes: Sequence[Route], lucks: Sequence[ArrivalProcess], *, seed: int = 0, run: int = 0
    ) -> None:
        """Start at time 0.

        Parameters
        ----------
        routes, lucks
            The unreliable links (see `routes_of`), and what chance does on each (see `luck_of`).
        seed, run
            The experiment's seed, and which run of it this is.
        """
        self.routes, self._lucks = tuple(routes), tuple(lucks)
        self._listeners = [_listen(route, luck, seed, run) for route, luck in zip(routes, lucks, strict=True)]
        self._now = 0

    def take(self, until: int) -> tuple[DeliveredPackets, ...]:
        """Return what each route's ticks see, from where the last call ended to before `until`, in quanta."""
        seen = []
        for route, luck, listeners in zip(self.routes, self._lucks, self._listeners, strict=True):
            phase, period = luck.tick_phase, luck.tick_period
            first = -(-(self._now - phase) // period)
            ticks = phase + period * np.arange(max(first, 0), -(-(until - phase) // period), dtype=np.int64)
            packets = np.empty((len(ticks), len(route.pairs)), np.int64)
            missing = np.empty(packets.shape, np.bool_)
            for ways, listener in listeners:
                heard = listener.hear(ticks)
                packets[:, ways], missing[:, ways] = heard.packets, heard.missing
            seen.append(DeliveredPackets(packets, missing))
        self._now = until
        return tuple(seen)


def _listen(route: Route, luck: ArrivalProcess, seed: int, run: int) -> list[tuple[Integers, Listener]]:
    """Return a listener for the ways of each delay of a route, with their places in it."""
    pairs = []
    for nominal in np.unique(luck.nominal).tolist():
        ways = np.flatnonzero(luck.nominal == nominal)
        law = replace(luck.law, delay=float(luck.delays[ways[0]]))
        listener = Listener(
            PacketSource(law, route.link, route.pairs[ways], seed=seed, run=run),
            phase=luck.phase,
            period=luck.period,
            delay=nominal,
            quantum=luck.quantum,
            newest=luck.newest,
        )
        pairs.append((ways, listener))
    return pairs


def routes_of(
    system: Model, timings: Mapping[str, Fraction], exchange: CommunicationGraph, frame_s: Fraction
) -> tuple[Route, ...]:
    """Return what is heard over unreliable links: a route for each of them and each clock that hears it.

    Parameters
    ----------
    system, timings, exchange
        As `luck_of` has them.
    frame_s
        The length of a frame in seconds.

    Raises
    ------
    ApcError
        E891 a group sets a number of a link for itself; E892 too many ways from peer to peer.
    """
    unreliable = [link for link in system.links if link.channel is not None]
    result = [_routes_over(system, timings, exchange, frame_s, link) for link in unreliable]
    return tuple(route for routes in result for route in routes)


def _routes_over(
    system: Model,
    timings: Mapping[str, Fraction],
    exchange: CommunicationGraph,
    frame_s: Fraction,
    link: Link,
) -> list[Route]:
    """Return a link's routes: the ways whose receivers hear it at the ticks of each clock."""
    peers, channel = exchange.peers, link.channel
    assert channel is not None, f"{link.name} is reliable"
    if link.graph.shape == "complete" and peers * (peers - 1) > MOST_WAYS:
        what = (
            f"{link.name} is unreliable, and {peers} peers that all hear each other are "
            f"{peers * (peers - 1)} ways with packets of their own; at most {MOST_WAYS} can be followed"
        )
        raise ApcError(Diagnostic("E892", SourceLocation(system.origin.topology), what, hint="graph: ring"))
    kind_of = np.repeat([group.kind for group in system.groups], np.diff(exchange.starts))
    pairs, weights = exchange.arcs(link.name)
    order = np.lexsort((pairs[:, 0], pairs[:, 1]))  # receiver by receiver: what each hears stands together
    pairs, weights = pairs[order], weights[order]
    sends = np.array([any(send.link == link.name for send in kind.sends) for kind in system.kinds])
    used = {}
    for clock in system.clocks:
        hears = np.array([_hears(kind, link.name, clock.name) for kind in system.kinds])
        ways = sends[kind_of[pairs[:, 0]]] & hears[kind_of[pairs[:, 1]]]
        if ways.any():
            used[clock.name] = pairs[ways], weights[ways]
    groups = {pair for some, _ in used.values() for pair in _groups(exchange, some)[0]}
    delays = {timings[exchange.delay(link.name, *pair)] for pair in groups}
    longest = max((channel_law(system, link, delay).longest for delay in delays), default=0.0)
    periods = {clock.name: timings[clock.period] for clock in system.clocks}
    return [
        Route(
            link=link.name,
            clock=clock,
            pairs=some,
            weights=own,
            longest=longest,
            ticks=int(frame_s / periods[clock]),
            slots=int(frame_s / periods[link.clock]),
            # A packet is first heard at most one tick after it arrives, and a clock ticks in every frame.
            frames=math.ceil(longest / float(frame_s)) + 1,
            zero=channel.on_loss == "zero",
        )
        for clock, (some, own) in used.items()
    ]


def _hears(kind: PeerType, link: str, clock: str) -> bool:
    ticking = [partition for partition in kind.clocks if partition.clock == clock]
    return any(receive.link == link for partition in ticking for receive in partition.receives)


def _groups(exchange: CommunicationGraph, pairs: Integers) -> tuple[list[tuple[int, int]], Integers]:
    """Return the different pairs of groups of pairs of peers, and which of them each pair (M,) is."""
    groups = np.searchsorted(exchange.starts, pairs, side="right") - 1
    count = len(exchange.groups)
    distinct, of_pair = np.unique(groups[:, 0] * count + groups[:, 1], return_inverse=True)
    return [divmod(item, count) for item in distinct.tolist()], of_pair


def _highest(ticks: Integers, ways: Integers, when: Integers, ranks: Integers, first: Integers) -> Integers:
    """Return, for each tick and way, the highest rank of what has happened by then.

    Parameters
    ----------
    ticks
        The ticks (n,), rising.
    ways, when, ranks
        What happened (K,): on which of the M ways, when (no later than the last tick), of what rank.
    first
        The ranks (M,) at the beginning.
    """
    places = np.full((len(ticks), len(first)), START, np.int64)
    places[0] = first
    np.maximum.at(places.reshape(-1), np.searchsorted(ticks, when) * len(first) + ways, ranks)
    return np.maximum.accumulate(places, axis=0)
