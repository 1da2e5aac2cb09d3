"""Forged compiled models: files that say of themselves what they like, with anything inside.

Takes: a seed. Gives: `forge`, a file's bytes and what sort of forgery they are; `zipped`; `ask`.
Guarantees: of equal seed comes equal input; none has a seal, as whoever forges a file has none.
Does not: watch over what it runs (see `running`).
"""

from __future__ import annotations

import functools
import io
import json
import random
import zipfile
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import msgspec

from apc.api import analyze, critical, simulate
from apc.compiler.cache import FORMAT, Origin
from apc.compiler.errors import ApcError
from apc.compiler.pipeline import compile_topology
from apc.compiler.store import model_of
from apc.inputs import load_fresh

FILE = "scene.apc"
_MODELS = Path(__file__).resolve().parents[2] / "models" / "scenes"
_SCENES = ("three-users-average", "users-table", "finger", "mixed-clocks", "experiment-mesh")
# In place of a text, a name, a number or all that a model was made from.
_HOSTILE = (
    *("", "..", "/etc/passwd", "../../x", "./users.csv", "/dev/zero", "x\0", "\x1b[31m", "Mass", "./parts/"),
    *("id > PWNED", "__import__('os').system('touch PWNED')", "1e999999999", "9" * 5000, "1/0", "held"),
    *(None, True, -1, 10**400, [], {}, [[]], [["a", "b"]], [[["hands", "held"]]], [[["device.mass", "1/0"]]]),
)


@dataclass(frozen=True, slots=True)
class Forged:
    """A file's bytes, and in a word what sort of forgery it is."""

    sort: str
    content: bytes


@functools.cache
def bases() -> tuple[tuple[Origin, bytes], ...]:
    """Return whole models to start from: what each was made from, and itself."""
    found = (compile_topology(_MODELS / f"{scene}.yaml") for scene in _SCENES)
    return tuple((system.origin, model_of(system)) for system in found)


def zipped(members: dict[str, bytes], *, kind: int = zipfile.ZIP_DEFLATED) -> bytes:
    """Return a ZIP archive."""
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w", kind) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return buffer.getvalue()


def unsealed(origin: bytes, model: bytes) -> bytes:
    """Return the file of a model that nobody has sealed."""
    return b"\n".join((f"apc {FORMAT} compiled".encode(), b"0" * 64, origin, model))


def forge(seed: str) -> Forged:
    """Return a forged file."""
    chance = random.Random(seed)
    origin, model = chance.choice(bases())
    text = msgspec.json.encode(origin)
    sort = chance.choice(("origin", "origin", "model", "bytes"))
    if sort == "origin":
        document = json.loads(text)
        for _ in range(chance.choice((1, 1, 2))):
            document[chance.choice(list(document))] = chance.choice(_HOSTILE)
            texts = document["texts"]
            if isinstance(texts, list) and texts and isinstance(texts[0], list):
                row = chance.choice(texts)
                row[:1] = [chance.choice(_HOSTILE)] if chance.random() < 0.3 else row[:1]
        text = json.dumps(document).encode()
    elif sort == "model":
        model = chance.randbytes(chance.choice((0, 1, 100, len(model))))
    content = bytearray(unsealed(text, model))
    if sort == "bytes":
        for _ in range(chance.randint(1, 4)):
            content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    return Forged(sort, bytes(content))


def ask(path: Path, *, everything: bool = False) -> str:
    """Ask a file's questions; return "answered", or "refused" if that was with a mistake of the file's.

    The one that takes longest is asked of one file in eight, or with `everything` of any; in mean square it
    would take many times as long, and `analyze` asks what it asks of the network.
    """
    try:
        system = load_fresh(path)
    except ApcError:
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
