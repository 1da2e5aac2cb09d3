"""Second moments under burst losses, tagged by channel states: exact for few channels, else an estimate.

Takes: a `LossyFrame`: any few peers, or equal peers on a complete graph.
Gives: `tagged_radius`, `tagged_error`.
Guarantees: with as many tags as there are channels it is exact but for rounding; with fewer, an estimate.
Does not: bound its rounding, or what fewer tags leave out.

A channel's state s is bad with probability b. Let φ = (s − b)/√(b(1 − b)), with mean 0, variance 1, and
autoregression coefficient 1 − p − r per frame. Conditional on the state, the loss indicator ν (see
`loss_patterns`) has mean β φ, and its square has mean λ(1 − λ) + β(1 − 2λ) φ. β is √(b(1 − b)) times the
difference of the loss probabilities in the bad and good state. So moments tagged by a set S of channels, E[x
xᵀ Π_(c ∈ S) φ_c], form a closed linear recursion; squared tags become 1 + κ φ_c. Moments with more than k
tags decay as (1 − p − r)^k and are truncated.

Symmetry of exchangeable peers: sets in one orbit share one matrix, and its entries in one orbit of the set's
stabilizer share one number.
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache, partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.relative_coordinates import relative_rows
from apc.mean_square.copy_error import PeerReadings, largest_error
from apc.mean_square.loss_patterns import Arcs, LossChannel, LossyFrame
from apc.not_supported import NotSupportedError
from apc.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

Terms = list[tuple[float, Arcs]]

# Up to this dimension the matrix of the moment map is formed explicitly.
FEW = 400

# Of larger ones, how many vectors are looked in, for how many eigenvalues, and how often from the start.
VECTORS, TOGETHER, RESTARTED = 60, 4, (40, 1000)

# What is left of a system of equations that is solved in as many vectors, relatively, and how often it starts
# again.
LEFT, RESTARTS = 1e-13, 40


def tagged_radius(of: LossyFrame, order: int) -> float:
    """Return the spectral radius of the second-moment map with at most `order` tags, in floats.

    Parameters
    ----------
    of
        The frame.
    order
        The largest number of tags.
    """
    tags = _tagged(of, min(order, len(of.arcs)))
    return _largest(partial(_step, tags), tags.at_rest(np.eye(len(of.mean))))


def tagged_error(of: LossyFrame, order: int, classes: Sequence[tuple[int, PeerReadings]]) -> float:
    """Return the largest copy error in m, with at most `order` tags.

    Parameters
    ----------
    of, order
        As for `tagged_radius`.
    classes
        The signals that each peer receives, as for `copy_error.moments_error`.
    """
    starts = zip(of.offsets, classes, strict=False)
    pushes = [start + state for start, (_, peer) in starts for state in peer.input_slots]
    added = np.zeros((len(of.mean),) * 2)
    added[pushes, pushes] = of.scale[pushes] ** -2.0
    tags = _tagged(of, min(order, len(of.arcs)))
    step = partial(_step, tags)
    lasting = _settled(step, step(tags.at_rest(added)))
    moments = (added + lasting[tags.entries[0]]) * np.outer(of.scale, of.scale)
    inner = relative_rows(relative_rows(moments, of.at).T, of.at)
    return largest_error(inner, of.at, of.offsets, classes)


@dataclass(frozen=True, slots=True, eq=False)
class _Tagged:
    """Second moments tagged by sets of channels, one set for each orbit under peer permutations.

    `entries` (sets, n, n) numbers the entries of each set's matrix, equal entries once; `many` is the count;
    `decays` (sets,) are the decay factors of the tags per frame. Sparse matrices map the moments of the
    representative sets to the expectations of ν F X (`first`: set, term; its rows `origin`: set, term, with
    columns permuted by `columns`, for each permutation of peers) and of ν ν F X Fᵀ for two terms (`second`:
    set, term, term).
    """

    of: LossyFrame
    entries: Integers
    many: Integers
    decays: Floats
    first: Any  # scipy.sparse.csr_matrix
    origin: Integers
    columns: Integers
    second: Any  # scipy.sparse.csr_matrix

    def shortened(self, moments: Floats) -> Floats:
        """Return each number once: the mean of the entries that it represents."""
        size = len(self.many)
        values = np.bincount(self.entries.ravel(), moments.ravel(), minlength=size) / self.many
        return np.asarray(values)

    def at_rest(self, moments: Floats) -> Floats:
        """Return the indices of the untagged moments (n, n)."""
        tagged = np.zeros(self.entries.shape)
        tagged[0] = moments
        return self.shortened(tagged)


@lru_cache(maxsize=1 << 16)
def _named(tags: Arcs, peers: int) -> tuple[Arcs, tuple[int, ...]]:
    """Return the representative of a set's orbit, and the permutation of peers that yields the set."""
    touched, rest = _touched(tags, peers)
    return min(
        (_renamed(tags, {peer: index for index, peer in enumerate(chosen)}), (*chosen, *rest))
        for chosen in itertools.permutations(touched)
    )


def _touched(tags: Arcs, peers: int) -> tuple[list[int], list[int]]:
    """Return the peers that tags name, and the rest."""
    touched = sorted({peer for g, h, _ in tags for peer in (g, h)})
    return touched, [peer for peer in range(peers) if peer not in touched]


def _renamed(tags: Arcs, label: Mapping[int, int]) -> Arcs:
    return tuple(sorted((label[g], label[h], link) for g, h, link in tags))


def _times(terms: Terms, arc: LossChannel, plain: float, tagged: float, kappa: float) -> Terms:
    """Return `plain` + `tagged` φ, φ being of an arc, times moments so tagged."""
    result = [(factor * plain, tags) for factor, tags in terms if plain]
    for factor, tags in terms:
        if arc in tags:
            result.append((factor * tagged, tuple(tag for tag in tags if tag != arc)))
            result.append((factor * tagged * kappa, tags))
        else:
            result.append((factor * tagged, tuple(sorted((*tags, arc)))))
    return result


def _tagged(of: LossyFrame, order: int) -> _Tagged:
    """Build all sets of at most `order` tags, and the terms of the recursion of each set's moments."""

    def named(tags: Arcs) -> tuple[Arcs, tuple[int, ...]]:
        return _named(tags, of.peers) if of.interchangeable else (tags, tuple(range(of.peers)))

    layers: list[dict[Arcs, None]] = [{(): None}]
    for _ in range(order):  # each larger set is a smaller one with an arc more
        larger = ((*layer, arc) for layer in layers[-1] for arc in of.arcs if arc not in layer)
        layers.append(dict.fromkeys(named(tuple(sorted(tags)))[0] for tags in larger))
    sets = tuple(tags for layer in layers for tags in layer)
    entries = _orbits(of, sets)
    laws = dict(zip(of.arcs, of.laws, strict=True))
    spread = {arc: math.sqrt(law.bad * (1 - law.bad)) for arc, law in laws.items()}
    kappa = {arc: (1 - 2 * laws[arc].bad) / size if size else 0.0 for arc, size in spread.items()}

    def times(tags: Arcs, *terms: Arcs) -> Terms:
        """Return the conditional mean of tagged moments times the loss indicators of one or two terms."""
        result = [(1.0, tags)]
        for arc in sorted(set().union(*terms)):
            law = laws[arc]
            tagged = (law.one_minus_h - law.one_minus_k) * spread[arc]
            lost, twice = law.mean_loss, all(arc in term for term in terms) and len(terms) > 1
            noise = (lost * (1 - lost), tagged * (1 - 2 * lost)) if twice else (0.0, tagged)
            result = _times(result, arc, *noise, kappa[arc])
        return [(factor, tags) for factor, tags in result if len(tags) <= order]

    index = {tags: number for number, tags in enumerate(sets)}
    number = {term: t for t, term in enumerate(of.terms)}
    count = len(of.terms)
    permutations: dict[tuple[int, ...], int] = {}
    origin: list[tuple[int, int, int]] = []
    first: list[tuple[float, int, int]] = []
    second: list[tuple[float, int, int]] = []
    for (s, tags), (t, term) in itertools.product(enumerate(sets), enumerate(of.terms)):
        for factor, tagged in times(tags, term):
            neutral, peers = named(tagged)
            label = {peer: name for name, peer in enumerate(peers)}
            first.append((factor, s * count + t, len(origin)))
            whose = permutations.setdefault(peers, len(permutations))
            origin.append((index[neutral], number[_renamed(term, label)], whose))
        for u, other in enumerate(of.terms):
            for factor, tagged in times(tags, term, other):
                neutral, peers = named(tagged)
                label = {peer: name for name, peer in enumerate(peers)}
                to = [number[_renamed(item, label)] for item in (term, other)]
                source = (index[neutral] * count + to[0]) * count + to[1]
                second.append((factor, (s * count + t) * count + u, source))
    return _Tagged(
        of=of,
        entries=entries,
        many=np.bincount(entries.ravel()),
        decays=np.array([math.prod(1 - laws[arc].p - laws[arc].r for arc in tags) for tags in sets]),
        first=_sparse(first, len(sets) * count, len(origin)),
        origin=np.array(origin, np.intp),
        columns=np.array([np.argsort(_states(of, peers)) for peers in permutations]),
        second=_sparse(second, len(sets) * count**2, len(sets) * count**2),
    )


def _sparse(terms: Sequence[tuple[float, int, int]], rows: int, columns: int) -> Any:
    """Return a sparse matrix of (entry, row, column)."""
    entries, row, column = zip(*terms, strict=True)
    return load_pool("scipy.sparse").csr_matrix((entries, (row, column)), shape=(rows, columns))


def _orbits(of: LossyFrame, sets: Sequence[Arcs]) -> Integers:
    """Number the entries of each set's matrix, with one number for each orbit of the set's stabilizer."""
    sparse, graph = load_pool("scipy.sparse"), load_pool("scipy.sparse.csgraph")
    n, first = len(of.mean), 0
    indices = np.zeros((len(sets), n, n), np.intp)
    every = np.arange(n * n).reshape(n, n)
    for index, tags in enumerate(sets):
        touched, rest = _touched(tags, of.peers)
        changes: list[Mapping[int, int]] = []
        if of.interchangeable:
            labels = (dict(zip(touched, chosen, strict=True)) for chosen in itertools.permutations(touched))
            changes += [label for label in labels if _renamed(tags, label) == tags]
            changes += [{number: other, other: number} for number, other in itertools.pairwise(rest)]
        moves = [every.T]
        for change in changes:
            to = _states(of, [change.get(peer, peer) for peer in range(of.peers)])
            moves.append(every[np.ix_(to, to)])
        rows = np.concatenate([every.ravel()] * len(moves))
        columns = np.concatenate([move.ravel() for move in moves])
        interchangeable = sparse.coo_matrix(
            (np.ones(len(rows), np.int8), (rows, columns)), shape=(n * n, n * n)
        )
        count, labels_of = graph.connected_components(interchangeable, directed=False)
        indices[index] = first + labels_of.reshape(n, n)
        first += count
    return indices


def _states(of: LossyFrame, peers: Sequence[int]) -> Integers:
    """Return the permutation of states when peer i becomes `peers[i]`: new[states] = old."""
    indices = np.arange(len(of.mean))
    number = {arc: index for index, arc in enumerate(of.arcs)}
    for peer, to in enumerate(peers):
        if peer != to:
            indices[of.offsets[peer] : of.offsets[peer + 1]] = np.arange(of.offsets[to], of.offsets[to + 1])
    for index, (g, h, link) in enumerate(of.arcs):
        if (peers[g], peers[h]) != (g, h):
            indices[of.stored[index]] = of.stored[number[peers[g], peers[h], link]]
    return indices


def _step(tags: _Tagged, numbers: Floats) -> Floats:
    """Return all moments a frame later."""
    of = tags.of
    moments = numbers[tags.entries]
    many, (count, width, n) = len(moments), of.reception_errors.shape
    flat = of.reception_errors.reshape(count * width, n)
    missed = flat @ moments  # F X
    both = (missed @ flat.T).reshape(many, count, width, count, width).transpose(0, 1, 3, 2, 4)
    rows = missed.reshape(many, count, width, n)[tags.origin[:, 0], tags.origin[:, 1]]
    rows = np.take_along_axis(rows, tags.columns[tags.origin[:, 2]][:, None, :], axis=-1)
    forms = (tags.first @ rows.reshape(len(rows), width * n)).reshape(many, count * width, n)
    squares = tags.second @ both.reshape(many * count**2, width**2)
    squares = squares.reshape(many, count, count, width, width).transpose(0, 1, 3, 2, 4)
    squares = squares.reshape(many, count * width, count * width)
    enters = of.input.transpose(1, 0, 2).reshape(n, count * width)
    crossed = enters @ (forms @ of.mean.T)
    moved = of.mean @ moments @ of.mean.T + crossed + crossed.transpose(0, 2, 1)
    return tags.shortened(tags.decays[:, None, None] * (moved + enters @ squares @ enters.T))


def _largest(step: Callable[[Floats], Floats], start: Floats) -> float:
    """Return the largest eigenvalue of a map that leaves a cone of moments invariant, in floats.

    Parameters
    ----------
    step
        The map of vectors (n,).
    start
        Moments (n,) inside the cone.

    Notes
    -----
    The eigenvalue is real, and no other is larger in magnitude. A few are asked for: alone, the first that an
    iteration finds may be one near to it. NaN where these don't come out.
    """
    if start.size <= FEW:
        return float(np.linalg.eigvals(np.array([step(column) for column in np.eye(start.size)])).real.max())
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((start.size, start.size), matvec=step, dtype=np.float64)
    for restarts in RESTARTED:
        # Those that have come out where others have not may be any.
        with suppress(linalg.ArpackNoConvergence):
            values = linalg.eigs(
                operator,
                TOGETHER,
                which="LR",
                v0=start,
                ncv=VECTORS,
                maxiter=restarts,
                tol=1e-13,
                return_eigenvectors=False,
            )
            return float(values.real.max())
    return np.nan


def _settled(step: Callable[[Floats], Floats], added: Floats) -> Floats:
    """Return the sum of the series of `step` applied to an input added once per frame (n,).

    Parameters
    ----------
    step
        The map of vectors (n,), of a spectral radius below 1.
    added
        The input (n,).
    """
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((added.size,) * 2, matvec=lambda x: x - step(x), dtype=np.float64)
    result, open_end = linalg.gmres(operator, added, rtol=LEFT, atol=0.0, restart=VECTORS, maxiter=RESTARTS)
    if open_end:
        raise NotSupportedError("its iteration did not come to an end")
    return np.asarray(result)
