"""A sparse frame map without the motions that nothing holds back.

Takes: a `SparseSystem`, and what nothing holds back of its peers.
Gives: `RigidSpace`, `rigid_space`; `RelativeMatrix`, `relative_matrix`.
Guarantees: the matrix that is left has all other eigenvalues, each as often as the whole; rigid motions are
checked against the whole before they are taken out.
Does not: find the motions (see `translation`), or chains of them that drift.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT
from apc.frame.exchange import Exchange
from apc.large.sparse_system import SparseSystem
from apc.large.translation import FreeMotions
from apc.threads import load_pool

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]


@dataclass(frozen=True, slots=True, eq=False)
class RigidSpace:
    """Motions V of the whole that stand still, R V = V, and `held`, a place for each to be told by.

    `relative` is W = V_r V_p⁻¹, p the places held and r all others, `rest`.
    """

    held: Integers
    rest: Integers
    relative: Any  # scipy.sparse, (n − d, d)


def nothing_rigid(system: SparseSystem) -> RigidSpace:
    """Return the space of no motions."""
    import scipy.sparse

    n = int(system.starts[-1])
    return RigidSpace(np.zeros(0, np.int64), np.arange(n), scipy.sparse.csr_matrix((n, 0)))


def rigid_space(system: SparseSystem, exchange: Exchange, motions: FreeMotions) -> RigidSpace | None:
    """Lay what nothing holds back out over all peers; None if it does not stand still in the whole.

    Parameters
    ----------
    system
        The whole.
    exchange
        The links, for the parts of the graph that hear nothing of each other.
    motions
        What nothing holds back.
    """
    found = _Columns([], [], [], [])
    for g, (own, pivots) in enumerate(zip(motions.own, motions.pivots, strict=True)):
        starts = system.starts[:-1][system.crowd_of == g]
        for motion, pivot in zip(own.T, pivots, strict=True):
            found.add(motion, starts, len(found.held) + np.arange(len(starts)))
            found.held.extend((starts + pivot).tolist())
    single = len(found.held)
    for members in _parts(exchange):
        crowd_of = system.crowd_of[members]
        for (crowd, pivot), vectors in motions.together(np.unique(crowd_of).tolist()):
            for g, motion in vectors.items():
                starts = system.starts[members[crowd_of == g]]
                found.add(motion, starts, np.full(len(starts), len(found.held)))
            found.held.append(int(system.starts[members[crowd_of == crowd][0]]) + pivot)
    space = found.matrix(int(system.starts[-1]))
    bound = (system.error + 4 * UNIT * abs(system.matrix)) @ abs(space)
    off = abs(system.matrix @ space - space) - 2 * bound
    if off.nnz and off.max() > 0:
        return None
    return _told_by(space, np.array(found.held, dtype=np.int64), single)


@dataclass(frozen=True, slots=True)
class _Columns:
    """Motions of single peers laid out over the whole: entries, their places, columns; what tells each."""

    values: list[Floats]
    places: list[Integers]
    columns: list[Integers]
    held: list[int]

    def add(self, motion: Floats, starts: Integers, columns: Integers) -> None:
        """Let peers whose states start there move by a motion, each in its column."""
        moving = np.flatnonzero(motion)
        self.values.append(np.tile(motion[moving], len(starts)))
        self.places.append((starts[:, None] + moving).ravel())
        self.columns.append(np.repeat(columns, len(moving)))

    def matrix(self, states: int) -> Any:
        """Return V (n, d)."""
        import scipy.sparse

        shape = (states, len(self.held))
        if not self.held:
            return scipy.sparse.csr_matrix(shape)
        entries = (np.concatenate(part) for part in (self.values, self.places, self.columns))
        value, place, column = entries
        return scipy.sparse.csr_matrix((value, (place, column)), shape=shape)


def _parts(exchange: Exchange) -> list[Integers]:
    """Return the peers of each part of the graph that hears nothing of the others."""
    import scipy.sparse

    peers = exchange.peers
    pairs = np.concatenate([exchange.arcs(link)[0] for link in exchange.links])
    graph = scipy.sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(peers, peers))
    parts, part_of = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(part_of, kind="stable")
    return list(np.split(order, np.cumsum(np.bincount(part_of, minlength=parts))[:-1]))


def _told_by(space: Any, held: Integers, single: int) -> RigidSpace:
    """Return motions V, the first `single` of single peers, with what tells them.

    V_p = [1 0; X 1], as common motions are 0 where those of single peers are held.
    """
    import scipy.sparse

    corner = space[held]
    assert single == len(held) or not corner[:single, single:].count_nonzero(), "motions not told apart"
    inverse = 2 * scipy.sparse.identity(len(held), format="csr") - corner
    rest = np.setdiff1d(np.arange(space.shape[0]), held)
    return RigidSpace(held, rest, (space[rest] @ inverse).tocsr())


@dataclass(frozen=True, slots=True, eq=False)
class RelativeMatrix:
    """A sparse matrix without its rigid motions: R = M_rr − W M_pr, over the places r of the state.

    `bordered` is [M_rr −W; M_pr −1], which is far sparser to factor than R; `error` bounds that of R.
    """

    matrix: Any  # scipy.sparse, (n − d, n − d)
    error: Any
    bordered: Any  # (n, n)

    def factor(self, shift: complex) -> Any:
        """Return LU factors of [M_rr − shift, −W; M_pr, −1]: what solves with these solves with R − shift."""
        import scipy.sparse

        linalg = load_pool("scipy.sparse.linalg")
        own, whole = self.matrix.shape[0], self.bordered.shape[0]
        diagonal = np.concatenate([np.full(own, shift), np.zeros(whole - own)])
        return linalg.splu((self.bordered - scipy.sparse.diags(diagonal)).tocsc())


def relative_matrix(system: SparseSystem, rigid: RigidSpace) -> RelativeMatrix:
    """Take rigid motions out: x_r − W x_p moves by M_rr − W M_pr.

    Parameters
    ----------
    system
        The whole.
    rigid
        Its rigid motions.
    """
    import scipy.sparse

    held, rest, weights = rigid.held, rigid.rest, rigid.relative
    matrix, error = system.matrix.tocsr(), system.error.tocsr()
    own, moved = matrix[rest][:, rest], matrix[held][:, rest]
    reduced = own - weights @ moved
    off = error[rest][:, rest] + abs(weights) @ (error[held][:, rest] + 8 * UNIT * abs(moved))
    below = -scipy.sparse.identity(len(held))
    bordered = scipy.sparse.bmat([[own, -weights], [moved, below]]) if len(held) else own
    return RelativeMatrix(
        reduced.tocsr(),
        (off + 2 * UNIT * abs(reduced)).tocsr(),
        bordered.tocsc().astype(np.complex128),
    )
