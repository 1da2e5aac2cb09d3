# ruff: noqa: E501 -- lists of hostile values, and models in text, read best as they are
"""Forged compiled models: files that say of themselves that they are whole, with anything inside.

Takes: a seed. Gives: `forge`, a file's bytes and what sort of forgery they are; `bases`, `packed`, `zipped`; `ask`.
Guarantees: of equal seed comes equal input; every digest is that of what it stands for, as whoever forges a file
makes it.
Does not: watch over what it runs (see `running`).
"""

from __future__ import annotations

import copy
import functools
import hashlib
import io
import json
import random
import tempfile
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from apc.api import analyze, critical, simulate
from apc.compiler import store
from apc.compiler.cache import MEMBER
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology

FILE = "scene.apc"
_MODELS = Path(__file__).resolve().parents[2] / "models" / "scenes"
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
_HOSTILE: tuple[Any, ...] = (
    *(
        None,
        True,
        False,
        0,
        1,
        -1,
        2,
        7,
        255,
        10**6,
        2**31,
        2**63,
        10**18,
        -(10**18),
        10**400,
        1.5,
        -0.0,
        1e308,
    ),
    *(
        1e-308,
        float("inf"),
        float("-inf"),
        float("nan"),
        "",
        "0",
        "1/0",
        "1/3",
        "-1",
        "1e9",
        "1e999999999",
        "9" * 5000,
    ),
    *(
        "nan",
        "x",
        "x" * 10_000,
        "lan",
        "kt",
        "device.x",
        "derivative",
        "id > PWNED",
        "\x1b[31m",
        "\ud800",
        "0/0",
    ),
    *(
        "9^9^9^9",
        "__import__('os').system('touch PWNED')",
        "../../x",
        "a; b",
        '"',
        "shell",
        "jit",
        "add",
        "pow",
    ),
    *([], {}, [[]], [0], [[0, 0]], ["add", 0, 0], {"member": "array0", "shape": [10**9, 10**9]}, [None] * 50),
)


@dataclass(frozen=True, slots=True)
class Forged:
    """A file's bytes, and in a word what sort of forgery it is."""

    sort: str
    content: bytes


@functools.cache
def bases() -> tuple[tuple[dict[str, Any], dict[str, bytes]], ...]:
    """Return whole models to start from: the document and the arrays of each."""
    found = []
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "parts").mkdir()
        (folder / "parts" / "cubic.yaml").write_text(_PART, encoding="utf-8")
        for text in (_LOOP, _EDGES):
            (folder / "scene.yaml").write_text(text, encoding="utf-8")
            found.append(_parts_of(compile_topology(folder / "scene.yaml"), folder))
        scenes = ("three-users-average", "users-table", "finger", "mixed-clocks", "experiment-mesh")
        found += [_parts_of(compile_topology(_MODELS / f"{scene}.yaml"), folder) for scene in scenes]
    return tuple(found)


def _parts_of(system: CompiledSystem, folder: Path) -> tuple[dict[str, Any], dict[str, bytes]]:
    path = folder / FILE
    store.save(system, path)
    with zipfile.ZipFile(path) as archive:
        document = json.loads(archive.read(MEMBER))
        return document, {member: archive.read(member) for member in document["members"]}


def packed(document: Any, members: dict[str, bytes], *, kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return the file of a document and its arrays, with the digests that they have."""
    if isinstance(document, dict) and isinstance(document.get("members"), dict):
        digests = {name: hashlib.sha256(content).hexdigest() for name, content in members.items()}
        document = {**document, "members": digests}
    return zipped({MEMBER: json.dumps(document).encode(), **members}, kind=kind)


def zipped(members: dict[str, bytes], *, kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a ZIP archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def forge(seed: str) -> Forged:
    """Return a forged file."""
    chance = random.Random(seed)
    document, members = copy.deepcopy(chance.choice(bases()))
    sort = chance.choice(
        ("value", "value", "value", "move", "number", "function", "function", "array", "bytes")
    )
    for _ in range(chance.choice((1, 1, 1, 2, 5))):
        try:
            _SORTS[sort](chance, document, members)
        except (IndexError, KeyError, TypeError):
            break  # what it changes is gone already
    content = packed(document, members, kind=chance.choice((zipfile.ZIP_DEFLATED, zipfile.ZIP_STORED)))
    if sort == "bytes":
        data = bytearray(content)
        for _ in range(chance.randint(1, 4)):
            data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
        content = bytes(data)
    return Forged(sort, content)


def _places(value: Any, wanted: Callable[[Any], bool] = lambda one: True) -> list[tuple[Any, Any]]:
    """Return every place in a document whose value is wanted, as (what holds it, where in that)."""
    found = []
    waiting = [value]
    while waiting:
        holder = waiting.pop()
        for key in range(len(holder)) if isinstance(holder, list) else list(holder):
            if wanted(holder[key]):
                found.append((holder, key))
            if isinstance(holder[key], dict | list):
                waiting.append(holder[key])
    return found


def _value(chance: random.Random, document: Any, members: dict[str, bytes]) -> None:
    """Put something else in a place, or take the place away, or have it twice."""
    holder, key = chance.choice(_places(document))
    match chance.randrange(6):
        case 0 if isinstance(holder, dict):
            del holder[key]
        case 1 if isinstance(holder, list):
            holder.insert(key, copy.deepcopy(holder[key]))
        case 2 if isinstance(holder, list):
            del holder[key]
        case _:
            holder[key] = copy.deepcopy(chance.choice(_HOSTILE))


def _move(chance: random.Random, document: Any, members: dict[str, bytes]) -> None:
    """Put what stands in one place in another, of the same type."""
    source, key = chance.choice(_places(document))
    target, there = chance.choice(_places(document, lambda one: type(one) is type(source[key])))
    target[there] = copy.deepcopy(source[key])


def _number(chance: random.Random, document: Any, members: dict[str, bytes]) -> None:
    """Change a number a little, or a lot."""
    holder, key = chance.choice(_places(document, lambda one: type(one) in (int, float)))
    holder[key] = chance.choice(
        (holder[key] + 1, holder[key] - 1, -holder[key], holder[key] * 1000, 0, 10**9, 1e-300, 1e300)
    )


def _function(chance: random.Random, document: Any, members: dict[str, bytes]) -> None:
    """Change an operation, a result, a constant or a size of a function."""
    holder, key = chance.choice(_places(document, lambda one: isinstance(one, dict) and "operations" in one))
    part = chance.choice(
        [one for one in ("operations", "results", "constants", "inputs") if holder[key][one]]
    )
    inside, place = chance.choice(_places(holder[key][part]))
    words = (
        "add",
        "mul",
        "div",
        "pow",
        "constpow",
        "if_else_zero",
        "sq",
        "call",
        "external",
        "lt",
        "exp",
        "not",
    )
    kinds = {str: words, int: (0, 1, 5, 40, 10**9, -1), float: (0.0, -1.0, 1e300, float("nan"), float("inf"))}
    inside[place] = chance.choice(kinds.get(type(inside[place]), _HOSTILE))


def _array(chance: random.Random, document: Any, members: dict[str, bytes]) -> None:
    """Change an array's bytes, or its shape."""
    shapes = _places(document["system"], lambda one: isinstance(one, dict) and "member" in one)
    if not shapes:
        return _value(chance, document, members)
    holder, key = chance.choice(shapes)
    name = holder[key]["member"]
    match chance.randrange(4):
        case 0:
            holder[key]["shape"] = chance.choice(
                ([10**9, 10**9], [0], [], [1], [2**40], [-1], [1, 1, 1], [True], ["1"], 3)
            )
        case 1:
            members[name] = members[name][: chance.randrange(1 + len(members[name]))]
        case 2:
            members[name] += chance.randbytes(8 * chance.randint(1, 4))
        case _:
            members[name] = chance.randbytes(len(members[name]))
    return None


def _nothing(chance: random.Random, document: Any, members: dict[str, bytes]) -> None:
    """Leave the document as it is: the bytes of the file are changed."""


_SORTS: dict[str, Callable[[random.Random, Any, dict[str, bytes]], None]] = {
    "value": _value,
    "move": _move,
    "number": _number,
    "function": _function,
    "array": _array,
    "bytes": _nothing,
}


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
        lambda: analyze(system),
        lambda: simulate(system, duration="20 ms", jit=False),
    ]
    if everything or path.stat().st_size % 8 == 0:
        questions.append(lambda: critical(system, first, criterion="nominal"))
    for question in questions:
        try:
            question()
        except ApcError:  # it is told
            continue
    return "answered"
