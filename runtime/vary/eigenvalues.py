"""The eigenvalues of many matrices and how fast they move.

Takes: matrices (k, n, n) and their derivatives.
Gives: `eigenvalues`.
Guarantees: a derivative that would be mostly rounding comes as 0.
Does not: bound the errors (see `spectrum`).
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]

# An inverse of the eigenvectors is used if it is one to this; derivatives then have half their digits.
SPOILT = 1e-8

# A derivative of an eigenvalue of worse condition than this is mostly rounding.
WORST = 1e10

# What is smaller decides nothing; its derivative, one of a defective cluster at zero often, means nothing.
SMALL = 0.05


def eigenvalues(matrix: Floats, slope: Floats) -> tuple[Complexes, Complexes]:
    """Return the eigenvalues (k, n) of matrices (k, n, n) and their derivatives, dλ = w dM v / (w v).

    A derivative that means nothing, of an eigenvalue near zero or one that is hardly simple, comes as 0.
    """
    values, right = np.linalg.eig(matrix)
    unit = np.eye(matrix.shape[1])
    try:
        left = np.linalg.inv(right)
        # A defective cluster spoils the inverse for all the others as well.
        spoilt = ~(np.abs(left @ right - unit) <= SPOILT).all(axis=(1, 2))
    except np.linalg.LinAlgError:
        left, spoilt = np.empty_like(right), np.ones(len(matrix), dtype=bool)
    if spoilt.any():
        left = left.astype(np.complex128)
        left[spoilt] = _left_vectors(matrix[spoilt], values[spoilt])
    with np.errstate(all="ignore"):
        derivative = np.einsum("kij,kji->ki", left, slope @ right)
        weight = np.einsum("kij,kji->ki", left, right)
        derivative = derivative / weight
    condition = np.linalg.norm(left, axis=2) * np.linalg.norm(right, axis=1)
    vague = ~(condition < WORST * np.abs(weight)) | ~np.isfinite(derivative) | (np.abs(values) < SMALL)
    return values.astype(np.complex128), np.where(vague, 0.0, derivative)


def _left_vectors(matrix: Floats, values: Complexes) -> Complexes:
    """Return left eigenvectors as rows, those of the transposed matrix whose eigenvalue is nearest."""
    found, vectors = np.linalg.eig(matrix.swapaxes(1, 2))
    nearest = np.argmin(np.abs(values[:, :, None] - found[:, None, :]), axis=2)
    rows: Complexes = np.take_along_axis(vectors.swapaxes(1, 2), nearest[:, :, None], axis=1)
    return rows
