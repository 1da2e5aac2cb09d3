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
from apc.eigen.interconnection import (
    Coupling,
    InterconnectionMatrices,
    ModalSystem,
    StateLayout,
    interconnect,
)
from apc.eigen.relative_coordinates import relative_coordinates, relative_rows, with_uncertainty
from apc.frame.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, with_error_radius
from apc.frame.schedule import CouplingTerm, UncertainSample
from apc.frame.taylor_models import entrywise
from apc.mean_square.class_moments import (
    MomentCoordinates,
    Moments,
    PeerVersusRest,
    PerTickReception,
    classes_of,
    local_value,
    stored_of,
)
from apc.mean_square.mean_dynamics import MeanSubsystem, RouteMemory, neutral_state, with_memory
from apc.mean_square.second_moment_operator import MomentBlock, Operator, mean_of, number_of
from apc.network.channel import ChannelLaw, channel_law
from apc.not_supported import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Number of combinations of received counts per class that are evaluated together: twelve different peers.
MOST_NODES = 4096

# Roundings of a node, of its weight and of a product with either.
NODE_ROUNDINGS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Receiver:
    """The dynamics of a peer of a class by the number of received packets.

    Each row of `received` (m, K) has probability `weight`.

    `local` is P(a) (m, 2, n, n), `mean` its mean, `received_from` K_g(a) for each class g (m, 2, n, n_g), and
    `shares` k_g (2, n, n_g), the contribution of one of its peers to the mean.
    """

    received: Floats
    weight: Floats
    local: Matrix
    mean: Matrix
    received_from: tuple[Matrix, ...]
    shares: tuple[Matrix, ...]


def quadrature(n: int, lost: float, most: int) -> tuple[Floats, Floats]:
    """Return nodes and weights for the number of arrivals, exact for polynomials up to 2·most − 1.

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


def self_substitution(system: Model, reception: PerTickReception) -> Moments:
    """Return the second-moment operator of peers that substitute their own values for missing ones.

    Parameters
    ----------
    system
        The model.
    reception
        The peers, from `class_moments.build_reception` with substitutes; packets are due at the start of
        frames.
    """
    classes = classes_of(reception)
    receivers, offsets, _ = receivers_of(system, reception, classes.common, classes.weights)
    sizes = np.diff(offsets).tolist()
    width = max(sizes)
    blocks, moment_coordinates = [], []
    for index, peer_versus_rest in enumerate(classes.loops):
        starts = np.cumsum([0, *(sizes[g] for g in peer_versus_rest.of)]).tolist()
        matrix = _mean(receivers, peer_versus_rest, starts)
        coordinates = relative_coordinates(
            neutral_state(matrix, peer_versus_rest.neutral, peer_versus_rest.loop, starts)
        )
        bounded, received_forms, shares = with_uncertainty(coordinates), [], []
        for subsystem, g in enumerate(peer_versus_rest.of):
            for weights, forms in _forms(receivers[g], peer_versus_rest, subsystem, starts, matrix):
                received_forms.append(
                    np.pad(forms[..., coordinates.rest], [*[(0, 0)] * 2, (0, width - sizes[g]), (0, 0)])
                )
                shares.append(
                    np.outer(np.arange(len(sizes)) == g, peer_versus_rest.many[subsystem] * weights)
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
    system: Model, reception: PerTickReception, common: ModalSystem, weights: Coupling
) -> tuple[list[Receiver], list[int], ChannelLaw]:
    """Return the dynamics of peers of each class, the offsets of their states, and the law of their losses.

    Parameters
    ----------
    system, reception
        The model and its peers.
    common
        The loop of all classes of peers.
    weights
        The coupling weight of a peer of one class at a peer of another.
    """
    stored = stored_of(system, reception, common, perfect=True)
    if len(stored) != 1:
        raise NotSupportedError("values that stand in beside what is heard over other links")
    (item,) = stored
    link = next(link for link in system.links if link.name == item.route[0])
    law = channel_law(system, link, reception.timings[item.route[1]])
    counts = [subsystem.count for subsystem in common.subsystems]
    subsystems = [with_memory(group, stored) for group in common.subsystems]
    received_now = sorted(set(item.memory.received.values()))
    values = []
    for subsystem in subsystems:
        indices = [
            subsystem.values[item.route, name, value] for name in item.channels for value in received_now
        ]
        assert not subsystem.map.d[:, indices].any(), (
            "what is heard was sent after hearing something in the same frame"
        )
        values.append(subsystem.map.s[:, indices])
    receivers = []
    for h, rows in enumerate(reception.of(common)):
        others = [count - (g == h) for g, count in enumerate(counts)]
        local = {coupling_term: weight[h] for coupling_term, weight in weights.items()}
        ticks = len({(row.clock, row.tick) for row in rows})
        nodes = [
            quadrature(n, law.mean_loss, ticks + 3)
            if any(listed[g] for listed in local.values())
            else (np.zeros(1), np.ones(1))
            for g, n in enumerate(others)
        ]
        combinations = math.prod(len(listed) for listed, _ in nodes)
        if combinations > MOST_NODES:
            raise NotSupportedError(
                f"values that stand in between different peers: a peer hears others in {combinations:,} "
                "ways; "
                f"{MOST_NODES:,} are the most that are followed"
            )
        received = np.array(list(itertools.product(*(listed for listed, _ in nodes))))
        weight = np.array(
            [math.prod(listed) for listed in itertools.product(*(shares for _, shares in nodes))]
        )
        receivers.append(_receiver(subsystems[h], rows, item, values, local, others, received, weight))
    offsets = np.cumsum([0] + [subsystem.states for subsystem in subsystems]).tolist()
    return receivers, offsets, law


def _receiver(
    subsystem: MeanSubsystem,
    rows: Sequence[UncertainSample],
    stored: RouteMemory,
    values: Sequence[Matrix],
    weights: Mapping[CouplingTerm, Sequence[Fraction]],
    others: Sequence[int],
    received: Floats,
    weight: Floats,
) -> Receiver:
    """Close a peer's loop with itself, through the substitutes for missing values.

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
    received, weight
        The combinations of received counts per class (m, K), and their probabilities (m,).
    """
    received_now = sorted(set(stored.memory.received.values()))
    n = subsystem.states
    ends = np.cumsum([n, *(rows_of.shape[-2] for rows_of in values)]).tolist()
    now = np.zeros((len(received), 2, len(rows), subsystem.map.s.shape[-2]))
    before = np.zeros((len(received), 2, len(rows), ends[-1]))
    for line, row in enumerate(rows):
        if (
            row.coupling_term.link,
            row.coupling_term.delay,
        ) != stored.route or row.channel not in stored.channels:
            continue
        local = np.array([float(weight) for weight in weights[row.coupling_term]])
        if row.gap:
            index = subsystem.sent[local_value(row)]
            now[:, 0, line, index] = (others - received) @ local
            now[:, 1, line, index] = 16 * UNIT_ROUNDOFF * ((others + np.abs(received)) @ np.abs(local))
            continue
        value = received_now.index(stored.memory.received[row.clock, row.tick])
        value += stored.channels.index(row.channel) * len(received_now)
        before[:, :, line, np.array(ends[:-1]) + value] = local, UNIT_ROUNDOFF * np.abs(local)
    layout = StateLayout((0,), ("",) * n, {})
    moved = interconnect(
        [subsystem.map], [InterconnectionMatrices(now, before)], layout, numbers=MIDPOINT_RADIUS
    ).matrix
    alone = moved[..., :n]

    received_by = [
        MIDPOINT_RADIUS.multiply(moved[..., start:end], rows_of)
        for start, end, rows_of in zip(ends, ends[1:], values, strict=False)
    ]
    shares = []
    for g, by in enumerate(received_by):
        shared = mean_of(weight, entrywise(by, _counts(received[:, g])))
        shares.append(entrywise(shared, number_of(1 / max(others[g], 1))))
    mean = mean_of(weight, alone)
    return Receiver(received, weight, alone, mean, tuple(received_by), tuple(shares))


def _mean(receivers: Sequence[Receiver], peer_versus_rest: PeerVersusRest, starts: Sequence[int]) -> Matrix:
    """Return the matrix (2, n, n) that the means of a loop's subsystems move by."""
    spans, matrix = list(map(slice, starts, starts[1:])), np.zeros((2, starts[-1], starts[-1]))
    for index, g in enumerate(peer_versus_rest.of):
        for of, (h, subsystem) in enumerate(
            zip(peer_versus_rest.of, peer_versus_rest.loop.subsystems, strict=True)
        ):
            block = entrywise(receivers[g].shares[h], number_of(float(subsystem.count - (of == index))))
            matrix[:, spans[index], spans[of]] = (
                MIDPOINT_RADIUS.add(receivers[g].mean, block) if of == index else block
            )
    return matrix


def _forms(
    receiver: Receiver, peer_versus_rest: PeerVersusRest, index: int, starts: Sequence[int], mean: Matrix
) -> Iterator[tuple[Floats, Matrix]]:
    """Return probabilities (m,) and deviations from the mean (m, 2, n_h, n) of the peers of a subsystem.

    A peer that receives a of n packets of the first subsystem's class receives that of the first subsystem
    with probability a/n; all others of a class have equal motions.
    """
    local = peer_versus_rest.of[0]
    received, n = (
        receiver.received[:, local],
        sum(
            subsystem.count
            for subsystem, g in zip(peer_versus_rest.loop.subsystems, peer_versus_rest.of, strict=True)
            if g == local
        )
        - (peer_versus_rest.of[index] == local),
    )
    for first in (0, 1) if index and n else (0,):
        chance = np.abs(1 - first - received / n) if index and n else np.ones(len(received))
        moved = np.zeros((len(received), 2, starts[index + 1] - starts[index], starts[-1]))
        for subsystem, g in enumerate(peer_versus_rest.of):
            number = (
                receiver.received[:, g] - first * (g == local)
                if subsystem
                else np.full(len(received), float(first))
            )
            columns = slice(starts[subsystem], starts[subsystem + 1])
            moved[..., columns] = entrywise(receiver.received_from[g], _counts(number))
            if subsystem == index:
                moved[..., columns] = MIDPOINT_RADIUS.add(moved[..., columns], receiver.local)
        yield (
            receiver.weight * chance,
            MIDPOINT_RADIUS.subtract(moved, mean[:, starts[index] : starts[index + 1]]),
        )


def _counts(numbers: Floats) -> Matrix:
    """Return numbers of peers (m, 2, 1, 1) with error bounds."""
    return np.stack([numbers, NODE_ROUNDINGS * UNIT_ROUNDOFF * np.abs(numbers)], axis=-1)[..., None, None]
