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

from apc.runtime.frame.discretize import UNIT
from apc.runtime.frame.exchange import Exchange
from apc.runtime.large.sparse_system import SparseSystem
from apc.runtime.large.translation import FreeMotions

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
    import scipy.sparse

    n, peers = int(system.starts[-1]), len(system.starts) - 1
    values, places, columns, held = [], [], [], []
    for g, (own, pivots) in enumerate(zip(motions.own, motions.pivots, strict=True)):
        starts = system.starts[:-1][system.crowd_of == g]
        for motion, pivot in zip(own.T, pivots, strict=True):
            moving = np.flatnonzero(motion)
            values.append(np.tile(motion[moving], len(starts)))
            places.append((starts[:, None] + moving).ravel())
            columns.append(np.repeat(len(held) + np.arange(len(starts)), len(moving)))
            held += (starts + pivot).tolist()
    single = len(held)
    pairs = np.concatenate([exchange.arcs(link)[0] for link in exchange.links])
    graph = scipy.sparse.csr_matrix((np.ones(len(pairs)), (pairs[:, 0], pairs[:, 1])), shape=(peers, peers))
    parts, part_of = scipy.sparse.csgraph.connected_components(graph, directed=False)
    order = np.argsort(part_of, kind="stable")
    for members in np.split(order, np.cumsum(np.bincount(part_of, minlength=parts))[:-1]):
        for (crowd, pivot), vectors in motions.together(np.unique(system.crowd_of[members]).tolist()):
            for g, motion in vectors.items():
                moving, starts = np.flatnonzero(motion), system.starts[members[system.crowd_of[members] == g]]
                values.append(np.tile(motion[moving], len(starts)))
                places.append((starts[:, None] + moving).ravel())
                columns.append(np.full(len(starts) * len(moving), len(held)))
            held.append(int(system.starts[members[system.crowd_of[members] == crowd][0]]) + pivot)
    entries = [np.concatenate([np.zeros(0), *part]) for part in (values, places, columns)]
    shape = (n, len(held))
    found = scipy.sparse.csr_matrix(
        (entries[0], (entries[1].astype(np.int64), entries[2].astype(np.int64))), shape=shape
    )
    bound = (system.error + 4 * UNIT * abs(system.matrix)) @ abs(found)
    moved = abs(system.matrix @ found - found)
    if (moved - 2 * bound).max() > 0 if found.nnz else False:
        return None
    pivots = np.array(held, dtype=np.int64)
    rest = np.setdiff1d(np.arange(n), pivots)
    # V_p = [1 0; X 1], the common motions last, as these are 0 where the others are held.
    corner = found[pivots]
    inverse = 2 * scipy.sparse.identity(len(held), format="csr") - corner
    assert single == len(held) or not corner[:single, single:].count_nonzero(), "motions not told apart"
    return RigidSpace(pivots, rest, (found[rest] @ inverse).tocsr())


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
        import scipy.sparse.linalg

        own, whole = self.matrix.shape[0], self.bordered.shape[0]
        diagonal = np.concatenate([np.full(own, shift), np.zeros(whole - own)])
        return scipy.sparse.linalg.splu((self.bordered - scipy.sparse.diags(diagonal)).tocsc())


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
