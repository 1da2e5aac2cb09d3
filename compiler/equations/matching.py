"""Which row may be matched to which column: matchings, what they leave over, and the order they imply.

Takes: the incidence of a sparse square system, and graphs, as lists of integers.
Gives: `match_columns`, `alternating`, `strong_components`.
Guarantees: the same input gives the same matching.
Does not: know what a row or a column stands for.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import connected_components, maximum_bipartite_matching


def _graph(rows: Sequence[Iterable[int]], columns: int) -> csr_array:
    """Return a sparse matrix with ones where a row lists a column."""
    lists = [list(row) for row in rows]
    ends = np.cumsum([0, *map(len, lists)])
    places = np.array([column for row in lists for column in row], dtype=np.int32)
    return csr_array((np.ones(len(places)), places, ends), shape=(len(lists), columns))


def match_columns(incidence: Sequence[Sequence[int]], columns: int) -> list[int | None]:
    """Return for each column the row matched to it, or None; as many as can be matched.

    Parameters
    ----------
    incidence
        For each row, the columns it may be matched to.
    columns
        The number of columns.
    """
    if not incidence or not columns:
        return [None] * columns
    matched = maximum_bipartite_matching(_graph(incidence, columns), perm_type="row")
    return [int(row) if row >= 0 else None for row in matched]


def alternating(
    starts: Iterable[int], neighbours: Sequence[Iterable[int]], partner: Mapping[int, int]
) -> tuple[list[int], list[int]]:
    """Return what alternating paths reach from nodes of one side, on that side and on the other.

    From the rows that a largest matching leaves over these are the equations that are too many, and their
    unknowns, and from the columns the other way round (Dulmage and Mendelsohn 1958).

    Parameters
    ----------
    starts
        Nodes without a partner.
    neighbours
        For each node of this side those of the other.
    partner
        For each node of the other side its own on this side.
    """
    near, far = dict.fromkeys(starts), dict.fromkeys(range(0))
    queue = list(near)
    for node in queue:
        for other in neighbours[node]:
            far[other] = None
            if (following := partner.get(other)) is not None and following not in near:
                near[following] = None
                queue.append(following)
    return sorted(near), sorted(far)


def strong_components(needs: Sequence[Iterable[int]]) -> list[list[int]]:
    """Return the strongly connected components of a graph, each after all it needs.

    SciPy numbers them as Pearce's algorithm ends with them, which is after all that can be reached from them.
    """
    count, labels = connected_components(_graph(needs, len(needs)), connection="strong")
    found: list[list[int]] = [[] for _ in range(count)]
    for node, label in enumerate(labels):
        found[label].append(node)
    return found
