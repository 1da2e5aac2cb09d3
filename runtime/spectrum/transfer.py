"""The transfer of many subsystems by partial fractions: poles and residues, and their sum in discs.

Takes: the maps x⁺ = P x + Q r, s = S x + D r of many subsystems with their radii, the multiplicity of each
subsystem, and the indices of its rows of s and entries of r among all; discs.
Gives: `TransferSubsystems`, `Transfer`, `transfer_of`; `Poles`; `powers`, `add_fractions`.
Guarantees: a result holds in a disc about each point: value, radius and slope include all rounding and the
errors of the maps.
Does not: evaluate T nearer to zero than `Transfer.innermost`.

    T(ζ) = Σ_i n_i (D_i + S_i (ζ − P_i)⁻¹ Q_i)

Each P_i is split, X⁻¹ P X = diag(p_1, …, p_K, T₂) + Δ: the eigenvalues beyond `INNER` one by one, and all
smaller ones, such as those of emptying queues, as one block that may be defective. The block's part is a
short power series of 1/ζ, summed over all subsystems independently of ζ.

A matrix in a disc of radius ρ about ζ is an array (…, 3, n, m) as in `taylor_models`: value, radius and ρ
times the slope.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import (
    MIDPOINT_RADIUS,
    UNIT_ROUNDOFF,
    Matrix,
    error_radius,
    solve,
    value_of,
    with_error_radius,
)
from apc.lifting.lift import FrameMap
from apc.spectrum.matrix_norms import balance, norms

Floats = NDArray[np.float64]
Integers = NDArray[np.int64]
Complexes = NDArray[np.complex128]

# Eigenvalues within this share of the largest go into the block. The block is evaluated beyond this multiple
# of its distance from zero, where this number of terms of its series leaves 2^−64 of the first.
INNER, FARTHER, TERMS = 0.15, 4.0, 32

# The terms of a series are truncated where their sum is this fraction of a rounding.
CUT = 2.0**-7

# The number of subsystems, and of results, computed in one batch, which fits into a processor's cache.
CHUNK, ANSWERS = 1024, 65_536


@dataclass(frozen=True, slots=True, eq=False)
class TransferSubsystems:
    """k subsystems of one structure.

    `rows` are the indices of their sent values s, `lines` of their received values r.

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
    """Subsystems with equal numbers of poles K; `rows` and `lines` as in `TransferSubsystems`.

    `circle` (k, K + 1, 1 + n_s + n_r) bounds the effect of an error of P: u w, |S X| u and w |Y Q| (see
    `_partial_fractions`), with the block last; `block` (k,) bounds ‖(ζ − T₂)⁻¹‖ |ζ|.
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
    """T of all subsystems: `fractions`, and `series`, the terms of D, ζ⁻¹, ζ⁻², … (2, 1 + terms, n_s · n_r)
    with radii.
    """

    fractions: tuple[_Fractions, ...]
    series: Matrix
    shape: tuple[int, int]
    innermost: float
    poles: Poles


def transfer_of(listed: Sequence[TransferSubsystems], n_s: int, n_r: int) -> Transfer:
    """Return the transfer of all subsystems: poles, residues, and a series for the fast-decaying modes.

    Parameters
    ----------
    listed
        All subsystems.
    n_s, n_r
        The numbers of values sent and received by all subsystems.
    """
    series = np.zeros((1 + TERMS, 2, n_s, n_r))
    fractions, inner = [], [float(np.finfo(np.float64).tiny)]
    poles: list[tuple[Matrix, ...]] = []
    for structure, subsystems in enumerate(listed):
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
                selection = np.flatnonzero(large == count)
                maps = FrameMap(p[selection], q[selection], s[selection], d[selection])
                counts = subsystems.counts[start + selection]
                part, error, terms = _partial_fractions(
                    maps,
                    counts,
                    values[selection, :count],
                    vectors[selection, :, :count],
                    FARTHER * inner[-1],
                )
                fractions.append(_Fractions(subsystems.rows, subsystems.lines, *part))
                indices = np.ix_(np.arange(len(terms)), np.arange(2), subsystems.rows, subsystems.lines)
                series[indices] = MIDPOINT_RADIUS.add(series[indices], terms)
                received = np.asarray(fractions[-1].residues.any(axis=-1))
                index = np.stack([np.full(len(selection), structure), start + selection], axis=-1)
                pole_data = np.repeat(counts, count), received, np.repeat(index, count, axis=0)
                poles.append((values[selection, :count].ravel(), error.ravel(), *pole_data))
    innermost = FARTHER * max(inner)
    all_poles = [np.concatenate(part) for part in zip(*poles, strict=True)]
    order = np.argsort(-np.abs(all_poles[0]), kind="stable")
    return Transfer(
        fractions=tuple(fractions),
        series=_truncated_series(series.swapaxes(0, 1).reshape(2, 1 + TERMS, n_s * n_r), innermost),
        shape=(n_s, n_r),
        innermost=innermost,
        poles=Poles(*(part[order] for part in all_poles)),
    )


def _truncated_series(series: Matrix, innermost: float) -> Matrix:
    """Return a series of 1/ζ without terms below the rounding of its first term.

    The sum of the omitted terms is added to the radius of the first term.
    """
    sizes = (np.abs(series[0]) + series[1]) * innermost ** -np.arange(float(1 + TERMS))[:, None]
    tail_sums = np.cumsum(sizes[::-1], axis=0)[::-1]
    term_count = max(1, np.count_nonzero((tail_sums > CUT * UNIT_ROUNDOFF * tail_sums[0]).any(axis=1)))
    series[1, 0] += (1 + TERMS * UNIT_ROUNDOFF) * tail_sums[term_count:][:1].sum(axis=0)
    return series[:, :term_count]


def _partial_fractions(
    maps: FrameMap, counts: Floats, values: Complexes, vectors: Complexes, radius: float
) -> tuple[tuple[Complexes, Complexes, Floats, Floats, Floats, Floats], Floats, Matrix]:
    """Return the poles, residues and block series of subsystems with equal numbers of poles.

    Parameters
    ----------
    maps
        The frame maps of the subsystems, with their radii.
    counts
        The multiplicity of each (k,).
    values, vectors
        The poles (k, K) and their vectors (k, n, K).
    radius
        The least |ζ| at which T is evaluated.

    Returns
    -------
    The last fields of `_Fractions`; the error bounds of the poles; the terms of D, ζ⁻¹, … (terms, 2, n_s,
    n_r).

    Notes
    -----
    P + E = X (Λ + Δ) X⁻¹ holds for some |Δ| ≤ |X⁻¹ (P X − X Λ)|, radii included. A majorant of rank one,
    Δ_kl ≤ u_k w_l, makes the Neumann series of (ζ − Λ − Δ)⁻¹ a geometric one: its change is at most
    (Σ_k |S X|_k u_k/|ζ − p_k|) (Σ_l w_l |Y Q|_l/|ζ − p_l|) / (1 − Σ_k u_k w_k/|ζ − p_k|).
    """
    subsystems, large = values.shape
    n, n_s, n_r = vectors.shape[1], maps.s.shape[-2], maps.q.shape[-1]
    basis, small = _block_basis(value_of(maps.p), values, vectors)
    diagonal = np.zeros((subsystems, n, n), np.complex128)
    diagonal[:, range(large), range(large)] = values
    diagonal[:, large:, large:] = small
    exact = MIDPOINT_RADIUS.exact(basis)
    residual = MIDPOINT_RADIUS.subtract(
        MIDPOINT_RADIUS.multiply(maps.p, exact),
        MIDPOINT_RADIUS.multiply(exact, MIDPOINT_RADIUS.exact(diagonal)),
    )
    result = solve(exact, np.concatenate([residual, maps.q], axis=-1))
    if result is None:  # nearly parallel vectors: no bound
        result = np.full((subsystems, 2, n, n + n_r), np.inf, np.complex128)
    change, b = _magnitude_bounds(result[..., :n]), result[..., n:]
    a = MIDPOINT_RADIUS.multiply(maps.s, exact)
    residues = MIDPOINT_RADIUS.multiply(
        np.moveaxis(a, -1, 1)[:, :large, ..., None], np.moveaxis(b, -2, 1)[:, :large, ..., None, :]
    )
    residues = np.moveaxis(residues * counts[:, None, None, None, None], 2, 0)
    terms, block = _block_series(a[..., large:], b[..., large:, :], small, radius)
    terms = np.concatenate([maps.d[:, :, None], terms], axis=2)
    term_count = terms.shape[2]
    terms = MIDPOINT_RADIUS.multiply(
        MIDPOINT_RADIUS.exact(counts[None]), terms.swapaxes(0, 1).reshape(2, subsystems, -1)
    )
    u, w = _rank_one_bound(change)
    u, w, sent = (
        _with_block_norm(factor, large) for factor in (u[:, None], w[:, None], _magnitude_bounds(a))
    )
    received = _with_block_norm(_magnitude_bounds(b).swapaxes(1, 2), large)
    circle = np.concatenate([u * w, counts[:, None, None] * sent * u, w * received], axis=1).swapaxes(1, 2)
    error = _pole_errors(values, circle[:, :-1, 0], circle[:, -1, 0] * block / radius)
    exact, error_bound = residues.reshape(2, subsystems * large, n_s * n_r)
    fractions = values, exact, np.abs(exact), error_bound.real.copy(), block, circle
    return fractions, error, terms.reshape(2, term_count, n_s, n_r).swapaxes(0, 1)


def _pole_errors(values: Complexes, products: Floats, block: Floats) -> Floats:
    """Return error bounds of the poles p_l (k, K): no eigenvalue is at z if Σ_l u_l w_l/|z − p_l| < 1.

    The sum is below 1 at a distance from all poles above the sum of all u w; and at twice the pole's own u w
    from a pole, if the other terms, at half the distance of the other poles, sum to less than 1/2.
    """
    gaps = np.abs(values[:, :, None] - values[:, None, :]) / 2
    gaps[:, range(gaps.shape[1]), range(gaps.shape[1])] = np.inf
    with np.errstate(all="ignore"):
        others = (products[:, None, :] / gaps).sum(axis=2) + block[:, None]
        common_bound = np.where(block < 0.5, 2 * products.sum(axis=1), np.inf)[:, None]
    return np.where(others < 0.5, np.minimum(2 * products, common_bound), common_bound)


def _magnitude_bounds(matrix: Matrix) -> Floats:
    """Return the largest magnitudes of entries within their radii."""
    return np.asarray(np.abs(value_of(matrix)) + error_radius(matrix).real)


def _block_basis(matrices: Floats, values: Complexes, vectors: Complexes) -> tuple[Complexes, Complexes]:
    """Return X = [eigenvectors of the large values, X₂] and T₂, for many matrices.

    With the vectors' QR, X_L = Q₁ R, M is block triangular over [X_L Q₂]: [Λ C; 0 T₂]. The rows of W with w_k
    (p_k − T₂) = −c_k eliminate C, X₂ = Q₂ + X_L W, even if T₂ lacks a full set of eigenvectors.
    """
    n, large = vectors.shape[1:]
    q, r = np.linalg.qr(vectors, mode="complete")
    complement, adjoint = q[:, :, large:], q.conj().swapaxes(1, 2)
    mapped = matrices @ complement
    small = adjoint[:, large:] @ mapped
    coupling = np.linalg.solve(r[:, :large], adjoint[:, :large] @ mapped)
    shifted = values[:, :, None, None] * np.eye(n - large) - small[:, None]
    mixing = np.linalg.solve(shifted.swapaxes(2, 3), -coupling[..., None])[..., 0]
    return np.concatenate([vectors, complement + vectors @ mixing], axis=2), small


def _block_series(row: Matrix, column: Matrix, small: Complexes, radius: float) -> tuple[Matrix, Floats]:
    """Return the terms S X₂ T₂^j Y₂ Q of ζ^(−j−1) of each subsystem, and a bound on ‖(ζ − T₂)⁻¹‖ |ζ| (k,).

    The remainder of the series is added to the radius of the first term; both hold for |ζ| ≥ radius.

    Parameters
    ----------
    row, column
        S X₂ (k, 2, n_s, m) and Y₂ Q (k, 2, m, n_r).
    small
        T₂ (k, m, m).
    radius
        The least |ζ|.
    """
    ends = (
        np.linalg.norm(_magnitude_bounds(row), axis=2)[:, :, None]
        * np.linalg.norm(_magnitude_bounds(column), axis=1)[:, None]
    )
    n_r = column.shape[-1]
    power, block = MIDPOINT_RADIUS.exact(small), np.ones(len(small))
    terms, size = 1, norms(_magnitude_bounds(power)) / radius
    while terms < TERMS and not (size < CUT * UNIT_ROUNDOFF).all():
        block *= 1 + size
        column = np.concatenate([column, MIDPOINT_RADIUS.multiply(power, column)], axis=-1)
        power, terms = MIDPOINT_RADIUS.multiply(power, power), 2 * terms
        size = norms(_magnitude_bounds(power)) * radius**-terms
    block *= np.where(size < 0.5, (1 + 1e-6) / (1 - np.minimum(size, 0.5)), np.inf)
    values = MIDPOINT_RADIUS.multiply(row, column)
    real = with_error_radius(value_of(values).real, error_radius(values).real + np.abs(value_of(values).imag))
    real = np.moveaxis(real.reshape(*real.shape[:-1], terms, n_r), -2, 2)
    real[:, 1, 0] += ends * (size * block)[:, None, None]
    return real, block


def _rank_one_bound(sizes: Floats) -> tuple[Floats, Floats]:
    """Return u and w with u_k w_l ≥ sizes_kl for all entries."""
    floor = np.finfo(np.float64).tiny
    u = np.maximum(sizes.max(axis=2), floor)
    w = np.maximum((sizes / u[:, :, None]).max(axis=1), floor)
    u = np.maximum((sizes / w[:, None, :]).max(axis=2), floor)
    return u, w


def _with_block_norm(rows: Floats, large: int) -> Floats:
    """Return rows (k, m, n) with the entries from `large` on replaced by their 2-norm: (k, m, large + 1)."""
    return np.concatenate([rows[..., :large], np.linalg.norm(rows[..., large:], axis=-1)[..., None]], axis=-1)


def powers(points: Complexes, reach: Floats, exponents: Integers) -> Matrix:
    """Return ζ^−l in discs (3, z, l): value, radius by Taylor's remainder, and slope.

    Parameters
    ----------
    points, reach
        The discs (z,).
    exponents
        The exponents l.
    """
    near = np.maximum(np.abs(points) - reach, np.finfo(np.float64).tiny)[:, None]
    share = reach[:, None] / near
    value = (1 / points)[:, None] ** exponents  # underflows to 0 for large |ζ|
    error_bound = (
        share**2 * exponents * (exponents + 1) / 2
        + (1 + exponents * share) * (16 + 8 * exponents) * UNIT_ROUNDOFF
    )
    slope = -exponents * reach[:, None] * value / points[:, None]
    return np.stack([value, (1 / near) ** exponents * error_bound, slope])


def add_fractions(
    transfer: Transfer, total: Matrix, points: Complexes, reach: Floats, *, bounded: bool = True
) -> None:
    """Add the poles' part of T to its series in discs; a radius is NaN where T has no bound.

    Parameters
    ----------
    transfer
        T.
    total
        The values of the series (z, 3, n_s, n_r), overwritten by the sum.
    points, reach
        The discs (z,).
    bounded
        Whether radii are computed.

    Notes
    -----
    1/(ζ + h − p) = q − h q² + h² q²/(ζ + h − p), q = 1/(ζ − p): the last is at most (ρ|q|)² |q|/(1 − ρ|q|).
    """
    nearest = np.abs(points) - reach
    # The roundings of a quotient, a product, the sum over poles and the sum over fractions.
    rounded = (
        4
        * (8 + len(transfer.fractions) + max(fraction.poles.size for fraction in transfer.fractions))
        * UNIT_ROUNDOFF
    )
    for fraction in transfer.fractions:
        for piece in _point_slices(fraction, len(points)):
            inverse, radius = 1.0 / (points[piece, None, None] - fraction.poles), reach[piece, None, None]
            values = np.zeros((len(inverse), 3, len(fraction.rows), len(fraction.lines)), np.complex128)
            values[:, 0] = _weighted_residues(inverse, fraction.residues, values)
            if bounded:
                relative_reach = radius * (inverse_size := np.abs(inverse))
                with np.errstate(all="ignore"):
                    inverse_bound = inverse_size / (
                        1 - relative_reach
                    )  # 1/(|ζ − p| − ρ), negative where a pole is in the disc
                    inverse_bound[inverse_bound.min(axis=(1, 2), initial=0.0) < 0] = np.nan
                values[:, 1] = _weighted_residues(
                    inverse_bound, fraction.errors, values
                ) + _perturbation_bound(fraction, inverse_bound, nearest[piece])
                relative_reach *= relative_reach
                relative_reach += rounded
                relative_reach *= inverse_bound
                values[:, 1] += _weighted_residues(relative_reach, fraction.sizes, values)
            inverse *= inverse
            values[:, 2] = -radius * _weighted_residues(inverse, fraction.residues, values)
            total[piece, :, fraction.rows[:, None], fraction.lines] += values
    total[~(nearest >= transfer.innermost), 1] = np.nan


def _weighted_residues(inverse: Matrix, residues: Matrix, shape: Matrix) -> Matrix:
    """Return the residues (k · K, n_s · n_r) weighted by (z, k, K) and summed, (z, n_s, n_r)."""
    return (inverse.reshape(len(inverse), -1) @ residues).reshape(len(inverse), *shape.shape[2:])


def _perturbation_bound(fractions: _Fractions, near: Floats, nearest: Floats) -> Floats:
    """Return a bound on the effect of errors of P (z, n_s, n_r) for |ζ| ≥ `nearest` (see
    `_partial_fractions`).
    """
    n_s = len(fractions.rows)
    summed = near.swapaxes(0, 1) @ fractions.circle[:, :-1]
    summed += (fractions.block[:, None] / nearest)[..., None] * fractions.circle[:, -1:]
    circle, sent, received = summed[..., 0], summed[..., 1 : n_s + 1], summed[..., n_s + 1 :]
    with np.errstate(all="ignore"):
        sent = sent / np.where(circle < 1, 1 - circle, np.nan)[..., None]
    return np.asarray(sent.transpose(1, 2, 0) @ received.swapaxes(0, 1))


def _point_slices(fractions: _Fractions, points: int) -> Iterator[slice]:
    """Yield slices of the points that are evaluated in one batch."""
    most = max(1, ANSWERS // max(1, fractions.poles.size))
    for start in range(0, points, most):
        yield slice(start, start + most)
