"""Claims about `apc.moments.gains`: sums of moments lie within their radii.

Independent: the equation X = M X Mᵀ + B, written out and solved in balls of 200 bits.
"""

from __future__ import annotations

import flint
import numpy as np
import pytest
from numpy.typing import NDArray

from apc.eigen.balls import precision
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.moments.gains import stein

Floats = NDArray[np.float64]


def solved(matrix: Floats, driven: Floats) -> Floats:
    """Return X to the last digit of a float."""
    n = len(matrix)
    with precision(200):
        own = flint.arb_mat(n, n, matrix.ravel().tolist())
        rows = [
            [(i == k and j == m) - own[i, k] * own[j, m] for k in range(n) for m in range(n)]
            for i in range(n)
            for j in range(n)
        ]
        right = flint.arb_mat(n * n, 1, driven.ravel().tolist())
        found = flint.arb_mat(n * n, n * n, [one for row in rows for one in row]).solve(right)
        return np.array([float(one.mid()) for one in found.entries()]).reshape(n, n)


def drawn(seed: int, radius: float) -> tuple[Floats, Floats]:
    """Return a matrix of a spectral radius, its states of very different units, and what is added."""
    generator = np.random.default_rng(seed)
    n = int(generator.integers(1, 6))
    matrix = generator.standard_normal((n, n))
    matrix *= radius / np.abs(np.linalg.eigvals(matrix)).max()
    units = 10.0 ** generator.uniform(-4, 4, n)
    half = units[:, None] * generator.standard_normal((n, n))
    return matrix * units[:, None] / units, half @ np.diag(generator.choice([-1.0, 0.0, 1.0], n)) @ half.T


@pytest.mark.parametrize("radius", [0.3, 0.99, 1 - 1e-6])
@pytest.mark.parametrize("seed", range(4))
def test_a_sum_lies_within_its_radius(seed: int, radius: float) -> None:
    matrix, driven = drawn(seed, radius)
    driven = (driven + driven.T) / 2
    found = stein(RADII.exact(matrix), RADII.exact(driven)[None], RADII)
    assert found is not None
    expected = solved(matrix, driven)
    # The expected value was itself rounded once.
    assert (np.abs(value_of(found[0]) - expected) <= radius_of(found[0]) + 1.2e-16 * np.abs(expected)).all()
    size = np.sqrt(np.outer(np.abs(np.diagonal(expected)), np.abs(np.diagonal(expected))))
    if radius < 0.999 and (np.diagonal(driven) > 0).all():
        assert (radius_of(found[0]) <= 1e-8 * size.max()).all()


@pytest.mark.parametrize("seed", range(4))
def test_a_wide_matrix_has_the_sums_of_all_within_it(seed: int) -> None:
    matrix, driven = drawn(seed, 0.7)
    driven = (driven + driven.T) / 2
    wide = 1e-3 * np.abs(matrix)
    found = stein(with_radius(matrix, wide), RADII.exact(driven)[None], RADII)
    assert found is not None
    generator = np.random.default_rng(seed)
    for _ in range(4):
        one = matrix + generator.choice([-1.0, 1.0], matrix.shape) * wide * 0.999
        expected = solved(one, driven)
        assert (np.abs(value_of(found[0]) - expected) <= radius_of(found[0])).all()


def test_where_a_matrix_may_grow_no_sum_is_proved() -> None:
    matrix = np.diag([0.999, 0.5])
    assert stein(RADII.exact(matrix), RADII.exact(np.eye(2))[None], RADII) is not None
    assert stein(with_radius(matrix, np.full((2, 2), 2e-3)), RADII.exact(np.eye(2))[None], RADII) is None
    assert stein(RADII.exact(np.diag([1.001, 0.5])), RADII.exact(np.eye(2))[None], RADII) is None
