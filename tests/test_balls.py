"""Claims about `apc.eigen.balls`."""

from __future__ import annotations

from fractions import Fraction

import flint
import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import frame_balls, precision, reduced_balls, square, unprovable
from apc.eigen.modes import dense, split
from apc.eigen.relative import independent_places
from apc.eigen.rigid import find_rigid_modes
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
