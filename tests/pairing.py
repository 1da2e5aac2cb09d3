"""Spectra paired with one another, nearest first, and graphs to compare them on."""

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


def arcs_of(name: str, peers: int) -> list[tuple[int, int, float]]:
    """Return a graph as (sender, receiver, weight): by hand what `ring` and `star` mean, and others."""
    both = {
        "ring": [(i, (i + 1) % peers, 1.0) for i in range(peers)],
        "star": [(0, i, 1.0) for i in range(1, peers)],
        "path": [(i, i + 1, 0.5 + i) for i in range(peers - 1)],
        "two pairs": [(0, 1, 1.0), (2, 3, 1.0)],
    }
    if name in both:
        return sorted({arc for i, j, w in both[name] for arc in ((i, j, w), (j, i, w))})
    return {
        "cycle": [(i, (i + 1) % peers, 0.7) for i in range(peers)],
        "one way": [(i, i + 1, 1.0) for i in range(peers - 1)],
        "apart": [(0, 1, 2.0), (1, 0, 2.0), (0, 2, -0.5), (3, 2, 1.5), (2, 3, 1.0)],
    }[name]
