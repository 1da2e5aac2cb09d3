"""Claims about `apc.eigen.enclosure`."""

from __future__ import annotations

import numpy as np
import pytest

from apc.eigen.eigenpairs import components
from apc.eigen.enclosure import enclose_eigenvalues


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


def _chain(n: int, count: int) -> np.ndarray:
    """Return the frame of so many masses in a row, and a ring of queues that nearly stand still."""
    spring = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    still = np.zeros((n, n))
    matrix = np.eye(2 * n) + 0.05 * np.block([[still, np.eye(n)], [-spring, -0.3 * np.eye(n) - 0.5 * spring]])
    whole = np.zeros((2 * n + count, 2 * n + count))
    whole[: 2 * n, : 2 * n], whole[2 * n :, 2 * n :] = matrix, 1e-3 * np.eye(count, k=-1)
    whole[2 * n :, 0] = whole[1, 2 * n :] = 1e-6
    return whole


@pytest.mark.parametrize(("masses", "count"), [(20, 0), (20, 6), (60, 3)])
def test_what_stands_alone_is_as_sure_as_first_order_has_it(masses: int, count: int) -> None:
    """An eigenvalue far from others is off by little more than its own vectors say, however many states.

    A disc about it whose radius counts every other motion is as many times as wide as there are of them. Of
    matrices within the error, the eigenvalues by another program's way are within the bounds.
    """
    matrix, off = _chain(masses, count), 1e-9
    error = off * np.abs(matrix)
    pairs, found = enclose_eigenvalues(matrix, error)
    first = pairs.errors(error)
    assert found.high - found.low < 4 * first[0] + 1e-12
    generator = np.random.default_rng(5)
    for _ in range(5):
        moved = np.linalg.eigvals(matrix + error * generator.choice([-1.0, 1.0], size=matrix.shape))
        assert found.low <= np.abs(moved).max() <= found.high
        assert (np.abs(pairs.values[:, None] - moved).min(axis=1) <= found.errors + 1e-13).all()


def test_two_that_hardly_differ_keep_their_common_disc() -> None:
    """Nothing tells a pair apart that the error mixes: each may be anywhere the pair may."""
    size, apart, off = 40, 1e-5, 1e-4
    matrix = np.diag(np.linspace(0.1, 0.8, size))
    matrix[-1, -1] = matrix[-2, -2] + apart
    error = np.full((size, size), off / size)
    pairs, found = enclose_eigenvalues(matrix, error)
    mixed = matrix + error[0, 0] * (np.eye(size, k=1) - np.eye(size, k=-1))
    moved = np.linalg.eigvals(mixed)
    assert (np.abs(pairs.values[:, None] - moved).min(axis=1) <= found.errors).all()
    assert found.errors[:2].min() >= apart / 2


@pytest.mark.parametrize("masses", [20, 60])
def test_conjugates_folded_into_real_columns_are_bounded_as_tightly_as_unfolded(masses: int) -> None:
    """Given as complex, the same matrix is enclosed by complex products: both hold the radius."""
    matrix = _chain(masses, 3)
    error = 1e-15 * np.abs(matrix)
    (pairs, folded), (_, unfolded) = (enclose_eigenvalues(one, error) for one in (matrix, matrix + 0j))
    assert (np.abs(pairs.values.imag) > 1e-3).sum() > masses
    assert max(folded.low, unfolded.low) <= min(folded.high, unfolded.high)
    assert folded.high - folded.low <= 2 * (unfolded.high - unfolded.low)
    assert np.median(folded.errors) <= 2 * np.median(unfolded.errors)
