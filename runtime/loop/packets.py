"""Packets between peers on a real network: their bytes, and who is let in.

Takes: what a peer sends; datagrams from anywhere. Gives: `Post`, `Data`, `Hello`, `Answer`; `DROPPED`.
Guarantees: a datagram that is not of this version, this scene, a known peer at its own address and, where
there is a secret, sealed with it, changes nothing but a counter; nor does one heard before.
Does not: wait, or know what values mean (see `peer`).

A datagram is a head, a body by its sort, and with a secret the first 16 bytes of HMAC-SHA-256 over both (RFC
2104, RFC 4868's length). Numbers are little-endian, times nanoseconds of the sender's clock:

    head    "apc", version, sort, the scene's first 8 bytes of SHA-256, sender u32, time i64
    data    link u16, count of the packet u64, how many values u16, the values f64
    hello   a number drawn by chance u64
    answer  that number u64, when the hello came i64, when the scene begins i64 (0: not known yet)
"""

from __future__ import annotations

import hmac
import math
import struct
from collections import Counter
from collections.abc import Mapping

from apc.compiler.frozen import dataclass

MAGIC, VERSION = b"apc", 1
DATA, HELLO, ANSWER = range(3)
HEAD = struct.Struct("<3sBB8sIq")
DATA_BODY, HELLO_BODY, ANSWER_BODY = struct.Struct("<HQH"), struct.Struct("<Q"), struct.Struct("<Qqq")
SCENE = 8  # bytes of the scene's digest
SEAL = 16  # bytes of the keyed hash
LARGEST = 65_507  # bytes of a datagram over IPv4
MOST_VALUES = (LARGEST - HEAD.size - DATA_BODY.size - SEAL) // 8

# Why a datagram was dropped, in the order in which that is looked at, and how a person is told.
DROPPED = {
    "stranger": "of a stranger",
    "malformed": "torn, or of another version",
    "other scene": "of another scene, or of one with another --set",
    "forged": "without the secret's seal",
    "heard before": "heard before",
    "joining": "before it had joined",
    "early": "of a time that was still to come",
    "late": "of a time long past",
    "unasked": "an answer to nothing that was asked",
    "not sent": "not taken by this system",
}

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Data:
    """Packet number `count` of a link, the link by its place in the scene."""

    sender: int
    time: int
    link: int
    count: int
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Hello:
    """A peer that wants to know whether its other is there, and when the scene begins."""

    sender: int
    time: int
    nonce: int


@dataclass(frozen=True, slots=True)
class Answer:
    """What a peer says to a `Hello` that came at `came`; the scene `begins` then, 0 if that is unknown."""

    sender: int
    time: int
    nonce: int
    came: int
    begins: int


class Post:
    """What one peer writes and reads; `dropped` counts what was let go, by why."""

    def __init__(self, own: int, scene: bytes, secret: bytes, addresses: Mapping[Address, int]) -> None:
        """Take who is who.

        Parameters
        ----------
        own
            The peer's number in the scene.
        scene
            The digest of the compiled scene, with its numbers.
        secret
            What all peers know, empty if there is none.
        addresses
            The other peers' numbers by their addresses.
        """
        self.own, self.scene, self.secret = own, scene[:SCENE], secret
        self.addresses = dict(addresses)
        self.dropped: Counter[str] = Counter()

    def data(self, time: int, link: int, count: int, values: tuple[float, ...]) -> bytes:
        """Return the datagram of a packet.

        Parameters
        ----------
        time
            When it is sent, by this peer's clock.
        link, count, values
            As in `Data`.
        """
        body = DATA_BODY.pack(link, count, len(values)) + struct.pack(f"<{len(values)}d", *values)
        return self._sealed(DATA, time, body)

    def hello(self, time: int, nonce: int) -> bytes:
        """Return the datagram that asks whether somebody is there."""
        return self._sealed(HELLO, time, HELLO_BODY.pack(nonce))

    def answer(self, time: int, to: Hello, came: int, begins: int) -> bytes:
        """Return the datagram that says so.

        Parameters
        ----------
        time, came, begins
            As in `Answer`.
        to
            The hello that is answered.
        """
        return self._sealed(ANSWER, time, ANSWER_BODY.pack(to.nonce, came, begins))

    def read(self, datagram: bytes, address: Address) -> Data | Hello | Answer | None:
        """Return what a datagram says, None if it is dropped."""
        why = self._refused(datagram, address)
        said = None if why else self._said(datagram[: -SEAL if self.secret else None])
        if said is None:
            self.drop(why or "malformed")
        return said

    def _said(self, datagram: bytes) -> Data | Hello | Answer | None:
        """Return what a datagram says whose head is right, None if the rest is not."""
        _, _, sort, _, sender, time = HEAD.unpack_from(datagram)
        body = datagram[HEAD.size :]
        if sort == DATA and len(body) >= DATA_BODY.size:
            link, count, values = DATA_BODY.unpack_from(body)
            if len(body) == DATA_BODY.size + 8 * values:
                told = struct.unpack_from(f"<{values}d", body, DATA_BODY.size)
                if all(map(math.isfinite, told)):
                    return Data(sender, time, link, count, told)
        elif sort == HELLO and len(body) == HELLO_BODY.size:
            return Hello(sender, time, *HELLO_BODY.unpack(body))
        elif sort == ANSWER and len(body) == ANSWER_BODY.size:
            return Answer(sender, time, *ANSWER_BODY.unpack(body))
        return None

    def drop(self, why: str) -> None:
        """Count a datagram that was let go."""
        self.dropped[why] += 1

    def _refused(self, datagram: bytes, address: Address) -> str:
        """Return why a datagram is let go for what it is, before what it says is read; empty if it is not."""
        known, sealed = self.addresses.get(address), SEAL if self.secret else 0
        if known is None:
            return "stranger"
        if len(datagram) < HEAD.size + sealed:
            return "malformed"
        magic, version, _, scene, sender, _ = HEAD.unpack_from(datagram)
        if (magic, version, sender) != (MAGIC, VERSION, known):
            return "malformed"
        if scene != self.scene:
            return "other scene"
        whole = not sealed or hmac.compare_digest(self._seal(datagram[:-SEAL]), datagram[-SEAL:])
        return "" if whole else "forged"

    def _sealed(self, sort: int, time: int, body: bytes) -> bytes:
        whole = HEAD.pack(MAGIC, VERSION, sort, self.scene, self.own, time) + body
        return whole + self._seal(whole) if self.secret else whole

    def _seal(self, whole: bytes) -> bytes:
        return hmac.digest(self.secret, whole, "sha256")[:SEAL]
