"""Equal peers on any graph, r = W s: one loop an eigenvalue of W.

Takes: a group of equal peers, the graph that all their ways share, an eigenvalue of its W.
Gives: `common_graph`, `GraphScale`, `graph_scale`, `graph_loop`.
Guarantees: exact weights where the eigenvalue is rational; else how far off they may be, and the closed form.
Does not: find the eigenvalues of W (see `graph_modes`).

An eigenvalue λ makes a system of one site, r = λ s, as often as W holds it. A complex pair λ = α ± iβ is one
real system of two sites, r = [α −β; β α] s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from apc.compiler.weights import sum_weights
from apc.eigen.closing import Coupling, ModalSystem
from apc.eigen.graph_modes import GraphMode, Surd
from apc.eigen.peers import PeerClass
from apc.frame.exchange import CommunicationGraph, check_mean
from apc.frame.schedule import CouplingTerm


def common_graph(ways: Sequence[CouplingTerm], exchange: CommunicationGraph) -> str:
    """Return "" if the links' W are one graph, or else why they have not the same eigenvectors."""
    links = list(dict.fromkeys(way.link for way in ways))
    shapes = {exchange.links[link].graph.shape for link in links}
    graphs = [exchange.links[link].graph for link in links]
    if len(shapes) > 1 or any(
        not np.array_equal(graph.arcs, graphs[0].arcs) or not np.array_equal(graph.weights, graphs[0].weights)
        for graph in graphs
    ):
        return f"the graphs of {' and '.join(links)} are not the same"
    if len({way.operator == "mean" for way in ways}) > 1 and _degree(links[0], exchange) is None:
        return f"means and sums over {links[0]}, whose peers hear unequal weights"
    if any(way.operator in ("max", "min") for way in ways):
        return "who is the largest or smallest decides who is heard"
    return ""


def _degree(link: str, exchange: CommunicationGraph) -> Fraction | None:
    """Return the sum of the weights that every peer hears over a link, None when it differs."""
    pairs, weights = exchange.arcs(link)
    sums = sum_weights(pairs[:, 1], weights, exchange.peers)
    return sums[0] if np.all(sums == sums[0]) else None


@dataclass(frozen=True, slots=True)
class GraphScale:
    """What each way weighs a neighbour by, in units of W; `by_mean`: of the W whose rows add up to 1."""

    weights: Mapping[CouplingTerm, Fraction]
    by_mean: bool


def graph_scale(group: PeerClass, ways: Sequence[CouplingTerm], exchange: CommunicationGraph) -> GraphScale:
    """Return how equal peers weigh their neighbours on the graph that all their ways share.

    Raises
    ------
    ApcError
        E801, E802 a mean that can't be.
    """
    link = ways[0].link
    means = any(way.operator == "mean" for way in ways)
    pairs, weights = exchange.arcs(link)
    if means:
        sums = sum_weights(pairs[:, 1], weights, exchange.peers)
        hears = np.bincount(pairs[:, 1], minlength=exchange.peers) > 0
        for peer in np.flatnonzero((sums == 0) | ~hears).tolist():
            check_mean(exchange, peer, link, "mean", bool(hears[peer]), sums[peer])
    degree = _degree(link, exchange)
    return GraphScale(
        {
            way: group.gain(way, group) / (degree if degree and way.operator == "mean" else Fraction(1))
            for way in ways
        },
        means and degree is None,
    )


def graph_loop(group: PeerClass, mode: GraphMode, scale: GraphScale) -> ModalSystem:
    """Let one site hear itself by an eigenvalue, or two by a complex pair."""
    a, b = mode.real, mode.imaginary
    weights = scale.weights
    doubts = {way: float(abs(weight)) * mode.doubt for way, weight in weights.items()}
    # What rounding makes of an eigenvalue 0 is called 0.
    named = 0.0 if abs(mode.value.real) <= mode.doubt else mode.value.real
    name = "common" if mode.common else f"graph {named:+.6g}"
    if not b:
        coupling: Coupling = {way: ((weight * a,),) for way, weight in weights.items()}
        surds: Mapping[CouplingTerm, Surd] = {}
        if mode.doubt and mode.surd:
            surd = mode.surd
            surds = {way: replace(surd, scale=weight * surd.scale) for way, weight in weights.items()}
        return ModalSystem(name, mode.multiplicity, (group,), coupling, doubts, surds)
    pair = {way: ((weight * a, -weight * b), (weight * b, weight * a)) for way, weight in weights.items()}
    sites = tuple(replace(group, name=part) for part in ("real", "imaginary"))
    return ModalSystem(f"{name} ± {mode.value.imag:.6g}i", mode.multiplicity, sites, pair, doubts)
