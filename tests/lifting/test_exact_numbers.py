"""Exact numbers: rationals, ratios of polynomials, every operation of CasADi."""

from __future__ import annotations

import math
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
import pytest

from apc.compiler import expression_data
from apc.parameter_values.exact_arithmetic import ROWS, evaluate_exact

PAIRS = {
    *("add", "sub", "mul", "div", "pow", "constpow", "fmin", "fmax", "atan2"),
    *("lt", "le", "eq", "ne", "and", "or", "if_else_zero"),
}


def _function(build: Any, size: int = 2) -> casadi.Function:
    x = casadi.SX.sym("x", size)
    return casadi.Function("f", [x], [build(x)])


@pytest.mark.parametrize("word", sorted(expression_data._CODES))
def test_every_operation_is_the_same_in_every_kind_of_number(word: str) -> None:
    """In rationals, and in rows with a complex step, what CasADi gives and differentiates."""
    symbols = casadi.vertsplit(casadi.SX.sym("x", 2 if word in PAIRS else 1))
    value = expression_data.symbolic(word)(*symbols)
    slope = casadi.jtimes(value, casadi.vertcat(*symbols), casadi.SX([1.0, -2.0][: len(symbols)]))
    f = casadi.Function("f", [casadi.vertcat(*symbols)], [value, slope])
    for point in ([0.75, 0.125], [0.25, 0.5], [0.5, 0.5], [0.0, 0.25]):
        given = point[: len(symbols)]
        requested, derivative = (float(one) for one in f(given))
        if math.isfinite(requested):
            direct = casadi.Function("f", symbols, [value])
            [[exact]] = evaluate_exact(direct, [[Fraction(one)] for one in given])
            assert float(exact) == pytest.approx(requested, rel=1e-15)
        steps = [np.array([one + 1e-60j * along]) for one, along in zip(given, (1, -2), strict=False)]
        with np.errstate(all="ignore"):
            found = ROWS[word](*steps)
        if math.isfinite(requested):
            assert np.real(found)[0] == pytest.approx(requested, rel=1e-15)
        else:
            assert not np.isfinite(found)[0]
        corner = (word in ("fmin", "fmax") and given[0] == given[1]) or (word == "fabs" and given[0] == 0)
        if math.isfinite(derivative) and not corner:
            assert np.imag(found)[0] / 1e-60 == pytest.approx(derivative, rel=1e-14)


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
