"""Claims about `apc.runtime.eigen.balls`, `apc.runtime.eigen.ratios` and `apc.runtime.eigen.duals`."""

from __future__ import annotations

from fractions import Fraction

import flint
import numpy as np
import pytest

from apc.compiler.compiled import CompiledSystem
from apc.runtime.analysis.analysis import lifted_groups
from apc.runtime.eigen.balls import frame_balls, precision, rational_ball, reduced_balls, square, unprovable
from apc.runtime.eigen.duals import Dual, step_duals
from apc.runtime.eigen.modes import dense, split
from apc.runtime.eigen.ratios import NotRational, Ratios
from apc.runtime.eigen.rigid import find_rigid_modes, independent_places
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
            reduced, _ = reduced_balls(matrix, free.exact, held, rest)
            whole, left = square(matrix).charpoly(), square(reduced).charpoly()
            once = flint.arb_poly([-1, 1]) ** len(free.names)
            assert all(
                one.overlaps(other) for one, other in zip(whole.coeffs(), (left * once).coeffs(), strict=True)
            )


def test_ratios_are_exact_and_differentiate() -> None:
    field = Ratios.of(2)
    a, b = field.parameter(0), field.parameter(1)
    assert not 1 / (a - b) - (a + b) / (a * a - b * b)
    assert (a / b) * (b / a) == 1
    assert (Fraction(1, 3) * a - a / 3 + 0.5) == Fraction(1, 2)
    with precision(100):
        point = [rational_ball(Fraction(2)), rational_ball(Fraction(3))]
        assert (a**2 / b).slope(0).at(point).contains(flint.fmpq(4, 3))
        assert (a**-1 / b).slope(1).at(point).contains(flint.fmpq(-1, 18))
        assert (2 - a).at(point).contains(0)


def test_a_ratio_refuses_to_be_compared_where_the_parameters_decide() -> None:
    a = Ratios.of(1).parameter(0)
    for question in (lambda: a < 1, lambda: abs(a), lambda: max(a, 0), lambda: float(a), lambda: a == 0):
        with pytest.raises(NotRational):
            question()
    with pytest.raises(ZeroDivisionError):
        1 / (a - a)


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
