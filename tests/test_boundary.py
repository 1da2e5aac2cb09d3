"""Boundary curves of families whose boundary is known."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.regions.boundary import Arc, trace
from apc.regions.cells import Survey, survey
from apc.regions.curves import area_beside, between
from apc.regions.eigenpairs import Eigenvalues, log_magnitudes
from tests.fields import Fields, cusp, disc, plane

TOLERANCE = 1e-9


def found(*fields: object, cells: int = 12) -> tuple[Fields, Survey, tuple[Arc, ...]]:
    """Return a family, its survey and its boundary; the boundary has been checked against the family."""
    family = Fields(*fields)  # type: ignore[arg-type] # fields
    seen = survey(lambda points: log_magnitudes(family.matrices(points), 4), cells=cells)
    arcs = trace(Eigenvalues(family), seen, tolerance=TOLERANCE, offset=np.zeros(2))
    for arc in arcs:
        check(family, arc)
    return family, seen, arcs


def check(family: Fields, arc: Arc) -> None:
    """The knots are on the boundary to rounding, the curve between them within its error."""
    assert np.abs(log_magnitudes(family.matrices(arc.knots), 1)).max() < 1e-12
    ends = (arc.points[:-1], arc.points[1:], arc.tangents[:-1], arc.tangents[1:])
    for share in (0.0, 0.21, 0.5, 0.8):
        pairs = Eigenvalues(family).leading(between(*ends, share))
        off = np.abs(pairs.growth) / np.linalg.norm(pairs.gradient, axis=1)
        assert np.all(off <= arc.errors.max() + 1e-12)
    beside = arc.points[1:-1] + 1e-4 * np.stack([-arc.tangents[1:-1, 1], arc.tangents[1:-1, 0]], axis=1)
    assert np.all(log_magnitudes(family.matrices(beside), 1) < 0), "the stable side is on the left"


def enclosed(arcs: tuple[Arc, ...]) -> float:
    return sum(area_beside(arc.points, arc.tangents) for arc in arcs)


def test_an_island_is_one_closed_curve_with_the_area_of_its_disc() -> None:
    _, _, arcs = found(disc(0.5, 0.5, 0.3))
    assert [arc.closed for arc in arcs] == [True]
    assert enclosed(arcs) == pytest.approx(np.pi * 0.09, rel=1e-9)
    assert arcs[0].errors.max() <= TOLERANCE


def test_a_hole_runs_the_other_way_round() -> None:
    _, seen, arcs = found(disc(0.52, 0.47, 0.2, -1))
    assert seen.corners == (True, True, True, True)
    assert enclosed(arcs) == pytest.approx(-np.pi * 0.04, rel=1e-9)


def test_two_islands_and_a_hole_inside_one_are_all_found() -> None:
    def both(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[NDArray[np.float64], ...]:
        """Return a product that is below zero in each of two discs apart."""
        (f, f_x, f_y), (g, g_x, g_y) = disc(0.25, 0.3, 0.17)(x, y), disc(0.7, 0.65, 0.2)(x, y)
        return f * g, f_x * g + f * g_x, f_y * g + f * g_y

    _, _, arcs = found(both, disc(0.68, 0.66, 0.05, -1))
    assert [arc.closed for arc in arcs] == [True] * 3
    assert enclosed(arcs) == pytest.approx(np.pi * (0.17**2 + 0.2**2 - 0.05**2), rel=1e-8)


def test_where_another_mode_takes_over_the_curve_has_a_corner() -> None:
    _, _, arcs = found(plane(1, 0.2, 0.5), plane(0.1, 1, 0.5))
    corner = np.linalg.solve([[1, 0.2], [0.1, 1]], [0.5, 0.5])
    assert [arc.system for arc in arcs] == [0, 1]
    np.testing.assert_allclose([arcs[0].points[-1], arcs[1].points[0]], [corner, corner], atol=1e-13)


def test_two_discs_leave_a_lens_with_two_corners_even_on_a_line_of_the_grid() -> None:
    _, _, arcs = found(disc(0.4, 0.5, 0.3), disc(0.6, 0.5, 0.3), cells=16)
    height = np.sqrt(0.09 - 0.01)
    corners = sorted(float(arc.points[0, 1]) for arc in arcs)
    assert corners == pytest.approx([0.5 - height, 0.5 + height], abs=1e-12)
    lens = 2 * (0.09 * np.arccos(1 / 3) - 0.1 * height)
    assert enclosed(arcs) == pytest.approx(lens, rel=1e-9)


def test_a_mode_that_bites_off_a_corner_between_two_crossings_is_seen() -> None:
    _, _, arcs = found(plane(1, 0, 0.51), disc(0.51, 0.52, 0.03, -1))
    assert sorted({arc.system for arc in arcs}) == [0, 1]


def test_a_curve_through_the_nodes_of_the_grid_is_one_curve() -> None:
    _, _, arcs = found(plane(1, 1, 1.0), cells=12)
    assert len(arcs) == 1
    np.testing.assert_allclose(np.sort(arcs[0].points[[0, -1], 0]), [0, 1], atol=1e-12)


def test_an_island_much_smaller_than_a_cell_is_found_by_what_is_seen_around_it() -> None:
    _, seen, arcs = found(disc(0.53, 0.53, 0.015))
    assert seen.finest < seen.cell
    assert enclosed(arcs) == pytest.approx(np.pi * 0.015**2, rel=1e-8)


def test_a_cusp_is_followed_as_far_as_it_has_a_tangent() -> None:
    family = Fields(cusp(0.32, 0.47))
    seen = survey(lambda points: log_magnitudes(family.matrices(points), 2), cells=12)
    arcs = trace(Eigenvalues(family), seen, tolerance=TOLERANCE, offset=np.zeros(2))
    points = np.concatenate([arc.points for arc in arcs])
    assert np.abs(points - [0.32, 0.47]).max(axis=1).min() < 0.02
    assert all(np.abs(log_magnitudes(family.matrices(arc.knots), 1)).max() < 1e-12 for arc in arcs)


def test_an_empty_region_and_a_full_one_have_no_boundary() -> None:
    for limit, stable in ((-1.0, False), (2.0, True)):
        _, seen, arcs = found(plane(0.1, 0.1, limit))
        assert arcs == ()
        assert set(seen.corners) == {stable}


def test_a_boundary_along_the_rectangles_edge_is_outside_it() -> None:
    # log|λ| = −x: zero on the whole left edge, where a stiffness of zero would free what it held.
    _, seen, arcs = found(plane(-1, 0, 0.0))
    assert arcs == ()
    assert seen.corners == (True, True, True, True)
