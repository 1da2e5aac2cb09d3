"""Populations by a small determinant: different peers on a complete graph, or delays of any length.

Takes: populations of different peers on complete graphs; or a few coupled subsystems.
Gives: `TransferMember`; `population_characteristic`, `loop_characteristic`.
Guarantees: the size of the determinant is the number of values sent in a frame by one peer of each delay
class, or by the few subsystems. It is independent of the number of peers and of delays.
Does not: find its zeros (see `zeros`).

A peer on a complete graph receives r_i = c_i L(ζ) (σ − s_i), with σ the sum of all sent values and L the
delays. With the feedback of weight −c_i from itself it is a subsystem T_i, s_i = T_i L σ, and det(I − Σ_i T_i
L) = 0. Subsystems with coupling weights, r_g = Σ_h W_gh ζ^(−lag) s_h, are det(I − T W) = 0, T = diag(T_g): no
state for a packet.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.linearization.linear_subsystem import LinearSubsystem
from apc.spectrum.characteristic import Characteristic, characteristic_of
from apc.spectrum.heterogeneous_peers import HeterogeneousGroup, close_self_feedback
from apc.spectrum.interconnection import Coupling, bounded_weight
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.transfer import TransferSubsystems, transfer_of
from apc.timing.communication_graph import CommunicationGraph, check_mean
from apc.timing.schedule import CouplingTerm, ReceivedSample, Schedule, SentSample

Floats = NDArray[np.float64]


@dataclass(frozen=True, slots=True, eq=False)
class TransferMember:
    """The peers of a population, or one subsystem of a loop, with r = `own_weights` s + `other_weights` τ.

    `subsystems` have maps without self-feedback; s are a peer's own sent values, τ the sums of all sent
    values for each entry of r, own packets included. `total_weights` are the total weights of the other
    peers. `subsystem` returns the matrices of one peer.
    """

    name: str
    schedule: Schedule
    z_names: tuple[str, ...]
    subsystems: TransferSubsystems
    own_weights: Floats  # (n_r,)
    other_weights: Floats
    total_weights: Floats
    subsystem: Callable[[int], LinearSubsystem]


def _weights(
    population: HeterogeneousGroup, populations: Sequence[HeterogeneousGroup], comm_graph: CommunicationGraph
) -> tuple[Floats, Floats]:
    """Return the weight of another peer's packet for each entry of r on a complete graph, and the number of
    senders.

    Raises
    ------
    ApcError
        E801 a mean over no peers.
    """
    weights, senders = np.ones((2, len(population.schedule.received)))
    for input_row, received in enumerate(population.schedule.received):
        link = received.coupling_term.link
        senders[input_row] = sum(sender.counts.sum() for sender in populations if sender.sends(link))
        senders[input_row] -= population.sends(link)
        if received.coupling_term.operator == "mean":
            first, others = int(comm_graph.starts[population.group]), float(senders[input_row])
            check_mean(comm_graph, first, link, "mean", others > 0, Fraction(others))
            weights[input_row] = 1.0 / others
    return weights, senders


def population_characteristic(
    populations: Sequence[HeterogeneousGroup], comm_graph: CommunicationGraph
) -> tuple[Characteristic, tuple[TransferMember, ...]]:
    """Return the characteristic function of different peers on complete graphs.

    Parameters
    ----------
    populations
        All peers.
    comm_graph
        The links, all of them complete.
    """
    delay_classes = [comm_graph.delay_class(population.group) for population in populations]
    sent_index: dict[tuple[int, SentSample], int] = {}
    received_index: dict[tuple[int, ReceivedSample], int] = {}
    group_of: dict[int, int] = {}
    for delay_class, population in zip(delay_classes, populations, strict=True):
        group_of.setdefault(delay_class, population.group)
        for sent in population.schedule.sent:
            sent_index.setdefault((delay_class, sent), len(sent_index))
        for received in population.schedule.received:
            received_index.setdefault((delay_class, received), len(received_index))

    def has_delay(coupling_term: CouplingTerm, sender: int, receiver: int) -> bool:
        """Return whether a coupling term has the delay of a pair of delay classes."""
        return (
            comm_graph.delay(coupling_term.link, group_of[sender], group_of[receiver]) == coupling_term.delay
        )

    members, subsystems = [], []
    for delay_class, population in zip(delay_classes, populations, strict=True):
        schedule = population.schedule
        weight, senders = _weights(population, populations, comm_graph)
        rows = np.array([sent_index[delay_class, sent] for sent in schedule.sent], np.int64)
        input_rows = np.array(
            [received_index[delay_class, received] for received in schedule.received], np.int64
        )
        own_weights = -weight * np.array(
            [
                float(has_delay(received.coupling_term, delay_class, delay_class))
                for received in schedule.received
            ]
        )
        uncoupled = TransferSubsystems(population.maps, population.counts, rows, input_rows)
        names = (*(state.name for state in population.jacobians.peer_type.states), *schedule.value_names)
        members.append(
            TransferMember(
                *(
                    population.name,
                    schedule,
                    names,
                    uncoupled,
                    own_weights,
                    weight,
                    weight * senders,
                    population.subsystem,
                ),
            )
        )
        subsystems.append(
            replace(uncoupled, maps=close_self_feedback(population.maps, schedule, own_weights, weight))
        )
    lags = sorted({received.lag for _, received in received_index})
    weights = np.zeros((len(lags), len(received_index), len(sent_index)))
    for (receiver, received), line in received_index.items():
        for (sender, sent), row in sent_index.items():
            if sent == received.sent and has_delay(received.coupling_term, sender, receiver):
                weights[lags.index(received.lag), line, row] = 1.0
    transfer = transfer_of(subsystems, len(sent_index), len(received_index))
    return characteristic_of(transfer, lags, weights, np.zeros_like(weights)), tuple(members)


def loop_characteristic(
    peer_classes: Sequence[PeerClass], coupling: Coupling, weight_errors: Mapping[CouplingTerm, float]
) -> tuple[Characteristic, tuple[TransferMember, ...]]:
    """Return the characteristic function of a few coupled subsystems, with delays of any length.

    Parameters
    ----------
    peer_classes
        The K subsystems.
    coupling
        The coupling weights W (K, K) by coupling term.
    weight_errors
        The error bound of each entry of W, if not exact.
    """
    n_s = n_r = 0
    members = []
    for peer_class in peer_classes:
        schedule, maps = peer_class.schedule, peer_class.lifted.mapped(lambda block: block[None])
        rows, lines = np.arange(n_s, n_s + len(schedule.sent)), np.arange(n_r, n_r + len(schedule.received))
        n_s, n_r = n_s + len(rows), n_r + len(lines)
        subsystems, unit = TransferSubsystems(maps, np.ones(1), rows, lines), np.ones(len(lines))
        members.append(
            TransferMember(
                *(peer_class.name, schedule, peer_class.z_names, subsystems, 0 * unit, unit, unit),
                subsystem=partial(_subsystem_of, peer_class),
            )
        )
    transfer = transfer_of([member.subsystems for member in members], n_s, n_r)
    return characteristic_of(transfer, *_feedback_weights(peer_classes, coupling, weight_errors)), tuple(
        members
    )


def _subsystem_of(peer_class: PeerClass, _: int) -> LinearSubsystem:
    """Return the subsystem of a class of peers; its index is not used."""
    return peer_class.subsystem


def _feedback_weights(
    peer_classes: Sequence[PeerClass], coupling: Coupling, weight_errors: Mapping[CouplingTerm, float]
) -> tuple[tuple[int, ...], Floats, Floats]:
    """Return the feedback from sent to received values of a loop's subsystems, r = Σ_l W_l ζ^(−l) s.

    Parameters
    ----------
    peer_classes
        The K subsystems.
    coupling
        The coupling weights W (K, K) by coupling term.
    weight_errors
        The error bound of each entry of W, if not exact.

    Returns
    -------
    The lags l, the weights W_l (l, n_r, n_s), and their error bounds.
    """
    sent_starts = np.cumsum([0, *(len(peer_class.schedule.sent) for peer_class in peer_classes)])
    reception_starts = np.cumsum([0, *(len(peer_class.schedule.received) for peer_class in peer_classes)])
    lags = sorted({received.lag for peer_class in peer_classes for received in peer_class.schedule.received})
    weights = np.zeros((2, len(lags), int(reception_starts[-1]), int(sent_starts[-1])))
    for g, peer_class in enumerate(peer_classes):
        for input_row, received in enumerate(peer_class.schedule.received):
            for h, sender in enumerate(peer_classes):
                if received.sent in sender.schedule.sent:
                    row = sent_starts[h] + sender.schedule.sent.index(received.sent)
                    pair = bounded_weight(
                        coupling[received.coupling_term][g][h], weight_errors.get(received.coupling_term, 0.0)
                    )
                    weights[:, lags.index(received.lag), reception_starts[g] + input_row, row] = pair
    return tuple(lags), *weights
