"""Claims about `apc.compiler.multiples`."""

from __future__ import annotations

from fractions import Fraction

from apc.compiler.multiples import common_divisor, common_multiple


def test_every_time_is_a_whole_number_of_the_largest_divisor() -> None:
    times = [Fraction(1, 90), Fraction(1, 60), Fraction(0), Fraction(7, 1000)]
    divisor = common_divisor(times)
    assert divisor == Fraction(1, 9000)
    assert all((time / divisor).denominator == 1 for time in times)


def test_the_least_common_multiple_is_whole_of_every_time_and_no_smaller_one_is() -> None:
    assert common_multiple([Fraction(3, 1000), Fraction(7, 2000)]) == Fraction(21, 1000)
    assert common_multiple([Fraction(1, 90), Fraction(1, 60)]) == Fraction(1, 30)
    assert common_multiple([Fraction(2, 3)]) == Fraction(2, 3)
    periods = [Fraction(1, 1000), Fraction(4, 3000), Fraction(5, 4)]
    found = common_multiple(periods)
    counts = [found / period for period in periods]
    assert all(count.denominator == 1 for count in counts)
    assert common_divisor(counts) == 1  # or a part of it would be whole too
