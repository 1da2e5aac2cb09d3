"""The stable share of a square, from the curves around it.

Takes: the arcs of a boundary, and the survey they follow.
Gives: `stable_area`.
Guarantees: exact for the curves as given; how far these are off the boundary bounds its error.
Does not: trace curves (see `boundary`).
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from apc.regions.boundary import Arc
from apc.regions.cells import Survey
from apc.regions.curves import area_beside

Floats = NDArray[np.float64]


def stable_area(arcs: Sequence[Arc], found: Survey) -> tuple[float, float]:
    """Return the stable share of the unit square, by Green's theorem, and a bound on its error.

    ∮ x dy around the stable side: along the curves, and up the right edge where that is stable.
    """
    area, off = 0.0, 0.0
    ends: dict[int, list[Floats]] = {}
    for arc in arcs:
        area += area_beside(arc.points, arc.tangents) if arc.smooth else _polygon(arc.points)
        length = np.linalg.norm(np.diff(arc.points, axis=0), axis=1)
        off += float(length @ arc.errors) + float(length.sum()) * arc.rounding
        ends.setdefault(arc.chain, []).append(arc.points)
    turns = []
    for chain, pieces in ends.items():
        if not found.closed[chain]:
            turns += [float(end[1]) for end in (pieces[0][0], pieces[-1][-1]) if end[0] == 1.0]
    stable, below = found.corners[1], 0.0
    for turn in [*sorted(turns), 1.0]:
        area += (turn - below) if stable else 0.0
        stable, below = not stable, turn
    return min(max(area, 0.0), 1.0), off


def _polygon(points: Floats) -> float:
    """Return ∫ x dy along straight lines."""
    return float(((points[:-1, 0] + points[1:, 0]) / 2) @ np.diff(points[:, 1]))
