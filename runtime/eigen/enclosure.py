"""Eigenvalues of matrices known up to an error, each with a bound.

Takes: square matrices, and a bound on what each entry may be off by.
Gives: `Enclosure`, `enclose_stack`, `enclose_eigenvalues`, `discs`; `least_radius`; `misses_an_eigenvalue`.
Guarantees: the bounds hold for every matrix within the error, whatever their conditioning; rounding in the
bounds themselves is charged. LAPACK's results are checked by their residuals, not believed.
Does not: know where a matrix comes from, or what is rigid (see `spectrum`).

X⁻¹(M + E)X = T + G, where X holds the right vectors and T = diag(Λ). Every eigenvalue is in one of
Gershgorin's discs of D⁻¹(T + G)D, whatever the positive diagonal D. Discs that touch hold together as many
eigenvalues as there are of them.

A queue that runs empty is nearly a Jordan block at zero, whose vectors are hardly several. Where it leaves
the spectral radius uncertain, X takes an orthonormal basis of what small eigenvalues span, or all, in the
place of their vectors; T is Schur's triangular form there, and D makes what is above its diagonal small.
"""

from __future__ import annotations

import functools
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.eigenpairs import Eigenpairs, components, eigenpairs, inverses
from apc.eigen.matrix_norms import PRODUCT_ROUNDINGS, balance, norms
from apc.frame.radius import UNIT
from apc.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Truths = NDArray[np.bool_]
Matrix = NDArray[Any]  # float64 or complex128

# Eigenvalues smaller than this decide nothing: e-folding in a fifth of a frame.
SMALL = 1e-2

# Floats scatter defective clusters at zero as far as this: below it eigenvalues are taken together.
CLUSTER = 0.3

# How much larger than the largest of a cluster's discs must be those of a scaling that all can have.
FARTHER = 1.25

# A spectral radius less certain than the first, relative to itself or to 1, has small ones taken together;
# what is less certain than the second is open.
SHARP, WIDE = 2e-12, 1e-9


@dataclass(frozen=True, slots=True, eq=False)
class Enclosure:
    """Bounds on the spectral radius (…), and how far each estimate can be from a true eigenvalue (…, n)."""

    low: Any
    high: Any
    errors: Floats


def enclose_eigenvalues(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Compute all eigenvalues of a matrix, the largest first, with their vectors, and enclose them.

    Parameters
    ----------
    matrix, error
        The matrix (n, n), and a bound on what each entry is off by.

    Returns
    -------
    The vectors are those of the part that the eigenvalue belongs to: the products of right and left ones are
    zero elsewhere.

    Notes
    -----
    Ordered by its strongly connected parts the matrix is block triangular: its eigenvalues, each as often as
    it is one, are those of the parts' own blocks. Equal peers in a directed chain make one Jordan block of
    the whole, which floats scatter far about; those of a part have nothing to do with the next part's.
    """
    n = len(matrix)
    values, errors = np.zeros(n, dtype=np.complex128), np.zeros(n)
    right, left = np.zeros((2, n, n), dtype=np.complex128)
    low = high = 0.0
    parts = components(~(np.abs(matrix) + error == 0)) if n else []
    for size in {len(part) for part in parts}:  # all of a size at once
        places = np.array([part for part in parts if len(part) == size])
        square = places[:, :, None], places[:, None]
        pairs, bounds = enclose_stack(matrix[square], error[square])
        values[places], errors[places] = pairs.values, bounds.errors
        right[square], left[square] = pairs.right, pairs.left
        low, high = float(np.maximum(low, bounds.low.max())), float(np.maximum(high, bounds.high.max()))
    order = descending(values)
    return Eigenpairs(values, right, left).at(order), Enclosure(low, high, errors[order])


def descending(values: Complexes) -> NDArray[np.intp]:
    """Return the order (…, n) of eigenvalues, the largest first, of a conjugate pair the one above."""
    return np.asarray(np.lexsort((-values.imag, values.real, -np.abs(values))))


def enclose_stack(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Do the same for a stack of matrices (k, n, n), each taken as a whole, with bounds on each."""
    # In one order in memory, no bit of an answer hangs on what is solved beside it.
    matrix, error = np.ascontiguousarray(matrix), np.ascontiguousarray(error)
    k, n = matrix.shape[:2]
    if n == 1:
        values, ones = matrix[:, 0].astype(np.complex128), np.ones((k, 1, 1), dtype=np.complex128)
        return Eigenpairs(values, ones, ones), discs(values, values, error[:, 0] * (1 + 4 * UNIT))
    with np.errstate(all="ignore"):
        values, right = np.linalg.eig(matrix)
        order = descending(values)
        right = np.take_along_axis(right, order[:, None], axis=2).astype(np.complex128)
        values = np.take_along_axis(values, order, axis=1).astype(np.complex128)
        pairs = Eigenpairs(values, right, inverses(right))
        bounds = _bounds(matrix, error, pairs, pairs.left, values)
        wide = bounds.high - bounds.low
        for row in np.flatnonzero(~(wide <= SHARP * np.maximum(bounds.low, 1.0))).tolist():
            again, closer = _enclose_split(matrix[row : row + 1], error[row : row + 1])
            values[row], right[row], pairs.left[row] = again.values[0], again.right[0], again.left[0]
            bounds.low[row], bounds.high[row], bounds.errors[row] = closer.low, closer.high, closer.errors
    return pairs, bounds


def _enclose_split(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Enclose the eigenvalues of one matrix (1, n, n) by their vectors, those below a limit together."""
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
        form, basis, small = load_pool("scipy.linalg").schur(
            matrix[0], output="complex", sort=functools.partial(_below, limit), check_finite=False
        )
        large = len(sizes) - small
        together = np.hstack([pairs.right[0, :, :large], basis[:, :small]])[None]
        values = np.concatenate([pairs.values[0, :large], np.diag(form)[:small]])[None]
        above = np.pad(np.triu(form[:small, :small], 1), [(large, 0)] * 2)
        enclosure = _bounds(matrix, error, replace(pairs, right=together), inverses(together), values, above)
        low, high = max(low, float(enclosure.low[0])), min(high, float(enclosure.high[0]))
        errors = np.minimum(errors, enclosure.errors[0])
    vectors = Eigenpairs(pairs.values, pairs.right * scale[:, None], pairs.left / scale)
    # No estimate is farther from its eigenvalue than both are from zero.
    return vectors, Enclosure(min(low, high), high, np.minimum(errors, sizes + high))


def _below(limit: float, value: complex) -> bool:
    return abs(value) < limit


def _bounds(
    matrix: Matrix,
    error: Floats,
    estimate: Eigenpairs,
    inverse: Matrix,
    values: Complexes,
    above: Complexes | None = None,
) -> Enclosure:
    """Enclose the eigenvalues of a stack.

    Parameters
    ----------
    matrix, error
        The matrices (k, n, n) and what they are off by.
    estimate, inverse
        What the eigenvalues may be, beside X, and about X⁻¹ (k, n, n).
    values, above
        The diagonal of T (k, n), and what is above it (n, n), None if nothing is.

    Notes
    -----
    With the row and column of an eigenvalue c scaled by 1/α > 1, its disc shrinks to |G_cc| + α Σ_b |G_cb|,
    and those of others b grow by |G_bc| / α. As long as these keep clear of it, it holds one eigenvalue
    (Wilkinson, The Algebraic Eigenvalue Problem, 1965, chapter 2). For what is above the diagonal D = diag(d)
    with d = (r − N)⁻¹ 1, r larger than N's eigenvalues: then N d < r d.
    """
    n = matrix.shape[-1]
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    fine = (n + 4) * UNIT if np.isrealobj(matrix) else charge  # a real matrix makes sums of n real products
    basis = estimate.right
    residual = matrix @ basis - basis * values[:, None]
    size, weight = np.abs(basis), np.abs(inverse)
    doubt = (error + fine * np.abs(matrix)) @ size + 4 * UNIT * size * np.abs(values)[:, None]
    if above is not None:
        residual = residual - basis @ above
        doubt += charge * (size @ np.abs(above))
    doubt += charge * np.abs(residual)
    over = (np.abs(inverse @ residual) + weight @ doubt) * (1 + charge)  # |G|, but for the inverse
    # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    wrong = (np.abs(np.eye(n) - inverse @ basis) + charge * (weight @ size)).sum(axis=2)
    defect = wrong.max(axis=1)
    over += (wrong / (1 - defect)[:, None])[:, :, None] * over.max(axis=1, keepdims=True)

    if above is not None:
        over = over + np.abs(above) * (1 + 4 * UNIT)
        over = over * _scaling(over[0], above)
    total = over.sum(axis=2) * (1 + charge)
    gap = np.abs(values[:, :, None] - values[:, None]) * (1 - 8 * UNIT) - total[:, :, None] - total[:, None]
    np.einsum("kii->ki", gap)[:] = np.inf
    share = np.where(gap > 0, over / gap, np.inf).max(axis=1) * (1 + 8 * UNIT)
    first = np.einsum("kii->ki", over)
    less = (first + share * (total - first)) * (1 + 8 * UNIT)
    radii = np.where(share < 1, np.minimum(less, total), total) * (1 + charge)
    known = (defect < 0.5) & np.isfinite(radii).all(axis=1)
    return discs(estimate.values, values, np.where(known[:, None], radii, np.inf))


def _scaling(over: Floats, above: Complexes) -> Floats:
    """Return d_j / d_i (n, n) of a D that makes small what stands above the diagonal."""
    scale = np.ones(len(over))
    part = np.flatnonzero(above.any(axis=0) | above.any(axis=1))
    within = over[np.ix_(part, part)]
    if np.isfinite(within).all() and len(part):
        most = FARTHER * float(np.abs(np.linalg.eigvals(within)).max())
        result = inverses(most * np.eye(len(part)) - within).sum(axis=1)
        if (result > 0).all():
            scale[part] = result / result.max()
    return scale / scale[:, None]


def discs(values: Complexes, centres: Complexes, radii: Floats, inner: Floats | None = None) -> Enclosure:
    """Return bounds on the spectral radius (…) and how far each estimate (…, n) is from its eigenvalue.

    k discs that hang together hold k eigenvalues, nobody knows which in which: each estimate is then off by
    at most the distance to the far side of any of them. `inner` (…, n) is what of each disc is not below the
    bound that is wanted, without it the least magnitude.
    """
    n = values.shape[-1]
    touching = (
        np.abs(centres[..., :, None] - centres[..., None, :]) <= radii[..., :, None] + radii[..., None, :]
    )
    label, spread = None, np.broadcast_to(np.arange(n), values.shape)
    while label is None or not np.array_equal(spread, label):
        label = spread
        spread = np.where(touching, label[..., None, :], n).min(axis=-1, initial=n)
    together = label[..., :, None] == label[..., None, :]
    reach = np.abs(values[..., :, None] - centres[..., None, :]) + radii[..., None, :]
    floor = 0.0 if inner is None else -np.inf
    inner = np.abs(centres) * (1 - 4 * UNIT) - radii if inner is None else inner
    least = np.where(together, inner[..., None, :], np.inf).min(axis=-1, initial=np.inf)
    return Enclosure(
        low=least.max(axis=-1, initial=floor),
        high=((np.abs(centres) + radii) * (1 + 4 * UNIT)).max(axis=-1, initial=0.0),
        errors=np.where(together, reach, 0.0).max(axis=-1, initial=0.0) * (1 + 4 * UNIT),
    )


def least_radius(matrix: Floats, slopes: Floats, error: Floats) -> float:
    """Return a lower bound on the spectral radius of M + Σ ε_k S_k + E for all |ε_k| ≤ 1, or 0 for none.

    Parameters
    ----------
    matrix, slopes, error
        M (n, n), S (m, n, n) and a bound on what each entry of E is.

    Notes
    -----
    X⁻¹(M + …)X = [λ + g, c; r, T + H], λ being the largest eigenvalue, alone, and T that of all others. A z
    near λ is an eigenvalue if z − λ − g = c (z − T − H)⁻¹ r, whose right side is at most ‖c‖‖r‖/(s − ρ), as
    long as |z − λ − g| ≤ ρ < s = σ_min(λ − T) − |g| − ‖H‖. By Rouché's theorem one is within the ρ at which
    both are equal. It goes along with λ + g, which only what moves it inwards brings nearer to zero.
    """
    with np.errstate(all="ignore"):
        n, linalg = len(matrix), load_pool("scipy.linalg")
        scale = balance(np.abs(matrix) + np.abs(slopes).sum(axis=0))
        units = scale / scale[:, None]
        matrix, slopes, error = matrix * units, slopes * units, error * units
        pairs = eigenpairs(matrix)
        pairs = pairs.at(descending(pairs.values))
        first = pairs.values[0]
        apart = np.abs(pairs.values[1:] - first).min(initial=np.inf) / 2
        form, basis, count = linalg.schur(
            matrix, output="complex", sort=lambda value: abs(value - first) > apart, check_finite=False
        )
        if count != n - 1:
            return 0.0
        right = np.hstack([pairs.right[:, :1], basis[:, :count]])
        left, centre = inverses(right), linalg.block_diag(first, form[:count, :count])
        moves = left @ slopes @ right
        charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
        size, weight = np.abs(right), np.abs(left)
        off = np.abs(left @ matrix @ right - centre)
        off += weight @ (error + 2 * charge * (np.abs(matrix) + np.abs(slopes).sum(axis=0))) @ size
        # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
        wrong = norms(np.abs(np.eye(n) - left @ right) + charge * (weight @ size))
        doubt = float(wrong / (1 - wrong) * (norms(centre) + norms(off) + norms(moves).sum()))

        def most(rows: slice, columns: slice) -> float:
            """Return a bound on the norm of a block of what moves."""
            block = norms(moves[:, rows, columns]).sum() + norms(off[rows, columns]) + doubt
            return float(block) * (1 + charge)

        item, rest = slice(0, 1), slice(1, n)
        others = np.linalg.svd(first * np.eye(count) - centre[1:, 1:], compute_uv=False)
        away = (others - charge * others.max(initial=0.0)).min(initial=np.inf)
        spare = away - most(item, item) - most(rest, rest)
        square = spare**2 - 4 * most(item, rest) * most(rest, item)
        if not (wrong < 1 and spare > 0 and square > 0):
            return 0.0
        near = 2 * most(item, rest) * most(rest, item) / (spare + np.sqrt(square))
        inwards = np.abs((np.exp(-1j * np.angle(first)) * moves[:, 0, 0]).real).sum() + off[0, 0] + doubt
        return float(abs(first) - (inwards + near) * (1 + charge) - charge)


def misses_an_eigenvalue(matrix: Floats, error: Floats) -> bool:
    """Say whether 1 is certainly no eigenvalue of a matrix (n, n) known up to an error."""
    n = len(matrix)
    away = np.eye(n) - matrix
    inverse = inverses(away)
    doubt = norms(error) + (n + 4) * UNIT * (n + norms(matrix))
    wrong = np.asarray(np.eye(n) - inverse @ away, dtype=np.float64)
    with np.errstate(all="ignore"):
        return bool(norms(wrong) + norms(inverse) * doubt < 0.5)
