"""Claims about `apc.eigen.balls`."""

from __future__ import annotations

from fractions import Fraction

import flint
import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import (
    Dual,
    frame_balls,
    mapped,
    precision,
    reduced_balls,
    slope_of,
    square,
    step_duals,
    unprovable,
    value_of,
)
from apc.eigen.modes import dense, split
from apc.eigen.relative import independent_places
from apc.eigen.rigid import find_rigid_modes
from apc.frame.discretize import step_balls
from tests.sites import MS, columned, grouped, linked, paper

SCENES = [
    paper(),
    paper("sum", own_delay=True, comp=MS * 5 / 2, comm=11 * MS, bt=1.0, bc=2.0),
    paper(comp=Fraction(0), comm=Fraction(0)),
    paper(network=3 * MS, haptic=2 * MS, haptic_phase=MS / 3, network_phase=MS / 2, comm=5 * MS),
    grouped(paper(), ("left", 2, {"device.mass": 0.2}), ("right", 3, {"contact.stiffness": 100.0})),
    linked(paper(peers=7), "ring"),
    linked(paper(peers=4), [(0, 1, 0.5), (1, 2, 2.0), (2, 3, 1.0), (3, 0, 0.25), (1, 0, 0.75)]),
    columned(paper(), device__mass=[0.1, 0.2, 0.15]),
]


@pytest.mark.parametrize("system", SCENES)
def test_the_matrix_in_balls_is_the_matrix_in_floats_within_its_error(system: CompiledSystem) -> None:
    groups, exchange = lifted_groups(system)
    for closed in (*split(groups, exchange).systems, dense(groups, exchange)):
        assert unprovable(closed) == ""
        with precision(200):
            matrix = frame_balls(closed)
            middle = [
                float(abs((flint.arb(entry) - value).mid()))
                for entry, value in zip(matrix.ravel(), closed.matrix.ravel().tolist(), strict=True)
            ]
            known = not any(way not in closed.surds for way in closed.doubts if closed.doubts[way])
            radii = max(float(flint.arb(entry).rad()) for entry in matrix.ravel())
        assert np.all(np.array(middle).reshape(closed.matrix.shape) <= closed.error + 1e-300)
        assert radii < (1e-45 if known else 1e-9)


def test_relative_coordinates_have_all_eigenvalues_but_the_rigid_ones() -> None:
    for closed in split(*lifted_groups(paper(kt=0.0))).systems:
        free = find_rigid_modes(closed)
        held = independent_places(free.basis.T).tolist()
        rest = [place for place in range(len(closed.names)) if place not in held]
        with precision(200):
            matrix = frame_balls(closed)
            reduced = reduced_balls(matrix, free.exact, held, rest)
            whole, left = square(matrix).charpoly(), square(reduced).charpoly()
            once = flint.arb_poly([-1, 1]) ** len(free.names)
            assert all(
                one.overlaps(other) for one, other in zip(whole.coeffs(), (left * once).coeffs(), strict=True)
            )


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
