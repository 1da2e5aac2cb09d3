"""The motion that neither grows nor dies out at a point of the stability boundary: whose it is, how fast.

Takes: closed systems with their rigid motions, and the eigenvalue that lies on the circle.
Gives: `Marginal`, `marginal_motion`, `with_rigid`.
Guarantees: a rigid motion, whose eigenvalue is 1 everywhere, is never taken for the one that decides, even
where that one is 1 as well: what changes sign from tick to tick is so after a frame of evenly many of them.
Does not: find the point (see `search`).
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import dataclass

import numpy as np

from apc.eigen.closing import ClosedSystem
from apc.eigen.eigenpairs import LARGE, eigenpairs, pair_near
from apc.eigen.relative import relative, relative_coordinates
from apc.eigen.rigid import RigidModes, rigid_modes_here
from apc.eigen.spectrum import angles_in_frame, whole_vectors

# An eigenvalue of 1 leaves open how far the peers stand aside together; next to the boundary, where it is
# this much larger, they stand where the motion takes them. Far above rounding, far below half a turn.
ASIDE = 1e-7


@dataclass(frozen=True, slots=True)
class Marginal:
    """The closed system `name`'s motion that turns by `turn` radians in a frame of `frame_s` seconds.

    `turn` is NaN where it can't be told.
    """

    name: str
    turn: float
    frame_s: float

    @property
    def frequency_hz(self) -> float:
        """The motion's frequency."""
        return abs(self.turn) / (2 * np.pi * self.frame_s)


def with_rigid(systems: Iterable[ClosedSystem]) -> Iterator[tuple[ClosedSystem, RigidModes]]:
    """Yield each closed system with its rigid motions, drifts left where they are."""
    return ((one, rigid_modes_here(one)) for one in systems)


def marginal_motion(systems: Iterable[tuple[ClosedSystem, RigidModes]], eigenvalue: complex) -> Marginal:
    """Return the motion of an eigenvalue, whole turns within a frame counted.

    Parameters
    ----------
    systems
        The closed systems it may be of, with their rigid motions; not all of them rigid altogether.
    eigenvalue
        That of the relative coordinates on the circle, as nearly as it is known.
    """
    best: tuple[float, Marginal] | None = None
    for system, free in systems:
        at = relative_coordinates(free.basis)
        reduced = relative(system.matrix, at)
        if not len(reduced):
            continue
        pairs = eigenpairs(reduced) if len(reduced) <= LARGE else pair_near(reduced, eigenvalue)
        place = int(np.argmin(np.abs(pairs.values - eigenvalue)))
        off = float(np.abs(pairs.values[place] - eigenvalue))
        if best is not None and off >= best[0]:
            continue
        one = pairs.at(np.array([place]))
        vector, shares = whole_vectors(system, at, one, aside=ASIDE)
        turn = float(angles_in_frame([(system, one.values, vector, shares)])[0][0])
        best = off, Marginal(system.name, turn, system.frame_s)
    assert best is not None, "something moves where something neither grows nor dies out"
    return best[1]
