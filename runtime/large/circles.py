"""Circles that have eigenvalues in them, or none beyond them, by counts along them.

Takes: a `Characteristic`, and where its zeros are about.
Gives: `held_around`, `poles_within`, `beyond`, `just_outside`, `bracket`.
Guarantees: each count is of zeros and poles within their bounds; where none can be had, nothing is said.
Does not: find zeros (see `zeros`).

f has all eigenvalues as zeros and the sites' own as poles, but where both are the same: as often as f goes
around 0 along a circle, so many more zeros than poles are in it.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from apc.large.characteristic import Characteristic, characteristic_ball, count_around
from apc.large.counting import FIRST_ARCS

Complexes = NDArray[np.complex128]

# The smallest circle about a zero that is tried, relative to it, and what the next ones are larger by.
FIRST_RADIUS, WIDER = 4e-15, 8.0

# A circle about a zero that has to be wider than this shows nothing.
WIDEST = 1e-3

# The circle just outside of the largest zero is so many times farther from it than its error; if a pole or
# another zero is in the way, wider ones are tried, so many.
OUTSIDE, TRIES = 8.0, 10

# A circle about a zero is so many times larger than what the zero is known to: then few arcs do.
CLEAR = 6.0

# How far aside of a zero, relatively, its slope is looked at, and how much nearer the next time.
ASIDE, NEARER = 1e-7, 30.0

# The least circle that is counted, for the discs along it to lie where f can be evaluated.
INMOST = 1.1

# Arcs about a zero to begin with, and evaluations after which the circle is too small to tell.
SMALL_ARCS, SMALL_POINTS = 12, 300

# Circles between which the largest eigenvalue must be are drawn together until they are this close,
# relatively, at the cost of no more counts than these; a circle that can't be counted is tried so far aside.
BRACKETED, MOST_COUNTS, BESIDE = 1e-3, 40, 1e-4

# Known zeros this close to a circle, relatively, no more than so many, tell where its arcs have to be short.
CLOSE_BY, MOST_CLOSE = 1e-5, 16

# Points from which a circle about a zero is looked for, and circles tried from each.
LOOKS = 4


def held_around(function: Characteristic, point: complex) -> tuple[float, int]:
    """Return the radius of a circle about a point that has eigenvalues in it, and how many; or inf and 0.

    Nearby a zero, at ζ + h, |f| ≈ |f′| h is known to a share c of it: the zero is known to about c h.
    """
    aside = ASIDE * abs(point)
    for _ in range(LOOKS):
        ball = characteristic_ball(function, np.array([point + aside]), np.zeros(1))
        radius = max(CLEAR * float(ball.change[0]) * aside, FIRST_RADIUS * abs(point))
        for _ in range(LOOKS):
            if not radius < WIDEST * abs(point):
                break
            inside = count_around(function, point, radius, arcs=SMALL_ARCS, most=SMALL_POINTS)
            poles = poles_within(function, point, radius)
            if inside is not None and poles is not None and inside + poles > 0:
                return radius, inside + poles
            radius *= WIDER
        aside /= NEARER  # a pole or another zero may be that close
    return float(np.inf), 0


def poles_within(function: Characteristic, centre: complex, radius: float) -> int | None:
    """Return how many poles are within a circle, each as often as f has it; None: no telling."""
    total = 0
    for one in function.transfers:
        distance = np.abs(one.eigenvalues - centre)
        if np.any(np.abs(distance - radius) <= one.eigenvalue_errors):
            return None
        total += int((distance < radius).sum())
    return total


def _poles_beyond(function: Characteristic, radius: float) -> int | None:
    """Return how many of the sites' eigenvalues are larger, multiplicities counted; None: no telling."""
    total = 0
    for one in function.transfers:
        size = np.abs(one.eigenvalues)
        if np.any(np.abs(size - radius) <= one.eigenvalue_errors):
            return None
        total += int(((size > radius).sum(axis=1) * one.counts).sum())
    return total


def beyond(function: Characteristic, radius: float, rigid: int, zeros: Complexes | None = None) -> int | None:
    """Return how many eigenvalues lie beyond a circle about zero, the rigid ones left out, or None.

    Parameters
    ----------
    function
        f.
    radius
        The circle's.
    rigid
        How many eigenvalues are 1.
    zeros
        Zeros in the upper half plane (z,), where they are known.
    """
    poles = _poles_beyond(function, radius)
    if zeros is not None:
        gaps = np.abs(np.abs(zeros) - radius)
        zeros = zeros[gaps < CLOSE_BY * radius][:MOST_CLOSE]
    turns = None if poles is None else count_around(function, 0.0, radius, arcs=_arcs(function), close=zeros)
    if poles is None or turns is None:
        return None
    return poles - turns - (rigid if radius < 1 else 0)


def _arcs(function: Characteristic) -> int:
    """Return how many arcs to begin with: f turns as often as its longest delay has frames."""
    return max(FIRST_ARCS, 2 * max(function.lags, default=0))


def just_outside(
    function: Characteristic, zeros: Complexes, largest: float, error: float, rigid: int, rigid_radius: float
) -> tuple[float, int]:
    """Return a circle just outside of the largest zero, and how many eigenvalues are beyond, or −1.

    Parameters
    ----------
    function
        f.
    zeros
        Those that are known (z,).
    largest, error
        The largest one's magnitude, and what it may be off by.
    rigid, rigid_radius
        How many eigenvalues are 1, and the circle about 1 that has no others.
    """
    width = max(OUTSIDE * error, 4 * FIRST_RADIUS) if np.isfinite(error) else WIDEST
    for _ in range(TRIES):
        radius = max(largest + width, function.innermost * INMOST)
        if rigid and abs(radius - 1) <= rigid_radius:
            radius = 1 + 2 * rigid_radius
        found = beyond(function, radius, rigid, zeros)
        if found is not None:
            return radius, found
        width *= WIDER
    return largest + width, -1


def bracket(
    function: Characteristic, low: float, high: float, rigid: int, rigid_radius: float
) -> tuple[float, float]:
    """Return radii beyond the first of which there is an eigenvalue, and beyond the second none.

    Parameters
    ----------
    function
        f.
    low
        A radius that the largest eigenvalue is known to have at least.
    high
        Where to begin.
    rigid, rigid_radius
        How many eigenvalues are 1, and the circle about 1 that has no others.
    """
    inmost = function.innermost * INMOST
    outer, radius, step = float(np.inf), max(high, low, inmost), 1e-6
    for _ in range(MOST_COUNTS):
        radius, found = _count_near(function, radius, rigid, rigid_radius)
        if found == 0:
            outer = min(outer, radius)
        elif found > 0:
            low = max(low, radius)
        elif np.isfinite(outer):
            break  # what can't be counted here is left between the two
        if np.isfinite(outer):
            if outer <= max(low, inmost) * (1 + BRACKETED):
                break
            radius = max(float(np.sqrt(max(low, outer / 2) * outer)), inmost)
        else:
            radius, step = radius * (1 + step), step * WIDER
    return low, outer


def _count_near(
    function: Characteristic, radius: float, rigid: int, rigid_radius: float
) -> tuple[float, int]:
    """Return a radius near to one, and how many eigenvalues are beyond it; −1 if that can't be told."""
    for aside in (0.0, BESIDE, -BESIDE):
        near = radius * (1 + aside)
        if near > function.innermost and not (rigid and abs(near - 1) <= rigid_radius):
            found = beyond(function, near, rigid)
            if found is not None and found >= 0:
                return near, found
    return radius, -1
