"""Exact numbers: rationals, ratios of polynomials, residues, every operation of CasADi."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import casadi
import flint
import numpy as np
import pytest

from apc.compiler import plain
from apc.eigen.balls import precision, rational_ball
from apc.eigen.ratios import Ratios
from apc.frame.exact import ROWS, evaluate_exact, is_rational
from apc.frame.residues import PRIMES, residues_of


def _function(build: Any, size: int = 2) -> casadi.Function:
    x = casadi.SX.sym("x", size)
    return casadi.Function("f", [x], [build(x)])


@pytest.mark.parametrize("word", sorted(plain._UNARY | plain._BINARY))
def test_every_operation_is_the_same_in_every_kind_of_number(word: str) -> None:
    """In rationals, and in rows with a complex step, what CasADi gives and differentiates."""
    symbols = casadi.vertsplit(casadi.SX.sym("x", 2 if word in plain._BINARY else 1))
    value = plain.symbolic(word)(*symbols)
    slope = casadi.jtimes(value, casadi.vertcat(*symbols), casadi.SX([1.0, -2.0][: len(symbols)]))
    f = casadi.Function("f", [casadi.vertcat(*symbols)], [value, slope])
    for point in ([0.75, 0.125], [0.25, 0.5], [0.5, 0.5], [0.0, 0.25]):
        given = point[: len(symbols)]
        wanted, derivative = (float(one) for one in f(given))
        if math.isfinite(wanted):
            direct = casadi.Function("f", symbols, [value])
            [[exact]] = evaluate_exact(direct, [[Fraction(one)] for one in given])
            assert float(exact) == pytest.approx(wanted, rel=1e-15)
        steps = [np.array([one + 1e-60j * along]) for one, along in zip(given, (1, -2), strict=False)]
        with np.errstate(all="ignore"):
            found = ROWS[word](*steps)
        if math.isfinite(wanted):
            assert np.real(found)[0] == pytest.approx(wanted, rel=1e-15)
        else:
            assert not np.isfinite(found)[0]
        corner = (word in ("fmin", "fmax") and given[0] == given[1]) or (word == "fabs" and given[0] == 0)
        if math.isfinite(derivative) and not corner:
            assert np.imag(found)[0] / 1e-60 == pytest.approx(derivative, rel=1e-14)


def test_what_is_rounded_over_rationals_is_told() -> None:
    assert is_rational(_function(lambda x: casadi.if_else(x[0] < 2, x[0] ** 3 / x[1], x[0] ** -2)))
    assert not is_rational(_function(lambda x: x[0] ** 0.3 + x[1]))
    assert not is_rational(_function(lambda x: x[0] ** x[1]))
    assert not is_rational(_function(lambda x: casadi.sqrt(x[0]) + x[1]))
    x = casadi.MX.sym("x", 2)
    assert not is_rational(casadi.Function("f", [x], [x * x]))


def _squared(x: Any, times: int) -> Any:
    return x if times == 0 else _squared(x * x, times - 1)


@pytest.mark.parametrize(
    "build",
    [
        lambda x: _squared(x[0], 40),
        lambda x: _squared(casadi.floor(x[1]), 40),
        lambda x: x[0] ** (10.0**9 * x[1]),
    ],
)
def test_a_number_of_digits_without_end_is_no_number(build: Any) -> None:
    with pytest.raises(OverflowError, match="a number of more than 1048576 bits"):
        evaluate_exact(_function(build), [[Fraction(1, 3), Fraction(2)]])


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
