"""What many sites together answer, by partial fractions: their poles and residues, and their sum in discs.

Takes: the maps x⁺ = P x + Q r, s = S x + D r of many sites with their radii, how often each site counts, and
where its rows of s and lines of r are among all; discs.
Gives: `TransferSubsystems`, `Transfer`, `transfer_of`; `Poles`; `powers`, `add_fractions`.
Guarantees: an answer holds in a disc about each point: value, radius and slope hold all that rounding does,
and what the maps may be off by.
Does not: answer nearer to zero than `Transfer.innermost`.

    T(ζ) = Σ_i n_i (D_i + S_i (ζ − P_i)⁻¹ Q_i)

Each P_i is split, X⁻¹ P X = diag(p_1, …, p_K, T₂) + Δ: the eigenvalues beyond `INNER` one by one, and all
that is smaller, queues running empty and the like, as one block that may be defective. The block's part is a
short power series of 1/ζ, added up over all sites before any ζ is known.

What is known in a disc of radius ρ about ζ is an array (…, 3, n, m) as `radius` has it over a cell: value,
radius and ρ times the slope.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.matrix_norms import balance, norms
from apc.frame.lift import FrameMap
from apc.frame.radius import RADII, UNIT, Matrix, radius_of, solve, value_of, with_radius

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]

# Eigenvalues within this share of the largest go into the block; it is looked at from so many times that
# distance from zero on, where so many terms of its series leave 2^−64 of the first.
INNER, FARTHER, TERMS = 0.15, 4.0, 32

# A term is left out where it and all after it are this share of a rounding.
CUT = 2.0**-7

# Sites worked on together, and answers: they stay in the cache of a processor.
CHUNK, ANSWERS = 1024, 65_536


@dataclass(frozen=True, slots=True, eq=False)
class TransferSubsystems:
    """k sites of one structure among all that is sent and heard: `rows` of s and `lines` of r are theirs.

    `maps` (k, …) have their radii; `counts` (k,) say how often each site is there.
    """

    maps: FrameMap
    counts: Floats
    rows: Integers
    lines: Integers


@dataclass(frozen=True, slots=True, eq=False)
class Poles:
    """The poles of all sites that are no part of a block, the largest first, with their conjugates.

    Each is off by no more than `errors`, wherever beyond `Transfer.innermost` that is asked; `counts` say how
    often its site is there, `heard` whether it has a residue, `sites` (m, 2) which of the structures it is
    of, and which site.
    """

    values: Complexes
    errors: Floats
    counts: Floats
    heard: NDArray[np.bool_]
    sites: Integers


@dataclass(frozen=True, slots=True, eq=False)
class _Fractions:
    """Some sites of equally many poles K, their rows and lines as in `TransferSubsystems`.

    Beside the n_s rows and n_r lines, what an error of P does has `circle` (k, K + 1, 1 + n_s + n_r): u w,
    |S X| u and w |Y Q|, see `_split`, the block last; `block` (k,) bounds ‖(ζ − T₂)⁻¹‖ |ζ|.
    """

    rows: Integers
    lines: Integers
    poles: Complexes  # (k, K)
    residues: Complexes  # (k · K, n_s · n_r), multiplicities included
    sizes: Floats
    errors: Floats
    block: Floats
    circle: Floats


@dataclass(frozen=True, slots=True, eq=False)
class Transfer:
    """T of all sites: fractions, and the terms of D, ζ⁻¹, ζ⁻², … (2, 1 + terms, n_s · n_r) with radii."""

    fractions: tuple[_Fractions, ...]
    series: Matrix
    shape: tuple[int, int]
    innermost: float
    poles: Poles


def transfer_of(listed: Sequence[TransferSubsystems], n_s: int, n_r: int) -> Transfer:
    """Split every site into its poles and a block of what dies out at once.

    Parameters
    ----------
    listed
        All sites.
    n_s, n_r
        How much is sent and heard by all.
    """
    series = np.zeros((1 + TERMS, 2, n_s, n_r))
    fractions, inner = [], [float(np.finfo(np.float64).tiny)]
    poles: list[tuple[Matrix, ...]] = []
    for which, sites in enumerate(listed):
        size = np.abs(value_of(sites.maps.p)) + radius_of(sites.maps.p)
        scale = balance(size.max(axis=0))
        for start in range(0, len(size), CHUNK):
            # Over states in other units, powers of two so that nothing is rounded.
            p, q, s, d = (block[start : start + CHUNK] for block in sites.maps.blocks)
            p, q, s = p / scale[:, None] * scale, q / scale[:, None], s * scale
            values, vectors = np.linalg.eig(value_of(p))
            order = np.argsort(-np.abs(values), axis=1, kind="stable")
            values = np.take_along_axis(values, order, axis=1).astype(np.complex128)
            vectors = np.take_along_axis(vectors, order[:, None, :], axis=2).astype(np.complex128)
            inner.append(INNER * min(1.0, float(np.abs(values).max(initial=0.0))) or INNER)
            large = (np.abs(values) > inner[-1]).sum(axis=1)
            for count in np.unique(large).tolist():
                some = np.flatnonzero(large == count)
                maps = FrameMap(p[some], q[some], s[some], d[some])
                counts = sites.counts[start + some]
                part, error, terms = _split(
                    maps, counts, values[some, :count], vectors[some, :, :count], FARTHER * inner[-1]
                )
                fractions.append(_Fractions(sites.rows, sites.lines, *part))
                own = np.ix_(np.arange(len(terms)), np.arange(2), sites.rows, sites.lines)
                series[own] = RADII.add(series[own], terms)
                heard = np.asarray(fractions[-1].residues.any(axis=-1))
                place = np.stack([np.full(len(some), which), start + some], axis=-1)
                each = np.repeat(counts, count), heard, np.repeat(place, count, axis=0)
                poles.append((values[some, :count].ravel(), error.ravel(), *each))
    innermost = FARTHER * max(inner)
    every = [np.concatenate(part) for part in zip(*poles, strict=True)]
    order = np.argsort(-np.abs(every[0]), kind="stable")
    return Transfer(
        fractions=tuple(fractions),
        series=_shortened(series.swapaxes(0, 1).reshape(2, 1 + TERMS, n_s * n_r), innermost),
        shape=(n_s, n_r),
        innermost=innermost,
        poles=Poles(*(part[order] for part in every)),
    )


def _shortened(series: Matrix, innermost: float) -> Matrix:
    """Return a series of 1/ζ without what is less than a rounding of its first term."""
    sizes = (np.abs(series[0]) + series[1]) * innermost ** -np.arange(float(1 + TERMS))[:, None]
    left = np.cumsum(sizes[::-1], axis=0)[::-1]
    kept = max(1, np.count_nonzero((left > CUT * UNIT * left[0]).any(axis=1)))
    series[1, 0] += (1 + TERMS * UNIT) * left[kept:][:1].sum(axis=0)
    return series[:, :kept]


def _split(
    maps: FrameMap, counts: Floats, values: Complexes, vectors: Complexes, radius: float
) -> tuple[tuple[Complexes, Complexes, Floats, Floats, Floats, Floats], Floats, Matrix]:
    """Split sites that all have as many poles.

    Parameters
    ----------
    maps
        Those of the sites, with their radii.
    counts
        How often each is there (k,).
    values, vectors
        The poles (k, K) and their vectors (k, n, K).
    radius
        From which |ζ| on T is asked for.

    Returns
    -------
    The last fields of `_Fractions`; what the poles of each site may be off by; the terms of D, ζ⁻¹, …
    (terms, 2, n_s, n_r).

    Notes
    -----
    P + E = X (Λ + Δ) X⁻¹ holds for some |Δ| ≤ |X⁻¹ (P X − X Λ)|, radii included. A majorant of rank one,
    Δ_kl ≤ u_k w_l, makes the Neumann series of (ζ − Λ − Δ)⁻¹ a geometric one: what it changes is at most
    (Σ_k |S X|_k u_k/|ζ − p_k|) (Σ_l w_l |Y Q|_l/|ζ − p_l|) / (1 − Σ_k u_k w_k/|ζ − p_k|).
    """
    sites, large = values.shape
    n, n_s, n_r = vectors.shape[1], maps.s.shape[-2], maps.q.shape[-1]
    basis, small = _block_basis(value_of(maps.p), values, vectors)
    diagonal = np.zeros((sites, n, n), np.complex128)
    diagonal[:, range(large), range(large)] = values
    diagonal[:, large:, large:] = small
    exact = RADII.exact(basis)
    left = RADII.subtract(RADII.multiply(maps.p, exact), RADII.multiply(exact, RADII.exact(diagonal)))
    result = solve(exact, np.concatenate([left, maps.q], axis=-1))
    if result is None:  # vectors that are nearly one another: nothing is known
        result = np.full((sites, 2, n, n + n_r), np.inf, np.complex128)
    change, b = _size(result[..., :n]), result[..., n:]
    a = RADII.multiply(maps.s, exact)
    residues = RADII.multiply(
        np.moveaxis(a, -1, 1)[:, :large, ..., None], np.moveaxis(b, -2, 1)[:, :large, ..., None, :]
    )
    residues = np.moveaxis(residues * counts[:, None, None, None, None], 2, 0)
    terms, block = _block_series(a[..., large:], b[..., large:, :], small, radius)
    terms = np.concatenate([maps.d[:, :, None], terms], axis=2)
    kept = terms.shape[2]
    terms = RADII.multiply(RADII.exact(counts[None]), terms.swapaxes(0, 1).reshape(2, sites, -1))
    u, w = _rank_one(change)
    u, w, sent = (_last_as_one(values, large) for values in (u[:, None], w[:, None], _size(a)))
    heard = _last_as_one(_size(b).swapaxes(1, 2), large)
    circle = np.concatenate([u * w, counts[:, None, None] * sent * u, w * heard], axis=1).swapaxes(1, 2)
    error = _pole_errors(values, circle[:, :-1, 0], circle[:, -1, 0] * block / radius)
    exact, off = residues.reshape(2, sites * large, n_s * n_r)
    fractions = values, exact, np.abs(exact), off.real.copy(), block, circle
    return fractions, error, terms.reshape(2, kept, n_s, n_r).swapaxes(0, 1)


def _pole_errors(values: Complexes, own: Floats, block: Floats) -> Floats:
    """Return how far the poles p_l can be off (k, K): Σ_l u_l w_l/|z − p_l| < 1 wherever none is nearer.

    What is farther from all of them than all u w together is; and what is twice a pole's own from it, where
    the others, at half their distance, leave it room.
    """
    gaps = np.abs(values[:, :, None] - values[:, None, :]) / 2
    gaps[:, range(gaps.shape[1]), range(gaps.shape[1])] = np.inf
    with np.errstate(all="ignore"):
        others = (own[:, None, :] / gaps).sum(axis=2) + block[:, None]
        together = np.where(block < 0.5, 2 * own.sum(axis=1), np.inf)[:, None]
    return np.where(others < 0.5, np.minimum(2 * own, together), together)


def _size(matrix: Matrix) -> Floats:
    """Return the largest magnitudes that entries have within their radii."""
    return np.asarray(np.abs(value_of(matrix)) + radius_of(matrix).real)


def _block_basis(matrices: Floats, values: Complexes, vectors: Complexes) -> tuple[Complexes, Complexes]:
    """Return X = [eigenvectors of the large values, X₂] and T₂, for many matrices.

    With the vectors' QR, X_L = Q₁ R, M is block triangular over [X_L Q₂]: [Λ C; 0 T₂]. The rows of W with
    w_k (p_k − T₂) = −c_k take C away, X₂ = Q₂ + X_L W, whether or not T₂ has a set of eigenvectors.
    """
    n, large = vectors.shape[1:]
    q, r = np.linalg.qr(vectors, mode="complete")
    rest, adjoint = q[:, :, large:], q.conj().swapaxes(1, 2)
    moved = matrices @ rest
    small = adjoint[:, large:] @ moved
    coupling = np.linalg.solve(r[:, :large], adjoint[:, :large] @ moved)
    shifted = values[:, :, None, None] * np.eye(n - large) - small[:, None]
    mixing = np.linalg.solve(shifted.swapaxes(2, 3), -coupling[..., None])[..., 0]
    return np.concatenate([vectors, rest + vectors @ mixing], axis=2), small


def _block_series(row: Matrix, column: Matrix, small: Complexes, radius: float) -> tuple[Matrix, Floats]:
    """Return the terms S X₂ T₂^j Y₂ Q of ζ^(−j−1) of each site, and a bound on ‖(ζ − T₂)⁻¹‖ |ζ| (k,).

    What is left of the series is charged to the first term; both hold from |ζ| = radius on.

    Parameters
    ----------
    row, column
        S X₂ (k, 2, n_s, m) and Y₂ Q (k, 2, m, n_r).
    small
        T₂ (k, m, m).
    radius
        |ζ|.
    """
    ends = np.linalg.norm(_size(row), axis=2)[:, :, None] * np.linalg.norm(_size(column), axis=1)[:, None]
    n_r = column.shape[-1]
    power, block = RADII.exact(small), np.ones(len(small))
    terms, size = 1, norms(_size(power)) / radius
    while terms < TERMS and not (size < CUT * UNIT).all():
        block *= 1 + size
        column = np.concatenate([column, RADII.multiply(power, column)], axis=-1)
        power, terms = RADII.multiply(power, power), 2 * terms
        size = norms(_size(power)) * radius**-terms
    block *= np.where(size < 0.5, (1 + 1e-6) / (1 - np.minimum(size, 0.5)), np.inf)
    values = RADII.multiply(row, column)
    real = with_radius(value_of(values).real, radius_of(values).real + np.abs(value_of(values).imag))
    real = np.moveaxis(real.reshape(*real.shape[:-1], terms, n_r), -2, 2)
    real[:, 1, 0] += ends * (size * block)[:, None, None]
    return real, block


def _rank_one(sizes: Floats) -> tuple[Floats, Floats]:
    """Return u and w with u_k w_l ≥ sizes_kl."""
    floor = np.finfo(np.float64).tiny
    u = np.maximum(sizes.max(axis=2), floor)
    w = np.maximum((sizes / u[:, :, None]).max(axis=1), floor)
    u = np.maximum((sizes / w[:, None, :]).max(axis=2), floor)
    return u, w


def _last_as_one(rows: Floats, large: int) -> Floats:
    """Return rows (k, m, n) with the entries from `large` on as one, their 2-norm: (k, m, large + 1)."""
    return np.concatenate([rows[..., :large], np.linalg.norm(rows[..., large:], axis=-1)[..., None]], axis=-1)


def powers(points: Complexes, reach: Floats, exponents: Integers) -> Matrix:
    """Return ζ^−l in discs (3, z, l), by Taylor's remainder; a power loses a rounding a turn or so.

    Parameters
    ----------
    points, reach
        The discs (z,).
    exponents
        The l.
    """
    near = np.maximum(np.abs(points) - reach, np.finfo(np.float64).tiny)[:, None]
    share = reach[:, None] / near
    value = (1 / points)[:, None] ** exponents  # far out, it dies out to nothing
    off = share**2 * exponents * (exponents + 1) / 2 + (1 + exponents * share) * (16 + 8 * exponents) * UNIT
    slope = -exponents * reach[:, None] * value / points[:, None]
    return np.stack([value, (1 / near) ** exponents * off, slope])


def add_fractions(
    transfer: Transfer, total: Matrix, points: Complexes, reach: Floats, *, bounded: bool = True
) -> None:
    """Add to what its series gives in discs what T's poles do; a radius is NaN where it is not known.

    Parameters
    ----------
    transfer
        T.
    total
        The answers (z, 3, n_s, n_r), written over.
    points, reach
        The discs (z,).
    bounded
        Whether radii are asked for.

    Notes
    -----
    1/(ζ + h − p) = q − h q² + h² q²/(ζ + h − p), q = 1/(ζ − p): the last is at most (ρ|q|)² |q|/(1 − ρ|q|).
    """
    nearest = np.abs(points) - reach
    # A quotient rounds, a product, each sum over poles and that of all parts.
    rounded = (
        4 * (8 + len(transfer.fractions) + max(fraction.poles.size for fraction in transfer.fractions)) * UNIT
    )
    for fraction in transfer.fractions:
        for piece in _pieces(fraction, len(points)):
            inverse, radius = 1.0 / (points[piece, None, None] - fraction.poles), reach[piece, None, None]
            values = np.zeros((len(inverse), 3, len(fraction.rows), len(fraction.lines)), np.complex128)
            values[:, 0] = _by_poles(inverse, fraction.residues, values)
            if bounded:
                moved = radius * (far := np.abs(inverse))
                with np.errstate(all="ignore"):
                    near = far / (1 - moved)  # 1/(|ζ − p| − ρ), negative where a pole is in the disc
                    near[near.min(axis=(1, 2), initial=0.0) < 0] = np.nan
                values[:, 1] = _by_poles(near, fraction.errors, values) + _reaction(
                    fraction, near, nearest[piece]
                )
                moved *= moved
                moved += rounded
                moved *= near
                values[:, 1] += _by_poles(moved, fraction.sizes, values)
            inverse *= inverse
            values[:, 2] = -radius * _by_poles(inverse, fraction.residues, values)
            total[piece, :, fraction.rows[:, None], fraction.lines] += values
    total[~(nearest >= transfer.innermost), 1] = np.nan


def _by_poles(inverse: Matrix, residues: Matrix, shape: Matrix) -> Matrix:
    """Return what poles (z, k, K) weighed by residues (k · K, n_s · n_r) add up to (z, n_s, n_r)."""
    return (inverse.reshape(len(inverse), -1) @ residues).reshape(len(inverse), *shape.shape[2:])


def _reaction(fractions: _Fractions, near: Floats, nearest: Floats) -> Floats:
    """Return what the errors of P do at most (z, n_s, n_r), see `_split`, where |ζ| is at least `nearest`."""
    n_s = len(fractions.rows)
    summed = near.swapaxes(0, 1) @ fractions.circle[:, :-1]
    summed += (fractions.block[:, None] / nearest)[..., None] * fractions.circle[:, -1:]
    circle, sent, heard = summed[..., 0], summed[..., 1 : n_s + 1], summed[..., n_s + 1 :]
    with np.errstate(all="ignore"):
        sent = sent / np.where(circle < 1, 1 - circle, np.nan)[..., None]
    return np.asarray(sent.transpose(1, 2, 0) @ heard.swapaxes(0, 1))


def _pieces(fractions: _Fractions, points: int) -> Iterator[slice]:
    """Yield which points are answered together."""
    most = max(1, ANSWERS // max(1, fractions.poles.size))
    for start in range(0, points, most):
        yield slice(start, start + most)
