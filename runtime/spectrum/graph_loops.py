"""Equal peers on any graph, r = W s: one loop for each eigenvalue of W.

Takes: a class of equal peers, the graph common to all their coupling terms, an eigenvalue of its W.
Gives: `reason_without_common_graph`, `GraphScale`, `graph_scale`, `graph_loop`.
Guarantees: exact weights where the eigenvalue is rational; else an error bound, and the closed form.
Does not: compute the eigenvalues of W (see `graph_modes`).

An eigenvalue λ gives a system of one subsystem, r = λ s, with the multiplicity of λ. A complex pair λ = α ±
iβ is one real system of two subsystems, r = [α −β; β α] s.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np

from apc.compiler.weights import sum_weights
from apc.spectrum.graph_modes import GraphMode, Surd
from apc.spectrum.interconnection import Coupling, ModalSystem
from apc.spectrum.peer_classes import PeerClass
from apc.timing.communication_graph import CommunicationGraph, check_mean
from apc.timing.schedule import CouplingTerm


def reason_without_common_graph(
    coupling_terms: Sequence[CouplingTerm], comm_graph: CommunicationGraph
) -> str:
    """Return the reason why the weight matrices of the links have different eigenvectors, "" if they are
    common.
    """
    links = list(dict.fromkeys(coupling_term.link for coupling_term in coupling_terms))
    shapes = {comm_graph.links[link].graph.shape for link in links}
    graphs = [comm_graph.links[link].graph for link in links]
    if len(shapes) > 1 or any(
        not np.array_equal(graph.arcs, graphs[0].arcs) or not np.array_equal(graph.weights, graphs[0].weights)
        for graph in graphs
    ):
        return f"the graphs of {' and '.join(links)} are not the same"
    if (
        len({coupling_term.operator == "mean" for coupling_term in coupling_terms}) > 1
        and _degree(links[0], comm_graph) is None
    ):
        return f"means and sums over {links[0]}, with unequal weights"
    if any(coupling_term.operator in ("max", "min") for coupling_term in coupling_terms):
        return "a maximum or minimum selects the sender"
    return ""


def _degree(link: str, comm_graph: CommunicationGraph) -> Fraction | None:
    """Return the total weight that every peer receives over a link, None if it differs between peers."""
    pairs, weights = comm_graph.arcs(link)
    sums = sum_weights(pairs[:, 1], weights, comm_graph.peers)
    return sums[0] if np.all(sums == sums[0]) else None


@dataclass(frozen=True, slots=True)
class GraphScale:
    """The weight of a neighbour in each coupling term; if `by_mean`, W is scaled to unit row sums."""

    weights: Mapping[CouplingTerm, Fraction]
    by_mean: bool


def graph_scale(
    peer_class: PeerClass, coupling_terms: Sequence[CouplingTerm], comm_graph: CommunicationGraph
) -> GraphScale:
    """Return the weights of equal peers for their neighbours on the graph common to all coupling terms.

    Raises
    ------
    ApcError
        E801, E802 an undefined mean.
    """
    link = coupling_terms[0].link
    means = any(coupling_term.operator == "mean" for coupling_term in coupling_terms)
    pairs, weights = comm_graph.arcs(link)
    if means:
        sums = sum_weights(pairs[:, 1], weights, comm_graph.peers)
        receives = np.bincount(pairs[:, 1], minlength=comm_graph.peers) > 0
        for peer in np.flatnonzero((sums == 0) | ~receives).tolist():
            check_mean(comm_graph, peer, link, "mean", bool(receives[peer]), sums[peer])
    degree = _degree(link, comm_graph)
    return GraphScale(
        {
            coupling_term: peer_class.gain(coupling_term, peer_class)
            / (degree if degree and coupling_term.operator == "mean" else Fraction(1))
            for coupling_term in coupling_terms
        },
        means and degree is None,
    )


def graph_loop(peer_class: PeerClass, mode: GraphMode, scale: GraphScale) -> ModalSystem:
    """Return the loop of an eigenvalue of W: one subsystem with a real weight, or two for a complex pair."""
    a, b = mode.real, mode.imaginary
    weights = scale.weights
    weight_errors = {
        coupling_term: float(abs(weight)) * mode.weight_error for coupling_term, weight in weights.items()
    }
    # A rounded eigenvalue 0 is printed as 0.
    named = 0.0 if abs(mode.value.real) <= mode.weight_error else mode.value.real
    name = "common" if mode.common else f"graph {named:+.6g}"
    if not b:
        coupling: Coupling = {coupling_term: ((weight * a,),) for coupling_term, weight in weights.items()}
        surds: Mapping[CouplingTerm, Surd] = {}
        if mode.weight_error and mode.surd:
            surd = mode.surd
            surds = {
                coupling_term: replace(surd, scale=weight * surd.scale)
                for coupling_term, weight in weights.items()
            }
        return ModalSystem(name, mode.multiplicity, (peer_class,), coupling, weight_errors, surds)
    pair = {
        coupling_term: ((weight * a, -weight * b), (weight * b, weight * a))
        for coupling_term, weight in weights.items()
    }
    peer_classes = tuple(replace(peer_class, name=part) for part in ("real", "imaginary"))
    return ModalSystem(
        f"{name} ± {mode.value.imag:.6g}i", mode.multiplicity, peer_classes, pair, weight_errors
    )
