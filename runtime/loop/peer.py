"""One peer of a scene in real time: it ticks, hears what has arrived, and sends.

Takes: a compiled scene, which peer, addresses, how long. Gives: `PeerLoop`, `live_scene`, `traced`,
`number_of`.
Guarantees: every tick is done once, in order, however late; what a tick hears is what had arrived when it was
done; a peer that begins late, or again, joins at the instant it is; others that fall silent are held or left
out as the link says.
Does not: move others, or keep hosts' clocks together: the difference between two clocks is measured as peers
meet (half of the shortest round trip is its error), and what they drift apart afterwards is in the delays.
Where a host sets its clock to another time, nothing changes: the clock that is read is never set.

A scene's time 0 is told by the peer with the lowest number once all it knows are there, unless one of them
knows it already; the nonce of the one that told it first is the session. What ticks at an instant is done as
that is over, by the program of the simulation cut at every instant; the peer's device moves as it does there.
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
from apc.compiler.words import counted, cut
from apc.frame.exchange import CommunicationGraph, build_exchange
from apc.frame.parameters import resolve
from apc.loop.device import DeviceFunction, Outside
from apc.loop.packets import DROPPED, Address, Data, Hello, HelloReply, Post
from apc.loop.realtime import now
from apc.network.channel import PacketSource, channel_law
from apc.network.timetable import START, DeliveredPackets
from apc.simulation.population import instants_within
from apc.simulation.rows_in_time import pushes, unsolved
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from apc.simulation.stepwise import InterpretedEngine

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Flags = NDArray[np.bool_]

NANO = 10**9
# Seconds after which a packet that has not come is given up, and times its nominal delay if that is more.
GIVEN_UP, TIMES = 1, 4
KNOCK = NANO // 20  # from one hello to the next
# Round trips by which another's clock is known, the shortest of them, and what lies between two.
TRIPS, BETWEEN = 10, NANO // 200
HEAD_START = NANO // 2  # between telling when a scene begins and its beginning
LARGEST = 1 << 16  # bytes of a datagram
AHEAD = 1024  # packets whose luck is drawn at once
# Datagrams read before the clock is looked at again, and all that a late tick reads: some tenths of a
# millisecond, whatever comes.
AT_ONCE = 32


def live_scene(system: Model) -> Model:
    """Return a scene whose links take what the network does: each way's packets are heard as they come."""
    timings = {timing.name: timing.value for timing in system.timings}
    late = [
        max(timings[text] for text in (link.delay, *(pair.delay for pair in link.delays)))
        for link in system.links
    ]
    given_up = [[float(max(Fraction(GIVEN_UP), TIMES * delay))] for delay in late]
    links = tuple(map(traced, system.links, given_up))
    return replace(system, links=links, within=())


def traced(link: Link, delays: Sequence[float] | Floats) -> Link:
    """Return a link whose packets take recorded delays, in seconds; what it makes of lost ones stays."""
    usual = link.channel or Channel(None, None, "uniform", "newest", "hold", None)
    lawless = replace(usual, loss=None, jitter=None, distribution="uniform")
    return replace(link, channel=replace(lawless, trace=np.asarray(delays)))


class StoppedError(RuntimeError):
    """The loop is to end: it was told so, or its device is at fault."""


class PeerLoop:
    """A peer's loop: its clock, its socket, and its part of the scene."""

    def __init__(
        self,
        system: Model,
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
        """Make it ready.

        Parameters
        ----------
        system
            The compiled scene, with its numbers.
        peer
            Which peer it is, such as "left[1]".
        listening
            A bound UDP socket.
        addresses
            Where the others are, by their names.
        digest, secret
            As for `Post`.
        duration
            How long, in seconds.
        emulate
            Whether packets are held back and lost at the sender as the scene's links say.
        seed
            Of what gets lost; that of the scene's experiment if not given.
        stop
            What can be read when the loop is to end.
        device
            What stands in the place of the peer's simulated device.

        Raises
        ------
        ApcError
            E970 there is no such peer, E971 one that it sends to or hears has no address; those of `prepare`.
        """
        self.system, self.name = system, peer
        self.exchange = build_exchange(system, resolve(system).timings)
        self.own = number_of(self.exchange, peer, "--peer")
        self.others = {number_of(self.exchange, text, "--to"): address for text, address in addresses.items()}
        settings = Settings(duration, jit=False, seed=seed)
        self.simulation = prepare(live_scene(system), settings, signals=[f"{peer}.*"], live=True)
        self.frame_ns = int(self.simulation.frame * self.simulation.quantum * NANO)
        self.frames = -(-int(duration * NANO) // self.frame_ns)
        self.post = Post(
            self.own, digest, secret, {address: number for number, address in self.others.items()}
        )
        self.socket = listening
        self.socket.setblocking(False)
        self.begins = 0  # when the scene begins, by this host's clock; 0 while not known
        self.session = 0  # what all peers that play together know it by; 0 while not known
        # Of each other the shortest round trip, and how far its clock was ahead then.
        self.offsets: dict[int, tuple[int, int]] = {}
        self.began: HelloReply | None = None  # the first that said when the scene begins
        self.knocked = 0  # when others were asked last
        self.first = 0  # the frame with which it joins
        self.stopped = False
        self.trouble: ApcError | None = None  # why it ended before its end, where nobody stopped it
        self.stop = stop
        self.watched: list[socket.socket | Connection] = [listening, *([stop] if stop else [])]
        self.rows: list[Floats] = []
        self.player = _SinglePeer(self, device, emulate=emulate)
        self._check_addresses()

    def _check_addresses(self) -> None:
        pairs = {tuple(pair) for route in self.player.routes for pair in route.pairs.tolist()}
        needed = {item for pair in pairs if self.own in pair for item in pair} - {self.own}
        unknown = [self.exchange.peer_name(other) for other in sorted(needed - set(self.others))][:4]
        wrong = (
            (
                not needed,
                f"{self.name} sends nothing over a link and hears nothing: there is nobody to play with",
                "apc simulate",
            ),
            (
                self.own in self.others,
                f"{self.name} is the peer that is played: --to says where the others are",
                f"--listen HOST:PORT for {self.name}",
            ),
            (
                len(set(self.others.values())) < len(self.others),
                "two peers have one address: a packet is known by where it comes from",
                "a port of its own for each",
            ),
            (
                bool(unknown),
                f"{self.name} sends to or hears {', '.join(unknown)}, which have no address",
                " ".join(f'--to "{text}=HOST:PORT"' for text in unknown),
            ),
        )
        for is_wrong, what, hint in wrong:
            if is_wrong:
                place = SourceLocation("--to" if needed else self.system.name)
                raise ApcError(Diagnostic("E971", place, what, hint=hint))

    # ---- meeting

    def meet(self, patience: float) -> None:
        """Find out when the scene begins.

        Raises
        ------
        ApcError
            E972 nobody tells within so many seconds.
        StoppedError
            It was told to end before.
        """
        end, leads = now() + int(patience * NANO), self.own < min(self.others)
        self.player.warm_up()
        while not self.session:
            self._knock(self.others)
            self.take_in(now() + KNOCK)
            if self.began is not None:
                for _ in range(TRIPS):
                    self._knock(self.others)
                    self.take_in(now() + BETWEEN)
                self.begins = self.began.begins - self.offsets[self.began.sender][1]
                self.session = self.began.session
            elif leads and set(self.others) == set(self.post.nonces):
                self.begins, self.session = now() + HEAD_START, self.post.nonce
            elif now() > end:
                raise self._alone(patience)
        if now() > self.begins:  # who begins late, or again, comes in with the frame after the next
            self.first = (now() - self.begins) // self.frame_ns + 2
            self.player.instant = self.first * self.frame_ns

    def _knock(self, others: Iterable[int]) -> None:
        """Ask others whether they are there."""
        self.knocked = now()
        for other in others:
            self._send(self.post.hello(now(), other), self.others[other])

    def _alone(self, patience: float) -> ApcError:
        missing = sorted(set(self.others) - set(self.post.nonces)) or sorted(self.others)[:1]
        names = ", ".join(self.exchange.peer_name(number) for number in missing)
        dropped = self.post.dropped.items()
        text = "; ".join(f"{counted(count, 'datagram')} dropped: {DROPPED[why]}" for why, count in dropped)
        what = f"{names} did not say within {patience:g} s when the scene begins" + (text and f" ({text})")
        hint = "the same FILE, --set and --secret-file at every peer, started within --wait of each other"
        return ApcError(Diagnostic("E972", SourceLocation(self.name), what, hint=hint))

    # ---- running

    def run(self) -> None:
        """Play until the end, or until it is told to end, or its device or an equation gives up."""
        simulation, first = self.simulation, self.first
        while first < self.frames:
            count = min(simulation.length, self.frames - first)
            given = pushes(simulation, first)
            played = self.player.play(first, count, given)
            self.rows.append(played.rows[: played.frames * len(simulation.marks)].copy())
            first += played.frames
            if played.frames < count:
                if not (self.stopped or self.trouble):
                    self.trouble = unsolved(simulation, first)
                return

    def wait(self, instant: int) -> int:
        """Take in what comes until an instant of the scene, in nanoseconds; return how late it is then."""
        if not self.begins:  # warming up
            return 0
        self.take_in(self.begins + instant)
        return now() - self.begins - instant

    # ---- the network

    def take_in(self, until: int) -> None:
        """Take in what comes, and send what is due, until an instant of this host's clock."""
        held = self.player.held_back
        while True:
            while held and held[0][0] <= now():
                _, _, datagram, address = heapq.heappop(held)
                self._send(datagram, address)
            self._read()
            if self.post.unmet and now() >= self.knocked + KNOCK:
                self._knock(self.post.unmet)
                self.post.unmet.clear()
            left = min(until, held[0][0] if held else until) - now()
            ready, _, _ = select.select(self.watched, [], [], max(left, 0) / NANO)
            if self.stop in ready:
                self.stopped = True
                raise StoppedError
            if now() >= until:
                return

    def _read(self) -> None:
        for _ in range(AT_ONCE):
            try:
                datagram, address = self.socket.recvfrom(LARGEST)
            except BlockingIOError:
                return
            except OSError:  # what was sent before found nobody: Linux tells it here
                continue
            came = now()
            match self.post.read(datagram, address[:2]):
                case Data() as packet:
                    self.player.hear(packet, came - self.begins)
                case Hello() as hello:
                    answer = self.post.answer(now(), hello, came, self.begins, self.session)
                    self._send(answer, address)
                case HelloReply() as answer:
                    self._met(answer, came)

    def _met(self, answer: HelloReply, came: int) -> None:
        """Learn another's clock, and when the scene begins, by a round trip (RFC 5905, section 8)."""
        trip = (came - answer.asked) - (answer.time - answer.came)
        ahead = ((answer.came - answer.asked) + (answer.time - came)) // 2
        self.offsets[answer.sender] = min(self.offsets.get(answer.sender, (trip, ahead)), (trip, ahead))
        if answer.session and self.began is None:
            self.began = answer

    def _send(self, datagram: bytes, address: Address) -> None:
        try:
            self.socket.sendto(datagram, address)
        except OSError:  # nobody is there, or no room: one packet more that is lost
            self.post.drop("not sent")


class _SinglePeer(InterpretedEngine):
    """One peer of a population, instant by instant; what the others send comes from the network.

    `log` has (due, late, took) of each instant, `arrivals` (link, sender, count, sent, arrived) of each
    packet, all in nanoseconds of the scene; `seen`, a route each, what its ticks saw on the peer's own ways.
    """

    def __init__(self, loop: PeerLoop, device: DeviceFunction | None, *, emulate: bool) -> None:
        simulation, population = loop.simulation, loop.simulation.population
        self.loop, self.routes = loop, population.hearing.routes
        self.member = next(g for g, member in enumerate(population.members) if loop.own in member.peers)
        super().__init__(population, None, moving=(self.member,))
        self.quantum_ns = simulation.quantum * NANO
        schedules = [member.program.schedule for member in population.members]
        self.begin_at = [0, *(int(number * self.quantum_ns) for number in instants_within(schedules))]
        self.links = [_OfLink(loop, place) for place in range(len(loop.system.links))]
        self.newest = [np.full(len(route.pairs), START, np.int64) for route in self.routes]
        self.mine = [np.flatnonzero(route.pairs[:, 1] == loop.own) for route in self.routes]
        self.seen: list[list[tuple[Integers, Flags]]] = [[] for _ in self.routes]
        self.network = _Emulated(loop) if emulate else None
        member = population.members[self.member]
        self.outside = Outside(loop.system, member, device) if device else None
        self.ahead: list[
            tuple[int, int, Data]
        ] = []  # packets not heard yet, by the instants of their samples
        self.held_back: list[tuple[int, int, bytes, Address]] = []
        self.log: list[tuple[int, int, int]] = []
        self.arrivals: list[tuple[int, int, int, int, int]] = []
        self.sent: dict[int, Counter[int]] = defaultdict(Counter)  # packets by link and receiver
        self.instant = 0

    def warm_up(self) -> None:
        """Play a frame that nobody hears: what is loaded and built at a first call isn't in the second."""
        self.play(0, 1, pushes(self.loop.simulation, 0))
        self.begin(0)
        self.log, self.seen = [], [[] for _ in self.routes]

    def _segment(
        self,
        number: int,
        index: int,
        seen: tuple[DeliveredPackets, ...],
        rows: Floats,
        pushes: Sequence[Floats | None],
    ) -> None:
        """Wait for a segment's instant, play it, and hand over what it sends at its end."""
        instant = number * self.loop.frame_ns + self.begin_at[index]
        late, begun = self.loop.wait(instant), now()
        self.instant = instant
        outside = self.outside if self.loop.begins else None
        if outside and (index == 0 or self.begin_at[index] > self.begin_at[index - 1]):
            self._of_device(outside.measure, instant / NANO, self.carries[self.member])
        super()._segment(number, index, seen, rows, pushes)
        if outside and index:  # before it nothing ticks: a frame begins with what is sent then
            self._push(outside)
        self._hand_over(number, index)
        took = now() - begun
        if self.log and self.log[-1][0] == instant:  # what a frame begins with, and its first tick
            _, late, before = self.log.pop()
            took += before
        self.log.append((instant, late, took))

    def _of_device(self, asked: Callable[..., None], *what: object) -> None:
        """Ask the device outside; where it is at fault the loop ends, and what was done stays."""
        try:
            asked(*what)
        except ApcError as error:
            self.loop.trouble = error
            raise StoppedError from None

    def _push(self, outside: Outside) -> None:
        """Tell the device outside what force acts from this instant on."""
        layout = self.population.members[self.member].program.layout
        carry = self.carries[self.member][:, 0]
        self._of_device(outside.push, self.instant / NANO, carry[: layout.states], carry[layout.held])

    def _sees(self, place: int, tick: int, seen: tuple[DeliveredPackets, ...]) -> tuple[Integers, Flags]:
        """Return the packets that are here, and which should be.

        A peer that is late does not hear what was sampled after the instant that it is at.
        """
        while self.ahead and self.ahead[0][0] <= self.instant:
            _, _, packet = heapq.heappop(self.ahead)
            link = self.links[packet.link]
            for at, way in link.ways[packet.sender]:
                last = self.newest[at][way]
                self.newest[at][way] = max(last, packet.count) if link.newest else packet.count
        route, newest, luck = self.routes[place], self.newest[place], self.loop.simulation.lucks[place]
        instant = int(self.instant // self.quantum_ns)
        due = (instant - luck.nominal - luck.phase) // luck.period
        missing = (newest < due) & (due >= 0) if route.zero else np.zeros(len(newest), np.bool_)
        mine = self.mine[place]
        self.seen[place].append((newest[mine].copy(), missing[mine].copy()))
        return newest.copy(), missing

    def _hand_over(self, number: int, index: int) -> None:
        """Send what a segment has computed, each packet at its instant or, emulated, when it would arrive."""
        loop, member = self.loop, self.population.members[self.member]
        sent = member.program.schedule.sent
        slots = {(sent[row].link, sent[row].slot) for row in member.program.segments[index].sent}
        for name, slot in sorted(slots):
            link = next(link for link in self.links if link.name == name)
            count = number * link.slots + slot
            keys = [link.keys[channel, slot] for channel in link.channels_of(loop.own)]
            column = self.population.hearing.column_of[loop.own]
            values = tuple(self.packets[number % self.population.hearing.ring, keys, column].tolist())
            instant = link.instant(count)
            for other in sorted(link.receivers) if loop.begins else ():  # while it warms up nobody hears it
                delay = self.network.delay(link, other, count) if self.network else 0
                self.sent[link.place][other] += 1
                if delay is not None:
                    at = loop.begins + instant + delay
                    datagram = loop.post.data(at, other, link.place, count, values)
                    if datagram is None:
                        loop.post.drop("not sent")
                        continue
                    heapq.heappush(self.held_back, (at, len(self.log), datagram, loop.others[other]))

    def hear(self, packet: Data, came: int) -> None:
        """Take in a packet that came at an instant of the scene, unless it can't be what it says."""
        link = self.links[packet.link] if packet.link < len(self.links) else None
        if why := "malformed" if link is None else self._refused(packet, came, link):
            self.loop.post.drop(why)
            return
        assert link is not None
        hearing, (frame, slot) = self.population.hearing, divmod(packet.count, link.slots)
        link.counts.setdefault(packet.sender, set()).add(packet.count)
        keys = [link.keys[channel, slot] for channel in link.channels_of(packet.sender)]
        self.packets[frame % hearing.ring, keys, hearing.column_of[packet.sender]] = packet.values
        heapq.heappush(self.ahead, (link.instant(packet.count), len(self.arrivals), packet))
        self.arrivals.append((link.place, packet.sender, packet.count, link.instant(packet.count), came))

    def _refused(self, packet: Data, came: int, link: _OfLink) -> str:
        """Return why a packet is let go, empty if it isn't."""
        if packet.sender not in link.ways or len(packet.values) != len(link.channels_of(packet.sender)):
            return "malformed"
        if not self.loop.begins:
            return "joining"
        frame, frame_now = packet.count // link.slots, came // self.loop.frame_ns
        # Of the frames that are kept the oldest may be overwritten by one that is early.
        kept = self.population.hearing.ring - 3
        if frame < frame_now - kept:
            return "late"
        # A peer that is late itself may still have to hear those that a newer one would overwrite.
        if frame > min(frame_now + 1, self.instant // self.loop.frame_ns + kept - 1):
            return "early"
        return "heard before" if packet.count in link.counts.get(packet.sender, ()) else ""


class _OfLink:
    """What a peer needs of a link: `place` and `name`; `slots` a frame; whom it tells and whom it hears.

    `channels` are what each peer sends over it, in the order of a packet's values, `keys` where they are
    kept, `ways` the routes and ways on which each other is heard, `counts` the packets that came of each.
    """

    def __init__(self, loop: PeerLoop, place: int) -> None:
        population = loop.simulation.population
        self.place, self.name = place, loop.system.links[place].name
        link, timings = loop.system.links[place], resolve(loop.system).timings
        clock = next(clock for clock in loop.system.clocks if clock.name == link.clock)
        self.phase, self.period = (timings[text] * NANO for text in (clock.phase, clock.period))
        self.newest = link.channel is None or link.channel.reorder == "newest"
        self.slots = int(loop.simulation.frame * loop.simulation.quantum * NANO / self.period)
        self.channels: dict[int, list[str]] = {}
        for member in population.members:
            sent = sorted({sent.channel for sent in member.program.schedule.sent if sent.link == self.name})
            self.channels |= dict.fromkeys(member.peers.tolist(), sent)
        listed = enumerate(population.hearing.keys)
        self.keys = {(sent.channel, sent.slot): row for row, sent in listed if sent.link == self.name}
        self.receivers: set[int] = set()
        self.ways: dict[int, list[tuple[int, int]]] = {}
        for at, route in enumerate(population.hearing.routes):
            for way, (sender, receiver) in enumerate(route.pairs.tolist() if route.link == self.name else ()):
                if sender == loop.own:
                    self.receivers.add(receiver)
                if receiver == loop.own:
                    self.ways.setdefault(sender, []).append((at, way))
        self.counts: dict[int, set[int]] = {}

    def channels_of(self, peer: int) -> list[str]:
        """Return what a peer sends over the link, in the order of a packet's values."""
        return self.channels[peer]

    def instant(self, count: int) -> int:
        """Return when a packet's sample is taken, in nanoseconds of the scene."""
        return int(self.phase + count * self.period)


class _Emulated:
    """The network that a scene says: what each packet is held back by, and which are lost."""

    def __init__(self, loop: PeerLoop) -> None:
        self.loop = loop
        self.timings = resolve(loop.system).timings
        self.delays: dict[tuple[int, int], Iterator[tuple[int, float]]] = {}

    def delay(self, link: _OfLink, other: int, count: int) -> int | None:
        """Return the delay of a packet in nanoseconds, None if it gets lost; counts of a way only grow."""
        key = link.place, other
        if key not in self.delays:
            self.delays[key] = enumerate(_drawn(self._source(link, other)))
        value = next(delay for number, delay in self.delays[key] if number == count)
        return None if math.isinf(value) else int(value * NANO)

    def _source(self, link: _OfLink, other: int) -> PacketSource:
        loop, exchange = self.loop, self.loop.exchange
        way, declared = (loop.own, other), loop.system.links[link.place]
        of, to = map(exchange.group_of, way)
        delay = self.timings[exchange.delay(link.name, of, to)]
        law = channel_law(
            loop.system, declared if declared.channel else traced(declared, [float(delay)]), delay
        )
        return PacketSource(law, link.name, [way], seed=loop.simulation.seed)


def _drawn(source: PacketSource) -> Iterator[float]:
    """Yield the delays of a way's packets, in seconds."""
    while True:
        yield from source.take(AHEAD)[0].tolist()


def number_of(exchange: CommunicationGraph, name: str, option: str) -> int:
    """Return the number of a peer called `left[1]`, as given to an option.

    Parameters
    ----------
    exchange
        Who is there.
    name, option
        What was given, and to what.

    Raises
    ------
    ApcError
        E970 there is no such peer.
    """
    every = [exchange.peer_name(index) for index in range(exchange.peers)]
    if name in every:
        return every.index(name)
    names = every[:4]
    expected = f"one of {', '.join(names)}{', …' if len(every) > 4 else ''}"
    near = nearest(name, [f"{group}[1]" for group in exchange.groups]) or names[0]
    hint = f'{option} "{near}{"=HOST:PORT" if option == "--to" else ""}"'
    raise ApcError(
        Diagnostic("E970", SourceLocation(option), "a peer", expected, cut(name) or "nothing", hint)
    )
