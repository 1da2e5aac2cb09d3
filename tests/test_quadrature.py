"""Claims about `apc.simulation.quadrature`."""

from __future__ import annotations

from fractions import Fraction

import mpmath
import numpy as np
import pytest

from apc.simulation.quadrature import (
    AGREE,
    NODES,
    Kernel,
    integrate,
    kernel_of,
    magnitude,
    panels,
    whole,
)

LENGTH = Fraction(1, 100)
MILD = np.array([[Fraction(0), Fraction(1)], [Fraction(-90), Fraction(-3, 2)]])
STIFF = np.array([[Fraction(0), Fraction(1)], [Fraction(-90), Fraction(-50_000)]])


def truth(kernel: Kernel, low: float, high: float) -> np.ndarray:
    """Return ∫ e^{A (T − s)} b cos(40 s) ds for a push on the second state, by the integral's closed form."""
    with mpmath.workdps(40):
        a = mpmath.matrix([[mpmath.mpf(one.numerator) / one.denominator for one in row] for row in kernel.a])
        end, w = mpmath.mpf(kernel.duration.numerator) / kernel.duration.denominator, mpmath.mpc(0, 40)
        # The integral of e^{A (T − s) + i w s} is −(A − i w)⁻¹ of itself at the ends.
        shifted = a - w * mpmath.eye(2)

        def at(s: float) -> mpmath.matrix:
            return mpmath.expm(a * (end - s)) * mpmath.exp(w * s) * mpmath.matrix([0, 1])

        found = mpmath.lu_solve(shifted, at(low) - at(high))
        return np.array([float(mpmath.re(one)) for one in found])


@pytest.mark.parametrize(("low", "high"), [(0.0, 0.01), (0.0, 0.0003), (0.002, 0.0071), (0.0099, 0.01)])
def test_a_part_of_an_interval_is_integrated_to_rounding(low: float, high: float) -> None:
    kernel = kernel_of(MILD, [1], LENGTH)
    assert kernel.smooth
    part = panels(kernel, np.array([low]), np.array([high]))
    g = np.cos(40 * part.after)[None]
    fine, apart = integrate(part, g)
    size = magnitude(part, g)
    assert (apart <= AGREE * size).all()
    assert (np.abs(fine[0] - truth(kernel, low, high)) <= AGREE * size[0]).all()


def test_the_whole_interval_is_right_to_the_last_digits_of_every_state() -> None:
    kernel = kernel_of(MILD, [1], LENGTH)
    found = whole(kernel)
    fine, _ = integrate(found, np.cos(40 * found.after)[None])
    np.testing.assert_allclose(fine[0], truth(kernel, 0.0, 0.01), rtol=1e-15)


def test_what_dies_out_within_the_interval_is_not_taken_for_smooth() -> None:
    kernel = kernel_of(STIFF, [1], LENGTH)
    assert not kernel.smooth
    low = np.array([0.0, 0.00999])
    part = panels(kernel, low, np.array([0.005, 0.01]))
    expected = [mpmath.expm(mpmath.matrix([[0, 1], [-90, -50_000]]) * (0.01 - s)) for s in part.after[1]]
    weights = (0.01 - 0.00999) / 2 * np.polynomial.legendre.leggauss(10)[1]
    for node in range(10):
        found = part.weights[1, node, :, 0] / weights[node]
        np.testing.assert_allclose(found, [float(expected[node][i, 1]) for i in (0, 1)], rtol=1e-11)


def test_rules_that_are_not_enough_are_told_apart() -> None:
    kernel = kernel_of(MILD, [1], LENGTH)
    found = whole(kernel)
    g = np.cos(4e4 * found.after)[None]
    _, apart = integrate(found, g)
    assert (apart > AGREE * magnitude(found, g)).any()
    assert found.after.shape == (1, len(NODES))
