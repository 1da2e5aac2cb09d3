"""Communication graphs: senders, receivers, weights and delays of the links between the peers of a model.

Takes: a `Model` and its timings.
Gives: `CommunicationGraph`, `build_comm_graph`, `check_mean`.
Guarantees: a complete graph, a ring and a star cost no more than their arcs.
Does not: know values or instants (see `scheduling`), or a graph's eigenvalues (see `graph_modes`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.weights import arcs

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Cached communication graphs.
CACHE_SIZE = 16


@dataclass(frozen=True, slots=True, eq=False)
class CommunicationGraph:
    """The links between the groups of a model.

    `topology` is the topology's file; `groups` are the groups' names (parts of one group have one name and
    are consecutive), `starts` (K + 1,) the number of each group's first peer and the total; `default_delay`
    is the timing of a link's delay, `pair_delay` that between two groups (link, sender, receiver) where it,
    the channel or the clock differs: of timings of equal value, channel and clock, always the same one.
    """

    topology: str
    groups: tuple[str, ...]
    starts: Integers
    links: Mapping[str, Link]
    default_delay: Mapping[str, str]
    pair_delay: Mapping[tuple[str, int, int], str]

    @property
    def peers(self) -> int:
        """The number of peers."""
        return int(self.starts[-1])

    def delay(self, link: str, sender: int, receiver: int) -> str:
        """Return the timing of the delay of a link from one group to another."""
        return self.pair_delay.get((link, sender, receiver), self.default_delay[link])

    def delay_class(self, group: int) -> int:
        """Return the group's index if a delay to or from the group differs from the default, else −1."""
        named = any(group in (sender, receiver) for _, sender, receiver in self.pair_delay)
        return group if named else -1

    def is_complete(self, link: str) -> bool:
        """Return whether the graph of the link is complete."""
        return self.links[link].graph.shape == "complete"

    def arcs(self, link: str) -> tuple[Integers, Floats]:
        """Return the (sender, receiver) pairs (M, 2) and the weights (M,) of a link that is not complete."""
        return arcs(self.links[link].graph, self.peers)

    def receives(self, link: str, receiver: int, sending: Sequence[bool]) -> list[int]:
        """Return the sending groups that have a link to some peer of group `receiver`."""
        counts = np.diff(self.starts)
        if self.is_complete(link):
            return [h for h, sends in enumerate(sending) if sends and counts[h] > (1 if h == receiver else 0)]
        pairs, _ = self.arcs(link)
        group_of = np.searchsorted(self.starts, pairs, side="right") - 1
        received = np.bincount(group_of[group_of[:, 1] == receiver, 0], minlength=len(sending))
        return [h for h, sends in enumerate(sending) if sends and received[h]]

    def group_of(self, peer: int) -> int:
        """Return the group of a peer number."""
        return int(np.searchsorted(self.starts, peer, side="right")) - 1

    def peer_name(self, peer: int) -> str:
        """Return the label `left[2]` of a peer number."""
        name = self.groups[self.group_of(peer)]
        return f"{name}[{peer - int(self.starts[self.groups.index(name)]) + 1}]"


def build_comm_graph(model: Model, timings: Mapping[str, Fraction]) -> CommunicationGraph:
    """Return the communication graph of a model; delays of equal value, channel and clock are one timing.

    Parameters
    ----------
    model
        The compiled model.
    timings
        Seconds by the name of the timing.
    """
    groups = tuple((group.name, group.count) for group in model.groups)
    return _cached_graph(model.origin.topology, groups, model.links, tuple(timings.items()))


@functools.lru_cache(maxsize=CACHE_SIZE)
def _cached_graph(
    topology: str,
    groups: tuple[tuple[str, int], ...],
    links: tuple[Link, ...],
    times: tuple[tuple[str, Fraction], ...],
) -> CommunicationGraph:
    """Return the communication graph of `build_comm_graph`, cached for models with equal times and graphs.

    Parameters
    ----------
    topology
        The file of the topology.
    groups
        The name and the number of peers of each group.
    links, times
        The links of the model, and the name and value in seconds of each timing.
    """
    names, timings = tuple(name for name, _ in groups), dict(times)
    indices: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        indices.setdefault(name, []).append(index)
    pair_delay: dict[tuple[str, int, int], str] = {}
    for link in links:
        timing_by_value = {(timings[link.delay], ""): link.delay}
        for pair in link.pairs:
            timing = pair.delay
            if pair.channel is None:
                timing = timing_by_value.setdefault((timings[pair.delay], pair.clock), pair.delay)
            if timing != link.delay:
                pairs = itertools.product(indices[pair.sender], indices[pair.receiver])
                pair_delay |= {(link.name, sender, receiver): timing for sender, receiver in pairs}
    return CommunicationGraph(
        topology=topology,
        groups=names,
        starts=np.cumsum([0] + [count for _, count in groups], dtype=np.int64),
        links={link.name: link for link in links},
        default_delay={link.name: link.delay for link in links},
        pair_delay=pair_delay,
    )


def check_mean(
    communication_graph: CommunicationGraph,
    peer: int,
    link: str,
    operator: str,
    receives: bool,
    total: Fraction,
) -> None:
    """Raise ApcError E801 for a mean, maximum or minimum over no peers, E802 for a mean whose weights
    sum to 0.

    Parameters
    ----------
    communication_graph
        The communication graph.
    peer
        The number of the receiving peer.
    link, operator
        The link and the operator over it.
    receives
        Whether the peer receives from any other peer.
    total
        The sum of the weights.
    """
    name = communication_graph.peer_name(peer)
    if not receives:
        message = f"{name} has no incoming connection over {link}, so {operator}() is undefined"
        advice = f"add an arc to {name}"
        raise ApcError(
            Diagnostic("E801", SourceLocation(communication_graph.topology), message, advice=advice)
        )
    if not total:
        message = f"the weights of {name} over {link} add up to 0, so mean() is undefined"
        raise ApcError(Diagnostic("E802", SourceLocation(communication_graph.topology), message))
