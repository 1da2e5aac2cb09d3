"""Which equation may be matched to which unknown, what a matching leaves over, and the order it implies.

Takes: which unknowns each equation holds. Gives: `match`.
Guarantees: the same input gives the same matching.
Does not: know what an equation or an unknown is.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_bipartite_matching

Unknown = TypeVar("Unknown")
Block = tuple[list[int], list[Unknown]]  # places of equations, and unknowns they hold


def match(
    held: Sequence[Collection[Unknown]], unknowns: Sequence[Unknown]
) -> tuple[list[int], Block[Unknown], Block[Unknown], list[Block[Unknown]]]:
    """Match equations to as many unknowns as can be.

    In the graph of it an edge goes from each equation to what it holds, and from each matched unknown to its
    equation. What can be reached from an equation that is left over is too much for its unknowns, and from
    where an unknown that is left over can be reached is too little (Dulmage and Mendelsohn 1958).

    Parameters
    ----------
    held
        What each equation holds.
    unknowns
        What there is to be held.

    Returns
    -------
    left_over
        The equations without an unknown of their own.
    over, under
        The equations that are too many, with the unknowns they hold; the unknowns that are too many, with the
        equations that hold them.
    blocks
        What has to be computed together, in an order in which each stands behind what it needs: SciPy numbers
        strong components as Pearce's algorithm ends with them, after all that can be reached from them.
    """
    n = len(held)
    node = {unknown: j for j, unknown in enumerate(unknowns, n)}
    edges = [sorted(node[item] for item in its) for its in held]
    holds = _graph(edges + [[]] * len(node))
    partner = maximum_bipartite_matching(holds[:n, n:], perm_type="row").tolist()
    graph = _graph(edges + [[i] if i >= 0 else [] for i in partner])

    def split(nodes: Iterable[int]) -> Block[Unknown]:
        ordered = sorted(nodes)
        return [i for i in ordered if i < n], [unknowns[i - n] for i in ordered if i >= n]

    def reached(starts: Iterable[int], along: Any) -> Block[Unknown]:
        walks = (breadth_first_order(along, start, return_predecessors=False) for start in starts)
        return split({int(item) for walk in walks for item in walk})

    left_over = sorted({*range(n)}.difference(partner))
    under = reached([j for j, i in enumerate(partner, n) if i < 0], graph.T.tocsr())
    count, labels = connected_components(graph, connection="strong")
    blocks = [split(np.flatnonzero(labels == label).tolist()) for label in range(count)]
    return left_over, reached(left_over, graph), under, blocks


def _graph(edges: Sequence[Sequence[int]]) -> Any:
    """Return the adjacency matrix of a graph, by where the edges of each of its nodes end."""
    ends = np.cumsum([0, *map(len, edges)])
    places = np.array([number for its in edges for number in its], dtype=np.int32)
    return csr_array((np.ones(len(places)), places, ends), shape=(len(edges), len(edges)))
