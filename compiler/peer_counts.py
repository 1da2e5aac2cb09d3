"""Numbers of peers and of senders to each peer, computed from the counts of groups.

Takes: groups, peer types, links and counts of a compiled model.
Gives: `with_received`, `received_sums`, `refuse_equal_sums`; `graph_of_groups`; `clocks_in_use`; `recounted`,
`least_peers`, `peers_of`.
Guarantees: a model with changed counts equals the compiled topology with these counts.
Does not: change the count of a group with different peers, or of peers named by a graph: E626.
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
    MOST_GROUP_ARCS,
    MOST_PLACED,
    PEERS,
    Graph,
    Group,
    GroupArc,
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
from apc.compiler.weights import arcs, arcs_of_groups, sum_weights

COUNT_ABOUT = "peers received over the link, counted with their weights"


def with_received(
    groups: Sequence[Group], peer_types: Sequence[PeerType], links: Sequence[Link]
) -> tuple[Group, ...]:
    """Return the groups with `count(LINK)`, the sum of the weights of each peer's senders over a link.

    Without weights it is the number of senders. It is a parameter of the group, or a column if it differs
    between the peers of the group; peer types that do not use it have none.

    Parameters
    ----------
    groups, peer_types, links
        The groups, peer types and links of the model; on a graph that isn't complete, every peer sends.
    """
    sums_by_link = {count_of(link.name): _received(link, groups, peer_types) for link in links}
    new_groups = []
    for index, group in enumerate(groups):
        values = [value for value in group.values if value.name not in sums_by_link]
        columns = [column for column in group.columns if column.name not in sums_by_link]
        for name, sums in sums_by_link.items():
            if name in peer_types[group.peer_type].parameters:
                weight_sum = sums[index]
                if isinstance(weight_sum, Fraction):
                    values.append(
                        Parameter(name, "1", float(weight_sum), description=COUNT_ABOUT, exact=weight_sum)
                    )
                else:
                    columns.append(PeerColumn(name, weight_sum))
        new_groups.append(replace(group, values=tuple(values), columns=tuple(columns)))
    return tuple(new_groups)


def received_sums(link: Link, peers: int) -> NDArray[Any]:
    """Return the exact sum of the weights of each peer's incoming arcs over a link with arcs (N,)."""
    return sum_weights(link.graph.arcs[:, 1], link.graph.weights, peers)


def refuse_equal_sums(
    peer_types: Sequence[PeerType], links: Sequence[Link], peers: int, locations: Mapping[str, SourceLocation]
) -> None:
    """Raise E217 if different sums of weights that peers receive over a link are equal in floats.

    Parameters
    ----------
    peer_types, links, peers
        The peer types, the links and the number of peers of the model.
    locations
        The location of each link, or of the setting of a count.
    """
    used = {name for peer_type in peer_types for name in peer_type.parameters}
    for link in links:
        if count_of(link.name) in used and link.graph.shape == "arcs":
            values = set(received_sums(link, peers).tolist())
            if len(set(map(float, values))) < len(values):
                message = f"two sums of weights over {link.name} differ by less than rounding"
                raise fault("E217", locations[link.name], message, advice="use weights of at most 15 digits")


def graph_of_groups(
    entries: Sequence[GroupArc], counts: Mapping[str, int], location: SourceLocation, code: str
) -> Graph:
    """Return the graph of arcs between groups.

    Parameters
    ----------
    entries, counts
        As for `arcs_of_groups`.
    location, code
        The location of the graph or of the setting of a count, and the code of the error for too many arcs.
    """
    total = sum(counts[sender] * counts[receiver] for sender, receiver, _ in entries)
    if total > MOST_GROUP_ARCS:
        expected = f"at most {MOST_GROUP_ARCS:,} arcs"
        raise fault(code, location, "graph", expected, f"{total:,}", advice="use graph: complete")
    return Graph("arcs", *arcs_of_groups(entries, counts), tuple(entries))


def clocks_in_use(model: Model) -> frozenset[str]:
    """Return the clocks of all peer types, and those whose ticks send packets from some group to another."""
    used = {part.clock for peer_type in model.peer_types for part in peer_type.clocks}
    names = [group.name for group in model.groups]
    owner = np.repeat(np.arange(len(names)), [group.count for group in model.groups])
    for link in model.links:
        if len(link.clocks) == 1:
            used.add(link.clock)
            continue
        own = {(pair.sender, pair.receiver): pair.clock for pair in link.pairs}
        several = [(g, g) for g, group in enumerate(model.groups) if group.count > 1]
        pairs = {*itertools.permutations(range(len(names)), 2), *several}
        if link.graph.shape != "complete":
            pairs = {*map(tuple, owner[arcs(link.graph, len(owner))[0]].tolist())}
        used |= {own.get((names[sender], names[receiver])) or link.clock for sender, receiver in pairs}
    return frozenset(used)


def _received(
    link: Link, groups: Sequence[Group], peer_types: Sequence[PeerType]
) -> list[Fraction | NDArray[np.float64]]:
    """Return the sums of weights received by the peers of each group over a link.

    A sum is one number if it is the same for all peers of a group, else an array (count,).
    """
    counts = [group.count for group in groups]
    peers, shape = sum(counts), link.graph.shape
    if shape == "complete":
        sends = [
            any(send.link == link.name for send in peer_types[group.peer_type].sends) for group in groups
        ]
        total = sum(itertools.compress(counts, sends))
        return [Fraction(total - is_sender) for is_sender in sends]
    received = np.full(peers, min(2, peers - 1) if shape == "ring" else 1, dtype=object)
    if shape == "star":
        received[0] = peers - 1
    if shape == "arcs":
        received = received_sums(link, peers)
    parts = np.split(received, np.cumsum(counts)[:-1])
    return [Fraction(part[0]) if np.all(part == part[0]) else part.astype(np.float64) for part in parts]


def recounted(model: Model, counts: Mapping[str, Fraction], location: SourceLocation) -> Model:
    """Return a model with other numbers of peers.

    Parameters
    ----------
    model
        The model, in which `peers` and its dependent parameters have their new values.
    counts
        The new count of each group.
    location
        The location of the setting.

    Raises
    ------
    ApcError
        E626 an invalid count: not a whole number, or of peers that differ or are named by a graph.
    """
    mistakes = Mistakes()
    total = sum(counts.values())
    others = {count_of(link.name): total - 1 for link in model.links}
    arcs = [link.name for link in model.links if link.graph.shape == "arcs" and not link.graph.groups]
    shaped = [link.name for link in model.links if link.graph.shape != "complete"]
    groups = [replace(group, count=int(counts[group.name])) for group in model.groups]
    for group in model.groups:
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
                raise fault("E626", location, f"{message}; the count can't be changed")
            if arcs:
                message = f"the graph of {arcs[0]} lists peers by number; {name} can't be changed"
                advice = f"name the groups in the graph, as in [{group.name}, {group.name}]"
                raise fault("E626", location, message, advice=advice)
            if shaped and total > MOST_PLACED:
                expected = f"at most {MOST_PLACED:,} peers where {shaped[0]} isn't complete"
                raise fault("E626", location, name, expected, f"{int(total):,}")
    if not mistakes and total < least_peers(model.peer_types):
        message, expected = "total number of peers", "at least 2, as a part receives from the other peers"
        raise fault("E626", location, message, expected, f"{int(total)}")
    mistakes.raise_if_any()
    group_counts = {group.name: group.count for group in groups}
    links = tuple(
        replace(link, graph=graph_of_groups(link.graph.groups, group_counts, location, "E626"))
        if link.graph.groups
        else link
        for link in model.links
    )
    locations = dict.fromkeys((link.name for link in links), location)
    refuse_equal_sums(model.peer_types, links, int(total), locations)
    return replace(
        model,
        links=links,
        groups=with_received(groups, model.peer_types, links),
        parameters=tuple(
            replace(parameter, value=float(others[parameter.name])) if parameter.name in others else parameter
            for parameter in model.parameters
        ),
    )


def least_peers(peer_types: Sequence[PeerType]) -> int:
    """Return the smallest number of peers of a model: two if a part receives from other peers, else one."""
    receives = any(partition.receives for peer_type in peer_types for partition in peer_type.clocks)
    return 2 if receives else 1


def peers_of(counts: Mapping[str, Fraction]) -> dict[str, Fraction]:
    """Return the value of the name `peers` for counts of groups."""
    return {PEERS: sum(counts.values(), Fraction(0))}
