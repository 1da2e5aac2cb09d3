"""Second moments where a receiver puts its own value in the place of a missing one.

Takes: a scene whose packets are due at the same instant of each frame, lost independently of each other.
Gives: `stand_in`; `Classes`, `standing_in`, `luck_of_luck`, `luck_after`, `entries_of`, `spread_of`.
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
from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.eigen.closing import Loop
from apc.eigen.relative import Relative, relative_coordinates
from apc.frame.discretize import UNIT
from apc.frame.radius import RADII, Arithmetic, with_radius
from apc.frame.schedule import Selected, Way
from apc.moments.crowd import Hearing, hearing, own_value, peer_classes, remembered_of, standing_motions
from apc.moments.gains import Gain, around, number_of, of_kind, stein, too_much
from apc.moments.mean_loops import Remembered, Site, scaled, standing_state, with_memory
from apc.network.channel import channel_law

Floats = NDArray[np.float64]
Matrix = NDArray[Any]

# Ways of hearing so many of each class that are looked at together: twelve peers that all differ.
MOST_NODES = 4096

# Roundings of a node, of its weight and of a product with either.
NODE_ROUNDINGS = 16


@dataclass(frozen=True, slots=True, eq=False)
class _Receiver:
    """How a peer of a class moves by how many it hears: each row of `heard` (m, K) of probability `weight`.

    `mean` (2, n, n) is that of P(a), `shares` are k_g, the mean that one peer of each class g takes part with
    (2, n, n_g). `apart` (m, 2, n, n + Σ n_g) is [P(a) − P, a K_g(a) − n_g k_g], and `per_peer` K_g(a) − k_g.
    """

    heard: Floats
    weight: Floats
    mean: Matrix
    shares: tuple[Matrix, ...]
    apart: Matrix
    per_peer: tuple[Matrix, ...]


@dataclass(frozen=True, slots=True, eq=False)
class Classes:
    """Classes of equal peers: how many, where each one's states start, and how a peer of each moves.

    `parts` are the means' loops in relative coordinates (class or None for all, matrix, coordinates).
    """

    counts: tuple[int, ...]
    offsets: tuple[int, ...]
    receivers: tuple[_Receiver, ...]
    parts: tuple[tuple[int | None, Matrix, Relative], ...]

    def of(self, place: int) -> slice:
        """Return the states of a class."""
        return slice(self.offsets[place], self.offsets[place + 1])

    def size(self, place: int) -> int:
        """Return how many states a peer of a class has."""
        return self.offsets[place + 1] - self.offsets[place]


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


def stand_in(system: CompiledSystem, prepared: Prepared, first: Fraction) -> tuple[list[Matrix], Gain] | str:
    """Return the means' loops and G(λ) of what luck adds, see `gains`; or why not.

    Parameters
    ----------
    system, prepared, first
        As for `standing_in`.
    """
    found = standing_in(system, prepared, first)
    if isinstance(found, str):
        return found
    why = too_much(sum(map(len, entries_of(found))), found.offsets[-1])
    return why or ([matrix for _, matrix, _ in found.parts], partial(luck_of_luck, found))


def standing_in(
    system: CompiledSystem, prepared: Prepared, first: Fraction, *, told: Hearing | None = None
) -> Classes | str:
    """Return how peers move that put their own values in the place of missing ones; or why not.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    first
        When frames begin: all packets that may be lost are due then.
    told
        Its peers, where they are not those of `hearing` with what stands in.
    """
    told = told or hearing(system, prepared, first=first, stand_in=True)
    loops, weights = peer_classes(told)
    common = loops[0]
    remembered = remembered_of(system, told, common, perfect=True)
    (one,) = remembered
    link = next(link for link in system.links if link.name == one.route[0])
    law = channel_law(system, link, told.timings[one.route[1]])
    counts = [site.count for site in common.sites]
    sites = [with_memory(group, remembered) for group in common.sites]
    heard_now = sorted(set(one.memory.heard.values()))
    values = []
    for site in sites:
        places = [site.values[one.route, name, value] for name in one.channels for value in heard_now]
        assert not site.map.d[:, places].any(), (
            "what is heard was sent after hearing something in the same frame"
        )
        values.append(site.map.s[:, places])
    receivers = []
    for h, rows in enumerate(told.of(common)):
        others = [count - (g == h) for g, count in enumerate(counts)]
        own = {way: listed[h] for way, listed in weights.items()}
        ticks = len({(row.clock, row.tick) for row in rows})
        nodes = [
            quadrature(n, 1 - law.mean_loss, ticks + 3)
            if any(listed[g] for listed in own.values())
            else (np.zeros(1), np.ones(1))
            for g, n in enumerate(others)
        ]
        ways = math.prod(len(listed) for listed, _ in nodes)
        if ways > MOST_NODES:
            return (
                f"values that stand in between different peers: a peer hears others in {ways:,} ways; "
                f"{MOST_NODES:,} are the most that are followed"
            )
        heard = np.array(list(itertools.product(*(listed for listed, _ in nodes))))
        weight = np.array(
            [math.prod(listed) for listed in itertools.product(*(shares for _, shares in nodes))]
        )
        receivers.append(_receiver(sites[h], rows, one, values, own, others, heard, weight))
    offsets = np.cumsum([0] + [len(site.names) for site in sites]).tolist()
    return _closed(tuple(receivers), tuple(counts), tuple(offsets), loops)


def _receiver(
    site: Site,
    rows: Sequence[Selected],
    one: Remembered,
    values: Sequence[Matrix],
    weights: Mapping[Way, Sequence[Fraction]],
    others: Sequence[int],
    heard: Floats,
    weight: Floats,
) -> _Receiver:
    """Close a peer's loop with itself: what stands in for what it misses.

    Parameters
    ----------
    site, rows
        The peer, and what each row of its r hears.
    one
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
    heard_now = sorted(set(one.memory.heard.values()))
    plain = site.map
    own_places = sorted({site.sent[own_value(row)] for row in rows if row.gap})
    m, n_r = len(heard), len(rows)
    gap = np.zeros((m, 2, n_r, len(own_places)))
    from_class = [np.zeros((2, n_r, rows_of.shape[-2])) for rows_of in values]
    for line, row in enumerate(rows):
        if (row.way.link, row.way.delay) != one.route or row.channel not in one.channels:
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
        value = heard_now.index(one.memory.heard[row.clock, row.tick])
        value += one.channels.index(row.channel) * len(heard_now)
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
    mean = _mean(weight, alone)
    apart, shares, per_peer = [RADII.subtract(alone, mean)], [], []
    for g, (felt_of, rows_of) in enumerate(zip(from_class, values, strict=True)):
        block = RADII.multiply(RADII.multiply(reached, felt_of), rows_of)
        alike = _each(block, heard[:, g])
        shared = _mean(weight, alike)
        shares.append(scaled(shared, number_of(1 / max(others[g], 1), RADII), RADII))
        apart.append(RADII.subtract(alike, shared))
        per_peer.append(RADII.subtract(block, shares[g]))
    return _Receiver(heard, weight, mean, tuple(shares), np.concatenate(apart, axis=-1), tuple(per_peer))


def _mean(weight: Floats, blocks: Matrix) -> Matrix:
    """Return the mean (2, n, n) of matrices (m, 2, n, n), the weights rounded."""
    value = np.tensordot(weight, blocks[:, 0], 1)
    size = np.tensordot(np.abs(weight), np.abs(blocks[:, 0]), 1)
    radius = np.tensordot(np.abs(weight), blocks[:, 1], 1) + NODE_ROUNDINGS * (len(weight) + 4) * UNIT * size
    return with_radius(value, radius * (1 + 8 * UNIT))


def _closed(
    receivers: tuple[_Receiver, ...], counts: tuple[int, ...], offsets: tuple[int, ...], loops: Sequence[Loop]
) -> Classes:
    """Close the means' loops, of all peers and of each class's apart."""
    common, n = loops[0], offsets[-1]
    whole = np.zeros((2, n, n))
    for h, one in enumerate(receivers):
        for g, count in enumerate(counts):
            block = scaled(one.shares[g], number_of(float(count - (g == h)), RADII), RADII)
            block = RADII.add(one.mean, block) if h == g else block
            whole[:, offsets[h] : offsets[h + 1], offsets[g] : offsets[g + 1]] = block
    at = relative_coordinates(standing_state(whole, standing_motions(common), common, offsets))
    parts: list[tuple[int | None, Matrix, Relative]] = [(None, _reduced(whole, at), at)]
    for loop in loops[1:]:
        h = [site.name for site in common.sites].index(loop.sites[0].name)
        apart = RADII.subtract(receivers[h].mean, receivers[h].shares[h])
        still = standing_state(apart, standing_motions(loop), loop, [0, offsets[h + 1] - offsets[h]])
        own = relative_coordinates(still)
        parts.append((h, _reduced(apart, own), own))
    return Classes(counts, offsets, receivers, tuple(parts))


def _each(blocks: Matrix, by: Floats) -> Matrix:
    """Return matrices (m, 2, n, n), each times a number of its own (m,)."""
    factor = by[:, None, None, None]
    found = blocks * np.abs(factor)
    found[:, 0] = blocks[:, 0] * by[:, None, None]
    found[:, 1] += NODE_ROUNDINGS * UNIT * np.abs(found[:, 0])
    return found


def _reduced(matrix: Matrix, at: Relative) -> Matrix:
    """Return a loop (2, n, n) in relative coordinates."""
    inner = matrix[:, at.rest[:, None], at.rest]
    if not len(at.held):
        return inner
    weights = with_radius(at.weights, at.doubt)
    return RADII.subtract(inner, RADII.multiply(weights, matrix[:, at.held[:, None], at.rest]))


def luck_of_luck(of: Classes, growth: float, numbers: Arithmetic) -> Matrix | None:
    """Return G(λ) over the entries of each class's Ω."""
    listed = [np.array(one, np.intp).T for one in entries_of(of)]
    firsts = np.cumsum([0] + [one.shape[1] for one in listed]).tolist()
    found = of_kind(np.zeros((2, firsts[-1], firsts[-1])), numbers)
    for d, (rows, columns) in enumerate(listed):
        units, number = np.zeros((len(rows), of.size(d), of.size(d))), np.arange(len(rows))
        units[number, rows, columns] = units[number, columns, rows] = 1.0
        after = luck_after(of, d, of_kind(RADII.exact(units), numbers), growth, numbers)
        if after is None:
            return None
        for h, ((a, b), added) in enumerate(zip(listed, after, strict=True)):
            block = np.moveaxis(added[..., a, b], 0, -1)
            where = np.s_[..., firsts[h] : firsts[h + 1], firsts[d] : firsts[d + 1]]
            found[where] = numbers.add(found[where], block)
    return found


def luck_after(of: Classes, d: int, added: Matrix, growth: float, numbers: Arithmetic) -> list[Matrix] | None:
    """Return what luck adds to peers of each class where those of one got Ω, None where that has no end.

    Parameters
    ----------
    of, d, added, growth, numbers
        As for `spread_of`.
    """
    spread = spread_of(of, d, added, growth, numbers)
    return None if spread is None else [_added(of, h, d, spread, numbers) for h in range(len(of.counts))]


def entries_of(of: Classes) -> list[list[tuple[int, int]]]:
    """Return the entries (a, b) of each class's Ω, a ≤ b."""
    return [[(a, b) for a in range(n) for b in range(a, n)] for n in np.diff(of.offsets).tolist()]


def spread_of(
    of: Classes, d: int, added: Matrix, growth: float, numbers: Arithmetic
) -> dict[int | None, Matrix] | None:
    """Return the moments that peers of a class make who each get Ω more a frame, None where they have no end.

    They are those of all classes' means (None), and those of class d that a peer of n has 1 − 1/n of, apart
    from its like.

    Parameters
    ----------
    of, d
        The classes, and which of them.
    added
        Ω (b, n, n), or several.
    growth
        λ, what second moments grow by in a frame.
    numbers
        What Ω is of.
    """
    root, shrink = number_of(growth**-0.5, numbers), number_of(1 / growth, numbers)
    spread: dict[int | None, Matrix] = {}
    for h, matrix, at in of.parts:
        if h not in (None, d):
            continue
        # What luck adds to a peer, in relative coordinates; of all peers' mean, a peer is one in n.
        place = of.offsets[d] if h is None else 0
        total = of.offsets[-1] if h is None else of.size(d)
        into = np.zeros((2, total, of.size(d)))
        into[0, place : place + of.size(d)] = np.eye(of.size(d))
        weights = with_radius(at.weights, at.doubt)
        into = (
            into[:, at.rest]
            if not len(at.held)
            else RADII.subtract(into[:, at.rest], RADII.multiply(weights, into[:, at.held]))
        )
        driven = scaled(around(of_kind(into, numbers), added, numbers), shrink, numbers)
        if h is None:
            driven = scaled(driven, number_of(1 / of.counts[d], numbers), numbers)
        moments = stein(scaled(of_kind(matrix, numbers), root, numbers), driven, numbers)
        if moments is None:
            return None
        whole = np.zeros((*moments.shape[:-2], total, total))
        whole[..., at.rest[:, None], at.rest] = moments
        spread[h] = whole
    return spread


def _added(of: Classes, h: int, d: int, spread: Mapping[int | None, Matrix], numbers: Arithmetic) -> Matrix:
    """Return Ω of a peer of class h, for moments that class d's luck made (b, n, n)."""
    classes, one = range(len(of.counts)), of.receivers[h]

    def together(g: int, k: int) -> Matrix:
        """Return the moments of two peers, of classes g and k, that are not the same."""
        alike: Matrix = spread[None][..., of.of(g), of.of(k)]
        if g == k == d and d in spread:
            return numbers.subtract(alike, scaled(spread[d], number_of(1 / of.counts[d], numbers), numbers))
        return alike

    def alone(g: int) -> Matrix:
        """Return the moments of one peer."""
        if g == d and d in spread:
            return numbers.add(together(g, g), spread[d])
        return together(g, g)

    # What luck adds: how a peer moves apart from the mean of such peers, those it hears taken alike; and
    # which of those that differ it hears, a of n.
    size = of.size(h)
    ends = np.cumsum([size] + [of.size(g) for g in classes]).tolist()
    joint = np.zeros((*alone(h).shape[:-2], ends[-1], ends[-1]))
    joint[..., :size, :size] = alone(h)
    for g in classes:
        rows = slice(ends[g], ends[g + 1])
        joint[..., :size, rows] = together(h, g)
        joint[..., rows, :size] = np.swapaxes(together(h, g), -1, -2)
        for k in classes:
            joint[..., rows, ends[k] : ends[k + 1]] = together(g, k)
    total = _mean_of(one.weight, around(_of_nodes(one.apart, numbers), joint[:, None], numbers), numbers)
    if d in spread and one.heard[:, d].any():
        others = of.counts[d] - (d == h)
        here = around(_of_nodes(one.per_peer[d], numbers), spread[d][:, None], numbers)
        total = numbers.add(total, _mean_of(one.weight * one.heard[:, d], here, numbers))
        share = of_kind(one.shares[d], numbers)
        missed = float(one.weight @ (others - one.heard[:, d]))
        there = scaled(around(share, spread[d], numbers), number_of(missed, numbers), numbers)
        total = numbers.add(total, there)
    return total


def _of_nodes(blocks: Matrix, numbers: Arithmetic) -> Matrix:
    """Return matrices (m, 2, …) with their radii as they are, or without them."""
    return blocks if numbers is RADII else blocks[:, 0]


def _mean_of(weight: Floats, blocks: Matrix, numbers: Arithmetic) -> Matrix:
    """Return the mean (b, …) of matrices (b, m, …)."""
    if numbers is not RADII:
        return np.asarray(np.einsum("m,bmij->bij", weight, blocks))
    value = np.einsum("m,bmij->bij", weight, blocks[:, :, 0])
    size = np.einsum("m,bmij->bij", np.abs(weight), np.abs(blocks[:, :, 0]))
    radius = np.einsum("m,bmij->bij", np.abs(weight), blocks[:, :, 1])
    radius += NODE_ROUNDINGS * (len(weight) + 4) * UNIT * size
    return with_radius(value, radius * (1 + 8 * UNIT))
