"""Winding number of a function around 0 along a circle, proved by a cover of discs.

Takes: functions bounded in discs; circles; matrices with bounded variation within discs.
Gives: `Ball`, `Bounded`, `winding_number`, `determinant_ball`; `FIRST_ARCS`.
Guarantees: a count is proved: no zero is missed between samples; None means that no cover was found, as when
a zero lies on the circle.
Does not: define the function (see `spectrum.characteristic`).

Each arc of the circle lies in a disc about its midpoint, and within the disc the function differs from its
value at the midpoint, f₀, by less than |f₀|: it has no zero there, and its argument keeps within ±π/2 of that
of f₀. Neighbouring arcs share a point, so their midpoints' arguments differ by less than π: the sum of these
differences is the change of the argument along the circle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.spectrum.matrix_norms import PRODUCT_ROUNDINGS

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class Ball:
    """A function at points: `direction` f₀/|f₀| (z,) and `change` (z,), a bound on |f/f₀ − 1| in discs."""

    direction: Complexes
    change: Floats


# A function of points (z,) and the radii of discs about them (z,).
Bounded = Callable[[Complexes, Floats], Ball]

# The number of arcs at first.
FIRST_ARCS = 32

# The limit of evaluations, in addition to those per arc: where rounding leaves f undecided along part of the
# circle, bisection of the arcs there would never end. Zeros very near to the circle cost some hundred.
MOST_POINTS, POINTS_AN_ARC = 3000, 4

# The narrowest arc in radians: narrower ones count as a zero on the circle.
NARROWEST = 1e-14

# Steps of the power method for a scaling, and the smallest ratio of its entries.
POWER_STEPS, FLOOR, TINY = 4, 1e-12, 1e-300


def winding_number(
    function: Bounded,
    centre: float | complex,
    radius: float,
    *,
    arcs: int = FIRST_ARCS,
    most: int | None = None,
) -> int | None:
    """Return the winding number of a function around 0 along a circle; None if undecided.

    Parameters
    ----------
    function
        The function, bounded in discs and real on the real axis: for a real centre, half the circle suffices.
    centre, radius
        The centre and the radius of the circle.
    arcs
        The number of arcs at first.
    most
        The limit of evaluations, by default unlimited.
    """
    is_symmetric = not complex(centre).imag
    most = MOST_POINTS + POINTS_AN_ARC * arcs if most is None else most
    edges = np.linspace(0.0, np.pi if is_symmetric else 2 * np.pi, (arcs // 2 if is_symmetric else arcs) + 1)
    starts, ends = edges[:-1], edges[1:]
    covered: list[tuple[Floats, Complexes]] = []
    evaluations = 0
    while len(starts):
        evaluations += len(starts)
        if evaluations > most:
            return None
        middles = (starts + ends) / 2
        # The far end of an arc is a chord away from its midpoint; the point itself is rounded.
        reach = radius * (2 * np.sin((ends - starts) / 4) + 1e-15) + 4e-16 * abs(centre)
        ball = function(centre + radius * np.exp(1j * middles), reach)
        is_covered = ball.change < 1
        covered.append((middles[is_covered], ball.direction[is_covered]))
        left, right = starts[~is_covered], ends[~is_covered]
        if np.any(right - left < NARROWEST):
            return None
        cut = (left + right) / 2
        starts, ends = np.concatenate([left, cut]), np.concatenate([cut, right])
    order = np.argsort(np.concatenate([angles for angles, _ in covered]))
    direction = np.concatenate([values for _, values in covered])[order]
    phase = float(np.angle(direction[1:] / direction[:-1]).sum())
    if is_symmetric:  # the other half is its mirror image; where they meet, the function is real
        phase = 2 * phase + float(np.angle(direction[0] ** 2)) + float(np.angle(direction[-1].conj() ** 2))
    else:
        phase += float(np.angle(direction[0] / direction[-1]))
    return round(phase / (2 * np.pi))


def determinant_ball(matrix: Complexes, slope: Complexes, uncertainty: Floats, reach: Floats) -> Ball:
    """Return the direction of a determinant at the centres of discs, and a bound on its relative change
    within them.

    Parameters
    ----------
    matrix, slope, uncertainty
        A and A₁ (z, n, n), and a bound V on the difference between A + h A₁ and the matrix anywhere in the
        disc.
    reach
        The discs' radii (z,).

    Notes
    -----
    With A + h A₁ + E in the disc, |E| ≤ V entry by entry, and F the Frobenius norm of
    D⁻¹ (ρ |A⁻¹ A₁| + |A⁻¹| V) D, for any scaling D > 0, det(A + h A₁ + E)/det A = Π (1 + λ_i) with
    Σ |λ_i|² ≤ F² (Schur), so it differs from 1 by at most (1 + F/√n)^n − 1.
    """
    with np.errstate(all="ignore"):
        n = matrix.shape[-1]
        is_valid = np.asarray(
            np.isfinite(uncertainty).all(axis=(1, 2)) & np.isfinite(matrix).all(axis=(1, 2))
        )
        matrix = np.where(is_valid[:, None, None], matrix, np.eye(n))
        sign, logarithm = np.linalg.slogdet(matrix)
        is_valid &= np.isfinite(logarithm)
        matrix = np.where(is_valid[:, None, None], matrix, np.eye(n))
        inverse, size, defect = _inverse(matrix)
        is_valid &= defect < 0.5
        uncertainty, slope = (np.where(is_valid[:, None, None], part, 0.0) for part in (uncertainty, slope))
        uncertainty += PRODUCT_ROUNDINGS * (n + 2) * UNIT_ROUNDOFF * reach[:, None, None] * np.abs(slope)
        relative_slope = np.abs(inverse @ slope)
        relative_slope += 2 * defect[:, None, None] * relative_slope.max(axis=1, keepdims=True, initial=0.0)
        norm = _scaled_norm(reach[:, None, None] * relative_slope + size @ uncertainty)
        change = np.where(is_valid, np.expm1(n * np.log1p(norm / np.sqrt(max(n, 1)))) * (1 + 1e-9), np.inf)
    return Ball(sign, change)


def _inverse(matrix: Complexes) -> tuple[Complexes, Floats, Floats]:
    """Return Y ≈ A⁻¹, a bound on |A⁻¹| (z, n, n), and ‖F‖ (z,) with F = I − Y A; valid for ‖F‖ < 1/2.

    A⁻¹ = (I − F)⁻¹ Y, and |(I − F)⁻¹| is at most I + 2‖F‖ in every entry.
    """
    n = matrix.shape[-1]
    inverse = np.linalg.inv(matrix)
    size = np.abs(inverse)
    error_bound = np.abs(np.eye(n) - inverse @ matrix)
    error_bound += PRODUCT_ROUNDINGS * (n + 2) * UNIT_ROUNDOFF * (size @ np.abs(matrix))
    defect = error_bound.sum(axis=2).max(axis=1, initial=0.0)
    largest = size.max(axis=1, keepdims=True, initial=0.0)
    return inverse.astype(np.complex128), size + 2 * defect[:, None, None] * largest, np.asarray(defect)


def _scaled_norm(matrices: Floats) -> Floats:
    """Return Frobenius norms of nonnegative matrices (z, n, n), after a diagonal scaling that reduces them.

    The left and right Perron vectors scale a matrix of rank one to a symmetric one; a few steps of the power
    method approximate them, and any scaling is valid.
    """
    right, left = np.ones(matrices.shape[:2]), np.ones(matrices.shape[:2])
    for _ in range(POWER_STEPS):
        right = (matrices @ right[..., None])[..., 0]
        left = (left[:, None, :] @ matrices)[:, 0]
        right = np.maximum(right / np.maximum(right.max(axis=1, keepdims=True, initial=0.0), TINY), FLOOR)
        left = np.maximum(left / np.maximum(left.max(axis=1, keepdims=True, initial=0.0), TINY), FLOOR)
    scale = np.sqrt(right / left)
    scaled = matrices / scale[:, :, None] * scale[:, None, :]
    return np.asarray(np.linalg.norm(scaled, axis=(1, 2)))
