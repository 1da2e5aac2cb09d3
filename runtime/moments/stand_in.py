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
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Coupling, Loop
from apc.eigen.relative import relative_coordinates, relative_rows, with_doubt
from apc.frame.radius import RADII, UNIT
from apc.frame.schedule import Selected, Way
from apc.frame.taylor import entrywise
from apc.moments.crowd import Hearing, own_value, peer_classes, remembered_of, standing_motions
from apc.moments.gains import Answer, Drive, Moments, Part, number_of, weighted
from apc.moments.mean_loops import Remembered, Site, standing_state, with_memory
from apc.moments.unserved import UnservedError
from apc.network.channel import ChannelLaw, channel_law

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Ways of hearing so many of each class that are looked at together: twelve peers that all differ.
MOST_NODES = 4096

# Roundings of a node, of its weight and of a product with either.
NODE_ROUNDINGS = 16


@dataclass(frozen=True, slots=True, eq=False)
class Receiver:
    """How a peer of a class moves by how many it hears: each row of `heard` (m, K) of probability `weight`.

    `mean` (2, n, n) is that of P(a), `shares` are k_g, the mean that one peer of each class g takes part with
    (2, n, n_g). `varies` (m, 2, n, n + Σ n_g) is [P(a) − P, a K_g(a) − n_g k_g], and `per_peer` K_g(a) − k_g.
    """

    heard: Floats
    weight: Floats
    mean: Matrix
    shares: tuple[Matrix, ...]
    varies: Matrix
    per_peer: tuple[Matrix, ...]


def quadrature(n: int, chance: float, most: int) -> tuple[Floats, Floats]:
    """Return nodes and weights of a binomial distribution, exact for polynomials up to 2·most − 1.

    Parameters
    ----------
    n, chance
        So many trials, each succeeding so often.
    most
        The number of nodes, unless all n + 1 outcomes are fewer.

    Notes
    -----
    The recurrence of Krawtchouk's polynomials, and Golub and Welsch (1969).
    """
    if n + 1 <= most:
        outcomes = np.arange(n + 1)
        weights = [math.comb(n, k) * chance**k * (1 - chance) ** (n - k) for k in range(n + 1)]
        return outcomes.astype(np.float64), np.array(weights)
    k = np.arange(most)
    middle = n * chance + k * (1 - 2 * chance)
    beside = np.sqrt(k[1:] * (n - k[1:] + 1.0) * chance * (1 - chance))
    nodes, vectors = np.linalg.eigh(np.diag(middle) + np.diag(beside, 1) + np.diag(beside, -1))
    return nodes, vectors[0] ** 2


def stand_in(system: CompiledSystem, hearing: Hearing) -> Moments:
    """Return the loops and the luck of peers that put their own values in the place of missing ones.

    Parameters
    ----------
    system
        The compiled scene.
    hearing
        Its peers, of `crowd.hearing` with what stands in; packets are due as frames begin.
    """
    loops, weights = peer_classes(hearing)
    receivers, offsets, _ = receivers_of(system, hearing, loops, weights)
    return _closed(receivers, [site.count for site in loops[0].sites], offsets, loops)


def receivers_of(
    system: CompiledSystem, hearing: Hearing, loops: Sequence[Loop], weights: Coupling
) -> tuple[list[Receiver], list[int], ChannelLaw]:
    """Return how peers of each class move, where their states start, and the law of what they miss.

    Parameters
    ----------
    system, hearing
        The compiled scene and its peers.
    loops
        The loops of classes of peers, that of all first.
    weights
        What a peer of one class weighs one of another by.
    """
    common = loops[0]
    remembered = remembered_of(system, hearing, common, perfect=True)
    if len(remembered) != 1:
        raise UnservedError("values that stand in beside what is heard over other links")
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
            quadrature(n, 1 - law.mean_loss, ticks + 3)
            if any(listed[g] for listed in own.values())
            else (np.zeros(1), np.ones(1))
            for g, n in enumerate(others)
        ]
        ways = math.prod(len(listed) for listed, _ in nodes)
        if ways > MOST_NODES:
            raise UnservedError(
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
    site: Site,
    rows: Sequence[Selected],
    remembered: Remembered,
    values: Sequence[Matrix],
    weights: Mapping[Way, Sequence[Fraction]],
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
    plain = site.map
    own_places = sorted({site.sent[own_value(row)] for row in rows if row.gap})
    m, n_r = len(heard), len(rows)
    gap = np.zeros((m, 2, n_r, len(own_places)))
    from_class = [np.zeros((2, n_r, rows_of.shape[-2])) for rows_of in values]
    for line, row in enumerate(rows):
        if (row.way.link, row.way.delay) != remembered.route or row.channel not in remembered.channels:
            continue
        if row.gap:
            missed = sum(float(weights[row.way][g]) * (others[g] - heard[:, g]) for g in range(len(others)))
            place = own_places.index(site.sent[own_value(row)])
            gap[:, 0, line, place] = missed
            gap[:, 1, line, place] = (
                16
                * UNIT
                * sum(
                    abs(float(weights[row.way][g])) * (others[g] + np.abs(heard[:, g]))
                    for g in range(len(others))
                )
            )
            continue
        value = heard_now.index(remembered.memory.heard[row.clock, row.tick])
        value += remembered.channels.index(row.channel) * len(heard_now)
        for g, block in enumerate(from_class):
            own = float(weights[row.way][g])
            block[0, line, value], block[1, line, value] = own, UNIT * abs(own)
    own_rows, own_heard = plain.s[:, own_places], plain.d[:, own_places]
    # r = gap o + s and o = O x + D r: time orders it, D gap is nilpotent.
    felt = np.broadcast_to(RADII.exact(np.eye(n_r)), (m, 2, n_r, n_r)).copy()
    step = RADII.multiply(gap, own_heard)
    term = felt
    for _ in range(n_r):
        term = RADII.multiply(step, term)
        if not term.any():
            break
        felt = RADII.add(felt, term)
    reached = RADII.multiply(plain.q, felt)
    alone = RADII.add(
        np.broadcast_to(plain.p, (m, *plain.p.shape)), RADII.multiply(RADII.multiply(reached, gap), own_rows)
    )

    def averaged(blocks: Matrix) -> Matrix:
        return np.asarray(weighted(blocks[None], weight, RADII)[0])

    mean = averaged(alone)
    varies, shares, per_peer = [RADII.subtract(alone, mean)], [], []
    for g, (felt_of, rows_of) in enumerate(zip(from_class, values, strict=True)):
        block = RADII.multiply(RADII.multiply(reached, felt_of), rows_of)
        counts = np.stack([heard[:, g], NODE_ROUNDINGS * UNIT * np.abs(heard[:, g])], axis=-1)
        alike = entrywise(block, counts[..., None, None])
        shared = averaged(alike)
        shares.append(entrywise(shared, number_of(1 / max(others[g], 1), RADII)))
        varies.append(RADII.subtract(alike, shared))
        per_peer.append(RADII.subtract(block, shares[g]))
    return Receiver(heard, weight, mean, tuple(shares), np.concatenate(varies, axis=-1), tuple(per_peer))


def _closed(
    receivers: Sequence[Receiver], counts: Sequence[int], offsets: Sequence[int], loops: Sequence[Loop]
) -> Moments:
    """Close the means' loops, of all peers and of what peers of each class differ by."""
    common, n = loops[0], offsets[-1]
    states = [slice(*ends) for ends in itertools.pairwise(offsets)]
    whole = np.zeros((2, n, n))
    for h, receiver in enumerate(receivers):
        for g, count in enumerate(counts):
            block = entrywise(receiver.shares[g], number_of(float(count - (g == h)), RADII))
            whole[:, states[h], states[g]] = RADII.add(receiver.mean, block) if h == g else block
    loops_of: list[tuple[int | None, Matrix]] = [(None, whole)]
    names = [site.name for site in common.sites]
    for loop in loops[1:]:
        h = names.index(loop.sites[0].name)
        loops_of.append((h, RADII.subtract(receivers[h].mean, receivers[h].shares[h])))
    listed = [np.array(np.triu_indices(state.stop - state.start)) for state in states]
    ends = np.cumsum([0, *(entries.shape[1] for entries in listed)]).tolist()
    places = list(map(slice, ends, ends[1:]))
    parts, drives = [], []
    for number, ((only, matrix), loop) in enumerate(zip(loops_of, loops, strict=True)):
        starts = offsets if only is None else [0, len(matrix[0])]
        at = relative_coordinates(standing_state(matrix, standing_motions(loop), loop, starts))
        bounded, inner = with_doubt(at), matrix[..., at.rest]
        answers = tuple(
            Answer(places[h], forms[..., at.rest], forms[..., at.rest], weights, listed[h])
            for h in range(len(counts))
            for forms, weights in [_forms(receivers, h, only, counts, states)]
            if len(weights)
        )
        part = Part(relative_rows(inner, bounded, RADII), only, at, tuple(starts), answers)
        parts.append(part)
        for d in range(len(counts)) if only is None else [only]:
            # Of a peer in n, the mean of all takes 1/n, and what it differs by from that the rest.
            share = 1 / counts[d] if only is None else 1 - 1 / counts[d]
            units = np.zeros((listed[d].shape[1], *[states[d].stop - states[d].start] * 2))
            a, b = listed[d]
            units[np.arange(len(a)), a, b] = units[np.arange(len(a)), b, a] = 1.0
            columns = states[d] if only is None else slice(None)
            into = relative_rows(RADII.exact(np.eye(matrix.shape[-1])[:, columns]), bounded, RADII)
            into = entrywise(into, number_of(share**0.5, RADII))
            drives.append(Drive(part.matrix, into, units, places[d], answers, number, 1.0))
    return Moments(tuple(parts), tuple(drives), ends[-1])


def _forms(
    receivers: Sequence[Receiver], h: int, only: int | None, counts: Sequence[int], states: Sequence[slice]
) -> tuple[Matrix, Floats]:
    """Return by which forms (k, 2, n_h, n) and weights (k,) luck adds to a peer of class h.

    What luck adds is how a peer moves beside the mean of such peers, those it hears taken to be the same; and
    which of those that differ it hears, a of n.

    Parameters
    ----------
    receivers, counts, states
        The classes: how peers of each move, how many there are, and where their states are in the loop of
        all.
    h
        The class that receives.
    only
        The class whose peers' differences the loop holds, None for the loop of all.
    """
    receiver = receivers[h]
    size = receiver.mean.shape[-1]
    itself, others = receiver.varies[..., :size], receiver.varies[..., size:]
    if only is None:
        forms = others.copy()
        forms[..., states[h]] = RADII.add(others[..., states[h]], itself)
        return forms, receiver.weight
    # Two peers of a class of n differ from its mean by amounts of covariance −1/(n − 1).
    n = counts[only]
    forms = others[..., states[only]]
    pairs = [(RADII.add(forms, itself) if h == only else forms, -receiver.weight / (n - 1))]
    if h == only:
        pairs.append((itself, receiver.weight * n / (n - 1)))
    missed = float(receiver.weight @ (n - (h == only) - receiver.heard[:, only]))
    pairs.append((receiver.per_peer[only], receiver.weight * receiver.heard[:, only] * n / (n - 1)))
    pairs.append((receiver.shares[only][None], np.array([missed * n / (n - 1)])))
    return np.concatenate([forms for forms, _ in pairs]), np.concatenate([weights for _, weights in pairs])
