"""Least common multiple and greatest common divisor of exact times.

Takes: rational numbers, usually times in seconds. Gives: `common_multiple`, `common_divisor`.
Guarantees: exact.
Does not: handle clocks.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction


def common_multiple(times: Iterable[Fraction]) -> Fraction:
    """Return the least common multiple of one or more positive times."""
    values = list(times)
    return Fraction(
        math.lcm(*(time.numerator for time in values)), math.gcd(*(time.denominator for time in values))
    )


def common_divisor(times: Iterable[Fraction]) -> Fraction:
    """Return the greatest common divisor of times: the largest rational with all times as integer
    multiples.
    """
    values = list(times)
    return Fraction(
        math.gcd(*(time.numerator for time in values)), math.lcm(*(time.denominator for time in values))
    )
