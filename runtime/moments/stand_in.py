"""Second moments where a receiver puts its own value in the place of a missing one.

Takes: a scene whose packets are due at the same instant of each frame, lost independently of each other.
Gives: `stand_in`; `Receiver`, `receivers_of`.
Guarantees: equal peers cost the same, however many they are.
Does not: serve bursts (see `patterns`), jitter, or several unreliable links.

A peer that hears a_g of the n_g others of class g puts its own value in the place of the n_g − a_g it misses,
tick by tick; so how it moves depends on how many it hears, and not on which of them:

    x_j⁺ = P(a) x_j + Σ_g K_g(a) Σ_(i heard of g) x_i

All peers are lucky or not independently of each other. So the moments of different peers are those of the
means, and each peer's own hold Ω more, which is linear in all moments. With P and K polynomials in a, the
mean over all a is a Gauss quadrature of the binomial distribution, exact with a node for every two degrees.
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
from apc.eigen.closing import Coupling, InterconnectionMatrices, ModalSystem, StateLayout, close
from apc.eigen.relative import relative_coordinates, relative_rows, with_doubt
from apc.frame.radius import RADII, UNIT, with_radius
from apc.frame.schedule import CouplingTerm, UncertainSample
from apc.frame.taylor import entrywise
from apc.moments.crowd import (
    MomentCoordinates,
    Moments,
    PeerVersusRest,
    PerTickReception,
    classes_of,
    own_value,
    remembered_of,
)
from apc.moments.mean_loops import MeanSubsystem, RouteMemory, standing_state, with_memory
from apc.moments.operator import MomentBlock, Operator, mean_of, number_of
from apc.network.channel import ChannelLaw, channel_law
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Ways of hearing so many of each class that are looked at together: twelve peers that all differ.
MOST_NODES = 4096

# Roundings of a node, of its weight and of a product with either.
NODE_ROUNDINGS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Receiver:
    """How a peer of a class moves by how many it hears: each row of `heard` (m, K) of probability `weight`.

    `alone` is P(a) (m, 2, n, n), `mean` its mean, `heard_of` K_g(a) for each class g (m, 2, n, n_g), and
    `shares` k_g (2, n, n_g), by which one peer of it takes part in the mean.
    """

    heard: Floats
    weight: Floats
    alone: Matrix
    mean: Matrix
    heard_of: tuple[Matrix, ...]
    shares: tuple[Matrix, ...]


def quadrature(n: int, lost: float, most: int) -> tuple[Floats, Floats]:
    """Return nodes and weights of how many packets arrive, exact for polynomials up to 2·most − 1.

    Parameters
    ----------
    n, lost
        So many packets, each lost with this probability: a binomial distribution.
    most
        The number of nodes, unless all n + 1 outcomes are fewer.

    Notes
    -----
    The recurrence of Krawtchouk's polynomials, and Golub and Welsch (1969).
    """
    if n + 1 <= most:
        outcomes = np.arange(n + 1)
        weights = [math.comb(n, k) * (1 - lost) ** k * lost ** (n - k) for k in range(n + 1)]
        return outcomes.astype(np.float64), np.array(weights)
    k, chance = np.arange(most), 1 - lost
    middle = n * chance + k * (1 - 2 * chance)
    beside = np.sqrt(k[1:] * (n - k[1:] + 1.0) * chance * lost)
    nodes, vectors = np.linalg.eigh(np.diag(middle) + np.diag(beside, 1) + np.diag(beside, -1))
    return nodes, vectors[0] ** 2


def stand_in(system: Model, hearing: PerTickReception) -> Moments:
    """Return the loops and the luck of peers that put their own values in the place of missing ones.

    Parameters
    ----------
    system
        The compiled scene.
    hearing
        Its peers, of `crowd.build_hearing` with what stands in; packets are due as frames begin.
    """
    of = classes_of(hearing)
    receivers, offsets, _ = receivers_of(system, hearing, of.common, of.weights)
    sizes = np.diff(offsets).tolist()
    width = max(sizes)
    blocks, moving = [], []
    for own, apart in enumerate(of.loops):
        starts = np.cumsum([0, *(sizes[g] for g in apart.of)]).tolist()
        matrix = _mean(receivers, apart, starts)
        at = relative_coordinates(standing_state(matrix, apart.standing, apart.loop, starts))
        bounded, seen, shares = with_doubt(at), [], []
        for site, g in enumerate(apart.of):
            for weights, forms in _forms(receivers[g], apart, site, starts, matrix):
                seen.append(np.pad(forms[..., at.rest], [*[(0, 0)] * 2, (0, width - sizes[g]), (0, 0)]))
                shares.append(np.outer(np.arange(len(sizes)) == g, apart.many[site] * weights))
        into = relative_rows(
            RADII.exact(np.eye(starts[-1], width) * (np.arange(width) < sizes[own])), bounded, RADII
        )
        inner = relative_rows(matrix[..., at.rest], bounded, RADII)
        listed = np.concatenate(seen), np.concatenate(shares, axis=-1)
        blocks.append(MomentBlock(inner, into[None], (own,), *listed))
        moving.append(MomentCoordinates(apart, at, tuple(starts)))
    everything = np.ones((len(sizes), width, width))
    entries = sum(size * (size + 1) // 2 for size in sizes)
    operator = Operator(tuple(blocks), with_radius(everything, np.zeros_like(everything)))
    return Moments(operator, tuple(moving), entries, max(operator.sizes))


def receivers_of(
    system: Model, hearing: PerTickReception, common: ModalSystem, weights: Coupling
) -> tuple[list[Receiver], list[int], ChannelLaw]:
    """Return how peers of each class move, where their states start, and the law of what they miss.

    Parameters
    ----------
    system, hearing
        The compiled scene and its peers.
    common
        The loop of all classes of peers.
    weights
        What a peer of one class weighs one of another by.
    """
    remembered = remembered_of(system, hearing, common, perfect=True)
    if len(remembered) != 1:
        raise NotSupportedError("values that stand in beside what is heard over other links")
    (item,) = remembered
    link = next(link for link in system.links if link.name == item.route[0])
    law = channel_law(system, link, hearing.timings[item.route[1]])
    counts = [site.count for site in common.sites]
    sites = [with_memory(group, remembered) for group in common.sites]
    heard_now = sorted(set(item.memory.heard.values()))
    values = []
    for site in sites:
        places = [site.values[item.route, name, value] for name in item.channels for value in heard_now]
        assert not site.map.d[:, places].any(), (
            "what is heard was sent after hearing something in the same frame"
        )
        values.append(site.map.s[:, places])
    receivers = []
    for h, rows in enumerate(hearing.of(common)):
        others = [count - (g == h) for g, count in enumerate(counts)]
        own = {way: weight[h] for way, weight in weights.items()}
        ticks = len({(row.clock, row.tick) for row in rows})
        nodes = [
            quadrature(n, law.mean_loss, ticks + 3)
            if any(listed[g] for listed in own.values())
            else (np.zeros(1), np.ones(1))
            for g, n in enumerate(others)
        ]
        ways = math.prod(len(listed) for listed, _ in nodes)
        if ways > MOST_NODES:
            raise NotSupportedError(
                f"values that stand in between different peers: a peer hears others in {ways:,} ways; "
                f"{MOST_NODES:,} are the most that are followed"
            )
        heard = np.array(list(itertools.product(*(listed for listed, _ in nodes))))
        weight = np.array(
            [math.prod(listed) for listed in itertools.product(*(shares for _, shares in nodes))]
        )
        receivers.append(_receiver(sites[h], rows, item, values, own, others, heard, weight))
    offsets = np.cumsum([0] + [site.states for site in sites]).tolist()
    return receivers, offsets, law


def _receiver(
    site: MeanSubsystem,
    rows: Sequence[UncertainSample],
    remembered: RouteMemory,
    values: Sequence[Matrix],
    weights: Mapping[CouplingTerm, Sequence[Fraction]],
    others: Sequence[int],
    heard: Floats,
    weight: Floats,
) -> Receiver:
    """Close a peer's loop with itself: what stands in for what it misses.

    Parameters
    ----------
    site, rows
        The peer, and what each row of its r hears.
    remembered
        What is heard of each sender.
    values
        What ticks hear of each class's peers, over their states.
    weights
        What the peer weighs a peer of each class by, way by way.
    others
        How many there are of each class beside it.
    heard, weight
        The ways of hearing so many of each class (m, K), and their probabilities (m,).
    """
    heard_now = sorted(set(remembered.memory.heard.values()))
    n = site.states
    ends = np.cumsum([n, *(rows_of.shape[-2] for rows_of in values)]).tolist()
    now = np.zeros((len(heard), 2, len(rows), site.map.s.shape[-2]))
    before = np.zeros((len(heard), 2, len(rows), ends[-1]))
    for line, row in enumerate(rows):
        if (row.way.link, row.way.delay) != remembered.route or row.channel not in remembered.channels:
            continue
        own = np.array([float(weight) for weight in weights[row.way]])
        if row.gap:
            place = site.sent[own_value(row)]
            now[:, 0, line, place] = (others - heard) @ own
            now[:, 1, line, place] = 16 * UNIT * ((others + np.abs(heard)) @ np.abs(own))
            continue
        value = heard_now.index(remembered.memory.heard[row.clock, row.tick])
        value += remembered.channels.index(row.channel) * len(heard_now)
        before[:, :, line, np.array(ends[:-1]) + value] = own, UNIT * np.abs(own)
    layout = StateLayout((0,), ("",) * n, {})
    moved = close([site.map], [InterconnectionMatrices(now, before)], layout, numbers=RADII).matrix
    alone = moved[..., :n]

    heard_of = [
        RADII.multiply(moved[..., start:end], rows_of)
        for start, end, rows_of in zip(ends, ends[1:], values, strict=False)
    ]
    shares = []
    for g, by in enumerate(heard_of):
        shared = mean_of(weight, entrywise(by, _counts(heard[:, g])))
        shares.append(entrywise(shared, number_of(1 / max(others[g], 1))))
    mean = mean_of(weight, alone)
    return Receiver(heard, weight, alone, mean, tuple(heard_of), tuple(shares))


def _mean(receivers: Sequence[Receiver], apart: PeerVersusRest, starts: Sequence[int]) -> Matrix:
    """Return the matrix (2, n, n) that the means of a loop's sites move by."""
    spans, matrix = list(map(slice, starts, starts[1:])), np.zeros((2, starts[-1], starts[-1]))
    for place, g in enumerate(apart.of):
        for of, (h, site) in enumerate(zip(apart.of, apart.loop.sites, strict=True)):
            block = entrywise(receivers[g].shares[h], number_of(float(site.count - (of == place))))
            matrix[:, spans[place], spans[of]] = RADII.add(receivers[g].mean, block) if of == place else block
    return matrix


def _forms(
    receiver: Receiver, apart: PeerVersusRest, place: int, starts: Sequence[int], mean: Matrix
) -> Iterator[tuple[Floats, Matrix]]:
    """Give the probabilities (m,) of how a peer of a site moves beside the mean, and how (m, 2, n_h, n).

    Of n others of the class that the first site is of, a peer that hears a hears that one with the
    probability a/n; all others of a class move alike.
    """
    own = apart.of[0]
    heard, n = (
        receiver.heard[:, own],
        sum(site.count for site, g in zip(apart.loop.sites, apart.of, strict=True) if g == own)
        - (apart.of[place] == own),
    )
    for first in (0, 1) if place and n else (0,):
        chance = np.abs(1 - first - heard / n) if place and n else np.ones(len(heard))
        moved = np.zeros((len(heard), 2, starts[place + 1] - starts[place], starts[-1]))
        for site, g in enumerate(apart.of):
            number = receiver.heard[:, g] - first * (g == own) if site else np.full(len(heard), float(first))
            columns = slice(starts[site], starts[site + 1])
            moved[..., columns] = entrywise(receiver.heard_of[g], _counts(number))
            if site == place:
                moved[..., columns] = RADII.add(moved[..., columns], receiver.alone)
        yield receiver.weight * chance, RADII.subtract(moved, mean[:, starts[place] : starts[place + 1]])


def _counts(numbers: Floats) -> Matrix:
    """Return numbers of peers (m, 2, 1, 1) with what they may be off by."""
    return np.stack([numbers, NODE_ROUNDINGS * UNIT * np.abs(numbers)], axis=-1)[..., None, None]
