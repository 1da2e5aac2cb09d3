"""Eigenvalues with their right and left vectors, of one matrix or of many; slopes and conditions.

Takes: matrices (…, n, n), their derivatives, or their error bounds.
Gives: `Eigenpairs`, `eigenpairs`, `pairs_of_eigenvalues`, `refined`; `eigenvalues`, `largest_magnitudes`;
`components`, `driving_parts`, `inverses`.
Guarantees: `eigenvalues` returns 0 for a derivative that would be mostly rounding.
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

from apc.support.threads import load_pool

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Indices = NDArray[np.intp]
Matrix = NDArray[Any]  # float64 or complex128

# A derivative of an eigenvalue of worse condition than this is mostly rounding.
WORST = 1e10

# Smaller eigenvalues do not decide stability; many are in a defective cluster at zero, with no derivative.
SMALL = 0.05

# The relative shift of inverse iteration from the predicted eigenvalue, so that the inverted matrix stays
# regular. Each step leaves a share of about SHIFT/gap of the other vectors.
SHIFT = 1e-7

# Steps of inverse iteration with one inverse. The vectors give the slopes: with an estimate accurate to 1e-4
# and other eigenvalues 0.1 away, 1e-9 of the other components is left.
STEPS = 3


def largest_magnitudes(matrices: Matrix) -> Floats:
    """Return the largest |λ| (…) of each matrix (…, n, n), finite, without bounds; 0 for n = 0."""
    magnitudes: Floats = np.abs(np.linalg.eigvals(matrices)).max(axis=-1, initial=0.0)
    return magnitudes


@dataclass(frozen=True, slots=True, eq=False)
class Eigenpairs:
    """Eigenvalues, with their right vectors as columns and their left vectors as rows."""

    values: Complexes  # (…, m)
    right: Complexes  # (…, n, m)
    left: Complexes  # (…, m, n)

    def at(self, indices: NDArray[np.intp]) -> Eigenpairs:
        """Return the pairs of some indices."""
        return Eigenpairs(self.values[..., indices], self.right[..., indices], self.left[..., indices, :])

    @property
    def condition(self) -> Floats:
        """The condition of each eigenvalue, |w| |v| / |w v| (…, m)."""
        product = np.abs(np.einsum("...ij,...ji->...i", self.left, self.right))
        return np.asarray(np.linalg.norm(self.left, axis=-1) * np.linalg.norm(self.right, axis=-2) / product)

    def slopes(self, slope: Matrix) -> Complexes:
        """Return the derivatives of the eigenvalues along a derivative dM of their matrix, w dM v / (w v)
        (…, m).
        """
        product = np.einsum("...ij,...ji->...i", self.left, self.right)
        return np.asarray(np.einsum("...ij,...ji->...i", self.left, slope @ self.right) / product)

    def errors(self, error: Floats) -> Floats:
        """Return the first-order error bounds of the eigenvalues, from error bounds of the entries of their
        matrix.
        """
        product = np.abs(np.einsum("...ij,...ji->...i", self.left, self.right))
        perturbation = np.einsum("...ij,...ji->...i", np.abs(self.left), error @ np.abs(self.right))
        return np.asarray(perturbation / product)


def eigenpairs(matrix: Matrix) -> Eigenpairs:
    """Return all eigenvalues of matrices (…, n, n), unordered, with their right and left vectors.

    Both vectors come from one triangular form, so that a defective cluster affects no other eigenvalue.

    Notes
    -----
    By LAPACK's geev: `scipy.linalg.eig` also calls it one matrix at a time, and takes ten times as long for a
    small one. For a real matrix geev returns the real and imaginary parts of a conjugate pair's vector in two
    columns.
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
        *batch_indices, columns = np.nonzero(values.imag > 0)
        upper, lower = (*batch_indices, slice(None), columns), (*batch_indices, slice(None), columns + 1)
        for vectors in (left, right):
            real, imaginary = vectors[upper], vectors[lower]
            vectors[upper], vectors[lower] = real + 1j * imaginary, real - 1j * imaginary
    return Eigenpairs(values, right, left.conj().swapaxes(-1, -2))


def inverses(matrix: Matrix) -> Matrix:
    """Return the inverses of matrices (…, n, n); NaN for a singular matrix."""
    try:
        return np.asarray(np.linalg.inv(matrix))
    except np.linalg.LinAlgError:
        if matrix.ndim == 2:
            return np.full_like(matrix, np.nan)
        return np.array([inverses(item) for item in matrix])


def pairs_of_eigenvalues(matrix: Matrix, values: Complexes) -> Eigenpairs:
    """Return given eigenvalues (n,) with the vectors of the nearest eigenvalues of a matrix (n, n)."""
    result = eigenpairs(matrix)
    if not values.size:
        return Eigenpairs(values, result.right[:, :0], result.left[:0])
    distances = np.abs(values[:, None] - result.values)
    nearest = distances.argmin(axis=1)
    taken, first = np.unique(nearest, return_index=True)
    repeated = np.delete(np.arange(len(values)), first)  # with the same nearest eigenvalue as another value
    if (np.abs(values[repeated]) < SMALL).all():  # a defective cluster at zero: vectors are arbitrary
        others = np.delete(np.arange(len(matrix)), taken)
        nearest[repeated] = others[np.abs(result.values[others]).argsort()[: len(repeated)]]
    else:
        nearest = load_pool("scipy.optimize").linear_sum_assignment(distances)[1]
    return Eigenpairs(values, result.right[:, nearest], result.left[nearest])


def eigenvalues(matrix: Floats, slope: Floats) -> tuple[Complexes, Complexes]:
    """Return the eigenvalues (k, n) of matrices (k, n, n) and their derivatives.

    Eigenvalues are computed for each strongly connected component. The derivative is 0 where it is mostly
    rounding: of an eigenvalue near zero, or of one that is nearly defective.
    """
    values = np.zeros((2, *matrix.shape[:2]), dtype=np.complex128)
    for part in components((matrix != 0).any(axis=0) | (slope != 0).any(axis=0)):
        block = np.index_exp[:, part[:, None], part]
        pairs = eigenpairs(matrix[block])
        with np.errstate(all="ignore"):
            derivatives = pairs.slopes(slope[block])
            unreliable = (
                (np.abs(pairs.values) < SMALL) | ~(pairs.condition < WORST) | ~np.isfinite(derivatives)
            )
        values[:, :, part] = pairs.values, np.where(unreliable, 0.0, derivatives)
    return values[0], values[1]


def refined(matrix: Matrix, guess: Eigenpairs) -> Eigenpairs:
    """Return, for each matrix (k, n, n), the eigenvalue nearest to a guess (k, 1), by inverse iteration."""
    shift = guess.values[..., None] * (1 + SHIFT)
    inverse = inverses(matrix - shift * np.eye(matrix.shape[-1]))
    v, w = guess.right, guess.left
    for _ in range(STEPS):
        v, w = inverse @ v, w @ inverse
    v, w = v / np.abs(v).max(axis=-2, keepdims=True), w / np.abs(w).max(axis=-1, keepdims=True)
    pair = Eigenpairs(guess.values, v, w)
    return Eigenpairs(pair.slopes(matrix), v, w)


def components(driven: NDArray[np.bool_]) -> list[Indices]:
    """Return the strongly connected components of a matrix's graph, ordered by their first states.

    Parameters
    ----------
    driven
        Whether state i depends on state j (n, n).

    Returns
    -------
    The states of each component, in rising order.
    """
    return list(_components(len(driven), np.packbits(driven).tobytes()))


# One model has the same few graphs repeatedly.
@lru_cache(maxsize=256)
def _components(count: int, packed: bytes) -> tuple[Indices, ...]:
    """Return the components of a graph of `count` states, with `driven` packed to bits; cached.

    Two states are in one component if each depends on the other over some path. Squaring the matrix of paths
    doubles their length. SciPy's function has the same result; its import takes as long as ten analyses.
    """
    bits = np.unpackbits(np.frombuffer(packed, np.uint8), count=count**2)
    shorter, paths = None, bits.reshape(count, count).astype(np.float32) + np.eye(count, dtype=np.float32)
    while shorter is None or (paths != shorter).any():
        shorter = paths
        paths = np.minimum(paths @ paths, 1, dtype=np.float32)
    first_states = (paths * paths.T).argmax(axis=1) if count else np.zeros(0, np.intp)
    return tuple(np.flatnonzero(first_states == first) for first in np.unique(first_states))


def driving_parts(driven: NDArray[np.bool_]) -> list[Indices]:
    """Return the `components` in which some state depends on a state of the component.

    All other states, such as packets in transit, have the eigenvalue 0 for any entries of the matrix.
    """
    return [states for states in components(driven) if driven[np.ix_(states, states)].any()]
