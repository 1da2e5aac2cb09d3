"""Modal decomposition: a complete system as few and small independent loops.

Takes: the peer classes of a model, and the links between them.
Gives: `split`; `ModalDecomposition`, `decompose`; `accepted_loops`, `orthogonal_loops`; `complete_loops`,
`dense_loop`, `dense`, `refuse_dense`, `split_exchangeable`; `couple`, `complete_degrees`.
Guarantees: the systems of a split, each with its multiplicity, have together the spectrum of `dense`, for any
number of peers. Weights are exact; a mean over no peers, or with weights that sum to 0, raises an error.
Does not: compute eigenvalues (see `spectrum`); find symmetries of different peers other than a permutation of
two.

On a complete graph a peer of class g receives r = c_g (Σ_j s_j − s_own), with c_g = 1/(others) for a mean and
1 for a sum. K groups of n_1 … n_K equal peers then split exactly:

    common        all peers of a class in phase: r_g = c_g Σ_h (n_h − δ_gh) s_h         once
    difference g  peers of class g with sum zero, all others at rest: r_g = −c_g s_g     n_g − 1 times

For equal peers on any other graph see `graph_loops`. Different peers on such a graph are one system, reduced
by interchangeable peers: g and h of equal dynamics whose weights to and from all others are equal. A class c
of n_c interchangeable peers with self-weight w_own and mutual weight w_other splits in two: the common motion
is that of one subsystem that receives w_own + (n_c − 1) w_other times its own packets and n_d W_cd times
those of class d; in the difference modes, with sum zero and all others at rest, each peer receives w_own −
w_other times its own packets, n_c − 1 times.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.weights import exact_weight
from apc.lifting.model_numbers import PeerIndices
from apc.spectrum.graph_loops import graph_loop, graph_scale, reason_without_common_graph
from apc.spectrum.graph_modes import graph_modes
from apc.spectrum.interconnection import ClosedLoop, Coupling, ModalSystem, close_loop
from apc.spectrum.peer_classes import (
    PeerClass,
    group_name,
    incomplete_links,
    states_of,
    too_large,
    used_coupling_terms,
)
from apc.support.not_supported import NotSupportedError
from apc.support.state_limits import MATRIX_STATES
from apc.timing.communication_graph import CommunicationGraph, check_mean
from apc.timing.schedule import CouplingTerm

# The mode family of peers that differ.
COUPLED = "coupled"


@dataclass(frozen=True, slots=True)
class ModalDecomposition:
    """A complete system as independent loops; `method` is "modes" or "dense", `notes` give the reason."""

    method: str
    loops: tuple[ModalSystem, ...]
    notes: tuple[str, ...]


def split(peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph) -> tuple[ClosedLoop, ...]:
    """Return the complete system as the smallest closed loops that its graphs and peer classes allow.

    Parameters
    ----------
    peer_classes
        All peers (see `peer_classes.classes_of_peers`).
    comm_graph
        The links.

    Raises
    ------
    ApcError
        E801, E802 an undefined mean; E804 one system of too many states.
    """
    loops = decompose(peer_classes, comm_graph).loops
    for modal_system in loops:
        if modal_system.states > MATRIX_STATES:
            raise too_large(comm_graph, f"{comm_graph.peers:,} peers", modal_system.states)
    return tuple(close_loop(modal_system) for modal_system in loops)


def decompose(peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph) -> ModalDecomposition:
    """Return the independent loops of a complete system, before their matrices are built (see `split`).

    Parameters
    ----------
    peer_classes, comm_graph
        As for `split`.
    """
    coupling_terms = used_coupling_terms(peer_class.schedule for peer_class in peer_classes)
    graphs = incomplete_links((peer_class.schedule for peer_class in peer_classes), comm_graph)
    if not graphs:
        return ModalDecomposition("modes", complete_loops(peer_classes, comm_graph), ())
    named = " and ".join(f"{link} ({comm_graph.links[link].graph.shape})" for link in graphs)
    reason = (
        f"the peers on {named} differ"
        if len(peer_classes) > 1
        else reason_without_common_graph(coupling_terms, comm_graph)
    )
    if not reason:
        scale = graph_scale(peer_classes[0], coupling_terms, comm_graph)
        modes = graph_modes(comm_graph.links[graphs[0]].graph, comm_graph.peers, mean=scale.by_mean)
        if modes is not None:
            note = f"{len(modes)} subsystems, one for each eigenvalue of the graph of {named}"
            return ModalDecomposition(
                "modes",
                tuple(graph_loop(peer_classes[0], graph_mode, scale) for graph_mode in modes),
                (note,),
            )
        reason = f"the graph of {named} has no full set of eigenvectors"
    parts = split_exchangeable(dense_loop(peer_classes, comm_graph), comm_graph)
    if len(parts) > 1:
        note = f"{len(parts)} subsystems (common and difference motions of interchangeable peers)"
        return ModalDecomposition("modes", parts, (note,))
    return ModalDecomposition("dense", parts, (f"all peers as one system: {reason}",))


def accepted_loops(
    peer_classes: Sequence[PeerClass],
    comm_graph: CommunicationGraph,
    accepted: Callable[[tuple[ModalSystem, ...]], bool],
    subject: str,
) -> tuple[tuple[ModalSystem, ...], bool]:
    """Return the independent loops if they are accepted, else one loop of all peers; and whether they are.

    Parameters
    ----------
    peer_classes, comm_graph
        As for `split`.
    accepted
        Whether a question can be answered from these loops.
    subject
        The question, for messages.

    Raises
    ------
    ApcError
        E933 one loop of too many states.
    """
    decomposed = decompose(peer_classes, comm_graph)
    if decomposed.method == "modes" and accepted(decomposed.loops):
        return decomposed.loops, True
    states = sum(
        peer_class.count * states_of(peer_class.schedule, peer_class.jacobians) for peer_class in peer_classes
    )
    if states > MATRIX_STATES:
        message = f"{subject}: {comm_graph.peers:,} peers on this graph form one system of {states:,} states"
        advice = f"use equal peers on complete graphs, or at most {MATRIX_STATES:,} states in total"
        raise ApcError(Diagnostic("E933", SourceLocation(comm_graph.topology), message, advice=advice))
    return (dense_loop(peer_classes, comm_graph),), False


def orthogonal_loops(
    peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph, most: int
) -> tuple[ModalSystem, ...]:
    """Return a model as orthogonal loops, the common loop first.

    Parameters
    ----------
    peer_classes, comm_graph
        As for `split`.
    most
        The limit of peers on a graph that is not complete.

    Raises
    ------
    NotSupportedError
        More peers on such a graph than the limit.
    """
    graphs = incomplete_links((peer_class.schedule for peer_class in peer_classes), comm_graph)
    if not graphs:
        return complete_loops(peer_classes, comm_graph)
    count = sum(peer_class.count for peer_class in peer_classes)
    if count > most:
        raise NotSupportedError(f"{count:,} peers on a graph that is not complete; the limit is {most}")
    if len(peer_classes) == 1 and all(comm_graph.links[link].graph.shape == "ring" for link in graphs):
        arrangement = decompose(peer_classes, comm_graph)
        if arrangement.method == "modes":
            return arrangement.loops
    return split_exchangeable(dense_loop(peer_classes, comm_graph), comm_graph)


def complete_loops(
    peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph
) -> tuple[ModalSystem, ...]:
    """Return a common loop, and a difference loop for each class of two or more peers, on complete graphs.

    Parameters
    ----------
    peer_classes
        All peers (see `peer_classes.classes_of_peers`).
    comm_graph
        The links, all of them complete.
    """
    degrees = complete_degrees(peer_classes, comm_graph)
    weights = couple(
        peer_classes,
        comm_graph,
        lambda coupling_term, g, h: Fraction(peer_classes[h].count - (1 if g == h else 0)),
        degrees,
    )
    loops = [ModalSystem(_mode_family(peer_classes), 1, tuple(peer_classes), weights)]
    if all(peer_class.count < 2 for peer_class in peer_classes):
        return tuple(loops)
    separation = couple(
        peer_classes, comm_graph, lambda coupling_term, g, h: Fraction(-1 if g == h else 0), degrees
    )
    for index, peer_class in enumerate(peer_classes):
        if peer_class.count < 2:
            continue
        own_weights = {key: ((rows[index][index],),) for key, rows in separation.items()}
        name = "difference" if len(peer_classes) == 1 else f"difference {peer_class.name}"
        loops.append(ModalSystem(name, peer_class.count - 1, (peer_class,), own_weights))
    return tuple(loops)


def dense(peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph) -> ClosedLoop:
    """Return the closed loop of all peers of the system, as a reference; its cost is N³.

    Parameters
    ----------
    peer_classes
        All peers (see `peer_classes.classes_of_peers`).
    comm_graph
        The links.

    Raises
    ------
    ApcError
        E801, E802 an undefined mean; E804 more than `MATRIX_STATES` states.
    """
    refuse_dense(peer_classes, comm_graph)
    return close_loop(dense_loop(peer_classes, comm_graph))


def refuse_dense(peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph) -> None:
    """Raise ApcError E804 for a dense system with too many states, before any peer is evaluated."""
    states = sum(
        peer_class.count * states_of(peer_class.schedule, peer_class.jacobians) for peer_class in peer_classes
    )
    if states > MATRIX_STATES:
        raise too_large(comm_graph, f"{comm_graph.peers:,} peers", states)


def dense_loop(peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph) -> ModalSystem:
    """Return all peers of the system as one loop, one subsystem per peer."""
    all_peers = tuple(
        replace(
            peer_class, name=comm_graph.peer_name(peer), count=1, peers=PeerIndices((range(peer, peer + 1),))
        )
        for peer, peer_class in sorted(
            ((peer, peer_class) for peer_class in peer_classes for peer in peer_class.peers),
            key=lambda pair: pair[0],
        )
    )
    weights = {
        link: {
            (receiver, sender): exact_weight(weight)
            for (sender, receiver), weight in zip(
                *(arc.tolist() for arc in comm_graph.arcs(link)), strict=True
            )
        }
        for link in comm_graph.links
    }
    degrees: dict[tuple[str, int], Fraction] = {}
    for link, entries in weights.items():
        for (receiver, sender), weight in entries.items():
            if all_peers[sender].sends(link):
                degrees[link, receiver] = degrees.get((link, receiver), Fraction(0)) + weight
    coupling = couple(
        all_peers,
        comm_graph,
        lambda coupling_term, g, h: weights[coupling_term.link].get((g, h), Fraction(0)),
        degrees,
    )
    return ModalSystem(COUPLED, 1, all_peers, coupling)


def _mode_family(peer_classes: Sequence[PeerClass]) -> str:
    """Return the mode family: "single" for one peer, "common" for equal peers, "coupled" for
    different peers.
    """
    return COUPLED if len(peer_classes) > 1 else "common" if peer_classes[0].count > 1 else "single"


def split_exchangeable(modal_system: ModalSystem, comm_graph: CommunicationGraph) -> tuple[ModalSystem, ...]:
    """Return a loop split by its interchangeable peers.

    Parameters
    ----------
    modal_system
        A loop of all peers, one per subsystem, with exact weights; without interchangeable peers it is
        returned unchanged.
    comm_graph
        The links, for the names of the groups.
    """
    classes: list[list[int]] = []
    for index in range(len(modal_system.peer_classes)):
        interchangeable = (
            members for members in classes if _are_exchangeable(modal_system, members[0], index)
        )
        matching_class = next(interchangeable, None)
        if matching_class is None:
            classes.append([index])
        else:
            matching_class.append(index)
    if modal_system.weight_errors or len(classes) == len(modal_system.peer_classes):
        return (modal_system,)
    peer_classes = tuple(
        _merged_class([modal_system.peer_classes[index] for index in members], comm_graph)
        for members in classes
    )
    coupling = {
        coupling_term: tuple(
            tuple(_class_weight(modal_system, coupling_term, members, others) for others in classes)
            for members in classes
        )
        for coupling_term in modal_system.coupling
    }
    loops = [
        replace(modal_system, name=_mode_family(peer_classes), peer_classes=peer_classes, coupling=coupling)
    ]
    for peer_class, members in zip(peer_classes, classes, strict=True):
        if len(members) > 1:
            first, second = members[:2]
            separation = {
                coupling_term: ((rows[first][first] - rows[first][second],),)
                for coupling_term, rows in modal_system.coupling.items()
            }
            multiplicity = modal_system.multiplicity * (len(members) - 1)
            loops.append(
                ModalSystem(f"difference {peer_class.name}", multiplicity, (peer_class,), separation)
            )
    return tuple(loops)


def _are_exchangeable(modal_system: ModalSystem, g: int, h: int) -> bool:
    """Return whether an exchange of the subsystems g and h leaves the loop unchanged."""
    peer_class, other = modal_system.peer_classes[g], modal_system.peer_classes[h]
    if peer_class.index != other.index:
        return False
    remaining = [index for index in range(len(modal_system.peer_classes)) if index not in (g, h)]
    return all(
        rows[g][g] == rows[h][h]
        and rows[g][h] == rows[h][g]
        and all(rows[g][k] == rows[h][k] and rows[k][g] == rows[k][h] for k in remaining)
        for rows in modal_system.coupling.values()
    )


def _class_weight(
    modal_system: ModalSystem, coupling_term: CouplingTerm, receivers: Sequence[int], senders: Sequence[int]
) -> Fraction:
    """Return the sum of the weights with which a subsystem receives all subsystems of a class.

    `receivers` and `senders` are the indices of the subsystems of two classes; all receivers of a class have
    the same sum.
    """
    row = modal_system.coupling[coupling_term][receivers[0]]
    return sum((row[index] for index in senders), Fraction(0))


def _merged_class(peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph) -> PeerClass:
    """Return equal peer classes as one."""
    peers = PeerIndices(tuple(run for peer_class in peer_classes for run in peer_class.peers.runs))
    return replace(peer_classes[0], name=group_name(peers, comm_graph), count=len(peers), peers=peers)


def couple(
    peer_classes: Sequence[PeerClass],
    comm_graph: CommunicationGraph,
    weigh: Callable[[CouplingTerm, int, int], Fraction],
    degrees: Mapping[tuple[str, int], Fraction],
) -> Coupling:
    """Return the coupling weights between subsystems, for each coupling term.

    Parameters
    ----------
    peer_classes
        The subsystems.
    comm_graph
        The links.
    weigh
        Returns the weight of a packet of subsystem h at subsystem g in a plain sum.
    degrees
        The divisors of a mean, by link and subsystem, without entries for peers that receive nothing.
    """
    coupling = {}
    for coupling_term in used_coupling_terms(peer_class.schedule for peer_class in peer_classes):
        rows = []
        for g, peer_class in enumerate(peer_classes):
            receives = any(
                received.coupling_term == coupling_term for received in peer_class.schedule.received
            )
            if receives and coupling_term.operator == "mean":
                total = degrees.get((coupling_term.link, g))
                check_mean(
                    comm_graph,
                    peer_class.peers.first,
                    coupling_term.link,
                    "mean",
                    total is not None,
                    total or Fraction(0),
                )
            row = []
            for h, sender in enumerate(peer_classes):
                weight = (
                    weigh(coupling_term, g, h)
                    if receives and sender.sends(coupling_term.link)
                    else Fraction(0)
                )
                if (
                    weight
                    and comm_graph.delay(coupling_term.link, sender.delay_class, peer_class.delay_class)
                    == coupling_term.delay
                ):
                    if coupling_term.operator == "mean":
                        weight /= degrees[coupling_term.link, g]
                    elif coupling_term.operator in ("max", "min"):  # the one that is split off counts once
                        weight = Fraction(1 if weight > 0 else -1)
                    row.append(
                        weight * peer_class.gain(coupling_term, sender) if coupling_term.edge else weight
                    )
                else:
                    row.append(Fraction(0))
            rows.append(tuple(row))
        coupling[coupling_term] = tuple(rows)
    return coupling


def complete_degrees(
    peer_classes: Sequence[PeerClass], comm_graph: CommunicationGraph
) -> dict[tuple[str, int], Fraction]:
    """Return the number of other peers from which a peer of each class receives, for each complete link."""
    degrees = {}
    for link in comm_graph.links:
        total = sum(peer_class.count for peer_class in peer_classes if peer_class.sends(link))
        for g, peer_class in enumerate(peer_classes):
            number = total - (1 if peer_class.sends(link) else 0)
            if number:
                degrees[link, g] = Fraction(number)
    return degrees
