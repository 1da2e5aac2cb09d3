# ruff: noqa: E501 -- scenes, and lists of hostile values, read best as they are
"""Damaged and forged files: compiled models, what `apc play` recorded of a peer, parts of a sweep.

Takes: a seed. Gives: `FORGERIES`; `zipped`, `packed`, `recorded`.
Guarantees: of equal seed comes equal input, but for what a clock says in a recording; every digest of a model
is that of what it stands for, as whoever forges a file makes it.
Does not: watch over what it runs (see `running`).
"""

from __future__ import annotations

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

import numpy as np

import apc
from apc.compiler import store
from apc.compiler.cache import MEMBER
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.loop.beside import compare_run
from apc.loop.peer import Loop
from apc.loop.reading import read_run
from apc.loop.run import run_of, write_run
from apc.processes import digest_of
from apc.sweeps.store import open_parts
from tests.fuzz.inputs import MODELS, Input, any_value, mutated
from tests.fuzz.trees import Pairs, Tree, as_json, changed, of_json
from tests.topologies import AVERAGE, replaced

FILE = "scene.apc"
_PART = """\
component: Cubic
about: A spring that hardens, given the wrong way round.
connectors: {flange: Flange}
parameters: {stiffness: {unit: N/m, min: 0}, soft: {unit: N^-2, min: 0}}
variables: {f: {unit: N}}
equations:
  - f + soft*f^3 = stiffness*flange.x
  - flange.f = f
"""
_LOOP = """\
topology: scene
library: parts
clocks: {tick: 1 ms}
peers: {user: {count: 2}}
masses: {device: {mass: 1 kg, damping: 2 N*s/m, x: 1 mm}}
couplers:
  tie: {type: Cubic, flange: device, stiffness: 3 N/m, soft: 0.1 N^-2}
  wall: {type: VirtualWall, flange: device, stiffness: 900 N/m, clock: tick}
"""
_EDGES = """\
topology: scene
clocks: {haptic: 1 ms, network: 8 ms}
parameters: {kt: 500 N/m}
peers:
  one: {count: 1, set: {device.mass: 1 kg}}
  two: {count: 2, set: {device.mass: [0.1 kg, 0.2 kg]}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}, cube: {mass: 0.6 kg, damping: 5 N*s/m, shared: true}}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms}
  coordination: {type: SaturatedMesh, object: cube, stiffness: "max(kt, 0.3*kt)/(peers - 1)", limit: 1 N, clock: haptic, link: lan}
links: {lan: {graph: {edges: [[1, 2], [2, 3], [3, 1]]}, clock: network, delay: 8 ms, loss: 10 %, jitter: 1 ms}}
hands: {hand: {type: ConstantForce, flange: device, force: 1 N, at: [one]}}
experiment: {duration: 20 ms}
"""
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


def packed(document: Any, members: dict[str, bytes], *, kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return the file of a compiled model: its document and its arrays, with the digests that they have."""
    return zipped(_digested({MEMBER: json.dumps(document).encode(), **members}), kind=kind)


def _digested(members: dict[str, bytes]) -> dict[str, bytes]:
    """Return the members of a model, the digests in its document those of the others."""
    tree = of_json(members[MEMBER])
    others = {name: content for name, content in members.items() if name != MEMBER}
    for pair in tree if isinstance(tree, Pairs) else ():
        if pair[0] == "members" and isinstance(pair[1], Pairs):
            pair[1] = Pairs([[name, hashlib.sha256(one).hexdigest()] for name, one in others.items()])
    return {MEMBER: as_json(tree).encode(), **others}


def array(value: Any) -> bytes:
    """Return an array as a member of a file."""
    file = io.BytesIO()
    np.save(file, value)
    return file.getvalue()


# ---- forging ----


def _forged(
    rng: random.Random, content: bytes, donor: bytes, *, name: str, digested: bool
) -> tuple[str, bytes]:
    """Return what sort of forgery it is, and a forged archive.

    Parameters
    ----------
    rng
        The luck of it.
    content, donor
        An archive, and one from whose document a part may come.
    name
        Of the member that holds a document: JSON, or an array of its bytes.
    digested
        Whether the document holds the others' digests, which are made to fit.
    """
    sort = rng.choice(_SORTS)
    if sort == "bytes":
        return sort, mutated(rng, content)
    members = _unzipped(content)
    for _ in range(rng.choice((1, 1, 1, 2, 5))):
        try:
            _change(rng, sort, members, _document(_unzipped(donor)[name]), name)
        except (IndexError, KeyError, ValueError):
            break  # what it changes is gone already, or damaged
    members = _digested(members) if digested else members
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
def bases() -> tuple[bytes, ...]:
    """Return whole models to start from."""
    files = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "parts").mkdir()
        (folder / "parts" / "cubic.yaml").write_text(_PART, encoding="utf-8")
        scenes = ("three-users-average", "users-table", "finger", "mixed-clocks", "experiment-mesh")
        paths = [MODELS / "scenes" / f"{scene}.yaml" for scene in scenes]
        for place, text in enumerate((_LOOP, _EDGES)):
            paths.append(folder / f"scene{place}.yaml")
            paths[-1].write_text(text, encoding="utf-8")
        for path in paths:
            store.save(compile_topology(path), folder / FILE)
            files.append((folder / FILE).read_bytes())
    return tuple(files)


def _forge_model(seed: str) -> Input:
    rng = random.Random(seed)
    sort, content = _forged(rng, rng.choice(bases()), rng.choice(bases()), name=MEMBER, digested=True)
    return Input(sort, ((FILE, content),))


def ask(path: Path, *, everything: bool = False) -> str:
    """Ask a file's questions; return "answered", or "refused" if that was with a mistake of the file's.

    The one that takes longest is asked of one file in eight, or with `everything` of any; in mean square it
    would take many times as long, and `analyze` asks what it asks of the network.
    """
    try:
        system = store.load(path)
    except ApcError as error:
        assert {one.code for one in error.mistakes} <= {"E602", "E603", "E604"}, str(error)
        return "refused"
    first = system.parameters[0].name if system.parameters else "device.mass"
    questions: list[Callable[[], object]] = [
        lambda: apc.analyze(system),
        lambda: apc.simulate(system, duration="20 ms", jit=False),
    ]
    if everything or path.stat().st_size % 8 == 0:
        questions.append(lambda: apc.critical(system, first, criterion="nominal"))
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
        (folder / "scene.yaml").write_text(moving, encoding="utf-8")
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


def _forge_recording(seed: str) -> Input:
    """Return the files of a run, one of its peers forged; of no seed, those that nobody changed."""
    files = {f"{RUN}/{name}": content for name, content in recorded().items()}
    sort = ""
    if seed:
        peer = files[PEER]
        sort, files[PEER] = _forged(random.Random(seed), peer, peer, name="told.npy", digested=False)
    return Input(sort, tuple(files.items()))


def _ask_recording() -> str:
    """Read the run in this folder and lay it beside its scene, unless it is refused."""
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
    sort, forged = _forged(rng, body, body, name="texts.npy", digested=False)
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
    """Makes a file of a seed, asks what it is asked in its folder, and has whole ones, which are answered."""

    make: Callable[[str], Input]
    ask: Callable[[], str]
    whole: Callable[[], list[Input]]


FORGERIES = {
    "models": Forgery(
        _forge_model,
        lambda: ask(Path(FILE)),
        lambda: [Input("", ((FILE, one),)) for one in bases()],
    ),
    "recordings": Forgery(_forge_recording, _ask_recording, lambda: [_forge_recording("")]),
    "parts": Forgery(_forge_part, _ask_part, lambda: [_forge_part("")]),
}
