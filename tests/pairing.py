"""Spectra paired with one another, nearest first."""

from __future__ import annotations

import numpy as np

# Queues that run empty make defective eigenvalues at zero, which rounding scatters by its n-th root: all that
# is smaller than this per frame is compared by number only.
SMALL = 1e-2


def apart(one: np.ndarray, other: np.ndarray) -> float:
    """Return the largest distance when the large values of two spectra are paired, as many of each."""
    mine, yours = one[np.abs(one) > SMALL], list(other[np.abs(other) > SMALL])
    assert len(mine) == len(yours)
    worst = 0.0
    for value in mine:
        nearest = min(range(len(yours)), key=lambda place: abs(yours[place] - value))
        worst = max(worst, abs(yours.pop(nearest) - value))
    return worst
