"""A run read from its folder, whoever wrote it.

Takes: the folder. Gives: `read_run`.
Guarantees: what is read is what peers of the scene beside it can have done: sizes, names and numbers fit the
scene and one another; nothing of it is run.
Does not: ask whether it was so.
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
from apc.compiler.words import counted
from apc.loop.packets import DROPPED
from apc.loop.peer import live_scene
from apc.loop.run import ARRAYS, OF_ROUTES, SCENE, PeerRecord, PeerRun, RealtimeRun
from apc.network.timetable import START, Route
from apc.npz import DamageError, read_arrays
from apc.opening import opened
from apc.simulation.settings import Settings
from apc.simulation.simulation import Simulation, prepare

# Bytes of a peer's file, and of what it unpacks to: three hours of a thousand ticks a second.
LARGEST = 1 << 30
LONGEST = 1 << 24  # bytes of what is told in words
MOST_PACKETS = 10**7  # of a way, the lost ones between the first and the last included
LATEST = 1 << 62  # nanoseconds: what any two differ by can be told as well


@dataclass(frozen=True, slots=True, eq=False)
class _Scene:
    """What a peer's file is held against: the scene's `names` of peers, and what simulates it."""

    names: tuple[str, ...]
    links: tuple[str, ...]
    simulation: Simulation

    @property
    def routes(self) -> tuple[Route, ...]:
        """What is heard over one link at the ticks of one clock, each."""
        return self.simulation.population.hearing.routes


def read_run(folder: Path) -> RealtimeRun:
    """Read a run. Raises ApcError E973 if a folder is none, damaged, or of several scenes."""

    def refuse(wrong: bool, what: str, hint: str = "apc play FILE --out ANOTHER") -> None:
        if wrong:
            raise ApcError(Diagnostic("E973", SourceLocation(str(folder)), what, hint=hint))

    files = sorted(folder.glob("*.npz"))
    none = f"holds no run: {SCENE} and a file a peer, as apc play writes them"
    refuse(not (folder / SCENE).is_file() or not files, none, "apc play FILE --out RUN")
    archive = read_archive(folder / SCENE)
    system = opened(archive, folder)
    many = f"holds {counted(len(files), 'peer', ',')} of a scene with {system.peers:,}"
    refuse(len(files) > system.peers, many)
    names = tuple(f"{group.name}[{place + 1}]" for group in system.groups for place in range(group.count))
    simulation = prepare(live_scene(system), Settings(Fraction(1, 1000), jit=False))
    scene = _Scene(names, tuple(link.name for link in system.links), simulation)
    peers = tuple(sorted((_read_peer(path, scene) for path in files), key=lambda peer_run: peer_run.number))
    apart = "holds peers that did not play together: of other runs, of other scenes, or with another --set"
    refuse(len({(peer.digest, peer.session) for peer in peers}) > 1, apart)
    played = hashlib.sha256(archive.model).hexdigest()
    refuse(peers[0].digest != played, f"its {SCENE} is not the scene that was played")
    refuse(len({peer.number for peer in peers}) < len(peers), "holds a peer twice")
    return RealtimeRun(str(folder), system, peers)


def _read_peer(path: Path, scene: _Scene) -> PeerRun:
    try:
        peer = _peer(read_file(path, LARGEST), scene)
        for check in (_check_words, _check_signals, _check_packets):
            check(peer, scene)
    except (RefusedError, DamageError) as error:
        raise ApcError(
            Diagnostic("E973", SourceLocation(str(path)), f"is no peer of this run: {error}")
        ) from None
    return peer


def _want(right: bool | np.bool_, fault: str) -> None:
    """Raise DamageError with a fault unless something is right."""
    if not right:
        raise DamageError(fault)


def _peer(data: bytes, scene: _Scene) -> PeerRun:
    """Return what a file holds, of which only the names and the types are known to be right."""
    of_routes = {
        name: {f"{name}{at}": kind for at in range(len(scene.routes))} for name, kind in OF_ROUTES.items()
    }
    kinds = {"told": ("|u1", 1), **ARRAYS} | of_routes["packets"] | of_routes["missing"]
    result = read_arrays(data, kinds, LARGEST)
    _want(result.keys() == kinds.keys(), f"it lacks one of {', '.join(kinds)}")
    _want(result["told"].size <= LONGEST, "it tells too much")
    try:
        words = msgspec.json.decode(result["told"].tobytes(), type=PeerRecord)
        _want(all(map(str.isprintable, words.not_given)), "")  # it is shown in a terminal
    except ValueError:
        raise DamageError("what it tells is not what apc play writes") from None
    arrays: dict[str, Any] = {name: result[name] for name in ARRAYS}
    arrays |= {name: tuple(map(result.__getitem__, of_route)) for name, of_route in of_routes.items()}
    return PeerRun(**asdict(words), **arrays)


def _check_words(peer: PeerRun, scene: _Scene) -> None:
    """Check what is said in words against the scene."""
    peers, links = range(len(scene.names)), range(len(scene.links))
    _want(peer.number in peers and peer.name == scene.names[peer.number], "the scene has no such peer")
    _want(re.fullmatch("[0-9a-f]{64}", peer.digest) is not None, "it doesn't say of which scene it is")
    _want(0 <= peer.session < 1 << 64, "its session is no number of 64 bits")
    _want(0 <= peer.first < peer.frames <= LATEST, "it joins after the end")
    _want(peer.dropped.keys() <= DROPPED.keys(), "datagrams are dropped for no known reason")
    sent = [(link, *pair) for link, by_peer in peer.sent.items() for pair in by_peer.items()]
    counts = [*peer.dropped.values(), *(count for *_, count in sent)]
    _want(all(0 <= count <= LATEST for count in counts), "a count is negative, or beyond all time")
    others = {*peer.offsets, *(other for _, other, _ in sent)}
    known = peer.sent.keys() <= {*links} and others <= {*peers}
    _want(known, "it tells of a peer or link that isn't there")


def _check_signals(peer: PeerRun, scene: _Scene) -> None:
    """Check what was recorded at instants: their order, and that each is within a frame of the last."""
    simulation = scene.simulation
    frame = float(simulation.frame * simulation.quantum)
    signals = tuple(signal.name for signal in simulation.signals if signal.name.startswith(f"{peer.name}."))
    _want(peer.signals == signals, "its signals are not those of the scene")
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
    _want(len(peer.late) == len(peer.took), "its ticks did not begin as often as they ended")
    for ticks in (peer.late, peer.took):
        _want(np.isfinite(ticks).all() and (ticks >= 0).all(), "a tick began, or took, no time there is")


def _check_packets(peer: PeerRun, scene: _Scene) -> None:
    """Check what came, and what ticks saw of it."""
    for route, packets, missing in zip(scene.routes, peer.packets, peer.missing, strict=True):
        ways = int((route.pairs[:, 1] == peer.number).sum())
        _want(packets.shape == missing.shape == (len(packets), ways), "it hears other peers than the scene's")
        _want(((packets >= START) & (packets <= LATEST)).all(), "a packet has a number that none has")
    _want(peer.arrivals.shape[1:] == (5,), "what came is not told in five numbers")
    links, senders, counts, sampled, came = peer.arrivals.T
    _want(((counts >= 0) & (sampled >= 0) & (sampled <= LATEST)).all(), "a packet has no time that there is")
    _want(((came >= -LATEST) & (came <= LATEST)).all(), "a packet came at no time that there is")
    heard = {
        (scene.links.index(route.link), sender)
        for route in scene.routes
        for sender in route.pairs[route.pairs[:, 1] == peer.number, 0].tolist()
    }
    _want(
        {*zip(links.tolist(), senders.tolist(), strict=True)} <= heard, "a packet came from where none comes"
    )
    for link, sender in heard:
        count = counts[(links == link) & (senders == sender)]
        span = int(count.max(initial=0)) - int(count.min(initial=LATEST))
        _want(span < MOST_PACKETS, f"a way has more than {MOST_PACKETS:,} packets")
