"""A network and its clock without waiting: time goes on as it is waited for, and peers answer at once."""

from __future__ import annotations

import heapq
from collections.abc import Callable
from fractions import Fraction
from types import SimpleNamespace
from typing import Any

import pytest

from apc.compiler.compiled import Model
from apc.realtime.packets import Address, Hello, Post
from apc.realtime.peer import NANO, PeerLoop

OWN: Address = ("127.0.0.1", 5000)
SOON = 100_000  # nanoseconds that a datagram is on its way
HOUR = 3600 * NANO


class Wire:
    """What a `Loop` listens at and waits with.

    `given` are the datagrams that it read, each with when and from whom; `told` hears what it sends. Reading
    one takes `cost` nanoseconds. The system's clock is set back by an hour now and then.
    """

    def __init__(self, monkeypatch: pytest.MonkeyPatch, *, cost: int = 0) -> None:
        self.time, self.cost, self.reads = 2 * NANO, cost, 0
        self.coming: list[tuple[int, int, bytes, Address]] = []
        self.endless: tuple[bytes, Address] | None = None
        self.given: list[tuple[int, bytes, Address]] = []
        self.told: dict[Address, Callable[[bytes], None]] = {}
        clocks = SimpleNamespace(
            monotonic_ns=lambda: self.time, time_ns=lambda: self.time % (NANO // 7) - HOUR
        )
        monkeypatch.setattr("apc.realtime.process_priority.time", clocks)
        monkeypatch.setattr("apc.realtime.peer.select", SimpleNamespace(select=self.wait))

    def send(self, datagram: bytes, address: Address, at: int = 0) -> None:
        """Have a datagram come from an address, `SOON` or at an instant."""
        heapq.heappush(
            self.coming, (at or self.time + SOON, len(self.coming) + len(self.given), datagram, address)
        )

    def setblocking(self, flag: bool) -> None:
        assert not flag

    def recvfrom(self, size: int) -> tuple[bytes, Address]:
        self.time += self.cost
        if self.coming and self.coming[0][0] <= self.time:
            _, _, datagram, address = heapq.heappop(self.coming)
            self.given.append((self.time, datagram, address))
        elif self.endless is not None:
            datagram, address = self.endless
        else:
            raise BlockingIOError
        self.reads += 1
        return datagram, address

    def sendto(self, datagram: bytes, address: Address) -> None:
        if address in self.told:
            self.told[address](datagram)

    def wait(self, watched: Any, _: Any, __: Any, seconds: float) -> tuple[list[Any], list[Any], list[Any]]:
        end = self.time + round(seconds * NANO)
        ready = bool(self.coming) and self.coming[0][0] <= end
        if self.endless is None:
            self.time = max(self.time, min(self.coming[0][0], end)) if ready else end
        reported = [one for one in watched if one is not self and one.poll()]
        return reported + ([self] if ready or self.endless else []), [], []


class Other:
    """A peer at the other end: it answers, asks who asks it, and is `ahead` by its clock."""

    def __init__(self, wire: Wire, number: int, digest: bytes, secret: bytes, ahead: int = 0) -> None:
        self.wire, self.address, self.ahead = wire, (OWN[0], OWN[1] + number), ahead
        self.post = Post(number, digest, secret, {OWN: 0})
        self.begins = self.session = 0  # by its own clock
        wire.told[self.address] = self.take

    def take(self, datagram: bytes) -> None:
        printed, time = self.post.read(datagram, OWN), self.wire.time + self.ahead
        if isinstance(printed, Hello):
            answer = self.post.answer(time + SOON, printed, time + SOON, self.begins, self.session)
            self.wire.send(answer, self.address, self.wire.time + 2 * SOON)
            if 0 not in self.post.nonces:
                self.ask()

    def ask(self) -> None:
        """Ask whether the peer that is played is there."""
        self.wire.send(self.post.hello(self.wire.time + self.ahead, 0), self.address)

    def send(self, at: int, count: int, values: tuple[float, ...]) -> None:
        """Have a packet of the first link come at an instant."""
        datagram = self.post.data(at, 0, 0, count, values)
        assert datagram is not None
        self.wire.send(datagram, self.address, at)


def loop_at(
    wire: Wire,
    model: Model,
    digest: bytes,
    secret: bytes,
    duration: str = "1/10",
    device: Any = None,
    stop: Any = None,
) -> PeerLoop:
    """Return the first peer of a topology at a wire, where the others are known."""
    names = [f"{group.name}[{at + 1}]" for group in model.groups for at in range(group.count)]
    others = {name: (OWN[0], OWN[1] + at) for at, name in enumerate(names) if at}
    return PeerLoop(
        model,
        names[0],
        wire,  # type: ignore[arg-type] # it stands for a socket
        others,
        digest=digest,
        duration=Fraction(duration),
        secret=secret,
        device=device,
        stop=stop,
    )


def send_packets(loop: PeerLoop, others: list[Other], value: float) -> None:
    """Send a packet of each other for every period, a millisecond after its sample."""
    link = loop.player.links[0]
    for count in range(loop.frames * link.slots):
        at = loop.begins + link.instant(count) + NANO // 1000
        for place, other in enumerate(others):
            other.send(at + place, count, (value * (count + 1),) * len(link.channels_of(other.post.local)))
