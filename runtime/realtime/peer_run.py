"""The record of a run on disk: a file per peer, a trace per directed link, and the topology.

Takes: a `PeerLoop` that has ended. Gives: `PeerRecord`, `PeerRun`, `RealtimeRun`, `run_of`, `check_folder`,
`write_run`; `delays_of`, `file_name`, `trace_name`.
Guarantees: a run is moved to its destination when completely written; until then the destination is
unchanged.
Does not: read a run (see `run_folder`), or compare it with analysis (see `run_comparison`).
"""

from __future__ import annotations

import math
import tempfile
from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from apc.compiler import store
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.files import check_target, same_file, unwritable
from apc.realtime.peer import NANO, PeerLoop
from apc.simulation.output_blocks import instants_of

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

TOPOLOGY = "topology.apc"
# The type and the number of dimensions of the arrays in a peer's file, and of the arrays of each route.
ARRAYS = {
    "time": ("<f8", 1),
    "values": ("<f8", 2),
    "delayed": ("<f8", 1),
    "took": ("<f8", 1),
    "arrivals": ("<i8", 2),
}
OF_ROUTES = {"packets": ("<i8", 2), "missing": ("|b1", 2)}


@dataclass(frozen=True, slots=True, eq=False)
class PeerRecord:
    """The metadata of one peer's run.

    `session` is the common session number; `first` is the frame in which the peer joined, of `frames`;
    `outside` states whether it had an external device. `signals` are the recorded signals. `dropped` counts
    datagrams by reason; `not_granted` lists the privileges that were not granted; `sent` counts packets by
    link and receiver; `offsets` are, for each other peer, the shortest round trip and the lead of its clock,
    in seconds.
    """

    name: str
    number: int
    digest: str
    session: int
    first: int
    frames: int
    stopped: bool
    emulated: bool
    outside: bool
    signals: tuple[str, ...]
    dropped: dict[str, int]
    not_granted: tuple[str, ...]
    sent: dict[int, dict[int, int]]
    offsets: dict[int, tuple[float, float]]


@dataclass(frozen=True, slots=True, eq=False)
class PeerRun(PeerRecord):
    """The record of one peer's run.

    `values` (rows, signals) are its signals at `time` (rows,) in seconds, as `simulate` returns them.
    `delayed` and `took` (n,) are, for each instant, the start after its due time and the execution time, in
    seconds. `arrivals` (n, 5) are link, sender, count, sampling instant and arrival instant of a packet, in
    nanoseconds of the session. `packets` and `missing` are, per route of the model, the packets in effect and
    the losses at its ticks on the peer's incoming links (ticks, links).
    """

    time: Floats
    values: Floats
    delayed: Floats
    took: Floats
    arrivals: Integers
    packets: tuple[Integers, ...]
    missing: tuple[NDArray[np.bool_], ...]

    @property
    def arcs(self) -> list[tuple[int, int]]:
        """The (link, sender) pairs of incoming directed links with packets."""
        return sorted({(link, sender) for link, sender in self.arrivals[:, :2].tolist()})


@dataclass(frozen=True, slots=True, eq=False)
class RealtimeRun:
    """The records of some or all peers of one run of a model."""

    folder: str
    model: Model
    peers: tuple[PeerRun, ...]


def run_of(loop: PeerLoop, digest: bytes, not_given: tuple[str, ...]) -> PeerRun:
    """Return the record of a loop that has ended."""
    simulation, player = loop.simulation, loop.player
    rows = np.concatenate([np.zeros((0, simulation.population.width)), *loop.rows])
    last = int(simulation.settings.duration / simulation.quantum)
    frame_count = len(rows) // len(simulation.sample_times)
    instants, is_recorded = instants_of(simulation, loop.first, frame_count, last)
    is_recorded &= np.isfinite(rows).all(axis=1)
    # After a stop request the loop does not wait for the last instant.
    log = np.maximum(np.array(player.log, np.int64).reshape(-1, 3), 0)

    def at_ticks(index: int, kind: type) -> tuple[NDArray[Any], ...]:
        """Return one entry of the records at ticks for each route, (ticks, links)."""
        arcs = zip(player.observed, loop.mine, strict=True)
        return tuple(
            np.array([tick[index] for tick in ticks], kind).reshape(len(ticks), len(mine))
            for ticks, mine in arcs
        )

    return PeerRun(
        name=loop.name,
        number=loop.local,
        digest=digest.hex(),
        session=loop.session,
        first=loop.first,
        frames=loop.frames,
        stopped=loop.stopped,
        emulated=loop.player.network is not None,
        outside=loop.player.outside is not None,
        signals=tuple(signal.name for signal in simulation.signals),
        dropped=dict(loop.post.dropped),
        not_granted=not_given,
        sent={link: dict(counts) for link, counts in player.sent.items()},
        offsets={number: (trip / NANO, ahead / NANO) for number, (trip, ahead) in loop.offsets.items()},
        time=np.asarray(instants[is_recorded] * float(simulation.quantum), np.float64),
        values=rows[is_recorded][:, simulation.order],
        delayed=log[:, 1] / NANO,
        took=log[:, 2] / NANO,
        arrivals=np.array(player.arrivals, np.int64).reshape(-1, 5),
        packets=at_ticks(0, np.int64),
        missing=at_ticks(1, np.bool_),
    )


def check_folder(folder: Path, topology: Path) -> None:
    """Raise an error, before the run starts, for a folder that cannot store a run of a model.

    Raises
    ------
    ApcError
        E973 the folder contains something else, E601 nothing can be written to it.
    """
    if folder.exists() and not folder.is_dir():
        message = "already exists and is not a folder"
    elif folder.exists() and any(folder.iterdir()) and not (folder / TOPOLOGY).is_file():
        message = "already exists and is not the folder of a run"
    elif any(
        same_file(folder / TOPOLOGY, path) for path in (topology, topology.parent / f"{topology.stem}.apc")
    ):
        message = "contains the topology of this run and is not the folder of a run"
    else:
        check_target(folder / TOPOLOGY if folder.exists() else folder)
        return
    raise ApcError(Diagnostic("E973", SourceLocation(str(folder)), message, fix="--out another.run"))


def write_run(folder: Path, model: Model, peers: Sequence[PeerRun], *, whole: bool = False) -> None:
    """Write the records of some peers to a folder.

    Parameters
    ----------
    folder
        The folder; created if missing.
    model
        The model.
    peers
        The records of some or all peers.
    whole
        Whether records of other peers in the folder are deleted.

    Raises
    ------
    ApcError
        E601 the folder cannot be written.
    """
    parent = folder if folder.is_dir() else folder.parent
    try:
        with tempfile.TemporaryDirectory(prefix=f".{folder.name[:64]}.", dir=parent) as temporary:
            temporary_folder = Path(temporary)
            store.save(model, temporary_folder / TOPOLOGY)
            for peer in peers:
                _write_peer(temporary_folder, peer, model)
            folder.mkdir(exist_ok=True)
            written = {path.name for path in temporary_folder.iterdir()}
            for name in sorted(
                written, key=lambda name: name != TOPOLOGY
            ):  # the file that identifies a run's folder comes first
                (temporary_folder / name).replace(folder / name)
        for path in (*folder.glob("*.npz"), *folder.glob("*-to-*.csv")) if whole else ():
            if path.name not in written:
                path.unlink()
    except OSError as error:
        raise unwritable(folder, error) from None


def _write_peer(folder: Path, peer: PeerRun, model: Model) -> None:
    """Write a peer's record, and the delay trace of each incoming directed link. Raises OSError."""
    record = msgspec.json.encode({field.name: getattr(peer, field.name) for field in fields(PeerRecord)})
    arrays = {name: getattr(peer, name) for name in ARRAYS}
    for name in OF_ROUTES:
        arrays |= {f"{name}{index}": array for index, array in enumerate(getattr(peer, name))}
    arrays["record"] = np.frombuffer(record, np.uint8)
    np.savez_compressed(folder / f"{file_name(peer.name)}.npz", **arrays)
    for link, sender in peer.arcs:
        rows = (
            "lost" if math.isinf(value) else f"{value * 1e3:.6f}" for value in delays_of(peer, link, sender)
        )
        text = "\n".join(["delay [ms]", *rows, ""])
        (folder / trace_name(model, link, sender, peer.number)).write_text(text, encoding="utf-8")


def delays_of(peer: PeerRun, link: int, sender: int) -> Floats:
    """Return the delays (n,) of a directed link's packets, from sampling to arrival.

    The delay of a lost packet is infinite. The delays begin with the first packet that the peer could receive
    and end with the last that arrived.
    """
    rows = peer.arrivals[(peer.arrivals[:, 0] == link) & (peer.arrivals[:, 1] == sender)]
    counts = rows[:, 2]
    delays = np.full(int(counts.max()) - int(counts.min()) + 1, math.inf)
    delays[counts - counts.min()] = np.maximum(rows[:, 4] - rows[:, 3], 0) / NANO
    return delays


def file_name(peer: str) -> str:
    """Return the file name `left-1` for `left[1]`, whose brackets are a pattern for a shell."""
    return peer.replace("[", "-").replace("]", "")


def trace_name(model: Model, link: int, sender: int, receiver: int) -> str:
    """Return the name of the trace of a directed link."""
    names = [f"{group.name}-{index + 1}" for group in model.groups for index in range(group.count)]
    return f"{model.links[link].name}-{names[sender]}-to-{names[receiver]}.csv"
