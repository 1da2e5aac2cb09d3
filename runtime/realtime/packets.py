"""Packets between peers on a real network: binary format and authentication.

Takes: the values that a peer sends; received datagrams. Gives: `Post`, `Data`, `Hello`, `HelloReply`;
`DROPPED`.
Guarantees: a datagram is rejected and counted if version, model, peer address or authentication code do not
match this session. Repeated datagrams, of this or an earlier session, are rejected too.
Does not: wait, or interpret values (see `peer`).

A datagram is a head, a body by its sort, and the first 16 bytes of HMAC-SHA-256 over both (RFC 2104, the
length of RFC 4868). Numbers are little-endian, times nanoseconds of the sender's clock:

    head    "apc", version, sort, the model's first 8 bytes of SHA-256, sender u32, time i64
    data    link u16, count of the packet u64, how many values u16, the values f64
    hello   the sender's nonce u64, the receiver's as far as it is known u64 (0: not yet)
    answer  both nonces as in a hello, the hello's time i64, when that came i64, when the model begins i64,
            the session u64 (0: neither is known yet)

A peer draws a random nonce at its start. A datagram with this nonce is therefore of the present session.
Hellos and answers are sealed with the secret, which is empty if there is none, data with a key of two peers
and both their nonces:

    HMAC-SHA-256(secret, "session", number and nonce of the lower peer, number and nonce of the higher one)

Data of an earlier session, or of a peer before its restart, therefore fail authentication.
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
TOPOLOGY = 8  # bytes of the model's digest
SEAL = 16  # bytes of the keyed hash
FAR = 1 << 61  # nanoseconds, 73 years: sums and differences of such times fit into 64 bits

# Reasons for dropping a datagram, in the order of the checks, with their texts for the user.
DROPPED = {
    "stranger": "of a stranger",
    "malformed": "torn, or of another version",
    "other topology": "of another topology, or of one with another --set",
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
    """Packet number `count` of a link, the link by its place in the model."""

    sender: int
    time: int
    link: int
    count: int
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Hello:
    """A peer's request to another, whose nonce it `received`: is it ready, and when does time 0 occur?"""

    sender: int
    time: int
    nonce: int
    received: int


@dataclass(frozen=True, slots=True)
class HelloReply:
    """The reply to the hello of time `requested` that arrived at `came`: time 0 occurs at `begins`.

    `session` is the unique number of the session; 0 if not yet known.
    """

    sender: int
    time: int
    nonce: int
    received: int
    requested: int
    came: int
    begins: int
    session: int


class Post:
    """The packet encoder and decoder of one peer.

    `nonces` are those of the connected peers; `unmet` are the peers that need a new handshake; `dropped`
    counts dropped datagrams by reason.
    """

    def __init__(self, number: int, topology: bytes, secret: bytes, addresses: Mapping[Address, int]) -> None:
        """Take who is who.

        Parameters
        ----------
        number
            The peer's number in the model.
        topology
            The digest of the model, with its parameter values.
        secret
            The common secret, empty if none.
        addresses
            The other peers' numbers by their addresses.
        """
        self.local, self.topology, self.secret = number, topology[:TOPOLOGY], secret
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
            The time of sending, by this peer's clock.
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
        """Return the encoded reply datagram.

        Parameters
        ----------
        time, came, begins, session
            As in `HelloReply`.
        to
            The hello to which this is the reply.
        """
        body = ANSWER_BODY.pack(self.nonce, to.nonce, to.time, came, begins, session)
        return self._sealed(ANSWER, time, body, self.secret)

    def read(self, datagram: bytes, address: Address) -> Data | Hello | HelloReply | None:
        """Return the decoded contents of a datagram, None if it is dropped."""
        why = self._refused(datagram, address)
        message = None if why else self._message(datagram[:-SEAL])
        if message is not None and not isinstance(message, Data):
            why = self._meet(message)
        if why or message is None:
            self.drop(why or "malformed")
            return None
        return message

    def _meet(self, message: Hello | HelloReply) -> str:
        """Register the sender of a datagram with this peer's nonce; return the rejection reason, or none."""
        if message.nonce in self.past:
            return "heard before"
        if message.received != self.nonce:
            return "unasked" if isinstance(message, HelloReply) else ""
        before = self.nonces.get(message.sender)
        if before != message.nonce:
            if before is not None:
                self.past.add(before)
            self.nonces[message.sender] = message.nonce
            (low, number), (high, two) = sorted([(self.local, self.nonce), (message.sender, message.nonce)])
            text = b"session" + OF_KEY.pack(low, number, high, two)
            self.keys[message.sender] = hmac.digest(self.secret, text, "sha256")
        return ""

    def _message(self, datagram: bytes) -> Data | Hello | HelloReply | None:
        """Return the contents of a datagram with a valid header, None if the rest is invalid."""
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
            times = answer.time, answer.requested, answer.came, answer.begins
            return answer if answer.nonce and max(map(abs, times)) < FAR else None
        return None

    def drop(self, why: str) -> None:
        """Count a datagram that was let go."""
        self.dropped[why] += 1

    def _refused(self, datagram: bytes, address: Address) -> str:
        """Return the reason for dropping a datagram by its header, before decoding; empty if valid."""
        known = self.addresses.get(address)
        if known is None:
            return "stranger"
        if len(datagram) < HEAD.size + SEAL:
            return "malformed"
        magic, version, sort, topology, sender, _ = HEAD.unpack_from(datagram)
        if (magic, version, sender) != (MAGIC, VERSION, known):
            return "malformed"
        if topology != self.topology:
            return "other topology"
        key = self.keys.get(known) if sort == DATA else self.secret
        if key is not None and hmac.compare_digest(_seal(key, datagram[:-SEAL]), datagram[-SEAL:]):
            return ""
        if sort == DATA:  # it may have been started again since it was there
            self.unmet.add(known)
        return "forged"

    def _sealed(self, sort: int, time: int, body: bytes, key: bytes) -> bytes:
        whole = HEAD.pack(MAGIC, VERSION, sort, self.topology, self.local, time) + body
        return whole + _seal(key, whole)


def _seal(key: bytes, whole: bytes) -> bytes:
    return hmac.digest(key, whole, "sha256")[:SEAL]
