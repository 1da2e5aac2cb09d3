"""Claims about `apc.frame.residues`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.frame.residues import PRIMES, residues_of

FIRST = np.array([0.1, -2.5, 1e-300, 1e300, 3.0, 0.0])
SECOND = np.array([0.3, 1e-17, -7.0, 0.125, 1 / 3, 5.0])


def _reduced(value: Fraction, prime: int) -> int:
    return value.numerator * pow(value.denominator, -1, prime) % prime


@pytest.mark.parametrize("prime", PRIMES)
def test_residues_are_those_of_the_exact_rationals(prime: int) -> None:
    a, b = residues_of(FIRST, prime), residues_of(SECOND, prime)
    found = ((a + b) * 3 - a / b + 1 / b - (Fraction(1, 7) - a)).column
    for value, one, other in zip(found.tolist(), FIRST.tolist(), SECOND.tolist(), strict=True):
        x, y = Fraction(one), Fraction(other)
        assert value == _reduced((x + y) * 3 - x / y + 1 / y - (Fraction(1, 7) - x), prime)


def test_what_floats_round_away_is_not_zero() -> None:
    a, b = (residues_of(np.array([value]), PRIMES[0]) for value in (0.1, 0.2))
    assert (a + b) - Fraction(0.3)  # in floats, too, they differ
    assert not (a + a) - b
    small = residues_of(np.array([1.0]), PRIMES[0]) + Fraction(1e-30)
    assert small - 1


def test_a_division_by_zero_in_any_row_is_one() -> None:
    with pytest.raises(ZeroDivisionError):
        1 / residues_of(FIRST, PRIMES[0])
