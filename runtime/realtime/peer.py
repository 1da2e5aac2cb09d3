"""The real-time loop of one peer: clock ticks, reception of packets, sending.

Takes: a model, the peer's name, addresses, a duration. Gives: `PeerLoop`, `live_topology`, `traced`,
`number_of`; `StoppedError`.
Guarantees: every tick is executed once, in order, even if late. A tick receives the packets that had arrived
at its execution. A peer that starts late or again joins at the present instant. Peers that stop sending are
held or omitted as the link specifies. Peers of `joins` and `leaves` are absent before and after.
Does not: simulate other peers, or synchronize host clocks. The offset of two clocks is measured at connection
(error: half the shortest round trip); later drift appears in the delays. A change of a host's wall-clock time
has no effect: the clock used is monotonic.

The peer with the lowest number announces time 0 once all peers with known addresses are connected, unless one
of them already has it. The nonce of the announcing peer is the session number. The ticks of an instant are
executed at its end, by the simulation's program split at every instant; the peer's device is integrated as in
the simulation.

Each period between joins and leaves has its own engine. A peer also sends to the peers that join later. A
peer that joins has start values. Each of its states in `PeerType.joining` is the mean of the newest received
values of the peers of its group that stay. The others hold the same values until its first packet arrives.
"""

from __future__ import annotations

import heapq
import math
import select
import socket
from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from multiprocessing.connection import Connection

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Channel, Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation, nearest
from apc.compiler.wording import counted, cut
from apc.network.channel import PacketSource, channel_law
from apc.network.packet_schedule import START, DeliveredPackets
from apc.parameter_values.parameters import resolve
from apc.realtime.device import DeviceFunction, ExternalDevice
from apc.realtime.packets import DROPPED, Address, Data, Hello, HelloReply, Post
from apc.realtime.present_peers import Period, means_at_joins, periods_of
from apc.realtime.process_priority import now
from apc.simulation.interpreted_engine import InterpretedEngine
from apc.simulation.output_blocks import forces_in_time, unsolved
from apc.simulation.population import instants_within
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.timing.communication_graph import CommunicationGraph, build_comm_graph

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

NANO = 10**9
# Seconds after which a missing packet counts as lost, or this multiple of its nominal delay if longer.
GIVEN_UP, TIMES = 1, 4
HELLO_PERIOD = NANO // 20  # from one hello to the next
# The number of round trips to measure the offset of a clock, by the shortest, and the time between two.
TRIPS, BETWEEN = 10, NANO // 200
HEAD_START = NANO // 2  # between the announcement of time 0 and time 0
LARGEST = 1 << 16  # bytes of a datagram
AHEAD = 1024  # packets whose random numbers are drawn in one batch
# Datagrams read between two readings of the clock, and the total that a late tick reads: some tenths of a
# millisecond at any packet rate.
AT_ONCE = 32


def live_topology(model: Model) -> Model:
    """Return a model whose links receive packets as they arrive on the real network."""
    timings = {timing.name: timing.value for timing in model.timings}
    largest_delays = [max(timings[text] for text in link.delays) for link in model.links]
    given_up = [[float(max(Fraction(GIVEN_UP), TIMES * delay))] for delay in largest_delays]
    links = tuple(map(traced, model.links, given_up))
    return replace(model, links=links, within=())


def traced(link: Link, delays: Sequence[float] | Floats) -> Link:
    """Return a link with recorded delays in seconds; its treatment of losses is unchanged."""
    reliable, trace = Channel(None, None, "uniform", "newest", "hold", None), np.asarray(delays)

    def recorded(channel: Channel) -> Channel:
        """Return a channel with the recorded delays."""
        return replace(channel, loss=None, jitter=None, distribution="uniform", trace=trace)

    pairs = tuple(replace(pair, channel=pair.channel and recorded(pair.channel)) for pair in link.pairs)
    return replace(link, channel=recorded(link.channel or reliable), pairs=pairs)


class StoppedError(RuntimeError):
    """The loop has to end: a stop was requested, or its device failed."""


class PeerLoop:
    """A peer's loop: its clock, its socket, and its part of the model."""

    def __init__(
        self,
        model: Model,
        peer: str,
        listening: socket.socket,
        addresses: Mapping[str, Address],
        *,
        digest: bytes,
        duration: Fraction,
        secret: bytes = b"",
        emulate: bool = False,
        seed: int | None = None,
        stop: Connection | None = None,
        device: DeviceFunction | None = None,
    ) -> None:
        """Prepare the loop.

        Parameters
        ----------
        model
            The model, with its parameter values.
        peer
            The peer's name, such as "left[1]".
        listening
            A bound UDP socket.
        addresses
            The addresses of the other peers, by name.
        digest, secret
            As for `Post`.
        duration
            The duration in seconds.
        emulate
            Whether the sender delays and drops packets according to the model's links.
        seed
            The seed of the losses; by default that of the topology's experiment.
        stop
            A file descriptor that becomes readable to request the end.
        device
            The external device that replaces the peer's simulated one.

        Raises
        ------
        ApcError
            E970 there is no such peer, E971 one that it sends to or receives from has no address; those of
            `prepare` and `means_at_joins`.
        """
        self.model, self.name = model, peer
        self.comm_graph = build_comm_graph(model, resolve(model).timings)
        self.local = number_of(self.comm_graph, peer, "--peer")
        self.others = {
            number_of(self.comm_graph, text, "--to"): address for text, address in addresses.items()
        }
        settings = Settings(duration, jit=False, seed=seed)
        self.simulation = prepare(live_topology(model), settings, signals=[f"{peer}.*"], live=True)
        self.means = means_at_joins(model)
        self.frame_ns = int(self.simulation.frame * self.simulation.quantum * NANO)
        self.frames = -(-int(duration * NANO) // self.frame_ns)
        self.post = Post(
            self.local, digest, secret, {address: number for number, address in self.others.items()}
        )
        self.socket = listening
        self.socket.setblocking(False)
        self.begins = 0  # the start of the model by this host's clock; 0 while unknown
        self.session = 0  # the number of the common session of all peers; 0 while unknown
        # For each other peer the shortest round trip, and the lead of its clock.
        self.offsets: dict[int, tuple[int, int]] = {}
        self.began: HelloReply | None = None  # the first reply with the start of the model
        self.last_hello = 0  # the time of the last hello
        self.stopped = False
        self.trouble: ApcError | None = None  # the error that ended the loop
        self.stop = stop
        self.watched: list[socket.socket | Connection] = [listening, *([stop] if stop else [])]
        self.rows: list[Floats] = []
        self.routes = self.simulation.population.exchange_program.routes
        # For each route, the indices of the incoming directed links of this peer.
        self.mine = [np.flatnonzero(route.pairs[:, 1] == self.local) for route in self.routes]
        self.players: list[_SinglePeer] = []  # one for each period
        self.stage = 0  # the index of the present one
        for period in periods_of(self.simulation, self.local, self.frames):
            self.players.append(_SinglePeer(self, period, device, emulate=emulate))
        for index, player in enumerate(self.players):
            player.send_to_joining(self.players[index + 1 :])
        self.first = self.player.period.first  # the frame in which this peer joins
        self._check_addresses()

    @property
    def player(self) -> _SinglePeer:
        """The engine of the present period."""
        return self.players[self.stage]

    def _check_addresses(self) -> None:
        """Raise ApcError E971 for missing, superfluous or equal addresses."""
        pairs = {tuple(pair) for route in self.routes for pair in route.pairs.tolist()}
        needed = {item for pair in pairs if self.local in pair for item in pair} - {self.local}
        unknown = [self.comm_graph.peer_name(other) for other in sorted(needed - set(self.others))][:4]
        wrong = (
            (
                not needed,
                f"{self.name} exchanges no packets with another peer",
                "apc simulate",
                "",
            ),
            (
                self.local in self.others,
                f"{self.name} is the local peer; --to gives the addresses of the others",
                "",
                f"use --listen HOST:PORT for {self.name}",
            ),
            (
                len(set(self.others.values())) < len(self.others),
                "two peers have the same address; packets are identified by their source address",
                "",
                "use a separate port for each",
            ),
            (
                bool(unknown),
                f"no address given for {', '.join(unknown)}, connected to {self.name}",
                " ".join(f'--to "{text}=HOST:PORT"' for text in unknown),
                "",
            ),
        )
        for is_wrong, message, fix, advice in wrong:
            if is_wrong:
                location = SourceLocation("--to" if needed else self.model.name)
                raise ApcError(Diagnostic("E971", location, message, fix=fix, advice=advice))

    # ---- connection

    def meet(self, patience: float) -> None:
        """Connect to the other peers and determine the start time of the session.

        Raises
        ------
        ApcError
            E972 no announcement arrives within the time limit.
        StoppedError
            A stop was requested before.
        """
        end, leads = now() + int(patience * NANO), self.local < min(self.others)
        for player in self.players:
            player.warm_up()
        while not self.session:
            self._send_hellos(self.others)
            self.take_in(now() + HELLO_PERIOD)
            if self.began is not None:
                for _ in range(TRIPS):
                    self._send_hellos(self.others)
                    self.take_in(now() + BETWEEN)
                self.begins = self.began.begins - self.offsets[self.began.sender][1]
                self.session = self.began.session
            elif leads and set(self.others) == set(self.post.nonces):
                self.begins, self.session = now() + HEAD_START, self.post.nonce
            elif now() > end:
                raise self._no_answer(patience)
        if now() > self.begins:  # a late or restarted peer joins in the frame after the next
            self.first = max(self.first, (now() - self.begins) // self.frame_ns + 2)
            while self.player.period.until <= self.first and self.player is not self.players[-1]:
                self.stage += 1
            self.player.instant = self.first * self.frame_ns

    def _send_hellos(self, others: Iterable[int]) -> None:
        """Send a hello to other peers."""
        self.last_hello = now()
        for other in others:
            self._send(self.post.hello(now(), other), self.others[other])

    def _no_answer(self, patience: float) -> ApcError:
        """Return error E972 for peers that did not reply in time."""
        missing = sorted(set(self.others) - set(self.post.nonces)) or sorted(self.others)[:1]
        names = ", ".join(self.comm_graph.peer_name(number) for number in missing)
        dropped = self.post.dropped.items()
        text = "; ".join(f"{counted(count, 'datagram')} dropped: {DROPPED[why]}" for why, count in dropped)
        message = f"no start time received from {names} within {patience:g} s" + (text and f" ({text})")
        advice = "use the same FILE, --set and --secret-file at every peer, and start all within --wait"
        return ApcError(Diagnostic("E972", SourceLocation(self.name), message, advice=advice))

    # ---- running

    def run(self) -> None:
        """Run until the end, the leave, a stop request, or a failure of the device or an equation."""
        first = self.first
        for player in self.players[self.stage :]:
            simulation, period = player.period.simulation, player.period
            if period.first > self.first:
                player.continue_from(self.player)
                self.stage += 1
            while first < period.until:
                count = min(simulation.length, period.until - first)
                forces = forces_in_time(replace(simulation, length=count), first)
                result = player.advance(first, count, forces)
                self.rows.append(result.rows[: result.frames * len(simulation.sample_times)].copy())
                first += result.frames
                if result.frames < count:
                    if not (self.stopped or self.trouble):
                        self.trouble = unsolved(simulation, first)
                    return

    def wait(self, instant: int) -> int:
        """Receive packets until an instant of the model, in nanoseconds.

        Return the lateness in nanoseconds.
        """
        if not self.begins:  # warming up
            return 0
        self.take_in(self.begins + instant)
        return now() - self.begins - instant

    # ---- the network

    def take_in(self, until: int) -> None:
        """Receive packets, and send those due, until an instant of this host's clock."""
        held = self.player.held_back
        while True:
            while held and held[0][0] <= now():
                _, _, datagram, address = heapq.heappop(held)
                self._send(datagram, address)
            self._read()
            if self.post.unmet and now() >= self.last_hello + HELLO_PERIOD:
                self._send_hellos(self.post.unmet)
                self.post.unmet.clear()
            left = min(until, held[0][0] if held else until) - now()
            ready, _, _ = select.select(self.watched, [], [], max(left, 0) / NANO)
            if self.stop in ready:
                self.stopped = True
                raise StoppedError
            if now() >= until:
                return

    def _read(self) -> None:
        """Read the datagrams that have arrived, at most `AT_ONCE`."""
        for _ in range(AT_ONCE):
            try:
                datagram, address = self.socket.recvfrom(LARGEST)
            except BlockingIOError:
                return
            except OSError:  # earlier packets had no receiver; Linux reports that here
                continue
            came = now()
            match self.post.read(datagram, address[:2]):
                case Data() as packet:
                    self._receiver(packet).receive(packet, came - self.begins)
                case Hello() as hello:
                    answer = self.post.answer(now(), hello, came, self.begins, self.session)
                    self._send(answer, address)
                case HelloReply() as answer:
                    self._synchronize(answer, came)

    def _receiver(self, packet: Data) -> _SinglePeer:
        """Return the engine of the first period, from the present one on, in which a packet is received."""
        receivers = (player for player in self.players[self.stage :] if packet.sender in player.column_of)
        return next(receivers, self.player)

    def _synchronize(self, answer: HelloReply, came: int) -> None:
        """Determine another peer's clock offset, and the start of the model, from a reply (RFC 5905,
        section 8).
        """
        trip = (came - answer.requested) - (answer.time - answer.came)
        ahead = ((answer.came - answer.requested) + (answer.time - came)) // 2
        self.offsets[answer.sender] = min(self.offsets.get(answer.sender, (trip, ahead)), (trip, ahead))
        if answer.session and self.began is None:
            self.began = answer

    def _send(self, datagram: bytes, address: Address) -> None:
        """Send a datagram; count it as dropped if the system does not send it."""
        try:
            self.socket.sendto(datagram, address)
        except OSError:  # no receiver or no buffer: the packet is lost
            self.post.drop("not sent")


class _SinglePeer(InterpretedEngine):
    """One peer in a period, executed instant by instant; the other peers' packets come from the network.

    `log` has (due, late, took) of each instant, `arrivals` (link, sender, count, sent, arrived) of each
    packet, all in nanoseconds of the session; `observed`, per route, has the packets in effect at its ticks
    on the peer's incoming links.
    """

    def __init__(
        self, loop: PeerLoop, period: Period, device: DeviceFunction | None, *, emulate: bool
    ) -> None:
        simulation, population = period.simulation, period.simulation.population
        self.loop, self.period, self.routes = loop, period, population.exchange_program.routes
        self.member = next(g for g, member in enumerate(population.members) if period.local in member.peers)
        columns = population.exchange_program.column_of[: len(period.peers)].tolist()
        self.column_of = dict(zip(period.peers.tolist(), columns, strict=True))  # by the number of a peer
        super().__init__(population, None, moving=(self.member,))
        self.quantum_ns = simulation.quantum * NANO
        schedules = [member.program.schedule for member in population.members]
        self.begin_at = [0, *(int(number * self.quantum_ns) for number in instants_within(schedules))]
        self.links = [
            _LinkState(loop, period, index, clock)
            for index, link in enumerate(loop.model.links)
            for clock in link.clocks
        ]
        self.link_of = {(link.location, sender): link for link in self.links for sender in link.arcs}
        self.newest = [np.full(len(route.pairs), START, np.int64) for route in self.routes]
        self.observed: list[list[tuple[Integers, Flags]]] = [[] for _ in self.routes]
        self.network = _EmulatedNetwork(loop) if emulate else None
        member = population.members[self.member]
        self.outside = ExternalDevice(loop.model, member, device) if device else None
        self.ahead: list[
            tuple[int, int, Data]
        ] = []  # packets not yet received by a tick, by sampling instant
        self.held_back: list[tuple[int, int, bytes, Address]] = []
        self.log: list[tuple[int, int, int]] = []
        self.arrivals: list[tuple[int, int, int, int, int]] = []
        self.sent: dict[int, Counter[int]] = defaultdict(Counter)  # packets by link and receiver
        self.instant = period.first * loop.frame_ns
        if loop.players:  # the record of all periods is one
            before = loop.players[0]
            self.observed, self.network, self.held_back = before.observed, before.network, before.held_back
            self.log, self.arrivals, self.sent = before.log, before.arrivals, before.sent
            self.ahead = before.ahead
            for link, other in zip(self.links, before.links, strict=True):
                link.counts = other.counts

    def warm_up(self) -> None:
        """Execute a frame whose packets have no receiver, so that loading and compiling precede the run."""
        self.advance(0, 1, forces_in_time(replace(self.period.simulation, length=1), 0))
        self.begin(0)
        self.log.clear()
        for packets in self.observed:
            packets.clear()
        self.instant = self.period.first * self.loop.frame_ns

    # ---- joins and leaves

    def send_to_joining(self, later: Sequence[_SinglePeer]) -> None:
        """Send to the peers that join in a later period, too."""
        for player in later:
            for link, later_link in zip(self.links, player.links, strict=True):
                link.receivers |= later_link.receivers

    def _join(self) -> None:
        """Set the means at the joining peers, in the local states and in the held values."""
        self._take_arrived()
        period, groups, program = self.period, self.period.groups, self.population.exchange_program
        own = self.carries[self.member]
        for index, (route, held) in enumerate(zip(self.routes, self.held, strict=True)):
            self._deliver(index, self.newest[index].copy(), np.zeros(len(route.pairs), np.bool_))
            mine = np.flatnonzero(route.pairs[:, 1] == period.local)
            senders = route.pairs[mine, 0]
            known = (self.newest[index][mine] != START) & ~np.isin(senders, period.joined)
            for row, keys in enumerate(program.channels[index]):
                sent = program.keys[keys[0]]
                for peer in period.joined:
                    state = self.loop.means[groups[peer]].get((sent.link, sent.channel))
                    values = held[row, mine[known & (groups[senders] == groups[peer])]]
                    if state is None or not len(values):
                        continue
                    if peer == period.local:
                        own[state] = values.mean()
                    elif groups[peer] == groups[period.local]:
                        values = np.append(values, own[state])
                    held[row, mine[senders == peer]] = values.mean()

    def continue_from(self, before: _SinglePeer) -> None:
        """Take over the values of the peers that stay, and the packets on the links between them."""
        for number in self.column_of.keys() & before.column_of.keys():
            self.packets[:, :, self.column_of[number]] = before.packets[:, :, before.column_of[number]]
        self.carries[self.member][:] = before.carries[before.member]
        if self.outside and before.outside:
            self.outside.before = before.outside.before
        for route, links in enumerate(self.period.links):
            _, old, new = np.intersect1d(before.period.links[route], links, return_indices=True)
            for name in ("held", "effective", "newest"):
                getattr(self, name)[route][..., new] = getattr(before, name)[route][..., old]

    # ---- ticks

    def _segment(
        self,
        number: int,
        index: int,
        observed: tuple[DeliveredPackets, ...],
        rows: Floats,
        pushes: Sequence[Floats | None],
    ) -> None:
        """Wait for the instant of a segment, execute the segment, and send its packets at its end."""
        instant = number * self.loop.frame_ns + self.begin_at[index]
        late, begin = self.loop.wait(instant), now()
        self.instant = instant
        if index == 0 and number == self.period.first and len(self.period.joined):
            self._join()
        outside = self.outside if self.loop.begins else None
        if outside and (index == 0 or self.begin_at[index] > self.begin_at[index - 1]):
            self._call_device(outside.measure, instant / NANO, self.carries[self.member])
        super()._segment(number, index, observed, rows, pushes)
        if outside and index:  # segment 0 has sends only, no ticks
            self._apply_force(outside)
        self._send_packets(number, index)
        took = now() - begin
        if self.log and self.log[-1][0] == instant:  # the sends at the start of a frame, and its first tick
            _, late, before = self.log.pop()
            took += before
        self.log.append((instant, late, took))

    def _call_device(self, function: Callable[..., None], *arguments: object) -> None:
        """Call the external device; its failure ends the loop, and the record is kept."""
        try:
            function(*arguments)
        except ApcError as error:
            self.loop.trouble = error
            raise StoppedError from None

    def _apply_force(self, outside: ExternalDevice) -> None:
        """Pass the force from this instant on to the external device."""
        layout = self.population.members[self.member].program.layout
        carry = self.carries[self.member][:, 0]
        self._call_device(outside.push, self.instant / NANO, carry[: layout.states], carry[layout.held])

    def _packets_at_tick(
        self, index: int, tick: int, observed: tuple[DeliveredPackets, ...]
    ) -> tuple[Integers, Flags]:
        """Return the packets in effect, and the detected losses, of a route at a tick.

        A late peer does not receive packets sampled after its present instant.
        """
        self._take_arrived()
        newest, arrival_process = self.newest[index], self.period.simulation.arrival_processes[index]
        instant = int(self.instant // self.quantum_ns)
        due = (instant - arrival_process.nominal - arrival_process.phase) // arrival_process.period
        missing = (newest < due) & (due >= 0) & arrival_process.zero
        mine, pairs = self.loop.mine[index], self.loop.routes[index].pairs  # of all peers
        recorded, lost = np.full(len(pairs), START, np.int64), np.zeros(len(pairs), np.bool_)
        recorded[self.period.links[index]], lost[self.period.links[index]] = newest, missing
        self.observed[index].append((recorded[mine], lost[mine]))
        return newest.copy(), missing

    def _take_arrived(self) -> None:
        """Take the packets sampled until the present instant into effect."""
        while self.ahead and self.ahead[0][0] <= self.instant:
            _, _, packet = heapq.heappop(self.ahead)
            link = self.link_of.get((packet.link, packet.sender))
            if link is None:  # the sender has left
                continue
            for route_index, arc in link.arcs[packet.sender]:
                last = self.newest[route_index][arc]
                self.newest[route_index][arc] = max(last, packet.count) if link.newest else packet.count

    def _send_packets(self, number: int, index: int) -> None:
        """Send the packets of a segment, each at its instant or, if emulated, at its arrival time."""
        loop, member = self.loop, self.population.members[self.member]
        sent = member.program.schedule.sent
        slots = {
            (sent[row].link, sent[row].clock, sent[row].slot) for row in member.program.segments[index].sent
        }
        for name, clock, slot in sorted(slots):
            link = next(link for link in self.links if (link.name, link.own_clock) == (name, clock))
            count = number * link.slots + slot
            keys = [link.keys[channel, slot] for channel in link.channels_of(loop.local)]
            column = self.column_of[loop.local]
            values = tuple(
                self.packets[number % self.population.exchange_program.ring, keys, column].tolist()
            )
            instant = link.instant(count)
            for other in sorted(link.receivers) if loop.begins else ():  # no warm-up packets
                delay = self.network.delay(link, other, count) if self.network else 0
                self.sent[link.location][other] += 1
                if delay is not None:
                    due = loop.begins + instant + delay
                    datagram = loop.post.data(due, other, link.location, count, values)
                    if datagram is None:
                        loop.post.drop("not sent")
                        continue
                    heapq.heappush(self.held_back, (due, len(self.log), datagram, loop.others[other]))

    def receive(self, packet: Data, came: int) -> None:
        """Store a packet that arrived at an instant of the session, unless its contents are invalid."""
        link = self.link_of.get((packet.link, packet.sender))
        if link is None:
            absent = self.loop.simulation.presence and packet.link < len(self.loop.model.links)
            self.loop.post.drop("absent" if absent else "malformed")
            return
        if why := self._drop_reason(packet, came, link):
            self.loop.post.drop(why)
            return
        exchange_program, (frame, slot) = self.population.exchange_program, divmod(packet.count, link.slots)
        link.counts.setdefault(packet.sender, set()).add(packet.count)
        keys = [link.keys[channel, slot] for channel in link.channels_of(packet.sender)]
        self.packets[frame % exchange_program.ring, keys, self.column_of[packet.sender]] = packet.values
        heapq.heappush(self.ahead, (link.instant(packet.count), len(self.arrivals), packet))
        self.arrivals.append((link.location, packet.sender, packet.count, link.instant(packet.count), came))

    def _drop_reason(self, packet: Data, came: int, link: _LinkState) -> str:
        """Return the reason for dropping a packet, "" if it is valid."""
        if len(packet.values) != len(link.channels_of(packet.sender)):
            return "malformed"
        if not self.loop.begins:
            return "joining"
        frame, frame_now = packet.count // link.slots, came // self.loop.frame_ns
        # An early packet may overwrite the oldest stored frame.
        stored = self.population.exchange_program.ring - 3
        if frame < frame_now - stored:
            return "late"
        # A late peer may still need packets that a newer one would overwrite.
        if frame > min(frame_now + 1, self.instant // self.loop.frame_ns + stored - 1):
            return "early"
        return "duplicate" if packet.count in link.counts.get(packet.sender, ()) else ""


class _LinkState:
    """The data of a link's packets that one clock sends, at one peer, in a period.

    `location` is the index of the link, `name` its name, `own_clock` the clock of pairs of groups, empty for
    that of the link; `slots` is the number of packets per frame; `receivers` are the peers that receive from
    this peer. `channels` are the channels that each peer sends over the link, in the order of a packet's
    values, and `keys` their storage keys. `arcs` are the routes and directed links of each sender, `counts`
    the numbers of the packets received from each sender. Peers are numbered among all peers.
    """

    def __init__(self, loop: PeerLoop, period: Period, index: int, clock_name: str) -> None:
        population, peers = period.simulation.population, period.peers
        self.location, self.name = index, loop.model.links[index].name
        link, timings = loop.model.links[index], resolve(loop.model).timings
        self.own_clock = "" if clock_name == link.clock else clock_name
        stream = self.name, self.own_clock
        clock = next(clock for clock in loop.model.clocks if clock.name == clock_name)
        self.phase, self.period = (timings[text] * NANO for text in (clock.phase, clock.period))
        self.newest = link.channel is None or link.channel.reorder == "newest"
        self.slots = int(loop.simulation.frame * loop.simulation.quantum * NANO / self.period)
        self.channels: dict[int, list[str]] = {}
        for member in population.members:
            samples = member.program.schedule.sent
            sent = sorted({sent.channel for sent in samples if (sent.link, sent.clock) == stream})
            self.channels |= dict.fromkeys(peers[member.peers].tolist(), sent)
        rows = enumerate(population.exchange_program.keys)
        self.keys = {
            (sent.channel, sent.slot): row for row, sent in rows if (sent.link, sent.clock) == stream
        }
        self.receivers: set[int] = set()
        self.arcs: dict[int, list[tuple[int, int]]] = {}
        for route_index, route in enumerate(population.exchange_program.routes):
            pairs = peers[route.pairs].tolist() if (route.link, route.sent_by) == stream else ()
            for arc, (sender, receiver) in enumerate(pairs):
                if sender == loop.local:
                    self.receivers.add(receiver)
                if receiver == loop.local:
                    self.arcs.setdefault(sender, []).append((route_index, arc))
        self.counts: dict[int, set[int]] = {}

    def channels_of(self, peer: int) -> list[str]:
        """Return the channels that a peer sends over the link, in the order of a packet's values."""
        return self.channels[peer]

    def instant(self, count: int) -> int:
        """Return the sampling time of a packet, in nanoseconds of the model."""
        return int(self.phase + count * self.period)


class _EmulatedNetwork:
    """Emulation of the links in the topology: the delay and the loss of each packet."""

    def __init__(self, loop: PeerLoop) -> None:
        self.loop = loop
        self.timings = resolve(loop.model).timings
        self.delays: dict[tuple[int, int], Iterator[tuple[int, float]]] = {}

    def delay(self, link: _LinkState, other: int, count: int) -> int | None:
        """Return the delay of a packet in nanoseconds, None if lost; the counts of a link must increase."""
        key = link.location, other
        if key not in self.delays:
            self.delays[key] = enumerate(_packet_delays(self._source(link, other)))
        value = next(delay for number, delay in self.delays[key] if number == count)
        return None if math.isinf(value) else int(value * NANO)

    def _source(self, link: _LinkState, receiver: int) -> PacketSource:
        """Return the random delays and losses of the packets from this peer to a receiver over a link.

        A link without a declared channel has its nominal delay and no losses.
        """
        loop, comm_graph = self.loop, self.loop.comm_graph
        arc, declared_link = (loop.local, receiver), loop.model.links[link.location]
        sender_group, receiver_group = map(comm_graph.group_of, arc)
        delay = comm_graph.delay(link.name, sender_group, receiver_group)
        law = channel_law(
            loop.model,
            declared_link if declared_link.channel else traced(declared_link, [float(self.timings[delay])]),
            delay,
        )
        return PacketSource(law, link.name, [arc], seed=loop.simulation.seed)


def _packet_delays(source: PacketSource) -> Iterator[float]:
    """Yield the delays of a directed link's packets, in seconds."""
    while True:
        yield from source.take(AHEAD)[0].tolist()


def number_of(comm_graph: CommunicationGraph, name: str, option: str) -> int:
    """Return the number of a peer with a name such as `left[1]`, as given to an option.

    Parameters
    ----------
    comm_graph
        The peers of the model.
    name, option
        The name of the peer, and the option for messages.

    Raises
    ------
    ApcError
        E970 there is no such peer.
    """
    every = [comm_graph.peer_name(index) for index in range(comm_graph.peers)]
    if name in every:
        return every.index(name)
    names = every[:4]
    expected = f"one of {', '.join(names)}{', …' if len(every) > 4 else ''}"
    near = nearest(name, [f"{group}[1]" for group in comm_graph.groups]) or names[0]
    fix = f'{option} "{near}{"=HOST:PORT" if option == "--to" else ""}"'
    raise ApcError(Diagnostic("E970", SourceLocation(option), "peer", expected, cut(name) or "nothing", fix))
