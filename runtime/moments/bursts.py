"""Second moments under bursts of losses, tag by tag: exact for few channels, an estimate for many.

Takes: a scene of equal peers that all hear each other, or any few, whose receivers hold what they miss.
Gives: `tagged_radius`.
Guarantees: with as many tags as there are channels it is exact but for rounding; with fewer, an estimate.
Does not: bound its rounding, or what fewer tags leave out.

A channel's state is bad with probability b; φ = (s − b)/√(b(1 − b)) has mean 0, variance 1, and is on the mean
1 − p − r times itself a frame later. What moves in a frame is affine in all states, A + Σ_c φ_c U_c F_c, with
F_c how far what is held is from what is sent. So moments tagged by a set S of channels, E[x xᵀ Π_(c ∈ S) φ_c],
move by one another, tags that are squared becoming 1 + κ φ_c; those of more than k tags decay as (1 − p − r)^k
and are left out.

Peers that can change places: sets that a permutation takes to each other have one matrix between them, and
entries of it that permutations of the set to itself exchange are one number.
"""

from __future__ import annotations

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared
from apc.compiler.compiled import CompiledSystem
from apc.eigen.pseudospectrum import balance
from apc.eigen.relative import relative_places
from apc.moments.patterns import Frames, frames, largest
from apc.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

# An arc of who hears whom: (receiver, sender).
Arc = tuple[int, int]
Tags = tuple[Arc, ...]


@dataclass(frozen=True, slots=True, eq=False)
class _Affine:
    """A frame as it is affine in the channels' states: A, and U_c F_c of each (C, n, m), (C, m, n).

    `chance` is that of a bad state, `last` how much of it is left a frame later.
    """

    mean: Floats
    enters: Floats
    misses: Floats
    chance: float
    last: float
    arcs: tuple[Arc, ...]
    peers: int
    sites: tuple[int, ...]
    held: tuple[range, ...]


def tagged_radius(
    system: CompiledSystem, prepared: Prepared, first: Fraction, orders: Sequence[int]
) -> list[float]:
    """Return the spectral radius of second moments, with so many tags at most, in floats.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `analysis.prepare` made of it.
    first
        When frames begin: all packets that may be lost are due then.
    orders
        How many tags there are at most, one after another.
    """
    found = frames(
        *(system, prepared, first),
        lambda count: np.concatenate([np.zeros((1, count), int), np.eye(count, dtype=int)]),
    )
    affine = _affine(found)
    return [_radius(affine, order) for order in orders]


def _affine(found: Frames) -> _Affine:
    """Return the frame as it depends on who is bad, motions that nothing holds back projected out."""
    law = found.laws[0]
    n, peers = found.matrices.shape[-1], len(found.sites) - 1
    own = found.sites[1]
    # The mean of all peers is taken off what moves with them: peers may still change places.
    project = np.eye(n)
    if found.basis.shape[1]:
        places, _ = relative_places(found.basis[:own])
        taken = np.zeros((len(places), n))
        for line, place in enumerate(places):
            taken[line, [start + place for start in found.sites[:-1]]] = 1 / peers
        project -= found.basis @ np.linalg.solve(taken @ found.basis, taken)
    count = len(found.channels)
    held = tuple(found.held[place] for place in range(count))
    chance = law.bad
    moved = project @ found.matrices
    size = np.abs(moved).max(axis=0)
    scale = _alike(balance(size), found, held)
    moved = moved / scale[:, None] * scale
    apart = moved[1:] - moved[0]
    misses = np.zeros((count, len(held[0]), n))
    for place, states in enumerate(held):
        # What is held, less what would have come: how the held states differ from pattern to pattern.
        misses[place] = apart[place, list(states)]
    misses = misses @ (project / scale[:, None] * scale)
    enters = apart @ np.linalg.pinv(misses)
    return _Affine(
        mean=moved[0] + chance * apart.sum(axis=0),
        enters=enters,
        misses=misses,
        chance=chance,
        last=1 - law.p - law.r,
        arcs=tuple((g, h) for *_, g, h in found.channels),
        peers=peers,
        sites=found.sites,
        held=held,
    )


def _alike(scale: Floats, found: Frames, held: Sequence[range]) -> Floats:
    """Return scales that are the same for all peers and channels, powers of two."""
    own = found.sites[1]
    listed = [np.arange(start, start + own) for start in found.sites[:-1]]
    result = np.array(scale)
    for rows in (np.array(listed), np.array([list(states) for states in held])):
        result[rows] = 2.0 ** np.round(np.log2(scale[rows]).mean(axis=0))
    return result


def _radius(of: _Affine, order: int) -> float:
    """Return the largest eigenvalue of all moments of so many tags at most."""
    tags = _Tagged(of, min(order, len(of.arcs)))
    start = tags.shortened(np.stack([np.eye(len(of.mean)) * (not one) for one in tags.sets]))
    return largest(tags.step, start)


class _Tagged:
    """Moments tagged by sets of channels, one of those that permutations take to each other."""

    def __init__(self, of: _Affine, order: int) -> None:
        """Find the sets, and what each one's moments follow from."""
        self.of, self.order = of, order
        self.number = {arc: place for place, arc in enumerate(of.arcs)}
        self._known: dict[Tags, tuple[Tags, tuple[int, ...]]] = {}
        found = dict.fromkeys([()])
        for size in range(1, order + 1):  # each larger set is a smaller one with an arc more
            smaller = [one for one in found if len(one) == size - 1]
            for one in smaller:
                for arc in of.arcs:
                    if arc not in one:
                        found.setdefault(self._canonical(tuple(sorted((*one, arc))))[0])
        self.sets: list[Tags] = list(found)
        self._place = {one: place for place, one in enumerate(self.sets)}
        self._orbits()
        self._neighbours()

    def _canonical(self, tags: Tags) -> tuple[Tags, tuple[int, ...]]:
        """Return the set that stands for all like it, and the permutation that takes that one to this."""
        if tags not in self._known:
            touched = sorted({peer for arc in tags for peer in arc})
            rest = [peer for peer in range(self.of.peers) if peer not in touched]
            best: tuple[Tags, tuple[int, ...]] | None = None
            for chosen in itertools.permutations(touched):
                label = {peer: place for place, peer in enumerate(chosen)}
                renamed = tuple(sorted((label[g], label[h]) for g, h in tags))
                if best is None or renamed < best[0]:
                    best = renamed, (*chosen, *rest)
            assert best is not None
            self._known[tags] = best
        return self._known[tags]

    def _orbits(self) -> None:
        """Number the entries of each set's matrix, those alike that the set's own permutations exchange."""
        n = len(self.of.mean)
        self.entries = np.zeros((len(self.sets), n, n), np.intp)
        first = 0
        sparse = load_pool("scipy.sparse")
        graph = load_pool("scipy.sparse.csgraph")
        every = np.arange(n * n).reshape(n, n)
        for place, tags in enumerate(self.sets):
            touched = sorted({peer for arc in tags for peer in arc})
            rest = [peer for peer in range(self.of.peers) if peer not in touched]
            moves = [every.T]
            for chosen in itertools.permutations(touched):
                label = dict(zip(touched, chosen, strict=True))
                if tuple(sorted((label[g], label[h]) for g, h in tags)) == tags and touched:
                    moves.append(self._moved(every, [label.get(peer, peer) for peer in range(self.of.peers)]))
            for one, other in itertools.pairwise(rest):
                swapped = list(range(self.of.peers))
                swapped[one], swapped[other] = other, one
                moves.append(self._moved(every, swapped))
            rows = np.concatenate([every.ravel()] * len(moves))
            columns = np.concatenate([move.ravel() for move in moves])
            links = sparse.coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(n * n, n * n))
            count, labels = graph.connected_components(links, directed=False)
            self.entries[place] = first + labels.reshape(n, n)
            first += count
        self.size = first
        self.many = np.bincount(self.entries.ravel(), minlength=first)

    def states(self, peers: Sequence[int]) -> Integers:
        """Return which state comes from where when peer i becomes `peers[i]`: new[states] = old."""
        of = self.of
        found = np.zeros(len(of.mean), np.intp)
        own = of.sites[1]
        for peer, to in enumerate(peers):
            found[of.sites[peer] : of.sites[peer] + own] = of.sites[to] + np.arange(own)
        for place, (g, h) in enumerate(of.arcs):
            found[list(of.held[place])] = list(of.held[self.number[peers[g], peers[h]]])
        return found

    def _moved(self, every: Integers, peers: Sequence[int]) -> Integers:
        to = self.states(peers)
        return every[np.ix_(to, to)]

    def _neighbours(self) -> None:
        """Find, of each set and channel, which sets' moments its tagged ones are."""
        of, count = self.of, len(self.of.arcs)
        kappa = (1 - 2 * of.chance) / np.sqrt(of.chance * (1 - of.chance))
        single: list[list[tuple[float, Tags]]] = []
        rows: list[tuple[int, int, float, Tags]] = []
        pairs: list[tuple[int, int, int, float, Tags]] = []

        def tagged(tags: Tags, arc: Arc) -> list[tuple[float, Tags]]:
            if arc in tags:
                return [(1.0, tuple(one for one in tags if one != arc)), (kappa, tags)]
            return [(1.0, tuple(sorted((*tags, arc))))]

        for place, tags in enumerate(self.sets):
            for c, arc in enumerate(of.arcs):
                own = tagged(tags, arc)
                rows += [(place, c, factor, one) for factor, one in own if len(one) <= self.order]
                for d, other in enumerate(of.arcs):
                    if d == c:
                        both = [(1.0, tags), *((kappa * factor, one) for factor, one in own)]
                    else:
                        both = [(f * g, two) for f, one in own for g, two in tagged(one, other)]
                    pairs += [(place, c, d, factor, one) for factor, one in both if len(one) <= self.order]
        del single, count
        self.rows = self._gathered([(place, c, c, factor, one) for place, c, factor, one in rows])
        self.pairs = self._gathered(pairs)

    def _gathered(
        self, listed: Sequence[tuple[int, int, int, float, Tags]]
    ) -> tuple[Integers, Floats, Integers]:
        """Return where terms belong (place, c, d), their factors, and where they come from (place, c, d, how)."""
        perms: dict[tuple[int, ...], int] = getattr(self, "perms", {})
        self.perms = perms
        to, factors, origin = [], [], []
        for place, c, d, factor, tags in listed:
            stands, peers = self._canonical(tags)
            back = {peer: label for label, peer in enumerate(peers)}
            of = [self.number[back[self.of.arcs[one][0]], back[self.of.arcs[one][1]]] for one in (c, d)]
            to.append((place, c, d))
            factors.append(factor)
            origin.append((self._place[stands], *of, perms.setdefault(peers, len(perms))))
        return np.array(to, np.intp), np.array(factors), np.array(origin, np.intp)

    def shortened(self, moments: Floats) -> Floats:
        """Return each number once: the mean of the entries it stands for."""
        return np.bincount(self.entries.ravel(), moments.ravel(), minlength=self.size) / self.many

    def step(self, numbers: Floats) -> Floats:
        """Return all moments a frame later."""
        of = self.of
        moments = numbers[self.entries]
        count, n = len(of.arcs), len(of.mean)
        width = of.misses.shape[1]
        sigma = np.sqrt(of.chance * (1 - of.chance))
        flat = of.misses.reshape(count * width, n)
        missed = (flat @ moments).reshape(len(moments), count, width, n)  # F X
        both = np.einsum("scwn,dvn->scdwv", missed, of.misses)
        to, factors, origin = self.rows
        if not hasattr(self, "columns"):
            self.columns = np.array([np.argsort(self.states(peers)) for peers in self.perms])
        forms = np.zeros((len(moments), count, width, n))
        values = np.take_along_axis(
            missed[origin[:, 0], origin[:, 1]], self.columns[origin[:, 3]][:, None, :], axis=-1
        )
        np.add.at(forms, (to[:, 0], to[:, 1]), factors[:, None, None] * values)
        to, factors, origin = self.pairs
        squares = np.zeros((len(moments), count, count, width, width))
        np.add.at(
            squares,
            (to[:, 0], to[:, 1], to[:, 2]),
            factors[:, None, None] * both[origin[:, 0], origin[:, 1], origin[:, 2]],
        )
        enters = of.enters.transpose(1, 0, 2).reshape(n, count * width)
        crossed = enters @ (forms.reshape(len(moments), count * width, n) @ of.mean.T)
        squares = squares.transpose(0, 1, 3, 2, 4).reshape(len(moments), count * width, count * width)
        moved = of.mean @ moments @ of.mean.T
        moved += sigma * (crossed + crossed.transpose(0, 2, 1)) + sigma**2 * (enters @ squares @ enters.T)
        decays = np.array([of.last ** len(one) for one in self.sets])
        return self.shortened(decays[:, None, None] * moved)
