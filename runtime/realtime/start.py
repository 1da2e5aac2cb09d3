"""Start of peers: one in this process, or all of a topology as processes of this machine.

Takes: a model, addresses. Gives: `LocalRun`, `RunPart`, `run_single`, `run_all`; `address_of`, `listen_at`,
`is_loopback`.
Guarantees: every process ends with its parent. Ctrl-C ends all, and the records up to then are returned. A
process that crashes or does not end is reported; the records of the others are kept.
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
from apc.frame.communication_graph import build_exchange
from apc.frame.parameters import resolve
from apc.processes import Workers, digest_of, local_processes, model_bytes, model_of_bytes
from apc.realtime.device import DeviceFunction
from apc.realtime.packets import Address
from apc.realtime.peer import PeerLoop, StoppedError
from apc.realtime.peer_run import PeerRun, run_of
from apc.realtime.process_priority import claim

MOST_PEERS = 64  # processes of one machine
LOOPBACK = "127.0.0.1"
TO_END = 10.0  # seconds for a peer to end in, and hand over what it did


@dataclass(frozen=True, slots=True)
class LocalRun:
    """Options of a session: `duration` in seconds; `patience` in seconds for connections."""

    duration: Fraction
    secret: bytes
    emulate: bool
    seed: int | None
    patience: float


@dataclass(frozen=True, slots=True)
class RunPart:
    """A peer's part of a run, None if it ended before the model began; its `trouble`, if it ended by that."""

    run: PeerRun | None
    trouble: ApcError | None = None


def address_of(text: str, option: str, peer: str = "") -> Address:
    """Read HOST:PORT.

    Parameters
    ----------
    text
        The given text.
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
        message = f"the host {host[:80]} is not known by an IPv4 address: {why}"
        raise ApcError(Diagnostic("E971", SourceLocation(option), message, hint=hint)) from None


def listen_at(address: Address) -> socket.socket:
    """Return a socket that listens at an address. Raises ApcError E974 if it is taken or not this host's."""
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.bind(address)
    except OSError as error:
        listening.close()
        message = f"can't listen at {address[0]}:{address[1]}: {error.strerror or error}"
        raise ApcError(
            Diagnostic("E974", SourceLocation("--listen"), message, hint=f'--listen "{LOOPBACK}:0"')
        ) from None
    return listening


def is_loopback(address: Address) -> bool:
    """Return whether an address can be reached from this machine only."""
    return ipaddress.ip_address(address[0]).is_loopback


def run_single(
    system: Model,
    peer: str,
    listening: socket.socket,
    addresses: Mapping[str, Address],
    how: LocalRun,
    stop: Connection | None = None,
    device: DeviceFunction | None = None,
) -> RunPart:
    """Run one peer.

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
    """Yield a file that is readable after Ctrl-C; a second Ctrl-C ends the processes."""
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


def run_all(system: Model, how: LocalRun) -> tuple[RunPart, ...]:
    """Run all peers of a model on loopback, a process each; Ctrl-C ends all, and the records are returned.

    One that ends without a word, or not at all, is the trouble (E975) of its own part.

    Raises
    ------
    ApcError
        E975 the peers are too many.
    """
    exchange = build_exchange(system, resolve(system).timings)
    if exchange.peers > MOST_PEERS:
        message = f"{exchange.peers:,} peers would be as many processes: at most {MOST_PEERS}"
        raise ApcError(
            Diagnostic("E975", SourceLocation(system.name), message, hint='apc run FILE --peer "user[1]" …')
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
            workers = stack.enter_context(local_processes(_run_named, shared, 1, lost))
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
    """Return the record of a process that ended normally or with a reported error."""
    error = done.exception()
    if error is None:
        return done.result()
    trouble = error if isinstance(error, ApcError) else workers.trouble(error)
    if trouble is None:
        raise error
    return RunPart(None, trouble)


@dataclass(frozen=True, slots=True)
class _Shared:
    """The start data of a process: its socket, and all addresses; `stop` is readable at the end."""

    model: bytes
    listening: socket.socket
    addresses: Mapping[str, Address]
    how: LocalRun
    stop: Connection


def _run_named(shared: _Shared, name: str) -> RunPart:
    """Run one peer in a process."""
    addresses = {other: address for other, address in shared.addresses.items() if other != name}
    system = model_of_bytes(shared.model)
    return run_single(system, name, shared.listening, addresses, shared.how, shared.stop)
