"""The circle criterion for loops with their contacts cut open, with weights of contact ticks.

Takes: loops with their contacts cut open (see `lure_form`).
Gives: `Weights`, `weights_of`; `least_of`, `is_proved`.
Guarantees: a proof holds for all matrices within their radii.
Does not: use the monotonicity of a contact's force (Jury and Lee, 1964).

In the closed loop, f = φ(y) with f (y − f) ≥ 0 at each tick. With w = y − f and weights λ > 0 of the ticks, Λ
= diag(λ), the loop converges to rest if a storage ξᵀP ξ of it grows by less than −2 fᵀΛw, which is never
above 0: the circle criterion (Tsypkin, 1964). With H from f to −y over a frame,

    He(Λ (H(e^{jθ}) + I)) ≻ 0        for all θ

A drift with all contacts open is a pole of H at z = 1, R/(z − 1). For one drift, y depends on it equally at
all ticks, R = −s m, and with Λ s = −mᵀ the remainder is free of it: He(−ΛR/(z − 1)) = mᵀm/2 on the circle,
for either sign of θ, is subtracted. One mode at most can satisfy this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from apc.analysis.lure_form import LurePlant, Matrix
from apc.eigen.kyp_bounds import least_real, proves_positive
from apc.frame.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, error_radius, value_of
from apc.not_supported import NotSupportedError

# λ of a tick of a part at a subsystem, and its radius; 1 for missing entries.
Weights = Mapping[tuple[str, str, int], tuple[float, float]]


def weights_of(loops: Sequence[LurePlant]) -> Weights:
    """Return the weights that remove the drift.

    Parameters
    ----------
    loops
        All loops of a model.

    Raises
    ------
    NotSupportedError
        The reason why there are none.
    """
    drifting = [loop for loop in loops if loop.measured]
    if len(drifting) > 1:
        names = " and ".join(open_loop.name for open_loop in drifting)
        raise NotSupportedError(f"with all contacts open, what may drift is of several modes: {names}")
    weights: dict[tuple[str, str, int], tuple[float, float]] = {}
    for open_loop in drifting:
        moved, error_bound = value_of(open_loop.moved)[0], error_radius(open_loop.moved)[0]
        for port, share, count, m, uncertainty in zip(
            open_loop.ports, open_loop.measured, open_loop.counts, moved, error_bound, strict=True
        ):
            if not share:
                raise NotSupportedError(f"{port[1]} does not hold what may drift with all contacts open")
            by = -1 / (float(share) * count)
            weight, radius = by * m, abs(by) * (uncertainty + 8 * UNIT_ROUNDOFF * abs(m))
            if not weight > radius:
                raise NotSupportedError(f"{port[1]} drives away what may drift with all contacts open")
            weights[port] = weight, radius
    return weights


def least_of(open_loop: LurePlant, weights: Weights) -> float:
    """Return the smallest weighted real part of a loop over all frequencies, less 1; dissipative above −1.

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
    """Return whether a weighted loop is proved to dissipate energy at all frequencies.

    Parameters
    ----------
    open_loop, weights
        As for `least_of`.
    """
    return proves_positive(*_posed(open_loop, weights))


def _posed(open_loop: LurePlant, weights: Weights) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """Return A, B, C, D and W of a loop whose He(C (e^{jθ} − A)⁻¹ B + D) + W must be positive."""
    weigh = _weigh(open_loop, weights)
    half = MIDPOINT_RADIUS.multiply(np.swapaxes(open_loop.moved / 2, -1, -2), open_loop.moved)
    c, d = (MIDPOINT_RADIUS.multiply(weigh, block) for block in (open_loop.c, open_loop.d))
    weight = MIDPOINT_RADIUS.subtract(weigh, half)
    return open_loop.a, open_loop.b, c, d, weight


def _weigh(open_loop: LurePlant, weights: Weights) -> Matrix:
    """Return the weights of a loop's ticks, for all their peers, on a diagonal with their radii."""
    values = np.zeros((2, len(open_loop.ports), len(open_loop.ports)))
    for k, (port, count) in enumerate(zip(open_loop.ports, open_loop.counts.tolist(), strict=True)):
        value, radius = weights.get(port, (1.0, 0.0))
        values[:, k, k] = value * count, (radius + UNIT_ROUNDOFF * value) * count * (1 + 4 * UNIT_ROUNDOFF)
    return values
