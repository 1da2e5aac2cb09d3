"""Claims about `apc.regions.rectangle`."""

from __future__ import annotations

import numpy as np

from apc.frame.names import Free
from apc.regions.rectangle import DirectFamily, Rectangle
from apc.vary.evaluator import PointEvaluator, evaluator
from tests.topologies import AVERAGE, compiled

RECTANGLE = Rectangle(np.array([10.0, 10.0]), np.array([2990.0, 2990.0]))
FREE = (Free("contact.stiffness"), Free("coordination.stiffness"))


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
