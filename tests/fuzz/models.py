# ruff: noqa: E501 -- topologies, and lists of hostile values, read best as they are
"""Damaged and forged files: compiled models, what `apc run` recorded of a peer, parts of a sweep, networks.

Takes: a seed. Gives: `FORGERIES`; `zipped`, `recorded`.
Guarantees: of equal seed comes equal input, but for what a clock says in a recording; no forged model has a
seal, as whoever forges a file has none.
Does not: watch over what it runs (see `running`).
"""

from __future__ import annotations

import copy
import functools
import hashlib
import io
import json
import random
import socket
import tempfile
import threading
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from apc.api import analyze, critical, simulate
from apc.compiler.cache import FORMAT, Origin
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.compiler.store import model_of
from apc.inputs.open_model import load_fresh
from apc.realtime.peer import PeerLoop
from apc.realtime.peer_run import run_of, write_run
from apc.realtime.run_comparison import compare_run
from apc.realtime.run_folder import read_run
from apc.studies.finished_parts import open_parts
from apc.support.processes import digest_of
from tests.fuzz.inputs import MODELS, Input, any_value, mutated
from tests.fuzz.networks import ask_network, make_network, whole_networks
from tests.fuzz.trees import Pairs, Tree, as_json, changed, of_json
from tests.topologies import AVERAGE, replaced

FILE = "topology.apc"
_TOPOLOGIES = ("three-users-average", "users-table", "finger", "mixed-clocks", "experiment-mesh")
# In place of a text, a name, a number or all that a model was made from.
_HOSTILE = (
    *("", "..", "/etc/passwd", "../../x", "./users.csv", "/dev/zero", "x\0", "\x1b[31m", "Mass", "./parts/"),
    *("id > PWNED", "__import__('os').system('touch PWNED')", "1e999999999", "9" * 5000, "1/0", "held"),
    *(None, True, -1, 10**400, [], {}, [[]], [["a", "b"]], [[["hands", "held"]]], [[["device.mass", "1/0"]]]),
)
RUN, PEER = "a.run", "a.run/user-1.npz"
TARGET, SWEEP = Path("r.csv"), {"model": "abc"}
_CELLS = (np.array(["stable", "unstable"] * 20, dtype=object), np.linspace(0.0, 1.0, 40))
_NUMBERS = (None, True, False, 0, 1, -1, 2, 255, 2**31, 2**53, 2**62, 2**63 - 1, -(2**63), 10**400, -0.0, 0.5, 1e300, -1e300, 1e-300)  # fmt: skip
_FLOATS = (0.0, -1.0, -0.0, 1e-300, 1e300, -1e300, float("nan"), float("inf"), float("-inf"))
_SORTS = ("bytes", "document", "document", "document", "array", "array", "members")


def zipped(members: dict[str, bytes], *, kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a ZIP archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def _unzipped(content: bytes) -> dict[str, bytes]:
    with zipfile.ZipFile(io.BytesIO(content)) as archive:
        return {name: archive.read(name) for name in archive.namelist()}


def array(value: Any) -> bytes:
    """Return an array as a member of a file."""
    file = io.BytesIO()
    np.save(file, value)
    return file.getvalue()


# ---- forging ----


def _forged(rng: random.Random, content: bytes, *, name: str) -> tuple[str, bytes]:
    """Return what sort of forgery it is, and a forged archive.

    Parameters
    ----------
    rng
        The luck of it.
    content
        An archive.
    name
        Of the member that holds a document: JSON, or an array of its bytes.
    """
    sort = rng.choice(_SORTS)
    if sort == "bytes":
        return sort, mutated(rng, content)
    members = _unzipped(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        try:
            _change(rng, sort, members, _document(_unzipped(content)[name]), name)
        except (IndexError, KeyError, ValueError):
            break  # what it changes is gone already, or damaged
    return sort, zipped(members, kind=rng.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED)))


def _change(rng: random.Random, sort: str, members: dict[str, bytes], donor: Tree, name: str) -> None:
    """Change the document in the member of a name, or another member, once."""
    if sort == "document":
        tree = _document(members[name])
        changed(tree, rng, donor, value=lambda: _value(rng), key=lambda: "x")
        text = as_json(tree).encode()
        members[name] = array(np.frombuffer(text, np.uint8)) if name.endswith(".npy") else text
        return
    one = rng.choice(sorted(members.keys() - {name}))
    if sort == "array":
        members[one] = _changed_array(rng, members[one])
        return
    new = rng.choice((one, "x.npy", "../x.npy", "packets9.npy", "time", "told.npy.npy"))
    made = members.pop(one)
    members[new] = rng.choice((b"", b"\x93NUMPY", rng.randbytes(200), made, members[name]))


def _document(content: bytes) -> Tree:
    is_array = content.startswith(b"\x93NUMPY")
    return of_json(np.load(io.BytesIO(content)).tobytes() if is_array else content)


def _value(rng: random.Random) -> Tree:
    numbers = rng.choice((*_NUMBERS, *_FLOATS))
    huge = Pairs([["member", "array0"], ["shape", [10**9, 10**9]]])
    return rng.choice((numbers, numbers, any_value(rng), huge))


def _changed_array(rng: random.Random, content: bytes) -> bytes:
    """Return an array with another number, another shape or another head; of what is none, other bytes."""
    if not content.startswith(b"\x93NUMPY") or rng.random() < 0.2:
        return rng.choice((content[: len(content) // 2], content + rng.randbytes(16), mutated(rng, content)))
    value = np.load(io.BytesIO(content)).copy()
    if value.dtype.kind == "U" or not value.size or rng.random() < 0.3:
        others = (value.ravel()[:-1], value[None], value.T.copy(), value != 0)
        return array(rng.choice((*others, np.zeros(()), np.array(["x"]), np.zeros((10**6, 5)))))
    numbers = _FLOATS if value.dtype.kind == "f" else (0, 1, -1, -2, 2**31, 2**53, 2**63 - 1)
    with np.errstate(all="ignore"):
        value.flat[rng.choice((0, value.size - 1, rng.randrange(value.size)))] = np.array(
            rng.choice(numbers)
        ).astype(value.dtype)
    return array(value)


# ---- compiled models ----


@functools.cache
def bases() -> tuple[tuple[Origin, bytes], ...]:
    """Return whole models to start from: what each was made from, and itself."""
    found = (compile_topology(MODELS / "topologies" / f"{topology}.yaml") for topology in _TOPOLOGIES)
    return tuple((model.origin, model_of(model)) for model in found)


def unsealed(origin: bytes, model: bytes) -> bytes:
    """Return the file of a model that nobody has sealed."""
    head = f"apc {FORMAT} compiled".encode()
    checksum = hashlib.sha256(b"\n".join((head, origin, model))).hexdigest()
    return b"\n".join((head, b"0" * 64 + b" " + checksum.encode(), origin, model))


def _forge_model(seed: str) -> Input:
    """Return a model that says it was made from something else, or is something else."""
    chance = random.Random(seed)
    origin, model = chance.choice(bases())
    text = msgspec.json.encode(origin)
    sort = chance.choice(("origin", "origin", "model", "bytes"))
    if sort == "origin":
        document = json.loads(text)
        for _ in range(chance.choice((1, 1, 2))):
            document[chance.choice(list(document))] = copy.deepcopy(chance.choice(_HOSTILE))
            texts = document["texts"]
            if isinstance(texts, list) and texts and isinstance(texts[0], list):
                row = chance.choice(texts)
                row[:1] = [copy.deepcopy(chance.choice(_HOSTILE))] if chance.random() < 0.3 else row[:1]
        text = json.dumps(document).encode()
    elif sort == "model":
        model = chance.randbytes(chance.choice((0, 1, 100, len(model))))
    content = bytearray(unsealed(text, model))
    if sort == "bytes":
        for _ in range(chance.randint(1, 4)):
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    return Input(sort, ((FILE, bytes(content)),))


def _whole_models() -> list[Input]:
    """Return models that nobody sealed and nobody changed, each asked everything once: that loads all."""
    files = [unsealed(msgspec.json.encode(origin), model) for origin, model in bases()]
    with tempfile.TemporaryDirectory() as name:
        for content in files:
            (Path(name) / FILE).write_bytes(content)
            assert ask(Path(name) / FILE, everything=True) == "answered"
    return [Input("", ((FILE, content),)) for content in files]


def ask(path: Path, *, everything: bool = False) -> str:
    """Ask a file's questions; return "answered", or "refused" if that was with a mistake of the file's.

    The one that takes longest is asked of one file in eight, or with `everything` of any; in mean square it
    would take many times as long, and `analyze` asks what it asks of the network.
    """
    try:
        model = load_fresh(path)
    except ApcError:
        return "refused"
    first = model.parameters[0].name if model.parameters else "device.mass"
    questions: list[Callable[[], object]] = [
        lambda: analyze(model),
        lambda: simulate(model, duration="20 ms", jit=False),
    ]
    if everything or path.stat().st_size % 8 == 0:
        questions.append(lambda: critical(model, first, criterion="nominal"))
    for question in questions:
        try:
            question()
        except ApcError:  # it is told
            continue
    return "answered"


# ---- recordings and parts of sweeps ----


@functools.cache
def recorded() -> dict[str, bytes]:
    """Return the files of a run of two peers, played here for some milliseconds."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        moving = replaced(AVERAGE, ("{count: 3}", "{count: 2, set: {device.x: 3 mm}}"))
        (folder / "topology.yaml").write_text(moving, encoding="utf-8")
        model = compile_topology(folder / "topology.yaml")
        names = ("user[1]", "user[2]")
        sockets = {peer: socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for peer in names}
        for one in sockets.values():
            one.bind(("127.0.0.1", 0))
        loops = [
            PeerLoop(model, peer, sockets[peer], others, digest=digest_of(model), duration=Fraction(1, 20))
            for peer in names
            for others in [{one: to.getsockname() for one, to in sockets.items() if one != peer}]
        ]
        threads = [threading.Thread(target=lambda one=one: (one.meet(60), one.run())) for one in loops]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join()
        write_run(folder / RUN, model, [run_of(loop, digest_of(model), ()) for loop in loops])
        return {path.name: path.read_bytes() for path in sorted((folder / RUN).iterdir())}


def _forge_recording(seed: str) -> Input:
    """Return the files of a run, one of its peers forged; of no seed, those that nobody changed."""
    files = {f"{RUN}/{name}": content for name, content in recorded().items()}
    sort = ""
    if seed:
        peer = files[PEER]
        sort, files[PEER] = _forged(random.Random(seed), peer, name="told.npy")
    return Input(sort, tuple(files.items()))


def _ask_recording() -> str:
    """Read the run in this folder and lay it beside its topology, unless it is refused."""
    try:
        run = read_run(Path(RUN))
    except ApcError as error:
        assert {one.code for one in error.mistakes} == {"E973"}, str(error)
        return "refused"
    try:
        compared = compare_run(run)
    except ApcError:  # a delay of years, say, which nothing is computed with
        return "refused"
    assert str(compared)
    assert json.dumps(compared.to_dict(), allow_nan=False)
    return "answered"


@functools.cache
def _part() -> tuple[str, bytes]:
    """Return the name and the bytes of a part that this user's apc wrote."""
    with tempfile.TemporaryDirectory() as name:
        parts = open_parts(Path(name) / TARGET, SWEEP)
        parts.write(0, _CELLS)
        [path] = parts.folder.iterdir()
        return f"{TARGET}.parts/{path.name}", path.read_bytes()


def _forge_part(seed: str) -> Input:
    """Return the file of a forged part of a sweep; some have the seal that they had."""
    rng = random.Random(seed)
    name, content = _part()
    if not seed:
        return Input("", ((name, content),))
    mark, _, body = content.partition(b"\n")
    sort, forged = _forged(rng, body, name="texts.npy")
    line = rng.choice((mark + b"\n", mark + b"\n", mark, b"\n", b"", b"0" * 64 + b"\n"))
    return Input(sort, ((name, line + forged),))


def _ask_part() -> str:
    """Read the part in this folder: it is what it was, or it is computed again."""
    name, content = _part()
    cells = open_parts(TARGET, SWEEP).read(0)
    assert (cells is None) == (Path(name).read_bytes() != content)
    return "refused" if cells is None else "answered"


@dataclass(frozen=True, slots=True)
class Forgery:
    """Makes a file of a seed, asks what it is asked in its folder, and has whole ones, which are answered.

    `seconds` of processor time and `memory` in bytes are the most that one may take.
    """

    make: Callable[[str], Input]
    ask: Callable[[], str]
    whole: Callable[[], list[Input]]
    seconds: float = 60.0
    memory: int = 1 << 30


FORGERIES = {
    "models": Forgery(_forge_model, lambda: ask(Path(FILE)), _whole_models),
    "recordings": Forgery(_forge_recording, _ask_recording, lambda: [_forge_recording("")]),
    "parts": Forgery(_forge_part, _ask_part, lambda: [_forge_part("")]),
    "networks": Forgery(make_network, ask_network, whole_networks, seconds=1.0, memory=200 << 20),
}
