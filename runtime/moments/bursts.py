"""Second moments under bursts of losses, tag by tag: exact for few channels, an estimate for many.

Takes: a scene of equal peers that all hear each other, or any few, whose receivers hold what they miss.
Gives: `Affine`, `affine`; `tagged_radius`, `tagged_error`.
Guarantees: with as many tags as there are channels it is exact but for rounding; with fewer, an estimate.
Does not: bound its rounding, or what fewer tags leave out.

A channel's state is bad with probability b; φ = (s − b)/√(b(1 − b)) has mean 0, variance 1, and is on the
mean 1 − p − r times itself a frame later. What moves in a frame is affine in all states, A + Σ_c φ_c U_c
F_c, with F_c how far what is held is from what is sent. So moments tagged by a set S of channels, E[x xᵀ
Π_(c ∈ S) φ_c], move by one another, tags that are squared becoming 1 + κ φ_c; those of more than k tags
decay as (1 − p − r)^k and are left out.

Peers that can change places: sets that a permutation takes to each other have one matrix between them, and
entries of it that permutations of the set to itself exchange are one number.
"""

from __future__ import annotations

import itertools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.matrix_norms import balance
from apc.eigen.relative import Relative, relative_places, relative_rows
from apc.frame.radius import value_of
from apc.moments.copies_apart import Peer, largest_error
from apc.moments.held import Chance, HeldLoop
from apc.moments.patterns import largest, settled
from apc.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

# An arc of who hears whom: (receiver, sender).
Arc = tuple[int, int]
Tags = tuple[Arc, ...]
Terms = list[tuple[float, Tags]]


@dataclass(frozen=True, slots=True, eq=False)
class Affine:
    """A frame as it is affine in the channels' states: A, and U_c F_c of each (C, n, m), (C, m, n).

    `chance` is that of a bad state, `last` how much of it is left a frame later. States are divided by
    `scale` (n,); those of each peer start at `offsets`, those that each channel holds are `held`.
    """

    mean: Floats
    enters: Floats
    misses: Floats
    chance: float
    last: float
    arcs: tuple[Arc, ...]
    offsets: tuple[int, ...]
    held: tuple[tuple[int, ...], ...]
    scale: Floats
    at: Relative

    @property
    def peers(self) -> int:
        """How many peers there are."""
        return len(self.offsets) - 1


def affine(held: HeldLoop, chances: Sequence[Chance]) -> Affine:
    """Return the frame as it depends on who is bad, motions that nothing holds back projected out.

    Parameters
    ----------
    held, chances
        Of `held.every_channel`, of equal peers that all hear each other.
    """
    law = chances[0].law
    f, g, s, e = (value_of(matrix) for matrix in (held.f, held.g, held.s, held.e))
    n, size, peers = len(f), held.offsets[1], len(held.offsets) - 1
    # The mean of all peers is taken off what moves with them: peers may still change places.
    basis, project = np.zeros((n, len(held.at.held))), np.eye(n)
    basis[held.at.held], basis[held.at.rest] = np.eye(len(held.at.held)), held.at.weights
    if basis.shape[1]:
        places, _ = relative_places(basis[:size])
        taken = np.zeros((len(places), n))
        for line, place in enumerate(places):
            taken[line, [start + place for start in held.offsets[:-1]]] = 1 / peers
        project -= basis @ np.linalg.solve(taken @ basis, taken)
    states = [[place for ear in chance.ears for place in held.places[ear]] for chance in chances]
    enters = np.stack([project @ g[:, list(chance.ears)] for chance in chances])
    misses = np.stack([(e - s)[list(chance.ears)] @ project for chance in chances])
    mean = project @ (f + g @ s) @ project
    each = np.abs(enters) @ np.abs(misses)
    scale = balance(np.abs(mean) + each.max(axis=0))
    # The same for all peers and channels, powers of two.
    for rows in (np.arange(size) + np.array(held.offsets[:-1])[:, None], np.array(states)):
        scale[rows] = 2.0 ** np.round(np.log2(scale[rows]).mean(axis=0))
    enters, misses = enters / scale[:, None], misses * scale
    return Affine(
        mean=mean / scale[:, None] * scale + law.bad * (enters @ misses).sum(axis=0),
        enters=enters,
        misses=misses,
        chance=law.bad,
        last=1 - law.p - law.r,
        arcs=tuple((chance.receiver, chance.sender) for chance in chances),
        offsets=held.offsets,
        held=tuple(map(tuple, states)),
        scale=scale,
        at=held.at,
    )


def tagged_radius(of: Affine, order: int) -> float:
    """Return the spectral radius of second moments, with so many tags at most, in floats.

    Parameters
    ----------
    of
        The frame.
    order
        How many tags there are at most.
    """
    tags = _tagged(of, min(order, len(of.arcs)))
    start = np.stack([np.eye(len(of.mean)) * (not pairs) for pairs in tags.sets])
    return largest(partial(_step, tags), tags.shortened(start))


def tagged_error(of: Affine, order: int, classes: Sequence[tuple[int, Peer]]) -> float:
    """Return the largest error of copies in m, with so many tags at most.

    Parameters
    ----------
    of, order
        As for `tagged_radius`.
    classes
        What each peer got, as for `errors.moments_error`.
    """
    starts = zip(of.offsets, classes, strict=False)
    pushes = [start + state for start, (_, peer) in starts for state in peer.drawn]
    added = np.zeros((len(of.mean),) * 2)
    added[pushes, pushes] = of.scale[pushes] ** -2.0
    tags = _tagged(of, min(order, len(of.arcs)))
    step = partial(_step, tags)
    lasting = settled(step, step(tags.shortened(np.stack([added * (not pairs) for pairs in tags.sets]))))
    moments = (added + lasting[tags.entries[0]]) * np.outer(of.scale, of.scale)
    inner = relative_rows(relative_rows(moments, of.at).T, of.at)
    return largest_error(inner, of.at, of.offsets, classes)


@dataclass(frozen=True, slots=True, eq=False)
class _Tagged:
    """Moments tagged by sets of channels, one of those that permutations take to each other.

    `entries` (sets, n, n) numbers the entries of each set's matrix, those alike once; `many` counts them.
    What a channel's state tags of F X (`first`: set, channel), of rows (`origin`: set, channel, whose columns
    stand as `columns` says, for each of the `permutations` of peers), and two channels' of F X Fᵀ (`second`:
    set, channel, channel), follow from those of the sets that stand for them: sparse matrices.
    """

    of: Affine
    sets: tuple[Tags, ...]
    entries: Integers
    many: Integers
    first: Any  # scipy.sparse.csr_matrix
    origin: Integers
    permutations: tuple[tuple[int, ...], ...]
    columns: Integers
    second: Any  # scipy.sparse.csr_matrix

    def shortened(self, moments: Floats) -> Floats:
        """Return each number once: the mean of the entries it stands for."""
        size = len(self.many)
        values = np.bincount(self.entries.ravel(), moments.ravel(), minlength=size) / self.many
        return np.asarray(values)


@cache
def _named(tags: Tags, peers: int) -> tuple[Tags, tuple[int, ...]]:
    """Return the set that stands for all like some tags, and which peers its peers 0, 1, … are in these."""
    touched, rest = _touched(tags, peers)
    return min(
        (_renamed(tags, {peer: place for place, peer in enumerate(chosen)}), (*chosen, *rest))
        for chosen in itertools.permutations(touched)
    )


def _touched(tags: Tags, peers: int) -> tuple[list[int], list[int]]:
    """Return the peers that tags name, and the rest."""
    touched = sorted({peer for arc in tags for peer in arc})
    return touched, [peer for peer in range(peers) if peer not in touched]


def _renamed(tags: Tags, label: Mapping[int, int]) -> Tags:
    return tuple(sorted((label[g], label[h]) for g, h in tags))


def _tagged(of: Affine, order: int) -> _Tagged:
    """Find the sets of so many tags at most, and what each one's moments follow from."""
    layers: list[dict[Tags, None]] = [{(): None}]
    for _ in range(order):  # each larger set is a smaller one with an arc more
        larger = ((*layer, arc) for layer in layers[-1] for arc in of.arcs if arc not in layer)
        layers.append(dict.fromkeys(_named(tuple(sorted(tags)), of.peers)[0] for tags in larger))
    sets = tuple(pairs for layer in layers for pairs in layer)
    entries = _orbits(of, sets)
    kappa = (1 - 2 * of.chance) / np.sqrt(of.chance * (1 - of.chance))

    def times(terms: Terms, arc: Arc) -> Terms:
        """Return what moments so tagged are, tagged by an arc more."""
        pairs = []
        for factor, tags in terms:
            if arc in tags:
                pairs += [(factor, tuple(tag for tag in tags if tag != arc)), (factor * kappa, tags)]
            else:
                pairs.append((factor, tuple(sorted((*tags, arc)))))
        return pairs

    place = {pairs: number for number, pairs in enumerate(sets)}
    number = {arc: c for c, arc in enumerate(of.arcs)}
    count = len(of.arcs)
    permutations: dict[tuple[int, ...], int] = {}
    origin: list[tuple[int, int, int]] = []
    first: list[tuple[float, int, int]] = []
    second: list[tuple[float, int, int]] = []
    for s, tags in enumerate(sets):
        for c, arc in enumerate(of.arcs):
            once = times([(1.0, tags)], arc)
            for factor, pairs in once:
                if len(pairs) <= order:
                    stands, peers = _named(pairs, of.peers)
                    (pair,) = _renamed((arc,), {peer: label for label, peer in enumerate(peers)})
                    first.append((factor, s * count + c, len(origin)))
                    origin.append(
                        (place[stands], number[pair], permutations.setdefault(peers, len(permutations)))
                    )
            for d, other in enumerate(of.arcs):
                for factor, pairs in times(once, other):
                    if len(pairs) <= order:
                        stands, peers = _named(pairs, of.peers)
                        label = {peer: name for name, peer in enumerate(peers)}
                        to = [number[label[g], label[h]] for g, h in (arc, other)]
                        source = (place[stands] * count + to[0]) * count + to[1]
                        second.append((factor, (s * count + c) * count + d, source))
    return _Tagged(
        of=of,
        sets=sets,
        entries=entries,
        many=np.bincount(entries.ravel()),
        first=_sparse(first, len(sets) * count, len(origin)),
        origin=np.array(origin, np.intp),
        permutations=tuple(permutations),
        columns=np.array([np.argsort(_states(of, peers)) for peers in permutations]),
        second=_sparse(second, len(sets) * count**2, len(sets) * count**2),
    )


def _sparse(terms: Sequence[tuple[float, int, int]], rows: int, columns: int) -> Any:
    """Return a sparse matrix of (entry, row, column)."""
    entries, row, column = zip(*terms, strict=True)
    return load_pool("scipy.sparse").csr_matrix((entries, (row, column)), shape=(rows, columns))


def _orbits(of: Affine, sets: Sequence[Tags]) -> Integers:
    """Number the entries of each set's matrix, those alike that the set's own permutations exchange."""
    sparse, graph = load_pool("scipy.sparse"), load_pool("scipy.sparse.csgraph")
    n, first = len(of.mean), 0
    places = np.zeros((len(sets), n, n), np.intp)
    every = np.arange(n * n).reshape(n, n)
    for place, tags in enumerate(sets):
        touched, rest = _touched(tags, of.peers)
        moves = [every.T]
        changes = [
            label
            for chosen in itertools.permutations(touched)
            if _renamed(tags, label := dict(zip(touched, chosen, strict=True))) == tags
        ]
        changes += [{number: other, other: number} for number, other in itertools.pairwise(rest)]
        for change in changes:
            to = _states(of, [change.get(peer, peer) for peer in range(of.peers)])
            moves.append(every[np.ix_(to, to)])
        rows = np.concatenate([every.ravel()] * len(moves))
        columns = np.concatenate([move.ravel() for move in moves])
        alike = sparse.coo_matrix((np.ones(len(rows), np.int8), (rows, columns)), shape=(n * n, n * n))
        count, labels = graph.connected_components(alike, directed=False)
        places[place] = first + labels.reshape(n, n)
        first += count
    return places


def _states(of: Affine, peers: Sequence[int]) -> Integers:
    """Return which state comes from where when peer i becomes `peers[i]`: new[states] = old."""
    places = np.zeros(len(of.mean), np.intp)
    number = {arc: place for place, arc in enumerate(of.arcs)}
    offset = of.offsets[1]
    for peer, to in enumerate(peers):
        places[of.offsets[peer] : of.offsets[peer] + offset] = of.offsets[to] + np.arange(offset)
    for place, (g, h) in enumerate(of.arcs):
        places[list(of.held[place])] = list(of.held[number[peers[g], peers[h]]])
    return places


def _step(tags: _Tagged, numbers: Floats) -> Floats:
    """Return all moments a frame later."""
    of = tags.of
    moments = numbers[tags.entries]
    many, (count, width, n) = len(moments), of.misses.shape
    sigma = np.sqrt(of.chance * (1 - of.chance))
    flat = of.misses.reshape(count * width, n)
    missed = flat @ moments  # F X
    both = (missed @ flat.T).reshape(many, count, width, count, width).transpose(0, 1, 3, 2, 4)
    rows = missed.reshape(many, count, width, n)[tags.origin[:, 0], tags.origin[:, 1]]
    rows = np.take_along_axis(rows, tags.columns[tags.origin[:, 2]][:, None, :], axis=-1)
    forms = (tags.first @ rows.reshape(len(rows), width * n)).reshape(many, count * width, n)
    squares = tags.second @ both.reshape(many * count**2, width**2)
    squares = squares.reshape(many, count, count, width, width).transpose(0, 1, 3, 2, 4)
    squares = squares.reshape(many, count * width, count * width)
    enters = of.enters.transpose(1, 0, 2).reshape(n, count * width)
    crossed = enters @ (forms @ of.mean.T)
    moved = of.mean @ moments @ of.mean.T
    moved += sigma * (crossed + crossed.transpose(0, 2, 1)) + sigma**2 * (enters @ squares @ enters.T)
    decays = np.array([of.last ** len(pairs) for pairs in tags.sets])
    return tags.shortened(decays[:, None, None] * moved)
