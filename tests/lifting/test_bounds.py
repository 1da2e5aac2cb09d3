"""What a frame rounds is within its bounds: against rationals, and the frame stepped in balls."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.lifting.interval_arithmetic import FLOATS, MIDPOINT_RADIUS, error_radius, value_of, with_error_radius
from apc.spectrum.eigenpairs import largest_magnitudes


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
    return bool((off <= _fractions(error_radius(found))).all())


OPERATIONS: dict[str, Callable[[Any], tuple[Any, Any]]] = {
    "product": lambda numbers: (numbers.multiply, (4, 6, 5)),
    "sum": lambda numbers: (numbers.add, (4, 6, 0)),
    "difference": lambda numbers: (numbers.subtract, (4, 6, 0)),
}


@pytest.mark.parametrize("name", OPERATIONS)
@pytest.mark.parametrize("seed", range(8))
def test_the_true_one_of_all_that_lie_within_the_radii_lies_within(name: str, seed: int) -> None:
    random = np.random.default_rng(seed)
    computed, (n, m, k) = OPERATIONS[name](MIDPOINT_RADIUS)
    exactly = np.dot if name == "product" else OPERATIONS[name](FLOATS)[0]
    a, b = _wild(random, n, m), _wild(random, m, k) if k else _wild(random, n, m)
    error_bound_a, error_bound_b = (np.abs(one) * random.choice([0.0, 1e-15, 1e-3]) for one in (a, b))
    found = computed(with_error_radius(a, error_bound_a), with_error_radius(b, error_bound_b))
    for corner in ((0, 0), (1, 1), (-1, 1), (1, -1)):
        moved = [
            _fractions(one) + sign * _fractions(off)
            for one, off, sign in zip((a, b), (error_bound_a, error_bound_b), corner, strict=True)
        ]
        assert _within(found, exactly(*moved))


def test_the_largest_magnitude_is_that_of_the_chosen_roots() -> None:
    # Companion matrices of chosen roots: 3 and −4; 0.3 ± 0.4i; a nilpotent one.
    polynomials = np.array([np.poly([3.0, -4.0]), np.poly([0.3 + 0.4j, 0.3 - 0.4j]).real, [1.0, 0.0, 0.0]])
    matrices = np.array([[[-b, -c], [1.0, 0.0]] for _, b, c in polynomials])
    assert largest_magnitudes(matrices) == pytest.approx([4.0, 0.5, 0.0], abs=1e-14)
    assert largest_magnitudes(matrices[0]) == pytest.approx(4.0, abs=1e-14)
    assert largest_magnitudes(np.zeros((2, 0, 0))).tolist() == [0.0, 0.0]
