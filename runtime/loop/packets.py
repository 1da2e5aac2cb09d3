"""Packets between peers on a real network: their bytes, and who is let in.

Takes: what a peer sends; datagrams from anywhere. Gives: `Post`, `Data`, `Hello`, `HelloReply`; `DROPPED`.
Guarantees: a datagram that is not of this version, this scene, a known peer at its own address and sealed as
this session wants it changes nothing but a counter; nor does one heard before, in this session or another.
Does not: wait, or know what values mean (see `peer`).

A datagram is a head, a body by its sort, and the first 16 bytes of HMAC-SHA-256 over both (RFC 2104, the
length of RFC 4868). Numbers are little-endian, times nanoseconds of the sender's clock:

    head    "apc", version, sort, the scene's first 8 bytes of SHA-256, sender u32, time i64
    data    link u16, count of the packet u64, how many values u16, the values f64
    hello   the sender's nonce u64, the receiver's as far as it is known u64 (0: not yet)
    answer  both nonces as in a hello, the hello's time i64, when that came i64, when the scene begins i64,
            the session u64 (0: neither is known yet)

A peer draws its nonce by chance as it starts. Who says it is there now: what was said in an earlier session
has another one. Hellos and answers are sealed with the secret, which is empty if there is none, data with a
key of two peers and both their nonces:

    HMAC-SHA-256(secret, "session", number and nonce of the lower peer, number and nonce of the higher one)

So data of an earlier session, or of a peer before it was started again, are nobody's.
"""

from __future__ import annotations

import hmac
import math
import secrets
import struct
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass

MAGIC, VERSION = b"apc", 2
DATA, HELLO, ANSWER = range(3)
HEAD = struct.Struct("<3sBB8sIq")
DATA_BODY, HELLO_BODY, ANSWER_BODY = struct.Struct("<HQH"), struct.Struct("<QQ"), struct.Struct("<QQqqqQ")
OF_KEY = struct.Struct("<IQIQ")
SCENE = 8  # bytes of the scene's digest
SEAL = 16  # bytes of the keyed hash
FAR = 1 << 61  # nanoseconds, 73 years: what follows from times within them is told in 64 bits

# Why a datagram was dropped, in the order in which that is looked at, and how a person is told.
DROPPED = {
    "stranger": "of a stranger",
    "malformed": "torn, or of another version",
    "other scene": "of another scene, or of one with another --set",
    "forged": "without the secret's seal, or of another session",
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
    """A peer that asks another, whose nonce it `heard`, whether it is there, and when the scene begins."""

    sender: int
    time: int
    nonce: int
    heard: int


@dataclass(frozen=True, slots=True)
class HelloReply:
    """What a peer says to the hello of time `asked` that came at `came`: the scene begins at `begins`.

    `session` tells this time that the scene is played from any other; 0 if it is not known yet.
    """

    sender: int
    time: int
    nonce: int
    heard: int
    asked: int
    came: int
    begins: int
    session: int


class Post:
    """What one peer writes and reads.

    `nonces` are those of the others that are there, `unmet` the others that can't be told or understood until
    they are asked again; `dropped` counts what was let go, by why.
    """

    def __init__(self, number: int, scene: bytes, secret: bytes, addresses: Mapping[Address, int]) -> None:
        """Take who is who.

        Parameters
        ----------
        number
            The peer's number in the scene.
        scene
            The digest of the compiled scene, with its numbers.
        secret
            What all peers know, empty if there is none.
        addresses
            The other peers' numbers by their addresses.
        """
        self.own, self.scene, self.secret = number, scene[:SCENE], secret
        self.addresses = dict(addresses)
        self.nonce = 1 + secrets.randbelow((1 << 64) - 1)
        self.nonces: dict[int, int] = {}
        self.keys: dict[int, bytes] = {}
        self.past: set[int] = set()  # nonces of others before they were started again
        self.unmet: set[int] = set()
        self.dropped: Counter[str] = Counter()

    def data(self, time: int, to: int, link: int, count: int, values: tuple[float, ...]) -> bytes | None:
        """Return the datagram of a packet, None if the other has not been there.

        Parameters
        ----------
        time
            When it is sent, by this peer's clock.
        to
            The number of the other.
        link, count, values
            As in `Data`.
        """
        if to not in self.keys:
            self.unmet.add(to)
            return None
        body = DATA_BODY.pack(link, count, len(values)) + struct.pack(f"<{len(values)}d", *values)
        return self._sealed(DATA, time, body, self.keys[to])

    def hello(self, time: int, to: int) -> bytes:
        """Return the datagram that asks another whether it is there."""
        body = HELLO_BODY.pack(self.nonce, self.nonces.get(to, 0))
        return self._sealed(HELLO, time, body, self.secret)

    def answer(self, time: int, to: Hello, came: int, begins: int, session: int) -> bytes:
        """Return the datagram that says so.

        Parameters
        ----------
        time, came, begins, session
            As in `HelloReply`.
        to
            The hello that is answered.
        """
        body = ANSWER_BODY.pack(self.nonce, to.nonce, to.time, came, begins, session)
        return self._sealed(ANSWER, time, body, self.secret)

    def read(self, datagram: bytes, address: Address) -> Data | Hello | HelloReply | None:
        """Return what a datagram says, None if it is dropped."""
        why = self._refused(datagram, address)
        said = None if why else self._said(datagram[:-SEAL])
        if said is not None and not isinstance(said, Data):
            why = self._meet(said)
        if why or said is None:
            self.drop(why or "malformed")
            return None
        return said

    def _meet(self, said: Hello | HelloReply) -> str:
        """Take who says this peer's nonce for one that is there; return why it is let go, empty if not."""
        if said.nonce in self.past:
            return "heard before"
        if said.heard != self.nonce:
            return "unasked" if isinstance(said, HelloReply) else ""
        before = self.nonces.get(said.sender)
        if before != said.nonce:
            if before is not None:
                self.past.add(before)
            self.nonces[said.sender] = said.nonce
            (low, number), (high, two) = sorted([(self.own, self.nonce), (said.sender, said.nonce)])
            text = b"session" + OF_KEY.pack(low, number, high, two)
            self.keys[said.sender] = hmac.digest(self.secret, text, "sha256")
        return ""

    def _said(self, datagram: bytes) -> Data | Hello | HelloReply | None:
        """Return what a datagram says whose head is right, None if the rest is not."""
        _, _, sort, _, sender, time = HEAD.unpack_from(datagram)
        body = datagram[HEAD.size :]
        if sort == DATA and len(body) >= DATA_BODY.size:
            link, count, values = DATA_BODY.unpack_from(body)
            if len(body) == DATA_BODY.size + 8 * values:
                numbers = struct.unpack_from(f"<{values}d", body, DATA_BODY.size)
                if all(map(math.isfinite, numbers)):
                    return Data(sender, time, link, count, numbers)
        elif sort == HELLO and len(body) == HELLO_BODY.size:
            hello = Hello(sender, time, *HELLO_BODY.unpack(body))
            return hello if hello.nonce else None
        elif sort == ANSWER and len(body) == ANSWER_BODY.size:
            answer = HelloReply(sender, time, *ANSWER_BODY.unpack(body))
            times = answer.time, answer.asked, answer.came, answer.begins
            return answer if answer.nonce and max(map(abs, times)) < FAR else None
        return None

    def drop(self, why: str) -> None:
        """Count a datagram that was let go."""
        self.dropped[why] += 1

    def _refused(self, datagram: bytes, address: Address) -> str:
        """Return why a datagram is let go for what it is, before what it says is read; empty if it is not."""
        known = self.addresses.get(address)
        if known is None:
            return "stranger"
        if len(datagram) < HEAD.size + SEAL:
            return "malformed"
        magic, version, sort, scene, sender, _ = HEAD.unpack_from(datagram)
        if (magic, version, sender) != (MAGIC, VERSION, known):
            return "malformed"
        if scene != self.scene:
            return "other scene"
        key = self.keys.get(known) if sort == DATA else self.secret
        if key is not None and hmac.compare_digest(_seal(key, datagram[:-SEAL]), datagram[-SEAL:]):
            return ""
        if sort == DATA:  # it may have been started again since it was there
            self.unmet.add(known)
        return "forged"

    def _sealed(self, sort: int, time: int, body: bytes, key: bytes) -> bytes:
        whole = HEAD.pack(MAGIC, VERSION, sort, self.scene, self.own, time) + body
        return whole + _seal(key, whole)


def _seal(key: bytes, whole: bytes) -> bytes:
    return hmac.digest(key, whole, "sha256")[:SEAL]
