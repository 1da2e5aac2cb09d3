"""Arcs of a graph and exact weights: the decimals of the file, and each peer's sum of weights.

Takes: a `Graph`; weights as floats, each representing its shortest decimal.
Gives: `arcs` of a graph, `arcs_of_groups`; `exact_weight`, `sum_weights`.
Guarantees: sums are exact, so that 0.1 and 0.2 are 0.3, and 0.1, 0.2 and −0.3 are zero.
Does not: read graphs (see `topology.graphs`).

Neutral modes are determined by exact equality. For the weights 0.1 and 0.2 of a peer's neighbors, a rounded
sum as its own weight would act as a spring to ground.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Mapping, Sequence
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Graph, GroupArc


def arcs(graph: Graph, peers: int) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the (sender, receiver) pairs (M, 2) of a graph and their weights (M,)."""
    peer_numbers = np.arange(peers, dtype=np.int64)
    if graph.shape == "arcs":
        return graph.arcs, graph.weights
    if graph.shape == "ring":
        next_peers = np.roll(peer_numbers, -1)
        one_direction = (
            np.stack([peer_numbers, next_peers], axis=1) if peers > 2 else np.array([[0, 1]])[: peers - 1]
        )
    elif graph.shape == "star":
        one_direction = np.stack([np.zeros(max(peers - 1, 0), np.int64), peer_numbers[1:]], axis=1)
    else:
        assert graph.shape == "complete", f"no such graph: {graph.shape}"
        one_direction = np.stack(np.triu_indices(peers, 1), axis=1)
    pairs = np.concatenate([one_direction, one_direction[:, ::-1]]).astype(np.int64)
    return pairs, np.ones(len(pairs))


def arcs_of_groups(
    entries: Sequence[GroupArc], counts: Mapping[str, int]
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Return the (sender, receiver) pairs (M, 2) between groups, and their weights (M,).

    Parameters
    ----------
    entries
        The sender, receiver and weight of the arcs between groups. A group is connected to itself between its
        different peers.
    counts
        The number of peers of each group, in order.
    """
    starts = dict(zip(counts, itertools.accumulate(counts.values(), initial=0), strict=False))
    pairs, weights = [np.zeros((0, 2), np.int64)], [np.zeros(0)]
    for sender, receiver, weight in entries:
        ends = [np.arange(starts[name], starts[name] + counts[name]) for name in (sender, receiver)]
        block = np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 2)
        pairs.append(block[block[:, 0] != block[:, 1]])
        weights.append(np.full(len(pairs[-1]), weight))
    return np.concatenate(pairs), np.concatenate(weights)


def exact_weight(weight: float) -> Fraction:
    """Return the shortest decimal that represents a float, as an exact number."""
    return Fraction(repr(float(weight)))


def sum_weights(receivers: NDArray[np.int64], weights: NDArray[np.float64], peers: int) -> NDArray[Any]:
    """Return the exact sum of the weights of each peer's incoming arcs (N,), as `Fraction`.

    Parameters
    ----------
    receivers, weights
        The receiver (M,), zero-based, and the weight (M,) of each arc.
    peers
        The number of peers.
    """
    distinct, index = np.unique(weights, return_inverse=True)
    exact = [exact_weight(weight) for weight in distinct.tolist()]
    denominator = math.lcm(*(weight.denominator for weight in exact))
    integers = np.array([int(weight * denominator) for weight in exact], dtype=object)
    totals = np.zeros(peers, dtype=object)
    np.add.at(totals, receivers, integers[index])
    rational = functools.cache(lambda total: Fraction(total, denominator))
    return np.array([rational(total) for total in totals], dtype=object)
