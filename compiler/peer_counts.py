"""How many peers there are, and how many of them each peer hears: what follows from the counts of groups.

Takes: groups, kinds and links of a compiled model.
Gives: `with_heard`, `heard_sums`; `recounted`, `least_peers`, `peers_of`.
Guarantees: a model with other counts is the one that its topology with these counts compiles to.
Does not: change who is in a group of peers that differ, or a graph that names its peers: that is refused.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import (
    LARGEST_COUNT,
    MOST_PLACED,
    PEERS,
    Group,
    Link,
    Model,
    Parameter,
    PeerColumn,
    PeerType,
    count_of,
    group_count,
)
from apc.compiler.errors import Mistakes, SourceLocation
from apc.compiler.source.reading import fault
from apc.compiler.weights import sum_weights

COUNT_ABOUT = "peers heard over the link, counted with their weights"


def with_heard(
    groups: Sequence[Group], kinds: Sequence[PeerType], links: Sequence[Link]
) -> tuple[Group, ...]:
    """Return the groups with how many peers each of them hears over a link, `count(LINK)`.

    It is a parameter of the group, or a column where it differs from peer to peer.

    Parameters
    ----------
    groups, kinds, links
        Of the model; on a graph that isn't complete, every peer sends.
    """
    heard = {count_of(link.name): _heard(link, groups, kinds) for link in links}
    result = []
    for place, group in enumerate(groups):
        values = [value for value in group.values if value.name not in heard]
        columns = [column for column in group.columns if column.name not in heard]
        for name, by_group in heard.items():
            if name in kinds[group.kind].parameters:
                number = by_group[place]
                if isinstance(number, Fraction):
                    values.append(Parameter(name, "1", float(number), about=COUNT_ABOUT, exact=number))
                else:
                    columns.append(PeerColumn(name, number))
        result.append(replace(group, values=tuple(values), columns=tuple(columns)))
    return tuple(result)


def heard_sums(link: Link, peers: int) -> NDArray[Any]:
    """Return what every peer of a scene hears in all over a link of arcs, as `sum_weights` does."""
    return sum_weights(link.graph.arcs[:, 1], link.graph.weights, peers)


def _heard(
    link: Link, groups: Sequence[Group], kinds: Sequence[PeerType]
) -> list[Fraction | NDArray[np.float64]]:
    """Return, by group, the summed weights of what its peers hear over a link: one number if alike."""
    counts = [group.count for group in groups]
    peers, shape = sum(counts), link.graph.shape
    if shape == "complete":
        sends = [any(send.link == link.name for send in kinds[group.kind].sends) for group in groups]
        total = sum(itertools.compress(counts, sends))
        return [Fraction(total - does) for does in sends]
    heard = np.full(peers, min(2, peers - 1) if shape == "ring" else 1, dtype=object)
    if shape == "star":
        heard[0] = peers - 1
    if shape == "arcs":
        heard = heard_sums(link, peers)
    parts = np.split(heard, np.cumsum(counts)[:-1])
    return [Fraction(part[0]) if np.all(part == part[0]) else part.astype(np.float64) for part in parts]


def recounted(system: Model, counts: Mapping[str, Fraction], place: SourceLocation) -> Model:
    """Return a model with other numbers of peers.

    Parameters
    ----------
    system
        The model, in which `peers` and what follows from it have their new values already.
    counts
        The new count of each group.
    place
        Where they were given.

    Raises
    ------
    ApcError
        E626 a count that can't be: no whole number, or of peers that differ or are named by a graph.
    """
    mistakes = Mistakes()
    total = sum(counts.values())
    others = {count_of(link.name): total - 1 for link in system.links}
    arcs = [link.name for link in system.links if link.graph.shape == "arcs"]
    shaped = [link.name for link in system.links if link.graph.shape != "complete"]
    groups = [replace(group, count=int(counts[group.name])) for group in system.groups]
    for group in system.groups:
        count, name = counts[group.name], group_count(group.name)
        own = [column.name for column in group.columns if column.name not in others]
        with mistakes:
            if count == group.count:
                continue
            if count.denominator != 1 or not 1 <= count <= LARGEST_COUNT:
                expected = f"a whole number from 1 to {LARGEST_COUNT:,}"
                raise fault("E626", place, name, expected, f"{float(count):.12g}")
            if own:
                what = f"{own[0]} has one value for each of the {group.count} peers of {group.name}"
                raise fault("E626", place, f"{what}: their count follows from them")
            if arcs:
                what = f"the graph of {arcs[0]} names its peers: {name} is what it is in the topology"
                raise fault("E626", place, what)
            if shaped and total > MOST_PLACED:
                expected = f"at most {MOST_PLACED:,} peers where {shaped[0]} isn't complete"
                raise fault("E626", place, name, expected, f"{int(total):,}")
    if not mistakes and total < least_peers(system.kinds):
        what, expected = "the number of all peers", "at least 2: parts follow the others"
        raise fault("E626", place, what, expected, f"{int(total)}")
    mistakes.raise_if_any()
    return replace(
        system,
        groups=with_heard(groups, system.kinds, system.links),
        parameters=tuple(
            replace(parameter, value=float(others[parameter.name])) if parameter.name in others else parameter
            for parameter in system.parameters
        ),
    )


def least_peers(kinds: Sequence[PeerType]) -> int:
    """Return how many peers a scene must have: two where some part follows the others."""
    hears = any(partition.receives for kind in kinds for partition in kind.clocks)
    return 2 if hears else 1


def peers_of(counts: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Return what the name `peers` stands for with these counts of groups."""
    return {PEERS: sum(counts.values(), Fraction(0))}
