"""The exact exponential, against closed forms in 60 digits."""

from __future__ import annotations

import itertools
from fractions import Fraction

import mpmath
import numpy as np
import pytest

from apc.compiler.errors import ApcError
from apc.frame.discretize import UNIT, discretize

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
def test_a_damped_mass_is_right_to_one_part_in_1e15_for_any_damping_and_mass(b: float, m: float) -> None:
    (step,) = discretize(*mass(m, b), [TIME])
    for row, truth in zip(step.matrix, closed_form(m, b), strict=True):
        for value, true in zip(row, truth, strict=True):
            # e^{-bT/m} underflows a float where b/m is large; nothing can be said relative to it there.
            assert abs(mpmath.mpf(float(value)) - true) <= mpmath.mpf("1e-15") * abs(true) + mpmath.mpf(
                "1e-300"
            )


@pytest.mark.parametrize(("b", "m"), list(itertools.product(DAMPINGS, MASSES)))
def test_the_error_bound_contains_the_truth(b: float, m: float) -> None:
    (step,) = discretize(*mass(m, b), [TIME])
    for row, sizes, truth in zip(step.matrix, step.size, closed_form(m, b), strict=True):
        for value, size, true in zip(row, sizes, truth, strict=True):
            assert abs(mpmath.mpf(float(value)) - true) <= UNIT * float(size)


def test_a_stiff_oscillator_keeps_its_phase() -> None:
    # x'' = -w²x: cos(wT) after some 10⁵ turns, from the exact w² and T.
    w2, time = Fraction(10**14), Fraction(1, 10)
    a = np.array([[Fraction(0), Fraction(1)], [-w2, Fraction(0)]], dtype=object)
    (step,) = discretize(a, np.zeros((2, 0), dtype=object), [time])
    with mpmath.workdps(60):
        assert abs(step.matrix[0, 0] - float(mpmath.cos(mpmath.mpf(10) ** 7 / 10))) < 1e-15


def test_two_steps_in_a_row_are_one_step_of_twice_the_length() -> None:
    once, twice = discretize(*mass(0.1, 5.0), [TIME, 2 * TIME])
    f, g = once.matrix[:, :2], once.matrix[:, 2:]
    assert np.allclose(np.hstack([f @ f, f @ g + g]), twice.matrix, rtol=1e-14, atol=0)


def test_without_states_there_is_nothing_to_step() -> None:
    (step,) = discretize(np.zeros((0, 0), dtype=object), np.zeros((0, 2), dtype=object), [TIME])
    assert step.matrix.shape == (0, 2)


def test_growth_beyond_a_float_is_refused() -> None:
    a = np.array([[Fraction(10**7)]], dtype=object)
    with pytest.raises(ApcError, match="E806"):
        discretize(a, np.zeros((1, 0), dtype=object), [Fraction(1)])
