"""Frame matrices as Chebyshev series: they are the evaluator's, with their slopes, or are not used."""

from __future__ import annotations

import numpy as np
import pytest

from apc.frame.names import Free
from apc.regions.surrogate import ChebyshevFamily, DirectFamily, Rectangle, resolve_family
from apc.vary.batch import matrix_errors
from apc.vary.evaluator import evaluator
from tests.topologies import AVERAGE, compiled

RECTANGLE = Rectangle(np.array([10.0, 10.0]), np.array([2990.0, 2990.0]))
FREE = (Free("contact.stiffness"), Free("coordination.stiffness"))


def both() -> tuple[ChebyshevFamily, DirectFamily]:
    source = evaluator(compiled(AVERAGE), FREE)
    family = resolve_family(source, RECTANGLE, lambda values: matrix_errors(source, values))
    assert isinstance(family, ChebyshevFamily)
    return family, DirectFamily(source, RECTANGLE, family.sizes, family.errors)


def test_the_series_has_the_eigenvalues_of_the_frame_everywhere() -> None:
    family, direct = both()
    points = np.random.default_rng(5).random((200, 2))
    for series, frame in zip(family.matrices(points), direct.matrices(points), strict=True):
        found, truth = (np.sort_complex(np.linalg.eigvals(one)) for one in (series, frame))
        assert np.abs(np.sort(np.abs(found)) - np.sort(np.abs(truth))).max() < 1e-12


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
