"""A crossing of the unit circle proved by ball arithmetic, between two values near to each other.

Takes: a crossing found in floats, and the closed systems at any value, for exact arithmetic.
Gives: `Bracket`, `bracket`.
Guarantees: a proved bracket holds a crossing of the true systems: on one of its ends every eigenvalue of the
system that crosses is proved inside the circle, on the other one outside.
Does not: search (see `crossings`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import flint

from apc.runtime.eigen.balls import frame_balls, precision, reduced_balls, unprovable
from apc.runtime.eigen.certify import schur_cohn
from apc.runtime.eigen.modes import ClosedSystem
from apc.runtime.eigen.rigid import RigidModes, relative_places
from apc.runtime.vary.crossings import Root

# Half the width asked of a bracket, relative to the value: half of 1e-12, rounding set aside.
HALF = 4e-13

# The first bracket tried is this much narrower: a root of floats is mostly better than asked.
FIRST = 1 / 4

# Each bracket that fails is followed by one so much wider, so many times.
WIDER, TRIES = 16.0, 8

# Bits tried in turn at one end of a bracket.
PRECISIONS = (128, 256, 512, 1024)

# The closed systems at a value, with the rigid modes of each.
ExactSystems = Callable[[float], Sequence[tuple[ClosedSystem, RigidModes]]]


@dataclass(frozen=True, slots=True)
class Bracket:
    """Where a crossing is: `value` ± `error`; `proof` says how it is known, "" when floats alone say so."""

    value: float
    error: float
    proof: str


def bracket(root: Root, systems: ExactSystems, *, low: float, high: float) -> Bracket | None:
    """Prove a root of floats, or None where balls can't be had or don't tell.

    Parameters
    ----------
    root
        The crossing.
    systems
        The closed systems at a value.
    low, high
        No bracket reaches beyond these.
    """
    if unprovable(systems(root.value)[root.system][0]):
        return None
    size = max(abs(root.value), 1e-300)
    known: dict[float, bool | None] = {}
    most_bits = 0

    def above(value: float) -> bool | None:
        """Say whether the crossing lies above a value, None if that isn't proved."""
        nonlocal most_bits
        if value not in known:
            system, free = systems(value)[root.system]
            inside, bits = _inside(system, free)
            most_bits = max(most_bits, bits)
            known[value] = None if inside is None else inside == root.rising
        return known[value]

    half = HALF * FIRST * size
    for _ in range(TRIES):
        left, right = max(root.value - half, low), min(root.value + half, high)
        if above(left) is True and above(right) is False:
            break
        half *= WIDER
    else:
        return None
    while right - left > 2 * HALF * size:
        middle = (left + right) / 2
        side = above(middle)
        if side is None or middle in (left, right):
            break
        left, right = (middle, right) if side else (left, middle)
    value = (left + right) / 2
    error = max(right - value, value - left)
    return Bracket(value, error, f"proved with {most_bits} bits")


def _inside(system: ClosedSystem, free: RigidModes) -> tuple[bool | None, int]:
    """Say whether all eigenvalues but the rigid ones are proved inside the circle, or one outside."""
    held, rest = (places.tolist() for places in relative_places(free.basis))
    for bits in PRECISIONS:
        with precision(bits):
            reduced = reduced_balls(frame_balls(system), free.exact, held, rest)[0]
            square = flint.arb_mat(len(rest), len(rest), [flint.arb(entry) for entry in reduced.ravel()])
            inside = schur_cohn(square.charpoly().coeffs())
        if inside is not None:
            return inside, bits
    return None, PRECISIONS[-1]
