"""Claims about `apc.frame.radius`: what is computed lies within its radius of what is true."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.frame.radius import FLOATS, RADII, radius_of, rounded, solve, value_of, with_radius


def _fractions(matrix: Any) -> Any:
    exact = np.empty(matrix.size, dtype=object)
    exact[:] = [Fraction(float(entry)) for entry in matrix.ravel()]
    return exact.reshape(matrix.shape)


def _wild(random: np.random.Generator, *shape: int) -> Any:
    """Numbers of all sizes, that cancel, some of them 0."""
    return (
        random.standard_normal(shape) * 10.0 ** random.integers(-9, 9, shape) * (random.random(shape) < 0.7)
    )


def _within(found: Any, true: Any) -> bool:
    off = np.abs(_fractions(value_of(found)) - true)
    return bool((off <= _fractions(radius_of(found))).all())


OPERATIONS: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "product": lambda numbers: (numbers.multiply, (4, 6, 5)),
    "sum": lambda numbers: (numbers.add, (4, 6, 0)),
    "difference": lambda numbers: (numbers.subtract, (4, 6, 0)),
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize("seed", range(20))
def test_the_true_one_of_all_that_lie_within_the_radii_lies_within(name: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    computed, (n, m, k) = OPERATIONS[name](RADII)
    exactly = np.dot if name == "product" else OPERATIONS[name](FLOATS)[0]
    a, b = _wild(random, n, m), _wild(random, m, k) if k else _wild(random, n, m)
    off_a, off_b = (np.abs(one) * random.choice([0.0, 1e-15, 1e-3]) for one in (a, b))
    found = computed(with_radius(a, off_a), with_radius(b, off_b))
    for corner in ((0, 0), (1, 1), (-1, 1), (1, -1)):
        moved = [
            _fractions(one) + sign * _fractions(off)
            for one, off, sign in zip((a, b), (off_a, off_b), corner, strict=True)
        ]
        assert _within(found, exactly(*moved))


def test_a_radius_is_of_the_size_of_what_is_rounded() -> None:
    random = np.random.default_rng(3)
    a, b = random.standard_normal((2, 30, 30))
    found = RADII.multiply(RADII.exact(a), RADII.exact(b))
    assert (radius_of(found) <= 40 * 2.0**-53 * (np.abs(a) @ np.abs(b))).all()
    assert (
        radius_of(RADII.multiply(RADII.exact(np.eye(30)), RADII.exact(b))) <= 4 * 2.0**-53 * np.abs(b)
    ).all()
    assert not radius_of(RADII.multiply(RADII.exact(0 * a), RADII.exact(b))).any()


def test_many_at_once_are_what_each_is_alone() -> None:
    random = np.random.default_rng(5)
    left, right = (rounded(random.standard_normal((3, 4, 4))) for _ in range(2))
    for calculate in (RADII.multiply, RADII.add, RADII.subtract):
        many = calculate(left, right)
        for one in range(3):
            alone = calculate(left[one], right[one])
            np.testing.assert_allclose(many[one], alone, rtol=1e-14)
    one = RADII.exact(np.array(1.0))
    assert one.tolist() == [1.0, 0.0]


def test_a_system_whose_states_are_of_unlike_units_is_solved_for_all_within_wide_radii() -> None:
    """[1 ±50; ±0.001 1] x = 1: every determinant is within 0.05 of 1, though no row is small."""
    wide = np.array([[0.0, 50.0], [1e-3, 0.0]])
    found = solve(with_radius(np.eye(2), wide), RADII.exact(np.ones((2, 1))))
    assert found is not None
    for a, b in itertools.product((Fraction(-50), Fraction(0), Fraction(50)), (-1e-3, 0.0, 1e-3)):
        c = Fraction(b)
        true = np.array([[(1 - a) / (1 - a * c)], [(1 - c) / (1 - a * c)]], dtype=object)
        assert _within(found, true)
    # What there is at least: (1 − |F|)⁻¹ |F| 1, here (50.05, 0.051)/0.95.
    np.testing.assert_allclose(radius_of(found)[:, 0], [50.05 / 0.95, 0.051 / 0.95], rtol=5e-3)
    assert solve(with_radius(np.eye(2), 50 * wide), RADII.exact(np.ones((2, 1)))) is None
