"""The circle criterion for loops with their contacts cut open, with weights of contact ticks.

Takes: loops with their contacts cut open (see `lure_form`).
Gives: `Weights`, `weights_of`; `least_real_part`, `is_proved`.
Guarantees: a proof holds for all matrices within their radii.
Does not: use the monotonicity of a contact's force (Jury and Lee, 1964).

In the closed loop, f = φ(y) with f (y − f) ≥ 0 at each tick. With w = y − f and weights λ > 0 of the ticks, Λ
= diag(λ), the loop converges to rest if a storage ξᵀP ξ of it grows by less than −2 fᵀΛw, which is never
above 0: the circle criterion (Tsypkin, 1964). With H from f to −y over a frame,

    He(Λ (H(e^{jθ}) + I)) ≻ 0        for all θ, with He(X) = (X + Xᴴ)/2

A drift with all contacts open is a pole of H at z = 1, R/(z − 1). For one drift, y depends on it equally at
all ticks, R = −s m, and with Λ s = −mᵀ the remainder is free of it: He(−ΛR/(z − 1)) = mᵀm/2 on the circle,
for either sign of θ, is subtracted. One mode at most can satisfy this.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from apc.extensions.switching.lure_form import LurePlant, Matrix
from apc.lifting.interval_arithmetic import MIDPOINT_RADIUS, UNIT_ROUNDOFF, error_radius, value_of
from apc.spectrum.kyp_bounds import least_real, proves_positive
from apc.support.not_supported import NotSupportedError

# λ of a tick of a part at a subsystem, and its radius; 1 for missing entries.
Weights = Mapping[tuple[str, str, int], tuple[float, float]]


def weights_of(loops: Sequence[LurePlant]) -> Weights:
    """Return the weights of contact ticks that remove the drift from the criterion; empty without a drift.

    Parameters
    ----------
    loops
        All loops of a model, with their contacts cut open.

    Raises
    ------
    NotSupportedError
        The reason why no weights exist.
    """
    drifting = [loop for loop in loops if loop.measured]
    if len(drifting) > 1:
        names = " and ".join(open_loop.name for open_loop in drifting)
        raise NotSupportedError(
            f"with all contacts open, free rigid-body motions belong to several modes: {names}"
        )
    weights: dict[tuple[str, str, int], tuple[float, float]] = {}
    for open_loop in drifting:
        input_gains, radii = value_of(open_loop.moved)[0], error_radius(open_loop.moved)[0]
        for port, output_gain, count, gain, gain_radius in zip(
            open_loop.ports, open_loop.measured, open_loop.counts, input_gains, radii, strict=True
        ):
            if not output_gain:
                raise NotSupportedError(
                    f"{port[1]} does not constrain the rigid-body motion with all contacts open"
                )
            factor = -1 / (float(output_gain) * count)
            weight, radius = factor * gain, abs(factor) * (gain_radius + 8 * UNIT_ROUNDOFF * abs(gain))
            if not weight > radius:
                raise NotSupportedError(
                    f"{port[1]} destabilizes the rigid-body motion with all contacts open"
                )
            weights[port] = weight, radius
    return weights


def least_real_part(open_loop: LurePlant, weights: Weights) -> float:
    """Return the least eigenvalue of Λ^(−1/2) He(Λ H) Λ^(−1/2) over all frequencies, without an error bound.

    The circle criterion is that it is above −1. It is −∞ if the loop with open contacts is not stable.

    Parameters
    ----------
    open_loop, weights
        The loop, and the weights of its ticks.
    """
    a, b, c, d, weight = (value_of(block) for block in _kyp_matrices(open_loop, weights))
    root_weights = np.sqrt(np.diag(value_of(_weight_matrix(open_loop, weights))))
    # Λ^(−1/2) on both sides; less the unit matrix, as the criterion's weight is that of H + I.
    scaled_bcd = b / root_weights, c / root_weights[:, None], d / np.outer(root_weights, root_weights)
    return least_real(
        a, *scaled_bcd, weight / np.outer(root_weights, root_weights) - np.eye(len(root_weights))
    )[0]


def is_proved(open_loop: LurePlant, weights: Weights) -> bool:
    """Return whether a weighted loop is proved to dissipate energy at all frequencies.

    Parameters
    ----------
    open_loop, weights
        As for `least_real_part`.
    """
    return proves_positive(*_kyp_matrices(open_loop, weights))


def _kyp_matrices(open_loop: LurePlant, weights: Weights) -> tuple[Matrix, Matrix, Matrix, Matrix, Matrix]:
    """Return the matrices of a loop for a proof of stability: He(C (e^{jθ} − A)⁻¹ B + D) + W ≻ 0 for all θ.

    Returns
    -------
    Matrix, Matrix, Matrix, Matrix, Matrix
        A, B, C, D and W with error radii, the outputs multiplied by the weights.
    """
    weights_matrix = _weight_matrix(open_loop, weights)
    drift_part = MIDPOINT_RADIUS.multiply(np.swapaxes(open_loop.moved / 2, -1, -2), open_loop.moved)
    c, d = (MIDPOINT_RADIUS.multiply(weights_matrix, block) for block in (open_loop.c, open_loop.d))
    weight = MIDPOINT_RADIUS.subtract(weights_matrix, drift_part)
    return open_loop.a, open_loop.b, c, d, weight


def _weight_matrix(open_loop: LurePlant, weights: Weights) -> Matrix:
    """Return the diagonal matrix Λ of a loop's tick weights times peer counts, with its radii (2, m, m)."""
    values = np.zeros((2, len(open_loop.ports), len(open_loop.ports)))
    for k, (port, count) in enumerate(zip(open_loop.ports, open_loop.counts.tolist(), strict=True)):
        value, radius = weights.get(port, (1.0, 0.0))
        values[:, k, k] = value * count, (radius + UNIT_ROUNDOFF * value) * count * (1 + 4 * UNIT_ROUNDOFF)
    return values
