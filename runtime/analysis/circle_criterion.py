"""Loops with their contacts cut open, each tick of a contact weighted: do their forces take energy out?

Takes: loops with their contacts cut open (see `opened`).
Gives: `Weights`, `weights_of`; `least_of`, `is_proved`.
Guarantees: what is called proved holds for all matrices within their radii.
Does not: use that a contact's force never falls as it is pressed (Jury and Lee, 1964).

Closed again, f = φ(y) with f (y − f) ≥ 0 at each tick. With w = y − f and weights λ > 0 of the ticks,
Λ = diag(λ), the loop comes to rest if a storage ξᵀP ξ of it grows by less than −2 fᵀΛw, which is never above
0: the circle criterion (Tsypkin, 1964). With H from f to −y over a frame,

    He(Λ (H(e^{jθ}) + I)) ≻ 0        for all θ

What can drift with all contacts open is a pole of H at z = 1, R/(z − 1). Where it is one motion, y follows it
alike at all ticks, R = −s m, and with Λ s = −mᵀ the rest is free of it: He(−ΛR/(z − 1)) = mᵀm/2 on the
circle, of either sign of θ, is taken off. That can be had in one mode.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from apc.analysis.opened import LurePlant, Matrix
from apc.eigen.dissipation import least_real, proves_positive
from apc.frame.radius import RADII, UNIT, radius_of, value_of
from apc.unserved import NotSupportedError

Floats = NDArray[np.float64]

# λ of a tick of a part at a site, and its radius; 1 of those that are not there.
Weights = Mapping[tuple[str, str, int], tuple[float, float]]


def weights_of(loops: Sequence[LurePlant]) -> Weights:
    """Return the weights that are free of what drifts.

    Parameters
    ----------
    loops
        All loops of a scene.

    Raises
    ------
    NotSupportedError
        Why there are none.
    """
    drifting = [loop for loop in loops if loop.seen]
    if len(drifting) > 1:
        names = " and ".join(open_loop.name for open_loop in drifting)
        raise NotSupportedError(f"with all contacts open, what may drift is of several modes: {names}")
    weights: dict[tuple[str, str, int], tuple[float, float]] = {}
    for open_loop in drifting:
        moved, off = value_of(open_loop.moved)[0], radius_of(open_loop.moved)[0]
        for port, share, count, m, doubt in zip(
            open_loop.ports, open_loop.seen, open_loop.counts, moved, off, strict=True
        ):
            if not share:
                raise NotSupportedError(f"{port[1]} does not hold what may drift with all contacts open")
            by = -1 / (float(share) * count)
            weight, radius = by * m, abs(by) * (doubt + 8 * UNIT * abs(m))
            if not weight > radius:
                raise NotSupportedError(f"{port[1]} drives away what may drift with all contacts open")
            weights[port] = weight, radius
    return weights


def least_of(open_loop: LurePlant, weights: Weights) -> float:
    """Return the least real part of a loop, weighted, at any frequency, less 1: above −1 it takes energy out.

    Parameters
    ----------
    open_loop, weights
        The loop, and the weights of its ticks.
    """
    a, b, c, d, weight = (value_of(block) for block in _posed(open_loop, weights))
    root = np.sqrt(np.diag(value_of(_weigh(open_loop, weights))))
    scaled = b / root, c / root[:, None], d / np.outer(root, root)
    return least_real(a, *scaled, weight / np.outer(root, root) - np.eye(len(root)))[0]


def is_proved(open_loop: LurePlant, weights: Weights) -> bool:
    """Say whether a loop, weighted, is proved to take energy out at all frequencies.

    Parameters
    ----------
    open_loop, weights
        As for `least_of`.
    """
    return proves_positive(*_posed(open_loop, weights))


def _posed(open_loop: LurePlant, weights: Weights) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, D and W of a loop whose He(C (e^{jθ} − A)⁻¹ B + D) + W is to be positive."""
    weigh = _weigh(open_loop, weights)
    half = RADII.multiply(np.swapaxes(open_loop.moved / 2, -1, -2), open_loop.moved)
    c, d = (RADII.multiply(weigh, block) for block in (open_loop.c, open_loop.d))
    weight = RADII.subtract(weigh, half)
    return open_loop.a, open_loop.b, c, d, weight


def _weigh(open_loop: LurePlant, weights: Weights) -> Matrix:
    """Return the weights of a loop's ticks, of all their peers, on a diagonal with their radii."""
    values = np.zeros((2, len(open_loop.ports), len(open_loop.ports)))
    for k, (port, count) in enumerate(zip(open_loop.ports, open_loop.counts.tolist(), strict=True)):
        value, radius = weights.get(port, (1.0, 0.0))
        values[:, k, k] = value * count, (radius + UNIT * value) * count * (1 + 4 * UNIT)
    return values
