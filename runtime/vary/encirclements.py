"""How often a loop's characteristic function encircles 0 along the unit circle, at many values at once.

Takes: the logarithm of a loop's characteristic function over the circle and over what varies.
Gives: `Sheet`; `count_beyond`.
Guarantees: every arc of the circle is divided until both its ends agree on the middle, or down to the least
width; the encirclements count the eigenvalues beyond the circle.
Does not: prove a count: floats are compared with floats.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from apc.eigen.bordered import Logarithm

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.intp]
Truths = NDArray[np.bool_]

# What corners foretell may differ by so much, and by so much less than a corner's, where no zero is near: of
# a straight F it differs by more where a zero is nearer to the middle than the corners are.
AGREE, DIP = 0.5, 1.0

# The argument a corner foretells may be so many radians from its own: nearer to a zero it turns any number of
# times, and agrees by accident.
TURNS = 2.0

# Angles to begin with: the first, relative to what one frame of the longest delay turns; their ratio while
# they are small, and their distance, in radians and in turns of the longest delay.
FIRST_ANGLE, RATIO, APART, TURNED = 1e-3, 1.6, 0.25, np.pi / 2

# Cells looked at at a time, arcs at a value, and levels: what follows the circle would be divided
# for ever, and what is nothing but rounding too.
MOST_OPEN, MOST_LEVELS = 20_000, 60

# A cell is divided aside of its middle, so that no angle is 0, where F may be 0/0.
ASIDE = 0.47

# An arc of a circle narrower than this, relative to the first, has a zero as good as on it.
NARROWEST = 1e-8


class Sheet(Protocol):
    """A loop's characteristic function over the plane of ζ and a value."""

    @property
    def states(self) -> int:
        """How many zeros it has, less what its packets make of them."""

    @property
    def longest(self) -> int:
        """The longest delay in frames."""

    def at(self, values: Floats, rows: Integers, points: Complexes) -> Logarithm:
        """Return its logarithm at points (z,), each at the value (k,) of its row (z,)."""


def _principal(logarithm: Complexes) -> Complexes:
    """Return logarithms of one number with the argument nearest to 0."""
    return logarithm.real + 1j * (np.mod(logarithm.imag + np.pi, 2 * np.pi) - np.pi)


def _angles(longest: int) -> Floats:
    """Return angles to begin with, half the circle and a little beyond its ends."""
    apart = min(APART, TURNED / (longest + 1))
    even = np.linspace(0.0, np.pi, int(np.ceil(np.pi / apart)) + 1)[1:-1]
    first = FIRST_ANGLE / (longest + 1)
    small = np.geomspace(first, even[0], max(2, int(np.log(even[0] / first) / np.log(RATIO)) + 1))[:-1]
    found = np.concatenate([small, even])
    return np.concatenate([[-found[0]], found, [2 * np.pi - found[-1]]])


def _on_circle(angles: Floats) -> Complexes:
    return np.asarray(np.exp(1j * angles))


def count_beyond(sheet: Sheet, values: Floats) -> Floats:
    """Return how many eigenvalues are beyond the circle at values (k,), NaN where one is on it."""
    angles = _angles(sheet.longest)
    every = np.repeat(np.arange(len(values)), len(angles))
    found = sheet.at(values, every, np.tile(_on_circle(angles), len(values)))
    value, turning = (part.reshape(len(values), -1) for part in (found.value, found.turning))
    row = np.repeat(np.arange(len(values)), len(angles) - 1)
    left, right = np.tile(angles[:-1], len(values)), np.tile(angles[1:], len(values))
    # The arcs about 1 and −1 are halved by them, and mirror themselves.
    share = np.tile(
        np.where(np.isin(np.arange(len(angles) - 1), [0, len(angles) - 2]), 0.5, 1.0), len(values)
    )
    ends = [value[:, :-1].ravel(), turning[:, :-1].ravel(), value[:, 1:].ravel(), turning[:, 1:].ravel()]
    turned, least = np.zeros(len(values)), NARROWEST * (right - left)[0]
    for _ in range(MOST_LEVELS):
        before, before_slope, after, after_slope = ends
        width = right - left
        half = width / 2
        apart = _principal(before + before_slope * half - after + after_slope * half)
        foretold = np.minimum((before + before_slope * half).real, (after - after_slope * half).real)
        dip = np.minimum(before.real, after.real) - foretold
        good = (np.abs(apart) < AGREE) & (dip < DIP)
        good &= np.maximum(np.abs(before_slope.imag), np.abs(after_slope.imag)) * half < TURNS
        steps = ((before_slope + after_slope) * half - apart).imag
        np.add.at(turned, row[good], (share * steps)[good])
        lost = ~good & ~((width > least) & np.isfinite(apart))
        turned[row[lost]] = np.nan
        crowded = np.bincount(row[~good], minlength=len(values)) > MOST_OPEN
        turned[crowded] = np.nan
        cut = ~good & ~np.isnan(turned[row])
        if not cut.any():
            break
        middle = left[cut] + ASIDE * width[cut]
        new = sheet.at(values, row[cut], _on_circle(middle))
        ends = [
            np.concatenate([before[cut], new.value]),
            np.concatenate([before_slope[cut], new.turning]),
            np.concatenate([new.value, after[cut]]),
            np.concatenate([new.turning, after_slope[cut]]),
        ]
        left, right = np.concatenate([left[cut], middle]), np.concatenate([middle, right[cut]])
        row, share = np.tile(row[cut], 2), np.tile(share[cut], 2)
    return np.asarray(np.round(sheet.states - turned / np.pi))
