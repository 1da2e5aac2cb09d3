"""The solutions of homogeneous linear equations, exactly.

Takes: matrices of rationals, or of their residues modulo a prime.
Gives: `null_space`; `residue`, `null_space_modulo`.
Guarantees: the vectors span all rational solutions, and no more.
Does not: work on floats or balls.
"""

from __future__ import annotations

import math
from collections.abc import Callable
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
    """Return a basis of the vectors that a matrix (m, n) takes to zero.

    Each vector begins with a 1, at a place where all others are 0; those that begin first come first.
    """
    m, n = matrix.shape
    exact = flint.fmpq_mat(max(m, 1), n)
    for i, j in np.argwhere(matrix != 0).tolist():
        entry = Fraction(matrix[i, j])
        exact[i, n - 1 - j] = flint.fmpq(entry.numerator, entry.denominator)
    return _kernel(exact, lambda item: Fraction(int(item.p), int(item.q)))


def residue(number: Fraction | int) -> Any:
    """Return a rational modulo the prime, 0 and 1 as whole numbers; ValueError if it has no residue."""
    if number in (0, 1):
        return int(number)
    return flint.nmod(number.numerator * pow(number.denominator, -1, PRIME), PRIME)


def null_space_modulo(residues: Matrix) -> list[list[Fraction]]:
    """Return `null_space` of rationals from their residues (m, n), as far as simple fractions determine it.

    There are no more vectors than these; whether these are such is to be seen.

    Raises
    ------
    ValueError
        A residue has no simple fraction.
    """
    m, n = residues.shape
    quick = flint.nmod_mat(max(m, 1), n, PRIME)
    for i, j in np.argwhere(residues != 0).tolist():
        quick[i, n - 1 - j] = int(residues[i, j])
    return _kernel(quick, _simplest)


def _kernel(equations: Any, number: Callable[[Any], Fraction]) -> list[list[Fraction]]:
    """Return the solutions of equations in unknowns of which the last is the first.

    What elimination leaves free is then where a vector begins.
    """
    reduced, rank = equations.rref()
    n = reduced.ncols()
    pivots: list[int] = []
    for line in range(rank):
        pivots.append(next(c for c in range(pivots[-1] + 1 if pivots else 0, n) if reduced[line, c] != 0))
    vectors = []
    for free in sorted(set(range(n)) - set(pivots)):
        vector = [Fraction(0)] * n
        vector[free] = Fraction(1)
        for line, pivot in enumerate(pivots):
            if reduced[line, free] != 0:
                vector[pivot] = -number(reduced[line, free])
        vectors.append(vector[::-1])
    return vectors[::-1]


def _simplest(residue: Any) -> Fraction:
    """Return the one fraction of small terms that has a residue modulo the prime, by Euclid's algorithm."""
    most = math.isqrt(PRIME // 2)
    a, b, u, v = PRIME, int(residue), 0, 1
    while b > most:
        quotient = a // b
        a, b, u, v = b, a - quotient * b, v, u - quotient * v
    if abs(v) > most:
        raise ValueError("no simple fraction")
    return Fraction(b, v)
