"""Whole multiples of exact times: the least common one, and the largest common divisor.

Takes: rationals, of seconds mostly. Gives: `common_multiple`, `common_divisor`.
Guarantees: exact.
Does not: know a clock.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from fractions import Fraction


def common_multiple(times: Iterable[Fraction]) -> Fraction:
    """Return the least time that is a whole multiple of every one of them, one or more, all above 0."""
    listed = list(times)
    return Fraction(
        math.lcm(*(time.numerator for time in listed)), math.gcd(*(time.denominator for time in listed))
    )


def common_divisor(times: Iterable[Fraction]) -> Fraction:
    """Return the largest rational of which every time is a whole multiple."""
    listed = list(times)
    return Fraction(
        math.gcd(*(time.numerator for time in listed)), math.lcm(*(time.denominator for time in listed))
    )
