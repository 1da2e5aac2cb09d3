"""All peers of a sparse graph as one sparse matrix, each peer with numbers of its own.

Takes: crowds, and the exchange between them.
Gives: `SparseSystem`, `sparse_system`; `MatrixAt`, `small_matrix`.
Guarantees: the matrix is that of `modes.dense`, in the same order of states, with a bound on its error entry
by entry; its cost grows with peers and arcs.
Does not: compute eigenvalues (see `krylov`).
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
from apc.frame.schedule import Heard, Sent
from apc.large.crowds import Crowd

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class SparseSystem:
    """state⁺ = `matrix` · state; the state holds, peer by peer, z and then the packets on their way.

    `starts` (N + 1,) says where each peer's part starts, `crowd_of` (N,) and `row_of` (N,) which crowd it is
    of and which of its different peers it is; `error` bounds the error of the matrix entry by entry.
    `hearing` are, for each lag, what every line of r weighs every row of s by, both peer by peer.
    """

    matrix: Any  # scipy.sparse, (n, n)
    error: Any
    starts: Integers
    crowd_of: Integers
    row_of: Integers
    lags: tuple[int, ...]
    hearing: tuple[Any, ...]  # scipy.sparse, (lines, rows)


def sparse_system(listed: Sequence[Crowd], exchange: Exchange) -> SparseSystem:
    """Assemble all peers.

    Parameters
    ----------
    listed
        All peers, one crowd a group of the scene.
    exchange
        The links.
    """
    crowd_of = np.repeat(np.arange(len(listed)), [len(crowd.rows) for crowd in listed])
    row_of = np.concatenate([np.asarray(crowd.rows) for crowd in listed])
    sizes = np.array([crowd.lifted.p.shape[-1] + sum(crowd.schedule.depths) for crowd in listed])
    starts = np.concatenate([[0], np.cumsum(sizes[crowd_of])])
    lags, hearing = _hearing(listed, exchange, crowd_of)
    exact = [crowd.lifted.blocks for crowd in listed]
    errors = [crowd.lifted.error.blocks for crowd in listed]
    large = [tuple(np.abs(block) for block in blocks) for blocks in exact]
    wide = [
        tuple(block + error for block, error in zip(blocks, off, strict=True))
        for blocks, off in zip(large, errors, strict=True)
    ]
    sized = [abs(one) for one in hearing]
    parts = (listed, crowd_of, row_of, starts, lags)
    matrix = _assemble(exact, *parts, hearing)
    upper, bound = _assemble(wide, *parts, sized), _assemble(large, *parts, sized)
    most = max((int(np.diff(one.indptr).max(initial=0)) for one in hearing), default=0)
    terms = max(crowd.lifted.p.shape[-1] + len(crowd.schedule.heard) * (2 + most) for crowd in listed)
    rounds = 4 * (terms + 4) * (1 + max(len(crowd.schedule.sent) for crowd in listed)) * UNIT
    return SparseSystem(matrix, (upper - bound) + rounds * upper, starts, crowd_of, row_of, lags, hearing)


def _hearing(
    listed: Sequence[Crowd], exchange: Exchange, crowd_of: Integers
) -> tuple[tuple[int, ...], tuple[Any, ...]]:
    """Return the lags, and what every line of r weighs every row of s of so many frames ago by."""
    import scipy.sparse

    n_s = np.array([len(crowd.schedule.sent) for crowd in listed])[crowd_of]
    n_r = np.array([len(crowd.schedule.heard) for crowd in listed])[crowd_of]
    s_start, r_start = np.concatenate([[0], np.cumsum(n_s)]), np.concatenate([[0], np.cumsum(n_r)])
    lags = tuple(sorted({one.lag for crowd in listed for one in crowd.schedule.heard}))
    shape = (int(r_start[-1]), int(s_start[-1]))
    triplets: dict[int, list[tuple[Floats, Integers, Integers]]] = {lag: [] for lag in lags}
    for link in exchange.links:
        sends = np.array([crowd.sends(link) for crowd in listed])[crowd_of]
        pairs, weights = exchange.arcs(link)
        kept = sends[pairs[:, 0]]
        sender, receiver, weight = pairs[kept, 0], pairs[kept, 1], weights[kept]
        total = sum_weights(receiver, weight, exchange.peers).floats
        for g, crowd in enumerate(listed):
            for line, heard in enumerate(crowd.schedule.heard):
                if heard.way.link == link:
                    share = weight / total[receiver] if heard.way.operator == "mean" else weight
                    for h, other in enumerate(listed):
                        row = _row(other, heard)
                        if row is None or exchange.delay(link, other.group, crowd.group) != heard.way.delay:
                            continue
                        pick = (crowd_of[receiver] == g) & (crowd_of[sender] == h)
                        lines, rows = r_start[receiver[pick]] + line, s_start[sender[pick]] + row
                        triplets[heard.lag].append((share[pick], lines, rows))
    found = []
    for lag in lags:
        values, lines, rows = (np.concatenate(part) for part in zip(*triplets[lag], strict=True))
        found.append(scipy.sparse.csr_matrix((values, (lines, rows)), shape=shape))
    return lags, tuple(found)


def _row(crowd: Crowd, heard: Heard) -> int | None:
    """Return the row of a crowd's s that is heard."""
    sent: tuple[Sent, ...] = crowd.schedule.sent
    return sent.index(heard.sent) if heard.sent in sent else None


def _assemble(
    blocks: Sequence[tuple[Floats, ...]],
    listed: Sequence[Crowd],
    crowd_of: Integers,
    row_of: Integers,
    starts: Integers,
    lags: Sequence[int],
    hearing: Sequence[Any],
) -> Any:
    """Return the closed matrix: as `modes.close_loop`, sparse."""
    import scipy.sparse

    n = int(starts[-1])
    n_s = np.array([len(crowd.schedule.sent) for crowd in listed])[crowd_of]
    n_r = np.array([len(crowd.schedule.heard) for crowd in listed])[crowd_of]
    s_start, r_start = np.concatenate([[0], np.cumsum(n_s)]), np.concatenate([[0], np.cumsum(n_r)])
    places = (starts[:-1], r_start[:-1], s_start[:-1])
    shapes = ((n, n), (n, int(r_start[-1])), (int(s_start[-1]), n), (int(s_start[-1]), int(r_start[-1])))
    own, q, s, d = (
        _spread([one[k] for one in blocks], crowd_of, row_of, *corners, shape)
        for k, (corners, shape) in enumerate(
            zip(
                (
                    (places[0], places[0]),
                    (places[0], places[1]),
                    (places[2], places[0]),
                    (places[2], places[1]),
                ),
                shapes,
                strict=True,
            )
        )
    )
    _ = None
    before, now = scipy.sparse.csr_matrix((int(r_start[-1]), n)), None
    first, shift = _packets(listed, crowd_of, starts, s_start, n)
    for lag, weights in zip(lags, hearing, strict=True):
        if lag == 0:
            now = weights
        else:
            before = before + weights @ _packet_of(listed, crowd_of, starts, s_start, lag, n)
    sent = s + d @ before
    if now is not None:
        loop = d @ now
        term = loop @ sent
        while term.nnz and abs(term).max() > 0:  # time orders it: it ends
            sent, term = sent + term, loop @ term
    heard = before if now is None else before + now @ sent
    return (own + q @ heard + first @ sent + shift).tocsr()


def _spread(
    blocks: Sequence[Floats | Complexes],
    crowd_of: Integers,
    row_of: Integers,
    top: Integers,
    left: Integers,
    shape: tuple[int, int],
) -> Any:
    """Return every peer's block at its place in a sparse matrix."""
    import scipy.sparse

    values, lines, columns = [], [], []
    for g, block in enumerate(blocks):
        peers = np.flatnonzero(crowd_of == g)
        own = block[row_of[peers]]
        height, width = own.shape[1:]
        values.append(own.ravel())
        lines.append((top[peers][:, None, None] + np.arange(height)[:, None] + 0 * np.arange(width)).ravel())
        columns.append(
            (left[peers][:, None, None] + 0 * np.arange(height)[:, None] + np.arange(width)).ravel()
        )
    entries = (np.concatenate(values), (np.concatenate(lines), np.concatenate(columns)))
    found = scipy.sparse.csr_matrix(entries, shape=shape)
    found.eliminate_zeros()
    return found


def _packets(
    listed: Sequence[Crowd], crowd_of: Integers, starts: Integers, s_start: Integers, n: int
) -> tuple[Any, Any]:
    """Return what puts rows of s into the youngest packets (n, rows), and what ages the packets (n, n)."""
    import scipy.sparse

    into, rows, old, young = [], [], [], []
    for g, crowd in enumerate(listed):
        peers = np.flatnonzero(crowd_of == g)
        place = starts[peers] + crowd.lifted.p.shape[-1]
        for row, depth in enumerate(crowd.schedule.depths):
            if depth:
                into.append(place)
                rows.append(s_start[peers] + row)
            for age in range(1, depth):
                old.append(place + age)
                young.append(place + age - 1)
            place = place + depth
    ones = [np.ones(sum(map(len, part))) for part in (into, old)]
    flat = [np.concatenate(part) if part else np.zeros(0, np.int64) for part in (into, rows, old, young)]
    first = scipy.sparse.csr_matrix((ones[0], (flat[0], flat[1])), shape=(n, int(s_start[-1])))
    return first, scipy.sparse.csr_matrix((ones[1], (flat[2], flat[3])), shape=(n, n))


def _packet_of(
    listed: Sequence[Crowd], crowd_of: Integers, starts: Integers, s_start: Integers, lag: int, n: int
) -> Any:
    """Return what picks, for every row of s, its packet of `lag` frames ago from the state (rows, n)."""
    import scipy.sparse

    rows, places = [], []
    for g, crowd in enumerate(listed):
        peers = np.flatnonzero(crowd_of == g)
        place = starts[peers] + crowd.lifted.p.shape[-1]
        for row, depth in enumerate(crowd.schedule.depths):
            if depth >= lag:
                rows.append(s_start[peers] + row)
                places.append(place + lag - 1)
            place = place + depth
    lines, columns = np.concatenate(rows), np.concatenate(places)
    shape = (int(s_start[-1]), n)
    return scipy.sparse.csr_matrix((np.ones(len(lines)), (lines, columns)), shape=shape)


# A matrix (rows of s, rows of s) at a point ζ.
MatrixAt = Callable[[complex], Any]


def small_matrix(system: SparseSystem, listed: Sequence[Crowd]) -> MatrixAt:
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

    sent = np.array([len(one.schedule.sent) for one in listed])[system.crowd_of]
    heard = np.array([len(one.schedule.heard) for one in listed])[system.crowd_of]
    top, left = (np.concatenate([[0], np.cumsum(part)]) for part in (sent, heard))
    shape = (int(top[-1]), int(left[-1]))

    def at(point: complex) -> Any:
        answers = []
        for one in (crowd.lifted for crowd in listed):
            shifted = point * np.eye(one.p.shape[-1]) - one.p
            answers.append(one.d + one.s @ np.linalg.solve(shifted, one.q.astype(np.complex128)))
        answer = _spread(answers, system.crowd_of, system.row_of, top[:-1], left[:-1], shape)
        hearing = sum(weights * point**-lag for lag, weights in zip(system.lags, system.hearing, strict=True))
        return (scipy.sparse.identity(shape[0]) - answer @ hearing).tocsc()

    return at
