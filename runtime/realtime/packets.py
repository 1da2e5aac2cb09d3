"""Packets between peers on a real network: binary format and authentication.

Takes: the values that a peer sends; received datagrams. Gives: `Post`, `Data`, `Hello`, `HelloReply`;
`DROPPED`.
Guarantees: a datagram is rejected and counted if version, model, peer address or authentication code do not
match this session. Repeated datagrams, of this or an earlier session, are rejected too.
Does not: wait, or interpret values (see `peer`).

A datagram is a head, a body that depends on its sort, and the first 16 bytes of HMAC-SHA-256 over both (RFC
2104, the length of RFC 4868). Numbers are little-endian, times nanoseconds of the sender's clock:

    head    "apc", version, sort, the model's first 8 bytes of SHA-256, sender u32, time i64
    data    link u16, count of the packet u64, number of values u16, the values f64
    hello   the sender's nonce u64, the receiver's nonce u64 (0: not known yet)
    answer  both nonces as in a hello, the hello's time i64, its arrival i64, the start of the model i64, the
            session u64 (0: the start and the session are not known yet)

A peer draws a random nonce at its start. A datagram with this nonce is therefore of the present session.
Hellos and answers are authenticated with the secret, which may be empty, data with a key of two peers and
their nonces:

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
    "stranger": "from an unknown sender",
    "malformed": "malformed, or of another version",
    "other topology": "of another topology, or of one with another --set",
    "forged": "invalid signature, or from another session",
    "duplicate": "duplicate",
    "joining": "before the sender joined",
    "absent": "from an absent peer",
    "early": "with a future time stamp",
    "late": "with an outdated time stamp",
    "unasked": "reply without a request",
    "not sent": "rejected by the operating system",
}

Address = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Data:
    """Packet number `count` of a link; the link is given by its index in the model."""

    sender: int
    time: int
    link: int
    count: int
    values: tuple[float, ...]


@dataclass(frozen=True, slots=True)
class Hello:
    """A peer's request for a reply from another peer; `received` is the other peer's nonce, 0 if unknown."""

    sender: int
    time: int
    nonce: int
    received: int


@dataclass(frozen=True, slots=True)
class HelloReply:
    """The reply to a hello sent at time `requested` that arrived at `came`.

    Time 0 of the model is at `begins`.

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
        """Set the addresses and draw a nonce.

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
        self.past: set[int] = set()  # nonces of other peers before a restart
        self.unmet: set[int] = set()
        self.dropped: Counter[str] = Counter()

    def data(self, time: int, to: int, link: int, count: int, values: tuple[float, ...]) -> bytes | None:
        """Return the datagram of a packet, None if the receiver is not connected yet.

        Parameters
        ----------
        time
            The time of sending, by this peer's clock.
        to
            The number of the receiver.
        link, count, values
            As in `Data`.
        """
        if to not in self.keys:
            self.unmet.add(to)
            return None
        body = DATA_BODY.pack(link, count, len(values)) + struct.pack(f"<{len(values)}d", *values)
        return self._datagram(DATA, time, body, self.keys[to])

    def hello(self, time: int, to: int) -> bytes:
        """Return the datagram of a hello to another peer."""
        body = HELLO_BODY.pack(self.nonce, self.nonces.get(to, 0))
        return self._datagram(HELLO, time, body, self.secret)

    def answer(self, time: int, to: Hello, came: int, begins: int, session: int) -> bytes:
        """Return the datagram of a reply to a hello.

        Parameters
        ----------
        time, came, begins, session
            As in `HelloReply`.
        to
            The hello.
        """
        body = ANSWER_BODY.pack(self.nonce, to.nonce, to.time, came, begins, session)
        return self._datagram(ANSWER, time, body, self.secret)

    def read(self, datagram: bytes, address: Address) -> Data | Hello | HelloReply | None:
        """Return the decoded contents of a datagram, None for a dropped datagram."""
        why = self._drop_reason(datagram, address)
        message = None if why else self._decoded(datagram[:-SEAL])
        if message is not None and not isinstance(message, Data):
            why = self._register_nonce(message)
        if why or message is None:
            self.drop(why or "malformed")
            return None
        return message

    def _register_nonce(self, message: Hello | HelloReply) -> str:
        """Register the nonce of the sender of a hello or reply; return the reason for dropping it, or ""."""
        if message.nonce in self.past:
            return "duplicate"
        if message.received != self.nonce:
            return "unasked" if isinstance(message, HelloReply) else ""
        before = self.nonces.get(message.sender)
        if before != message.nonce:
            if before is not None:
                self.past.add(before)
            self.nonces[message.sender] = message.nonce
            (low, low_nonce), (high, high_nonce) = sorted(
                [(self.local, self.nonce), (message.sender, message.nonce)]
            )
            text = b"session" + OF_KEY.pack(low, low_nonce, high, high_nonce)
            self.keys[message.sender] = hmac.digest(self.secret, text, "sha256")
        return ""

    def _decoded(self, datagram: bytes) -> Data | Hello | HelloReply | None:
        """Return the contents of a datagram with a valid header, None if its body is invalid."""
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
        """Count a dropped datagram."""
        self.dropped[why] += 1

    def _drop_reason(self, datagram: bytes, address: Address) -> str:
        """Return the reason for dropping a datagram by its header, before decoding; "" if it is valid."""
        number = self.addresses.get(address)
        if number is None:
            return "stranger"
        if len(datagram) < HEAD.size + SEAL:
            return "malformed"
        magic, version, sort, topology, sender, _ = HEAD.unpack_from(datagram)
        if (magic, version, sender) != (MAGIC, VERSION, number):
            return "malformed"
        if topology != self.topology:
            return "other topology"
        key = self.keys.get(number) if sort == DATA else self.secret
        if key is not None and hmac.compare_digest(
            _authentication_code(key, datagram[:-SEAL]), datagram[-SEAL:]
        ):
            return ""
        if sort == DATA:  # the sender may have been restarted
            self.unmet.add(number)
        return "forged"

    def _datagram(self, sort: int, time: int, body: bytes, key: bytes) -> bytes:
        """Return a datagram: header, body and authentication code."""
        message = HEAD.pack(MAGIC, VERSION, sort, self.topology, self.local, time) + body
        return message + _authentication_code(key, message)


def _authentication_code(key: bytes, message: bytes) -> bytes:
    """Return the first bytes of the keyed hash of a message."""
    return hmac.digest(key, message, "sha256")[:SEAL]
