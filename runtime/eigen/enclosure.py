"""Eigenvalues of matrices known up to an error, each with a bound.

Takes: square matrices, and a bound on what each entry may be off by.
Gives: `Enclosure`, `enclose_stack`, `enclose_eigenvalues`, `discs`; `misses_one`.
Guarantees: the bounds hold for every matrix within the error, whatever their conditioning; rounding in the
bounds themselves is charged. LAPACK's results are checked by their residuals, not believed.
Does not: know where a matrix comes from, or what is rigid (see `spectrum`).

X⁻¹(M + E)X = diag(Λ, T) + G, where X = [X₁ X₂] holds the right vectors of the large eigenvalues Λ, and in
X₂ a basis of what their left vectors annihilate, on which M acts as T. Every eigenvalue is in one of
Gershgorin's discs about Λ, or within the pseudospectral radius of T about zero (Feingold and Varga, Block
diagonally dominant matrices, 1962). Discs that touch hold together as many eigenvalues as there are of them.

All eigenvalues count as large at first. A queue that runs empty is nearly a Jordan block at zero, whose
vectors are hardly several: where it leaves the spectral radius uncertain, the eigenvalues that are small are
taken together as T, and the split between large and small is looked for at the widest gaps.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.eigenpairs import Eigenpairs, components, eigenpairs, inverses
from apc.eigen.pseudospectrum import PRODUCT_ROUNDINGS, balance, norms, pseudospectral_radius
from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Truths = NDArray[np.bool_]
Matrix = NDArray[Any]  # float64 or complex128

# Eigenvalues smaller than this decide nothing (e-folding in a fifth of a frame) and are often one defective
# cluster at zero; the first split between large and small is here.
SMALL = 1e-2

# A spectral radius less certain than the first, relative to itself or to 1, has the split at `SMALL` tried;
# less certain than the second, so many other splits.
SHARP, WIDE, SPLITS = 2e-12, 1e-9, 8

# Eigenvalues nearer to one another than this, relatively, are not split from each other.
CLOSE = 1e-6

# How much larger what drives the block of small ones may become where a disc beside it is scaled.
GROWN = 1024.0

# What squares hide that leave the range of floats.
TINY = 1e-150


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
    for part in components(~(np.abs(matrix) + error == 0)) if n else []:
        square = np.ix_(part, part)
        pairs, bounds = enclose_stack(matrix[square][None], error[square][None])
        values[part], errors[part] = pairs.values[0], bounds.errors[0]
        right[square], left[square] = pairs.right[0], pairs.left[0]
        low, high = float(np.maximum(low, bounds.low[0])), float(np.maximum(high, bounds.high[0]))
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
        bounds = _bounds(matrix, error, pairs, np.ones((k, n), dtype=np.bool_))
        wide = bounds.high - bounds.low
        for row in np.flatnonzero(~(wide <= SHARP * np.maximum(bounds.low, 1.0))).tolist():
            again, closer = _enclose_split(matrix[row : row + 1], error[row : row + 1])
            values[row], right[row], pairs.left[row] = again.values[0], again.right[0], again.left[0]
            bounds.low[row], bounds.high[row], bounds.errors[row] = closer.low, closer.high, closer.errors
    return pairs, bounds


def _enclose_split(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Enclose the eigenvalues of one matrix (1, n, n) by as many splits as it needs, all of which hold."""
    n = matrix.shape[-1]
    scale = balance(np.abs(matrix[0]) + error[0])
    units = scale / scale[:, None]
    matrix, error = matrix * units, error * units
    pairs = eigenpairs(matrix)
    pairs = pairs.at(descending(pairs.values)[0])
    sizes = np.abs(pairs.values[0])
    low, high, errors = 0.0, np.inf, np.full(n, np.inf)
    for count, large in enumerate(_splits(sizes)):
        if count > 1 and high - low <= WIDE * max(low, 1.0):
            break
        found = _bounds(matrix, error, pairs, np.arange(n)[None] < large)
        low, high = max(low, float(found.low[0])), min(high, float(found.high[0]))
        errors = np.minimum(errors, found.errors[0])
    # No estimate is farther from its eigenvalue than both are from zero.
    vectors = Eigenpairs(pairs.values, pairs.right * scale[:, None], pairs.left / scale)
    return vectors, Enclosure(min(low, high), high, np.minimum(errors, sizes + high))


def _splits(sizes: Floats) -> Iterator[int]:
    """Yield how many eigenvalues of falling magnitudes (n,) to count as large; conjugates stay together."""
    first = int((sizes >= SMALL).sum())
    yield len(sizes)
    yield first
    ratios = np.append(sizes[1:], 0.0) / np.maximum(sizes, np.finfo(np.float64).tiny)
    gaps = [int(k) + 1 for k in np.argsort(ratios[:-1], kind="stable") if ratios[k] < 1 - CLOSE]
    yield from [count for count in gaps if count != first and sizes[count - 1] > SMALL][:SPLITS]
    yield 0


def _bounds(matrix: Matrix, error: Floats, pairs: Eigenpairs, large: Truths) -> Enclosure:
    """Enclose the eigenvalues of a stack, of each matrix the first so many as large ones (k, n).

    Notes
    -----
    With the block of a large eigenvalue c scaled by 1/α > 1, the discs are those of G_cb α, and of G_bc / α
    for the others b: the first shrinks to |G_cc| + α Σ_b ‖G_cb‖, and the others grow. As long as these keep
    clear of it, it holds one eigenvalue (Wilkinson, The Algebraic Eigenvalue Problem, 1965, chapter 2).
    """
    n = matrix.shape[-1]
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    fine = (n + 4) * UNIT if np.isrealobj(matrix) else charge  # a real matrix makes sums of n real products
    values, small = np.where(large, pairs.values, 0.0), ~large
    split = bool(small.any())
    basis, inverse = pairs.right, pairs.left
    if split:
        # At right angles to the large ones' right vectors, less what their left vectors see of it.
        aside = np.linalg.qr(pairs.right)[0]
        scale = np.einsum("kij,kji->ki", pairs.left, pairs.right)
        seen = np.where(large[:, :, None], pairs.left / scale[:, :, None], 0.0)
        basis = np.where(large[:, None], pairs.right, aside - pairs.right @ (seen @ aside))
        inverse = inverses(basis)
    elif not np.allclose(np.einsum("kij,kji->ki", inverse, basis), 1.0):
        inverse = inverses(basis)
    moved = matrix @ basis
    # T, in the places of the small ones.
    block = np.where(small[:, :, None] & small[:, None], inverse @ moved, 0.0) if split else None
    residual = moved - basis * values[:, None]
    size, weight = np.abs(basis), np.abs(inverse)
    doubt = (error + fine * np.abs(matrix)) @ size + 4 * UNIT * size * np.abs(values)[:, None]
    if block is not None:
        residual = residual - basis @ block
        doubt += charge * (size @ np.abs(block))
    doubt += charge * np.abs(residual)
    over = (np.abs(inverse @ residual) + weight @ doubt) * (1 + charge)  # |G|, but for the inverse
    # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    wrong = (np.abs(np.eye(n) - inverse @ basis) + charge * (weight @ size)).sum(axis=2)
    defect = wrong.max(axis=1)
    over += (wrong / (1 - defect)[:, None])[:, :, None] * over.max(axis=1, keepdims=True)

    first, into = np.einsum("kii->ki", over), over
    total = np.where(large[:, None], over, 0.0).sum(axis=2)
    radii, grown, least = total, total, 0.0
    if block is not None:
        squares = np.square(over)
        across = np.sqrt(np.where(small[:, None], squares, 0.0).sum(axis=2)) + TINY
        driving = np.sqrt(np.where(small[:, :, None], squares, 0.0).sum(axis=1)) + TINY
        off = np.sqrt(np.where(small, np.square(across), 0.0).sum(axis=1)) + (driving * large).sum(axis=1)
        total = (total + across) * (1 + charge)
        nearest = np.abs(np.where(small, pairs.values, 0.0)).max(axis=1)
        inner, outer = (
            pseudospectral_radius(block, part * off * (1 + charge), nearest)[:, None] for part in (1.0, GROWN)
        )
        radii, grown, least = np.where(large, total, inner), np.where(large, total, outer), 1 / (GROWN - 1)
        into = np.where(large[:, :, None], over, 0.0)
    gap = np.abs(values[:, :, None] - values[:, None]) * (1 - 8 * UNIT) - grown[:, :, None] - radii[:, None]
    np.einsum("kii->ki", gap)[:] = np.inf
    share = np.maximum(np.where(gap > 0, into / gap, np.inf).max(axis=1), least) * (1 + 8 * UNIT)
    less = (first + share * (total - first)) * (1 + 8 * UNIT)
    radii = np.where(large & (share < 1), np.minimum(less, radii), radii) * (1 + charge)
    known = (defect < 0.5) & np.isfinite(radii).all(axis=1)
    return discs(pairs.values, values, np.where(known[:, None], radii, np.inf))


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
    inner = np.abs(centres) * (1 - 4 * UNIT) - radii if inner is None else inner
    least = np.where(together, inner[..., None, :], np.inf).min(axis=-1, initial=np.inf)
    return Enclosure(
        low=np.maximum(least.max(axis=-1, initial=0.0), 0.0),
        high=((np.abs(centres) + radii) * (1 + 4 * UNIT)).max(axis=-1, initial=0.0),
        errors=np.where(together, reach, 0.0).max(axis=-1, initial=0.0) * (1 + 4 * UNIT),
    )


def misses_one(matrix: Floats, error: Floats) -> bool:
    """Say whether 1 is certainly no eigenvalue of a matrix (n, n) known up to an error."""
    n = len(matrix)
    away = np.eye(n) - matrix
    inverse = inverses(away)
    doubt = norms(error) + (n + 4) * UNIT * (n + norms(matrix))
    wrong = np.asarray(np.eye(n) - inverse @ away, dtype=np.float64)
    with np.errstate(all="ignore"):
        return bool(norms(wrong) + norms(inverse) * doubt < 0.5)
