"""Claims about peers in real time: their packets, what they hear, and that they do what is simulated.

No claim is on how late anything was: a busy machine only makes what is heard later.
"""

from __future__ import annotations

import errno
import hashlib
import io
import json
import math
import multiprocessing
import os
import random
import select
import shutil
import signal
import socket
import struct
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import Future, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import nullcontext
from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.__main__ import run
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake
from apc.loop.beside import Ticks, compare_run
from apc.loop.device import device_function
from apc.loop.packets import Address, Answer, Data, Hello, Post
from apc.loop.peer import AT_ONCE, KNOCK, NANO, Loop
from apc.loop.reading import read_run
from apc.loop.run import delays_of, run_of, write_run
from apc.loop.start import Part, Play, play_all
from apc.network.recorded import describe
from apc.present.loop import ticks_text
from apc.processes import Workers, digest_of
from tests.fuzz.models import recorded
from tests.fuzz.packets import run_packets
from tests.topologies import AVERAGE, replaced, told
from tests.wire import HOUR, SOON, Other, Wire, loop_at, send_packets

DIGEST = hashlib.sha256(b"a scene").digest()
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
    two.read(one.answer(1, two_asks(two, one), 2, 3, 4), THERE)
    one.read(two.hello(5, 1), HERE)
    assert (two.nonces, one.nonces) == ({1: one.nonce}, {2: two.nonce})
    return two, one


def two_asks(two: Post, one: Post) -> Hello:
    found = one.read(two.hello(0, 1), HERE)
    assert isinstance(found, Hello)
    return found


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
        Answer(2, 19, sender.nonce, receiver.nonce, 5, 6, -1, 8),
    ]
    assert not receiver.dropped
    assert post(2, secret=secret).data(17, 1, 3, 4, ()) is None  # it has met nobody


@SECRETS
def test_what_is_not_a_peers_changes_nothing_but_a_counter(secret: bytes) -> None:
    """10⁴ datagrams of random bytes, every bit of good ones turned, others' scenes, secrets and addresses."""
    luck = random.Random(1)
    sender, receiver = met(secret)
    good = sender.data(17, 1, 0, 4, (1.0,))
    assert good is not None
    before = dict(receiver.nonces), dict(receiver.keys)
    for _ in range(10_000):
        assert receiver.read(luck.randbytes(luck.randrange(200)), HERE) is None
    assert receiver.dropped == {"malformed": 10_000}
    said = [good, sender.hello(18, 1), sender.answer(19, Hello(1, 5, receiver.nonce, 0), 6, -1, 8)]
    for one in said:
        for at in range(8 * len(one)):
            torn = bytearray(one)
            torn[at // 8] ^= 1 << at % 8
            assert receiver.read(bytes(torn), HERE) is None
    assert receiver.dropped["other scene"] == 3 * 8 * 8
    assert receiver.read(good, ("127.0.0.1", 5001)) is None
    assert receiver.dropped["stranger"] == 1
    before_forged = receiver.dropped["forged"]
    others = [post(2, secret=b"another secret of some length"), post(2, digest=b"other" * 8, secret=secret)]
    for one in (*others, post(3, secret=secret)):
        assert receiver.read(one.hello(18, 1), HERE) is None
    assert receiver.dropped["forged"] == before_forged + 1
    again = met(secret)[0].data(17, 1, 0, 4, (1.0,))  # of another session
    assert receiver.read(again or b"", HERE) is None
    assert receiver.dropped["forged"] == before_forged + 2
    for value in (math.nan, math.inf):
        assert receiver.read(sender.data(17, 1, 0, 4, (value,)) or b"", HERE) is None
    assert (receiver.nonces, receiver.keys) == before
    assert receiver.read(good, HERE) is not None


def played(
    wire: Wire,
    scene: CompiledSystem,
    secret: bytes,
    value: float,
    replayed: Sequence[tuple[int, bytes, Address]] = (),
) -> Loop:
    """Play a scene with two others; all that is replayed comes at once and when it came, twice."""
    loop, start = loop_at(wire, scene, DIGEST, secret), wire.time
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


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> CompiledSystem:
    path = tmp_path_factory.mktemp("scene") / "three.yaml"
    path.write_text(MOVING, encoding="utf-8")
    return apc.compile(path)


def loops(system: CompiledSystem, duration: str, *, emulate: bool = False) -> Iterator[Loop]:
    names = [f"{group.name}[{at + 1}]" for group in system.groups for at in range(group.count)]
    sockets = {name: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for name in names}
    for one in sockets.values():
        one.bind(("127.0.0.1", 0))
    where = {name: one.getsockname() for name, one in sockets.items()}
    for name in names:
        others = {other: at for other, at in where.items() if other != name}
        yield Loop(
            system,
            name,
            sockets[name],
            others,
            digest=digest_of(system),
            duration=Fraction(duration),
            emulate=emulate,
        )


@SECRETS
def test_of_what_was_heard_in_one_session_nothing_is_taken_in_another(
    scene: CompiledSystem, secret: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All of it is sent again, at once and when it came, while the peers meet and while they play."""
    wires = [Wire(monkeypatch)]
    played(wires[0], scene, secret, 1.0)
    recorded = wires[0].given
    assert len(recorded) > 20
    wires.append(Wire(monkeypatch))
    without = played(wires[1], scene, secret, 2.0)
    wires.append(Wire(monkeypatch))
    found = played(wires[2], scene, secret, 2.0, recorded)
    assert found.begins == without.begins
    assert found.offsets == without.offsets
    assert found.player.arrivals == without.player.arrivals
    assert len(found.player.arrivals) == 2 * found.frames
    assert np.array_equal(np.concatenate(found.rows), np.concatenate(without.rows))
    assert set(found.post.dropped) == {"forged", "unasked"}


def test_a_peer_that_is_started_again_is_heard_and_what_it_was_before_is_not(
    scene: CompiledSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Even where what it says to be known gets lost: a packet that nobody can read has it asked."""
    wire = Wire(monkeypatch)
    loop = loop_at(wire, scene, DIGEST, b"", "1/2")
    others = [Other(wire, number, DIGEST, b"") for number in (1, 2)]
    loop.meet(60)
    width = len(loop.player.links[0].channels_of(1))
    loop.take_in(loop.begins)
    others[0].send(wire.time + SOON, 0, (0.5,) * width)
    loop.take_in(wire.time + 2 * SOON)
    before = list(wire.given)
    again = Other(wire, 1, DIGEST, b"")
    again.ask()
    loop.take_in(wire.time + 2 * SOON)  # it now knows this peer's nonce, and this peer not yet its own
    assert loop.post.nonces[1] == others[0].post.nonce
    for count in (1, 2):
        again.send(wire.time + SOON, count, (0.75,) * width)
        loop.take_in(wire.time + KNOCK)
    for _, datagram, address in before:
        wire.send(datagram, address)
    loop.take_in(wire.time + KNOCK)
    assert loop.post.nonces[1] == again.post.nonce
    assert [row[1:3] for row in loop.player.arrivals] == [(1, 0), (1, 2)]
    assert set(loop.post.dropped) == {"forged", "heard before"}


def test_nobody_is_there_who_says_what_was_said_in_another_session(
    scene: CompiledSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    wire = Wire(monkeypatch)
    played(wire, scene, b"", 1.0)
    recorded, wire = wire.given, Wire(monkeypatch)
    loop = loop_at(wire, scene, DIGEST, b"")
    for _ in range(10):
        for _, datagram, address in recorded:
            wire.send(datagram, address, wire.time + NANO // 100)
    with pytest.raises(ApcError, match=r"E972 user\[2\], user\[3\] did not say within 1 s"):
        loop.meet(1)
    assert not loop.session


def test_peers_whose_clocks_were_started_at_different_times_begin_at_one_instant(
    scene: CompiledSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A clock that is never set counts from when its host was started, even after the scene began."""
    for ahead in (HOUR, -HOUR):
        wire = Wire(monkeypatch)
        loop = loop_at(wire, scene, DIGEST, b"", "2")
        one, _ = (Other(wire, number, DIGEST, b"", ahead) for number in (1, 2))
        one.begins, one.session = wire.time + ahead - NANO, 7  # a second ago
        loop.meet(60)
        assert (loop.session, loop.begins) == (7, one.begins - ahead)
        assert loop.first == (wire.time - loop.begins) // loop.frame_ns + 2


def test_no_tick_waits_where_the_system_s_clock_is_set(
    scene: CompiledSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    loop = played(Wire(monkeypatch), scene, b"", 1.0)
    assert [late for _, late, _ in loop.player.log] == [0] * 104


def test_a_flood_is_read_after_a_tick_s_work(scene: CompiledSystem, monkeypatch: pytest.MonkeyPatch) -> None:
    """Datagrams without end, of strangers and of a peer, at 10 µs each: of them a late tick reads so many."""
    for address in (("192.0.2.9", 9), ("127.0.0.1", 5001)):
        wire = Wire(monkeypatch, cost=10_000)
        loop = loop_at(wire, scene, DIGEST, b"")
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


def test_peers_do_what_is_simulated_with_the_packets_they_heard(
    scene: CompiledSystem, tmp_path: Path
) -> None:
    """In one process, a thread each: every signal at every tick, to the last bits."""
    lossy = apc.set_parameters(scene, {"lan.delay": "3 ms"})
    every = list(loops(lossy, "1/4", emulate=True))
    threads = [threading.Thread(target=lambda one=one: (one.meet(60), one.run())) for one in every]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    write_run(tmp_path, lossy, [run_of(loop, digest_of(lossy), ()) for loop in every])
    found = read_run(tmp_path)
    assert [one.name for one in found.peers] == ["user[1]", "user[2]", "user[3]"]
    beside = compare_run(found)
    assert not beside.why_not
    assert max(far for far, _ in beside.apart.values()) <= 1e-12  # 250 ticks of roundings
    assert beside.apart["N"][1] > 1
    assert "signals differ by at most\n" in str(beside)
    assert len(beside.ways) == 6
    for way in beside.ways:
        # Nothing is lost by us: what did not come by the end was still on its way.
        assert way.came.lost.count == 0
        assert way.came.shortest >= 0.003
        assert describe(way.trace).to_dict()["packets"] == way.came.packets
    assert json.dumps(beside.to_dict())
    assert str(beside)


def test_a_ticks_packets_are_those_that_had_come(scene: CompiledSystem) -> None:
    """Without time: packets given by hand, out of order, twice, too early, too late, of another width."""
    loop = next(loops(scene, "1"))
    player = loop.player
    loop.begins = 1
    period, frame = 8_000_000, loop.frame_ns

    def given(count: int, came: int, *values: float, sender: int = 1, link: int = 0) -> None:
        player.hear(Data(sender, 0, link, count, values), came)

    width = len(player.links[0].channels_of(1))
    values = [0.25] * width
    player.instant = 5 * period
    given(3, 3 * period + 1, *values)
    given(2, 3 * period + 2, *values)  # newest wins
    player._sees(0, 0, ())
    way = next(way for way, pair in enumerate(player.routes[0].pairs.tolist()) if pair == [1, 0])
    assert player.newest[0][way] == 3
    given(3, 3 * period + 3, *values)
    given(90, 4 * period, *values)
    given(0, 500 * frame, *values)
    given(4, 4 * period, *values, 1.0)
    given(4, 4 * period, *values, link=7)
    given(4, 4 * period, *values, sender=0)
    given(6, 6 * period, *values)  # of later than the instant that this peer is at
    player._sees(0, 0, ())
    assert player.newest[0][way] == 3
    assert loop.post.dropped == {"heard before": 1, "early": 1, "late": 1, "malformed": 3}
    assert [row[2] for row in player.arrivals] == [3, 2, 6]
    player.instant = 6 * period
    player._sees(0, 0, ())
    assert player.newest[0][way] == 6


def test_a_peer_that_is_far_behind_loses_packets_and_hears_none_in_the_place_of_others(
    scene: CompiledSystem,
) -> None:
    """Stopped for two seconds, of which packets of one are kept: what would overwrite those is let go."""
    loop = next(loops(scene, "4"))
    loop.begins, player = 1, loop.player
    width, kept = len(loop.player.links[0].channels_of(1)), player.population.hearing.ring
    for count in range(2 * kept):
        player.hear(Data(1, 0, 0, count, (float(count),) * width), 2 * kept * loop.frame_ns - 1)
        player.hear(Data(2, 0, 0, count, (float(count),) * width), count * loop.frame_ns)
    heard = [row[2] for row in player.arrivals if row[1] == 2]
    assert heard == list(range(kept - 3))
    column, link = player.population.hearing.column_of[2], player.links[0]
    for count in heard:
        keys = [link.keys[channel, 0] for channel in link.channels_of(2)]
        assert (player.packets[count % kept, keys, column] == count).all()


def test_a_flood_of_packets_moves_counters_alone(scene: CompiledSystem) -> None:
    """10⁵ of each: replayed, too early, too late; what is heard stays, and what is kept does not grow."""
    loop = next(loops(scene, "1"))
    loop.begins = 1
    player, width = loop.player, len(loop.player.links[0].channels_of(1))
    player.hear(Data(1, 0, 0, 0, (0.5,) * width), 0)
    before = player.packets.copy()
    luck = random.Random(2)
    for _ in range(100_000):
        player.hear(Data(1, 0, 0, 0, (luck.random(),) * width), 0)
        player.hear(Data(1, 0, 0, luck.randrange(10, 2**60), (1.0,) * width), 0)
        player.hear(Data(1, 0, 0, luck.randrange(1000), (1.0,) * width), 2000 * loop.frame_ns)
    assert loop.post.dropped == {"heard before": 100_000, "early": 100_000, "late": 100_000}
    assert (player.packets == before).all()
    assert len(player.arrivals) == 1


# It says sooner that it is at work.
PLAY = """
import sys
from apc.__main__ import main
from apc.cli import progress
if __name__ == "__main__":
    progress.QUIET = 4.0
    sys.exit(main())
"""


def command(folder: Path, *words: str) -> subprocess.Popen[str]:
    (folder / "apc_play.py").write_text(PLAY, encoding="utf-8")  # a file: processes it starts read it again
    return subprocess.Popen(
        [sys.executable, "apc_play.py", "play", "three.yaml", *words],
        cwd=folder, text=True, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
    )  # fmt: skip


def free_ports(count: int) -> list[int]:
    sockets = [socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(count)]
    for one in sockets:
        one.bind(("127.0.0.1", 0))
    ports = [one.getsockname()[1] for one in sockets]
    for one in sockets:
        one.close()
    return ports


@pytest.mark.whole
def test_a_peer_that_is_killed_and_started_again_joins_the_others(tmp_path: Path) -> None:
    (tmp_path / "three.yaml").write_text(replaced(MOVING, ("{count: 3,", "{count: 2,")), encoding="utf-8")
    one, two = free_ports(2)
    first = ("--peer", "user[1]", "--listen", f"127.0.0.1:{one}", "--to", f"user[2]=127.0.0.1:{two}")
    second = ("--peer", "user[2]", "--listen", f"127.0.0.1:{two}", "--to", f"user[1]=127.0.0.1:{one}")
    common = ("--duration", "9 s", "--out", "a.run")
    staying = command(tmp_path, *first, *common, "--wait", "120 s")
    killed = command(tmp_path, *second, *common)
    with pytest.raises(subprocess.TimeoutExpired):  # until both have met, and play
        staying.wait(4)
    killed.kill()
    killed.communicate()
    again = command(tmp_path, *second, *common, "--wait", "10 s")
    told = again.communicate(timeout=240)
    # On a machine so busy that the other had ended before this one knocked, nobody answers.
    assert again.returncode == 0 or "E972" in told[1], told[1]
    told = staying.communicate(timeout=240)
    assert staying.returncode == 0, told[1]
    found = read_run(tmp_path / "a.run")
    assert found.peers[0].first == 0
    assert len(found.peers[0].time) == 9_000
    if again.returncode == 0 and found.peers[1].first:  # it had begun before it was killed
        assert "joined later" in compare_run(found).why_not


def test_a_device_outside_is_measured_and_pushed(scene: CompiledSystem, tmp_path: Path) -> None:
    """A wall of clay at 2 mm: its position is what is recorded, its force what the contact's spring says."""
    (tmp_path / "clay.py").write_text(
        "told = []\ndef device(time, force):\n    told.append((time, force))\n    return 0.002\n", "utf-8"
    )
    every = list(loops(scene, "1/10"))
    device = device_function(tmp_path / "clay.py")
    own = Loop(
        scene,
        "user[1]",
        every[0].socket,
        dict(zip(("user[2]", "user[3]"), every[0].others.values(), strict=True)),
        digest=digest_of(scene),
        duration=Fraction(1, 10),
        device=device,
    )
    played = [own, *every[1:]]
    threads = [threading.Thread(target=lambda one=one: (one.meet(60), one.run())) for one in played]
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    found = run_of(own, digest_of(scene), ())
    column = {name.removeprefix("user[1]."): at for at, name in enumerate(found.signals)}
    assert (found.values[1:, column["device.x"]] == 0.002).all()
    assert (found.values[2:, column["device.v"]] == 0).all()
    acting = found.values[:, column["contact.f acting"]]
    told = device.__globals__["told"]  # type: ignore[attr-defined]
    forces = {round(time * 1000): force for time, force in told if force is not None}
    # What acts from tick k on is recorded at tick k + 1, as it was just before that.
    for tick in range(len(acting) - 1):
        assert forces[tick] == pytest.approx(-acting[tick + 1], abs=1e-12)


def test_a_forged_datagram_is_dropped_in_meeting_and_in_playing(scene: CompiledSystem) -> None:
    """Here some; thousands are `python -m tests.fuzz --inputs 0 --packets 10000`."""
    failures, outcomes = run_packets(scene, 300, 7)
    assert not failures
    assert min(outcomes.values()) > 20
    assert len(outcomes) == 7


@pytest.mark.skipif(shutil.which("cc") is None, reason="no C compiler")
def test_a_device_may_be_in_c(tmp_path: Path) -> None:
    text = "double apc_device(double time, const double *force) { return force ? -*force : 2 * time; }"
    (tmp_path / "d.c").write_text(text, encoding="utf-8")
    subprocess.run(["cc", "-shared", "-fPIC", "-o", "d.so", "d.c"], cwd=tmp_path, check=True)
    device = device_function(tmp_path / "d.so")
    assert device(1.5, None) == 3.0
    assert device(1.5, 0.25) == -0.25
    with pytest.raises(ApcError, match="E976"):
        device_function(tmp_path / "d.txt")


def test_all_peers_of_a_scene_on_this_machine(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = replaced(
        MOVING,
        ("three-users-average", f"{tmp_path}/of/another/folder"),  # a title, which is any text
        ("{count: 3,", "{count: 2,"),
        ("delay: 8 ms}", "delay: 8 ms, loss: 20 %}"),
    )
    Path("three.yaml").write_text(text, encoding="utf-8")
    ran = subprocess.run(
        [sys.executable, "-m", "apc", "play", "--duration", "2 s", "--emulate", "--json"],
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert ran.returncode == 0, ran.stderr
    told = json.loads(ran.stdout)
    assert told["why_not"] == ""
    assert max(far for far, _ in told["apart"].values()) <= 1e-9
    for way in told["ways"]:
        assert 0.05 < way["came"]["lost"]["share"] < 0.4  # of 250, of which 20 % are lost: 6 deviations
    run_folder = Path("three.run")
    assert run(["compare", str(run_folder)]) == 0
    assert "packets were held back and lost at the sender" in capsys.readouterr().out
    (run_folder / "user-1.npz").write_bytes(b"PK")
    assert run(["compare", str(run_folder)]) == 1
    assert "E973" in capsys.readouterr().err


@pytest.fixture
def kept(tmp_path: Path) -> Path:
    """Return the folder of a run of two peers."""
    folder = tmp_path / "a.run"
    folder.mkdir()
    for name, content in recorded().items():
        (folder / name).write_bytes(content)
    return folder


def changed(folder: Path, **how: Callable[[Any], Any]) -> None:
    """Write a peer's file anew, with another value of what it tells or of its arrays."""
    path = folder / "user-1.npz"
    with np.load(path) as found:
        arrays = dict(found)
    told = json.loads(arrays["told"].tobytes())
    for name, change in how.items():
        kept = told if name in told else arrays
        kept[name] = change(kept[name])
    arrays["told"] = np.frombuffer(json.dumps(told).encode(), np.uint8)
    np.savez_compressed(path, **arrays)


def put(place: Any, number: float) -> Callable[[Any], Any]:
    """Return a change of one number of an array."""

    def change(array: Any) -> Any:
        array = array.copy()
        array[place] = number
        return array

    return change


@pytest.mark.parametrize(
    ("name", "change", "why"),
    [
        ("time", put(3, math.inf), "a time or signal is no finite number"),
        ("values", put((3, 0), math.nan), "a time or signal is no finite number"),
        ("time", put(3, 0.0), "its times do not increase"),
        ("time", put(-1, 1e9), "it leaves out a frame or more"),
        ("time", lambda array: array[:-1], "it has not one value of each signal at each time"),
        ("values", lambda array: array[:, 1:], "it has not one value of each signal at each time"),
        ("values", lambda array: array.ravel(), "its values has 1 dimensions, not 2"),
        ("values", lambda array: array.astype(object), "its values is no array of <f8"),
        ("late", put(0, -1.0), "a tick began, or took, no time there is"),
        ("took", put(0, math.inf), "a tick began, or took, no time there is"),
        ("took", lambda array: array[1:], "its ticks did not begin as often as they ended"),
        ("arrivals", put((0, 0), 1), "a packet came from where none comes"),
        ("arrivals", put((0, 1), -1), "a packet came from where none comes"),
        ("arrivals", put((0, 2), -1), "a packet has no time that there is"),
        ("arrivals", put((0, 2), 2**62), "a way has more than 10,000,000 packets"),
        ("arrivals", put((0, 3), -1), "a packet has no time that there is"),
        ("arrivals", put((0, 4), 2**63 - 1), "a packet came at no time that there is"),
        ("arrivals", lambda array: array[:, 1:], "what came is not told in five numbers"),
        ("packets0", put((0, 0), -2), "a packet has a number that none has"),
        ("packets0", lambda array: array[:, :0], "it hears other peers than the scene's"),
        ("missing0", lambda array: array[1:], "it hears other peers than the scene's"),
        ("missing0", lambda array: array.astype(np.int64), "its missing0 is no array of |b1"),
        ("number", lambda _: 1, "the scene has no such peer"),
        ("number", lambda _: -1, "the scene has no such peer"),
        ("name", lambda _: "../../x", "the scene has no such peer"),
        ("first", lambda _: -1, "it joins after the end"),
        ("first", lambda _: 10**30, "it joins after the end"),
        ("frames", lambda _: 0, "it joins after the end"),
        ("routes", lambda _: 10**30, "its links are not those it tells of"),
        ("routes", lambda _: 0, "its links are not those it tells of"),
        ("signals", lambda listed: listed[1:], "its signals are not those of the scene"),
        ("dropped", lambda _: {"late": -1}, "a count is negative"),
        ("dropped", lambda _: {"x": 1}, "datagrams are dropped for no known reason"),
        ("sent", lambda _: [[0, 1, -1]], "a count is negative"),
        ("sent", lambda _: [[9, 1, 1]], "it tells of a peer or link that isn't there"),
        ("offsets", lambda _: [[9, 0.0, 0.0]], "it tells of a peer or link that isn't there"),
        ("offsets", lambda _: [[1, math.nan, 0.0]], "what it tells is not what apc play writes"),
        ("stopped", lambda _: 1, "what it tells is not what apc play writes"),
        ("not_given", lambda _: ["\x1b[2J"], "what it tells is not what apc play writes"),
    ],
)
def test_what_no_peer_of_the_scene_can_have_done_is_refused(
    kept: Path, name: str, change: Callable[[Any], Any], why: str
) -> None:
    assert len(read_run(kept).peers) == 2
    changed(kept, **{name: change})
    (message,) = told(read_run, kept)
    assert message.startswith(f"{kept / 'user-1.npz'}: E973 is no peer of this run: {why}")


def test_a_run_beside_another_scene_is_refused(kept: Path) -> None:
    """One of the same structure, whose numbers differ: what happened would be laid beside its motion."""
    found = apc.load(kept / "scene.apc")
    apc.save(apc.set_parameters(found, {"coordination.stiffness": "600 N/m"}), kept / "scene.apc")
    assert "E973 its scene.apc is not the scene that was played" in told(lambda: read_run(kept))[0]


def test_what_is_no_file_of_a_peer_is_refused_at_once(kept: Path) -> None:
    path, bomb = kept / "user-1.npz", io.BytesIO()
    np.savez_compressed(bomb, told=np.zeros((8 << 20) - 128, np.uint8))
    path.write_bytes(
        bomb.getvalue().replace((8 << 20).to_bytes(4, "little"), (1 << 31).to_bytes(4, "little"))
    )
    assert "E973 is no peer of this run: it unpacks to more than 1024 MiB." in told(read_run, kept)[0]
    path.unlink()
    os.mkfifo(path)  # who opens it waits for ever
    assert "E973 is no peer of this run: is a device, pipe or socket." in told(read_run, kept)[0]
    path.unlink()
    path.symlink_to("user-2.npz")
    assert "E973 holds a peer twice" in told(read_run, kept)[0]
    (kept / "user-3.npz").symlink_to("user-2.npz")
    assert "E973 holds 3 peers of a scene with 2" in told(read_run, kept)[0]


def test_a_run_is_not_written_to_where_links_in_its_folder_lead(kept: Path, tmp_path: Path) -> None:
    found, mine = read_run(kept), tmp_path / "mine.txt"
    mine.write_text("mine", encoding="utf-8")
    names = sorted(path.name for path in kept.iterdir())
    assert len(names) == 5, "the scene, two peers and a way each"
    for name in names:
        (kept / name).unlink()
        (kept / name).symlink_to(mine)
    write_run(kept, found.system, found.peers)
    assert mine.read_text() == "mine"
    assert len(read_run(kept).peers) == 2


def test_what_cant_be_played_is_told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("three.yaml").write_text(MOVING, encoding="utf-8")
    taken = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    taken.bind(("127.0.0.1", 0))
    port = taken.getsockname()[1]
    other = ["--to", "user[2]=127.0.0.1:1", "--to", "user[3]=127.0.0.1:2"]
    Path("own").mkdir()
    Path("own/thesis.txt").write_text("mine", encoding="utf-8")
    Path("short.txt").write_text("abc", encoding="utf-8")
    Path("short.txt").chmod(0o600)
    Path("open to all.txt").write_text("sixteen bytes or more", encoding="utf-8")
    Path("open to all.txt").chmod(0o604)
    there = sorted(str(one) for one in Path().rglob("*"))
    listed = [
        (["--peer", "user[4]", *other], "E970 a peer wants one of user[1], user[2], user[3], got user[4]."),
        (["--peer", "user[1]", "--to", "user[9]=127.0.0.1:1"], '--to: E970 a peer wants one of user[1]'),
        (["--peer", "user[1]", "--to", "user[2]=127.0.0.1:1"], 'Write: --to "user[3]=HOST:PORT"'),
        (["--peer", "user[1]", *other, "--to", "user[2]=127.0.0.1:9"], "E971 user[2] is given twice"),
        (["--peer", "user[1]", *other, "--to", "user[1]=127.0.0.1:9"], "E971 user[1] is the peer that"),
        (["--peer", "user[1]", "--to", "user[2]=127.0.0.1:0"], '0. Write: --to "user[2]=192.'),
        (["--peer", "user[1]", *other[:2], "--to", "user[3]=127.0.0.1:1"], "two peers have one address"),
        (["--peer", "user[1]", "--to", "user[2]=[::1]:9"], "is not known by an IPv4 address"),
        (["--peer", "user[1]", *other, "--wait", "-1 s"], "E207 the time wants 0 s or more, got -1 s"),
        (["--peer", "user[1]", *other, "--out", "own"], "E973 is there already, and is no folder of a run"),
        (["--out", "three.yaml"], "E973 is there already, and is no folder."),
        (["--out", "no/such/folder"], "E601"),
        (["--peer", "user[1]", "--listen", "nowhere", *other], "E971 an address wants HOST:PORT"),
        (["--peer", "user[1]", "--to", "user[2]"], "E971 an address wants PEER=HOST:PORT"),
        (["--peer", "user[1]", "--listen", f"127.0.0.1:{port}", *other], f"can't listen at 127.0.0.1:{port}"),
        (["--peer", "user[1]", *other, "--wait", "100 ms"], "user[2], user[3] did not say within 0.1 s"),
        (["--peer", "user[1]", *other, "--device", "no.py"], "E976"),
        (["--out", "own"], "E973 is there already, and is no folder of a run"),
        (["--secret-file", "short.txt"], "E974 a secret wants 16 bytes or more, got 3."),
        (["--secret-file", "open to all.txt"], "users of this machine. Write: chmod 600 'open to all.txt'"),
        (["--secret-file", "none.txt"], "E974"),
    ]  # fmt: skip
    for words, message in listed:
        assert run(["play", "three.yaml", "--duration", "1 s", *words]) == 1, words
        assert message in " ".join(capsys.readouterr().err.split()), words
    assert Path("own/thesis.txt").read_text(encoding="utf-8") == "mine"
    assert sorted(str(one) for one in Path().rglob("*")) == there  # nothing is begun
    Path("empty").mkdir()
    assert run(["compare", "empty"]) == 1
    assert "E973" in capsys.readouterr().err
    alone = replaced(MOVING, ("{count: 3,", "{count: 65,"))
    Path("many.yaml").write_text(alone, encoding="utf-8")
    assert run(["play", "many.yaml", "--duration", "1 s"]) == 1
    assert "E975 65 peers would be as many processes: at most 64" in capsys.readouterr().err
    taken.close()


def test_a_ways_delays_begin_with_the_first_that_came_and_end_with_the_last(scene: CompiledSystem) -> None:
    loop = next(loops(scene, "1"))
    loop.player.arrivals = [(0, 1, 5, 40, 50), (0, 1, 7, 56, 70), (0, 2, 1, 8, 9)]
    found = delays_of(run_of(loop, DIGEST, ()), 0, 1)
    assert np.isinf(found[1])
    assert found[[0, 2]] == pytest.approx([10e-9, 14e-9])
    assert struct.calcsize("<d") == 8


def test_of_answers_the_shortest_round_trip_tells_a_clock_and_the_first_the_beginning(
    scene: CompiledSystem,
) -> None:
    """A peer that starts slowly answers old hellos: these are answers too."""
    loop = next(loops(scene, "1"))
    for asked, begins in ((1_000, 0), (2_000, 9_000), (1_000, 8_000)):
        loop._met(Answer(1, 5_000, 3, 4, asked, 4_000, begins, int(begins > 0)), 6_000)
    assert loop.offsets[1][0] == 6_000 - 2_000 - 1_000
    assert loop.told is not None
    assert loop.told.begins == 9_000


def test_what_ends_a_loop_leaves_what_was_done(scene: CompiledSystem, tmp_path: Path) -> None:
    """Told to end, however late it is; a device that raises, or gives no number, is told with its time."""
    faults = {
        "raise OSError('gone')": "raised OSError at 0.05 s: gone",
        "return None": "gave None as its position at 0.05 s",
        "return '1'": "gave '1' as its position at 0.05 s",
    }
    for fault, message in faults.items():
        text = f"def device(time, force):\n    if time >= 0.05:\n        {fault}\n    return 0.002\n"
        (tmp_path / "device.py").write_text(text, encoding="utf-8")
        every = list(loops(scene, "1/10"))
        others = dict(zip(("user[2]", "user[3]"), every[0].others.values(), strict=True))
        device = device_function(tmp_path / "device.py")
        own = Loop(
            scene,
            "user[1]",
            every[0].socket,
            others,
            digest=digest_of(scene),
            duration=Fraction(1, 10),
            device=device,
        )
        own.begins = 1  # long ago: every tick is late
        own.run()
        assert message in str(own.trouble)
        found = run_of(own, digest_of(scene), ())
        assert found.time[-1] == pytest.approx(0.047)  # of whole frames
        stop, end = multiprocessing.Pipe(duplex=False)
        told = Loop(
            scene,
            "user[1]",
            every[0].socket,
            others,
            digest=digest_of(scene),
            duration=Fraction(1, 10),
            stop=stop,
        )
        told.begins = 1
        end.close()
        told.run()
        assert told.stopped
        assert told.trouble is None


@pytest.mark.whole
def test_ctrl_c_ends_a_peer_and_what_it_did_is_kept(tmp_path: Path) -> None:
    """While it waits for others nothing is written; while it plays, alone or all, what was done is."""
    (tmp_path / "three.yaml").write_text(replaced(MOVING, ("{count: 3,", "{count: 2,")), encoding="utf-8")
    nobody = ("--peer", "user[1]", "--to", "user[2]=127.0.0.1:1", "--duration", "9 s", "--out", "no.run")
    waiting = command(tmp_path, *nobody, "--wait", "600 s")
    playing = command(tmp_path, "--duration", "600 s", "--out", "all.run")
    for _ in range(600):  # both print when they have been at work for so long
        if select.select([playing.stderr], [], [], 1.0)[0]:
            break
    for one in (waiting, playing):
        one.send_signal(signal.SIGINT)
    assert "stopped" in waiting.communicate(timeout=240)[1]
    assert waiting.returncode == 130
    assert not (tmp_path / "no.run").exists()
    told = playing.communicate(timeout=240)
    if playing.returncode != 130:  # the scene had begun
        assert playing.returncode == 0, told[1]
        assert "stopped before the end" in told[0]
        assert all(one.stopped for one in read_run(tmp_path / "all.run").peers)


def test_a_peer_that_is_lost_or_silent_takes_nothing_of_the_others_along(
    scene: CompiledSystem, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One ends at once with what it did, one is killed, one does not end when all are told to."""
    whole = run_of(next(loops(scene, "1")), digest_of(scene), ())
    ended: dict[str, Future[Part]] = {f"user[{at}]": Future() for at in (1, 2, 3)}
    ended["user[1]"].set_result(Part(whole))
    ended["user[2]"].set_exception(BrokenProcessPool())

    def workers(compute: object, shared: object, jobs: int, lost: Mistake) -> nullcontext[Workers[str, Part]]:
        assert jobs == 1
        return nullcontext(Workers(ended.__getitem__, 2, lambda _: ApcError(lost)))

    waits = iter([wait, None, wait])  # Ctrl-C when both have ended

    def waiting(*given: Any, **how: Any) -> Any:
        if (now := next(waits)) is None:
            raise KeyboardInterrupt
        return now(*given, **how)

    monkeypatch.setattr("apc.loop.start.local_processes", workers)
    monkeypatch.setattr("apc.loop.start.wait", waiting)
    monkeypatch.setattr("apc.loop.start.TO_END", 0.0)
    parts = play_all(scene, Play(Fraction(1), b"", emulate=False, seed=None, patience=1.0))
    assert [one.run for one in parts if one.run] == [whole]
    assert [str(one.trouble) for one in parts if one.trouble] == [
        "user[2]: E975 ended without a word: what it played is lost.",
        "user[3]: E975 did not end within 0 s of being told to, and was ended: what it played is lost.",
    ]


def written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def test_a_run_is_put_in_place_whole_or_not_at_all(
    scene: CompiledSystem, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a disk that is full after one of two peers the older run stays, and where none was, none is."""
    folder, save = tmp_path / "a.run", np.savez_compressed
    one, two, three = (run_of(loop, digest_of(scene), ()) for loop in loops(scene, "1"))
    one = replace(one, arrivals=np.array([[0, 1, 5, 40, 50]]))
    write_run(folder, scene, [one, two, three], whole=True)
    before = written(folder)
    assert sorted(before) == [
        "lan-user-2-to-user-1.csv",
        "scene.apc",
        *(f"user-{at}.npz" for at in (1, 2, 3)),
    ]

    def full(path: Path, **arrays: Any) -> None:
        if path.name == "user-2.npz":
            path.write_bytes(b"PK")
            raise OSError(errno.ENOSPC, "No space left on device")
        save(path, **arrays)

    monkeypatch.setattr(np, "savez_compressed", full)
    later = [replace(peer, session=7) for peer in (one, two)]
    for whole in (True, False):
        for target in (folder, tmp_path / "b.run"):
            with pytest.raises(ApcError, match=f"{target.name}: E601 can't be written: No space left"):
                write_run(target, scene, later, whole=whole)
    assert written(folder) == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.run"]
    monkeypatch.setattr(np, "savez_compressed", save)
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    write_run(folder, scene, [replace(three, session=7)])  # one that plays by itself
    with pytest.raises(ApcError, match="E973 holds peers that did not play together: of other runs"):
        read_run(folder)
    write_run(folder, scene, later, whole=True)
    assert sorted(written(folder)) == sorted(
        ["lan-user-2-to-user-1.csv", "notes.txt", "scene.apc", "user-1.npz", "user-2.npz"]
    )
    assert [peer.session for peer in read_run(folder).peers] == [7, 7]


def test_tables_fit_a_terminal_whatever_peers_are_called() -> None:
    name = "a_peer_with_a_long_name_of_its_own[1]"
    ticks = Ticks(name, 60_000, (1e-4,) * 4, (1e-4,) * 4, 0.0, stopped=False, not_given=(), dropped={})
    lines = ticks_text([ticks])
    assert max(map(len, lines)) <= 80
    assert f"  {name}" in lines
