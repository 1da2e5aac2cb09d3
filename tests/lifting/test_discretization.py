"""The exact exponential of a continuous motion, against closed forms in 60 digits and against balls."""

from __future__ import annotations

import itertools
from fractions import Fraction

import mpmath
import numpy as np
import pytest

from apc.compiler.errors import ApcError
from apc.lifting.discretize import discretize

DAMPINGS = (0.0, 1e-12, 1e-6, 5.0, 1e6)


MASSES = (1e-6, 0.1, 1e3)


TIME = Fraction(1, 1000)


def mass(m: float, b: float) -> tuple[np.ndarray, np.ndarray]:
    """A point mass with damping, pushed by a force; exact entries."""
    exact = np.array([[Fraction(0), Fraction(1)], [Fraction(0), -Fraction(b) / Fraction(m)]], dtype=object)
    return exact, np.array([[Fraction(0)], [1 / Fraction(m)]], dtype=object)


def closed_form(m: float, b: float) -> list[list[mpmath.mpf]]:
    """[F G] of a point mass by its series or its closed form, whichever loses nothing in 60 digits."""
    with mpmath.workdps(120):
        t, a, m_ = mpmath.mpf(TIME.numerator) / TIME.denominator, mpmath.mpf(b) / mpmath.mpf(m), mpmath.mpf(m)
        if b == 0:
            return [[mpmath.mpf(1), t, t**2 / 2 / m_], [mpmath.mpf(0), mpmath.mpf(1), t / m_]]
        e = mpmath.exp(-a * t)
        return [
            [mpmath.mpf(1), (1 - e) / a, (t - (1 - e) / a) / a / m_],
            [mpmath.mpf(0), e, (1 - e) / a / m_],
        ]


@pytest.mark.parametrize(("b", "m"), list(itertools.product(DAMPINGS, MASSES)))
def test_a_damped_mass_is_right_to_one_part_in_1e15_and_within_its_bound(b: float, m: float) -> None:
    (step,) = discretize(*mass(m, b), [TIME])
    for row, radii, truth in zip(*step, closed_form(m, b), strict=True):
        for value, radius, true in zip(row, radii, truth, strict=True):
            apart = abs(mpmath.mpf(float(value)) - true)
            # e^{-bT/m} underflows a float where b/m is large; nothing can be said relative to it there.
            assert apart <= mpmath.mpf("1e-15") * abs(true) + mpmath.mpf("1e-300")
            assert apart <= float(radius)


def test_a_stiff_oscillator_keeps_its_phase() -> None:
    # x'' = -w²x: cos(wT) after some 10⁵ turns, from the exact w² and T.
    w2, time = Fraction(10**14), Fraction(1, 10)
    a = np.array([[Fraction(0), Fraction(1)], [-w2, Fraction(0)]], dtype=object)
    (step,) = discretize(a, np.zeros((2, 0), dtype=object), [time])
    with mpmath.workdps(60):
        assert abs(step[0, 0, 0] - float(mpmath.cos(mpmath.mpf(10) ** 7 / 10))) < 1e-15


def test_growth_beyond_a_float_is_refused() -> None:
    a = np.array([[Fraction(10**7)]], dtype=object)
    with pytest.raises(ApcError, match="E806"):
        discretize(a, np.zeros((1, 0), dtype=object), [Fraction(1)])
