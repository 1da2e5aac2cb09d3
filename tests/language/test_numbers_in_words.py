"""Numbers of reports end with the digit their error stands in; lines fit a terminal."""

from __future__ import annotations

import math
from fractions import Fraction

import pytest
from hypothesis import given
from hypothesis import strategies as st

from apc.analysis.analysis import analyze
from apc.compiler.wording import known_digits, measured
from apc.lifting.numeric_model import numeric_model
from apc.output.formatting import radius_text
from tests.topologies import OSCILLATOR, compiled


@pytest.mark.parametrize(
    ("value", "error", "expected"),
    [
        (1096.4108683656437, 1.2e-10, "1096.4108683656 ± 2e-10 N/m"),
        (0.957171389624963, 4.4e-13, "0.9571713896250 ± 5e-13 N/m"),
        (0.00178074101228953, 1.7e-16, "0.0017807410122895 ± 2e-16 N/m"),
        (1234.5, 20.0, "1230 ± 3e+01 N/m"),
        (9.96, 0.06, "9.96 ± 6e-02 N/m"),
        (9.996, 0.096, "10.0 ± 1e-01 N/m"),
        (-0.5, 0.25, "-0.5 ± 3e-01 N/m"),
        (2.5e-9, 1e-12, "2.500e-09 ± 1e-12 N/m"),
        (0.0, 1e-3, "0.000 ± 1e-03 N/m"),
        (1.0, math.inf, "1 ± inf N/m"),
        (0.0, 0.0, "0 ± 0 N/m"),
        (0.0, 5e-307, "0 ± 5e-307 N/m"),
    ],
)
def test_a_number_ends_with_the_digit_its_error_stands_in(value: float, error: float, expected: str) -> None:
    number, unit = expected.rsplit(" ", 1)
    shown, mark, off = number.partition(" ± ")
    assert measured(value, error, unit) == f"{shown} {unit}{mark}{off}"


@pytest.mark.parametrize(
    ("radius", "error", "beyond", "expected"),
    [
        (1 - 3.2e-15, 7e-16, None, "1 − 3.2e-15 ± 8e-16"),
        (1 + 2.5e-8, 1e-15, None, "1 + 2.5000e-08 ± 3e-12"),
        (1.0, 9e-16, None, "1.0000000000000000 ± 9e-16"),
        (1.0, 0.5, (-0.5, -1e-3), "0.7 ± 3e-01"),
        (0.75, 1e-3, (-0.3, -0.2), "0.750 ± 1e-03"),
    ],
)
def test_a_radius_near_1_is_told_by_its_distance(
    radius: float, error: float, beyond: tuple[float, float] | None, expected: str
) -> None:
    assert radius_text(radius, error, beyond) == expected


def test_what_is_proved_of_a_radius_is_told_beyond_floats() -> None:
    found = analyze(
        numeric_model(compiled(OSCILLATOR.format(stiffness="1", damping="1e-20")))
    )  # e^(−5e-21) a second
    assert found.stable and "radius     1 − 5.0000e-21 ± " in str(found)


@given(st.floats(-1e12, 1e12), st.floats(1e-30, 1e9))
def test_what_is_shown_holds_whatever_the_error_holds(value: float, error: float) -> None:
    shown, _, off = measured(value, error).partition(" ± ")
    assert abs(Fraction(shown) - Fraction(repr(value))) + Fraction(repr(error)) <= Fraction(off)
    digit = Fraction(10) ** math.floor(math.log10(float(off)) + 1e-9)
    assert Fraction(off) <= 2 * Fraction(error) + Fraction(digit) or Fraction(off) < Fraction(
        1, 10**10
    ) * abs(Fraction(value))


@pytest.mark.parametrize(
    ("error", "expected"), [(1e-9, "1645.353"), (0.2, "1645"), (3e3, "2e+03"), (0.0, "1645.353")]
)
def test_digits_that_an_error_leaves_open_are_not_shown(error: float, expected: str) -> None:
    assert known_digits(1645.3530049, error, 7) == expected
