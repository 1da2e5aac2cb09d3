"""Peers started: one here, or all of a scene as processes of this machine.

Takes: a compiled scene, addresses. Gives: `Play`, `RunPart`, `play_one`, `play_all`; `address_of`,
`listen_at`, `is_loopback`.
Guarantees: every process ends with the one that started it; Ctrl-C ends all, and what was done is given; one
that is lost, or does not end, is told, and takes nothing of the others along.
Does not: step (see `peer`), or write (see `run`).
"""

from __future__ import annotations

import ipaddress
import multiprocessing
import signal
import socket
from collections.abc import Iterator, Mapping
from concurrent.futures import FIRST_COMPLETED, Future, wait
from contextlib import ExitStack, contextmanager, nullcontext
from dataclasses import dataclass
from fractions import Fraction
from multiprocessing.connection import Connection

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.exchange import build_exchange
from apc.frame.parameters import resolve
from apc.loop.device import DeviceFunction
from apc.loop.packets import Address
from apc.loop.peer import PeerLoop, StoppedError
from apc.loop.realtime import claim
from apc.loop.run import PeerRun, run_of
from apc.processes import Workers, digest_of, local_processes, model_bytes, model_of_bytes

MOST_PEERS = 64  # processes of one machine
LOOPBACK = "127.0.0.1"
TO_END = 10.0  # seconds for a peer to end in, and hand over what it did


@dataclass(frozen=True, slots=True)
class Play:
    """How a scene is played: `duration` in seconds; `patience` in seconds for others."""

    duration: Fraction
    secret: bytes
    emulate: bool
    seed: int | None
    patience: float


@dataclass(frozen=True, slots=True)
class RunPart:
    """A peer's part of a run, None if it ended before the scene began; its `trouble`, if it ended by that."""

    run: PeerRun | None
    trouble: ApcError | None = None


def address_of(text: str, option: str, peer: str = "") -> Address:
    """Read HOST:PORT.

    Parameters
    ----------
    text
        What was given.
    option, peer
        To what, for messages; `--to` is given a peer's name before.

    Raises
    ------
    ApcError
        E971 if it is none, or no such host is known by an IPv4 address.
    """
    host, colon, port = text.rpartition(":")
    least = 1 if peer else 0  # a port to send to, or to have one chosen
    expected = f"HOST:PORT, the port from {least} to 65535"
    hint = f'{option} "{peer and f"{peer}="}192.0.2.7:5000"'
    valid = colon and host and port.isascii() and port.isdecimal() and len(port) < 6
    if not (valid and least <= int(port) < 1 << 16):
        raise ApcError(
            Diagnostic("E971", SourceLocation(option), "an address", expected, text[:80] or "nothing", hint)
        )
    try:
        return socket.getaddrinfo(host, int(port), socket.AF_INET, socket.SOCK_DGRAM)[0][4][:2]  # type: ignore[return-value]
    except (OSError, UnicodeError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        what = f"the host {host[:80]} is not known by an IPv4 address: {why}"
        raise ApcError(Diagnostic("E971", SourceLocation(option), what, hint=hint)) from None


def listen_at(address: Address) -> socket.socket:
    """Return a socket that listens at an address. Raises ApcError E974 if it is taken or not this host's."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.bind(address)
    except OSError as error:
        listening.close()
        what = f"can't listen at {address[0]}:{address[1]}: {error.strerror or error}"
        raise ApcError(
            Diagnostic("E974", SourceLocation("--listen"), what, hint=f'--listen "{LOOPBACK}:0"')
        ) from None
    return listening


def is_loopback(address: Address) -> bool:
    """Say whether an address can be reached from this machine alone."""
    return ipaddress.ip_address(address[0]).is_loopback


def play_one(
    system: Model,
    peer: str,
    listening: socket.socket,
    addresses: Mapping[str, Address],
    how: Play,
    stop: Connection | None = None,
    device: DeviceFunction | None = None,
) -> RunPart:
    """Play one peer.

    Parameters
    ----------
    system, peer, listening, addresses, device
        As for `PeerLoop`.
    how
        For how long, and how.
    stop
        As for `PeerLoop`; Ctrl-C if not given.

    Raises
    ------
    ApcError
        Those of `PeerLoop` and `PeerLoop.meet`.
    """
    digest = digest_of(system)
    with _interrupts() if stop is None else nullcontext(stop) as stopping:
        loop = PeerLoop(
            *(system, peer, listening, addresses),
            digest=digest,
            duration=how.duration,
            secret=how.secret,
            emulate=how.emulate,
            seed=how.seed,
            stop=stopping,
            device=device,
        )
        not_given = claim()
        try:
            loop.meet(how.patience)
        except StoppedError:
            return RunPart(None)
        loop.run()
        return RunPart(run_of(loop, digest, not_given) if any(map(len, loop.rows)) else None, loop.trouble)


@contextmanager
def _interrupts() -> Iterator[Connection]:
    """Give what can be read once Ctrl-C was pressed; pressed again, it ends what it finds."""
    stop, end = multiprocessing.Pipe(duplex=False)

    def pressed(*_: object) -> None:
        if end.closed:
            raise KeyboardInterrupt
        end.close()

    before = signal.signal(signal.SIGINT, pressed)
    try:
        yield stop
    finally:
        signal.signal(signal.SIGINT, before)
        end.close()
        stop.close()


def play_all(system: Model, how: Play) -> tuple[RunPart, ...]:
    """Play all peers of a scene on loopback, a process each; Ctrl-C ends all, and what was done is given.

    One that ends without a word, or not at all, is the trouble (E975) of its own part.

    Raises
    ------
    ApcError
        E975 the peers are too many.
    """
    exchange = build_exchange(system, resolve(system).timings)
    if exchange.peers > MOST_PEERS:
        what = f"{exchange.peers:,} peers would be as many processes: at most {MOST_PEERS}"
        raise ApcError(
            Diagnostic("E975", SourceLocation(system.name), what, hint='apc play FILE --peer "user[1]" …')
        )
    names = [exchange.peer_name(index) for index in range(exchange.peers)]
    sockets = {name: listen_at((LOOPBACK, 0)) for name in names}
    addresses = {name: listening.getsockname() for name, listening in sockets.items()}
    stop, end = multiprocessing.Pipe(duplex=False)
    model, parts, patience = model_bytes(system), [], None
    running: dict[Future[RunPart], tuple[str, Workers[str, RunPart]]] = {}
    with ExitStack() as stack:
        for name, listening in sockets.items():  # a pool for each: one that is lost breaks its own
            shared = _Shared(model, listening, addresses, how, stop)
            lost = Diagnostic("E975", SourceLocation(name), "ended without a word: what it played is lost")
            workers = stack.enter_context(local_processes(_play_named, shared, 1, lost))
            running[workers.submit(name)] = name, workers
        while running:
            try:
                done, _ = wait(running, patience, return_when=FIRST_COMPLETED)
            except KeyboardInterrupt:
                end.close()
                patience = TO_END if patience is None else 0.0
                continue
            for future in done:
                name, workers = running.pop(future)
                parts.append(_part(future, workers))
            if not done:
                break
    silent = f"did not end within {TO_END:g} s of being told to, and was ended: what it played is lost"
    for name, _ in running.values():
        parts.append(RunPart(None, ApcError(Diagnostic("E975", SourceLocation(name), silent))))
    for listening in sockets.values():
        listening.close()
    return tuple(parts)


def _part(done: Future[RunPart], workers: Workers[str, RunPart]) -> RunPart:
    """Return what a process did that has ended, by itself or by what is told as its trouble."""
    error = done.exception()
    if error is None:
        return done.result()
    trouble = error if isinstance(error, ApcError) else workers.trouble(error)
    if trouble is None:
        raise error
    return RunPart(None, trouble)


@dataclass(frozen=True, slots=True)
class _Shared:
    """What a process gets: where it listens, and all addresses; `stop` can be read when it is to end."""

    model: bytes
    listening: socket.socket
    addresses: Mapping[str, Address]
    how: Play
    stop: Connection


def _play_named(shared: _Shared, name: str) -> RunPart:
    """Play one peer in a process of its own."""
    addresses = {other: address for other, address in shared.addresses.items() if other != name}
    system = model_of_bytes(shared.model)
    return play_one(system, name, shared.listening, addresses, shared.how, shared.stop)
