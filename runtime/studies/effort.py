"""The cost of a scheme: operations per tick, and numbers sent over its links.

Takes: a `Model`.
Gives: `Effort`, `effort`.
Guarantees: counts are from the compiled functions and the graphs, and the same on every machine. For
complete graphs the cost of counting depends on the number of groups, not of peers.
Does not: measure time (see `benchmark`), or count the headers of packets.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model, PeerType, Receive
from apc.compiler.expression_data import POLISH, straight
from apc.compiler.weights import arcs
from apc.parameter_values.parameters import resolve

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True)
class Effort:
    """The largest number of operations of a peer per tick, and the numbers sent per second.

    `operations` are those of a tick of `clock`, the clock with the most operations: the arithmetic of the
    compiled equations, one iteration of each nonlinear loop, and one operation for each received number, or
    the operations for each pair of peers in a pairwise reduction. `sent` are the numbers per second sent by
    the peer with the most, counted once per receiver; `sent_by_all` by all peers.
    """

    operations: int
    clock: str
    sent: float
    sent_by_all: float


def effort(model: Model) -> Effort:
    """Return the cost of a scheme: operations per tick, and numbers sent per second.

    Parameters
    ----------
    model
        The model.
    """
    peer_types = [model.peer_types[group.peer_type] for group in model.groups]
    counts = np.array([group.count for group in model.groups], dtype=np.int64)
    names = np.array([group.name for group in model.groups])
    timings = resolve(model).timings
    rates = {clock.name: float(1 / timings[clock.period]) for clock in model.clocks}
    received: dict[str, Integers] = {}
    largest_rates, total_rates = np.zeros(len(peer_types)), np.zeros(len(peer_types))
    for link in model.links:
        channels = np.array([_channels(peer_type, link) for peer_type in peer_types], dtype=np.int64)
        receives = np.array([_receives(peer_type, link) for peer_type in peer_types])
        packets = np.full((len(counts), len(counts)), rates[link.clock])
        for pair in (pair for pair in link.pairs if pair.clock):
            of_pair = np.ix_(names == pair.sender, names == pair.receiver)
            packets[of_pair] = rates[pair.clock]
        received[link.name], most, total = _directed_link_rates(link, counts, channels > 0, receives, packets)
        largest_rates += channels * most
        total_rates += channels * total
    ticks = [
        (
            _operations(clock.tick)
            + sum(_reception_cost(receive, int(received[receive.link][index])) for receive in clock.receives),
            clock.clock,
        )
        for index, peer_type in enumerate(peer_types)
        for clock in peer_type.clocks
    ]
    operations, name = max(ticks, key=lambda tick: tick[0], default=(0, ""))
    return Effort(operations, name, float(largest_rates.max(initial=0.0)), float(total_rates.sum()))


def _channels(peer_type: PeerType, link: Link) -> int:
    """Return the number of values in a peer's packet over a link."""
    return sum(len(send.channels) for send in peer_type.sends if send.link == link.name)


def _receives(peer_type: PeerType, link: Link) -> bool:
    """Return whether a peer uses the values received over a link."""
    return any(receive.link == link.name for clock in peer_type.clocks for receive in clock.receives)


def _directed_link_rates(
    link: Link, counts: Integers, sends: NDArray[np.bool_], receives: NDArray[np.bool_], rates: Floats
) -> tuple[Integers, Floats, Floats]:
    """Return the largest number of senders to one peer, and the packet rates in 1/s, by group (K,).

    These are the largest rate from one peer to all its receivers, and the rate from all peers of the group.

    Parameters
    ----------
    link
        The link.
    counts, sends, receives
        (K,) by group: the number of peers, and whether they send and receive over the link.
    rates
        (K, K) the rate of the packets from one group to another, first the sender.
    """
    if link.graph.shape == "complete":
        received = receives * (int((sends * counts).sum()) - sends)
        receivers: Floats = sends * (rates @ (receives * counts) - rates.diagonal() * receives)
        return received, receivers, receivers * counts
    peers, starts = int(counts.sum()), np.cumsum([0, *counts[:-1]])
    group = np.repeat(np.arange(len(counts)), counts)
    pairs, _ = arcs(link.graph, peers)
    pairs = pairs[sends[group[pairs[:, 0]]] & receives[group[pairs[:, 1]]]]
    senders = np.bincount(pairs[:, 1], minlength=peers)
    of_pair = rates[group[pairs[:, 0]], group[pairs[:, 1]]]
    receivers = np.asarray(np.bincount(pairs[:, 0], of_pair, minlength=peers), dtype=np.float64)
    return (
        np.maximum.reduceat(senders, starts),
        np.maximum.reduceat(receivers, starts),
        np.add.reduceat(receivers, starts),
    )


def _reception_cost(receive: Receive, peers: int) -> int:
    """Return the number of operations of a reduction over `peers` senders."""
    return peers if receive.edge is None else peers * (1 + _operations(receive.edge))


def _operations(function: Any) -> int:
    """Return the number of operations of a function and its loops, without inputs and constants."""
    if function.is_a("SXFunction"):
        return len(straight(function).operations)
    called = {inner.name(): inner for inner in function.find_functions(0) if inner.name() != POLISH}
    return sum(_operations(item if item.is_a("SXFunction") else item.oracle()) for item in called.values())
