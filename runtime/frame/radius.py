"""What the kernel computes with: floats, or floats that carry their radius.

Takes: matrices of floats, real or complex, and bounds on what their entries are off by.
Gives: `UNIT`; `Arithmetic`, `FLOATS`, `RADII`; `with_radius`, `rounded`, `value_of`, `radius_of`,
`slopes_of`, `spread_of`; `solve`; `common_shape`.
Guarantees: a sum or product in `RADII` holds that of all matrices within the radii of its operands, its own
rounding and that of the radius included.
Does not: carry rational numbers or balls of many digits (see `balls`); charge what underflows, less
than 1e-307 a product.

A matrix with its radius has a third axis from the end, (…, 2, n, m): its entries, and how far each may be
off. A row (2, m) and a single number (2,) have it first.

A sum of k products is off by at most γ_k = k·u/(1 − k·u) times the same sum of magnitudes (Higham, Accuracy
and Stability of Numerical Algorithms, section 3.1), in whatever order it is added up. Terms that are exactly
zero don't round.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[Any]

UNIT = float(np.finfo(np.float64).eps) / 2  # the unit roundoff of double precision

# What a bound is larger than the least, relatively, so that rounding leaves no doubt of it.
SPARED = 1e-3

# Terms of a sum worth counting one by one, as many may be exactly zero.
FEW = 16


@dataclass(frozen=True, slots=True)
class Arithmetic:
    """How matrices of a kind of number are multiplied, added, subtracted and solved, and others written.

    `exact` writes what is exact, `bounded` what may be off by so much. `solve` gives X of M X = R, None where
    it can't be said, or where nobody asks it of such numbers; `vanishes` says that a matrix is zero. `scaled`
    multiplies by a number that is off by one rounding, `size` is the largest that magnitudes can be.
    `doubled`, where it isn't made of these, takes [F G] − [I 0] (…, n, n + m) of a time to that of twice the
    time.
    """

    multiply: Callable[[Matrix, Matrix], Matrix]
    add: Callable[[Matrix, Matrix], Matrix]
    subtract: Callable[[Matrix, Matrix], Matrix]
    exact: Callable[[Matrix], Matrix]
    solve: Callable[[Matrix, Matrix], Matrix | None] = lambda matrix, right: None
    vanishes: Callable[[Matrix], bool] = lambda matrix: not matrix.any()
    bounded: Callable[[Matrix, Matrix], Matrix] = lambda value, off: value
    scaled: Callable[[Matrix, float | Matrix], Matrix] = lambda matrix, factor: matrix * factor
    size: Callable[[Matrix], Matrix] = np.abs
    doubled: Callable[[Matrix], Matrix] | None = None


def common_shape(*shapes: tuple[int, ...]) -> tuple[int, ...]:
    """Return the shape of arrays of these shapes together, mostly that of all of them."""
    return shapes[0] if shapes.count(shapes[0]) == len(shapes) else np.broadcast_shapes(*shapes)


def with_radius(value: Matrix, radius: Matrix) -> Matrix:
    """Return matrices (…, n, m) with their radii (…, 2, n, m)."""
    shape = common_shape(value.shape, radius.shape)
    values = np.empty((*shape[:-2], 2, *shape[-2:]), dtype=value.dtype)
    values[..., 0, :, :], values[..., 1, :, :] = value, radius
    return values


def rounded(value: Matrix, times: int = 1) -> Matrix:
    """Return matrices (…, n, m) of which each entry was rounded once or so many times, with their radii."""
    return with_radius(value, times * UNIT * np.abs(value))


def value_of(matrix: Matrix) -> Matrix:
    """Return the entries (…, n, m) of matrices with their radii."""
    return matrix[..., 0, :, :]


def radius_of(matrix: Matrix) -> Matrix:
    """Return how far the entries (…, n, m) of matrices with their radii may be off."""
    return matrix[..., 1, :, :]


def slopes_of(matrix: Matrix) -> Matrix:
    """Return how matrices over cells change towards each side (…, m, n, n'); of others, none."""
    return matrix[..., 2:, :, :]


def spread_of(matrix: Matrix) -> Matrix:
    """Return how far entries (…, n, m) change within a cell, to first order."""
    return np.asarray(np.abs(slopes_of(matrix)).sum(axis=-3))


def _multiply(left: Matrix, right: Matrix) -> Matrix:
    """Return the product of matrices with their radii, over cells too; NaN or infinite where a bound is.

    Notes
    -----
    (a + α)(b + β) = a b + (a β + α b) + α β: over cells, the last is in the radius, as is what a sum of
    products rounds.
    """
    a, b, off_a, off_b = value_of(left), value_of(right), radius_of(left).real, radius_of(right).real
    sides = left.shape[-3] - 2
    terms = a.shape[-1]
    if terms > FEW:  # a term is none where its factor is exactly 0
        terms = int(np.count_nonzero(left.any(axis=-3), axis=-1).max(initial=0))
    kind = np.complex128 if "c" in (left.dtype.kind, right.dtype.kind) else np.float64
    if kind is np.complex128:  # of either part twice as many products, and √2 times as far together
        terms = 3 * terms + 2
    if sides:
        terms += sides + 2
    charge = (terms + 2) * UNIT / (1 - (terms + 2) * UNIT)
    many = common_shape(a.shape[:-2], b.shape[:-2])
    values = np.empty((*many, 2 + sides, a.shape[-2], b.shape[-1]), dtype=kind)
    np.matmul(a, b, out=value_of(values))
    # Each radius is as much larger as adding it up may have rounded it down. Of many matrices writing and
    # fetching their numbers takes longer than computing them: nothing is written twice.
    size = np.abs(b)
    weight = charge * size
    if sides:
        spread_a, spread_b = spread_of(left), spread_of(right)
        weight += charge * spread_b
        first = np.matmul(a[..., None, :, :], slopes_of(right), out=slopes_of(values))
        first += slopes_of(left) @ b[..., None, :, :]
    weight += off_b
    off = np.matmul(np.abs(a), weight, out=radius_of(values))
    if sides:
        off_b = off_b + spread_b
        off += spread_a @ (charge * size + off_b)
    if off_a.any():
        size += off_b
        off += off_a @ size
    off *= 1 + 8 * charge
    return values


def _added(left: Matrix, right: Matrix, values: Callable[[Matrix, Matrix], Matrix]) -> Matrix:
    """Return the sum or difference of matrices with their radii."""
    result = values(left, right)  # the radii are added up below
    value, off = value_of(result), radius_of(result)
    np.add(radius_of(left), radius_of(right), out=off)
    off += UNIT * np.abs(value)
    if result.shape[-3] > 2:
        off += UNIT * spread_of(result)
    off *= 1 + (result.shape[-3] + 4) * UNIT
    return result


def _exact(value: Matrix) -> Matrix:
    """Return exact matrices, or an exact row or number, with their radii."""
    return np.stack([value, np.zeros_like(value)], axis=-min(value.ndim + 1, 3))


def solve(matrix: Matrix, right: Matrix, numbers: Arithmetic | None = None) -> Matrix | None:
    """Return X of M X = R for all M (2, n, n) and R (2, n, m) within their radii; None where it has no bound.

    Parameters
    ----------
    matrix, right
        M and R.
    numbers
        `RADII`, if not given; or that of matrices over cells (see `taylor`), where X follows as they do.

    Notes
    -----
    With an inverse Y in floats and F = I − Y M, an X in floats is off by E ≤ B + |F| E, B = |Y (R − M X)|.
    For any T > 0 with B + |F| T ≤ T, entry by entry, E ≤ T (B being positive, |F| T < T, so that powers of
    |F| die out). T is (I − |F|)⁻¹ B, which is the least there is, and the same of a little of itself.
    """
    numbers = numbers or RADII
    n = matrix.shape[-1]
    try:
        inverse = np.linalg.inv(value_of(matrix))
    except np.linalg.LinAlgError:
        return None
    exact, values = numbers.exact(inverse), numbers.exact(inverse @ value_of(right))
    moved = right[..., 2:, :, :] - matrix[..., 2:, :, :] @ value_of(values)[..., None, :, :]
    values[..., 2:, :, :] = inverse[..., None, :, :] @ moved
    wrong = numbers.subtract(numbers.exact(np.eye(n)), numbers.multiply(exact, matrix))
    left = numbers.multiply(exact, numbers.subtract(right, numbers.multiply(matrix, values)))
    off = _most(left) + np.finfo(np.float64).tiny
    size = _most(wrong) * (1 + n * UNIT)
    try:
        grown = np.linalg.inv(np.eye(n) - size)
        bound = grown @ (off + SPARED * (grown @ off))
    except np.linalg.LinAlgError:
        return None
    serves = (bound > 0) & ((off + size @ bound) * (1 + (n + 4) * UNIT) <= bound)
    radius_of(values)[...] = bound
    return values if serves.all() else None


def _most(matrix: Matrix) -> Matrix:
    """Return the largest magnitudes of entries (…, n, m) within their radii, wherever in a cell."""
    result = np.abs(value_of(matrix)) + radius_of(matrix).real + spread_of(matrix)
    return np.asarray(result * (1 + matrix.shape[-3] * UNIT))


def _scaled(matrix: Matrix, factor: float | Matrix) -> Matrix:
    """Return matrices with their radii, or over cells, times a number that is off by one rounding."""
    values = matrix * factor
    off = radius_of(values)
    off += 2 * UNIT * (np.abs(value_of(values)) + spread_of(values))
    off *= 1 + (values.shape[-3] + 4) * UNIT
    return values


def _doubled(grown: Matrix) -> Matrix:
    """Return [F G] − [I 0] of twice the time with its radii, over cells too.

    Notes
    -----
    With E = F − I, E ← 2 E + E² and G ← 2 G + E G round by what E is, not by the 1 beside it. What E is off
    by, Δ, goes on as F Δ + Δ F + Δ² though: it dies out with what F lets die out, where 2 Δ + |E| Δ + Δ |E|
    would grow fourfold each time.
    """
    n = grown.shape[-2]
    identity = np.eye(*grown.shape[-2:])
    off, spread = radius_of(grown).real.copy(), spread_of(grown)
    without = grown.copy()
    radius_of(without)[...] = 0
    result = _added(2 * without, _multiply(without[..., :n], without), np.add)
    step = np.abs(value_of(grown) + identity)
    carried = (step[..., :n] + spread[..., :n]) @ off + off[..., :n] @ (step + spread + off)
    carried[..., n:] += off[..., n:]
    rounding = 1 + (n + 2 * grown.shape[-3] + 8) * UNIT
    radius_of(result)[...] = (radius_of(result) + carried * rounding) * (1 + 2 * UNIT)
    return result


def _solve_floats(matrix: Matrix, right: Matrix) -> Matrix | None:
    try:
        return np.asarray(np.linalg.solve(matrix, right))
    except np.linalg.LinAlgError:
        return None


FLOATS = Arithmetic(np.matmul, np.add, np.subtract, lambda value: value, _solve_floats)
RADII = Arithmetic(
    _multiply,
    lambda a, b: _added(a, b, np.add),
    lambda a, b: _added(a, b, np.subtract),
    _exact,
    solve,
    bounded=with_radius,
    scaled=_scaled,
    size=_most,
    doubled=_doubled,
)
