"""Relative coordinates: the map without rigid modes, in floats, at many points, or in balls.

Takes: rigid modes V, and matrices M with span V as invariant space.
Gives: `Relative`, `relative_coordinates`, `with_uncertainty`; `relative`, `relative_rows`,
`relative_bounded`; `relative_indices`, `independent_indices`.
Guarantees: the bounds hold for all matrices within their errors, with V rounded once.
Does not: find the rigid modes (see `rigid_modes`).

With V = [V_p; V_r], p as many indices as there are rigid modes, and W = V_r V_p⁻¹, the relative coordinates
x_r − W x_p have an autonomous map M_rr − W M_pr, which has all other eigenvalues.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import (
    FLOATS,
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Arithmetic,
    error_radius,
    value_of,
    with_error_radius,
)
from apc.spectrum.matrix_norms import PRODUCT_ROUNDINGS
from apc.support.threads import load_pool

Floats = NDArray[np.float64]
Indices = NDArray[np.intp]
Matrix = NDArray[Any]  # float64 or complex128; balls where stated


@dataclass(frozen=True, slots=True, eq=False)
class Relative:
    """The coordinates x_r − W x_p: `eliminated` are the indices p, `rest` all others, `weights` is W.

    `uncertainty` bounds the error of W, entry by entry. If W depends on a parameter, W and its bound have a
    leading axis of points (k, …).
    """

    eliminated: Indices
    rest: Indices
    weights: Matrix  # (len(rest), len(eliminated))
    uncertainty: Floats


def relative(matrix: Matrix, coordinates: Relative, numbers: Arithmetic = FLOATS) -> Matrix:
    """Return M_rr − W M_pr of matrices M (…, n, n) in a number type; M itself if nothing is eliminated."""
    if not len(coordinates.eliminated):
        return matrix
    remaining_columns = matrix[..., _run(coordinates.rest)]
    eliminated = numbers.multiply(
        coordinates.weights, remaining_columns[..., _run(coordinates.eliminated), :]
    )
    return numbers.subtract(remaining_columns[..., _run(coordinates.rest), :], eliminated)


def _run(locations: Indices) -> Indices | slice:
    """Return consecutive indices as a slice, which avoids copies, and others unchanged."""
    first, count = int(locations[0]) if len(locations) else 0, len(locations)
    return slice(first, first + count) if (locations == np.arange(first, first + count)).all() else locations


def relative_rows(matrix: Matrix, coordinates: Relative, numbers: Arithmetic = FLOATS) -> Matrix:
    """Return M_r − W M_p of matrices M (…, n, m) in a number type: the input matrix of x_r − W x_p."""
    remaining_rows = matrix[..., coordinates.rest, :]
    if not len(coordinates.eliminated):
        return remaining_rows
    return numbers.subtract(
        remaining_rows, numbers.multiply(coordinates.weights, matrix[..., coordinates.eliminated, :])
    )


def with_uncertainty(coordinates: Relative, numbers: Arithmetic = MIDPOINT_RADIUS) -> Relative:
    """Return coordinates with their weights W in a number type, with error bounds."""
    return replace(coordinates, weights=numbers.bounded(coordinates.weights, coordinates.uncertainty))


def relative_bounded(matrix: Matrix, error: Floats, coordinates: Relative) -> tuple[Matrix, Floats]:
    """Return M_rr − W M_pr of matrices (…, n, n) known up to an error, and a bound on its error."""
    if not len(coordinates.eliminated):
        return matrix, error
    values = relative(with_error_radius(matrix, error), with_uncertainty(coordinates), MIDPOINT_RADIUS)
    return value_of(values), error_radius(values)


def independent_indices(rows: NDArray[Any]) -> NDArray[np.intp]:
    """Return m well-conditioned independent rows of a matrix given as its transpose (m, n), by their
    indices.
    """
    if not len(rows):
        return np.zeros(0, dtype=np.intp)
    scaled = rows / np.maximum(np.abs(rows).max(axis=1, keepdims=True), np.finfo(np.float64).tiny)
    order = load_pool("scipy.linalg").qr(scaled, mode="r", pivoting=True, check_finite=False)[1]
    return np.asarray(np.sort(order[: len(rows)]), dtype=np.intp)


def relative_indices(basis: Floats) -> tuple[Indices, Indices]:
    """Return the indices p of coordinates eliminated by rigid modes V (n, d), d of them, and all others r."""
    eliminated = independent_indices(basis.T)
    return eliminated, np.delete(np.arange(len(basis)), eliminated)  # np.setdiff1d imports numpy.ma, 10 ms


def relative_coordinates(basis: Floats, locations: tuple[Indices, Indices] | None = None) -> Relative:
    """Return the coordinates relative to rigid modes V (n, d), each entry rounded once.

    Notes
    -----
    The indices p and r are those of `relative_indices` unless given. W − W* = (V_r − W V_p + a rounding of
    either) V_p*⁻¹ up to sign.
    """
    eliminated, remaining = relative_indices(basis) if locations is None else locations
    count = len(eliminated)
    if not count:
        no_weights = np.zeros((len(remaining), 0))
        return Relative(eliminated, remaining, no_weights, no_weights)
    eliminated_rows, remaining_rows = basis[eliminated], basis[remaining]
    inverse = np.linalg.inv(eliminated_rows)
    weights = remaining_rows @ inverse
    rounding = PRODUCT_ROUNDINGS * (count + 2) * UNIT_ROUNDOFF
    residual = np.abs(remaining_rows - weights @ eliminated_rows) + rounding * (
        np.abs(remaining_rows) + np.abs(weights) @ np.abs(eliminated_rows)
    )
    size = np.abs(inverse)
    defect = np.abs(np.eye(count) - inverse @ eliminated_rows) + 2 * rounding * (
        size @ np.abs(eliminated_rows)
    )
    assert float(defect.sum(axis=1).max()) < 0.5, "rigid modes nearly linearly dependent"
    # V_p*⁻¹ = (I − F)⁻¹ Y, and |(I − F)⁻¹| ≤ I + |F| + …, at most doubling the largest.
    size = size + 2 * defect.sum(axis=1, keepdims=True) * size.max(axis=0, initial=0.0)
    return Relative(eliminated, remaining, weights, residual @ size)
