"""Damaged and forged files of arrays: what `apc play` recorded of a peer, and a part of a sweep.

Takes: a seed. Gives: `forge_recording`, `forge_part`: a sort of forgery and a folder's files; `recording`,
`part`: those that are whole; `ask_recording`, `ask_part`.
Guarantees: of equal seed comes equal input, but for what a clock says in a recording.
Does not: watch over what it runs (see `running`).
"""

from __future__ import annotations

import functools
import io
import json
import random
import socket
import tempfile
import threading
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np

from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.loop.beside import compare_run
from apc.loop.peer import Loop
from apc.loop.reading import read_run
from apc.loop.run import run_of, write_run
from apc.processes import digest_of
from apc.sweeps.store import open_parts
from tests.fuzz.models import zipped
from tests.topologies import AVERAGE, replaced

Files = tuple[tuple[str, bytes], ...]

RUN, PEER = "a.run", "a.run/user-1.npz"
TARGET, SWEEP = Path("r.csv"), {"model": "abc"}
_MOVING = replaced(AVERAGE, ("{count: 3}", "{count: 2, set: {device.x: 3 mm}}"))
_CELLS = (np.array(["stable", "unstable"] * 20, dtype=object), np.linspace(0.0, 1.0, 40))
_HOSTILE: tuple[Any, ...] = (
    *(None, True, "", "x", "../x", "x\n", [], {}, [[]], -1, 0, 1, 2, 10**9, 2**62, 2**63, 10**30, 0.5, -0.5),
    *(
        1e300,
        float("nan"),
        float("inf"),
        "user[2]",
        "0" * 64,
        [[0, 1, 2]],
        [[0, 0.5, 1]],
        {"late": -1},
        {"x": 1},
    ),
)
_NUMBERS = (0, 1, -1, -2, 2**31, 2**53, 2**62, 2**63 - 1, -(2**63))
_FLOATS = (0.0, -1.0, -0.0, 1e-300, 1e300, -1e300, float("nan"), float("inf"), float("-inf"))


@functools.cache
def recorded() -> dict[str, bytes]:
    """Return the files of a run of two peers, played here for some milliseconds."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "scene.yaml").write_text(_MOVING, encoding="utf-8")
        system = compile_topology(folder / "scene.yaml")
        names = ("user[1]", "user[2]")
        sockets = {peer: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for peer in names}
        for one in sockets.values():
            one.bind(("127.0.0.1", 0))
        loops = [
            Loop(system, peer, sockets[peer], others, digest=digest_of(system), duration=Fraction(1, 20))
            for peer in names
            for others in [{one: to.getsockname() for one, to in sockets.items() if one != peer}]
        ]
        threads = [threading.Thread(target=lambda one=one: (one.meet(60), one.run())) for one in loops]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        write_run(folder / RUN, system, [run_of(loop, digest_of(system), ()) for loop in loops])
        return {path.name: path.read_bytes() for path in sorted((folder / RUN).iterdir())}


@functools.cache
def _part() -> tuple[str, bytes]:
    """Return the name and the bytes of a part that this user's apc wrote."""
    with tempfile.TemporaryDirectory() as name:
        parts = open_parts(Path(name) / TARGET, SWEEP)
        parts.write(0, _CELLS)
        [path] = parts.folder.iterdir()
        return f"{TARGET}.parts/{path.name}", path.read_bytes()


def array(value: Any) -> bytes:
    """Return an array as a member of a file."""
    file = io.BytesIO()
    np.save(file, value)
    return file.getvalue()


def _opened(content: bytes) -> dict[str, bytes]:
    with np.load(io.BytesIO(content)) as found:
        return {f"{name}.npy": array(found[name]) for name in found}


def recording() -> Files:
    """Return the files of a run as they are."""
    return tuple((f"{RUN}/{name}", content) for name, content in recorded().items())


def part() -> Files:
    """Return the file of a part as it is."""
    return (_part(),)


def forge_recording(seed: str) -> tuple[str, Files]:
    """Return the files of a run, one of its peers forged."""
    files = dict(recording())
    sort, files[PEER] = _forged(random.Random(seed), files[PEER])
    return sort, tuple(files.items())


def forge_part(seed: str) -> tuple[str, Files]:
    """Return the file of a forged part of a sweep; some have the seal that they had."""
    chance = random.Random(seed)
    name, content = _part()
    mark, _, body = content.partition(b"\n")
    sort, forged = _forged(chance, body)
    line = chance.choice((mark + b"\n", mark + b"\n", mark, b"\n", b"", b"0" * 64 + b"\n"))
    return sort, ((name, line + forged),)


def _forged(chance: random.Random, content: bytes) -> tuple[str, bytes]:
    sort = chance.choice(("bytes", "cut", "told", "numbers", "numbers", "shape", "members", "head"))
    if sort == "bytes":
        data = bytearray(content)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        return sort, bytes(data)
    if sort == "cut":
        at = chance.randrange(len(content))
        return sort, chance.choice((content[:at], content[at:], content + content[at:], b"", b"PK"))
    members = _opened(content)
    for _ in range(chance.choice((1, 1, 2))):
        try:
            _change(chance, members, sort)
        except (IndexError, KeyError, TypeError, ValueError):
            break  # what it changes is gone already
    return sort, zipped(members, kind=chance.choice((0, 8)))


def _change(chance: random.Random, members: dict[str, bytes], sort: str) -> None:
    name = chance.choice(sorted(members)) if members else "time.npy"
    if sort == "members":
        match chance.randrange(4):
            case 0:
                members.pop(name, None)
            case 1:
                members[chance.choice(("x.npy", "../x.npy", "packets9.npy", "time", "told.npy.npy"))] = b""
            case 2:
                members[name] = chance.choice((b"", b"\x93NUMPY", chance.randbytes(200)))
            case _:
                members[name] = members[chance.choice(sorted(members))]
        return
    if sort == "head":
        data = bytearray(members[name])
        data[chance.randrange(min(len(data), 128))] = chance.randrange(256)
        members[name] = bytes(data)
        return
    if sort == "told":
        name = "told.npy" if "told.npy" in members else "texts.npy"
        document = json.loads(np.load(io.BytesIO(members[name])).tobytes())
        key = (
            chance.choice(sorted(document)) if isinstance(document, dict) else chance.randrange(len(document))
        )
        document[key] = chance.choice(_HOSTILE)
        members[name] = array(np.frombuffer(json.dumps(document).encode(), np.uint8))
        return
    value = np.load(io.BytesIO(members[name])).copy()
    if value.dtype.kind == "U":
        return
    if sort == "shape" or not value.size:
        members[name] = array(
            chance.choice(
                (
                    *(
                        value[:0],
                        value[:-1],
                        value.ravel(),
                        value[None],
                        value.T.copy(),
                        np.zeros(()),
                        value[::-1],
                    ),
                    *(
                        np.concatenate([value, value]),
                        value.astype(np.float32),
                        np.array(["x"]),
                        value != 0,
                    ),
                    *(np.zeros(10**7), np.zeros((0, 5)), np.zeros((10**6, 5), np.int64)),
                )
            )
        )
        return
    flat = value.reshape(-1)
    place = chance.choice((0, -1, chance.randrange(len(flat))))
    with np.errstate(all="ignore"):
        number = chance.choice(_FLOATS if value.dtype.kind == "f" else _NUMBERS)
        flat[place] = np.array(number).astype(value.dtype)
    members[name] = array(value)


def ask_recording() -> str:
    """Read the run in this folder and lay it beside its scene, unless it is refused."""
    try:
        run = read_run(Path(RUN))
    except ApcError as error:
        assert {one.code for one in error.mistakes} == {"E973"}, str(error)
        return "refused"
    try:
        found = compare_run(run)
    except ApcError:  # a delay of years, say, which nothing is computed with
        return "refused"
    assert str(found) and json.dumps(found.to_dict(), allow_nan=False)
    return "answered"


def ask_part() -> str:
    """Read the part in this folder: it is what it was, or it is computed again."""
    parts = open_parts(TARGET, SWEEP)
    name, content = _part()
    cells = parts.read(0)
    assert (cells is None) == (Path(name).read_bytes() != content)
    return "refused" if cells is None else "answered"
