"""What a scheme costs: the operations of a tick, and the numbers that go over its links.

Takes: a `Model`.
Gives: `Effort`, `effort`.
Guarantees: counted from the compiled functions and the graphs, so it is the same on every machine; peers that
hear each other all cost a group, not a peer.
Does not: measure time (see `benchmark`), or count the headers of packets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model, PeerType, Receive
from apc.compiler.plain import POLISH, straight
from apc.frame.exchange import arcs
from apc.frame.parameters import resolve

Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Effort:
    """What the peer does that has most to do, and what is sent.

    `operations` are those of a tick of `clock`, of all clocks the one with most: the arithmetic of the
    compiled equations, one iteration of each nonlinear loop, and one operation for each number heard, or,
    where a reduction can't be taken apart, what each pair of peers takes. `sent` are the numbers a second of
    the peer that sends most, each counted once for everybody who hears it, `sent_by_all` those of all peers.
    """

    operations: int
    clock: str
    sent: float
    sent_by_all: float


def effort(system: Model) -> Effort:
    """Count what a scheme costs.

    Parameters
    ----------
    system
        The compiled scene.
    """
    kinds = [system.kinds[group.kind] for group in system.groups]
    counts = np.array([group.count for group in system.groups], dtype=np.int64)
    timings = resolve(system).timings
    rates = {clock.name: 1 / float(timings[clock.period]) for clock in system.clocks}
    heard: dict[str, Integers] = {}
    busiest, every = np.zeros(len(kinds)), np.zeros(len(kinds))
    for link in system.links:
        channels = np.array([_channels(kind, link) for kind in kinds], dtype=np.int64)
        hears = np.array([_hears(kind, link) for kind in kinds])
        heard[link.name], most, total = _ways(link, counts, channels > 0, hears)
        busiest += channels * most * rates[link.clock]
        every += channels * total * rates[link.clock]
    ticks = [
        (
            _operations(clock.tick)
            + sum(_to_hear(receive, int(heard[receive.link][place])) for receive in clock.receives),
            clock.clock,
        )
        for place, kind in enumerate(kinds)
        for clock in kind.clocks
    ]
    operations, name = max(ticks, key=lambda tick: tick[0], default=(0, ""))
    return Effort(operations, name, float(busiest.max(initial=0.0)), float(every.sum()))


def _channels(kind: PeerType, link: Link) -> int:
    """Return how many numbers a peer's packet over a link holds."""
    return sum(len(send.channels) for send in kind.sends if send.link == link.name)


def _hears(kind: PeerType, link: Link) -> bool:
    """Say whether a peer reads what it hears over a link."""
    return any(receive.link == link.name for clock in kind.clocks for receive in clock.receives)


def _ways(
    link: Link, counts: Integers, sends: NDArray[np.bool_], hears: NDArray[np.bool_]
) -> tuple[Integers, Integers, Integers]:
    """Return by group: how many a peer hears at most; by how many it is heard at most, and all of its peers.

    Parameters
    ----------
    link
        The link.
    counts, sends, hears
        (K,) by group: how many peers it has, and whether they send over the link, and read it.
    """
    if link.graph.shape == "complete":
        heard = hears * (int((sends * counts).sum()) - sends)
        receivers = sends * (int((hears * counts).sum()) - hears)
        return heard, receivers, receivers * counts
    peers, starts = int(counts.sum()), np.cumsum([0, *counts[:-1]])
    group = np.repeat(np.arange(len(counts)), counts)
    pairs, _ = arcs(link.graph, peers)
    pairs = pairs[sends[group[pairs[:, 0]]] & hears[group[pairs[:, 1]]]]
    senders, receivers = (np.bincount(pairs[:, side], minlength=peers) for side in (1, 0))
    return (
        np.maximum.reduceat(senders, starts),
        np.maximum.reduceat(receivers, starts),
        np.add.reduceat(receivers, starts),
    )


def _to_hear(receive: Receive, peers: int) -> int:
    """Return the operations of a reduction over so many peers."""
    return peers if receive.edge is None else peers * (1 + _operations(receive.edge))


def _operations(function: Any) -> int:
    """Return how many operations a function has, with those of its loops; inputs and constants are none."""
    if function.is_a("SXFunction"):
        return len(straight(function).operations)
    called = {
        find_function.name(): find_function
        for find_function in function.find_functions(0)
        if find_function.name() != POLISH
    }
    return sum(_operations(item if item.is_a("SXFunction") else item.oracle()) for item in called.values())
