"""Claims about `apc.frame.exact`."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import casadi
import mpmath
import numpy as np
import pytest

from apc.compiler import plain
from apc.compiler.language.expression import SMOOTH
from apc.frame.exact import ROWS, evaluate_exact, is_rational


def _function(build: Any, size: int = 2) -> casadi.Function:
    x = casadi.SX.sym("x", size)
    return casadi.Function("f", [x], [build(x)])


def test_rational_operations_are_exact() -> None:
    f = _function(lambda x: casadi.vertcat(x[0] / x[1] + x[0] * x[0] - 3, 1 / x[0], x[1] ** 3, -x[0]))
    third, seventh = Fraction(1, 3), Fraction(1, 7)
    assert evaluate_exact(f, [[third, seventh]]) == [
        [Fraction(7, 3) + Fraction(1, 9) - 3, Fraction(3), Fraction(1, 343), -third]
    ]


def test_conditions_choose_without_touching_the_other_branch() -> None:
    f = _function(lambda x: casadi.if_else(x[0] < x[1], x[0], x[1]))
    assert evaluate_exact(f, [[Fraction(1), Fraction(2)]]) == [[Fraction(1)]]
    assert evaluate_exact(f, [[Fraction(3), Fraction(2)]]) == [[Fraction(2)]]


def test_constants_are_the_doubles_they_are() -> None:
    f = _function(lambda x: x[0] * 0.1)
    assert evaluate_exact(f, [[Fraction(1), Fraction(0)]]) == [[Fraction(0.1)]]


@pytest.mark.parametrize("name", ["sqrt", "fabs", "floor", "sign", "fmin", "fmax", "atan2", *SMOOTH])
def test_every_operation_agrees_with_casadi_in_floats(name: str) -> None:
    operation = getattr(casadi, name)
    two = name in ("fmin", "fmax", "atan2")
    f = _function(lambda x: operation(x[0] / 2, x[1]) if two else operation(x[0] / 2))
    [[value]] = evaluate_exact(f, [[Fraction(7, 4), Fraction(1, 8)]])
    assert float(value) == pytest.approx(float(f([1.75, 0.125])), rel=1e-15)


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


def test_transcendental_operations_go_to_any_precision() -> None:
    f = _function(lambda x: casadi.exp(x[0]), 1)
    with mpmath.workdps(50):
        [[value]] = evaluate_exact(
            f, [[mpmath.mpf(1)]], number=mpmath.mpf, rounded=lambda name, a: getattr(mpmath, name)(a)
        )
        assert abs(value - mpmath.e) < mpmath.mpf(10) ** -48
    [[rounded]] = evaluate_exact(f, [[Fraction(1)]])
    assert rounded == Fraction(math.e)


def test_a_jacobian_can_be_walked_too() -> None:
    x = casadi.SX.sym("x", 2)
    jacobian = casadi.densify(casadi.jacobian(casadi.vertcat(x[0] * x[1], x[1] ** 2), x))
    f = casadi.Function("f", [x], [casadi.vec(jacobian)])
    a, b = Fraction(1, 3), Fraction(2, 7)
    assert evaluate_exact(f, [[a, b]]) == [[b, 0, a, 2 * b]]


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


def test_one_to_any_power_is_one() -> None:
    f = _function(lambda x: x[0] ** (10.0**9 * x[1]))
    assert evaluate_exact(f, [[Fraction(-1), Fraction(2)]]) == [[Fraction(1)]]
