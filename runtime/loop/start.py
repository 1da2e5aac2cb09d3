"""Peers started: one here, or all of a scene as processes of this machine.

Takes: a compiled scene, addresses. Gives: `Play`, `play_one`, `play_all`; `address_of`, `listen_at`,
`is_loopback`.
Guarantees: every process ends with the one that started it; Ctrl-C ends all, and what was done is written.
Does not: step (see `peer`).
"""

from __future__ import annotations

import hashlib
import ipaddress
import multiprocessing
import socket
from collections.abc import Mapping
from concurrent.futures import FIRST_COMPLETED, wait
from fractions import Fraction
from multiprocessing.connection import Connection
from pathlib import Path

from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError, Mistake, Place
from apc.compiler.frozen import dataclass
from apc.frame.exchange import build_exchange
from apc.frame.parameters import resolve
from apc.loop.device import DeviceFunction
from apc.loop.packets import Address
from apc.loop.peer import Loop
from apc.loop.realtime import claim
from apc.loop.run import run_of, write_peer
from apc.processes import local_processes, model_bytes, model_of_bytes

MOST_PEERS = 64  # processes of one machine
LOOPBACK = "127.0.0.1"


@dataclass(frozen=True, slots=True)
class Play:
    """How a scene is played: `duration` in seconds, into `folder`; `patience` in seconds for others."""

    folder: Path
    duration: Fraction
    secret: bytes
    emulate: bool
    seed: int | None
    patience: float


def address_of(text: str, option: str) -> Address:
    """Read HOST:PORT. Raises ApcError E971 if it is none, or no such host is known."""
    host, colon, port = text.rpartition(":")
    expected, hint = "HOST:PORT, the port from 0 to 65535", f'{option} "192.0.2.7:5000"'
    if not (colon and host and port.isascii() and port.isdecimal() and int(port) < 1 << 16):
        raise ApcError(Mistake("E971", Place(option), "an address", expected, text[:80] or "nothing", hint))
    try:
        return socket.getaddrinfo(host, int(port), socket.AF_INET, socket.SOCK_DGRAM)[0][4][:2]  # type: ignore[return-value]
    except OSError as error:
        what = f"the host {host[:80]} is not known: {error.strerror or error}"
        raise ApcError(Mistake("E971", Place(option), what, hint=hint)) from None


def listen_at(address: Address) -> socket.socket:
    """Return a socket that listens at an address. Raises ApcError E974 if it is taken or not this host's."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.bind(address)
    except OSError as error:
        listening.close()
        what = f"can't listen at {address[0]}:{address[1]}: {error.strerror or error}"
        raise ApcError(Mistake("E974", Place("--listen"), what, hint=f'--listen "{LOOPBACK}:0"')) from None
    return listening


def is_loopback(address: Address) -> bool:
    """Say whether an address can be reached from this machine alone."""
    return ipaddress.ip_address(address[0]).is_loopback


def play_one(
    system: CompiledSystem,
    peer: str,
    listening: socket.socket,
    addresses: Mapping[str, Address],
    how: Play,
    stop: Connection | None = None,
    device: DeviceFunction | None = None,
) -> None:
    """Play one peer, and write what it did.

    Parameters
    ----------
    system, peer, listening, addresses, stop, device
        As for `Loop`.
    how
        For how long, and where to.

    Raises
    ------
    ApcError
        Those of `Loop`, `Loop.meet` and `write_peer`.
    """
    digest = hashlib.sha256(model_bytes(system)).digest()
    loop = Loop(
        system,
        peer,
        listening,
        addresses,
        digest=digest,
        duration=how.duration,
        secret=how.secret,
        emulate=how.emulate,
        seed=how.seed,
        stop=stop,
        device=device,
    )
    not_given = claim()
    loop.meet(how.patience)
    loop.run()
    write_peer(how.folder, run_of(loop, digest, not_given), system)


def play_all(system: CompiledSystem, how: Play) -> None:
    """Play all peers of a scene on loopback, a process each; Ctrl-C ends all, and what was done is kept.

    Raises
    ------
    ApcError
        E975 the peers are too many, or one of them ended without a word; what one of them raises.
    """
    exchange = build_exchange(system, resolve(system).timings)
    if exchange.peers > MOST_PEERS:
        what = f"{exchange.peers:,} peers would be as many processes: at most {MOST_PEERS}"
        raise ApcError(Mistake("E975", Place(system.name), what, hint='apc play FILE --peer "user[1]" …'))
    names = [exchange.peer_name(one) for one in range(exchange.peers)]
    sockets = {name: listen_at((LOOPBACK, 0)) for name in names}
    stop, end = multiprocessing.get_context("spawn").Pipe(duplex=False)
    shared = _Shared(model_bytes(system), sockets, how, stop)
    lost = Mistake("E975", Place(system.name), "one of the peers ended without a word")
    with local_processes(_play_named, shared, len(names), lost) as workers:
        running = {workers.submit(name) for name in names}
        while running:
            try:
                done, running = wait(running, return_when=FIRST_COMPLETED)
            except KeyboardInterrupt:
                end.close()
                continue
            for one in done:
                if (error := one.exception()) is not None:
                    raise workers.trouble(error) or error
    for listening in sockets.values():
        listening.close()


@dataclass(frozen=True, slots=True)
class _Shared:
    """What all processes get: `stop` can be read when they are to end."""

    model: bytes
    sockets: Mapping[str, socket.socket]
    how: Play
    stop: Connection


def _play_named(shared: _Shared, name: str) -> None:
    """Play one peer in a process of its own."""
    addresses = {other: one.getsockname() for other, one in shared.sockets.items() if other != name}
    play_one(model_of_bytes(shared.model), name, shared.sockets[name], addresses, shared.how, shared.stop)
