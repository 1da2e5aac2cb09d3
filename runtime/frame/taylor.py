"""What the kernel computes with over many cells at once: floats with slopes, and a radius for all the rest.

Takes: values of matrices at the middle of a cell of parameters, and how they change towards its sides.
Gives: `taylor`; `within`, `hull`, `corners`; `reciprocal`.
Guarantees: a sum, product, quotient or exponential holds that of all numbers its operands hold, at every
point of the cell; rounding is charged. What can't be bounded is infinite or NaN.
Does not: follow what is of the second order (it goes into the radius); charge what underflows, less than
1e-307 a product.

A matrix over a cell of m parameters has a third axis from the end, (…, 2 + m, n, n'): its value v at the
middle, a radius r, and its change s_k from the middle to the upper side of parameter k; it holds
v + Σ_k s_k ε_k + ρ for every ε_k in [−1, 1] and |ρ| ≤ r: a Taylor model of the first order (Makino and Berz,
Taylor models and other validated functional inclusion methods, 2003). Value and radius stand where
`frame.radius` has them, and without parameters it is what that has.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.radius import (
    RADII,
    UNIT,
    Arithmetic,
    radius_of,
    slopes_of,
    solve,
    spread_of,
    value_of,
    with_radius,
)

Matrix = NDArray[Any]


@lru_cache(maxsize=16)
def taylor(parameters: int) -> Arithmetic:
    """Return how matrices over cells of so many parameters are multiplied, added, subtracted and written."""

    def exact(value: Matrix) -> Matrix:
        return np.stack([value, *[np.zeros_like(value)] * (1 + parameters)], axis=-min(value.ndim + 1, 3))

    def bounded(value: Matrix, off: Matrix) -> Matrix:
        return within(with_radius(value, off), parameters)

    arithmetic = replace(RADII, exact=exact, bounded=bounded)
    return replace(arithmetic, solve=lambda matrix, right: solve(matrix, right, arithmetic))


def arithmetic_of(matrix: Matrix) -> Arithmetic:
    """Return what matrices with their radii (…, 2, n, m), or over cells (…, 2 + m, n, n'), compute with."""
    return RADII if matrix.shape[-3] == 2 else taylor(matrix.shape[-3] - 2)


def over_as_many(matrix: Matrix, other: Matrix) -> Matrix:
    """Return matrices over as many parameters as others, none of which moves them but those that did."""
    return within(matrix, other.shape[-3] - matrix.shape[-3])


def entrywise(left: Matrix, right: Matrix) -> Matrix:
    """Return the product entry by entry of matrices over cells (…, 2 + m, n, n'), or of one and numbers.

    Either may be one with its radii (…, 2, n, n') that stays all over the cells.
    """
    left, right = over_as_many(left, right), over_as_many(right, left)
    count = left.shape[-3] - 2
    a, b, off_a, off_b = value_of(left), value_of(right), radius_of(left), radius_of(right)
    spread_a, spread_b, size_a, size_b = spread_of(left), spread_of(right), np.abs(a), np.abs(b)
    first = slopes_of(left) * b[..., None, :, :], a[..., None, :, :] * slopes_of(right)
    values = np.concatenate([(a * b)[..., None, :, :]] * 2 + [first[0] + first[1]], axis=-3)
    off = spread_a * spread_b + (size_a + spread_a) * off_b + off_a * (size_b + spread_b + off_b)
    off += (count + 2) * UNIT * (size_a * size_b + spread_a * size_b + size_a * spread_b)
    radius_of(values)[...] = off * (1 + (count + 8) * UNIT)
    return values


def within(matrix: Matrix, parameters: int) -> Matrix:
    """Return matrices with their radii (…, 2, n, m) over cells of more parameters, which don't move them."""
    if parameters <= 0:
        return matrix
    still = np.zeros((*matrix.shape[:-3], parameters, *matrix.shape[-2:]))
    return np.concatenate([matrix, still], axis=-3)


def hull(matrix: Matrix) -> Matrix:
    """Return matrices over cells as matrices with radii (…, 2, n, m) that hold them all over the cells."""
    off = radius_of(matrix) + spread_of(matrix)
    return with_radius(value_of(matrix), off * (1 + matrix.shape[-3] * UNIT))


def corners(matrix: Matrix) -> list[Matrix]:
    """Return matrices over cells at each corner of these, with their radii (…, 2, n, m)."""
    result = [matrix[..., :2, :, :]]
    for by in range(2, matrix.shape[-3]):
        slope = RADII.exact(matrix[..., by, :, :])
        result = [turn(values, slope) for values in result for turn in (RADII.add, RADII.subtract)]
    return result


def reciprocal(number: Matrix) -> Matrix:
    """Return 1/x of numbers (…, 2 + m, 1, 1) over cells; infinite or NaN where one may be 0.

    Notes
    -----
    1/x = 1/v − (x − v)/v² + (x − v)²/(v² x).
    """
    value, spread = np.abs(value_of(number)), spread_of(number) + radius_of(number)
    values = number / -np.square(value_of(number))[..., None, :, :]
    value_of(values)[...] = 1 / value_of(number)
    apart = value - spread * (1 + 8 * UNIT)
    off = radius_of(number) + spread * np.where(apart > 0, spread / apart, np.inf)
    off = off / np.square(value) + 8 * UNIT * (1 / value + spread_of(values))
    radius_of(values)[...] = off * (1 + 64 * UNIT)
    return values
