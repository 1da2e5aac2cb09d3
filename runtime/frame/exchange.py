"""Who hears whom, with what weight and how late: the links of a scene between its peers.

Takes: a `Model` and its timings.
Gives: `CommunicationGraph`, `build_exchange`, `arcs`, `check_mean`.
Guarantees: a complete graph, a ring and a star cost no more than their arcs.
Does not: know what is sent, or when (see `scheduling`), or a graph's eigenvalues (see `graph_modes`).
"""

from __future__ import annotations

import functools
import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Graph, Link, Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]

# Exchanges that are remembered.
KEPT = 16


@dataclass(frozen=True, slots=True, eq=False)
class CommunicationGraph:
    """The links between the groups of a scene.

    `scene` is the file it stands in; `groups` are the groups' names (parts of one group have one name and
    follow each other), `starts` (K + 1,) the number of each
    group's first peer and the number of all; `usual` is the timing of a link's delay, `late` that between two
    groups (link, sender, receiver) where it is another: of timings of equal value, always the same one.
    """

    scene: str
    groups: tuple[str, ...]
    starts: Integers
    links: Mapping[str, Link]
    usual: Mapping[str, str]
    late: Mapping[tuple[str, int, int], str]

    @property
    def peers(self) -> int:
        """The number of peers."""
        return int(self.starts[-1])

    def delay(self, link: str, sender: int, receiver: int) -> str:
        """Return the timing of the delay of a link from one group to another."""
        return self.late.get((link, sender, receiver), self.usual[link])

    def role(self, group: int) -> int:
        """Return the group when some delay is its own, else −1: these groups' delays are the usual ones."""
        named = any(group in (sender, receiver) for _, sender, receiver in self.late)
        return group if named else -1

    def is_complete(self, link: str) -> bool:
        """Say whether everybody hears everybody else."""
        return self.links[link].graph.shape == "complete"

    def arcs(self, link: str) -> tuple[Integers, Floats]:
        """Return the (sender, receiver) pairs (M, 2) and the weights (M,) of a link that is not complete."""
        return arcs(self.links[link].graph, self.peers)

    def hears(self, link: str, receiver: int, sending: Sequence[bool]) -> list[int]:
        """Return the groups that some peer of group `receiver` hears, of those that send."""
        counts = np.diff(self.starts)
        if self.is_complete(link):
            return [h for h, does in enumerate(sending) if does and counts[h] > (1 if h == receiver else 0)]
        pairs, _ = self.arcs(link)
        group_of = np.searchsorted(self.starts, pairs, side="right") - 1
        heard = np.bincount(group_of[group_of[:, 1] == receiver, 0], minlength=len(sending))
        return [h for h, does in enumerate(sending) if does and heard[h]]

    def group_of(self, peer: int) -> int:
        """Return the group of a peer, by its number."""
        return int(np.searchsorted(self.starts, peer, side="right")) - 1

    def peer_name(self, peer: int) -> str:
        """Return `left[2]`, for a peer's number."""
        name = self.groups[self.group_of(peer)]
        return f"{name}[{peer - int(self.starts[self.groups.index(name)]) + 1}]"


def build_exchange(system: Model, timings: Mapping[str, Fraction]) -> CommunicationGraph:
    """Collect the links of a system, delays of equal value as one.

    Parameters
    ----------
    system
        The compiled scene.
    timings
        Seconds by the name of the timing.
    """
    groups = tuple((group.name, group.count) for group in system.groups)
    return _exchange(system.origin.topology, groups, system.links, tuple(timings.items()))


@functools.lru_cache(maxsize=KEPT)
def _exchange(
    scene: str,
    groups: tuple[tuple[str, int], ...],
    links: tuple[Link, ...],
    times: tuple[tuple[str, Fraction], ...],
) -> CommunicationGraph:
    """Return what `build_exchange` does: of scenes that differ in other numbers only, the same object."""
    names, timings = tuple(name for name, _ in groups), dict(times)
    indices: dict[str, list[int]] = {}
    for index, name in enumerate(names):
        indices.setdefault(name, []).append(index)
    late: dict[tuple[str, int, int], str] = {}
    for link in links:
        of_value = {timings[link.delay]: link.delay}
        for pair in link.delays:
            timing = of_value.setdefault(timings[pair.delay], pair.delay)
            if timing != link.delay:
                pairs = itertools.product(indices[pair.sender], indices[pair.receiver])
                late |= {(link.name, sender, receiver): timing for sender, receiver in pairs}
    return CommunicationGraph(
        scene=scene,
        groups=names,
        starts=np.cumsum([0] + [count for _, count in groups], dtype=np.int64),
        links={link.name: link for link in links},
        usual={link.name: link.delay for link in links},
        late=late,
    )


def arcs(graph: Graph, peers: int) -> tuple[Integers, Floats]:
    """Return the (sender, receiver) pairs (M, 2) of a graph and their weights (M,)."""
    everyone = np.arange(peers, dtype=np.int64)
    if graph.shape == "arcs":
        return graph.arcs, graph.weights
    if graph.shape == "ring":
        following = np.roll(everyone, -1)
        one_way = np.stack([everyone, following], axis=1) if peers > 2 else np.array([[0, 1]])[: peers - 1]
    elif graph.shape == "star":
        one_way = np.stack([np.zeros(max(peers - 1, 0), np.int64), everyone[1:]], axis=1)
    else:
        assert graph.shape == "complete", f"no such graph: {graph.shape}"
        one_way = np.stack(np.triu_indices(peers, 1), axis=1)
    pairs = np.concatenate([one_way, one_way[:, ::-1]]).astype(np.int64)
    return pairs, np.ones(len(pairs))


def check_mean(
    exchange: CommunicationGraph, peer: int, link: str, operator: str, hears: bool, total: Fraction
) -> None:
    """Refuse a mean, maximum or minimum over nobody, or a mean whose weights add up to 0.

    Parameters
    ----------
    exchange
        The links.
    peer
        The number of the peer that hears.
    link, operator
        What over which link.
    hears
        Whether it hears anybody.
    total
        The sum of the weights.
    """
    name = exchange.peer_name(peer)
    if not hears:
        what = f"{name} hears nobody over {link}: there is no {operator} over nobody"
        raise ApcError(Diagnostic("E801", SourceLocation(exchange.scene), what))
    if not total:
        what = f"the weights of what {name} hears over {link} add up to 0: there is no mean"
        raise ApcError(Diagnostic("E802", SourceLocation(exchange.scene), what))
