"""Eigenvalues of a matrix known up to an error, each with a bound.

Takes: a square matrix and a bound on what each entry may be off by.
Gives: `Enclosure`, `enclose_eigenvalues`, `enclose_all`, `discs`.
Guarantees: the bounds hold for every matrix within the error, whatever their conditioning; rounding in the
bounds themselves is charged. LAPACK's results are checked by their residuals, not believed.
Does not: know where the matrix comes from, or what is rigid (see `spectrum`).

States that drive each other are a part. Ordered by parts, the matrix is block triangular: its eigenvalues,
each as often as it is one, are those of the parts' own blocks. Peers in a directed chain are a part each.
Equal ones make one Jordan block of the whole, whose eigenvalues floats scatter far about; those of a part
have nothing to do with the next part's.

What one solve tells of all comes first; where that says too little, parts of one size are enclosed at once if
their eigenvalues stand apart (see `apart`), and one by one where that leaves the radius uncertain.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.apart import GROWN, SMALL, Apart, padded, pairs_apart, pairs_by_discs
from apc.eigen.eigenpairs import LARGE, Eigenpairs, components, eigenpairs
from apc.eigen.pseudospectrum import PRODUCT_ROUNDINGS, balance, norms, pseudospectral_radius
from apc.eigen.relative import independent_places
from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Places = NDArray[np.intp]
Matrix = NDArray[Any]  # float64 or complex128

# A radius less certain than this, or than this part of it where it is above 1, is worth more work: other
# splits, this many; fewer of a matrix of more states, where each takes a second.
WIDE = 1e-9
SPLITS_TRIED, FEWER_SPLITS, MANY_STATES = 8, 2, 300

# What the quick way leaves wider, relative to a radius of 1 or more, is looked at again.
SHARP = 2e-12

# Eigenvalues nearer to one another than this, relatively, are enclosed together: their own vectors are hardly
# two.
CLOSE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class Enclosure:
    """Bounds on the spectral radius, and how far each estimate can be from a true eigenvalue.

    `near` are such bounds as well, those on small eigenvalues wide; `telling` gives `errors`, which are made
    each time they are asked for.
    """

    low: float
    high: float
    near: Floats  # (n,)
    telling: Callable[[], Floats]

    @property
    def errors(self) -> Floats:
        """How far each estimate can be from a true eigenvalue (n,)."""
        return self.telling()


def _told(low: float, high: float, errors: Floats) -> Enclosure:
    """Return bounds of which nothing is left to make."""
    return Enclosure(low, high, errors, lambda: errors)


@dataclass(frozen=True, slots=True, eq=False)
class _Parts:
    """A matrix with its error, cut into parts: those of one state, and those of more."""

    matrix: Matrix
    error: Floats
    alone: Places
    several: tuple[Places, ...]


def enclose_eigenvalues(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Compute all eigenvalues, the largest first, with their vectors, and enclose them.

    Parameters
    ----------
    matrix, error
        The matrix (n, n), and a bound on what each entry is off by.

    Returns
    -------
    The vectors are those of the part that the eigenvalue belongs to: the products of right and left ones are
    zero elsewhere.
    """
    return enclose_all([(matrix, error, False)])[0]


def enclose_all(given: Sequence[tuple[Matrix, Floats, bool]]) -> list[tuple[Eigenpairs, Enclosure]]:
    """Do the same for many matrices at once.

    Parameters
    ----------
    given
        Of each the matrix, its error, and whether it is not to be cut where discs tell too little.
    """
    cuts = [_cut(matrix, error) for matrix, error, _ in given]
    found = _enclose_by_discs(cuts)
    for place, (matrix, error, whole) in enumerate(given):
        if whole and found[place] is None and len(matrix) > 1:
            cuts[place] = _Parts(matrix, error, np.zeros(0, dtype=np.intp), (np.arange(len(matrix)),))
    blocks = [
        (cut.matrix[part[:, None], part], cut.error[part[:, None], part])
        for cut, quick in zip(cuts, found, strict=True)
        if quick is None
        for part in cut.several
    ]
    rest = iter(_enclose_blocks(blocks))
    return [
        _joined(cut, [next(rest) for _ in cut.several]) if quick is None else quick
        for cut, quick in zip(cuts, found, strict=True)
    ]


def _cut(matrix: Matrix, error: Floats) -> _Parts:
    parts = components(~(np.abs(matrix) + error == 0)) if len(matrix) else []
    alone = np.array([part[0] for part in parts if len(part) == 1], dtype=np.intp)
    return _Parts(matrix, error, alone, tuple(part for part in parts if len(part) > 1))


def _enclose_by_discs(cuts: Sequence[_Parts]) -> list[tuple[Eigenpairs, Enclosure] | None]:
    """Enclose the eigenvalues of matrices of one part, and some states beside it, where discs tell enough.

    Parts of about one size go at once.
    """
    found: list[tuple[Eigenpairs, Enclosure] | None] = [None] * len(cuts)
    alike: dict[int, list[int]] = {}
    for place, cut in enumerate(cuts):
        if len(cut.several) == 1 and len(cut.several[0]) <= LARGE and np.isrealobj(cut.matrix):
            alike.setdefault(padded(len(cut.several[0])), []).append(place)
    for places in alike.values():
        blocks = [
            (cut.matrix[part[:, None], part], cut.error[part[:, None], part])
            if len(cut.alone)
            else (cut.matrix, cut.error)
            for cut in (cuts[place] for place in places)
            for part in cut.several
        ]
        for place, (pairs, apart) in zip(places, pairs_by_discs(blocks), strict=True):
            if apart is None or not apart.high - apart.low <= SHARP * max(apart.low, 1.0):
                continue
            told = pairs, Enclosure(apart.low, apart.high, apart.near, apart.sharpened)
            found[place] = told if not len(cuts[place].alone) else _joined(cuts[place], [told])
    return found


def _joined(cut: _Parts, found: Sequence[tuple[Eigenpairs, Enclosure]]) -> tuple[Eigenpairs, Enclosure]:
    """Return the eigenvalues of a matrix, given those of its parts of more than one state."""
    n, alone = len(cut.matrix), cut.alone
    values, near = np.zeros(n, dtype=np.complex128), np.zeros(n)
    values[alone], near[alone] = cut.matrix[alone, alone], cut.error[alone, alone]
    size = np.abs(values[alone])
    low = max(0.0, float(((size - near[alone]) * (1 - 4 * UNIT)).max(initial=0.0)))
    high = float(((size + near[alone]) * (1 + 4 * UNIT)).max(initial=0.0))
    for part, (pairs, bounds) in zip(cut.several, found, strict=True):
        values[part], near[part] = pairs.values, bounds.near
        low, high = float(np.maximum(low, bounds.low)), float(np.maximum(high, bounds.high))  # NaN stays
    order = np.lexsort((-values.imag, values.real, -np.abs(values)))
    rank = np.empty_like(order)
    rank[order] = np.arange(n)
    right, left = np.zeros((2, n, n), dtype=np.complex128)
    right[alone, rank[alone]] = left[rank[alone], alone] = 1.0
    for part, (pairs, _) in zip(cut.several, found, strict=True):
        right[part[:, None], rank[part]], left[rank[part][:, None], part] = pairs.right, pairs.left

    def telling() -> Floats:
        errors = near.copy()
        for part, (_, bounds) in zip(cut.several, found, strict=True):
            errors[part] = bounds.errors
        return errors[order]

    return Eigenpairs(values[order], right, left), Enclosure(low, high, near[order], telling)


def _enclose_blocks(blocks: Sequence[tuple[Matrix, Floats]]) -> list[tuple[Eigenpairs, Enclosure]]:
    """Enclose the eigenvalues of matrices whose states all drive each other, those of one size at once.

    One large matrix has both its vectors from one triangular form, one of complex numbers has no pairs.
    """
    found: dict[int, tuple[Eigenpairs, Enclosure]] = {}
    alike: dict[int, list[int]] = {}
    for place, (matrix, error) in enumerate(blocks):
        if len(matrix) > LARGE or np.iscomplexobj(matrix):
            found[place] = _enclose_part(matrix, error)
        else:
            alike.setdefault(len(matrix), []).append(place)
    for places in alike.values():
        stacks = (np.stack(one) for one in zip(*(blocks[place] for place in places), strict=True))
        pairs, told = pairs_apart(*stacks)
        for row, (place, apart) in enumerate(zip(places, told, strict=True)):
            own = Eigenpairs(pairs.values[row], pairs.right[row], pairs.left[row])
            if apart is None or not apart.high - apart.low <= WIDE * max(apart.low, 1.0):
                found[place] = _enclose_part(*blocks[place])
            else:
                found[place] = own, _sharper(*blocks[place], apart)
    return [found[place] for place in range(len(blocks))]


def _sharper(matrix: Matrix, error: Floats, apart: Apart) -> Enclosure:
    """Return bounds on eigenvalues that stand apart, on the radius by more work where these say little."""
    low, high = apart.low, apart.high
    if high - low > SHARP * max(low, 1.0):
        _, other = _enclose_part(matrix, error)
        low, high = max(low, other.low), min(high, other.high)
    return Enclosure(low, high, apart.near, apart.sharpened)


def _enclose_part(matrix: Matrix, error: Floats) -> tuple[Eigenpairs, Enclosure]:
    """Enclose the eigenvalues of a matrix whose states all drive each other.

    The eigenvalues are split by magnitude, large from small, see `_enclose`. A chain of packets or forces
    that hardly anybody answers is nearly a Jordan block at zero, scattered by rounding over a ring that may
    reach far out: when the first split leaves the radius uncertain, the widest gaps between magnitudes are
    tried as well. What any split proves holds.
    """
    scale = balance(np.abs(matrix) + error)
    matrix, error = matrix / scale[:, None] * scale, error / scale[:, None] * scale
    found = eigenpairs(matrix)
    pairs = found.at(np.lexsort((-found.values.imag, found.values.real, -np.abs(found.values))))
    values, right, left = pairs.values, pairs.right, pairs.left
    sizes = np.abs(values)

    first = int((sizes >= SMALL).sum())
    tried = [_enclose(matrix, error, values, right, left, first)]
    low, high, splits = tried[0].low, tried[0].high, _splits(sizes, first)
    while not high - low <= WIDE * max(low, 1.0) and (count := next(splits, None)) is not None:
        tried.append(_enclose(matrix, error, values, right, left, count))
        low, high = max(one.low for one in tried), min(one.high for one in tried)
    # No estimate is farther from its eigenvalue than both are from zero.
    errors = np.minimum(np.min([one.errors for one in tried], axis=0), sizes + high)
    return Eigenpairs(values, right * scale[:, None], left / scale), _told(min(low, high), high, errors)


def _splits(sizes: Floats, first: int) -> Iterator[int]:
    """Yield after how many eigenvalues of falling magnitude to split besides the first, the widest gap first.

    Conjugates stay together; the last is before all.
    """
    ratios = np.append(sizes[1:], 0.0) / np.maximum(sizes, np.finfo(np.float64).tiny)
    counts = [int(k) + 1 for k in np.argsort(ratios[:-1], kind="stable") if ratios[k] < 1 - CLOSE]
    others = [count for count in counts if count != first and sizes[count - 1] > SMALL]
    yield from others[: SPLITS_TRIED if len(sizes) <= MANY_STATES else FEWER_SPLITS]
    yield 0


def _enclose(
    matrix: Matrix, error: Floats, values: Complexes, right: Complexes, left: Complexes, large: int
) -> Enclosure:
    """Enclose the eigenvalues of a matrix known up to `error` entry by entry, the `large` first sharply.

    Notes
    -----
    X = [X₁ X₂]: X₁ the right vectors of the large ones, X₂ annihilated by their left vectors. Then
    X⁻¹(M + E)X = diag(T₁, …, T_k, T) + G, |G| ≤ |X⁻¹| (|residual| + |E| |X|), one block T_c a cluster of
    large eigenvalues that are nearly equal, and T for all that are small. Every eigenvalue z then has
    ‖(z − T_c)⁻¹‖ Σ_b ‖G_cb‖ ≥ 1 for some block c (Feingold and Varga, Block diagonally dominant matrices,
    1962): it is in a disc of `_blockdiscs` about an eigenvalue of T_c, or within `pseudospectral_radius`
    of T about zero. Discs that touch hold together as many eigenvalues as there are of them.
    """
    n = len(matrix)
    # What block each place is of: the small ones are all of the last.
    label = np.append(_clusters(values[:large]), np.full(n - large, large))
    basis = _basis(right, left, label, large)
    found = None if basis is None else _block_diagonal(matrix, error, basis, label, large)
    if found is None:
        return _told(0.0, np.inf, np.full(n, np.inf))
    form, left_over = found
    sizes, totals = _totals(left_over, label, large)
    # A block of one is its own centre.
    centres, radii = np.diagonal(form).astype(np.complex128), totals.copy()
    several = _several(label[:large])
    for block in several:
        centres[block], radii[block] = _blockdiscs(form[np.ix_(block, block)], float(totals[block[0]]))
    if large < n:
        own = form[large:, large:]
        small = own.real if np.isrealobj(matrix) else own
        centres[large:], radii[large:] = 0.0, pseudospectral_radius(small, float(totals[-1]))
    told = discs(values, centres, radii)
    ones, grown = np.ones(n, dtype=np.bool_), radii.copy()
    for block in [*several, np.arange(large, n)]:
        ones[block] = False
    outermost = int(np.argmax(np.abs(centres) + radii))
    touching = np.abs(centres - centres[outermost]) <= radii + radii[outermost]
    wide = told.high - told.low > WIDE * max(told.low, 1.0)
    if not (wide and ones[outermost] and touching.sum() == 1):
        return told
    for block in several:
        about, radius = _blockdiscs(form[np.ix_(block, block)], GROWN * float(totals[block[0]]))
        grown[block] = radius + np.abs(about - centres[block])
    if large < n:
        grown[large:] = pseudospectral_radius(small, GROWN * float(totals[-1]))
    return discs(values, centres, _alone(centres, radii, ones, grown, sizes, totals))


def _alone(
    centres: Complexes,
    radii: Floats,
    ones: NDArray[np.bool_],
    grown: Floats,
    sizes: Floats,
    totals: Floats,
) -> Floats:
    """Return the radii (n,) of discs, less where a disc of a block of one stands alone.

    Parameters
    ----------
    centres, radii
        The discs, one for each place.
    ones, grown
        Which are of blocks of one, and of the others the radius if their totals were `GROWN` times as large.
    sizes, totals
        See `_totals`.

    Notes
    -----
    With block c scaled by 1/α > 1, the discs are those of G_cb α, and of G_bc / α for the others: c's shrinks
    to ‖G_cc‖ + α Σ_b ‖G_cb‖, the first of which is all there is to first order, and the others grow. As long
    as these keep clear of it, it holds one eigenvalue (Wilkinson, The Algebraic Eigenvalue Problem, 1965,
    chapter 2), that of the disc before, which was clear of the others, too.
    """
    gap = np.abs(centres[:, None] - centres) * (1 - 8 * UNIT) - radii - grown[:, None]  # [b, c]
    np.fill_diagonal(gap, np.inf)
    room = np.where(ones[:, None], gap, ((GROWN - 1) * totals)[:, None])
    with np.errstate(divide="ignore", invalid="ignore"):
        share = np.where(gap > 0, sizes / room, np.inf)
    np.fill_diagonal(share, 0.0)
    share = share.max(axis=0) * (1 + 8 * UNIT)
    first = np.diagonal(sizes)
    less = (first + share * (totals - first)) * (1 + 8 * UNIT)
    return np.where(ones & (share < 1) & (less < radii), less, radii)


def _basis(right: Complexes, left: Complexes, label: Places, large: int) -> Matrix | None:
    """Return X = [X₁ X₂] (n, n), or None where vectors are too alike to tell apart."""
    n = len(right)
    basis: Matrix = np.zeros((n, n), dtype=np.complex128)
    free = np.arange(n)
    rows = left[:large].copy()
    basis[:, :large] = right[:, :large]
    for cluster in _several(label[:large]):
        basis[:, cluster] = np.linalg.qr(right[:, cluster])[0]
        rows[cluster] = np.linalg.qr(rows[cluster].T)[0].T
    if large:
        rows = _folded(rows.T, _conjugates(rows.T)).T
        held = independent_places(rows)
        free = np.delete(free, held)
        if len(free) != n - large:
            return None
        try:
            basis[np.ix_(held, np.arange(large, n))] = -np.linalg.solve(rows[:, held], rows[:, free])
        except np.linalg.LinAlgError:
            return None
    basis[free, np.arange(large, n)] = 1.0
    return basis


def _conjugates(columns: Complexes) -> Places:
    """Return the first of each two conjugate columns side by side; none unless all others are real."""
    turning = np.flatnonzero(columns.imag.any(axis=0))
    first, second = turning[::2], turning[1::2]
    beside = len(first) == len(second) and (second == first + 1).all()
    return first if beside and (columns[:, second] == columns[:, first].conj()).all() else first[:0]


def _folded(columns: Complexes, first: Places) -> Matrix:
    """Return columns with a + bi and a − bi, of which these are the first, as a and b: R of X = R U.

    Real products and inverses are a quarter of the work of complex ones.
    """
    if not len(first):
        return columns if columns.imag.any() else columns.real
    folded = columns.real.copy()
    folded[:, first + 1] = columns[:, first].imag
    return folded


def _unfolded(folded: Matrix, first: Places) -> Matrix:
    """Return R U of R, see `_folded`."""
    if not len(first):
        return folded
    columns = folded.astype(np.complex128)
    columns[:, first] += 1j * folded[:, first + 1]
    columns[:, first + 1] = folded[:, first] - 1j * folded[:, first + 1]
    return columns


def _unfolded_rows(folded: Matrix, first: Places) -> Matrix:
    """Return U⁻¹ S of rows S, see `_folded`."""
    if not len(first):
        return folded
    rows = folded.astype(np.complex128)
    rows[first] = (folded[first] - 1j * folded[first + 1]) / 2
    rows[first + 1] = rows[first].conj()
    return rows


def _block_diagonal(
    matrix: Matrix, error: Floats, basis: Matrix, label: Places, large: int
) -> tuple[Matrix, Floats] | None:
    """Return diag(T₁, …, T_k, T) and a bound on |G|, the products' roundings included; None without X⁻¹."""
    n = len(matrix)
    first = _conjugates(basis)
    folded = _folded(basis, first)
    try:
        apart = np.linalg.inv(folded)
    except np.linalg.LinAlgError:
        return None
    # Half of a sum of four real products each is off by less than is charged to a complex one.
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    inverse, moved = _unfolded_rows(apart, first), _unfolded(matrix @ folded, first)
    product = _unfolded(_unfolded_rows(apart @ folded, first), first)
    size, weight = np.abs(basis), np.abs(inverse)
    # What is outside the blocks is never asked for: nearly all of them are of one.
    alone = np.einsum("ij,ji->i", inverse, moved)
    form = np.diag(alone)
    left, carried = moved - basis * alone, size * np.abs(alone)
    for block in _blocks(label, large):
        own = inverse[block] @ moved[:, block]
        if block[0] == large and np.isrealobj(matrix):
            own = own.real  # the large ones are whole conjugate pairs, so what is left is real
        form[np.ix_(block, block)] = own
        left[:, block] = moved[:, block] - basis[:, block] @ own
        carried[:, block] = size[:, block] @ np.abs(own)
    doubt = np.abs(left) + (error + charge * np.abs(matrix)) @ size + charge * carried
    # The computed inverse Y is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X.
    wrong = np.abs(np.eye(n) - product).sum(axis=1) + charge * (weight @ size.sum(axis=1))
    defect = float(wrong.max(initial=0.0))
    if not defect < 0.5:
        return None
    left_over = weight @ doubt * (1 + charge)
    left_over += wrong[:, None] / (1 - defect) * left_over.max(axis=0, initial=0.0)
    return (form, left_over) if np.isfinite(left_over).all() else None


def _totals(left_over: Floats, label: Places, large: int) -> tuple[Floats, Floats]:
    """Return ‖G_cb‖, that of Frobenius, for the blocks c and b of all places (n, n), and Σ_b of it (n,)."""
    n = len(left_over)
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    peak = float(left_over.max(initial=0.0))  # relative to it no square is lost
    squares = np.square(left_over / peak) if peak > 0 else left_over
    for block in _blocks(label, large):
        squares[block] = squares[block].sum(axis=0)
        squares[:, block] = squares[:, block].sum(axis=1, keepdims=True)
    sizes = peak * (1 + charge) * (np.sqrt(squares) + 1e-150)
    if large < n:
        sizes[large:, large:] = norms(left_over[large:, large:])  # often much less: few entries in a row
    first = label == np.arange(n)  # each block once
    return sizes, np.asarray(sizes[:, first].sum(axis=1))


def _blocks(label: Places, large: int) -> list[Places]:
    """Return the places of each block of two or more, the small ones' last."""
    small = np.arange(large, len(label))
    return [*_several(label[:large]), *([small] if len(small) else [])]


def _blockdiscs(block: Matrix, error: float) -> tuple[Complexes, float]:
    """Return the centres and the radius of discs that hold the eigenvalues of a block known up to `error`.

    Notes
    -----
    Either discs about its own eigenvalues Λ with vectors V, T = V Λ V⁻¹ + R: nothing is farther from one of
    them than ‖V⁻¹‖ ‖V‖ (‖R‖ + error) (Bauer and Fike, Numerische Mathematik 2, 1960). Or, where these are
    hardly vectors of their own, one disc about their mean c that holds the pseudospectrum of T − c.
    """
    m = len(block)
    values, vectors = (part.astype(np.complex128) for part in np.linalg.eig(block))
    charge = PRODUCT_ROUNDINGS * (m + 2) * UNIT
    size = float(norms(vectors))
    try:
        inverse = np.linalg.inv(vectors)
        wrong = float(norms(np.eye(m) - inverse @ vectors)) + charge * float(norms(inverse)) * size
    except np.linalg.LinAlgError:
        inverse, wrong = vectors, np.inf
    centre = complex(np.mean(values))
    shifted = block - centre * np.eye(m)
    rounded = charge * (float(norms(block)) + abs(centre))
    around = pseudospectral_radius(shifted, error + rounded)
    if wrong < 0.5:
        weight = float(norms(inverse)) / (1 - wrong)
        residual = float(norms(block @ vectors - vectors * values)) + rounded * size
        radius = weight * (residual + size * error) * (1 + charge)
        if radius < around:
            return values, radius
    return np.full(m, centre), around


def _clusters(values: Complexes) -> Places:
    """Return for each eigenvalue the first of those that are nearly equal to it, chain by chain."""
    return _connected(np.abs(values[:, None] - values[None, :]) <= CLOSE * np.abs(values)[:, None])


def _several(label: Places) -> list[Places]:
    """Return the places of each cluster of two or more."""
    return (
        [np.flatnonzero(label == one) for one in np.flatnonzero(np.bincount(label) > 1)] if len(label) else []
    )


def _connected(touching: NDArray[np.bool_]) -> Places:
    """Return for each place the least place that it hangs together with."""
    n = len(touching)
    touching = touching | touching.T
    label = np.arange(n)
    while True:
        spread = np.where(touching, label[None, :], n).min(axis=1, initial=n)
        if np.array_equal(spread, label):
            return label
        label = spread


def discs(values: Complexes, centres: Complexes, radii: Floats) -> Enclosure:
    """Return bounds on the spectral radius and, for each estimate, how far its eigenvalue can be.

    k discs that hang together hold k eigenvalues, nobody knows which in which: each estimate is then off by
    at most the distance to the far side of any of them.
    """
    label = _connected(np.abs(centres[:, None] - centres[None, :]) <= radii[:, None] + radii[None, :])
    reach = np.abs(values[:, None] - centres[None, :]) + radii[None, :]
    errors = np.where(label[:, None] == label[None, :], reach, 0.0).max(axis=1)
    inner = np.abs(centres) - radii
    low = max(0.0, *(float(inner[label == one].min()) for one in set(label.tolist())))
    return _told(low, float((np.abs(centres) + radii).max()), errors)
