"""Rational numbers modulo a prime, whole columns at once: exact zeros among a hundred thousand rows.

Takes: columns of floats, as the rationals they are.
Gives: `Residues`, `residues_of`, `residues_of_rounded`, `PRIMES`.
Guarantees: sums, products and quotients are those of the rationals modulo the prime: what is not 0 modulo it
is not 0. What is 0 modulo two of them is 0, but for one chance in 2^62.
Does not: compare, or take roots.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import Any

import numpy as np
from numpy.typing import NDArray

Integers = NDArray[np.int64]

# The largest primes below 2^31: a product of two residues fits in 63 bits.
PRIMES = (2**31 - 1, 2**31 - 19)

# A float is a whole number of 2^53rds of a power of two.
MANTISSA = 53


@dataclass(frozen=True, slots=True, eq=False)
class Residues:
    """A column of rationals modulo `prime`; a whole number or Fraction counts for every row."""

    column: Integers
    prime: int

    def _other(self, other: Any) -> Integers:
        if isinstance(other, Residues):
            return other.column
        exact = Fraction(other)
        return np.int64(exact.numerator * pow(exact.denominator, -1, self.prime) % self.prime)  # type: ignore[return-value] # it broadcasts

    def __add__(self, other: Any) -> Residues:
        return Residues((self.column + self._other(other)) % self.prime, self.prime)

    def __neg__(self) -> Residues:
        return Residues(-self.column % self.prime, self.prime)

    def __sub__(self, other: Any) -> Residues:
        return Residues((self.column - self._other(other)) % self.prime, self.prime)

    def __rsub__(self, other: Any) -> Residues:
        return Residues((self._other(other) - self.column) % self.prime, self.prime)

    def __mul__(self, other: Any) -> Residues:
        return Residues(self.column * self._other(other) % self.prime, self.prime)

    def __truediv__(self, other: Any) -> Residues:
        below = Residues(np.broadcast_to(self._other(other), self.column.shape), self.prime).inverse()
        return Residues(self.column * below.column % self.prime, self.prime)

    def __rtruediv__(self, other: Any) -> Residues:
        return Residues(self.inverse().column * self._other(other) % self.prime, self.prime)

    __radd__ = __add__
    __rmul__ = __mul__

    def inverse(self) -> Residues:
        """Return 1/self by Fermat's little theorem.

        Raises
        ------
        ZeroDivisionError
            Some row is 0 modulo the prime.
        """
        if not self.column.all():
            raise ZeroDivisionError("a row is 0 modulo the prime")
        power, square, exponent = np.ones_like(self.column), self.column, self.prime - 2
        while exponent:
            if exponent & 1:
                power = power * square % self.prime
            square = square * square % self.prime
            exponent >>= 1
        return Residues(power, self.prime)

    def __bool__(self) -> bool:
        """Say whether any row is not 0."""
        return bool(self.column.any())


def residues_of(column: NDArray[np.float64], prime: int) -> Residues:
    """Return a column of floats, each the rational it is, modulo a prime."""
    mantissa, exponent = np.frexp(column)
    whole = np.ldexp(mantissa, MANTISSA).astype(np.int64) % prime
    different, place = np.unique(exponent, return_inverse=True)
    powers = np.array([pow(2, int(power) - MANTISSA, prime) for power in different], np.int64)
    return Residues(whole * powers[place] % prime, prime)


def residues_of_rounded(column: NDArray[np.float64], rationals: Sequence[Fraction], prime: int) -> Residues:
    """Return a column of floats, each the one of these rationals that it rounds, modulo a prime.

    Raises
    ------
    ValueError
        A denominator is 0 modulo the prime.
    """
    exact = {float(one): one.numerator * pow(one.denominator, -1, prime) % prime for one in rationals}
    return Residues(np.array([exact[value] for value in column.tolist()], np.int64), prime)
