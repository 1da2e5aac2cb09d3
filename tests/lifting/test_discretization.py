"""The exact exponential of a continuous motion, against closed forms in 60 digits and against balls."""

from __future__ import annotations

import itertools
from fractions import Fraction

import flint
import mpmath
import numpy as np
import pytest

from apc.compiler.errors import ApcError
from apc.eigen.balls import precision
from apc.frame.discretize import (
    FEW_TOGETHER,
    UNIT,
    discretize,
)

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
    for row, sizes, truth in zip(step.matrix, step.size, closed_form(m, b), strict=True):
        for value, size, true in zip(row, sizes, truth, strict=True):
            apart = abs(mpmath.mpf(float(value)) - true)
            # e^{-bT/m} underflows a float where b/m is large; nothing can be said relative to it there.
            assert apart <= mpmath.mpf("1e-15") * abs(true) + mpmath.mpf("1e-300")
            assert apart <= UNIT * float(size)


def test_a_stiff_oscillator_keeps_its_phase() -> None:
    # x'' = -w²x: cos(wT) after some 10⁵ turns, from the exact w² and T.
    w2, time = Fraction(10**14), Fraction(1, 10)
    a = np.array([[Fraction(0), Fraction(1)], [-w2, Fraction(0)]], dtype=object)
    (step,) = discretize(a, np.zeros((2, 0), dtype=object), [time])
    with mpmath.workdps(60):
        assert abs(step.matrix[0, 0] - float(mpmath.cos(mpmath.mpf(10) ** 7 / 10))) < 1e-15


def test_growth_beyond_a_float_is_refused() -> None:
    a = np.array([[Fraction(10**7)]], dtype=object)
    with pytest.raises(ApcError, match="E806"):
        discretize(a, np.zeros((1, 0), dtype=object), [Fraction(1)])


def chain(masses: int, *, stiffness: int = 1000, damping: int = 1) -> tuple[np.ndarray, np.ndarray]:
    """Masses of 10 g in a row between two walls, springs and dampers between them, the ends pushed."""
    a, b = (np.full((2 * masses, n), Fraction(0), dtype=object) for n in (2 * masses, 2))
    for i in range(masses):
        a[2 * i, 2 * i + 1] = Fraction(1)
        for j, share in ((i - 1, -1), (i, 2), (i + 1, -1)):
            if 0 <= j < masses:
                a[2 * i + 1, 2 * j : 2 * j + 2] = [Fraction(-100 * k * share) for k in (stiffness, damping)]
    b[1, 0] = b[-1, 1] = Fraction(100)
    return a, b


@pytest.mark.few(1)
@pytest.mark.parametrize(("stiffness", "damping"), [(1000, 1), (1000, 0), (20, 3), (1000, 4)])
def test_a_chain_of_many_masses_is_within_its_bound(stiffness: int, damping: int) -> None:
    a, b = chain(FEW_TOGETHER, stiffness=stiffness, damping=damping)
    (step,) = discretize(a, b, [TIME])
    both = np.concatenate([np.concatenate([a, b], axis=1), np.full((2, len(a) + 2), Fraction(0))])
    with precision(200):
        rows = [[flint.arb(flint.fmpq(one.numerator, one.denominator)) for one in row] for row in both * TIME]
        truth = np.array(
            [[float(one) for one in row] for row in flint.arb_mat(rows).exp().tolist()[: len(a)]]
        )
    bound = UNIT * step.roundings * step.size
    assert (np.abs(step.matrix - truth) <= bound + UNIT * np.abs(truth)).all()
    # In units of length in which velocities are as large as ways, no entry is off by more than composing it
    # rounds: 130 states and holds.
    units = np.tile([1.0, np.sqrt(stiffness * 100.0)], FEW_TOGETHER)
    scaled = bound / units[:, None] * np.concatenate([units, np.full(2, 1 / 100.0)])
    assert scaled.max() <= 4 * 130 * UNIT
