"""Many small matrices made diagonal, but for a block of what dies out at once.

Takes: square matrices of one size, with bounds on their errors, and their eigenvalues and vectors.
Gives: `Diagonal`, `block_diagonal`; `block_norms`, `block_norms_along`, `block_resolvent`.
Guarantees: what is left beside the diagonal and the block is bounded, rounding included. Queues running empty
make defective eigenvalues at zero: the block asks for no vectors of these.
Does not: choose what is large.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.norms import PRODUCT_ROUNDINGS, norms
from apc.frame.discretize import UNIT

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# Powers of the block are squared so often, or until they are this small: the rest is a geometric series.
SQUARINGS, SETTLED = 6, 0.1


@dataclass(frozen=True, slots=True, eq=False)
class Diagonal:
    """X⁻¹ (M + E) X = diag(p_1, …, p_L, T₂) + Δ of k matrices, |Δ| ≤ `change`.

    `dual` is X⁻¹ but for rounding, which `grown` ≥ 1 (k, 1, 1) makes up for.
    """

    basis: Complexes  # (k, n, n): X
    dual: Complexes
    small: Complexes  # (k, n − L, n − L): T₂
    change: Floats  # (k, n, n)
    grown: Floats


def block_diagonal(
    matrices: Floats, errors: Floats, values: Complexes, vectors: Complexes, large: int
) -> Diagonal:
    """Make matrices block diagonal.

    Parameters
    ----------
    matrices, errors
        M and bounds on |E|, entry by entry (k, n, n).
    values, vectors
        Their eigenvalues (k, n) and right vectors (k, n, n).
    large
        How many of the eigenvalues, the first L, are taken one by one.
    """
    n = values.shape[1]
    basis, dual, small = _block_basis(matrices, values, vectors, large)
    charge = PRODUCT_ROUNDINGS * (n + 2) * UNIT
    weight, size = np.abs(dual), np.abs(basis)
    own = values[:, None, :large]
    formed = np.concatenate([basis[:, :, :large] * own, basis[:, :, large:] @ small], axis=2)
    formed_size = np.concatenate(
        [size[:, :, :large] * np.abs(own), size[:, :, large:] @ np.abs(small)], axis=2
    )
    doubt = np.abs(matrices @ basis - formed) + (errors + charge * np.abs(matrices)) @ size
    doubt += charge * formed_size
    # The computed inverse is off: X⁻¹ = (I − F)⁻¹ Y with F = I − Y X, and |(I − F)⁻¹| ≤ 1 + 2|F|.
    wrong = (np.abs(np.eye(n) - dual @ basis) + charge * (weight @ size)).sum(axis=2).max(axis=1)
    grown = np.where(wrong < 0.25, 1 + 2 * n * wrong, np.inf)[:, None, None]
    return Diagonal(basis, dual, small, grown * (1 + charge) * (weight @ doubt), grown)


def _block_basis(
    matrices: Floats, values: Complexes, vectors: Complexes, large: int
) -> tuple[Complexes, Complexes, Complexes]:
    """Return X = [eigenvectors of the large values, X₂], its inverse, and T₂, for many matrices.

    With the vectors' QR, X_L = Q₁ R, M is block triangular over [X_L Q₂]: [Λ C; 0 T₂]. The rows of W with
    w_k (p_k − T₂) = −c_k take C away, X₂ = Q₂ + X_L W, whether or not T₂ has a set of eigenvectors.
    """
    n = matrices.shape[-1]
    q, r = np.linalg.qr(vectors[:, :, :large], mode="complete")
    adjoint = q.conj().swapaxes(1, 2)
    rest, rest_adjoint = q[:, :, large:], adjoint[:, large:]
    own = np.linalg.solve(r[:, :large], adjoint[:, :large])
    moved = matrices @ rest
    small = rest_adjoint @ moved
    coupling = own @ moved
    shifted = values[:, :large, None, None] * np.eye(n - large) - small[:, None]
    mixing = np.linalg.solve(shifted.swapaxes(2, 3), -coupling[..., None])[..., 0]
    basis = np.concatenate([vectors[:, :, :large], rest + vectors[:, :, :large] @ mixing], axis=2)
    dual = np.concatenate([own - mixing @ rest_adjoint, rest_adjoint], axis=1)
    return basis, dual, small


def block_norms_along(rows: Floats, large: int) -> Floats:
    """Return rows (k, m, n) with the entries from `large` on as one, their 2-norm: (k, m, large + 1)."""
    return np.concatenate([rows[..., :large], np.linalg.norm(rows[..., large:], axis=-1)[..., None]], axis=-1)


def block_norms(square: Floats, large: int) -> Floats:
    """Return bounds on the 2-norms of the blocks of matrices (k, n, n): (k, large + 1, large + 1)."""
    found = block_norms_along(square, large)
    last = np.linalg.norm(found[:, large:, :], axis=1)[:, None]
    last[:, 0, large] = norms(square[:, large:, large:])
    return np.concatenate([found[:, :large], last], axis=1)


def block_resolvent(small: Complexes, radius: float) -> Floats:
    """Return a bound on ‖(ζ − T₂)⁻¹‖ for |ζ| ≥ radius: Σ_j ‖T₂^j‖ radius^(−j−1), doubling by doubling."""
    total = np.full(len(small), 1.0 / radius)
    power = small / radius
    size = norms(power)
    for _ in range(SQUARINGS):
        if np.all(size < SETTLED):
            break
        total *= 1 + size
        power = power @ power
        size = norms(power)
    return np.where(size < 0.5, total / (1 - np.minimum(size, 0.5)), np.inf) * (1 + 1e-6)
