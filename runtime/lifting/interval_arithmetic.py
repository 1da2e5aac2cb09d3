"""Number types of the kernel: floats, or floats with error radii (midpoint-radius arithmetic).

Takes: matrices of floats, real or complex, and bounds on the errors of their entries.
Gives: `UNIT_ROUNDOFF`; `Arithmetic`, `FLOATS`, `MIDPOINT_RADIUS`; `with_error_radius`, `rounded`, `value_of`,
`error_radius`, `slopes_of`, `spread_of`; `solve`; `common_shape`.
Guarantees: a sum or product in `MIDPOINT_RADIUS` encloses that of all matrices within the radii of its
operands, with its own rounding and that of the radius.
Does not: represent rational numbers or balls of many digits (see `ball_arithmetic`); charge underflow, below
1e-307 per product.

A matrix with its radius has a third axis from the end, (…, 2, n, m): entries, then their error bounds. For a
row (2, m) and a single number (2,) it is the first axis.

A sum of k products has an error of at most γ_k = k·u/(1 − k·u) times the same sum of magnitudes (Higham,
Accuracy and Stability of Numerical Algorithms, section 3.1), in any order of summation. Terms that are
exactly zero do not round.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[Any]

UNIT_ROUNDOFF = float(np.finfo(np.float64).eps) / 2  # the unit roundoff of double precision

# The relative margin of a bound, so that its own rounding cannot make it too small.
SPARED = 1e-3

# Number of terms of a sum worth counting exactly, as many may be exactly zero.
FEW = 16


@dataclass(frozen=True, slots=True)
class Arithmetic:
    """The operations of a number type: multiply, add, subtract, solve matrices, and convert others.

    `exact` converts exact numbers, `bounded` numbers with an error bound. `solve` returns X of M X = R, None
    where X has no bound, or where the number type does not need it; `vanishes` tests whether a matrix is
    zero. `scaled` multiplies by a number with one rounding error, `size` bounds the magnitudes from above.
    `doubled`, where it is not composed of the others, maps [F G] − [I 0] (…, n, n + m) of a duration to that
    of twice the duration.
    """

    multiply: Callable[[Matrix, Matrix], Matrix]
    add: Callable[[Matrix, Matrix], Matrix]
    subtract: Callable[[Matrix, Matrix], Matrix]
    exact: Callable[[Matrix], Matrix]
    solve: Callable[[Matrix, Matrix], Matrix | None] = lambda matrix, right: None
    vanishes: Callable[[Matrix], bool] = lambda matrix: not matrix.any()
    bounded: Callable[[Matrix, Matrix], Matrix] = lambda value, error_bound: value
    scaled: Callable[[Matrix, float | Matrix], Matrix] = lambda matrix, factor: matrix * factor
    size: Callable[[Matrix], Matrix] = np.abs
    doubled: Callable[[Matrix], Matrix] | None = None


def common_shape(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape to which arrays of these shapes broadcast."""
    return shapes[0] if shapes.count(shapes[0]) == len(shapes) else np.broadcast_shapes(*shapes)


def with_error_radius(value: Matrix, radius: Matrix) -> Matrix:
    """Return matrices (…, n, m) with their error radii, as (…, 2, n, m)."""
    shape = common_shape(value.shape, radius.shape)
    values = np.empty((*shape[:-2], 2, *shape[-2:]), dtype=value.dtype)
    values[..., 0, :, :], values[..., 1, :, :] = value, radius
    return values


def rounded(value: Matrix, times: int = 1) -> Matrix:
    """Return matrices (…, n, m) with error radii for the given number of roundings of each entry."""
    return with_error_radius(value, times * UNIT_ROUNDOFF * np.abs(value))


def value_of(matrix: Matrix) -> Matrix:
    """Return the entries (…, n, m) of matrices with their radii."""
    return matrix[..., 0, :, :]


def error_radius(matrix: Matrix) -> Matrix:
    """Return the error bounds of the entries (…, n, m) of matrices with radii."""
    return matrix[..., 1, :, :]


def slopes_of(matrix: Matrix) -> Matrix:
    """Return the slopes of matrices over cells along each parameter (…, m, n, n').

    For matrices that are not over cells the result is empty, m = 0.
    """
    return matrix[..., 2:, :, :]


def spread_of(matrix: Matrix) -> Matrix:
    """Return the first-order variation of entries (…, n, m) within a cell."""
    return np.asarray(np.abs(slopes_of(matrix)).sum(axis=-3))


def _multiply(left: Matrix, right: Matrix) -> Matrix:
    """Return the product of matrices with their radii, over cells too.

    Entries without a finite bound are NaN or infinite.

    Notes
    -----
    (a + α)(b + β) = a b + (a β + α b) + α β: over cells, the last term is in the radius, and so is the
    rounding of the sum of products.
    """
    a, b, error_bound_a, error_bound_b = (
        value_of(left),
        value_of(right),
        error_radius(left).real,
        error_radius(right).real,
    )
    parameters = left.shape[-3] - 2
    terms = a.shape[-1]
    if terms > FEW:  # a term is zero where its factor is exactly 0
        terms = int(np.count_nonzero(left.any(axis=-3), axis=-1).max(initial=0))
    dtype = np.complex128 if "c" in (left.dtype.kind, right.dtype.kind) else np.float64
    if dtype is np.complex128:  # twice as many products in each part, and √2 times the error of both
        terms = 3 * terms + 2
    if parameters:
        terms += parameters + 2
    rounding = (terms + 2) * UNIT_ROUNDOFF / (1 - (terms + 2) * UNIT_ROUNDOFF)
    batch_shape = common_shape(a.shape[:-2], b.shape[:-2])
    values = np.empty((*batch_shape, 2 + parameters, a.shape[-2], b.shape[-1]), dtype=dtype)
    np.matmul(a, b, out=value_of(values))
    # Each radius is enlarged by the possible rounding of its own sum. For many matrices memory access takes
    # longer than arithmetic: no array is written twice.
    size = np.abs(b)
    weight = rounding * size
    if parameters:
        spread_a, spread_b = spread_of(left), spread_of(right)
        weight += rounding * spread_b
        first = np.matmul(a[..., None, :, :], slopes_of(right), out=slopes_of(values))
        first += slopes_of(left) @ b[..., None, :, :]
    weight += error_bound_b
    error_bound = np.matmul(np.abs(a), weight, out=error_radius(values))
    if parameters:
        error_bound_b = error_bound_b + spread_b
        error_bound += spread_a @ (rounding * size + error_bound_b)
    if error_bound_a.any():
        size += error_bound_b
        error_bound += error_bound_a @ size
    error_bound *= 1 + 8 * rounding
    return values


def _sum(left: Matrix, right: Matrix, operation: Callable[[Matrix, Matrix], Matrix]) -> Matrix:
    """Return the sum or difference of matrices with their radii, over cells too."""
    result = operation(left, right)  # the radii are added up below
    value, error_bound = value_of(result), error_radius(result)
    np.add(error_radius(left), error_radius(right), out=error_bound)
    error_bound += UNIT_ROUNDOFF * np.abs(value)
    if result.shape[-3] > 2:
        error_bound += UNIT_ROUNDOFF * spread_of(result)
    error_bound *= 1 + (result.shape[-3] + 4) * UNIT_ROUNDOFF
    return result


def _with_zero_radius(value: Matrix) -> Matrix:
    """Return exact matrices, or an exact row or number, with radii of 0."""
    return np.stack([value, np.zeros_like(value)], axis=-min(value.ndim + 1, 3))


def solve(matrix: Matrix, right: Matrix, numbers: Arithmetic | None = None) -> Matrix | None:
    """Return X of M X = R for all M (2, n, n) and R (2, n, m) within their radii; None without a bound.

    Parameters
    ----------
    matrix, right
        M and R.
    numbers
        `MIDPOINT_RADIUS` by default; or the arithmetic of matrices over cells (see `taylor_models`), with X
        over the same cells.

    Notes
    -----
    With an approximate inverse Y in floats and F = I − Y M, an approximate X has an error E ≤ B + |F| E, B =
    |Y (R − M X)|. For any T > 0 with B + |F| T ≤ T, entry by entry, E ≤ T (B being positive, |F| T < T, so
    that powers of |F| converge to 0). T is (I − |F|)⁻¹ B, the smallest such T, enlarged slightly.
    """
    numbers = numbers or MIDPOINT_RADIUS
    n = matrix.shape[-1]
    try:
        inverse = np.linalg.inv(value_of(matrix))
    except np.linalg.LinAlgError:
        return None
    exact, values = numbers.exact(inverse), numbers.exact(inverse @ value_of(right))
    slope_residual = right[..., 2:, :, :] - matrix[..., 2:, :, :] @ value_of(values)[..., None, :, :]
    values[..., 2:, :, :] = inverse[..., None, :, :] @ slope_residual
    defect = numbers.subtract(numbers.exact(np.eye(n)), numbers.multiply(exact, matrix))
    residual = numbers.multiply(exact, numbers.subtract(right, numbers.multiply(matrix, values)))
    error_bound = _magnitude_bound(residual) + np.finfo(np.float64).tiny
    defect_bound = _magnitude_bound(defect) * (1 + n * UNIT_ROUNDOFF)
    try:
        amplification = np.linalg.inv(np.eye(n) - defect_bound)
        bound = amplification @ (error_bound + SPARED * (amplification @ error_bound))
    except np.linalg.LinAlgError:
        return None
    is_bound = (bound > 0) & ((error_bound + defect_bound @ bound) * (1 + (n + 4) * UNIT_ROUNDOFF) <= bound)
    error_radius(values)[...] = bound
    return values if is_bound.all() else None


def _magnitude_bound(matrix: Matrix) -> Matrix:
    """Return upper bounds of the magnitudes of entries (…, n, m), over their radii and the complete cell."""
    result = np.abs(value_of(matrix)) + error_radius(matrix).real + spread_of(matrix)
    return np.asarray(result * (1 + matrix.shape[-3] * UNIT_ROUNDOFF))


def _scaled(matrix: Matrix, factor: float | Matrix) -> Matrix:
    """Return matrices with their radii, or over cells, times a number with one rounding error."""
    values = matrix * factor
    error_bound = error_radius(values)
    error_bound += 2 * UNIT_ROUNDOFF * (np.abs(value_of(values)) + spread_of(values))
    error_bound *= 1 + (values.shape[-3] + 4) * UNIT_ROUNDOFF
    return values


def _doubled(grown: Matrix) -> Matrix:
    """Return [F G] − [I 0] of twice the duration with its radii, over cells too.

    Notes
    -----
    With E = F − I, E ← 2 E + E² and G ← 2 G + E G have roundings in proportion to E, not to 1. The error Δ of
    E is propagated as F Δ + Δ F + Δ²: it decays where F does, while 2 Δ + |E| Δ + Δ |E| would grow fourfold
    in each step.
    """
    n = grown.shape[-2]
    identity = np.eye(*grown.shape[-2:])
    error_bound, spread = error_radius(grown).real.copy(), spread_of(grown)
    without_radius = grown.copy()
    error_radius(without_radius)[...] = 0
    result = _sum(2 * without_radius, _multiply(without_radius[..., :n], without_radius), np.add)
    step = np.abs(value_of(grown) + identity)
    propagated = (step[..., :n] + spread[..., :n]) @ error_bound + error_bound[..., :n] @ (
        step + spread + error_bound
    )
    propagated[..., n:] += error_bound[..., n:]
    rounding = 1 + (n + 2 * grown.shape[-3] + 8) * UNIT_ROUNDOFF
    error_radius(result)[...] = (error_radius(result) + propagated * rounding) * (1 + 2 * UNIT_ROUNDOFF)
    return result


def _solve_floats(matrix: Matrix, right: Matrix) -> Matrix | None:
    """Return X of M X = R in floats, None for a singular M."""
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return None


FLOATS = Arithmetic(np.matmul, np.add, np.subtract, lambda value: value, _solve_floats)
MIDPOINT_RADIUS = Arithmetic(
    _multiply,
    lambda a, b: _sum(a, b, np.add),
    lambda a, b: _sum(a, b, np.subtract),
    _with_zero_radius,
    solve,
    bounded=with_error_radius,
    scaled=_scaled,
    size=_magnitude_bound,
    doubled=_doubled,
)
