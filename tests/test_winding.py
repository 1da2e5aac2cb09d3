"""Claims about `apc.eigen.winding`: a count of zeros that misses none, or none at all."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pytest

from apc.eigen.winding import Ball, Bounded, wind


def _polynomial(zeros: Sequence[complex]) -> Bounded:
    """Return Π (ζ − z) with the bound Π (1 + reach/|ζ − z|) − 1."""

    def function(points: np.ndarray, reach: np.ndarray) -> Ball:
        factors = points[:, None] - np.array(zeros)
        with np.errstate(divide="ignore"):
            change = np.prod(1 + reach[:, None] / np.abs(factors), axis=1) - 1
        value = np.prod(factors, axis=1)
        return Ball(value / np.abs(value), np.where(np.isfinite(change), change, np.inf))

    return function


ZEROS = (0.5, 0.99, -0.3 + 0.2j, -0.3 - 0.2j, 1.0 + 1e-9, 2.0, 0.6 + 0.8j, 0.6 - 0.8j)


@pytest.mark.parametrize(
    ("radius", "count"),
    [(0.2, 0), (0.45, 2), (0.9, 3), (0.995, 4), (1 - 1e-7, 4), (1 + 5e-10, 6), (1 + 1e-6, 7), (3.0, 8)],
)
def test_zeros_are_counted_however_near_to_the_circle(radius: float, count: int) -> None:
    assert wind(_polynomial(ZEROS), 0.0, radius) == count
    assert wind(_polynomial(ZEROS), 0.0, radius, close=np.array(ZEROS)) == count


def test_arcs_graded_towards_a_known_zero_are_settled_at_once() -> None:
    """A zero 1e-10 within the circle: halving finds its way there in 30 rounds."""
    rounds: list[int] = []

    def counted(points: np.ndarray, reach: np.ndarray) -> Ball:
        rounds.append(len(points))
        return _polynomial((zero, zero.conjugate()))(points, reach)

    zero = 0.9 * np.exp(1j)
    assert wind(counted, 0.0, 0.9 + 1e-10) == 2
    assert len(rounds) > 25
    halved = sum(rounds)
    rounds.clear()
    assert wind(counted, 0.0, 0.9 + 1e-10, close=np.array([zero])) == 2
    assert len(rounds) == 1 and sum(rounds) < halved


def test_a_zero_on_the_circle_is_no_count() -> None:
    assert wind(_polynomial(ZEROS), 0.0, 0.5) is None


def test_a_small_circle_about_a_complex_zero_holds_it() -> None:
    assert wind(_polynomial(ZEROS), 0.6 + 0.8j, 1e-9) == 1
    assert wind(_polynomial(ZEROS), 0.6 + 0.8001j, 1e-9) == 0


def test_many_zeros_near_the_circle_are_all_counted() -> None:
    random = np.random.default_rng(0)
    upper = (1 + 1e-4 * random.standard_normal(40)) * np.exp(1j * np.pi * random.random(40))
    zeros = [*upper.tolist(), *upper.conj().tolist()]
    inside = int((np.abs(np.array(zeros)) < 1).sum())
    assert wind(_polynomial(zeros), 0.0, 1.0) == inside


def test_too_few_evaluations_are_no_count() -> None:
    assert wind(_polynomial(ZEROS), 0.0, 1 - 1e-7, most=40) is None
