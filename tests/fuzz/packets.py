"""Forged datagrams: torn, sealed with other keys, of other sessions, heard before, and of a peer gone wrong.

Takes: a seed. Gives: `run_packets`.
Guarantees: of equal seed comes equal input; what takes them is a peer that has met the others and plays.
"""

from __future__ import annotations

import random
import struct
from collections import Counter
from collections.abc import Callable

import pytest

from apc.compiler.compiled import Model
from apc.realtime.packets import ANSWER, DATA, HELLO, Address, Hello, Post
from apc.realtime.peer import PeerLoop
from tests.fuzz.inputs import mutated
from tests.surfaces.wire import OWN, SOON, Other, Wire, loop_at, send_packets

DIGEST = bytes(range(32))
SECRET = b"sixteen bytes or more"
EXTREME = (0, 1, -1, 2**31, 2**61 - 1, 1 - 2**61, 2**63 - 1, -(2**63))
Forgery = tuple[bytes, Address]


def run_packets(model: Model, count: int, seed: int) -> tuple[list[str], Counter[str]]:
    """Give a peer so many forged datagrams, in meeting the others and in playing with them.

    Returns
    -------
    failures
        What each was that was taken, or raised.
    outcomes
        How many of each sort there were.
    """
    failures: list[str] = []
    outcomes: Counter[str] = Counter()
    with pytest.MonkeyPatch.context() as patch:
        earlier = _met(patch, model)
        _play(earlier)
        for given in (_meeting, _playing):
            here = _met(patch, model)
            _play(here)
            for index in range(given is _playing, count, 2):
                noise = random.Random(f"{seed}/{index}")
                sort = noise.choice(list(FORGED))
                reported = given(here, FORGED[sort](noise, here, earlier), sort in INSIDE)
                outcomes[sort] += 1
                if reported:
                    failures.append(f"{sort}, seed {seed}, datagram {index}: {reported}")
    return failures, outcomes


class _Topology:
    """A peer that plays with two others: `given` are the datagrams that it took from them."""

    def __init__(self, wire: Wire, loop: PeerLoop, others: list[Other]) -> None:
        self.wire, self.loop, self.others = wire, loop, others
        self.given: list[Forgery] = []

    def state(self) -> object:
        """Return all that a datagram might change."""
        loop = self.loop
        stored = loop.player.packets.tobytes(), list(loop.player.arrivals), len(loop.player.ahead)
        return (
            stored,
            dict(loop.post.nonces),
            dict(loop.post.keys),
            dict(loop.offsets),
            loop.began,
            loop.begins,
        )


def _met(patch: pytest.MonkeyPatch, model: Model) -> _Topology:
    wire = Wire(patch)
    loop = loop_at(wire, model, DIGEST, SECRET)
    others = [Other(wire, number, DIGEST, SECRET) for number in (1, 2)]
    loop.meet(60)
    return _Topology(wire, loop, others)


def _play(topology: _Topology) -> None:
    send_packets(topology.loop, topology.others, 1.0)
    topology.loop.take_in(topology.loop.begins + topology.loop.frame_ns)
    topology.given = [(datagram, address) for _, datagram, address in topology.wire.given]


def _playing(here: _Topology, forged: Forgery, may: bool) -> str:
    """Return what is wrong as a peer that plays is given a datagram, empty if nothing is."""
    before = here.state()
    here.wire.coming.clear()
    here.wire.send(*forged)
    try:
        here.loop.take_in(here.wire.time + SOON)
    except Exception as error:
        return f"{type(error).__name__}: {error}"
    return "" if may or here.state() == before else "it was taken"


def _meeting(here: _Topology, forged: Forgery, may: bool) -> str:
    """Return what is wrong as a peer meets the others and is given a datagram first."""
    loop, reported = here.loop, ""
    loop.begins, loop.session, loop.began = 0, 0, None
    loop.offsets.clear()
    here.wire.coming.clear()
    here.wire.send(*forged)
    try:
        loop.meet(60)
        reported = "" if may or loop.session == loop.post.nonce else "it was told when the topology begins"
    except Exception as error:
        reported = f"{type(error).__name__}: {error}"
    return reported or _playing(here, (here.others[0].post.hello(1, 0), here.others[0].address), True)


def _torn(noise: random.Random, here: _Topology, _: _Topology) -> Forgery:
    """Return a good one changed anyhow, but for one that is as it was."""
    datagram, address = noise.choice(here.given)
    torn = next(one for one in iter(lambda: mutated(noise, datagram), None) if one != datagram)
    return torn, address


def _again(noise: random.Random, here: _Topology, _: _Topology) -> Forgery:
    """Return one that was heard, or one of somebody else's at an address."""
    datagram, address = noise.choice(here.given)
    stranger = ("192.0.2.1", 5000)
    where = [address, OWN, stranger, *(one.address for one in here.others)]
    return datagram, noise.choice(where)


def _local(noise: random.Random, here: _Topology, _: _Topology) -> Forgery:
    """Return what the peer itself may have sent."""
    post, other = here.loop.post, noise.choice(here.others)
    data = post.data(1, other.post.local, 0, 1, (1.0, 1.0))
    assert data is not None
    return noise.choice([data, post.hello(1, other.post.local)]), other.address


def _guessed(noise: random.Random, here: _Topology, _: _Topology) -> Forgery:
    """Return one of somebody who knows everything but the secret."""
    other = noise.choice(here.others)
    post = Post(other.post.local, DIGEST, noise.choice([b"", b"password", SECRET[:-1]]), {OWN: 0})
    post.nonces = {0: here.loop.post.nonce}
    post.keys = {0: noise.choice([post.secret, SECRET, noise.randbytes(32)])}
    requested = Hello(0, here.wire.time, here.loop.post.nonce, 0)
    data = post.data(1, 0, 0, noise.randrange(99), (1.0, 1.0))
    reported = [post.hello(1, 0), post.answer(1, requested, 2, 3, 4), data]
    return noise.choice(reported) or b"", other.address


def _wrong(noise: random.Random, here: _Topology, _: _Topology) -> Forgery:
    """Return one that a peer gone wrong has sealed: numbers that can't be, lengths that don't fit."""
    post, whole = (other := noise.choice(here.others)).post, lambda: noise.choice(EXTREME)
    times = struct.pack("<qqq", whole(), whole(), whole())
    own, received = noise.choice([0, *[post.nonce] * 9]), noise.choice([0, *[here.loop.post.nonce] * 9])
    nonces = struct.pack("<QQ", own, received)
    values = [noise.choice([0.0, 1e308, float("nan"), float("inf")]) for _ in range(noise.randrange(4))]
    data = struct.pack(
        "<HQH", noise.choice([0, 1, 2**16 - 1]), whole() % 2**64, noise.choice([len(values), 9])
    )
    bodies = {
        HELLO: nonces,
        ANSWER: nonces + times + struct.pack("<Q", noise.choice([0, 1])),
        DATA: data + struct.pack(f"<{len(values)}d", *values),
        noise.randrange(3, 256): nonces,
    }
    sort = noise.choice(list(bodies))
    body = bodies[sort][: None if noise.random() < 0.8 else noise.randrange(20)]
    return post._datagram(sort, whole(), body, post.keys[0] if sort == DATA else SECRET), other.address


FORGED: dict[str, Callable[[random.Random, _Topology, _Topology], Forgery]] = {
    "random bytes": lambda noise, here, _: (
        noise.randbytes(noise.randrange(200)),
        noise.choice(here.others).address,
    ),
    "torn": _torn,
    "duplicate": _again,
    "of an earlier session": lambda noise, _, earlier: noise.choice(earlier.given),
    "this peer's own": _local,
    "sealed without the secret": _guessed,
    "of a peer gone wrong": _wrong,
}
INSIDE = ("of a peer gone wrong",)  # it may tell another time, and stops nobody
