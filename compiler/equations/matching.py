"""Matching of equations to unknowns, unmatched parts, and the resulting order.

Takes: the unknowns of each equation. Gives: `match`.
Guarantees: the same input gives the same matching.
Does not: use the content of an equation or unknown.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence
from typing import Any, TypeVar

import numpy as np
from scipy.sparse import csr_array
from scipy.sparse.csgraph import breadth_first_order, connected_components, maximum_bipartite_matching

Unknown = TypeVar("Unknown")
Block = tuple[list[int], list[Unknown]]  # indices of equations, and their unknowns


def match(
    held: Sequence[Collection[Unknown]], unknowns: Sequence[Unknown]
) -> tuple[list[int], Block[Unknown], Block[Unknown], list[Block[Unknown]]]:
    """Return a maximum matching of equations and unknowns: unmatched parts and strong components.

    The directed graph has an edge from each equation to its unknowns, and from each matched unknown to its
    equation. The part reachable from an unmatched equation is overdetermined, and the part from which an
    unmatched unknown is reachable is underdetermined (Dulmage and Mendelsohn 1958).

    Parameters
    ----------
    held
        The unknowns of each equation.
    unknowns
        All unknowns.

    Returns
    -------
    unmatched
        The indices of the unmatched equations.
    over, under
        The overdetermined equations with their unknowns; the underdetermined unknowns with their equations.
    blocks
        The strong components in order of dependence: SciPy numbers strong components in the order of
        completion in Pearce's algorithm, after all components reachable from them.
    """
    n = len(held)
    node = {unknown: j for j, unknown in enumerate(unknowns, n)}
    edges = [sorted(node[item] for item in equation_unknowns) for equation_unknowns in held]
    incidence = _graph(edges + [[]] * len(node))
    partner = maximum_bipartite_matching(incidence[:n, n:], perm_type="row").tolist()
    graph = _graph(edges + [[i] if i >= 0 else [] for i in partner])

    def split(nodes: Iterable[int]) -> Block[Unknown]:
        """Return the equations and the unknowns among the nodes of the graph."""
        ordered = sorted(nodes)
        return [i for i in ordered if i < n], [unknowns[i - n] for i in ordered if i >= n]

    def reachable(starts: Iterable[int], along: Any) -> Block[Unknown]:
        """Return the equations and unknowns reachable from start nodes in a directed graph."""
        walks = (breadth_first_order(along, start, return_predecessors=False) for start in starts)
        return split({int(item) for walk in walks for item in walk})

    unmatched = sorted({*range(n)}.difference(partner))
    under = reachable([j for j, i in enumerate(partner, n) if i < 0], graph.T.tocsr())
    count, labels = connected_components(graph, connection="strong")
    blocks = [split(np.flatnonzero(labels == label).tolist()) for label in range(count)]
    return unmatched, reachable(unmatched, graph), under, blocks


def _graph(edges: Sequence[Sequence[int]]) -> Any:
    """Return the adjacency matrix of a graph, from the end nodes of the edges of each node."""
    ends = np.cumsum([0, *map(len, edges)])
    locations = np.array(
        [number for equation_unknowns in edges for number in equation_unknowns], dtype=np.int32
    )
    return csr_array((np.ones(len(locations)), locations, ends), shape=(len(edges), len(edges)))
