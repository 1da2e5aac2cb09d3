"""Eigenvalues with their right and left vectors, of one matrix or of many, and what follows from both.

Takes: matrices (…, n, n), their derivatives, or what they are off by.
Gives: `Eigenpairs`, `eigenpairs`, `left_vectors`, `pairs_to`, `refined`; `eigenvalues`; `components`.
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
Places = NDArray[np.intp]
Matrix = NDArray[Any]  # float64 or complex128

# An inverse of the eigenvectors is used if its rows are left vectors to this; derivatives have half their
# digits then, even where another eigenvalue is as near as 0.01.
SPOILT = 1e-10

# A derivative of an eigenvalue of worse condition than this is mostly rounding.
WORST = 1e10

# What is smaller decides nothing; its derivative, one of a defective cluster at zero often, means nothing.
SMALL = 0.05

# A matrix of more states than this is worth the loading of SciPy.
LARGE = 100

# Graphs of matrices whose parts are kept, and states of the largest one: a search asks for the same again and
# again.
KEPT, FEW_STATES = 128, 64

# An eigenvalue found twice, from either side, is the same to the first, relatively; below the second it ends
# within the frame.
SAME, NOTHING = 1e-9, 1e-12

# How far from the predicted eigenvalue inverse iteration is shifted, so that the matrix it inverts stays
# regular. Each step leaves a share of about SHIFT/gap of the other vectors.
SHIFT = 1e-7

# Steps of inverse iteration with one inverse. The vectors give the slopes: with a guess right to 1e-4 and
# other eigenvalues 0.1 away, 1e-9 of what there was of the others is left.
STEPS = 3


@dataclass(frozen=True, slots=True, eq=False)
class Eigenpairs:
    """Eigenvalues with their right vectors as columns and their left ones as rows."""

    values: Complexes  # (…, m)
    right: Complexes  # (…, n, m)
    left: Complexes  # (…, m, n)

    def at(self, places: NDArray[np.intp]) -> Eigenpairs:
        """Return some of the pairs."""
        return Eigenpairs(self.values[..., places], self.right[..., places], self.left[..., places, :])

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
        """Return by how much the eigenvalues are off, to first order, for what their matrix is off by."""
        product = np.abs(np.einsum("...ij,...ji->...i", self.left, self.right))
        moved = np.einsum("...ij,...ji->...i", np.abs(self.left), error @ np.abs(self.right))
        return np.asarray(moved / product)


def eigenpairs(matrix: Matrix) -> Eigenpairs:
    """Return all eigenvalues of matrices (…, n, n), in no order, and their vectors.

    Right and left vectors are looked for apart, so that a defective cluster spoils none but its own; of one
    large matrix from the same triangular form, which is most of the work.
    """
    if matrix.ndim == 2 and len(matrix) > LARGE:
        found, left, right = load_pool("scipy.linalg").eig(matrix, left=True, check_finite=False)
        return Eigenpairs(found.astype(np.complex128), right.astype(np.complex128), left.conj().T)
    values, right = (one.astype(np.complex128) for one in np.linalg.eig(matrix))
    return Eigenpairs(values, right, left_vectors(matrix, values))


def left_vectors(matrix: Matrix, values: Complexes) -> Complexes:
    """Return left vectors (…, n, n) as rows: those of Mᵀ, each to its nearest of the values (…, n)."""
    found, vectors = np.linalg.eig(matrix.swapaxes(-1, -2))
    nearest = _nearest(values, found)
    rows = np.take_along_axis(vectors.swapaxes(-1, -2), nearest[..., None], axis=-2)
    return np.asarray(rows.astype(np.complex128))


def pairs_to(matrix: Matrix, values: Complexes) -> Eigenpairs:
    """Return the eigenvalues (n,) with the vectors of a matrix (n, n), each those of the nearest it has."""
    found = eigenpairs(matrix)
    own = found.at(_nearest(values, found.values))
    return Eigenpairs(values, own.right, own.left)


def _nearest(values: Complexes, found: Complexes) -> NDArray[np.intp]:
    """Return which of the eigenvalues found (…, n) each of some values (…, n) is, each another."""
    order, ranked = (np.argsort(-np.abs(one), axis=-1, kind="stable") for one in (values, found))
    nearest = np.empty_like(order)
    np.put_along_axis(nearest, order, ranked, axis=-1)
    apart = np.abs(np.take_along_axis(found, nearest, axis=-1) - values)
    if (apart <= SAME * np.abs(values) + NOTHING).all():
        return nearest  # in order of magnitude, as mostly
    distances = np.abs(values[..., :, None] - found[..., None, :])
    nearest = np.argmin(distances, axis=-1)
    claimed = (np.diff(np.sort(nearest, axis=-1), axis=-1) == 0).any(axis=-1)
    for one in map(tuple, np.argwhere(claimed).tolist()):  # each goes to one only, as they come
        own, apart = nearest[one], distances[one]
        several = np.bincount(own, minlength=len(own))[own] > 1
        apart[:, own[~several]] = np.inf
        for place in np.flatnonzero(several).tolist():
            own[place] = np.argmin(apart[place])
            apart[:, own[place]] = np.inf
    return np.asarray(nearest)


def eigenvalues(matrix: Floats, slope: Floats) -> tuple[Complexes, Complexes]:
    """Return the eigenvalues (k, n) of matrices (k, n, n) and their derivatives, fast.

    States that drive each other have eigenvalues of their own. A derivative that means nothing, of an
    eigenvalue near zero or one that is hardly simple, comes as 0.
    """
    driven = (matrix != 0).any(axis=0) | (slope != 0).any(axis=0)
    alike = _alike(driven)
    if len(alike) == 1 and len(alike[0]) == 1:
        return _by_vectors(matrix, slope)
    found = np.zeros((2, *matrix.shape[:2]), dtype=np.complex128)
    for states in alike:
        blocks = np.index_exp[:, states[:, :, None], states[:, None, :]]
        found[:, :, states] = _by_vectors(matrix[blocks], slope[blocks])
    return found[0], found[1]


def _alike(driven: NDArray[np.bool_]) -> tuple[Places, ...]:
    """Return the parts of a matrix's graph (n, n), those of as many states together (m, s)."""
    of_size: dict[int, list[Places]] = {}
    for part in components(driven):
        of_size.setdefault(len(part), []).append(part)
    return tuple(np.array(parts) for parts in of_size.values())


def _by_vectors(matrix: Floats, slope: Floats) -> tuple[Complexes, Complexes]:
    """Return the eigenvalues (…, n) of matrices (…, n, n) and their derivatives, see `eigenvalues`."""
    if matrix.shape[-1] == 1:
        alone, rate = (one[..., 0].astype(np.complex128) for one in (matrix, slope))
        return alone, np.where((np.abs(alone) < SMALL) | ~np.isfinite(rate), 0.0, rate)
    left: Matrix
    values, right = np.linalg.eig(matrix)
    small = np.abs(values) < SMALL
    try:
        left = np.linalg.inv(right)
        # A defective cluster spoils the inverse, of the others hardly ever.
        off = np.abs(left @ matrix - values[..., None] * left).max(axis=-1)
        spoilt = ~(small | (off <= SPOILT * np.abs(left).max(axis=-1))).all(axis=-1)
    except np.linalg.LinAlgError:
        left, spoilt = np.empty_like(right), np.ones(matrix.shape[:-2], dtype=bool)
    if spoilt.any():
        left = left.astype(np.complex128)
        left[spoilt] = left_vectors(matrix[spoilt], values[spoilt])
    pairs = Eigenpairs(values, right, left)
    with np.errstate(all="ignore"):
        derivative = pairs.slopes(slope)
        vague = small | ~(pairs.condition < WORST) | ~np.isfinite(derivative)
    return values.astype(np.complex128), np.where(vague, 0.0, derivative)


def refined(matrix: Matrix, guess: Eigenpairs) -> Eigenpairs:
    """Return of each matrix (k, n, n) the eigenvalue nearest to a guess (k, 1), by inverse iteration."""
    shift = guess.values[..., None] * (1 + SHIFT)
    inverse = np.linalg.inv(matrix - shift * np.eye(matrix.shape[-1]))
    v, w = guess.right, guess.left
    for _ in range(STEPS):
        v, w = inverse @ v, w @ inverse
    v, w = v / np.abs(v).max(axis=-2, keepdims=True), w / np.abs(w).max(axis=-1, keepdims=True)
    pair = Eigenpairs(guess.values, v, w)
    return Eigenpairs(pair.slopes(matrix), v, w)


def components(driven: NDArray[np.bool_]) -> list[Places]:
    """Return the strongly connected components of a matrix's graph, by their first places.

    Parameters
    ----------
    driven
        Whether state i is driven by state j (n, n).

    Returns
    -------
    The places of each part, in rising order.

    Notes
    -----
    A state that drives nobody left, or that nobody left drives, is a part of its own: such go first, as
    queues are full of them. Of the others, what a state reaches and what reaches it are its part.
    """
    n = len(driven)
    if n > FEW_STATES:
        return _components(driven)
    return [np.array(part) for part in _known_components(n, driven.tobytes())]


@lru_cache(maxsize=KEPT)
def _known_components(n: int, driven: bytes) -> tuple[tuple[int, ...], ...]:
    """Return the components of a small graph, row by row: whatever the numbers, it mostly stays."""
    found = _components(np.frombuffer(driven, dtype=np.bool_).reshape(n, n))
    return tuple(tuple(part.tolist()) for part in found)


def _components(driven: NDArray[np.bool_]) -> list[Places]:
    """Return `components`, found."""
    links = driven.copy()
    np.fill_diagonal(links, False)
    left = np.ones(len(links), dtype=np.bool_)
    found: list[Places] = []
    while True:
        alone = left & ~((links & left).any(axis=1) & (links.T & left).any(axis=1))
        if not alone.any():
            break
        found += [np.array([place]) for place in np.flatnonzero(alone)]
        left &= ~alone
    while left.any():
        start = int(np.argmax(left))
        part = _reached(links, start, left) & _reached(links.T, start, left)
        found.append(np.flatnonzero(part))
        left &= ~part
    return sorted(found, key=lambda part: int(part[0]))


def _reached(links: NDArray[np.bool_], start: int, left: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return which of the states left are reached from one, itself included."""
    reached = np.zeros(len(links), dtype=np.bool_)
    reached[start] = True
    frontier = reached
    while frontier.any():
        frontier = links[frontier].any(axis=0) & left & ~reached
        reached = reached | frontier
    return reached
