"""The solutions of homogeneous linear equations, exactly.

Takes: matrices of rationals, or of their residues modulo a prime.
Gives: `null_space`; `residue`, `null_space_modulo`.
Guarantees: the vectors span all rational solutions, and no more.
Does not: work on floats or balls.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from fractions import Fraction
from typing import Any

import flint
import numpy as np
from numpy.typing import NDArray

Matrix = NDArray[Any]  # of whole numbers and fractions

# Independent whole-number vectors, freed of common factors, stay independent modulo a prime: modulo a prime a
# null space is at least as large as over the rationals.
PRIME = 2**61 - 1


def null_space(matrix: Matrix) -> list[list[Fraction]]:
    """Return a basis of the null space of a matrix (m, n), in exact rationals.

    The first nonzero entry of each vector is 1, at an index where all other vectors are 0; vectors are
    ordered by this index. Elimination is modulo a prime, and its vectors are verified; exact elimination,
    whose rationals grow, is for matrices whose null space has no simple fractions.
    """
    nonzero = [(i, j, matrix[i, j]) for i, j in np.argwhere(matrix != 0).tolist()]
    residues = np.zeros(matrix.shape, dtype=object)
    known: dict[tuple[int, int], Any] = {}
    try:
        for i, j, entry in nonzero:
            key = entry.numerator, entry.denominator
            if key not in known:
                known[key] = residue(entry)
            residues[i, j] = known[key]
        vectors = null_space_modulo(residues)
        if _solve(nonzero, vectors):
            return vectors
    except ValueError:  # the prime divides a denominator, or a residue has no simple fraction
        pass
    m, n = matrix.shape
    exact = flint.fmpq_mat(max(m, 1), n)
    for i, j, entry in nonzero:
        exact[i, n - 1 - j] = flint.fmpq(entry.numerator, entry.denominator)
    return _null_space_basis(exact, lambda item: Fraction(int(item.p), int(item.q)))


def _solve(nonzero: Sequence[tuple[int, int, Fraction | int]], vectors: Sequence[Sequence[Fraction]]) -> bool:
    """Return whether vectors solve homogeneous equations with these entries (row, column, value)."""
    for vector in vectors:
        sums: dict[int, Fraction | int] = {}
        for i, j, entry in nonzero:
            if vector[j]:
                product = entry if vector[j] == 1 else entry * vector[j]
                sums[i] = sums[i] + product if i in sums else product
        if any(sums.values()):
            return False
    return True


def residue(number: Fraction | int) -> Any:
    """Return a rational modulo PRIME, 0 and 1 as integers; ValueError if the rational has no residue."""
    if number in (0, 1):
        return int(number)
    return flint.nmod(number.numerator * pow(number.denominator, -1, PRIME), PRIME)


def null_space_modulo(residues: Matrix) -> list[list[Fraction]]:
    """Return `null_space` of rationals from their residues (m, n), with entries reconstructed as simple
    fractions.

    The rational null space has no larger dimension; the caller has to verify that these vectors belong to it.

    Raises
    ------
    ValueError
        A residue has no simple fraction.
    """
    m, n = residues.shape
    matrix = flint.nmod_mat(max(m, 1), n, PRIME)
    for i, j in np.argwhere(residues != 0).tolist():
        matrix[i, n - 1 - j] = int(residues[i, j])
    return _null_space_basis(matrix, _reconstructed_fraction)


def _null_space_basis(equations: Any, to_fraction: Callable[[Any], Fraction]) -> list[list[Fraction]]:
    """Return a basis of the null space of equations whose columns are in reversed order.

    Each basis vector, in the original order, has a 1 as its first nonzero entry, at a free unknown.
    """
    reduced, rank = equations.rref()
    n = reduced.ncols()
    pivots: list[int] = []
    for row in range(rank):
        pivots.append(next(c for c in range(pivots[-1] + 1 if pivots else 0, n) if reduced[row, c] != 0))
    vectors = []
    for free_column in sorted(set(range(n)) - set(pivots)):
        vector = [Fraction(0)] * n
        vector[free_column] = Fraction(1)
        for row, pivot in enumerate(pivots):
            if reduced[row, free_column] != 0:
                vector[pivot] = -to_fraction(reduced[row, free_column])
        vectors.append(vector[::-1])
    return vectors[::-1]


def _reconstructed_fraction(residue: Any) -> Fraction:
    """Return the fraction of small numerator and denominator with a given residue, by Euclid's algorithm."""
    limit = math.isqrt(PRIME // 2)
    a, b, u, v = PRIME, int(residue), 0, 1
    while b > limit:
        quotient = a // b
        a, b, u, v = b, a - quotient * b, v, u - quotient * v
    if abs(v) > limit:
        raise ValueError("no simple fraction")
    return Fraction(b, v)
