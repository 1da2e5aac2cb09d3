"""The dominant eigenvalues of families of matrices over a plane, with their slopes.

Takes: a `DirectFamily`: the closed systems of a model as matrices over the unit square, with derivatives.
Gives: `Pairs`, `join`; `Eigenvalues`; `log_magnitudes`, `by_system`.
Guarantees: all points are computed in few calls. A complex pair is represented by its eigenvalue of positive
imaginary part.
Does not: use the meaning of the two coordinates.

    d log|λ|/dx = Re(dλ/dx / λ)
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.regions.adaptive_grid import just_inside
from apc.regions.rectangle import DirectFamily
from apc.spectrum.eigenpairs import Eigenpairs, refined

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Integers = NDArray[np.int64]

# Magnitudes within this relative difference are equal: rounding cannot separate them.
SIMILAR = 1e-11

# Smaller magnitudes are never dominant, and the logarithm must be finite.
LEAST_MAGNITUDE = 1e-3


@dataclass(frozen=True, slots=True, eq=False)
class Pairs:
    """The critical eigenvalue at each of k points, with its vectors.

    `slope` (k, 2) are dλ/dx and dλ/dy, `gradient` (k, 2) those of log|λ|; `right` and `left` (k, n_max) are
    the eigenvectors, padded with zeros for smaller systems.
    """

    system: Integers
    value: Complexes
    slope: Complexes
    gradient: Floats
    right: Complexes
    left: Complexes

    @property
    def log_radius(self) -> Floats:
        """log|λ| (k,), positive for a growing mode."""
        return np.log(np.abs(self.value))

    def at(self, indices: Integers | NDArray[np.bool_] | slice) -> Pairs:
        """Return the eigenpairs at some of the points."""
        return Pairs(*(getattr(self, name)[indices] for name in self.__slots__))


def join(parts: list[Pairs]) -> Pairs:
    """Return the concatenation of several sets of eigenpairs."""
    return Pairs(*(np.concatenate([getattr(part, name) for part in parts]) for name in Pairs.__slots__))


def log_magnitudes(matrices: Sequence[Floats], count: int) -> Floats:
    """Return the logarithms of the `count` largest magnitudes of all systems (k, count), descending."""
    values = np.hstack([np.abs(np.linalg.eigvals(matrix)) for matrix in matrices])
    if not values.shape[1]:  # nothing moves
        values = np.zeros((len(values), 1))
    largest = -np.sort(-values, axis=1)[:, :count]
    logarithms: Floats = np.log(np.maximum(largest, LEAST_MAGNITUDE))
    return logarithms


def by_system(system: Integers) -> list[tuple[int, Integers]]:
    """Return each system's index with the indices of its points."""
    return [(s, np.flatnonzero(system == s)) for s in sorted(set(system.tolist()))]


@dataclass(frozen=True, slots=True, eq=False)
class Eigenvalues:
    """The evaluator of the eigenvalues of closed systems over the unit square."""

    family: DirectFamily

    def growth(self, points: Floats) -> Floats:
        """Return the log of the spectral radius (k,) at points just inside the square, as the survey
        samples it.
        """
        return log_magnitudes(self.family.matrices(just_inside(points)), 1)[:, 0]

    def dominant(self, points: Floats) -> Pairs:
        """Return the eigenvalue of largest magnitude at each point (k, 2), moved just inside the square."""
        points = just_inside(points)
        matrices = self.family.matrices(points)
        values = [np.linalg.eigvals(matrix) for matrix in matrices]
        best = np.stack([np.abs(value).max(axis=1) for value in values], axis=1)
        # Of systems that share an eigenvalue, always the first: rounding would alternate between them.
        system = np.argmax(best >= (1 - SIMILAR) * best.max(axis=1, keepdims=True), axis=1)
        k, widest = len(points), max(self.family.sizes)
        value = np.zeros(k, np.complex128)
        start = np.zeros((k, widest), np.complex128)
        for s, values_of_system in enumerate(values):
            rows = np.flatnonzero(system == s)
            if len(rows):
                result = values_of_system[
                    rows,
                    np.argmax(
                        np.abs(values_of_system[rows]) + 1e-12 * (values_of_system[rows].imag > 0), axis=1
                    ),
                ]
                value[rows] = result.real + 1j * np.abs(result.imag)
                # An arbitrary start vector: inverse iteration converges unless it is orthogonal.
                start[rows, : self.family.sizes[s]] = 1 / (1 + np.arange(self.family.sizes[s])) + 0.5j
        guess = Pairs(system, value, np.zeros((k, 2), complex), np.zeros((k, 2)), start, start.copy())
        return self.refine(points, guess)

    def refine(self, points: Floats, guess: Pairs) -> Pairs:
        """Return at each point the eigenvalue of a system nearest to a guess, by inverse iteration.

        Parameters
        ----------
        points
            The points (k, 2).
        guess
            The system, eigenvalue and start vectors of each point.
        """
        k = len(points)
        system = guess.system
        value, slope = np.zeros(k, np.complex128), np.zeros((k, 2), np.complex128)
        right, left = np.zeros_like(guess.right), np.zeros_like(guess.left)
        for s, rows in by_system(system):
            n = self.family.sizes[s]
            matrix, derivatives = self.family.slopes(s, points[rows])
            pair = refined(
                matrix,
                Eigenpairs(guess.value[rows, None], guess.right[rows, :n, None], guess.left[rows, None, :n]),
            )
            value[rows], slope[rows] = pair.values[:, 0], pair.slopes(derivatives)[..., 0].T
            right[rows, :n], left[rows, :n] = pair.right[..., 0], pair.left[:, 0]
        gradient = (slope / value[:, None]).real
        return Pairs(system, value, slope, gradient, right, left)

    def value_errors(self, pairs: Pairs) -> Floats:
        """Return error bounds of the eigenvalues (k,) for errors E of the matrices: |w| E |v|/|w v|."""
        values = np.zeros(len(pairs.value))
        for s, rows in by_system(pairs.system):
            n = self.family.sizes[s]
            right, left = pairs.right[rows, :n, None], pairs.left[rows, None, :n]
            pair = Eigenpairs(pairs.value[rows, None], right, left)
            values[rows] = pair.errors(self.family.errors[s])[:, 0]
        return values
