"""Files of a run of `apc run`: written whole or not at all, read as data, refused where no run can be."""

from __future__ import annotations

import errno
import io
import json
import math
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import apc
from apc.compiler.errors import ApcError
from apc.realtime.peer_run import PeerRun, run_of, write_run
from apc.realtime.run_folder import read_run
from apc.support.processes import digest_of
from tests.fuzz.models import recorded
from tests.surfaces.wire import Wire, loop_at
from tests.topologies import AVERAGE, compiled, messages_of


@pytest.fixture
def stored(tmp_path: Path) -> Path:
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
    reported = json.loads(arrays["record"].tobytes())
    for name, change in how.items():
        stored = reported if name in reported else arrays
        stored[name] = change(stored[name])
    arrays["record"] = np.frombuffer(json.dumps(reported).encode(), np.uint8)
    np.savez_compressed(path, **arrays)


def put(place: Any, number: float) -> Callable[[Any], Any]:
    """Return a change of one number of an array."""

    def change(array: Any) -> Any:
        array = array.copy()
        array[place] = number
        return array

    return change


@pytest.mark.few(12)
@pytest.mark.parametrize(
    ("name", "change", "why"),
    [
        ("time", put(3, math.inf), "a time or signal is not finite"),
        ("time", put(3, 0.0), "its times do not increase"),
        ("time", put(-1, 1e9), "a frame is missing"),
        ("time", lambda array: array[:-1], "the numbers of values and times differ"),
        ("values", lambda array: array.ravel(), "its values has 1 dimensions, not 2"),
        ("delayed", put(0, -1.0), "a time of a tick is negative or not finite"),
        ("took", put(0, math.inf), "a time of a tick is negative or not finite"),
        ("took", lambda array: array[1:], "the numbers of begun and completed ticks differ"),
        ("arrivals", put((0, 0), 1), "a packet is from an unconnected peer"),
        ("arrivals", put((0, 2), 2**62), "a directed connection has more than 10,000,000 packets"),
        ("arrivals", put((0, 3), -1), "a packet has an invalid time"),
        ("arrivals", put((0, 4), 2**63 - 1), "a packet has an invalid arrival time"),
        ("arrivals", lambda array: array[:, 1:], "an arrival does not have five numbers"),
        ("packets0", put((0, 0), -2), "a packet has an invalid number"),
        ("packets0", lambda array: array[:, :0], "its senders are not those of the topology"),
        ("missing0", lambda array: array.astype(np.int64), "its missing0 is not an array of |b1"),
        ("number", lambda _: 1, "the topology has no such peer"),
        ("name", lambda _: "../../x", "the topology has no such peer"),
        ("first", lambda _: -1, "it joins after the end"),
        ("signals", lambda listed: listed[1:], "its signals are not those of the topology"),
        ("dropped", lambda _: {"late": -1}, "a count is out of range"),
        ("dropped", lambda _: {"x": 1}, "the reason of a dropped datagram is unknown"),
        ("sent", lambda _: {0: {1: -1}}, "a count is out of range"),
        ("sent", lambda _: {9: {1: 1}}, "it names an unknown peer or link"),
        ("offsets", lambda _: {9: [0.0, 0.0]}, "it names an unknown peer or link"),
        ("offsets", lambda _: {1: [math.nan, 0.0]}, "its record was not written by apc run"),
        ("stopped", lambda _: 1, "its record was not written by apc run"),
        ("not_granted", lambda _: ["\x1b[2J"], "its record was not written by apc run"),
    ],
)
def test_what_no_peer_of_the_topology_can_have_done_is_refused(
    stored: Path, name: str, change: Callable[[Any], Any], why: str
) -> None:
    assert len(read_run(stored).peers) == 2
    changed(stored, **{name: change})
    (message,) = messages_of(read_run, stored)
    assert message.startswith(f"{stored / 'user-1.npz'}: E973 is not a peer of this run: {why}")


def test_a_run_beside_another_topology_is_refused(stored: Path) -> None:
    """One of the same structure, whose numbers differ: what happened would be laid beside its motion."""
    found = apc.load(stored / "topology.apc")
    apc.save(apc.set_parameters(found, {"coordination.stiffness": "600 N/m"}), stored / "topology.apc")
    assert "E973 its topology.apc is not the topology of the run" in messages_of(lambda: read_run(stored))[0]


def test_what_is_no_file_of_a_peer_is_refused_at_once(stored: Path) -> None:
    path, bomb = stored / "user-1.npz", io.BytesIO()
    np.savez_compressed(bomb, told=np.zeros((8 << 20) - 128, np.uint8))
    path.write_bytes(
        bomb.getvalue().replace((8 << 20).to_bytes(4, "little"), (1 << 31).to_bytes(4, "little"))
    )
    assert (
        "E973 is not a peer of this run: it unpacks to more than 1024 MiB."
        in messages_of(read_run, stored)[0]
    )
    path.unlink()
    os.mkfifo(path)  # who opens it waits for ever
    assert "E973 is not a peer of this run: is a device, pipe or socket." in messages_of(read_run, stored)[0]
    path.unlink()
    path.symlink_to("user-2.npz")
    assert "E973 contains a peer twice" in messages_of(read_run, stored)[0]
    (stored / "user-3.npz").symlink_to("user-2.npz")
    assert "E973 has 3 peers of a topology with 2" in messages_of(read_run, stored)[0]


def test_a_run_is_not_written_to_where_links_in_its_folder_lead(stored: Path, tmp_path: Path) -> None:
    found, mine = read_run(stored), tmp_path / "mine.txt"
    mine.write_text("mine", encoding="utf-8")
    names = sorted(path.name for path in stored.iterdir())
    assert len(names) == 5, "the topology, two peers and a way each"
    for name in names:
        (stored / name).unlink()
        (stored / name).symlink_to(mine)
    write_run(stored, found.model, found.peers)
    assert mine.read_text() == "mine"
    assert len(read_run(stored).peers) == 2


def written(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in folder.iterdir()}


def renamed(peer: PeerRun, at: int) -> PeerRun:
    name = f"user[{at + 1}]"
    signals = tuple(one.replace("user[1]", name) for one in peer.signals)
    return replace(peer, number=at, name=name, signals=signals)


def test_a_run_is_put_in_place_whole_or_not_at_all(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """On a disk that is full after one of two peers the older run stays, and where none was, none is."""
    folder, save = tmp_path / "a.run", np.savez_compressed
    topology = compiled(AVERAGE)
    digest = digest_of(topology)
    first = run_of(loop_at(Wire(monkeypatch), topology, digest, b""), digest, ())
    one, two, three = (renamed(first, at) for at in range(3))
    one = replace(one, arrivals=np.array([[0, 1, 5, 40, 50]]))
    write_run(folder, topology, [one, two, three], whole=True)
    before = written(folder)
    assert sorted(before) == [
        "lan-user-2-to-user-1.csv",
        "topology.apc",
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
                write_run(target, topology, later, whole=whole)
    assert written(folder) == before
    assert [path.name for path in tmp_path.iterdir()] == ["a.run"]
    monkeypatch.setattr(np, "savez_compressed", save)
    (folder / "notes.txt").write_text("mine", encoding="utf-8")
    write_run(folder, topology, [replace(three, session=7)])  # one that plays by itself
    with pytest.raises(ApcError, match="E973 has peers of different runs"):
        read_run(folder)
    write_run(folder, topology, later, whole=True)
    assert sorted(written(folder)) == sorted(
        ["lan-user-2-to-user-1.csv", "notes.txt", "topology.apc", "user-1.npz", "user-2.npz"]
    )
    assert [peer.session for peer in read_run(folder).peers] == [7, 7]
