"""The transfer of many subsystems by partial fractions: poles and residues, and their sum in discs.

Takes: the maps x⁺ = P x + Q r, s = S x + D r of many subsystems with their radii, how often each subsystem
counts, and where its rows of s and lines of r are among all; discs.
Gives: `TransferSubsystems`, `Transfer`, `transfer_of`; `Poles`; `powers`, `add_fractions`.
Guarantees: an answer holds in a disc about each point: value, radius and slope hold all that rounding does,
and what the maps may be off by.
Does not: answer nearer to zero than `Transfer.innermost`.

    T(ζ) = Σ_i n_i (D_i + S_i (ζ − P_i)⁻¹ Q_i)

Each P_i is split, X⁻¹ P X = diag(p_1, …, p_K, T₂) + Δ: the eigenvalues beyond `INNER` one by one, and all
that is smaller, queues running empty and the like, as one block that may be defective. The block's part is a
short power series of 1/ζ, added up over all subsystems before any ζ is known.

What is known in a disc of radius ρ about ζ is an array (…, 3, n, m) as `radius` has it over a cell: value,
radius and ρ times the slope.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.matrix_norms import balance, norms
from apc.frame.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Matrix,
    error_radius,
    solve,
    value_of,
    with_error_radius,
)
from apc.frame.lift import FrameMap

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]

# Eigenvalues within this share of the largest go into the block. The block is evaluated beyond this multiple
# of its distance from zero, where this number of terms of its series leaves 2^−64 of the first.
INNER, FARTHER, TERMS = 0.15, 4.0, 32

# A term is left out where it and all after it are this share of a rounding.
CUT = 2.0**-7

# Subsystems worked on together, and answers: they stay in the cache of a processor.
CHUNK, ANSWERS = 1024, 65_536


@dataclass(frozen=True, slots=True, eq=False)
class TransferSubsystems:
    """k subsystems of one structure, with their `rows` of all sent values s and `lines` of received values r.

    `maps` (k, …) have their radii; `counts` (k,) are their multiplicities.
    """

    maps: FrameMap
    counts: Floats
    rows: Integers
    lines: Integers


@dataclass(frozen=True, slots=True, eq=False)
class Poles:
    """The poles of all subsystems outside the blocks, the largest first, with their conjugates.

    `errors` bound their errors outside `Transfer.innermost`. `counts` are the multiplicities of their
    subsystems, `received` is whether a pole has a residue, `subsystems` (m, 2) are the indices of structure
    and subsystem.
    """

    values: Complexes
    errors: Floats
    counts: Floats
    received: NDArray[np.bool_]
    subsystems: Integers


@dataclass(frozen=True, slots=True, eq=False)
class _Fractions:
    """Some subsystems with equal numbers of poles K, their rows and lines as in `TransferSubsystems`.

    In addition to the n_s rows and n_r lines, the effect of an error of P has `circle` (k, K + 1, 1 + n_s +
    n_r): u w,
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
    """T of all subsystems: fractions, and terms of D, ζ⁻¹, ζ⁻², … (2, 1 + terms, n_s · n_r) with radii."""

    fractions: tuple[_Fractions, ...]
    series: Matrix
    shape: tuple[int, int]
    innermost: float
    poles: Poles


def transfer_of(listed: Sequence[TransferSubsystems], n_s: int, n_r: int) -> Transfer:
    """Split every subsystem into its poles and a block of fast-decaying modes.

    Parameters
    ----------
    listed
        All subsystems.
    n_s, n_r
        The numbers of values sent and received by all.
    """
    series = np.zeros((1 + TERMS, 2, n_s, n_r))
    fractions, inner = [], [float(np.finfo(np.float64).tiny)]
    poles: list[tuple[Matrix, ...]] = []
    for which, subsystems in enumerate(listed):
        size = np.abs(value_of(subsystems.maps.p)) + error_radius(subsystems.maps.p)
        scale = balance(size.max(axis=0))
        for start in range(0, len(size), CHUNK):
            # Over states in other units, powers of two so that nothing is rounded.
            p, q, s, d = (block[start : start + CHUNK] for block in subsystems.maps.blocks)
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
                counts = subsystems.counts[start + some]
                part, error, terms = _split(
                    maps, counts, values[some, :count], vectors[some, :, :count], FARTHER * inner[-1]
                )
                fractions.append(_Fractions(subsystems.rows, subsystems.lines, *part))
                local = np.ix_(np.arange(len(terms)), np.arange(2), subsystems.rows, subsystems.lines)
                series[local] = MIDPOINT_RADIUS.add(series[local], terms)
                received = np.asarray(fractions[-1].residues.any(axis=-1))
                index = np.stack([np.full(len(some), which), start + some], axis=-1)
                each = np.repeat(counts, count), received, np.repeat(index, count, axis=0)
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
    """Return a series of 1/ζ without terms below the rounding of its first term."""
    sizes = (np.abs(series[0]) + series[1]) * innermost ** -np.arange(float(1 + TERMS))[:, None]
    left = np.cumsum(sizes[::-1], axis=0)[::-1]
    stored = max(1, np.count_nonzero((left > CUT * UNIT_ROUNDOFF * left[0]).any(axis=1)))
    series[1, 0] += (1 + TERMS * UNIT_ROUNDOFF) * left[stored:][:1].sum(axis=0)
    return series[:, :stored]


def _split(
    maps: FrameMap, counts: Floats, values: Complexes, vectors: Complexes, radius: float
) -> tuple[tuple[Complexes, Complexes, Floats, Floats, Floats, Floats], Floats, Matrix]:
    """Split subsystems that all have as many poles.

    Parameters
    ----------
    maps
        Those of the subsystems, with their radii.
    counts
        The multiplicity of each (k,).
    values, vectors
        The poles (k, K) and their vectors (k, n, K).
    radius
        From which |ζ| on T is asked for.

    Returns
    -------
    The last fields of `_Fractions`; what the poles of each subsystem may be off by; the terms of D, ζ⁻¹, …
    (terms, 2, n_s, n_r).

    Notes
    -----
    P + E = X (Λ + Δ) X⁻¹ holds for some |Δ| ≤ |X⁻¹ (P X − X Λ)|, radii included. A majorant of rank one,
    Δ_kl ≤ u_k w_l, makes the Neumann series of (ζ − Λ − Δ)⁻¹ a geometric one: what it changes is at most
    (Σ_k |S X|_k u_k/|ζ − p_k|) (Σ_l w_l |Y Q|_l/|ζ − p_l|) / (1 − Σ_k u_k w_k/|ζ − p_k|).
    """
    subsystems, large = values.shape
    n, n_s, n_r = vectors.shape[1], maps.s.shape[-2], maps.q.shape[-1]
    basis, small = _block_basis(value_of(maps.p), values, vectors)
    diagonal = np.zeros((subsystems, n, n), np.complex128)
    diagonal[:, range(large), range(large)] = values
    diagonal[:, large:, large:] = small
    exact = MIDPOINT_RADIUS.exact(basis)
    left = MIDPOINT_RADIUS.subtract(
        MIDPOINT_RADIUS.multiply(maps.p, exact),
        MIDPOINT_RADIUS.multiply(exact, MIDPOINT_RADIUS.exact(diagonal)),
    )
    result = solve(exact, np.concatenate([left, maps.q], axis=-1))
    if result is None:  # vectors that are nearly one another: nothing is known
        result = np.full((subsystems, 2, n, n + n_r), np.inf, np.complex128)
    change, b = _size(result[..., :n]), result[..., n:]
    a = MIDPOINT_RADIUS.multiply(maps.s, exact)
    residues = MIDPOINT_RADIUS.multiply(
        np.moveaxis(a, -1, 1)[:, :large, ..., None], np.moveaxis(b, -2, 1)[:, :large, ..., None, :]
    )
    residues = np.moveaxis(residues * counts[:, None, None, None, None], 2, 0)
    terms, block = _block_series(a[..., large:], b[..., large:, :], small, radius)
    terms = np.concatenate([maps.d[:, :, None], terms], axis=2)
    stored = terms.shape[2]
    terms = MIDPOINT_RADIUS.multiply(
        MIDPOINT_RADIUS.exact(counts[None]), terms.swapaxes(0, 1).reshape(2, subsystems, -1)
    )
    u, w = _rank_one_bound(change)
    u, w, sent = (_merge_last(values, large) for values in (u[:, None], w[:, None], _size(a)))
    received = _merge_last(_size(b).swapaxes(1, 2), large)
    circle = np.concatenate([u * w, counts[:, None, None] * sent * u, w * received], axis=1).swapaxes(1, 2)
    error = _pole_errors(values, circle[:, :-1, 0], circle[:, -1, 0] * block / radius)
    exact, error_bound = residues.reshape(2, subsystems * large, n_s * n_r)
    fractions = values, exact, np.abs(exact), error_bound.real.copy(), block, circle
    return fractions, error, terms.reshape(2, stored, n_s, n_r).swapaxes(0, 1)


def _pole_errors(values: Complexes, local: Floats, block: Floats) -> Floats:
    """Return error bounds of the poles p_l (k, K): Σ_l u_l w_l/|z − p_l| < 1 if none is nearer.

    What is farther from all of them than all u w together is; and what is twice a pole's own from it, where
    the others, at half their distance, leave it room.
    """
    gaps = np.abs(values[:, :, None] - values[:, None, :]) / 2
    gaps[:, range(gaps.shape[1]), range(gaps.shape[1])] = np.inf
    with np.errstate(all="ignore"):
        others = (local[:, None, :] / gaps).sum(axis=2) + block[:, None]
        together = np.where(block < 0.5, 2 * local.sum(axis=1), np.inf)[:, None]
    return np.where(others < 0.5, np.minimum(2 * local, together), together)


def _size(matrix: Matrix) -> Floats:
    """Return the largest magnitudes that entries have within their radii."""
    return np.asarray(np.abs(value_of(matrix)) + error_radius(matrix).real)


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
    """Return the terms S X₂ T₂^j Y₂ Q of ζ^(−j−1) of each subsystem, and a bound on ‖(ζ − T₂)⁻¹‖ |ζ| (k,).

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
    power, block = MIDPOINT_RADIUS.exact(small), np.ones(len(small))
    terms, size = 1, norms(_size(power)) / radius
    while terms < TERMS and not (size < CUT * UNIT_ROUNDOFF).all():
        block *= 1 + size
        column = np.concatenate([column, MIDPOINT_RADIUS.multiply(power, column)], axis=-1)
        power, terms = MIDPOINT_RADIUS.multiply(power, power), 2 * terms
        size = norms(_size(power)) * radius**-terms
    block *= np.where(size < 0.5, (1 + 1e-6) / (1 - np.minimum(size, 0.5)), np.inf)
    values = MIDPOINT_RADIUS.multiply(row, column)
    real = with_error_radius(value_of(values).real, error_radius(values).real + np.abs(value_of(values).imag))
    real = np.moveaxis(real.reshape(*real.shape[:-1], terms, n_r), -2, 2)
    real[:, 1, 0] += ends * (size * block)[:, None, None]
    return real, block


def _rank_one_bound(sizes: Floats) -> tuple[Floats, Floats]:
    """Return u and w with u_k w_l ≥ sizes_kl."""
    floor = np.finfo(np.float64).tiny
    u = np.maximum(sizes.max(axis=2), floor)
    w = np.maximum((sizes / u[:, :, None]).max(axis=1), floor)
    u = np.maximum((sizes / w[:, None, :]).max(axis=2), floor)
    return u, w


def _merge_last(rows: Floats, large: int) -> Floats:
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
    error_bound = (
        share**2 * exponents * (exponents + 1) / 2
        + (1 + exponents * share) * (16 + 8 * exponents) * UNIT_ROUNDOFF
    )
    slope = -exponents * reach[:, None] * value / points[:, None]
    return np.stack([value, (1 / near) ** exponents * error_bound, slope])


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
        4
        * (8 + len(transfer.fractions) + max(fraction.poles.size for fraction in transfer.fractions))
        * UNIT_ROUNDOFF
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
    """Return the sum of poles (z, k, K) weighted by residues (k · K, n_s · n_r), of shape (z, n_s, n_r)."""
    return (inverse.reshape(len(inverse), -1) @ residues).reshape(len(inverse), *shape.shape[2:])


def _reaction(fractions: _Fractions, near: Floats, nearest: Floats) -> Floats:
    """Return a bound on the effect of errors of P (z, n_s, n_r), see `_split`, for |ζ| ≥ `nearest`."""
    n_s = len(fractions.rows)
    summed = near.swapaxes(0, 1) @ fractions.circle[:, :-1]
    summed += (fractions.block[:, None] / nearest)[..., None] * fractions.circle[:, -1:]
    circle, sent, received = summed[..., 0], summed[..., 1 : n_s + 1], summed[..., n_s + 1 :]
    with np.errstate(all="ignore"):
        sent = sent / np.where(circle < 1, 1 - circle, np.nan)[..., None]
    return np.asarray(sent.transpose(1, 2, 0) @ received.swapaxes(0, 1))


def _pieces(fractions: _Fractions, points: int) -> Iterator[slice]:
    """Yield the points that are evaluated together."""
    most = max(1, ANSWERS // max(1, fractions.poles.size))
    for start in range(0, points, most):
        yield slice(start, start + most)
