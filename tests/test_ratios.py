"""Claims about `apc.eigen.ratios`."""

from __future__ import annotations

from fractions import Fraction

import flint
import pytest

from apc.eigen.balls import precision, rational_ball
from apc.eigen.ratios import MOST_TERMS, NotRational, Ratio, Ratios


def test_ratios_are_exact_and_differentiate() -> None:
    field = Ratios.of(2)
    a, b = field.parameter(0), field.parameter(1)
    assert not 1 / (a - b) - (a + b) / (a * a - b * b)
    assert (a / b) * (b / a) == 1
    assert (Fraction(1, 3) * a - a / 3 + 0.5) == Fraction(1, 2)
    with precision(100):
        point = [rational_ball(Fraction(2)), rational_ball(Fraction(3))]
        assert (a**2 / b).slope(0).at(point).contains(flint.fmpq(4, 3))
        assert (a**-1 / b).slope(1).at(point).contains(flint.fmpq(-1, 18))
        assert (2 - a).at(point).contains(0)


def test_a_ratio_refuses_to_be_compared_where_the_parameters_decide() -> None:
    a = Ratios.of(1).parameter(0)
    for question in (lambda: a < 1, lambda: abs(a), lambda: max(a, 0), lambda: float(a), lambda: a == 0):
        with pytest.raises(NotRational):
            question()
    with pytest.raises(ZeroDivisionError):
        1 / (a - a)


def test_a_ratio_is_the_function_at_every_point() -> None:
    """(a + 2b)³/(a − b) − 1/b, its value and slopes, by hand in fractions at a few points."""
    field = Ratios.of(2)
    a, b = field.parameter(0), field.parameter(1)
    ratio = (a + 2 * b) ** 3 / (a - b) - 1 / b
    with precision(200):
        for x, y in (
            (Fraction(3), Fraction(1, 7)),
            (Fraction(-5, 2), Fraction(4)),
            (Fraction(1, 3), Fraction(-2)),
        ):
            s, d = x + 2 * y, x - y
            by_a = 3 * s**2 / d - s**3 / d**2
            by_b = 6 * s**2 / d + s**3 / d**2 + 1 / y**2
            point = [rational_ball(x) + flint.arb(0), rational_ball(y) + flint.arb(0)]
            for found, exact in ((ratio, s**3 / d - 1 / y), (ratio.slope(0), by_a), (ratio.slope(1), by_b)):
                assert found.at(point).contains(flint.fmpq(exact.numerator, exact.denominator))


def test_what_depends_on_no_parameter_is_a_number() -> None:
    a = Ratios.of(1).parameter(0)
    third = (a + a * a) / (3 * a + 3 * a * a)
    assert third.constant() == Fraction(1, 3)
    assert float(third) == 1 / 3
    assert abs(-third) == Fraction(1, 3)
    assert third < 1 <= 3 * third
    assert int(6 * third) == 2
    assert not a - a
    assert a


def test_a_ratio_that_grows_without_end_is_refused() -> None:
    field = Ratios.of(4)
    total: Ratio = field.parameter(0) * 0
    for place in range(4):
        total = total + field.parameter(place)
    with pytest.raises(NotRational, match="too many terms"):
        for _ in range(MOST_TERMS):
            total = total * total
