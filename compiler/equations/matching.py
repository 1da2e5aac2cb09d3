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

Incidence = Sequence[Sequence[int]]  # for each row, its columns


def _graph(rows: Incidence, columns: int) -> csr_array:
    ends = np.cumsum([0, *map(len, rows)])
    places = np.array([column for row in rows for column in row], dtype=np.int32)
    return csr_array((np.ones(len(places)), places, ends), shape=(len(rows), columns))


def match_columns(incidence: Incidence, columns: int) -> dict[int, int]:
    """Return the rows of the columns that are matched, as many as can be."""
    if not incidence or not columns:
        return {}
    matched = maximum_bipartite_matching(_graph(incidence, columns), perm_type="row")
    return {column: row for column, row in enumerate(matched.tolist()) if row >= 0}


def alternating(
    starts: Iterable[int], neighbours: Incidence, partner: Mapping[int, int]
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
        The matched nodes of the other side, with their nodes on this side.
    """
    near, far = dict.fromkeys(starts), set[int]()
    queue = list(near)
    for node in queue:
        far.update(neighbours[node])
        new = [partner[one] for one in neighbours[node] if partner.get(one, node) not in near]
        near |= dict.fromkeys(new)
        queue += dict.fromkeys(new)
    return sorted(near), sorted(far)


def strong_components(needs: Incidence) -> list[list[int]]:
    """Return the strongly connected components of a graph, each after all it needs.

    SciPy numbers them as Pearce's algorithm ends with them, which is after all that can be reached from them.
    """
    count, labels = connected_components(_graph(needs, len(needs)), connection="strong")
    found: list[list[int]] = [[] for _ in range(count)]
    for node, label in enumerate(labels):
        found[label].append(node)
    return found
