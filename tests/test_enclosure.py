"""Claims about `apc.eigen.enclosure`."""

from __future__ import annotations

import numpy as np
import pytest

from apc.eigen.enclosure import components


def _listed(driven: np.ndarray) -> list[list[int]]:
    return [part.tolist() for part in components(driven)]


def test_a_chain_of_rings_is_its_rings() -> None:
    driven = np.zeros((7, 7), dtype=bool)
    for i, j in ((0, 4), (4, 0), (2, 5), (5, 6), (6, 2), (2, 0), (3, 2), (1, 3)):
        driven[i, j] = True
    assert _listed(driven) == [[0, 4], [1], [2, 5, 6], [3]]


def test_a_queue_is_a_part_a_place_and_a_ring_is_one() -> None:
    assert _listed(np.eye(50, k=1, dtype=bool)) == [[place] for place in range(50)]
    assert _listed(np.roll(np.eye(50, dtype=bool), 1, axis=0)) == [list(range(50))]
    assert _listed(np.zeros((0, 0), dtype=bool)) == []
    assert _listed(np.eye(2, dtype=bool)) == [[0], [1]]


@pytest.mark.parametrize("density", [0.02, 0.06, 0.12, 0.4])
def test_parts_are_the_states_that_reach_each_other(density: float) -> None:
    """By the transitive closure; ordered by parts, the eigenvalues are those of the blocks."""
    generator = np.random.default_rng(4)
    for n in range(1, 30):
        driven = generator.random((n, n)) < density
        reach = np.eye(n, dtype=int) + driven
        for _ in range(5):
            reach = ((reach @ reach) > 0).astype(int)
        same = (reach > 0) & (reach.T > 0)
        expected = sorted({tuple(np.flatnonzero(row).tolist()) for row in same})
        assert _listed(driven) == [list(part) for part in expected]
        assert not driven.any() or np.array_equal(driven, driven.astype(bool))
        matrix = np.where(driven, generator.normal(size=(n, n)), 0.0)
        blocks = [np.trace(np.linalg.matrix_power(matrix[np.ix_(p, p)], 3)) for p in components(driven)]
        assert sum(blocks) == pytest.approx(np.trace(np.linalg.matrix_power(matrix, 3)), abs=1e-9)
