"""Frame matrices as Chebyshev series: they are the evaluator's, with their slopes, or are not used."""

from __future__ import annotations

import numpy as np
import pytest

from apc.frame.names import Free
from apc.regions.surrogate import ChebyshevFamily, DirectFamily, Rectangle, resolve_family
from apc.vary.batch import BatchEvaluator
from apc.vary.evaluator import PointEvaluator, evaluator
from tests.topologies import AVERAGE, compiled

RECTANGLE = Rectangle(np.array([10.0, 10.0]), np.array([2990.0, 2990.0]))
FREE = (Free("contact.stiffness"), Free("coordination.stiffness"))


def both() -> tuple[ChebyshevFamily, DirectFamily]:
    source = evaluator(compiled(AVERAGE), FREE)
    assert isinstance(source, BatchEvaluator)
    family = resolve_family(source, RECTANGLE, source.errors)
    assert isinstance(family, ChebyshevFamily)
    return family, DirectFamily(source, RECTANGLE, family.sizes, family.errors)


def test_the_series_has_the_eigenvalues_of_the_frame_everywhere() -> None:
    family, direct = both()
    points = np.random.default_rng(5).random((200, 2))
    for series, frame in zip(family.matrices(points), direct.matrices(points), strict=True):
        found, truth = (np.sort(np.abs(np.linalg.eigvals(one))) for one in (series, frame))
        queued = truth.shape[1] - found.shape[1]  # of a packet that nobody hears, as nothing damps here
        assert queued == 1
        assert np.abs(found - truth[:, queued:]).max() < 1e-12
        assert truth[:, :queued].max() < 1e-12


def test_its_slopes_are_those_of_its_sum() -> None:
    family, _ = both()
    points = np.random.default_rng(6).random((20, 2))
    step = 1e-6
    for system in range(len(family.sizes)):
        _, slopes = family.slopes(system, points)
        for axis in (0, 1):
            moved = step * np.eye(2)[axis]
            after, before = (family.matrices(points + sign * moved)[system] for sign in (1, -1))
            np.testing.assert_allclose(slopes[axis], (after - before) / (2 * step), atol=1e-7)


def test_a_frame_of_eight_ticks_is_a_polynomial_of_few_terms() -> None:
    family, _ = both()
    assert len(family.terms) <= 45


def test_what_jumps_in_the_rectangle_is_asked_point_by_point() -> None:
    class Jumping:
        free = FREE

        def matrices(self, values: np.ndarray[tuple[int, int], np.dtype[np.float64]]):  # type: ignore[no-untyped-def] # as in `Evaluator`
            return ((values[:, :1, None] > 1000) * np.ones((1, 2, 2)),)

    family = resolve_family(Jumping(), RECTANGLE, lambda values: (np.zeros((1, 2, 2)),))  # type: ignore[arg-type] # it has enough
    assert isinstance(family, DirectFamily)
    assert family.matrices(np.array([[0.1, 0.5], [0.9, 0.5]]))[0][:, 0, 0] == pytest.approx([0, 1])


def test_a_point_with_other_motions_keeps_the_size_of_the_slopes() -> None:
    """A search along a boundary may leave the rectangle, or meet an edge where other motions are free."""

    class Changing:
        def slopes(self, values: np.ndarray[tuple[int, int], np.dtype[np.float64]], along: object):  # type: ignore[no-untyped-def] # as in `Evaluator`
            size = int(values[0, 0] // 1000) + 1
            matrix = np.full((len(values), size, size), np.nan if size == 1 else float(size))
            return ((matrix, matrix),)

    family = DirectFamily(Changing(), RECTANGLE, (2,), ())  # type: ignore[arg-type] # it has enough
    at = {
        size: family.slopes(0, RECTANGLE.points(np.array([[1000.0 * size - 500, 20.0]])))
        for size in (1, 2, 3)
    }
    for matrix, slope in at.values():
        assert matrix.shape == (1, 2, 2) and slope.shape == (2, 1, 2, 2)
    assert np.isnan(at[1][0]).all() and np.isnan(at[3][0]).all()
    assert (at[2][0] == 2).all() and (at[2][1] == 2).all()


def test_where_a_search_has_lost_its_point_there_is_no_matrix() -> None:
    """The scene's contact is not linear, so that each point is linearized by itself."""
    text = AVERAGE.replace("SampledSpringDamper, a: device", "OneSidedContact, half_width: 20 mm, a: device")
    source = evaluator(compiled(text), FREE)
    assert isinstance(source, PointEvaluator)
    (found,) = source.matrices(np.array([[np.nan, 500.0], [1000.0, 500.0]]))
    assert np.isnan(found[0]).all() and np.isfinite(found[1]).all()
