"""Sums of second moments, X = M X Mᵀ + B, lie within their radii: against the equation solved in balls."""

from __future__ import annotations

import flint
import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as some
from numpy.typing import NDArray

from apc.eigen.balls import precision
from apc.frame.radius import RADII, radius_of, value_of, with_radius
from apc.moments.gains import stein

Floats = NDArray[np.float64]


def solved(matrix: Floats, driven: Floats) -> Floats:
    """Return X to the last digit of a float, from 200 bits."""
    n = len(matrix)
    with precision(200):
        own = flint.arb_mat(n, n, matrix.ravel().tolist())
        rows = [
            (i == k and j == m) - own[i, k] * own[j, m]
            for i in range(n)
            for j in range(n)
            for k in range(n)
            for m in range(n)
        ]
        found = flint.arb_mat(n * n, n * n, rows).solve(flint.arb_mat(n * n, 1, driven.ravel().tolist()))
        return np.array([float(one.mid()) for one in found.entries()]).reshape(n, n)


@settings(max_examples=30)
@given(
    seed=some.integers(0, 10**6),
    radius=some.sampled_from([0.3, 0.7, 0.99, 1 - 1e-6]),
    width=some.sampled_from([0.0, 1e-3]),
)
def test_a_sum_lies_within_its_radius_whatever_units_its_states_have(
    seed: int, radius: float, width: float
) -> None:
    generator = np.random.default_rng(seed)
    n = int(generator.integers(1, 6))
    matrix = generator.standard_normal((n, n))
    matrix *= radius / np.abs(np.linalg.eigvals(matrix)).max()
    units = 10.0 ** generator.uniform(-4, 4, n)
    half = units[:, None] * generator.standard_normal((n, n))
    matrix, driven = matrix * units[:, None] / units, half @ half.T
    driven = (driven + driven.T) / 2
    wide = width * np.abs(matrix)
    found = stein(with_radius(matrix, wide), RADII.exact(driven)[None], RADII)
    if found is None:  # of a matrix known so badly, some may grow
        assert width and radius > 0.6
        return
    for turn in (0.0, 0.999 * generator.choice([-1.0, 1.0], (n, n))):
        expected = solved(matrix + turn * wide, driven)
        # The expected value was itself rounded once.
        room = radius_of(found[0]) + 1.2e-16 * np.abs(expected)
        assert (np.abs(value_of(found[0]) - expected) <= room).all()
    size = np.sqrt(np.outer(np.diagonal(expected), np.diagonal(expected)))
    assert width or radius > 0.999 or (radius_of(found[0]) <= 1e-8 * size.max()).all()


def test_where_a_matrix_may_grow_no_sum_is_proved() -> None:
    unit = RADII.exact(np.eye(2))[None]
    assert stein(RADII.exact(np.diag([0.999, 0.5])), unit, RADII) is not None
    assert stein(with_radius(np.diag([0.999, 0.5]), np.full((2, 2), 2e-3)), unit, RADII) is None
    assert stein(RADII.exact(np.diag([1.001, 0.5])), unit, RADII) is None
