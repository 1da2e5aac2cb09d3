"""Second moments if a receiver substitutes its own value for a missing one.

Takes: a model whose packets are due at the same instant of each frame, with independent losses.
Gives: `self_substitution`; `Receiver`, `receivers_of`.
Guarantees: the cost is independent of the number of equal peers.
Does not: support bursts (see `gilbert_elliott`), jitter, or several unreliable links.

A peer that receives from a_g of the n_g others of class g substitutes its own value for the n_g − a_g missing
ones, tick by tick. Its dynamics depend on the number of received packets, not on the senders:

    x_j⁺ = P(a) x_j + Σ_g K_g(a) Σ_(i received of g) x_i

The losses of different peers are independent. So cross moments of different peers are those of the means, and
each peer's own moments have an additional term Ω, linear in all moments. As P and K are polynomials in a, the
mean over a is a Gauss quadrature of the binomial distribution, exact with one node per two degrees.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, with_error_radius
from apc.lifting.taylor_models import entrywise
from apc.mean_square.class_moments import (
    MomentCoordinates,
    Moments,
    PeerVersusRest,
    PerTickReception,
    classes_of,
    local_value,
    stored_of,
)
from apc.mean_square.mean_dynamics import MeanSubsystem, RouteMemory, with_memory, with_stored_values
from apc.mean_square.second_moment_operator import MomentBlock, Operator, rounded_number, weighted_sum
from apc.network.channel import ChannelLaw, channel_law
from apc.spectrum.interconnection import (
    Coupling,
    InterconnectionMatrices,
    ModalSystem,
    StateLayout,
    interconnect,
)
from apc.spectrum.relative_coordinates import relative_coordinates, relative_rows, with_uncertainty
from apc.support.not_supported import NotSupportedError
from apc.timing.schedule import CouplingTerm, UncertainSample

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Number of combinations of received counts per class that are evaluated together: twelve different peers.
MOST_NODES = 4096

# Roundings of a node, of its weight and of a product with either.
NODE_ROUNDINGS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Receiver:
    """The dynamics of a peer of a class by the number of received packets.

    Each row of `received` (m, K) has the probability `probabilities` (m,).

    `local_map` is P(a) (m, 2, n, n), `mean` its mean,
    `received_from` K_g(a) for each class g (m, 2, n, n_g), and
    `shares` k_g (2, n, n_g), the contribution of one peer of each class to the mean.
    """

    received: Floats
    probabilities: Floats
    local_map: Matrix
    mean: Matrix
    received_from: tuple[Matrix, ...]
    shares: tuple[Matrix, ...]


def quadrature(n: int, lost: float, most: int) -> tuple[Floats, Floats]:
    """Return quadrature nodes and weights for the number of received packets, exact up to degree 2·most − 1.

    Parameters
    ----------
    n, lost
        The number of packets and their loss probability: a binomial distribution.
    most
        The largest number of nodes; all n + 1 outcomes if fewer.

    Notes
    -----
    The recurrence of Krawtchouk polynomials, and the method of Golub and Welsch (1969).
    """
    if n + 1 <= most:
        outcomes = np.arange(n + 1)
        weights = [math.comb(n, k) * (1 - lost) ** k * lost ** (n - k) for k in range(n + 1)]
        return outcomes.astype(np.float64), np.array(weights)
    k, chance = np.arange(most), 1 - lost
    middle = n * chance + k * (1 - 2 * chance)
    off_diagonal = np.sqrt(k[1:] * (n - k[1:] + 1.0) * chance * lost)
    nodes, vectors = np.linalg.eigh(np.diag(middle) + np.diag(off_diagonal, 1) + np.diag(off_diagonal, -1))
    return nodes, vectors[0] ** 2


def self_substitution(model: Model, reception: PerTickReception) -> Moments:
    """Return the second-moment operator of peers that substitute their own values for missing ones.

    Parameters
    ----------
    model
        The model.
    reception
        The peers, from `class_moments.build_reception` with substitutes; packets are due at the start of
        frames.
    """
    classes = classes_of(reception)
    receivers, offsets, _ = receivers_of(model, reception, classes.common, classes.weights)
    sizes = np.diff(offsets).tolist()
    width = max(sizes)
    blocks, moment_coordinates = [], []
    for index, peer_versus_rest in enumerate(classes.loops):
        starts = np.cumsum([0, *(sizes[g] for g in peer_versus_rest.class_of)]).tolist()
        matrix = _mean_matrix(receivers, peer_versus_rest, starts)
        coordinates = relative_coordinates(
            with_stored_values(matrix, peer_versus_rest.neutral, peer_versus_rest.modal_system, starts)
        )
        bounded, received_forms, shares = with_uncertainty(coordinates), [], []
        for subsystem, g in enumerate(peer_versus_rest.class_of):
            for weights, forms in _deviations(receivers[g], peer_versus_rest, subsystem, starts, matrix):
                received_forms.append(
                    np.pad(forms[..., coordinates.rest], [*[(0, 0)] * 2, (0, width - sizes[g]), (0, 0)])
                )
                shares.append(
                    np.outer(np.arange(len(sizes)) == g, peer_versus_rest.candidates[subsystem] * weights)
                )
        into = relative_rows(
            MIDPOINT_RADIUS.exact(np.eye(starts[-1], width) * (np.arange(width) < sizes[index])),
            bounded,
            MIDPOINT_RADIUS,
        )
        inner = relative_rows(matrix[..., coordinates.rest], bounded, MIDPOINT_RADIUS)
        reception_terms = np.concatenate(received_forms), np.concatenate(shares, axis=-1)
        blocks.append(MomentBlock(inner, into[None], (index,), *reception_terms))
        moment_coordinates.append(MomentCoordinates(peer_versus_rest, coordinates, tuple(starts)))
    ones_by_class = np.ones((len(sizes), width, width))
    entries = sum(size * (size + 1) // 2 for size in sizes)
    operator = Operator(tuple(blocks), with_error_radius(ones_by_class, np.zeros_like(ones_by_class)))
    return Moments(operator, tuple(moment_coordinates), entries, max(operator.sizes))


def receivers_of(
    model: Model, reception: PerTickReception, common: ModalSystem, weights: Coupling
) -> tuple[list[Receiver], list[int], ChannelLaw]:
    """Return the receiver dynamics of each class, the offsets of their states, and the channel law of the
    losses.

    Parameters
    ----------
    model, reception
        The model and its peers.
    common
        The loop of all classes of peers.
    weights
        The coupling weight of a peer of one class at a peer of another.
    """
    stored = stored_of(model, reception, common, perfect=True)
    if len(stored) != 1:
        raise NotSupportedError("substituted values together with packets of other links")
    (memory,) = stored
    link = next(link for link in model.links if link.name == memory.route[0])
    law = channel_law(model, link, memory.route[1])
    counts = [peer_class.count for peer_class in common.peer_classes]
    subsystems = [with_memory(peer_class, stored) for peer_class in common.peer_classes]
    received_now = sorted(set(memory.memory.received.values()))
    values = []
    for subsystem in subsystems:
        indices = [
            subsystem.values[memory.route, name, value] for name in memory.channels for value in received_now
        ]
        assert not subsystem.map.d[:, indices].any(), (
            "a received packet depends on another packet of the same frame"
        )
        values.append(subsystem.map.s[:, indices])
    receivers = []
    for h, rows in enumerate(reception.of(common)):
        others = [count - (g == h) for g, count in enumerate(counts)]
        class_weights = {coupling_term: rows_of[h] for coupling_term, rows_of in weights.items()}
        ticks = len({(row.clock, row.tick) for row in rows})
        # The number of packets received from each class is binomial; its moments are integrated exactly.
        packet_counts = [
            quadrature(n, law.mean_loss, ticks + 3)
            if any(row[g] for row in class_weights.values())
            else (np.zeros(1), np.ones(1))
            for g, n in enumerate(others)
        ]
        combinations = math.prod(len(values_of) for values_of, _ in packet_counts)
        if combinations > MOST_NODES:
            raise NotSupportedError(
                f"substituted values between different peers: {combinations:,} reception "
                f"patterns; the limit is {MOST_NODES:,}"
            )
        received = np.array(list(itertools.product(*(values_of for values_of, _ in packet_counts))))
        probabilities = np.array(
            [*map(math.prod, itertools.product(*(shares for _, shares in packet_counts)))]
        )
        receivers.append(
            _closed_receiver(
                subsystems[h], rows, memory, values, class_weights, others, received, probabilities
            )
        )
    offsets = np.cumsum([0] + [subsystem.states for subsystem in subsystems]).tolist()
    return receivers, offsets, law


def _closed_receiver(
    subsystem: MeanSubsystem,
    rows: Sequence[UncertainSample],
    stored: RouteMemory,
    values: Sequence[Matrix],
    weights: Mapping[CouplingTerm, Sequence[Fraction]],
    others: Sequence[int],
    received: Floats,
    probabilities: Floats,
) -> Receiver:
    """Return a peer's dynamics, with its loop closed through the substitutes for missing values.

    Parameters
    ----------
    subsystem, rows
        The peer, and the received sample of each row of r.
    stored
        The receiver memory of each sender.
    values
        The values received from each class's peers, over their states.
    weights
        The coupling weights of a peer of each class, by coupling term.
    others
        The number of other peers of each class.
    received, probabilities
        The combinations of received counts per class (m, K), and their probabilities (m,).
    """
    received_now = sorted(set(stored.memory.received.values()))
    n = subsystem.states
    ends = np.cumsum([n, *(rows_of.shape[-2] for rows_of in values)]).tolist()
    direct = np.zeros((len(received), 2, len(rows), subsystem.map.s.shape[-2]))
    delayed = np.zeros((len(received), 2, len(rows), ends[-1]))
    for input_row, row in enumerate(rows):
        if (
            row.coupling_term.link,
            row.coupling_term.delay,
        ) != stored.route or row.channel not in stored.channels:
            continue
        class_weights = np.array([float(coupling_weight) for coupling_weight in weights[row.coupling_term]])
        if row.gap:
            index = subsystem.sent[local_value(row)]
            direct[:, 0, input_row, index] = (others - received) @ class_weights
            direct[:, 1, input_row, index] = (
                16 * UNIT_ROUNDOFF * ((others + np.abs(received)) @ np.abs(class_weights))
            )
            continue
        value = received_now.index(stored.memory.received[row.clock, row.tick])
        value += stored.channels.index(row.channel) * len(received_now)
        delayed[:, :, input_row, np.array(ends[:-1]) + value] = (
            class_weights,
            UNIT_ROUNDOFF * np.abs(class_weights),
        )
    layout = StateLayout((0,), ("",) * n, {})
    closed = interconnect(
        [subsystem.map], [InterconnectionMatrices(direct, delayed)], layout, numbers=MIDPOINT_RADIUS
    ).matrix
    local_map = closed[..., :n]

    received_by = [
        MIDPOINT_RADIUS.multiply(closed[..., start:end], rows_of)
        for start, end, rows_of in zip(ends, ends[1:], values, strict=False)
    ]
    shares = []
    for g, sender_matrix in enumerate(received_by):
        shared = weighted_sum(probabilities, entrywise(sender_matrix, _rounded_counts(received[:, g])))
        shares.append(entrywise(shared, rounded_number(1 / max(others[g], 1))))
    mean = weighted_sum(probabilities, local_map)
    return Receiver(received, probabilities, local_map, mean, tuple(received_by), tuple(shares))


def _mean_matrix(
    receivers: Sequence[Receiver], peer_versus_rest: PeerVersusRest, starts: Sequence[int]
) -> Matrix:
    """Return the state matrix (2, n, n) of the means of a loop's subsystems."""
    spans, matrix = list(map(slice, starts, starts[1:])), np.zeros((2, starts[-1], starts[-1]))
    for index, g in enumerate(peer_versus_rest.class_of):
        for sender, (h, peer_class) in enumerate(
            zip(peer_versus_rest.class_of, peer_versus_rest.modal_system.peer_classes, strict=True)
        ):
            block = entrywise(
                receivers[g].shares[h], rounded_number(float(peer_class.count - (sender == index)))
            )
            matrix[:, spans[index], spans[sender]] = (
                MIDPOINT_RADIUS.add(receivers[g].mean, block) if sender == index else block
            )
    return matrix


def _deviations(
    receiver: Receiver, peer_versus_rest: PeerVersusRest, index: int, starts: Sequence[int], mean: Matrix
) -> Iterator[tuple[Floats, Matrix]]:
    """Yield deviations of a subsystem's transition matrix from its mean, with their probabilities.

    The received counts per class (m,) are random; for `index` > 0 so is whether one of the packets is that of
    the first subsystem. A peer that receives a of n packets of that class receives it with probability a/n.
    All other peers of a class have equal motions.

    Parameters
    ----------
    receiver, index
        The dynamics of the subsystem's class, and the index of the subsystem.
    peer_versus_rest, starts
        The loop, and the first state of each subsystem.
    mean
        The state matrix of the means (2, n, n).

    Yields
    ------
    Floats
        The probabilities (m,) of the received counts, with the packet of the first subsystem or without it.
    Matrix
        The deviations (m, 2, n_h, n): rows for the subsystem's states, columns for the states of the loop.
    """
    first_class = peer_versus_rest.class_of[0]
    received_of_first_class, senders_of_first_class = (
        receiver.received[:, first_class],
        sum(
            peer_class.count
            for peer_class, g in zip(
                peer_versus_rest.modal_system.peer_classes, peer_versus_rest.class_of, strict=True
            )
            if g == first_class
        )
        - (peer_versus_rest.class_of[index] == first_class),
    )
    for receives_first in (0, 1) if index and senders_of_first_class else (0,):
        outcome_probability = (
            np.abs(1 - receives_first - received_of_first_class / senders_of_first_class)
            if index and senders_of_first_class
            else np.ones(len(received_of_first_class))
        )
        transition = np.zeros(
            (len(received_of_first_class), 2, starts[index + 1] - starts[index], starts[-1])
        )
        for subsystem, g in enumerate(peer_versus_rest.class_of):
            received_count = (
                receiver.received[:, g] - receives_first * (g == first_class)
                if subsystem
                else np.full(len(received_of_first_class), float(receives_first))
            )
            columns = slice(starts[subsystem], starts[subsystem + 1])
            transition[..., columns] = entrywise(receiver.received_from[g], _rounded_counts(received_count))
            if subsystem == index:
                transition[..., columns] = MIDPOINT_RADIUS.add(transition[..., columns], receiver.local_map)
        yield (
            receiver.probabilities * outcome_probability,
            MIDPOINT_RADIUS.subtract(transition, mean[:, starts[index] : starts[index + 1]]),
        )


def _rounded_counts(numbers: Floats) -> Matrix:
    """Return numbers of peers (m, 2, 1, 1) with error bounds."""
    return np.stack([numbers, NODE_ROUNDINGS * UNIT_ROUNDOFF * np.abs(numbers)], axis=-1)[..., None, None]
