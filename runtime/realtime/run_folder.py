"""Reader of a run from its folder, which may come from an untrusted source.

Takes: the folder. Gives: `read_run`.
Guarantees: the record is possible for the topology in the same folder: sizes, names and values are consistent
with it and one another. No code of the folder is executed.
Does not: verify that the run took place.
"""

from __future__ import annotations

import hashlib
import re
from dataclasses import asdict, dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from apc.compiler.cache import read_archive
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import RefusedError, read_file
from apc.compiler.wording import counted
from apc.model_loading import loaded_model
from apc.network.packet_schedule import START, Route
from apc.npz import DamageError, read_arrays
from apc.realtime.packets import DROPPED
from apc.realtime.peer import live_topology
from apc.realtime.peer_run import ARRAYS, OF_ROUTES, TOPOLOGY, PeerRecord, PeerRun, RealtimeRun
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare

# Bytes of a peer's file, and of what it unpacks to: three hours of a thousand ticks a second.
LARGEST = 1 << 30
LONGEST = 1 << 24  # bytes of the metadata
MOST_PACKETS = 10**7  # packets of a directed link, including the lost ones between the first and the last
LATEST = 1 << 62  # nanoseconds: differences are representable, too


@dataclass(frozen=True, slots=True, eq=False)
class _Topology:
    """The reference for checking a peer's file: the model's `names` of peers, and the simulation."""

    names: tuple[str, ...]
    links: tuple[str, ...]
    simulation: Simulation

    @property
    def routes(self) -> tuple[Route, ...]:
        """The samples received over one link at the ticks of one clock, each."""
        return self.simulation.population.exchange_program.routes


def read_run(folder: Path) -> RealtimeRun:
    """Read a run. Raises ApcError E973 if a folder is none, damaged, or of several models."""

    def refuse(wrong: bool, message: str, hint: str = "apc run FILE --out ANOTHER") -> None:
        if wrong:
            raise ApcError(Diagnostic("E973", SourceLocation(str(folder)), message, hint=hint))

    files = sorted(folder.glob("*.npz"))
    none = f"holds no run: {TOPOLOGY} and a file a peer, as apc run writes them"
    refuse(not (folder / TOPOLOGY).is_file() or not files, none, "apc run FILE --out RUN")
    archive = read_archive(folder / TOPOLOGY)
    system = loaded_model(archive, folder)
    many = f"holds {counted(len(files), 'peer', ',')} of a topology with {system.peers:,}"
    refuse(len(files) > system.peers, many)
    names = tuple(f"{group.name}[{index + 1}]" for group in system.groups for index in range(group.count))
    simulation = prepare(live_topology(system), Settings(Fraction(1, 1000), jit=False))
    topology = _Topology(names, tuple(link.name for link in system.links), simulation)
    peers = tuple(
        sorted((_read_peer(path, topology) for path in files), key=lambda peer_run: peer_run.number)
    )
    differences = (
        "holds peers that did not play together: of other runs, of other topologies, or with another --set"
    )
    refuse(len({(peer.digest, peer.session) for peer in peers}) > 1, differences)
    played = hashlib.sha256(archive.model).hexdigest()
    refuse(peers[0].digest != played, f"its {TOPOLOGY} is not the topology that was played")
    refuse(len({peer.number for peer in peers}) < len(peers), "holds a peer twice")
    return RealtimeRun(str(folder), system, peers)


def _read_peer(path: Path, topology: _Topology) -> PeerRun:
    try:
        peer = _peer(read_file(path, LARGEST), topology)
        for check in (_check_words, _check_signals, _check_packets):
            check(peer, topology)
    except (RefusedError, DamageError) as error:
        raise ApcError(
            Diagnostic("E973", SourceLocation(str(path)), f"is no peer of this run: {error}")
        ) from None
    return peer


def _want(right: bool | np.bool_, fault: str) -> None:
    """Raise DamageError with a fault unless something is right."""
    if not right:
        raise DamageError(fault)


def _peer(data: bytes, topology: _Topology) -> PeerRun:
    """Return the contents of a file; only names and types have been checked."""
    of_routes = {
        name: {f"{name}{at}": kind for at in range(len(topology.routes))} for name, kind in OF_ROUTES.items()
    }
    kinds = {"record": ("|u1", 1), **ARRAYS} | of_routes["packets"] | of_routes["missing"]
    result = read_arrays(data, kinds, LARGEST)
    _want(result.keys() == kinds.keys(), f"it lacks one of {', '.join(kinds)}")
    _want(result["record"].size <= LONGEST, "it tells too much")
    try:
        words = msgspec.json.decode(result["record"].tobytes(), type=PeerRecord)
        _want(all(map(str.isprintable, words.not_granted)), "")  # it is shown in a terminal
    except ValueError:
        raise DamageError("what it tells is not what apc run writes") from None
    arrays: dict[str, Any] = {name: result[name] for name in ARRAYS}
    arrays |= {name: tuple(map(result.__getitem__, of_route)) for name, of_route in of_routes.items()}
    return PeerRun(**asdict(words), **arrays)


def _check_words(peer: PeerRun, topology: _Topology) -> None:
    """Check the metadata against the model."""
    peers, links = range(len(topology.names)), range(len(topology.links))
    _want(peer.number in peers and peer.name == topology.names[peer.number], "the topology has no such peer")
    _want(re.fullmatch("[0-9a-f]{64}", peer.digest) is not None, "it doesn't say of which topology it is")
    _want(0 <= peer.session < 1 << 64, "its session is no number of 64 bits")
    _want(0 <= peer.first < peer.frames <= LATEST, "it joins after the end")
    _want(peer.dropped.keys() <= DROPPED.keys(), "datagrams are dropped for no known reason")
    sent = [(link, *pair) for link, by_peer in peer.sent.items() for pair in by_peer.items()]
    counts = [*peer.dropped.values(), *(count for *_, count in sent)]
    _want(all(0 <= count <= LATEST for count in counts), "a count is negative, or beyond all time")
    others = {*peer.offsets, *(other for _, other, _ in sent)}
    known = peer.sent.keys() <= {*links} and others <= {*peers}
    _want(known, "it tells of a peer or link that isn't there")


def _check_signals(peer: PeerRun, topology: _Topology) -> None:
    """Check the recorded instants: their order, and their distance within a frame."""
    simulation = topology.simulation
    frame = float(simulation.frame * simulation.quantum)
    signals = tuple(signal.name for signal in simulation.signals if signal.name.startswith(f"{peer.name}."))
    _want(peer.signals == signals, "its signals are not those of the topology")
    _want(
        peer.values.shape == (len(peer.time), len(signals)),
        "it has not one value of each signal at each time",
    )
    _want(
        np.isfinite(peer.time).all() and np.isfinite(peer.values).all(),
        "a time or signal is no finite number",
    )
    steps = np.diff(peer.time, prepend=peer.first * frame)
    _want((steps[1:] > 0).all() and (peer.time >= 0).all(), "its times do not increase")
    _want((steps <= frame * (1 + 1e-9)).all(), "it leaves out a frame or more")
    _want(len(peer.delayed) == len(peer.took), "its ticks did not begin as often as they ended")
    for ticks in (peer.delayed, peer.took):
        _want(np.isfinite(ticks).all() and (ticks >= 0).all(), "a tick began, or took, no time there is")


def _check_packets(peer: PeerRun, topology: _Topology) -> None:
    """Check the received packets, and those used at ticks."""
    for route, packets, missing in zip(topology.routes, peer.packets, peer.missing, strict=True):
        arcs = int((route.pairs[:, 1] == peer.number).sum())
        _want(
            packets.shape == missing.shape == (len(packets), arcs), "it hears other peers than the topology's"
        )
        _want(((packets >= START) & (packets <= LATEST)).all(), "a packet has a number that none has")
    _want(peer.arrivals.shape[1:] == (5,), "what came is not told in five numbers")
    links, senders, counts, sampled, came = peer.arrivals.T
    _want(((counts >= 0) & (sampled >= 0) & (sampled <= LATEST)).all(), "a packet has no time that there is")
    _want(((came >= -LATEST) & (came <= LATEST)).all(), "a packet came at no time that there is")
    received = {
        (topology.links.index(route.link), sender)
        for route in topology.routes
        for sender in route.pairs[route.pairs[:, 1] == peer.number, 0].tolist()
    }
    _want(
        {*zip(links.tolist(), senders.tolist(), strict=True)} <= received,
        "a packet came from where none comes",
    )
    for link, sender in received:
        count = counts[(links == link) & (senders == sender)]
        span = int(count.max(initial=0)) - int(count.min(initial=LATEST))
        _want(span < MOST_PACKETS, f"a way has more than {MOST_PACKETS:,} packets")
