"""The boundary of a stable region over a time, point by point: it has steps, and no tangents.

Takes: the log of the spectral radius over the unit square, and the `Survey` of its cells.
Gives: `trace_steps`.
Guarantees: every point is known along its cell's edge to `RESOLUTION` of the range.
Does not: say how the boundary runs inside a cell; its error there is the size of the cell.

Over a link a packet is read at ticks only: the radius is a step function of the delay, and the boundary a
staircase, which goes straight up wherever a packet comes a tick later.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from apc.regions.boundary import Arc
from apc.regions.cells import Survey

Floats = NDArray[np.float64]

# Where on a cell's edge the boundary is, in shares of the range: finer than any picture shows.
RESOLUTION = 2.0**-24


def trace_steps(
    growth: Callable[[Floats], Floats], leading: Callable[[Floats], complex], found: Survey
) -> tuple[Arc, ...]:
    """Follow the boundary from edge to edge by straight lines.

    Parameters
    ----------
    growth
        The log of the spectral radius (k,) at points (k, 2).
    leading
        The eigenvalue that decides at a point (2,).
    found
        Where the boundary crosses the cells' edges, and in what order.
    """
    if not found.crossings:
        return ()
    stable = np.array([one.stable for one in found.crossings])
    unstable = np.array([one.unstable for one in found.crossings])
    while float(np.abs(unstable - stable).max()) > RESOLUTION:
        middle = (stable + unstable) / 2
        out = growth(middle) >= 0
        unstable, stable = np.where(out[:, None], middle, unstable), np.where(out[:, None], stable, middle)
    points = (stable + unstable) / 2
    arcs = []
    for number, (chain, closed) in enumerate(zip(found.chains, found.closed, strict=True)):
        members = [*chain, chain[0]] if closed else list(chain)
        own = points[members]
        chord = np.diff(own, axis=0)
        length = np.linalg.norm(chord, axis=1)
        direction = chord / np.maximum(length, RESOLUTION)[:, None]
        middle = members[len(members) // 2]  # its unstable side has the motion that grows
        arcs.append(
            Arc(
                points=own,
                tangents=np.concatenate([direction, direction[-1:]]),
                errors=np.maximum(length, RESOLUTION),
                knots=unstable[middle][None],
                values=np.array([leading(unstable[middle])], np.complex128),
                system=0,
                rounding=RESOLUTION,
                chain=number,
                smooth=False,
            )
        )
    return tuple(arcs)
