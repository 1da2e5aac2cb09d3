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
from apc.parameter_values.parameters import resolve
from apc.realtime.device import DeviceFunction
from apc.realtime.packets import Address
from apc.realtime.peer import PeerLoop, StoppedError
from apc.realtime.peer_run import PeerRun, run_of
from apc.realtime.process_priority import claim
from apc.support.processes import Workers, digest_of, local_processes, model_bytes, model_of_bytes
from apc.timing.communication_graph import build_comm_graph

MOST_PEERS = 64  # processes of one machine
LOOPBACK = "127.0.0.1"
TO_END = 10.0  # seconds for a peer to end and return its record


@dataclass(frozen=True, slots=True)
class LocalRun:
    """Options of a session: `duration` in seconds; `patience`, the limit in seconds for connections."""

    duration: Fraction
    secret: bytes
    emulate: bool
    seed: int | None
    patience: float


@dataclass(frozen=True, slots=True)
class RunPart:
    """A peer's record, None if it ended before the start of the model.

    `trouble` is the error that ended it.
    """

    run: PeerRun | None
    trouble: ApcError | None = None


def address_of(text: str, option: str, peer: str = "") -> Address:
    """Return the address of a text HOST:PORT.

    Parameters
    ----------
    text
        The given text.
    option, peer
        The option, and the peer's name in front of the address, for messages.

    Raises
    ------
    ApcError
        E971 the text is no address, or the host has no IPv4 address.
    """
    host, colon, port = text.rpartition(":")
    least = 1 if peer else 0  # a port to send to, or to have one chosen
    expected = f"HOST:PORT, the port from {least} to 65535"
    fix = f'{option} "{peer and f"{peer}="}192.0.2.7:5000"'
    valid = colon and host and port.isascii() and port.isdecimal() and len(port) < 6
    if not (valid and least <= int(port) < 1 << 16):
        raise ApcError(
            Diagnostic("E971", SourceLocation(option), "address", expected, text[:80] or "nothing", fix)
        )
    try:
        return socket.getaddrinfo(host, int(port), socket.AF_INET, socket.SOCK_DGRAM)[0][4][:2]  # type: ignore[return-value]
    except (OSError, UnicodeError) as error:
        why = error.strerror if isinstance(error, OSError) else str(error)
        message = f"the host {host[:80]} has no IPv4 address: {why}"
        raise ApcError(Diagnostic("E971", SourceLocation(option), message, fix=fix)) from None


def listen_at(address: Address) -> socket.socket:
    """Return a socket bound to an address.

    Raises ApcError E974 if the address is occupied or not this host's.
    """
    listening = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
    try:
        listening.bind(address)
    except OSError as error:
        listening.close()
        message = f"can't listen at {address[0]}:{address[1]}: {error.strerror or error}"
        raise ApcError(
            Diagnostic("E974", SourceLocation("--listen"), message, fix=f'--listen "{LOOPBACK}:0"')
        ) from None
    return listening


def is_loopback(address: Address) -> bool:
    """Return whether an address is reachable from this machine only."""
    return ipaddress.ip_address(address[0]).is_loopback


def run_single(
    model: Model,
    peer: str,
    listening: socket.socket,
    addresses: Mapping[str, Address],
    how: LocalRun,
    stop: Connection | None = None,
    device: DeviceFunction | None = None,
) -> RunPart:
    """Return the record of one peer, run in this process.

    Parameters
    ----------
    model, peer, listening, addresses, device
        As for `PeerLoop`.
    how
        The options of the session.
    stop
        As for `PeerLoop`; by default Ctrl-C requests the end.

    Raises
    ------
    ApcError
        Those of `PeerLoop` and `PeerLoop.meet`.
    """
    digest = digest_of(model)
    with _stop_on_interrupt() if stop is None else nullcontext(stop) as stop_connection:
        loop = PeerLoop(
            *(model, peer, listening, addresses),
            digest=digest,
            duration=how.duration,
            secret=how.secret,
            emulate=how.emulate,
            seed=how.seed,
            stop=stop_connection,
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
def _stop_on_interrupt() -> Iterator[Connection]:
    """Yield a connection that becomes readable after Ctrl-C; a second Ctrl-C ends the processes."""
    stop, end = multiprocessing.Pipe(duplex=False)

    def pressed(*_: object) -> None:
        """Close the sending end; raise KeyboardInterrupt if it is closed already."""
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


def run_all(compiled_model: Model, how: LocalRun) -> tuple[RunPart, ...]:
    """Return the records of all peers, run on loopback in a process each; Ctrl-C ends all peers.

    A process that crashes, or does not end, has the trouble E975 in its own record.

    Raises
    ------
    ApcError
        E975 too many peers.
    """
    comm_graph = build_comm_graph(compiled_model, resolve(compiled_model).timings)
    if comm_graph.peers > MOST_PEERS:
        message = f"{comm_graph.peers:,} peers need as many processes; the limit is {MOST_PEERS}"
        raise ApcError(
            Diagnostic(
                "E975",
                SourceLocation(compiled_model.name),
                message,
                advice="start each peer with --peer NAME",
            )
        )
    names = [comm_graph.peer_name(index) for index in range(comm_graph.peers)]
    sockets = {name: listen_at((LOOPBACK, 0)) for name in names}
    addresses = {name: listening.getsockname() for name, listening in sockets.items()}
    stop, end = multiprocessing.Pipe(duplex=False)
    model, parts, patience = model_bytes(compiled_model), [], None
    running: dict[Future[RunPart], tuple[str, Workers[str, RunPart]]] = {}
    with ExitStack() as stack:
        for name, listening in sockets.items():  # a pool for each process, as a crash breaks the pool
            shared = _ProcessData(model, listening, addresses, how, stop)
            lost = Diagnostic(
                "E975", SourceLocation(name), "peer process exited unexpectedly; its recording is lost"
            )
            workers = stack.enter_context(local_processes(_run_peer, shared, 1, lost))
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
                parts.append(_record_of(future, workers))
            if not done:
                break
    silent = f"did not exit within {TO_END:g} s and was terminated; its recording is lost"
    for name, _ in running.values():
        parts.append(RunPart(None, ApcError(Diagnostic("E975", SourceLocation(name), silent))))
    for listening in sockets.values():
        listening.close()
    return tuple(parts)


def _record_of(done: Future[RunPart], workers: Workers[str, RunPart]) -> RunPart:
    """Return the record of a process that ended normally or with a reported error."""
    error = done.exception()
    if error is None:
        return done.result()
    trouble = error if isinstance(error, ApcError) else workers.trouble(error)
    if trouble is None:
        raise error
    return RunPart(None, trouble)


@dataclass(frozen=True, slots=True)
class _ProcessData:
    """The start data of a process: its socket, and all addresses.

    `stop` becomes readable to request the end.
    """

    model: bytes
    listening: socket.socket
    addresses: Mapping[str, Address]
    how: LocalRun
    stop: Connection


def _run_peer(shared: _ProcessData, name: str) -> RunPart:
    """Return the record of one peer, run in this process."""
    addresses = {other: address for other, address in shared.addresses.items() if other != name}
    model = model_of_bytes(shared.model)
    return run_single(model, name, shared.listening, addresses, shared.how, shared.stop)
