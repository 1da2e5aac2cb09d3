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
from apc.inputs.model_loading import loaded_model
from apc.network.packet_schedule import START, Route
from apc.realtime.packets import DROPPED
from apc.realtime.peer import live_topology
from apc.realtime.peer_run import ARRAYS, OF_ROUTES, TOPOLOGY, PeerRecord, PeerRun, RealtimeRun
from apc.simulation.presence import always_present
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare
from apc.support.npz import DamageError, read_arrays

# The limit in bytes of a peer's file and of its contents: three hours of a thousand ticks a second.
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
        """The routes of the simulation: the samples received over one link at the ticks of one clock."""
        return self.simulation.population.exchange_program.routes


def read_run(folder: Path) -> RealtimeRun:
    """Return the run in a folder. Raises ApcError E973 if the folder contains no run, or a damaged one."""

    def refuse(wrong: bool, message: str, fix: str = "apc run FILE --out ANOTHER") -> None:
        """Raise ApcError E973 if a condition is violated."""
        if wrong:
            raise ApcError(Diagnostic("E973", SourceLocation(str(folder)), message, fix=fix))

    files = sorted(folder.glob("*.npz"))
    none = f"has no run ({TOPOLOGY} and one file for each peer, as written by apc run)"
    refuse(not (folder / TOPOLOGY).is_file() or not files, none, "apc run FILE --out RUN")
    archive = read_archive(folder / TOPOLOGY)
    model = loaded_model(archive, folder)
    many = f"has {counted(len(files), 'peer', ',')} of a topology with {model.peers:,}"
    refuse(len(files) > model.peers, many)
    names = tuple(f"{group.name}[{index + 1}]" for group in model.groups for index in range(group.count))
    simulation = prepare(live_topology(always_present(model)), Settings(Fraction(1, 1000), jit=False))
    topology = _Topology(names, tuple(link.name for link in model.links), simulation)
    peers = tuple(
        sorted((_read_peer(path, topology) for path in files), key=lambda peer_run: peer_run.number)
    )
    differences = "has peers of different runs, topologies or --set options"
    refuse(len({(peer.digest, peer.session) for peer in peers}) > 1, differences)
    played = hashlib.sha256(archive.model).hexdigest()
    refuse(peers[0].digest != played, f"its {TOPOLOGY} is not the topology of the run")
    refuse(len({peer.number for peer in peers}) < len(peers), "contains a peer twice")
    return RealtimeRun(str(folder), model, peers)


def _read_peer(path: Path, topology: _Topology) -> PeerRun:
    """Return the record in a peer's file, checked against the model. Raises ApcError E973."""
    try:
        peer = _decode_peer(read_file(path, LARGEST), topology)
        for check in (_check_metadata, _check_signals, _check_packets):
            check(peer, topology)
    except (RefusedError, DamageError) as error:
        raise ApcError(
            Diagnostic("E973", SourceLocation(str(path)), f"is not a peer of this run: {error}")
        ) from None
    return peer


def _want(right: bool | np.bool_, fault: str) -> None:
    """Raise DamageError with a fault unless a condition holds."""
    if not right:
        raise DamageError(fault)


def _decode_peer(data: bytes, topology: _Topology) -> PeerRun:
    """Return the contents of a peer's file, with names and types checked."""
    of_routes = {
        name: {f"{name}{index}": kind for index in range(len(topology.routes))}
        for name, kind in OF_ROUTES.items()
    }
    kinds = {"record": ("|u1", 1), **ARRAYS} | of_routes["packets"] | of_routes["missing"]
    result = read_arrays(data, kinds, LARGEST)
    _want(result.keys() == kinds.keys(), f"it lacks one of {', '.join(kinds)}")
    _want(result["record"].size <= LONGEST, "its record is too long")
    try:
        metadata = msgspec.json.decode(result["record"].tobytes(), type=PeerRecord)
        _want(all(map(str.isprintable, metadata.not_granted)), "")  # it is shown in a terminal
    except ValueError:
        raise DamageError("its record was not written by apc run") from None
    arrays: dict[str, Any] = {name: result[name] for name in ARRAYS}
    arrays |= {name: tuple(map(result.__getitem__, of_route)) for name, of_route in of_routes.items()}
    return PeerRun(**asdict(metadata), **arrays)


def _check_metadata(peer: PeerRun, topology: _Topology) -> None:
    """Check the metadata against the model. Raises DamageError."""
    peers, links = range(len(topology.names)), range(len(topology.links))
    _want(peer.number in peers and peer.name == topology.names[peer.number], "the topology has no such peer")
    _want(re.fullmatch("[0-9a-f]{64}", peer.digest) is not None, "it does not identify its topology")
    _want(0 <= peer.session < 1 << 64, "its session is not a 64-bit number")
    _want(0 <= peer.first < peer.frames <= LATEST, "it joins after the end")
    _want(peer.dropped.keys() <= DROPPED.keys(), "the reason of a dropped datagram is unknown")
    sent = [(link, *pair) for link, by_peer in peer.sent.items() for pair in by_peer.items()]
    counts = [*peer.dropped.values(), *(count for *_, count in sent)]
    _want(all(0 <= count <= LATEST for count in counts), "a count is out of range")
    others = {*peer.offsets, *(other for _, other, _ in sent)}
    known = peer.sent.keys() <= {*links} and others <= {*peers}
    _want(known, "it names an unknown peer or link")


def _check_signals(peer: PeerRun, topology: _Topology) -> None:
    """Check the recorded instants: their order, and their distance within a frame. Raises DamageError."""
    simulation = topology.simulation
    frame = float(simulation.frame * simulation.quantum)
    signals = tuple(signal.name for signal in simulation.signals if signal.name.startswith(f"{peer.name}."))
    _want(peer.signals == signals, "its signals are not those of the topology")
    _want(
        peer.values.shape == (len(peer.time), len(signals)),
        "the numbers of values and times differ",
    )
    _want(
        np.isfinite(peer.time).all() and np.isfinite(peer.values).all(),
        "a time or signal is not finite",
    )
    steps = np.diff(peer.time, prepend=peer.first * frame)
    _want((steps[1:] > 0).all() and (peer.time >= 0).all(), "its times do not increase")
    _want((steps <= frame * (1 + 1e-9)).all(), "a frame is missing")
    _want(len(peer.delayed) == len(peer.took), "the numbers of begun and completed ticks differ")
    for ticks in (peer.delayed, peer.took):
        _want(np.isfinite(ticks).all() and (ticks >= 0).all(), "a time of a tick is negative or not finite")


def _check_packets(peer: PeerRun, topology: _Topology) -> None:
    """Check the received packets, and the packets in effect at ticks. Raises DamageError."""
    for route, packets, missing in zip(topology.routes, peer.packets, peer.missing, strict=True):
        arcs = int((route.pairs[:, 1] == peer.number).sum())
        _want(
            packets.shape == missing.shape == (len(packets), arcs),
            "its senders are not those of the topology",
        )
        _want(((packets >= START) & (packets <= LATEST)).all(), "a packet has an invalid number")
    _want(peer.arrivals.shape[1:] == (5,), "an arrival does not have five numbers")
    links, senders, counts, sampled, came = peer.arrivals.T
    _want(((counts >= 0) & (sampled >= 0) & (sampled <= LATEST)).all(), "a packet has an invalid time")
    _want(((came >= -LATEST) & (came <= LATEST)).all(), "a packet has an invalid arrival time")
    received = {
        (topology.links.index(route.link), sender)
        for route in topology.routes
        for sender in route.pairs[route.pairs[:, 1] == peer.number, 0].tolist()
    }
    _want(
        {*zip(links.tolist(), senders.tolist(), strict=True)} <= received,
        "a packet is from an unconnected peer",
    )
    for link, sender in received:
        count = counts[(links == link) & (senders == sender)]
        span = int(count.max(initial=0)) - int(count.min(initial=LATEST))
        _want(span < MOST_PACKETS, f"a directed connection has more than {MOST_PACKETS:,} packets")
