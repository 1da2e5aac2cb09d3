"""All peers of a sparse graph as one sparse matrix, each peer with numbers of its own.

Takes: populations, and the exchange between them; what nothing holds back of their peers.
Gives: `SparseSystem`, `sparse_system`; `RigidSpace`, `rigid_space`, `nothing_rigid`, `without_rigid`;
`small_matrix`.
Guarantees: the matrix is that of `modes.dense`, in the same order of states, with a bound on its error entry
by entry; its cost grows with peers and arcs. Rigid motions are checked against it before they are taken out.
Does not: compute eigenvalues (see `krylov`), find the motions (see `translation`), or chains that drift.

With z of all peers below one another, s what they send and r what they hear in a frame, c_ℓ the packets that
are ℓ frames old and somebody still hears, and E_ℓ the rows of s that grow so old,

    r = H₀ s + Σ_ℓ H_ℓ E_ℓᵀ c_ℓ,    s = S z + D r
    z⁺ = P z + Q r,    c_1⁺ = E_1 s,    c_ℓ⁺ = E_ℓ E_ℓ₋₁ᵀ c_ℓ₋₁
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.weights import sum_weights
from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.large.populations import Population
from apc.large.translation import FreeMotions

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class SparseSystem:
    """state⁺ = `matrix` · state; the state holds, peer by peer, z and then the packets on their way.

    `starts` (N + 1,) says where each peer's part starts, `population_of` (N,) and `row_of` (N,) which
    population it is of and which of its different peers it is; `error` bounds the error of the matrix
    entry by entry. `hearing` are, for each lag, what every line of r weighs every row of s by, both peer
    by peer.
    """

    matrix: Any  # scipy.sparse, (n, n)
    error: Any
    starts: Integers
    population_of: Integers
    row_of: Integers
    lags: tuple[int, ...]
    hearing: tuple[Any, ...]  # scipy.sparse, (lines, rows)


def sparse_system(listed: Sequence[Population], exchange: Exchange) -> SparseSystem:
    """Assemble all peers.

    Parameters
    ----------
    listed
        All peers, one population a group of the scene.
    exchange
        The links.
    """
    population_of = np.repeat(np.arange(len(listed)), [len(population.rows) for population in listed])
    row_of = np.concatenate([np.asarray(population.rows) for population in listed])
    sizes = np.array(
        [population.lifted.p.shape[-1] + sum(population.schedule.depths) for population in listed]
    )
    starts = np.concatenate([[0], np.cumsum(sizes[population_of])])
    lags, hearing = _hearing(listed, exchange, population_of)
    exact = [population.lifted.blocks for population in listed]
    errors = [population.lifted.error.blocks for population in listed]
    large = [tuple(np.abs(block) for block in blocks) for blocks in exact]
    wide = [
        tuple(block + error for block, error in zip(*both, strict=True))
        for both in zip(large, errors, strict=True)
    ]
    sized = [abs(one) for one in hearing]
    matrix = _assemble(exact, listed, lags, hearing)
    upper, bound = _assemble(wide, listed, lags, sized), _assemble(large, listed, lags, sized)
    most = max((int(np.diff(one.indptr).max(initial=0)) for one in hearing), default=0)
    terms = max(
        population.lifted.p.shape[-1] + len(population.schedule.heard) * (2 + most) for population in listed
    )
    rounds = 4 * (terms + 4) * (1 + max(len(population.schedule.sent) for population in listed)) * UNIT
    return SparseSystem(
        matrix, (upper - bound) + rounds * upper, starts, population_of, row_of, lags, hearing
    )


def _hearing(
    listed: Sequence[Population], exchange: Exchange, population_of: Integers
) -> tuple[tuple[int, ...], tuple[Any, ...]]:
    """Return the lags, and what every line of r weighs every row of s of so many frames ago by."""
    import scipy.sparse

    n_s = np.array([len(population.schedule.sent) for population in listed])[population_of]
    n_r = np.array([len(population.schedule.heard) for population in listed])[population_of]
    s_start, r_start = np.concatenate([[0], np.cumsum(n_s)]), np.concatenate([[0], np.cumsum(n_r)])
    lags = tuple(sorted({one.lag for population in listed for one in population.schedule.heard}))
    triplets: dict[int, list[tuple[Floats, Integers, Integers]]] = {lag: [] for lag in lags}
    for link in exchange.links:
        sends = np.array([population.sends(link) for population in listed])[population_of]
        pairs, weights = exchange.arcs(link)
        kept = sends[pairs[:, 0]]
        sender, receiver, weight = pairs[kept, 0], pairs[kept, 1], weights[kept]
        total = sum_weights(receiver, weight, exchange.peers).floats
        for g, population in enumerate(listed):
            for line, heard in enumerate(population.schedule.heard):
                if heard.way.link != link:
                    continue
                share = weight / total[receiver] if heard.way.operator == "mean" else weight
                for h, other in enumerate(listed):
                    sent = other.schedule.sent
                    late = exchange.delay(link, other.group, population.group)
                    if heard.sent in sent and late == heard.way.delay:
                        pick = (population_of[receiver] == g) & (population_of[sender] == h)
                        rows = s_start[sender[pick]] + sent.index(heard.sent)
                        triplets[heard.lag].append((share[pick], r_start[receiver[pick]] + line, rows))
    found = []
    for lag in lags:
        values, lines, rows = (np.concatenate(part) for part in zip(*triplets[lag], strict=True))
        shape = (int(r_start[-1]), int(s_start[-1]))
        found.append(scipy.sparse.csr_matrix((values, (lines, rows)), shape=shape))
    return lags, tuple(found)


def _assemble(
    blocks: Sequence[tuple[Floats, ...]],
    listed: Sequence[Population],
    lags: Sequence[int],
    hearing: Sequence[Any],
) -> Any:
    """Return the closed matrix of peers with these P, Q, S and D, population by population (k, …)."""
    import scipy.sparse

    p, q, s, d = (_beside([one[k] for one in blocks], listed) for k in range(4))
    depth = _by_peer(listed, lambda population: population.schedule.depths)
    kept = [np.flatnonzero(depth >= lag) for lag in range(1, int(depth.max(initial=0)) + 1)]
    states = p.shape[0] + sum(map(len, kept))
    weights, nobody = dict(zip(lags, hearing, strict=True)), scipy.sparse.csr_matrix(d.shape[::-1])
    old = [weights.get(lag, nobody)[:, places] for lag, places in enumerate(kept, 1)]
    heard = scipy.sparse.hstack([scipy.sparse.csr_matrix((d.shape[1], p.shape[0])), *old]).tocsr()
    sent = _widened(s, states) + d @ heard
    if 0 in weights:
        within = d @ weights[0]
        term = within @ sent
        while term.nnz and abs(term).max() > 0:  # time orders it: it ends
            sent, term = sent + term, within @ term
        heard = heard + weights[0] @ sent
    rows, place = [_widened(p, states) + q @ heard], p.shape[0]
    for lag, places in enumerate(kept, 1):
        if lag == 1:
            rows.append(sent[places])
            continue
        younger = kept[lag - 2]
        ones = (np.ones(len(places)), (np.arange(len(places)), place + np.searchsorted(younger, places)))
        rows.append(scipy.sparse.csr_matrix(ones, shape=(len(places), states)))
        place += len(younger)
    order = _peer_by_peer(listed, kept)
    return scipy.sparse.vstack(rows).tocsr()[order][:, order]


def _beside(blocks: Sequence[Floats | Complexes], listed: Sequence[Population]) -> Any:
    """Return every peer's block, of its row in its population's (k, h, w), on a sparse matrix's diagonal."""
    import scipy.sparse

    found = []
    for block, population in zip(blocks, listed, strict=True):
        own = block[np.asarray(population.rows)]
        count, height, width = own.shape
        shape = (count * height, count * width)
        if own.size:
            found.append(scipy.sparse.bsr_matrix((own, np.arange(count), np.arange(count + 1)), shape=shape))
        else:
            found.append(scipy.sparse.csr_matrix(shape))
    whole = scipy.sparse.block_diag(found, format="csr") if len(found) > 1 else found[0].tocsr()
    whole.eliminate_zeros()
    return whole


def _widened(matrix: Any, width: int) -> Any:
    """Return a sparse matrix with zeros to its right."""
    import scipy.sparse

    return scipy.sparse.csr_matrix((matrix.data, matrix.indices, matrix.indptr), (matrix.shape[0], width))


def _by_peer(listed: Sequence[Population], numbers: Callable[[Population], Sequence[int]]) -> Integers:
    """Return what is listed of a population, peer after peer."""
    found = [
        np.tile(np.array(numbers(population), dtype=np.int64), len(population.rows)) for population in listed
    ]
    return np.concatenate(found)


def _peer_by_peer(listed: Sequence[Population], kept: Sequence[Integers]) -> Integers:
    """Return the order of `modes.dense` of a state of all z and then all packets, the youngest first."""
    peer = np.arange(sum(len(population.rows) for population in listed))
    own = np.repeat(peer, _by_peer(listed, lambda population: [population.lifted.p.shape[-1]]))
    sender = np.repeat(peer, _by_peer(listed, lambda population: [len(population.schedule.sent)]))
    whose = np.concatenate([own, *(sender[places] for places in kept)])
    row = np.concatenate([np.full(len(own), -1), *kept])
    age = np.concatenate([np.arange(len(own)), *(np.full(len(one), lag) for lag, one in enumerate(kept))])
    return np.lexsort((age, row, whose))


@dataclass(frozen=True, slots=True, eq=False)
class RigidSpace:
    """Motions V of the whole that stand still, R V = V, and `held`, a place for each to be told by.

    `motions` is V V_p⁻¹ (n, d), p the places held.
    """

    held: Integers
    motions: Any  # scipy.sparse


def nothing_rigid(system: SparseSystem) -> RigidSpace:
    """Return the space of no motions."""
    import scipy.sparse

    return RigidSpace(np.zeros(0, np.int64), scipy.sparse.csr_matrix((int(system.starts[-1]), 0)))


def rigid_space(system: SparseSystem, exchange: Exchange, free: FreeMotions) -> RigidSpace | None:
    """Lay what nothing holds back out over all peers; None if it does not stand still in the whole.

    Parameters
    ----------
    system
        The whole.
    exchange
        The links, for the parts of the graph that hear nothing of each other.
    free
        What nothing holds back.
    """
    import scipy.sparse

    columns: list[tuple[Floats, Integers, Integers]] = []  # entries, their places, their columns
    held: list[int] = []

    def add(motion: Floats, starts: Integers, numbers: Integers) -> None:
        moving = np.flatnonzero(motion)
        places = (starts[:, None] + moving).ravel()
        columns.append((np.tile(motion[moving], len(starts)), places, np.repeat(numbers, len(moving))))

    for g, (own, pivots) in enumerate(zip(free.own, free.pivots, strict=True)):
        starts = system.starts[:-1][system.population_of == g]
        for motion, pivot in zip(own.T, pivots, strict=True):
            add(motion, starts, len(held) + np.arange(len(starts)))
            held.extend((starts + pivot).tolist())
    single = len(held)
    for members in _parts(exchange):
        population_of = system.population_of[members]
        for (population, pivot), vectors in free.together(np.unique(population_of).tolist()):
            for g, motion in vectors.items():
                starts = system.starts[members[population_of == g]]
                add(motion, starts, np.full(len(starts), len(held)))
            held.append(int(system.starts[members[population_of == population][0]]) + pivot)
    shape = (int(system.starts[-1]), len(held))
    value, place, column = (
        (np.concatenate(part) for part in zip(*columns, strict=True)) if columns else ([],) * 3
    )
    space = scipy.sparse.csr_matrix((value, (place, column)), shape=shape)
    bound = (system.error + 4 * UNIT * abs(system.matrix)) @ abs(space)
    off = abs(system.matrix @ space - space) - 2 * bound
    if off.nnz and off.max() > 0:
        return None
    # V_p = [1 0; X 1], as common motions are 0 where those of single peers are held.
    corner = space[held]
    assert single == len(held) or not corner[:single, single:].count_nonzero(), "motions not told apart"
    inverse = 2 * scipy.sparse.identity(len(held), format="csr") - corner
    return RigidSpace(np.array(held, dtype=np.int64), (space @ inverse).tocsr())


def _parts(exchange: Exchange) -> list[Integers]:
    """Return the peers of each part of the graph that hears nothing of the others."""
    import scipy.sparse

    peers = exchange.peers
    pairs = np.concatenate([exchange.arcs(link)[0] for link in exchange.links])
    graph = scipy.sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(peers, peers))
    parts, part_of = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(part_of, kind="stable")
    return list(np.split(order, np.cumsum(np.bincount(part_of, minlength=parts))[:-1]))


def without_rigid(system: SparseSystem, rigid: RigidSpace) -> tuple[Any, Any]:
    """Return M − V V_p⁻¹ M_p (n, n), which takes rigid motions to 0 and has all other eigenvalues; its error.

    Parameters
    ----------
    system
        The whole.
    rigid
        Its rigid motions.
    """
    taken = rigid.motions @ system.matrix[rigid.held]
    reduced = system.matrix - taken
    off = system.error + abs(rigid.motions) @ (
        system.error[rigid.held] + 8 * UNIT * abs(system.matrix[rigid.held])
    )
    return reduced.tocsc(), (off + 2 * UNIT * abs(reduced)).tocsr()


# A matrix (rows of s, rows of s) at a point ζ.
MatrixAt = Callable[[complex], Any]


def small_matrix(system: SparseSystem, listed: Sequence[Population]) -> MatrixAt:
    """Return ζ ↦ I − T(ζ) W(ζ), sparse, over what all peers send: see `characteristic`.

    Its determinant is that of I − R/ζ over Π (1 − p/ζ), p the eigenvalues of the peers hearing nothing; it is
    as many times smaller as a peer has states for each row that it sends.

    Parameters
    ----------
    system
        The whole.
    listed
        All peers.
    """
    import scipy.sparse

    def at(point: complex) -> Any:
        answers = []
        for one in (population.lifted for population in listed):
            shifted = point * np.eye(one.p.shape[-1]) - one.p
            answers.append(one.d + one.s @ np.linalg.solve(shifted, one.q.astype(np.complex128)))
        hearing = sum(weights * point**-lag for lag, weights in zip(system.lags, system.hearing, strict=True))
        answer = _beside(answers, listed)
        return (scipy.sparse.identity(answer.shape[0]) - answer @ hearing).tocsc()

    return at
