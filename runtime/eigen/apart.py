"""All eigenvalues of many matrices at once, each with a bound, where those that decide stand apart.

Takes: matrices (k, n, n), and bounds on what each entry may be off by.
Gives: `Apart`, `pairs_apart`; `pairs_by_discs`, `padded`.
Guarantees: the bounds hold for every matrix within the errors, whatever their conditioning; rounding in the
bounds themselves is charged. Where two eigenvalues are too near, or vectors too alike, nothing is said.
Does not: enclose clusters, or look for a better split of large from small (see `enclosure`).

One call of LAPACK for all right vectors, and for `pairs_apart` one for all left ones; all else are products
of small matrices. Its bounds are those of `enclosure` with every large eigenvalue a block of its own.
"""

from __future__ import annotations

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.dominant import resolvents
from apc.eigen.eigenpairs import Eigenpairs, eigenpairs
from apc.eigen.pseudospectrum import PRODUCT_ROUNDINGS, pseudospectral_radius
from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Matrix = NDArray[Any]  # float64 or complex128

# Eigenvalues smaller than this decide nothing (e-folding in a fifth of a frame) and are often one defective
# cluster at zero, the queues running empty; the first split between large and small is here.
SMALL = 1e-2

# Small ones are shown to be within half the distance to the next, and this, which is clear of 1.
WITHIN = 0.5

# How much larger what drives a block may become where one beside it is scaled.
GROWN = 1024.0

# What squares hide that leave the range of floats.
TINY = 1e-150

# Roundings of a column beside its n terms. Of a real matrix times vectors both parts are sums of n terms, and
# what is taken from it is a product of two complex numbers, or such a sum.
EXTRA = 4

# Eigenvalues of a worse condition than this have vectors too alike for their discs, |w| |v| where w v = 1.
ALIKE = 1e4

# A bound this small needs no closer look: a few roundings of what lies on the circle.
LEAST = 2.0**-50

# Sweeps of balancing: after twice as many the bounds are hardly less.
SWEEPS = 8


@dataclass(frozen=True, slots=True, eq=False)
class Apart:
    """Bounds on the eigenvalues of one matrix, the largest first, and on the largest magnitude.

    Exactly one true eigenvalue is within `near` of each large one. All small ones are within `near` of each
    of them, and `sharpened` gives closer bounds on all, which is most of the work.
    """

    low: float
    high: float
    near: Floats  # (n,)
    sharpened: Callable[[], Floats]


def padded(size: int) -> int:
    """Return the size to which matrices are filled up, to be solved with others."""
    return max(8, 4 * -(-size // 4))


def pairs_by_discs(blocks: Sequence[tuple[Floats, Floats]]) -> list[tuple[Eigenpairs, Apart | None]]:
    """Return all eigenvalues of each matrix, in order, and the bounds that their vectors alone give.

    There are none where large ones don't stand apart, where the vectors are too alike, or where a closer look
    may know twice as much.

    Parameters
    ----------
    blocks
        Real matrices (n, n) of one `padded` size, each with a bound on what its entries are off by.

    Notes
    -----
    X⁻¹(M + E)X = Λ + G with all right vectors X: Gershgorin's discs, and as in `pairs_apart` what is scaled
    where one stands alone. Small ones whose discs touch are each somewhere in these. It asks for nothing but
    one solve: eigenvalues at zero by structure, which `pairs_apart` takes for a block, mostly have vectors of
    their own, and a bound hundreds of times as close.

    Matrices are filled up with entries on the diagonal that are larger than any eigenvalue, always to the
    same size: no bit of an answer hangs on what is solved beside it.
    """
    sizes = [len(matrix) for matrix, _ in blocks]
    n = padded(sizes[0])
    matrix, error = np.zeros((2, len(blocks), n, n))
    for row, ((own, off), size) in enumerate(zip(blocks, sizes, strict=True)):
        matrix[row, :size, :size], error[row, :size, :size] = own, off
        if size < n:
            beyond = 2.0 * size * float(np.abs(own).max())
            matrix[row, range(size, n), range(size, n)] = beyond * np.arange(1, n - size + 1)
    with np.errstate(all="ignore"):
        values, right = np.linalg.eig(matrix)
        order = np.lexsort((-values.imag, values.real, -np.abs(values)))
        every = np.arange(len(blocks))[:, None]
        values = values[every, order].astype(np.complex128)
        right = right.swapaxes(1, 2)[every, order].swapaxes(1, 2).astype(np.complex128)
        try:
            left = np.linalg.inv(right)
        except np.linalg.LinAlgError:
            left, told = right, list[Apart | None]([None] * len(blocks))
        else:
            told = _discs(matrix, error, Eigenpairs(values, right, left), n - np.array(sizes))
    return [
        (
            Eigenpairs(values[row, n - size :], right[row, :size, n - size :], left[row, n - size :, :size]),
            apart,
        )
        for row, (size, apart) in enumerate(zip(sizes, told, strict=True))
    ]


def _discs(matrix: Floats, error: Floats, pairs: Eigenpairs, others: NDArray[np.intp]) -> list[Apart | None]:
    """Return the bounds of `pairs_by_discs`; the first so many eigenvalues of each are none of its own."""
    n = matrix.shape[-1]
    values, right, left = pairs.values, pairs.right, pairs.left
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    size, weight, magnitudes = np.abs(right), np.abs(left), np.abs(values)
    residual = matrix @ right
    residual -= right * values[:, None]
    doubt = (error + (n + EXTRA) * UNIT * np.abs(matrix)) @ size
    doubt += size * (EXTRA * UNIT * magnitudes)[:, None]
    doubt += charge * np.abs(residual)
    # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    product = weight @ size
    wrong = (np.abs(np.eye(n) - left @ right) + charge * product).sum(axis=2)
    defect = wrong.max(axis=1)
    over = weight @ doubt
    attainable = _diagonal(over).copy()  # whatever the vectors
    over += np.abs(left @ residual)
    over *= 1 + charge
    over += (wrong / (1 - defect)[:, None])[:, :, None] * over.max(axis=1, keepdims=True)
    total, first = over.sum(axis=2) * (1 + charge), _diagonal(over)
    gap = np.abs(values[:, :, None] - values[:, None]) * (1 - 8 * UNIT)
    gap -= total[:, :, None]
    gap -= total[:, None]
    _diagonal(gap)[...] = np.inf
    alone = gap.min(axis=1) > 0
    share = (over / gap).max(axis=1) * (1 + 8 * UNIT)
    radius = np.where(alone & (share < 1), (first + share * (total - first)) * (1 + 8 * UNIT), total)
    own = np.arange(n) >= others[:, None]
    outer = (magnitudes + radius) * (1 + 4 * UNIT) * own
    # Those that touch are small; each is in one of their discs.
    reach = np.where(alone, 0.0, outer).max(axis=1, keepdims=True)
    near = np.where(alone, radius, magnitudes + reach) * (1 + 4 * UNIT)
    least = np.where(alone & own, magnitudes - radius, 0.0).max(axis=1) * (1 - 4 * UNIT)
    sharp = (near <= 2 * attainable) | (near < LEAST) | ~own
    high = outer.max(axis=1)
    known = (defect < 0.5) & (_diagonal(product).max(axis=1) < ALIKE) & (high < np.inf)
    known &= (sharp & (alone | (magnitudes < SMALL))).all(axis=1)
    answers: list[Apart | None] = [None] * len(matrix)
    for one in np.flatnonzero(known).tolist():
        told = near[one, others[one] :]
        answers[one] = Apart(
            max(0.0, float(least[one])), float(high[one]), told, functools.partial(_told, told)
        )
    return answers


def _told(near: Floats) -> Floats:
    return near


def pairs_apart(matrix: Floats, error: Floats) -> tuple[Eigenpairs, list[Apart | None]]:
    """Return all eigenvalues of each matrix, the largest first, with their vectors, and bounds on them.

    There are none where those that are not small don't stand apart, or all are small.

    Parameters
    ----------
    matrix, error
        Real matrices (k, n, n), and a bound on what each entry is off by.

    Notes
    -----
    X = [X₁ X₂]: X₁ the right vectors of the large eigenvalues, X₂ annihilated by their left vectors, which
    are those of unit length at right angles to X₁ less their part in X₁. X⁻¹(M + E)X = diag(Λ, T) + G as in
    `enclosure`; what `_alone` says there of one disc beside others is said here of every large one.
    """
    with np.errstate(all="ignore"):
        scale = _alike(np.abs(matrix) + error)
        units = scale[:, None] / scale[:, :, None]
        matrix, error = matrix * units, error * units
        pairs = _in_order(eigenpairs(matrix))
        bounds = _bounds(matrix, error, pairs)
    return Eigenpairs(pairs.values, pairs.right * scale[:, :, None], pairs.left / scale[:, None]), bounds


def _diagonal(stack: Matrix) -> Matrix:
    """Return the diagonals (k, n) of matrices (k, n, n) that stand one behind the other, to be written to."""
    return stack.reshape(len(stack), -1)[:, :: stack.shape[-1] + 1]


def _in_order(pairs: Eigenpairs) -> Eigenpairs:
    """Return the pairs of each matrix in order, the largest first, of a conjugate pair the one above."""
    values, one = pairs.values, np.arange(len(pairs.values))[:, None]
    order = np.lexsort((-values.imag, values.real, -np.abs(values)))
    right = pairs.right.swapaxes(1, 2)[one, order].swapaxes(1, 2)
    return Eigenpairs(values[one, order], right, pairs.left[one, order])


def _bounds(matrix: Floats, error: Floats, pairs: Eigenpairs) -> list[Apart | None]:
    """Return the bounds on the eigenvalues of balanced matrices, see `pairs_apart`."""
    k, n = matrix.shape[:2]
    values, right, left = pairs.values, pairs.right, pairs.left
    large = np.abs(values) >= SMALL
    beside = ~large  # columns of X₂
    basis = right
    if beside.any():
        # A pair spans the real and imaginary parts of its vector: a real basis of what is at right angles.
        spanned = np.where(values.imag[:, None] < 0, right.imag, right.real)
        straight = np.where(beside[:, None], np.linalg.qr(spanned)[0], 0.0)
        along = left / np.einsum("kij,kji->ki", left, right)[:, :, None]
        along[beside] = 0.0
        straight = straight - (right @ (along @ straight)).real
        basis = np.where(large[:, None], right, straight)
    try:
        inverse = np.linalg.inv(basis)
    except np.linalg.LinAlgError:
        return [None] * k
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    rounded = (n + EXTRA) * UNIT  # see `EXTRA`
    moved = matrix @ basis
    size, weight = np.abs(basis), np.abs(inverse)
    form = inverse @ moved
    own = np.einsum("kii->ki", form) * large
    small = np.where(beside[:, :, None] & beside[:, None], form.real, 0.0)  # real, as what it is of is
    blocks = small.astype(np.complex128)
    np.einsum("kii->ki", blocks)[:] += own
    doubt = np.abs(moved - basis @ blocks) + (error + rounded * np.abs(matrix)) @ size
    doubt += rounded * (size @ np.abs(blocks))
    # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    wrong = np.abs(np.eye(n) - inverse @ basis).sum(axis=2)
    wrong += charge * (weight @ size.sum(axis=2)[:, :, None])[:, :, 0]
    defect = wrong.max(axis=1)
    left_over = weight @ doubt * (1 + charge)
    left_over += (wrong / (1 - defect)[:, None])[:, :, None] * left_over.max(axis=1, keepdims=True)

    # ‖G_cb‖ for the large, one column b each, and all small ones together.
    alone = np.where(large[:, None], left_over, 0.0)
    squared = np.square(left_over)
    across = np.sqrt(np.where(large[:, None], 0.0, squared).sum(axis=2)) + TINY
    total = (alone.sum(axis=2) + across) * (1 + charge)
    driving = np.sqrt((squared * beside[:, :, None]).sum(axis=1)) + TINY  # ‖G_cb‖ of them
    within = np.sqrt((np.square(across) * beside).sum(axis=1))
    off = (within + (driving * large).sum(axis=1)) * (1 + charge)
    distance = np.abs(own)
    clear = np.where(large, distance - total, np.inf).min(axis=1)
    inner = np.minimum(clear / 2, WITHIN)  # all small ones are shown to be within
    known = (defect < 0.5) & large.any(axis=1) & (inner > 0)
    if beside.any():
        shrunk = small / inner[:, None, None]
        away = (GROWN * off / inner + 2 * UNIT * np.sqrt(np.square(shrunk).sum(axis=(1, 2)))) * (1 + charge)
        known &= resolvents(shrunk) * away < 0.5

    gap = np.abs(own[:, :, None] - own[:, None]) * (1 - 8 * UNIT) - total[:, :, None] - total[:, None]
    pair = large[:, :, None] & large[:, None] & ~np.eye(n, dtype=np.bool_)
    gap = np.where(pair, gap, np.inf)
    known &= (gap > 0).all(axis=(1, 2))
    share = np.maximum((alone / gap).max(axis=1), 1 / (GROWN - 1)) * (1 + 8 * UNIT)
    first = np.einsum("kii->ki", left_over)
    less = (first + share * (total - first)) * (1 + 8 * UNIT)
    radius = np.where(share < 1, np.minimum(less, total), total)
    near = np.where(large, np.abs(values - own) + radius, np.abs(values) + inner[:, None]) * (1 + 8 * UNIT)
    reach = np.where(large, distance + radius, -np.inf).max(axis=1) * (1 + 4 * UNIT)
    least = np.where(large, distance - radius, -np.inf).max(axis=1) * (1 - 4 * UNIT)
    answers: list[Apart | None] = [None] * k
    for one in np.flatnonzero(known & np.isfinite(near).all(axis=1)).tolist():
        places = np.flatnonzero(beside[one])
        sharpened = functools.partial(
            _sharpened, small[one][places[:, None], places], float(off[one]), values[one], near[one], places
        )
        answers[one] = Apart(float(least[one]), float(reach[one]), near[one], sharpened)
    return answers


def _sharpened(
    block: Floats, off: float, values: Complexes, near: Floats, places: NDArray[np.intp]
) -> Floats:
    """Return the bounds (n,) with those on small eigenvalues as close as their pseudospectrum has them."""
    found = near.copy()
    if len(places):
        radius = pseudospectral_radius(block, off)
        found[places] = np.minimum(near[places], (np.abs(values[places]) + radius) * (1 + 8 * UNIT))
    return found


def _alike(size: Floats) -> Floats:
    """Return d (k, n), powers of two, that make rows and columns of D⁻¹ |M| D about alike in norm.

    As `pseudospectrum.balance`, of all states at once: each goes half-way, as those beside it go as well.
    """
    squared = np.square(size)
    _diagonal(squared)[...] = 0.0
    turned = squared.swapaxes(1, 2)
    scale = np.ones((*size.shape[:2], 1))  # squared
    free = (squared @ scale > 0) & (turned @ scale > 0)
    for _ in range(SWEEPS):
        step = (squared @ scale) / (turned @ (1 / scale))  # rows by columns, times the scale squared
        scale *= np.where(free, np.sqrt(np.sqrt(step) / scale), 1.0)
    exponents = np.log2(scale[:, :, 0]) / 2
    return np.asarray(np.exp2(np.round(np.where(np.isfinite(exponents), exponents, 0.0))))
