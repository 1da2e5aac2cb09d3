"""Claims about `apc.eigen.duals`."""

from __future__ import annotations

from fractions import Fraction

import flint
import numpy as np

from apc.eigen.balls import precision
from apc.eigen.duals import Dual, mapped, slope_of, step_duals, value_of
from apc.frame.discretize import step_balls


def test_the_slope_of_a_step_is_the_slope() -> None:
    """F = e^(−b T), G = (1 − e^(−b T))/b for dx/dt = −b x + u; by b: −T F, and (T F − G)/b."""
    with precision(150):
        b, t = flint.arb(3), flint.arb(flint.fmpq(1, 10))
        step = step_duals(
            np.array([[Dual(-b, flint.arb(-1))]], dtype=object),
            np.array([[1]], dtype=object),
            Fraction(1, 10),
        )
        f, g = (-b * t).exp(), (1 - (-b * t).exp()) / b
        for found, value, slope in ((step[0, 0], f, -t * f), (step[0, 1], g, (t * f - g) / b)):
            assert found.value.overlaps(value)
            assert found.slope.overlaps(slope)
            assert float(found.slope.rad()) < 1e-35
        product = step[0, 0] * step[0, 0] + 1
        assert product.slope.overlaps(-2 * t * f * f)


def test_sums_and_products_follow_leibniz_in_either_order() -> None:
    """(3 + t)·(5 − 2t) at t = 0: 15 and −1; whole numbers and balls have no slope."""
    one, other = Dual(3, 1), Dual(5, -2)
    for product in (one * other, other * one):
        assert (product.value, product.slope) == (15, -1)
    for found, value, slope in ((2 + one, 5, 1), (one + other, 8, -1), (4 * other, 20, -8), (-one, -3, -1)):
        assert (found.value, found.slope) == (value, slope)
    assert (value_of(7), slope_of(7)) == (7, 0)
    assert (value_of(one), slope_of(one)) == (3, 1)
    assert mapped(slope_of, np.array([[one, 7]], dtype=object)).tolist() == [[1, 0]]


def test_a_step_without_slopes_is_the_plain_step() -> None:
    with precision(150):
        a = np.array([[0, 1], [-4, flint.arb(-1)]], dtype=object)
        b = np.array([[0], [1]], dtype=object)
        for found, plain in zip(
            step_duals(a, b, Fraction(1, 3)).ravel(), step_balls(a, b, Fraction(1, 3)).ravel(), strict=True
        ):
            assert not isinstance(found, Dual)
            assert found.overlaps(plain)


def test_the_slope_over_a_ball_holds_every_parameter_s_slope() -> None:
    """F = e^(−b T) over b from 2 to 4: −T e^(−b T) of each."""
    with precision(150):
        b, t = flint.arb(3, 1), flint.arb(flint.fmpq(1, 10))
        step = step_duals(
            np.array([[Dual(-b, flint.arb(-1))]], dtype=object),
            np.zeros((1, 0), dtype=object),
            Fraction(1, 10),
        )
        for one in (2, 2.5, 3.75, 4):
            exact = -t * (-flint.arb(one) * t).exp()
            assert step[0, 0].slope.contains(exact)
