"""Claims about `apc.vary.slopes`."""

from __future__ import annotations

import numpy as np
import pytest

from apc.frame.discretize import UNIT
from apc.frame.names import parameter_of
from apc.vary.batch import BatchEvaluator
from apc.vary.evaluator import evaluator
from apc.vary.sensitivity import varied
from apc.vary.slopes import moved_systems
from tests.topologies import AVERAGE, MESH, compiled, replaced

HELD = replaced(
    MESH,
    ("delay: 8 ms}", "delay: 8 ms, graph: {edges: [[1, 2, 0.3], [1, 3, 0.3], [2, 3, 0.5]]}}"),
    ("link: lan}", "link: lan, delays: own}"),
)
GROUPS = replaced(
    AVERAGE, ("  user: {count: 3}", "  one: {count: 1, set: {device.mass: 0.14 kg}}\n  two: {count: 2}")
)


@pytest.mark.parametrize("text", [AVERAGE, MESH, HELD, GROUPS], ids=["average", "mesh", "held", "groups"])
def test_what_goes_through_the_sites_is_the_derivative_of_the_whole_matrix(text: str) -> None:
    """The complex step through the composition and the closing of the whole: other products, other roundings.

    In `held` the rigid directions follow the parameters.
    """
    system = compiled(text)
    free = varied(system)
    family = evaluator(system, free)
    assert isinstance(family, BatchEvaluator)
    assert any(one.moving for one in family.wirings) == (text == HELD)
    here = np.array([parameter_of(system, one).value for one in free])
    whole = family.slopes(np.repeat(here[None], len(free), axis=0), np.eye(len(free)))
    for moved, (matrices, slopes) in zip(moved_systems(family, here), whole, strict=True):
        n = len(moved.matrix)
        assert moved.matrix == pytest.approx(matrices[0], rel=1e-12, abs=1e-12)
        found, off = np.zeros((2, *slopes.shape))
        for one in moved.through:
            inner, outward, inward = one.slopes, np.abs(one.outward), np.abs(one.inward)
            size = np.abs(inner.matrices)
            error = inner.errors + 8 * n * UNIT * size
            found[inner.places] += one.outward @ inner.matrices @ one.inward
            off[inner.places] += outward @ error @ inward
            off[inner.places] += one.outward_error @ size @ inward + outward @ size @ one.inward_error
        assert (np.abs(found - slopes) <= 2 * off).all()
        assert off.max() < 1e-9 * np.abs(slopes).max()
