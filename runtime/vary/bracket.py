"""A crossing of the unit circle held between two values near to each other.

Takes: a crossing found in floats, and the closed systems at any value.
Gives: `Bracket`, `bracket`, `bracket_in_floats`; `hold`.
Guarantees: a bracket holds a crossing of the true systems: on one of its ends every eigenvalue of the systems
that cross is inside the circle, on the other one outside; proved by ball arithmetic or, for more states than
that is worth or where the equations can't be had exactly, by the error bounds of an analysis in floats.
Does not: search (see `crossings`).
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from apc.eigen.balls import frame_balls, precision, reduced_balls, square, unprovable
from apc.eigen.certify import MOST_PROVED, schur_cohn
from apc.eigen.closing import ClosedSystem, Loop
from apc.eigen.relative import independent_places
from apc.eigen.rigid import RigidModes
from apc.eigen.spectrum import STABLE, STABLE_TRANSLATING, STABLE_TURNING, UNSTABLE, solve_spectrum
from apc.vary.crossings import Root

# Half the width asked of a bracket, relative to the value: half of 1e-12, rounding set aside.
HALF = 4e-13

# The first bracket tried is this much narrower, as a root of floats is mostly better than asked. What was
# wider is halved until it is hardly wider than that.
FIRST, HARDLY = 1 / 4, 1.5

# Each bracket that fails is followed by one so much wider, so many times.
WIDER, TRIES = 16.0, 8

# Bits tried in turn at one end of a bracket; with fewer a state the polynomial's coefficients seldom tell.
PRECISIONS = (128, 256, 512, 1024)
BITS_A_STATE = 6

# The loop that crosses at a value, with its rigid modes.
ExactLoop = Callable[[float], tuple[ClosedSystem | Loop, RigidModes]]

# The closed systems at a value, as an analysis has them, one of which crosses.
FloatSystems = Callable[[float], Sequence[ClosedSystem]]

# Whether the crossing lies above a value, None if that isn't known.
Above = Callable[[float], bool | None]

# A bracket in floats reaches this many of the spectral radius's error bounds to either side at first.
FLOAT_REACH = 2.0

# Where the eigenvalue has no derivative in floats it is one of a defective cluster, which rounding scatters:
# one of four by the fourth root of a rounding. The analysis takes such clusters apart where the graph does.
SCATTER = 1e-4


@dataclass(frozen=True, slots=True)
class Bracket:
    """Where a crossing is: `value` ± `error`; `proof` says how it is known, "" when floats alone say so."""

    value: float
    error: float
    proof: str


def bracket(root: Root, loop: ExactLoop, *, low: float, high: float) -> Bracket | None:
    """Prove a root of floats by ball arithmetic, or None where balls can't be had or don't tell.

    Parameters
    ----------
    root
        The crossing.
    loop
        The loop that crosses, at a value.
    low, high
        No bracket reaches beyond these.
    """
    system, _ = loop(root.value)
    if unprovable(system) or len(system.names) > MOST_PROVED:
        return None
    likely = BITS_A_STATE * len(system.names)
    most_bits = next((bits for bits in PRECISIONS if bits >= likely), PRECISIONS[-1])

    @functools.cache
    def above(value: float) -> bool | None:
        nonlocal most_bits
        inside, most_bits = _inside(*loop(value), most_bits)
        return None if inside is None else inside == root.rising

    held = hold(root, above, low, high)
    return None if held is None else Bracket(*held, f"proved with {most_bits} bits")


def bracket_in_floats(
    root: Root, systems: FloatSystems, *, low: float, high: float, in_balls: bool = True
) -> Bracket | None:
    """Hold a root between two values whose analyses differ, or None where their bounds don't tell.

    Parameters
    ----------
    root
        The crossing.
    systems
        Those closed systems at a value of which one crosses, with bounds on their errors.
    low, high
        No bracket reaches beyond these.
    in_balls
        Whether balls are asked for a verdict that floats leave open.
    """

    @functools.cache
    def above(value: float) -> bool | None:
        verdict = solve_spectrum(systems(value), in_balls=in_balls).verdict
        sides = {STABLE: True, STABLE_TRANSLATING: True, STABLE_TURNING: True, UNSTABLE: False}
        return (sides[verdict] == root.rising) if verdict in sides else None

    error = solve_spectrum(systems(root.value), in_balls=in_balls).spectral_radius_error
    if not np.isfinite(error):
        return None
    reach = FLOAT_REACH * error / abs(root.slope) if root.slope else SCATTER * _size(root)
    held = hold(root, above, low, high, reach)
    return None if held is None else Bracket(*held, "bounded in floats")


def _size(root: Root) -> float:
    return max(abs(root.value), 1e-300)


def hold(root: Root, above: Above, low: float, high: float, half: float = 0.0) -> tuple[float, float] | None:
    """Return a value and the error on it of a bracket, if one is found.

    Parameters
    ----------
    root
        The crossing.
    above
        Whether it lies above a value.
    low, high
        No bracket reaches beyond these.
    half
        How far to either side of the root it starts at least.
    """
    half = max(half, HALF * FIRST * _size(root))
    for _ in range(TRIES):
        left, right = max(root.value - half, low), min(root.value + half, high)
        if above(left) is True and above(right) is False:
            break
        half *= WIDER
    else:
        return None
    while right - left > HARDLY * 2 * FIRST * HALF * _size(root):
        middle = (left + right) / 2
        side = above(middle)
        if side is None or middle in (left, right):
            break
        left, right = (middle, right) if side else (left, middle)
    value = (left + right) / 2
    return value, max(right - value, value - left)


def _inside(system: ClosedSystem | Loop, free: RigidModes, least: int) -> tuple[bool | None, int]:
    """Say whether all eigenvalues but the rigid ones are proved inside the circle, or one outside.

    With `least` bits or more: what one end of a bracket took, the other takes, too.
    """
    held = independent_places(free.basis.T)
    for bits in (one for one in PRECISIONS if one >= least):
        with precision(bits):
            reduced = square(reduced_balls(frame_balls(system), free.exact, held))
            inside = schur_cohn(reduced.charpoly().coeffs())
        if inside is not None:
            return inside, bits
    return None, PRECISIONS[-1]
