"""Numbers of peers and of senders to each peer, computed from the counts of groups.

Takes: groups, peer types and links of a compiled model.
Gives: `with_received`, `received_sums`; `recounted`, `least_peers`, `peers_of`.
Guarantees: a model with changed counts equals the compiled topology with these counts.
Does not: change the members of a heterogeneous group, or a graph with named peers: that is refused.
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


def with_received(
    groups: Sequence[Group], peer_types: Sequence[PeerType], links: Sequence[Link]
) -> tuple[Group, ...]:
    """Return the groups with the number of senders to each of their peers over a link, `count(LINK)`.

    It is a parameter of the group, or a column if peers differ.

    Parameters
    ----------
    groups, peer_types, links
        Those of the model; on a graph that isn't complete, every peer sends.
    """
    received = {count_of(link.name): _received(link, groups, peer_types) for link in links}
    result = []
    for index, group in enumerate(groups):
        values = [value for value in group.values if value.name not in received]
        columns = [column for column in group.columns if column.name not in received]
        for name, by_group in received.items():
            if name in peer_types[group.peer_type].parameters:
                number = by_group[index]
                if isinstance(number, Fraction):
                    values.append(Parameter(name, "1", float(number), description=COUNT_ABOUT, exact=number))
                else:
                    columns.append(PeerColumn(name, number))
        result.append(replace(group, values=tuple(values), columns=tuple(columns)))
    return tuple(result)


def received_sums(link: Link, peers: int) -> NDArray[Any]:
    """Return each peer's sum of weights over a link of arcs, as `sum_weights` does."""
    return sum_weights(link.graph.arcs[:, 1], link.graph.weights, peers)


def _received(
    link: Link, groups: Sequence[Group], peer_types: Sequence[PeerType]
) -> list[Fraction | NDArray[np.float64]]:
    """Return, by group, the sum of weights received by its peers over a link: one number if equal."""
    counts = [group.count for group in groups]
    peers, shape = sum(counts), link.graph.shape
    if shape == "complete":
        sends = [
            any(send.link == link.name for send in peer_types[group.peer_type].sends) for group in groups
        ]
        total = sum(itertools.compress(counts, sends))
        return [Fraction(total - does) for does in sends]
    received = np.full(peers, min(2, peers - 1) if shape == "ring" else 1, dtype=object)
    if shape == "star":
        received[0] = peers - 1
    if shape == "arcs":
        received = received_sums(link, peers)
    parts = np.split(received, np.cumsum(counts)[:-1])
    return [Fraction(part[0]) if np.all(part == part[0]) else part.astype(np.float64) for part in parts]


def recounted(system: Model, counts: Mapping[str, Fraction], location: SourceLocation) -> Model:
    """Return a model with other numbers of peers.

    Parameters
    ----------
    system
        The model, in which `peers` and its dependent parameters have their new values.
    counts
        The new count of each group.
    location
        The location of the setting.

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
        local = [column.name for column in group.columns if column.name not in others]
        with mistakes:
            if count == group.count:
                continue
            if count.denominator != 1 or not 1 <= count <= LARGEST_COUNT:
                expected = f"a whole number from 1 to {LARGEST_COUNT:,}"
                raise fault("E626", location, name, expected, f"{float(count):.12g}")
            if local:
                message = f"{local[0]} has one value for each of the {group.count} peers of {group.name}"
                raise fault("E626", location, f"{message}: their count follows from them")
            if arcs:
                message = f"the graph of {arcs[0]} names its peers: {name} is what it is in the topology"
                raise fault("E626", location, message)
            if shaped and total > MOST_PLACED:
                expected = f"at most {MOST_PLACED:,} peers where {shaped[0]} isn't complete"
                raise fault("E626", location, name, expected, f"{int(total):,}")
    if not mistakes and total < least_peers(system.peer_types):
        message, expected = "the number of all peers", "at least 2: parts follow the others"
        raise fault("E626", location, message, expected, f"{int(total)}")
    mistakes.raise_if_any()
    return replace(
        system,
        groups=with_received(groups, system.peer_types, system.links),
        parameters=tuple(
            replace(parameter, value=float(others[parameter.name])) if parameter.name in others else parameter
            for parameter in system.parameters
        ),
    )


def least_peers(peer_types: Sequence[PeerType]) -> int:
    """Return the smallest number of peers of a model: two if a part depends on the others."""
    receives = any(partition.receives for peer_type in peer_types for partition in peer_type.clocks)
    return 2 if receives else 1


def peers_of(counts: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Return the value of the name `peers` for these counts of groups."""
    return {PEERS: sum(counts.values(), Fraction(0))}
