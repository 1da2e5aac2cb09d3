"""A crossing of a loop with long delays held between two values near to each other, without its packets.

Takes: a crossing found in floats, and the loop at any value.
Gives: `bracket_of_loop`.
Guarantees: as `bracket`: on one end every eigenvalue is inside the circle, on the other one outside.
Does not: search (see `plane`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from apc.eigen.balls import precision, unprovable
from apc.eigen.bordered import (
    beyond_circle,
    map_balls,
    proved_zero,
    side_by_side,
    wire_balls,
    wires_of,
)
from apc.eigen.closing import Loop
from apc.vary.bracket import PRECISIONS, Bracket, hold
from apc.vary.crossings import Root

# Circles within the unit one beyond which only the eigenvalue that crosses is looked for, widest first; it is
# the one that was found where it is no farther from it than this.
WITHIN, BESIDE = (1e-6, 1e-8, 1e-10), 1e-6


def bracket_of_loop(
    root: Root, loops: Callable[[float], Loop], rigid: int, *, low: float, high: float
) -> Bracket | None:
    """Prove a root of a loop with long delays, without a matrix of its packets; None where it can't be.

    The eigenvalue that crosses is held in a ball at either end; on the stable one, a count tells that no
    other is beyond a circle within the unit one.

    Parameters
    ----------
    root
        The crossing.
    loops
        The loop at a value.
    rigid
        How often 1 is an eigenvalue at every value.
    low, high
        No bracket reaches beyond these.
    """
    exact = not unprovable(loops(root.value))
    most_bits = 0

    def crossing(value: float) -> tuple[Any, Any, int] | None:
        """Return the eigenvalue at a value, how far beyond the circle it is, and with how many bits."""
        for bits in PRECISIONS:
            with precision(bits):
                found = proved_zero(map_balls(loops(value)), wire_balls(loops(value)), root.eigenvalue)
                if found is None or abs(complex(found) - root.eigenvalue) > BESIDE:
                    continue
                if not (beyond := abs(found) - 1).contains(0):
                    return found, beyond, bits
        return None

    @functools.cache
    def above(value: float) -> bool | None:
        nonlocal most_bits
        loop = loops(value)
        maps = side_by_side([group.lifted for group in loop.sites])
        errors = side_by_side([group.lifted.error for group in loop.sites])
        wires = wires_of(loop.sites, loop.coupling, loop.doubts)

        def beyond(radius: float, value: complex) -> int | None:
            return beyond_circle(maps, errors, wires, radius, np.array([1.0, value] if rigid else [value]))

        if not exact:
            aside = abs(root.slope * (value - root.value)) / 2
            if beyond(1 - aside, root.eigenvalue) == rigid:
                return root.rising
            outside = beyond(1 + aside, root.eigenvalue)
            return not root.rising if outside else None
        found = crossing(value)
        if found is None:
            return None
        point, size, bits = found
        most_bits = max(most_bits, bits)
        if size > 0:
            return not root.rising
        times = 1 if point.imag.contains(0) else 2
        for width in WITHIN:
            if size > -width and beyond(1 - width, complex(point)) == rigid + times:
                return root.rising
        return None

    at = root
    if exact and root.slope and (found := crossing(root.value)):
        at = replace(root, value=root.value - float(found[1]) / root.slope)
    held = hold(at, above, low, high)
    if held is None:
        return None
    return Bracket(*held, f"proved with {most_bits} bits" if exact else "bounded in floats")
