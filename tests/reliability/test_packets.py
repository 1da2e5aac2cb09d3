"""What peers say to one another in real time: nothing is taken of others, of other sessions or too late.

No claim is on how late anything was: a busy machine only makes what is heard later.
"""

from __future__ import annotations

import hashlib
import math
import random
from collections.abc import Sequence

import numpy as np
import pytest

from apc.compiler.errors import ApcError
from apc.realtime.packets import Address, Data, Hello, HelloReply, Post
from apc.realtime.peer import AT_ONCE, HELLO_PERIOD, NANO, PeerLoop
from tests.fuzz.packets import run_packets
from tests.surfaces.wire import HOUR, SOON, Other, Wire, loop_at, send_packets
from tests.topologies import AVERAGE, compiled, replaced

DIGEST = hashlib.sha256(b"a topology").digest()
HERE: Address = ("127.0.0.1", 5000)
THERE: Address = ("127.0.0.1", 5009)
MOVING = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: 3 mm}}"))


def post(own: int = 1, *, digest: bytes = DIGEST, secret: bytes = b"") -> Post:
    return Post(own, digest, secret, {HERE: 2})


SECRETS = pytest.mark.parametrize("secret", [b"", b"sixteen bytes or more"], ids=["open", "secret"])


def met(secret: bytes = b"") -> tuple[Post, Post]:
    """Return the posts of peers 2 and 1 that have said hello, at `HERE` and elsewhere."""
    two, one = post(2, secret=secret), post(secret=secret)
    two.addresses = {THERE: 1}
    requested = one.read(two.hello(0, 1), HERE)
    assert isinstance(requested, Hello)
    two.read(one.answer(1, requested, 2, 3, 4), THERE)
    one.read(two.hello(5, 1), HERE)
    assert (two.nonces, one.nonces) == ({1: one.nonce}, {2: two.nonce})
    return two, one


@SECRETS
def test_what_is_written_is_read(secret: bytes) -> None:
    sender, receiver = met(secret)
    datagrams = [
        sender.data(17, 1, 3, 4, (1.5, -0.0, 1e-300)),
        sender.hello(18, 1),
        sender.answer(19, Hello(1, 5, receiver.nonce, 0), 6, -1, 8),
    ]
    assert [receiver.read(one or b"", HERE) for one in datagrams] == [
        Data(2, 17, 3, 4, (1.5, -0.0, 1e-300)),
        Hello(2, 18, sender.nonce, receiver.nonce),
        HelloReply(2, 19, sender.nonce, receiver.nonce, 5, 6, -1, 8),
    ]
    assert not receiver.dropped
    assert post(2, secret=secret).data(17, 1, 3, 4, ()) is None  # it has met nobody


@SECRETS
def test_what_is_not_a_peers_changes_nothing_but_a_counter(secret: bytes) -> None:
    """Random bytes, every bit of good datagrams turned, others' topologies, secrets, sessions and
    addresses.
    """
    noise = random.Random(1)
    sender, receiver = met(secret)
    good = sender.data(17, 1, 0, 4, (1.0,)) or b""
    printed = [good, sender.hello(18, 1), sender.answer(19, Hello(1, 5, receiver.nonce, 0), 6, -1, 8)]
    before = dict(receiver.nonces), dict(receiver.keys)

    def dropped(*datagrams: bytes, address: Address = HERE) -> dict[str, int]:
        """Return what is counted when some datagrams come, none of which is taken."""
        receiver.dropped.clear()
        assert {receiver.read(one, address) for one in datagrams} == {None}
        return dict(receiver.dropped)

    assert dropped(*(noise.randbytes(noise.randrange(200)) for _ in range(2000))) == {"malformed": 2000}
    torn = [
        bytes(byte ^ (1 << at % 8) * (place == at // 8) for place, byte in enumerate(one))
        for one in printed
        for at in range(8 * len(one))
    ]
    assert dropped(*torn)["other topology"] == 3 * 8 * 8
    assert dropped(good, address=("127.0.0.1", 5001)) == {"stranger": 1}
    assert dropped(post(2, secret=b"another secret of some length").hello(18, 1)) == {"forged": 1}
    assert dropped(met(secret)[0].data(17, 1, 0, 4, (1.0,)) or b"") == {"forged": 1}  # of another session
    assert dropped(post(2, digest=b"other" * 8, secret=secret).hello(18, 1))
    assert dropped(post(3, secret=secret).hello(18, 1))
    assert dropped(*(sender.data(17, 1, 0, 4, (value,)) or b"" for value in (math.nan, math.inf)))
    assert (receiver.nonces, receiver.keys) == before
    assert receiver.read(good, HERE) is not None


def played(
    wire: Wire, secret: bytes, value: float, replayed: Sequence[tuple[int, bytes, Address]] = ()
) -> PeerLoop:
    """Play a topology with two others; all that is replayed comes at once and when it came, twice."""
    loop, start = loop_at(wire, compiled(MOVING), DIGEST, secret), wire.time
    others = [Other(wire, number, DIGEST, secret) for number in (1, 2)]
    for time, datagram, address in replayed:
        wire.send(datagram, address, start + 1)
        wire.send(datagram, address, time)
    loop.meet(60)
    send_packets(loop, others, value)
    for time, datagram, address in replayed:
        wire.send(datagram, address, loop.begins + 1)
        wire.send(datagram, address, time + wire.time - start)
    loop.run()
    return loop


@pytest.mark.few(1)
@SECRETS
def test_of_what_was_heard_in_one_session_nothing_is_taken_in_another(
    secret: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it is sent again, at once and when it came, while the peers meet and while they play."""
    wires = [Wire(monkeypatch)]
    played(wires[0], secret, 1.0)
    recorded = wires[0].given
    assert len(recorded) > 20
    wires.append(Wire(monkeypatch))
    without = played(wires[1], secret, 2.0)
    wires.append(Wire(monkeypatch))
    found = played(wires[2], secret, 2.0, recorded)
    assert {late for _, late, _ in found.player.log} == {0}, "though the system's clock was set"
    assert found.begins == without.begins
    assert found.offsets == without.offsets
    assert found.player.arrivals == without.player.arrivals
    assert len(found.player.arrivals) == 2 * found.frames
    assert np.array_equal(np.concatenate(found.rows), np.concatenate(without.rows))
    assert set(found.post.dropped) == {"forged", "unasked"}


def test_a_peer_that_is_started_again_is_heard_and_what_it_was_before_is_not(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Even where what it says to be known gets lost: a packet that nobody can read has it asked."""
    wire = Wire(monkeypatch)
    loop = loop_at(wire, compiled(MOVING), DIGEST, b"", "1/2")
    others = [Other(wire, number, DIGEST, b"") for number in (1, 2)]
    loop.meet(60)
    width = len(loop.player.links[0].channels_of(1))
    loop.take_in(loop.begins)
    others[0].send(wire.time + SOON, 0, (0.5,) * width)
    loop.take_in(wire.time + 2 * SOON)
    before = list(wire.given)
    repeated = Other(wire, 1, DIGEST, b"")
    repeated.ask()
    loop.take_in(wire.time + 2 * SOON)  # it now knows this peer's nonce, and this peer not yet its own
    assert loop.post.nonces[1] == others[0].post.nonce
    for count in (1, 2):
        repeated.send(wire.time + SOON, count, (0.75,) * width)
        loop.take_in(wire.time + HELLO_PERIOD)
    for _, datagram, address in before:
        wire.send(datagram, address)
    loop.take_in(wire.time + HELLO_PERIOD)
    assert loop.post.nonces[1] == repeated.post.nonce
    assert [row[1:3] for row in loop.player.arrivals] == [(1, 0), (1, 2)]
    assert set(loop.post.dropped) == {"forged", "duplicate"}


def test_nobody_is_there_who_says_what_was_said_in_another_session(monkeypatch: pytest.MonkeyPatch) -> None:
    wire = Wire(monkeypatch)
    played(wire, b"", 1.0)
    recorded, wire = wire.given, Wire(monkeypatch)
    loop = loop_at(wire, compiled(MOVING), DIGEST, b"")
    for _ in range(10):
        for _, datagram, address in recorded:
            wire.send(datagram, address, wire.time + NANO // 100)
    with pytest.raises(ApcError, match=r"E972 no start time received from user\[2\], user\[3\] within 1 s"):
        loop.meet(1)
    assert not loop.session


def test_peers_whose_clocks_were_started_at_different_times_begin_at_one_instant(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A clock that is never set counts from when its host was started, even after the topology began."""
    for ahead in (HOUR, -HOUR):
        wire = Wire(monkeypatch)
        loop = loop_at(wire, compiled(MOVING), DIGEST, b"", "2")
        one, _ = (Other(wire, number, DIGEST, b"", ahead) for number in (1, 2))
        one.begins, one.session = wire.time + ahead - NANO, 7  # a second ago
        loop.meet(60)
        assert (loop.session, loop.begins) == (7, one.begins - ahead)
        assert loop.first == (wire.time - loop.begins) // loop.frame_ns + 2


@pytest.mark.whole
def test_a_flood_is_read_after_a_tick_s_work(monkeypatch: pytest.MonkeyPatch) -> None:
    """Datagrams without end, of strangers and of a peer, at 10 µs each: of them a late tick reads so many."""
    for address in (("192.0.2.9", 9), ("127.0.0.1", 5001)):
        wire = Wire(monkeypatch, cost=2_000)
        loop = loop_at(wire, compiled(MOVING), DIGEST, b"")
        _ = [Other(wire, number, DIGEST, b"") for number in (1, 2)]
        loop.meet(60)
        wire.endless = (bytes(100), address)
        loop.run()
        assert wire.reads > 5_000
        assert (
            max(late for _, late, _ in loop.player.log) <= 2 * AT_ONCE * wire.cost
        )  # begun before, and after
        loop.begins -= HOUR  # late by an hour
        before = wire.reads
        loop.wait(0)
        assert wire.reads == before + AT_ONCE


def test_a_ticks_packets_are_those_that_had_come(monkeypatch: pytest.MonkeyPatch) -> None:
    """Packets given by hand, out of order, twice, too early, too late, of another width; then a flood."""
    loop = loop_at(Wire(monkeypatch), compiled(MOVING), DIGEST, b"", "1")
    player = loop.player
    loop.begins = 1
    period, values = 8_000_000, (0.25,) * len(player.links[0].channels_of(1))
    arc = player.routes[0].pairs.tolist().index([1, 0])

    def newest(at: int) -> int:
        """Return the packet that a tick sees at the end of a period."""
        player.instant = at * period
        player._packets_at_tick(0, 0, ())
        return int(player.newest[0][arc])

    for count, came in ((3, 3 * period + 1), (2, 3 * period + 2)):
        player.receive(Data(1, 0, 0, count, values), came)
    assert newest(5) == 3, "the newest wins"
    for sender, link, count, came, given in (
        (1, 0, 3, 3 * period + 3, values),
        (1, 0, 90, 4 * period, values),
        (1, 0, 0, 500 * loop.frame_ns, values),
        (1, 0, 4, 4 * period, (*values, 1.0)),
        (1, 7, 4, 4 * period, values),
        (0, 0, 4, 4 * period, values),
        (1, 0, 6, 6 * period, values),  # of later than the instant that this peer is at
    ):
        player.receive(Data(sender, 0, link, count, given), came)
    assert newest(5) == 3
    assert loop.post.dropped == {"duplicate": 1, "early": 1, "late": 1, "malformed": 3}
    assert [row[2] for row in player.arrivals] == [3, 2, 6]
    assert newest(6) == 6
    before, noise = player.packets.copy(), random.Random(2)
    loop.post.dropped.clear()
    for _ in range(10_000):
        player.receive(Data(1, 0, 0, 6, (noise.random(),) * len(values)), 6 * period)
        player.receive(Data(1, 0, 0, noise.randrange(20, 2**60), values), 6 * period)
        player.receive(Data(1, 0, 0, noise.randrange(1000), values), 2000 * loop.frame_ns)
    assert loop.post.dropped == {"duplicate": 10_000, "early": 10_000, "late": 10_000}
    assert (player.packets == before).all()
    assert len(player.arrivals) == 3


def test_a_peer_that_is_far_behind_loses_packets_and_hears_none_in_the_place_of_others(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Stopped for two seconds, of which packets of one are kept: what would overwrite those is let go."""
    loop = loop_at(Wire(monkeypatch), compiled(MOVING), DIGEST, b"", "4")
    loop.begins, player = 1, loop.player
    width, stored = len(loop.player.links[0].channels_of(1)), player.population.exchange_program.ring
    for count in range(2 * stored):
        player.receive(Data(1, 0, 0, count, (float(count),) * width), 2 * stored * loop.frame_ns - 1)
        player.receive(Data(2, 0, 0, count, (float(count),) * width), count * loop.frame_ns)
    received = [row[2] for row in player.arrivals if row[1] == 2]
    assert received == list(range(stored - 3))
    column, link = player.population.exchange_program.column_of[2], player.links[0]
    for count in received:
        keys = [link.keys[channel, 0] for channel in link.channels_of(2)]
        assert (player.packets[count % stored, keys, column] == count).all()


def test_of_answers_the_shortest_round_trip_tells_a_clock_and_the_first_the_beginning(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """A peer that starts slowly answers old hellos: these are answers too."""
    loop = loop_at(Wire(monkeypatch), compiled(MOVING), DIGEST, b"", "1")
    for requested, begins in ((1_000, 0), (2_000, 9_000), (1_000, 8_000)):
        loop._synchronize(HelloReply(1, 5_000, 3, 4, requested, 4_000, begins, int(begins > 0)), 6_000)
    assert loop.offsets[1][0] == 6_000 - 2_000 - 1_000
    assert loop.began is not None
    assert loop.began.begins == 9_000


def test_a_forged_datagram_is_dropped_in_meeting_and_in_playing(monkeypatch: pytest.MonkeyPatch) -> None:
    """Here some; thousands are `python -m tests.fuzz --inputs 0 --packets 10000`."""
    failures, outcomes = run_packets(compiled(MOVING), 300, 7)
    assert not failures
    assert min(outcomes.values()) > 20
    assert len(outcomes) == 7
