"""Eigenvalues with their right and left vectors, of one matrix or of many; slopes and conditions.

Takes: matrices (…, n, n), their derivatives, or their error bounds.
Gives: `Eigenpairs`, `eigenpairs`, `pairs_to`, `refined`; `eigenvalues`; `components`,
`driving_parts`, `inverses`.
Guarantees: a derivative that `eigenvalues` gives and that would be mostly rounding comes as 0.
Does not: bound the errors of eigenvalues (see `enclosure`).

For a simple eigenvalue λ of M with right and left vectors, M v = λ v and w M = λ w (w a row),
dλ = w dM v / (w v).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Indices = NDArray[np.intp]
Matrix = NDArray[Any]  # float64 or complex128

# A derivative of an eigenvalue of worse condition than this is mostly rounding.
WORST = 1e10

# What is smaller decides nothing; its derivative, one of a defective cluster at zero often, means nothing.
SMALL = 0.05

# How far from the predicted eigenvalue inverse iteration is shifted, so that the matrix it inverts stays
# regular. Each step leaves a share of about SHIFT/gap of the other vectors.
SHIFT = 1e-7

# Steps of inverse iteration with one inverse. The vectors give the slopes: with an estimate accurate to 1e-4
# and other eigenvalues 0.1 away, 1e-9 of the other components is left.
STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Eigenpairs:
    """Eigenvalues with their right vectors as columns and their left ones as rows."""

    values: Complexes  # (…, m)
    right: Complexes  # (…, n, m)
    left: Complexes  # (…, m, n)

    def at(self, indices: NDArray[np.intp]) -> Eigenpairs:
        """Return some of the pairs."""
        return Eigenpairs(self.values[..., indices], self.right[..., indices], self.left[..., indices, :])

    @property
    def condition(self) -> Floats:
        """The condition of each eigenvalue, |w| |v| / |w v| (…, m)."""
        product = np.abs(np.einsum("...ij,...ji->...i", self.left, self.right))
        return np.asarray(np.linalg.norm(self.left, axis=-1) * np.linalg.norm(self.right, axis=-2) / product)

    def slopes(self, slope: Matrix) -> Complexes:
        """Return how fast the eigenvalues move with their matrix, w dM v / (w v) (…, m)."""
        product = np.einsum("...ij,...ji->...i", self.left, self.right)
        return np.asarray(np.einsum("...ij,...ji->...i", self.left, slope @ self.right) / product)

    def errors(self, error: Floats) -> Floats:
        """Return the first-order error bounds of the eigenvalues, for given error bounds of their matrix."""
        product = np.abs(np.einsum("...ij,...ji->...i", self.left, self.right))
        moved = np.einsum("...ij,...ji->...i", np.abs(self.left), error @ np.abs(self.right))
        return np.asarray(moved / product)


def eigenpairs(matrix: Matrix) -> Eigenpairs:
    """Return all eigenvalues of matrices (…, n, n), in no order, with their right and left vectors.

    Both come from one triangular form, so that a defective cluster spoils none but its own.

    Notes
    -----
    By LAPACK's geev itself: `scipy.linalg.eig` calls it one matrix at a time, too, and takes ten times as
    long around a small one. Of a real matrix it gives the real and imaginary parts of a conjugate pair's
    vector in the places of the two.
    """
    geev = load_pool("scipy.linalg.lapack").get_lapack_funcs("geev", (matrix,))
    values = np.empty(matrix.shape[:-1], dtype=np.complex128)
    left, right = np.empty((2, *matrix.shape), dtype=np.complex128)
    for index in np.ndindex(matrix.shape[:-2] if matrix.size else 0):
        *parts, left[index], right[index], failed = geev(matrix[index])
        if failed:
            raise np.linalg.LinAlgError("eigenvalues did not converge")
        values[index] = parts[0] if len(parts) == 1 else parts[0] + 1j * parts[1]
    if not np.iscomplexobj(matrix):
        *where, first = np.nonzero(values.imag > 0)
        upper, lower = (*where, slice(None), first), (*where, slice(None), first + 1)
        for vectors in (left, right):
            real, imaginary = vectors[upper], vectors[lower]
            vectors[upper], vectors[lower] = real + 1j * imaginary, real - 1j * imaginary
    return Eigenpairs(values, right, left.conj().swapaxes(-1, -2))


def inverses(matrix: Matrix) -> Matrix:
    """Return the inverses of matrices (…, n, n); NaN where there is none."""
    try:
        return np.asarray(np.linalg.inv(matrix))
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(matrix, np.nan)
        return np.array([inverses(item) for item in matrix])


def pairs_to(matrix: Matrix, values: Complexes) -> Eigenpairs:
    """Return eigenvalues (n,) with the vectors that a matrix (n, n) has to the nearest of its own."""
    result = eigenpairs(matrix)
    distances = np.abs(values[:, None] - result.values)
    nearest = load_pool("scipy.optimize").linear_sum_assignment(distances)[1]
    return Eigenpairs(values, result.right[:, nearest], result.left[nearest])


def eigenvalues(matrix: Floats, slope: Floats) -> tuple[Complexes, Complexes]:
    """Return the eigenvalues (k, n) of matrices (k, n, n) and their derivatives, fast.

    States that drive each other have eigenvalues of their own. A derivative that means nothing, of an
    eigenvalue near zero or one that is hardly simple, comes as 0.
    """
    values = np.zeros((2, *matrix.shape[:2]), dtype=np.complex128)
    for part in components((matrix != 0).any(axis=0) | (slope != 0).any(axis=0)):
        block = np.index_exp[:, part[:, None], part]
        pairs = eigenpairs(matrix[block])
        with np.errstate(all="ignore"):
            moves = pairs.slopes(slope[block])
            vague = (np.abs(pairs.values) < SMALL) | ~(pairs.condition < WORST) | ~np.isfinite(moves)
        values[:, :, part] = pairs.values, np.where(vague, 0.0, moves)
    return values[0], values[1]


def refined(matrix: Matrix, guess: Eigenpairs) -> Eigenpairs:
    """Return of each matrix (k, n, n) the eigenvalue nearest to a guess (k, 1), by inverse iteration."""
    shift = guess.values[..., None] * (1 + SHIFT)
    inverse = inverses(matrix - shift * np.eye(matrix.shape[-1]))
    v, w = guess.right, guess.left
    for _ in range(STEPS):
        v, w = inverse @ v, w @ inverse
    v, w = v / np.abs(v).max(axis=-2, keepdims=True), w / np.abs(w).max(axis=-1, keepdims=True)
    pair = Eigenpairs(guess.values, v, w)
    return Eigenpairs(pair.slopes(matrix), v, w)


def components(driven: NDArray[np.bool_]) -> list[Indices]:
    """Return the strongly connected components of a matrix's graph, by their first places.

    Parameters
    ----------
    driven
        Whether state i is driven by state j (n, n).

    Returns
    -------
    The places of each part, in rising order.
    """
    return list(_components(len(driven), np.packbits(driven).tobytes()))


# SciPy takes 0.1 ms to check its argument, and one model has the same few graphs repeatedly.
@lru_cache(maxsize=256)
def _components(count: int, packed: bytes) -> tuple[Indices, ...]:
    """Return the components of a graph of so many states, whose `driven` is packed to bits."""
    # Imported where it is asked: it takes 30 ms, as long as many an analysis.
    from scipy.sparse.csgraph import connected_components

    if not count:
        return ()
    bits = np.unpackbits(np.frombuffer(packed, np.uint8), count=count**2)
    many, labels = connected_components(bits.reshape(count, count), connection="strong")
    parts = [np.flatnonzero(labels == part) for part in range(many)]
    return tuple(sorted(parts, key=lambda part: int(part[0])))


def driving_parts(driven: NDArray[np.bool_]) -> list[Indices]:
    """Return the `components` in which some state drives one of them, itself or another.

    What only passes on, as packets on their way, has the eigenvalue 0 whatever the entries are.
    """
    return [states for states in components(driven) if driven[np.ix_(states, states)].any()]
