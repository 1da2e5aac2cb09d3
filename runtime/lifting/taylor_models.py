"""The number type of the kernel over many cells: floats with slopes, and a radius for the remainder.

Takes: values of matrices at the middle of a cell of parameters, and how they change towards its sides.
Gives: `taylor`; `within`, `hull`, `corners`; `reciprocal`; `arithmetic_of`, `over_as_many`, `entrywise`.
Guarantees: a sum, product, quotient or exponential encloses that of all numbers in its operands, at every
point of the cell; rounding is charged. A result without a bound is infinite or NaN.
Does not: propagate second-order terms (they are added to the radius); charge underflow, below 1e-307 per
product.

A matrix over a cell of m parameters has a third axis from the end, (…, 2 + m, n, n'): its value v at the
middle, a radius r, and its change s_k from the middle to the upper side of parameter k; it encloses v + Σ_k
s_k ε_k + ρ for every ε_k in [−1, 1] and |ρ| ≤ r: a Taylor model of the first order (Makino and Berz, Taylor
models and other validated functional inclusion methods, 2003). Value and radius have the same indices as in
`lifting.interval_arithmetic`; without parameters both types are equal.
"""

from __future__ import annotations

from dataclasses import replace
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Arithmetic,
    error_radius,
    slopes_of,
    solve,
    spread_of,
    value_of,
    with_error_radius,
)

Matrix = NDArray[Any]


@lru_cache(maxsize=16)
def taylor(parameters: int) -> Arithmetic:
    """Return the arithmetic of matrices over cells of the given number of parameters."""

    def exact(value: Matrix) -> Matrix:
        """Return exact matrices with radii and slopes of 0."""
        return np.stack([value, *[np.zeros_like(value)] * (1 + parameters)], axis=-min(value.ndim + 1, 3))

    def bounded(value: Matrix, error_bound: Matrix) -> Matrix:
        """Return matrices with error radii and slopes of 0."""
        return within(with_error_radius(value, error_bound), parameters)

    arithmetic = replace(MIDPOINT_RADIUS, exact=exact, bounded=bounded)
    return replace(arithmetic, solve=lambda matrix, right: solve(matrix, right, arithmetic))


def arithmetic_of(matrix: Matrix) -> Arithmetic:
    """Return the arithmetic of matrices with their radii (…, 2, n, m), or over cells (…, 2 + m, n, n')."""
    return MIDPOINT_RADIUS if matrix.shape[-3] == 2 else taylor(matrix.shape[-3] - 2)


def over_as_many(matrix: Matrix, reference: Matrix) -> Matrix:
    """Return a matrix over the parameters of another one; added slopes are zero."""
    return within(matrix, reference.shape[-3] - matrix.shape[-3])


def entrywise(left: Matrix, right: Matrix) -> Matrix:
    """Return the entrywise product of matrices over cells (…, 2 + m, n, n').

    Either factor may have radii only (…, 2, n, n'), and is then constant over the cells.
    """
    left, right = over_as_many(left, right), over_as_many(right, left)
    count = left.shape[-3] - 2
    a, b, error_bound_a, error_bound_b = (
        value_of(left),
        value_of(right),
        error_radius(left),
        error_radius(right),
    )
    spread_a, spread_b, size_a, size_b = spread_of(left), spread_of(right), np.abs(a), np.abs(b)
    slope_terms = slopes_of(left) * b[..., None, :, :], a[..., None, :, :] * slopes_of(right)
    values = np.concatenate([(a * b)[..., None, :, :]] * 2 + [slope_terms[0] + slope_terms[1]], axis=-3)
    error_bound = (
        spread_a * spread_b
        + (size_a + spread_a) * error_bound_b
        + error_bound_a * (size_b + spread_b + error_bound_b)
    )
    error_bound += (count + 2) * UNIT_ROUNDOFF * (size_a * size_b + spread_a * size_b + size_a * spread_b)
    error_radius(values)[...] = error_bound * (1 + (count + 8) * UNIT_ROUNDOFF)
    return values


def within(matrix: Matrix, parameters: int) -> Matrix:
    """Return matrices with their radii (…, 2, n, m) over cells of more parameters, with slopes of 0."""
    if parameters <= 0:
        return matrix
    zero_slopes = np.zeros((*matrix.shape[:-3], parameters, *matrix.shape[-2:]))
    return np.concatenate([matrix, zero_slopes], axis=-3)


def hull(matrix: Matrix) -> Matrix:
    """Return matrices with radii (…, 2, n, m) that enclose matrices over cells at every point of the cell."""
    error_bound = error_radius(matrix) + spread_of(matrix)
    return with_error_radius(value_of(matrix), error_bound * (1 + matrix.shape[-3] * UNIT_ROUNDOFF))


def corners(matrix: Matrix) -> list[Matrix]:
    """Return matrices over cells at each corner of the cell, with their radii (…, 2, n, m)."""
    result = [matrix[..., :2, :, :]]
    for axis in range(2, matrix.shape[-3]):
        slope = MIDPOINT_RADIUS.exact(matrix[..., axis, :, :])
        result = [
            operation(values, slope)
            for values in result
            for operation in (MIDPOINT_RADIUS.add, MIDPOINT_RADIUS.subtract)
        ]
    return result


def reciprocal(number: Matrix) -> Matrix:
    """Return 1/x of numbers x (…, 2 + m, 1, 1) over cells; infinite or NaN where x may be 0.

    Notes
    -----
    1/x = 1/v − (x − v)/v² + (x − v)²/(v² x).
    """
    value, spread = np.abs(value_of(number)), spread_of(number) + error_radius(number)
    values = number / -np.square(value_of(number))[..., None, :, :]
    value_of(values)[...] = 1 / value_of(number)
    separation = value - spread * (1 + 8 * UNIT_ROUNDOFF)
    error_bound = error_radius(number) + spread * np.where(separation > 0, spread / separation, np.inf)
    error_bound = error_bound / np.square(value) + 8 * UNIT_ROUNDOFF * (1 / value + spread_of(values))
    error_radius(values)[...] = error_bound * (1 + 64 * UNIT_ROUNDOFF)
    return values
