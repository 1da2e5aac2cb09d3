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

from apc.extensions.loss_models.loss_patterns import Arcs, LossChannel, LossyFrame
from apc.mean_square.copy_error import PeerReadings, largest_error
from apc.spectrum.relative_coordinates import relative_rows
from apc.support.not_supported import NotSupportedError
from apc.support.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.intp]

Terms = list[tuple[float, Arcs]]

# Up to this dimension the matrix of the moment map is formed explicitly.
FEW = 400

# Arnoldi's method above this dimension: number of vectors, of eigenvalues, and of restarts.
VECTORS, TOGETHER, RESTARTED = 60, 4, (40, 1000)

# The relative residual of a system of equations solved by GMRES, and its number of restarts.
RELATIVE_RESIDUAL, RESTARTS = 1e-13, 40


def tagged_radius(lossy_frame: LossyFrame, order: int) -> float:
    """Return the growth factor of second moments per frame with at most `order` tags, in floats.

    Parameters
    ----------
    lossy_frame
        The frame.
    order
        The largest number of tags.
    """
    tagged = _tagged_moments(lossy_frame, min(order, len(lossy_frame.arcs)))
    return _largest(partial(_step, tagged), tagged.untagged_moments(np.eye(len(lossy_frame.mean))))


def tagged_error(lossy_frame: LossyFrame, order: int, classes: Sequence[tuple[int, PeerReadings]]) -> float:
    """Return the largest copy error in m, with at most `order` tags.

    Parameters
    ----------
    lossy_frame, order
        As for `tagged_radius`.
    classes
        The readings of each peer, as for `copy_error.moments_error`.
    """
    peer_starts = zip(lossy_frame.offsets, classes, strict=False)
    force_states = [start + state for start, (_, peer) in peer_starts for state in peer.input_slots]
    inputs = np.zeros((len(lossy_frame.mean),) * 2)
    inputs[force_states, force_states] = lossy_frame.scale[force_states] ** -2.0
    tagged = _tagged_moments(lossy_frame, min(order, len(lossy_frame.arcs)))
    step = partial(_step, tagged)
    later_moments = _series_sum(step, step(tagged.untagged_moments(inputs)))
    moments = (inputs + later_moments[tagged.entries[0]]) * np.outer(lossy_frame.scale, lossy_frame.scale)
    inner = relative_rows(relative_rows(moments, lossy_frame.coordinates).T, lossy_frame.coordinates)
    return largest_error(inner, lossy_frame.coordinates, lossy_frame.offsets, classes)


@dataclass(frozen=True, slots=True, eq=False)
class _TaggedMoments:
    """Second moments tagged by sets of channels, one set for each orbit under peer permutations.

    `entries` (sets, n, n) numbers the entries of each set's matrix, equal entries once; `counts` are the
    numbers of entries; `decays` (sets,) are the decay factors of the tags per frame. Sparse matrices map the
    moments of the representative sets to the expectations of ν F X (`first`: set, term; its rows `origin`:
    set, term, with columns permuted by `columns`, for each permutation of peers) and of ν ν F X Fᵀ for two
    terms (`second`: set, term, term).
    """

    lossy_frame: LossyFrame
    entries: Integers
    counts: Integers
    decays: Floats
    first: Any  # scipy.sparse.csr_matrix
    origin: Integers
    columns: Integers
    second: Any  # scipy.sparse.csr_matrix

    def averaged(self, moments: Floats) -> Floats:
        """Return each distinct entry once: the mean of the entries with its number."""
        size = len(self.counts)
        values = np.bincount(self.entries.ravel(), moments.ravel(), minlength=size) / self.counts
        return np.asarray(values)

    def untagged_moments(self, moments: Floats) -> Floats:
        """Return moments (n, n) without tags as numbered entries; all tagged moments are 0."""
        tagged = np.zeros(self.entries.shape)
        tagged[0] = moments
        return self.averaged(tagged)


@lru_cache(maxsize=1 << 16)
def _representative(tags: Arcs, peers: int) -> tuple[Arcs, tuple[int, ...]]:
    """Return the representative of a set's orbit, and the permutation of peers that maps the set to it."""
    named_peers, other_peers = _named_peers(tags, peers)
    return min(
        (_renamed(tags, {peer: index for index, peer in enumerate(chosen)}), (*chosen, *other_peers))
        for chosen in itertools.permutations(named_peers)
    )


def _named_peers(tags: Arcs, peers: int) -> tuple[list[int], list[int]]:
    """Return the peers in a set of tags, and all other peers."""
    named = sorted({peer for g, h, _ in tags for peer in (g, h)})
    return named, [peer for peer in range(peers) if peer not in named]


def _renamed(tags: Arcs, label: Mapping[int, int]) -> Arcs:
    """Return a set of tags with its peers renumbered."""
    return tuple(sorted((label[g], label[h], link) for g, h, link in tags))


def _times_factor(terms: Terms, arc: LossChannel, plain: float, tagged: float, kappa: float) -> Terms:
    """Return tagged terms times `plain` + `tagged` φ, where φ is the tag of an arc.

    Parameters
    ----------
    terms
        The terms: factors with sets of tags.
    arc, plain, tagged
        The arc, and the two factors.
    kappa
        κ of φ² = 1 + κ φ.
    """
    result = [(factor * plain, tags) for factor, tags in terms if plain]
    for factor, tags in terms:
        if arc in tags:
            result.append((factor * tagged, tuple(tag for tag in tags if tag != arc)))
            result.append((factor * tagged * kappa, tags))
        else:
            result.append((factor * tagged, tuple(sorted((*tags, arc)))))
    return result


def _tagged_moments(lossy_frame: LossyFrame, order: int) -> _TaggedMoments:
    """Return the recursion of second moments with at most `order` tags: all sets of tags, and the terms
    of each.
    """

    def representative(tags: Arcs) -> tuple[Arcs, tuple[int, ...]]:
        """Return the representative of a set, and the permutation that maps the set to it."""
        return (
            _representative(tags, lossy_frame.peers)
            if lossy_frame.interchangeable
            else (tags, tuple(range(lossy_frame.peers)))
        )

    layers: list[dict[Arcs, None]] = [{(): None}]
    for _ in range(order):  # each larger set is a smaller one with one more arc
        larger = ((*layer, arc) for layer in layers[-1] for arc in lossy_frame.arcs if arc not in layer)
        layers.append(dict.fromkeys(representative(tuple(sorted(tags)))[0] for tags in larger))
    sets = tuple(tags for layer in layers for tags in layer)
    entries = _entry_orbits(lossy_frame, sets)
    laws = dict(zip(lossy_frame.arcs, lossy_frame.laws, strict=True))
    spread = {arc: math.sqrt(law.bad * (1 - law.bad)) for arc, law in laws.items()}
    kappa = {arc: (1 - 2 * laws[arc].bad) / size if size else 0.0 for arc, size in spread.items()}

    def mean_terms(tags: Arcs, *terms: Arcs) -> Terms:
        """Return the conditional mean of tagged moments times the loss indicators of one or two terms."""
        result = [(1.0, tags)]
        for arc in sorted(set().union(*terms)):
            law = laws[arc]
            tagged = (law.one_minus_h - law.one_minus_k) * spread[arc]
            lost, twice = law.mean_loss, all(arc in term for term in terms) and len(terms) > 1
            noise = (lost * (1 - lost), tagged * (1 - 2 * lost)) if twice else (0.0, tagged)
            result = _times_factor(result, arc, *noise, kappa[arc])
        return [(factor, tagged_arcs) for factor, tagged_arcs in result if len(tagged_arcs) <= order]

    index = {tags: number for number, tags in enumerate(sets)}
    number = {term: t for t, term in enumerate(lossy_frame.terms)}
    count = len(lossy_frame.terms)
    permutations: dict[tuple[int, ...], int] = {}
    origin: list[tuple[int, int, int]] = []
    first: list[tuple[float, int, int]] = []
    second: list[tuple[float, int, int]] = []
    for (s, tags), (t, term) in itertools.product(enumerate(sets), enumerate(lossy_frame.terms)):
        for factor, tagged in mean_terms(tags, term):
            neutral, peers = representative(tagged)
            label = {peer: name for name, peer in enumerate(peers)}
            first.append((factor, s * count + t, len(origin)))
            permutation = permutations.setdefault(peers, len(permutations))
            origin.append((index[neutral], number[_renamed(term, label)], permutation))
        for u, other_term in enumerate(lossy_frame.terms):
            for factor, tagged in mean_terms(tags, term, other_term):
                neutral, peers = representative(tagged)
                label = {peer: name for name, peer in enumerate(peers)}
                term_numbers = [number[_renamed(item, label)] for item in (term, other_term)]
                source = (index[neutral] * count + term_numbers[0]) * count + term_numbers[1]
                second.append((factor, (s * count + t) * count + u, source))
    return _TaggedMoments(
        lossy_frame=lossy_frame,
        entries=entries,
        counts=np.bincount(entries.ravel()),
        decays=np.array([math.prod(1 - laws[arc].p - laws[arc].r for arc in tags) for tags in sets]),
        first=_sparse(first, len(sets) * count, len(origin)),
        origin=np.array(origin, np.intp),
        columns=np.array([np.argsort(_state_permutation(lossy_frame, peers)) for peers in permutations]),
        second=_sparse(second, len(sets) * count**2, len(sets) * count**2),
    )


def _sparse(terms: Sequence[tuple[float, int, int]], rows: int, columns: int) -> Any:
    """Return a sparse matrix of (entry, row, column)."""
    entries, row, column = zip(*terms, strict=True)
    return load_pool("scipy.sparse").csr_matrix((entries, (row, column)), shape=(rows, columns))


def _entry_orbits(lossy_frame: LossyFrame, sets: Sequence[Arcs]) -> Integers:
    """Return the index (sets, n, n) of each entry of the covariances, equal for entries that are equal.

    Each set of lost arcs has a covariance (n, n) of the states of all peers. Exchanges of peers that leave
    the set unchanged leave its covariance unchanged: they permute its entries, and entries that they map to
    each other (an orbit) are equal. The covariance is symmetric as well. An orbit has one index over all
    sets.

    Parameters
    ----------
    lossy_frame
        The model over one frame.
    sets
        The sets of lost arcs.
    """
    sparse, graph = load_pool("scipy.sparse"), load_pool("scipy.sparse.csgraph")
    n, first = len(lossy_frame.mean), 0
    indices = np.zeros((len(sets), n, n), np.intp)
    entry_indices = np.arange(n * n).reshape(n, n)
    for index, tags in enumerate(sets):
        named_peers, other_peers = _named_peers(tags, lossy_frame.peers)
        changes: list[Mapping[int, int]] = []
        if lossy_frame.interchangeable:
            labels = (
                dict(zip(named_peers, chosen, strict=True)) for chosen in itertools.permutations(named_peers)
            )
            changes += [label for label in labels if _renamed(tags, label) == tags]
            changes += [
                {number: next_peer, next_peer: number}
                for number, next_peer in itertools.pairwise(other_peers)
            ]
        moves = [entry_indices.T]
        for change in changes:
            states = _state_permutation(
                lossy_frame, [change.get(peer, peer) for peer in range(lossy_frame.peers)]
            )
            moves.append(entry_indices[np.ix_(states, states)])
        rows = np.concatenate([entry_indices.ravel()] * len(moves))
        columns = np.concatenate([move.ravel() for move in moves])
        interchangeable = sparse.coo_matrix(
            (np.ones(len(rows), np.int8), (rows, columns)), shape=(n * n, n * n)
        )
        count, labels_of = graph.connected_components(interchangeable, directed=False)
        indices[index] = first + labels_of.reshape(n, n)
        first += count
    return indices


def _state_permutation(lossy_frame: LossyFrame, peers: Sequence[int]) -> Integers:
    """Return the permutation of states in which peer i becomes `peers[i]`: new[states] = old."""
    indices = np.arange(len(lossy_frame.mean))
    number = {arc: index for index, arc in enumerate(lossy_frame.arcs)}
    for peer, target in enumerate(peers):
        if peer != target:
            indices[lossy_frame.offsets[peer] : lossy_frame.offsets[peer + 1]] = np.arange(
                lossy_frame.offsets[target], lossy_frame.offsets[target + 1]
            )
    for index, (g, h, link) in enumerate(lossy_frame.arcs):
        if (peers[g], peers[h]) != (g, h):
            indices[lossy_frame.stored[index]] = lossy_frame.stored[number[peers[g], peers[h], link]]
    return indices


def _step(tagged: _TaggedMoments, numbers: Floats) -> Floats:
    """Return all tagged moments one frame later."""
    lossy_frame = tagged.lossy_frame
    moments = numbers[tagged.entries]
    set_count, (count, width, n) = len(moments), lossy_frame.reception_errors.shape
    flat = lossy_frame.reception_errors.reshape(count * width, n)
    error_moments = flat @ moments  # F X
    error_products = (
        (error_moments @ flat.T).reshape(set_count, count, width, count, width).transpose(0, 1, 3, 2, 4)
    )
    rows = error_moments.reshape(set_count, count, width, n)[tagged.origin[:, 0], tagged.origin[:, 1]]
    rows = np.take_along_axis(rows, tagged.columns[tagged.origin[:, 2]][:, None, :], axis=-1)
    forms = (tagged.first @ rows.reshape(len(rows), width * n)).reshape(set_count, count * width, n)
    squares = tagged.second @ error_products.reshape(set_count * count**2, width**2)
    squares = squares.reshape(set_count, count, count, width, width).transpose(0, 1, 3, 2, 4)
    squares = squares.reshape(set_count, count * width, count * width)
    noise_inputs = lossy_frame.input.transpose(1, 0, 2).reshape(n, count * width)
    crossed = noise_inputs @ (forms @ lossy_frame.mean.T)
    next_moments = lossy_frame.mean @ moments @ lossy_frame.mean.T + crossed + crossed.transpose(0, 2, 1)
    return tagged.averaged(
        tagged.decays[:, None, None] * (next_moments + noise_inputs @ squares @ noise_inputs.T)
    )


def _largest(step: Callable[[Floats], Floats], start: Floats) -> float:
    """Return the largest eigenvalue of a map with an invariant cone of moments, in floats.

    Parameters
    ----------
    step
        The map of vectors (n,).
    start
        Moments (n,) inside the cone.

    Notes
    -----
    The eigenvalue is real, and no other is larger in magnitude. Several are computed, as a single one may
    converge to a neighbour. NaN without convergence.
    """
    if start.size <= FEW:
        return float(np.linalg.eigvals(np.array([step(column) for column in np.eye(start.size)])).real.max())
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator((start.size, start.size), matvec=step, dtype=np.float64)
    for restarts in RESTARTED:
        # Without convergence of all, those that converged need not be the largest.
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


def _series_sum(step: Callable[[Floats], Floats], input_per_frame: Floats) -> Floats:
    """Return Σ_k stepᵏ(input_per_frame), k ≥ 0: the solution x (n,) of x = step(x) + input_per_frame, by
    GMRES.

    Parameters
    ----------
    step
        The map of vectors (n,), of a spectral radius below 1.
    input_per_frame
        The input (n,).
    """
    linalg = load_pool("scipy.sparse.linalg")
    operator = linalg.LinearOperator(
        (input_per_frame.size,) * 2, matvec=lambda x: x - step(x), dtype=np.float64
    )
    result, not_converged = linalg.gmres(
        operator, input_per_frame, rtol=RELATIVE_RESIDUAL, atol=0.0, restart=VECTORS, maxiter=RESTARTS
    )
    if not_converged:
        raise NotSupportedError("GMRES did not converge")
    return np.asarray(result)
