"""Damaged and forged recordings of packets: outputs of ping and irtt, and tables of delays.

Takes: a seed. Gives: `make_network`, `ask_network`, `whole_networks`.
Guarantees: of equal seed comes equal input.
Does not: watch over what it runs (see `running`).
"""

from __future__ import annotations

import functools
import json
import math
import random
import re
from pathlib import Path

from apc.compiler.errors import ApcError
from apc.network.link_fit import fit_recording
from tests.fuzz.inputs import HOSTILE, Input, mutated

FILE = "lan.txt"
LARGE = 200_000  # bytes; a larger recording may take a second
PINGS = Path(__file__).parents[1] / "networks" / "pings.txt"
IRTT = {
    "stats": {"packets_sent": 3, "packets_received": 3, "duplicates": 1},
    "config": {"params": {"interval": 8_000_000}},
    "round_trips": [
        {"seqno": 0, "lost": "false", "delay": {"rtt": 16_000_000}},
        {"seqno": 1, "lost": "true", "delay": {}},
        {"seqno": 2, "lost": "false", "delay": {"rtt": 17_000_000}},
    ],
}
_NUMBERS = ("0", "-1", "1", "2", "3", "32767", "65535", "65536", "4294967296", "1e308", "1e-308", "1,5",
            "NaN", "Infinity", "9" * 400, "9" * 5000, "٣", "½", "", "0x10", "1_000")  # fmt: skip
_LONG = ("=", ":", ",", "%", " ", "1", "icmp_seq=", "time=", "TTL=1 ", "= 1, ", "1ms", "[", "\r", "\xa0")
_SORTS = ("bytes", "bytes", "number", "number", "lines", "lines", "two", "long")


@functools.cache
def samples() -> tuple[bytes, ...]:
    """Return recordings of each program and language, read or refused, a table and one of irtt."""
    texts = re.split(r"^## .*\n", PINGS.read_text(encoding="utf-8"), flags=re.MULTILINE)[1:]
    stamped = "".join(f"[16{n:08d}.5] 64 bytes: icmp_seq={n} ttl=1 time=2 ms\n" for n in range(1, 20))
    return (*(text.encode() for text in (*texts, stamped)), *[json.dumps(IRTT).encode()] * 20,
            *[b"n,delay [ms]\n1,8\n2,lost\n3,\n4,9.5\n"] * 5)  # fmt: skip


def make_network(seed: str) -> Input:
    """Return a recording changed at random, once or more."""
    rng = random.Random(seed)
    sort, data = rng.choice(_SORTS), rng.choice(samples())
    for _ in range(rng.choice((1, 1, 2, 5))):
        data = _changed(rng, sort, data)
        if len(data) > LARGE // 10:
            break
    return Input(sort, ((FILE, data[:LARGE]),))


def _changed(rng: random.Random, sort: str, data: bytes) -> bytes:
    """Return bytes, or numbers or lines of a text, changed at random."""
    if sort == "bytes":
        return mutated(rng, data)
    if sort == "two":
        other = rng.choice(samples())
        return data[: rng.choice((len(data), rng.randrange(len(data) + 1)))] + other
    text = data.decode("utf-8", "replace")
    if sort == "number":
        found = list(re.finditer(r"\d+(?:\.\d+)?", text)) or [re.match("", text)]
        one = rng.choice(found)
        new = rng.choice((*_NUMBERS, rng.choice(HOSTILE)))
        return (text[: one.start()] + new + text[one.end() :]).encode("utf-8", "replace")
    if sort == "long":
        at = rng.randrange(len(text) + 1)
        return (text[:at] + rng.choice(_LONG) * rng.choice((100, 3000, 30_000)) + text[at:]).encode()
    lines = text.splitlines(keepends=True)
    at = rng.randrange(len(lines) + 1)
    change = rng.randrange(4)
    if change == 0:
        rng.shuffle(lines)
    elif change == 1:
        lines[at : at + 1] = lines[at : at + 1] * rng.choice((2, 100, 1000))
    elif change == 2:
        del lines[at : at + rng.randrange(1, 4)]
    else:
        numbered = (re.sub(r"seq=\d+", f"seq={n}", line) for line in lines[at:] for n in range(300))
        lines[at:] = list(numbered)
    return "".join(lines).encode("utf-8", "replace")


def ask_network() -> str:
    """Describe the recording in this folder: a result that agrees with itself, or a diagnostic."""
    try:
        found = fit_recording(FILE)
    except ApcError as error:
        lines = len(re.split(rb"\r\n|\n|\r", Path(FILE).read_bytes()))
        for mistake in error.mistakes:
            assert re.match("E70[1-4]|E22", mistake.code), str(error)  # E22 of a unit in a heading
            assert mistake.location.file == FILE, str(error)
            assert mistake.location.line <= lines, str(error)
        return "refused"
    assert len(found.delays) == found.packets > 0
    assert found.lost.count == sum(map(math.isinf, found.delays.tolist()))
    assert (found.delays >= 0).all()
    assert math.isnan(found.interval) or found.interval > 0
    assert str(found)
    assert json.dumps(found.to_dict(), allow_nan=False)
    return "answered"


def whole_networks() -> list[Input]:
    """Return recordings that nobody changed, which are read."""
    return [Input("", ((FILE, data),)) for data in (samples()[0], samples()[-1], json.dumps(IRTT).encode())]
