"""How often a function goes around 0 along a circle, told by a cover of discs.

Takes: functions bounded in discs; circles; matrices that change little within discs.
Gives: `Ball`, `Bounded`, `wind`, `determinant_ball`; `FIRST_ARCS`.
Guarantees: a count is right: no zero is missed between samples; None says that no cover was found, as when a
zero lies on the circle.
Does not: know whose function it is (see `large.characteristic`).

Each arc of the circle lies in a disc about its middle, and within the disc the function differs from its
value at the middle, f₀, by less than |f₀|: it has no zero there, and its argument keeps within ±π/2 of that
of f₀. Neighbouring arcs share a point, so their middles' arguments differ by less than π: the sum of these
differences is the change of the argument along the circle.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.matrix_norms import PRODUCT_ROUNDINGS
from apc.frame.radius import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@dataclass(frozen=True, slots=True, eq=False)
class Ball:
    """A function at points: `direction` f₀/|f₀| (z,) and `change` (z,), a bound on |f/f₀ − 1| in discs."""

    direction: Complexes
    change: Floats


# A function of points (z,) and the radii of discs about them (z,).
Bounded = Callable[[Complexes, Floats], Ball]

# Arcs to begin with, all around.
FIRST_ARCS = 32

# Evaluations after which a cover is given up, beside those an arc: where rounding leaves f open along a
# stretch of the circle, cutting the arcs there would never end. Zeros however near to the circle cost some
# hundred.
MOST_POINTS, POINTS_AN_ARC = 3000, 4

# An arc narrower than this many radians has a zero as good as on it: given up.
NARROWEST = 1e-14

# Steps of the power method for a scaling, and the least ratio of its entries.
POWER_STEPS, FLOOR, TINY = 4, 1e-12, 1e-300


def wind(
    function: Bounded,
    centre: float | complex,
    radius: float,
    *,
    arcs: int = FIRST_ARCS,
    most: int | None = None,
) -> int | None:
    """Return how often a function goes around 0 along a circle, counter-clockwise; None if it can't be told.

    Parameters
    ----------
    function
        Bounded in discs. It is real on the real axis: about a real centre, half the circle tells all.
    centre, radius
        The circle.
    arcs
        How many arcs to begin with.
    most
        Evaluations after which to give up, or as many as serve.
    """
    half = not complex(centre).imag
    most = MOST_POINTS + POINTS_AN_ARC * arcs if most is None else most
    edges = np.linspace(0.0, np.pi if half else 2 * np.pi, (arcs // 2 if half else arcs) + 1)
    starts, ends = edges[:-1], edges[1:]
    settled: list[tuple[Floats, Complexes]] = []
    spent = 0
    while len(starts):
        spent += len(starts)
        if spent > most:
            return None
        middles = (starts + ends) / 2
        # The far end of an arc is a chord away from its middle; the point itself is rounded.
        reach = radius * (2 * np.sin((ends - starts) / 4) + 1e-15) + 4e-16 * abs(centre)
        ball = function(centre + radius * np.exp(1j * middles), reach)
        good = ball.change < 1
        settled.append((middles[good], ball.direction[good]))
        left, right = starts[~good], ends[~good]
        if np.any(right - left < NARROWEST):
            return None
        cut = (left + right) / 2
        starts, ends = np.concatenate([left, cut]), np.concatenate([cut, right])
    order = np.argsort(np.concatenate([angles for angles, _ in settled]))
    direction = np.concatenate([values for _, values in settled])[order]
    turned = float(np.angle(direction[1:] / direction[:-1]).sum())
    if half:  # the other half mirrors it; where they meet, the function is real
        turned = 2 * turned + float(np.angle(direction[0] ** 2)) + float(np.angle(direction[-1].conj() ** 2))
    else:
        turned += float(np.angle(direction[0] / direction[-1]))
    return round(turned / (2 * np.pi))


def determinant_ball(matrix: Complexes, slope: Complexes, doubt: Floats, reach: Floats) -> Ball:
    """Return a determinant at the centres of discs, and how much it changes at most within them.

    Parameters
    ----------
    matrix, slope, doubt
        A and A₁ (z, n, n), and a bound V on what A + h A₁ differs by from the matrix anywhere in the disc.
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
        fine = np.asarray(np.isfinite(doubt).all(axis=(1, 2)) & np.isfinite(matrix).all(axis=(1, 2)))
        matrix = np.where(fine[:, None, None], matrix, np.eye(n))
        sign, logarithm = np.linalg.slogdet(matrix)
        fine &= np.isfinite(logarithm)
        matrix = np.where(fine[:, None, None], matrix, np.eye(n))
        inverse, size, wrong = _inverse(matrix)
        fine &= wrong < 0.5
        doubt, slope = (np.where(fine[:, None, None], part, 0.0) for part in (doubt, slope))
        doubt += PRODUCT_ROUNDINGS * (n + 2) * UNIT * reach[:, None, None] * np.abs(slope)
        turned = np.abs(inverse @ slope)
        turned += 2 * wrong[:, None, None] * turned.max(axis=1, keepdims=True, initial=0.0)
        share = _scaled_norm(reach[:, None, None] * turned + size @ doubt)
        change = np.where(fine, np.expm1(n * np.log1p(share / np.sqrt(max(n, 1)))) * (1 + 1e-9), np.inf)
    return Ball(sign, change)


def _inverse(matrix: Complexes) -> tuple[Complexes, Floats, Floats]:
    """Return Y ≈ A⁻¹ and a bound on |A⁻¹| (z, n, n), good while F = I − Y A has ‖F‖ (z,) < 1/2.

    A⁻¹ = (I − F)⁻¹ Y, and |(I − F)⁻¹| is at most I + 2‖F‖ in every entry.
    """
    n = matrix.shape[-1]
    inverse = np.linalg.inv(matrix)
    size = np.abs(inverse)
    off = np.abs(np.eye(n) - inverse @ matrix)
    off += PRODUCT_ROUNDINGS * (n + 2) * UNIT * (size @ np.abs(matrix))
    wrong = off.sum(axis=2).max(axis=1, initial=0.0)
    largest = size.max(axis=1, keepdims=True, initial=0.0)
    return inverse.astype(np.complex128), size + 2 * wrong[:, None, None] * largest, np.asarray(wrong)


def _scaled_norm(matrices: Floats) -> Floats:
    """Return Frobenius norms of matrices without negative entries (z, n, n), scaled to be small.

    Between the vectors of Perron of either side a matrix of rank one is symmetric; a few steps of the power
    method come near them, and any scaling will do.
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
