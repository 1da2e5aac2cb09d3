"""Enclosures of eigenvalues of matrices known up to an error.

Takes: square matrices, and a bound on the error of each entry.
Gives: `Enclosure`, `enclose_stack`, `enclose_eigenvalues`, `discs`; `least_radius`;
`excludes_unit_eigenvalue`; `descending`.
Guarantees: the bounds hold for every matrix within the error, for any conditioning; rounding in the bounds
themselves is charged. LAPACK's results are verified by their residuals.
Does not: build the matrix, or remove rigid modes (see `spectrum`).

X⁻¹(M + E)X = T + G, where X holds the right vectors and T = diag(Λ). Every eigenvalue is in one of
Gershgorin's discs of D⁻¹(T + G)D, for any positive diagonal D. Connected discs together contain as many
eigenvalues as there are discs.

The state of an emptying queue is nearly a Jordan block at zero, with nearly parallel vectors. Where it leaves
the spectral radius uncertain, X takes an orthonormal basis of the invariant subspace of small eigenvalues, or
of all, instead of their vectors; T is then Schur's triangular form, and D makes the entries above its
diagonal small.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.spectrum.eigenpairs import Eigenpairs, components, eigenpairs, inverses, largest_magnitudes
from apc.spectrum.matrix_norms import PRODUCT_ROUNDINGS, balance, norms
from apc.support.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Matrix = NDArray[Any]  # float64 or complex128

# The limit of negligible eigenvalues: a decay by e in a fifth of a frame.
SMALL = 1e-2

# The spread of defective clusters at zero in floats: eigenvalues below it are treated together.
CLUSTER = 0.3

# The ratio of a cluster's largest disc to the disc of a common scaling.
FARTHER = 1.25

# Uncertainty of a spectral radius, relative to itself or to 1: above the first, small eigenvalues are treated
# together; above the second, the radius is undecided.
SHARP, WIDE = 2e-12, 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Enclosure:
    """Bounds on the spectral radius, `low` and `high` (…), and on the error of each eigenvalue, `errors` (…,
    n).
    """

    low: Any
    high: Any
    errors: Floats


def enclose_eigenvalues(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Return all eigenvalues of a matrix, the largest first, with their vectors, and an enclosure.

    Parameters
    ----------
    matrix, error
        The matrix (n, n), and a bound on the error of each entry.

    Returns
    -------
    The eigenpairs and the enclosure. The vectors are those of the eigenvalue's strongly connected component:
    the products of right and left vectors are zero in all other components.

    Notes
    -----
    Ordered by its strongly connected parts the matrix is block triangular: its eigenvalues, with
    multiplicities, are those of the diagonal blocks. Equal peers in a directed chain make one Jordan block of
    the complete matrix, which floats scatter widely; the blocks of the parts are independent.
    """
    n = len(matrix)
    values, errors = np.zeros(n, dtype=np.complex128), np.zeros(n)
    right, left = np.zeros((2, n, n), dtype=np.complex128)
    low = high = 0.0
    parts = components(~(np.abs(matrix) + error == 0)) if n else []
    for size in {len(part) for part in parts}:  # components of equal size in one call
        indices = np.array([part for part in parts if len(part) == size])
        square = indices[:, :, None], indices[:, None]
        pairs, bounds = enclose_stack(matrix[square], error[square])
        values[indices], errors[indices] = pairs.values, bounds.errors
        right[square], left[square] = pairs.right, pairs.left
        low, high = float(np.maximum(low, bounds.low.max())), float(np.maximum(high, bounds.high.max()))
    order = descending(values)
    return Eigenpairs(values, right, left).at(order), Enclosure(low, high, errors[order])


def descending(values: Complexes) -> NDArray[np.intp]:
    """Return the indices (…, n) that sort eigenvalues: largest first, of a conjugate pair the positive
    one first.
    """
    return np.asarray(np.lexsort((-values.imag, values.real, -np.abs(values))))


def enclose_stack(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Return `enclose_eigenvalues` for a stack of matrices (k, n, n), without splitting into components."""
    # In one memory order, so that the result of a matrix does not depend on the other matrices.
    matrix, error = np.ascontiguousarray(matrix), np.ascontiguousarray(error)
    k, n = matrix.shape[:2]
    if n == 1:
        values, ones = matrix[:, 0].astype(np.complex128), np.ones((k, 1, 1), dtype=np.complex128)
        return Eigenpairs(values, ones, ones), discs(values, values, error[:, 0] * (1 + 4 * UNIT_ROUNDOFF))
    with np.errstate(all="ignore"):
        values, right = np.linalg.eig(matrix)
        order = descending(values)
        right = np.take_along_axis(right, order[:, None], axis=2).astype(np.complex128)
        values = np.take_along_axis(values, order, axis=1).astype(np.complex128)
        pairs = Eigenpairs(values, right, inverses(right))
        bounds = _bounds(matrix, error, pairs, pairs.left, values)
        width = bounds.high - bounds.low
        # Wide bounds, as near a multiple eigenvalue, are computed again with an invariant subspace.
        for row in np.flatnonzero(~(width <= SHARP * np.maximum(bounds.low, 1.0))).tolist():
            repeated, tighter = _enclose_with_subspace(matrix[row : row + 1], error[row : row + 1])
            values[row], right[row], pairs.left[row] = repeated.values[0], repeated.right[0], repeated.left[0]
            bounds.low[row], bounds.high[row], bounds.errors[row] = tighter.low, tighter.high, tighter.errors
    return pairs, bounds


def _enclose_with_subspace(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Return an enclosure for one matrix (1, n, n), with one invariant subspace for all small eigenvalues."""
    scale = balance(np.abs(matrix[0]) + error[0])
    units = scale / scale[:, None]
    matrix, error = matrix * units, error * units
    pairs = eigenpairs(matrix)
    pairs = pairs.at(descending(pairs.values)[0])
    sizes = np.abs(pairs.values[0])
    low, high, errors = 0.0, np.inf, np.full(len(sizes), np.inf)
    for limit in (0.0, CLUSTER, np.inf):
        if high - low <= SHARP * max(low, 1.0):
            break
        form, basis, small_count = load_pool("scipy.linalg").schur(
            matrix[0], output="complex", sort=functools.partial(_is_smaller, limit), check_finite=False
        )
        large_count = len(sizes) - small_count
        combined = np.hstack([pairs.right[0, :, :large_count], basis[:, :small_count]])[None]
        values = np.concatenate([pairs.values[0, :large_count], np.diag(form)[:small_count]])[None]
        upper = np.pad(np.triu(form[:small_count, :small_count], 1), [(large_count, 0)] * 2)
        enclosure = _bounds(matrix, error, replace(pairs, right=combined), inverses(combined), values, upper)
        low, high = max(low, float(enclosure.low[0])), min(high, float(enclosure.high[0]))
        errors = np.minimum(errors, enclosure.errors[0])
    vectors = Eigenpairs(pairs.values, pairs.right * scale[:, None], pairs.left / scale)
    # No estimate is farther from its eigenvalue than the sum of their distances from zero.
    return vectors, Enclosure(min(low, high), high, np.minimum(errors, sizes + high))


def _is_smaller(limit: float, value: complex) -> bool:
    """Return whether an eigenvalue is smaller than a limit."""
    return abs(value) < limit


def _bounds(
    matrix: Matrix,
    error: Floats,
    estimate: Eigenpairs,
    inverse: Matrix,
    values: Complexes,
    upper: Complexes | None = None,
) -> Enclosure:
    """Return an enclosure of the eigenvalues of a stack of matrices, from an approximate (block)
    diagonalization.

    Parameters
    ----------
    matrix, error
        The matrices (k, n, n) and their error bounds.
    estimate, inverse
        Estimates of the eigenvalues with X, and an approximation of X⁻¹ (k, n, n).
    values, upper
        The diagonal of T (k, n), and the part above it (n, n), None if it is zero.

    Notes
    -----
    With the row and column of an eigenvalue c scaled by 1/α > 1, its disc shrinks to |G_cc| + α Σ_b |G_cb|,
    and those of others b grow by |G_bc| / α. As long as these are disjoint from it, it contains one
    eigenvalue (Wilkinson, The Algebraic Eigenvalue Problem, 1965, chapter 2). For the part N above the
    diagonal D = diag(d) with d = (r − N)⁻¹ 1, r larger than N's eigenvalues: then N d < r d.
    """
    n = matrix.shape[-1]
    rounding = PRODUCT_ROUNDINGS * (n + 2) * UNIT_ROUNDOFF
    entry_rounding = (
        (n + 4) * UNIT_ROUNDOFF if np.isrealobj(matrix) else rounding
    )  # a real matrix has sums of n real products
    basis = estimate.right
    residual = matrix @ basis - basis * values[:, None]
    size, weight = np.abs(basis), np.abs(inverse)
    uncertainty = (error + entry_rounding * np.abs(matrix)) @ size + 4 * UNIT_ROUNDOFF * size * np.abs(
        values
    )[:, None]
    if upper is not None:
        residual = residual - basis @ upper
        uncertainty += rounding * (size @ np.abs(upper))
    uncertainty += rounding * np.abs(residual)
    perturbation = (np.abs(inverse @ residual) + weight @ uncertainty) * (
        1 + rounding
    )  # |G|, but for the inverse
    # The computed inverse Y has an error: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    defect_rows = (np.abs(np.eye(n) - inverse @ basis) + rounding * (weight @ size)).sum(axis=2)
    defect = defect_rows.max(axis=1)
    perturbation += (defect_rows / (1 - defect)[:, None])[:, :, None] * perturbation.max(
        axis=1, keepdims=True
    )

    if upper is not None:
        perturbation = perturbation + np.abs(upper) * (1 + 4 * UNIT_ROUNDOFF)
        perturbation = perturbation * _scaling(perturbation[0], upper)
    total = perturbation.sum(axis=2) * (1 + rounding)
    gap = (
        np.abs(values[:, :, None] - values[:, None]) * (1 - 8 * UNIT_ROUNDOFF)
        - total[:, :, None]
        - total[:, None]
    )
    np.einsum("kii->ki", gap)[:] = np.inf
    ratio = np.where(gap > 0, perturbation / gap, np.inf).max(axis=1) * (1 + 8 * UNIT_ROUNDOFF)
    diagonal = np.einsum("kii->ki", perturbation)
    reduced = (diagonal + ratio * (total - diagonal)) * (1 + 8 * UNIT_ROUNDOFF)
    radii = np.where(ratio < 1, np.minimum(reduced, total), total) * (1 + rounding)
    is_valid = (defect < 0.5) & np.isfinite(radii).all(axis=1)
    return discs(estimate.values, values, np.where(is_valid[:, None], radii, np.inf))


def _scaling(perturbation: Floats, upper: Complexes) -> Floats:
    """Return d_j / d_i (n, n) of a D that makes the entries above the diagonal small."""
    scale = np.ones(len(perturbation))
    part = np.flatnonzero(upper.any(axis=0) | upper.any(axis=1))
    block = perturbation[np.ix_(part, part)]
    if np.isfinite(block).all() and len(part):
        shift = FARTHER * float(largest_magnitudes(block))
        result = inverses(shift * np.eye(len(part)) - block).sum(axis=1)
        if (result > 0).all():
            scale[part] = result / result.max()
    return scale / scale[:, None]


def discs(values: Complexes, centres: Complexes, radii: Floats, inner: Floats | None = None) -> Enclosure:
    """Return bounds on the spectral radius (…) and the distance of each estimate (…, n) from its eigenvalue.

    k connected discs contain k eigenvalues, in any order: the error of each estimate is then at most the
    distance to the far side of any of them. `inner` (…, n) is a lower bound on the magnitudes in each disc,
    by default the smallest magnitude.
    """
    n = values.shape[-1]
    overlaps = (
        np.abs(centres[..., :, None] - centres[..., None, :]) <= radii[..., :, None] + radii[..., None, :]
    )
    label, spread = None, np.broadcast_to(np.arange(n), values.shape)
    while label is None or not np.array_equal(spread, label):
        label = spread
        spread = np.where(overlaps, label[..., None, :], n).min(axis=-1, initial=n)
    connected = label[..., :, None] == label[..., None, :]
    reach = np.abs(values[..., :, None] - centres[..., None, :]) + radii[..., None, :]
    floor = 0.0 if inner is None else -np.inf
    inner = np.abs(centres) * (1 - 4 * UNIT_ROUNDOFF) - radii if inner is None else inner
    least = np.where(connected, inner[..., None, :], np.inf).min(axis=-1, initial=np.inf)
    return Enclosure(
        low=least.max(axis=-1, initial=floor),
        high=((np.abs(centres) + radii) * (1 + 4 * UNIT_ROUNDOFF)).max(axis=-1, initial=0.0),
        errors=np.where(connected, reach, 0.0).max(axis=-1, initial=0.0) * (1 + 4 * UNIT_ROUNDOFF),
    )


def least_radius(matrix: Floats, slopes: Floats, error: Floats) -> float:
    """Return a lower bound on the spectral radius of M + Σ ε_k S_k + E for all |ε_k| ≤ 1; 0 without a bound.

    Parameters
    ----------
    matrix, slopes, error
        M (n, n), S (m, n, n) and a bound on each entry of E.

    Notes
    -----
    X⁻¹(M + …)X = [λ + g, c; r, T + H], λ being the largest eigenvalue, alone, and T that of all others. A z
    near λ is an eigenvalue if z − λ − g = c (z − T − H)⁻¹ r, whose right side is at most ‖c‖‖r‖/(s − ρ), as
    long as |z − λ − g| ≤ ρ < s = σ_min(λ − T) − |g| − ‖H‖. By Rouché's theorem one is within the ρ at which
    both are equal. Only the inward component of g reduces the bound.
    """
    with np.errstate(all="ignore"):
        n, linalg = len(matrix), load_pool("scipy.linalg")
        scale = balance(np.abs(matrix) + np.abs(slopes).sum(axis=0))
        units = scale / scale[:, None]
        matrix, slopes, error = matrix * units, slopes * units, error * units
        pairs = eigenpairs(matrix)
        pairs = pairs.at(descending(pairs.values))
        first = pairs.values[0]
        separation = np.abs(pairs.values[1:] - first).min(initial=np.inf) / 2
        form, basis, count = linalg.schur(
            matrix, output="complex", sort=lambda value: abs(value - first) > separation, check_finite=False
        )
        if count != n - 1:
            return 0.0
        right = np.hstack([pairs.right[:, :1], basis[:, :count]])
        left, centre = inverses(right), linalg.block_diag(first, form[:count, :count])
        transformed_slopes = left @ slopes @ right
        rounding = PRODUCT_ROUNDINGS * (n + 2) * UNIT_ROUNDOFF
        size, weight = np.abs(right), np.abs(left)
        error_bound = np.abs(left @ matrix @ right - centre)
        error_bound += weight @ (error + 2 * rounding * (np.abs(matrix) + np.abs(slopes).sum(axis=0))) @ size
        # The computed inverse Y has an error: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
        defect = norms(np.abs(np.eye(n) - left @ right) + rounding * (weight @ size))
        uncertainty = float(
            defect / (1 - defect) * (norms(centre) + norms(error_bound) + norms(transformed_slopes).sum())
        )

        def block_norm(rows: slice, columns: slice) -> float:
            """Return a bound on the norm of a block of the perturbation."""
            block = (
                norms(transformed_slopes[:, rows, columns]).sum()
                + norms(error_bound[rows, columns])
                + uncertainty
            )
            return float(block) * (1 + rounding)

        first_index, other_indices = slice(0, 1), slice(1, n)
        singular_values = np.linalg.svd(first * np.eye(count) - centre[1:, 1:], compute_uv=False)
        distance = (singular_values - rounding * singular_values.max(initial=0.0)).min(initial=np.inf)
        slack = distance - block_norm(first_index, first_index) - block_norm(other_indices, other_indices)
        discriminant = slack**2 - 4 * block_norm(first_index, other_indices) * block_norm(
            other_indices, first_index
        )
        if not (defect < 1 and slack > 0 and discriminant > 0):
            return 0.0
        shift = (
            2
            * block_norm(first_index, other_indices)
            * block_norm(other_indices, first_index)
            / (slack + np.sqrt(discriminant))
        )
        inward_shift = (
            np.abs((np.exp(-1j * np.angle(first)) * transformed_slopes[:, 0, 0]).real).sum()
            + error_bound[0, 0]
            + uncertainty
        )
        return float(abs(first) - (inward_shift + shift) * (1 + rounding) - rounding)


def excludes_unit_eigenvalue(matrix: Floats, error: Floats) -> bool:
    """Return whether 1 is proved not to be an eigenvalue of a matrix (n, n) known up to an error."""
    n = len(matrix)
    shifted = np.eye(n) - matrix
    inverse = inverses(shifted)
    uncertainty = norms(error) + (n + 4) * UNIT_ROUNDOFF * (n + norms(matrix))
    defect = np.asarray(np.eye(n) - inverse @ shifted, dtype=np.float64)
    with np.errstate(all="ignore"):
        return bool(norms(defect) + norms(inverse) * uncertainty < 0.5)
