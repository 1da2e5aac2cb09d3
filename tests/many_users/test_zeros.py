"""Zeros of polynomials: inside the circle or not, in discs, counted without a miss."""

from __future__ import annotations

from collections.abc import Sequence

import flint
import numpy as np
import pytest

from apc.eigen.balls import precision
from apc.eigen.certify import schur_cohn
from apc.eigen.roots import approach_roots, root_discs
from apc.eigen.winding import Ball, Bounded, wind


def _polynomial(*roots: complex) -> list[flint.arb]:
    """Return the coefficients of a real polynomial by its roots, lowest first."""
    exact = flint.acb_poly.from_roots([flint.acb(root.real, root.imag) for root in map(complex, roots)])
    return [coefficient.real for coefficient in exact.coeffs()]


@pytest.mark.parametrize(
    ("roots", "inside"),
    [
        ((0.5, -0.9, 0.3 + 0.4j, 0.3 - 0.4j), True),
        ((0.5, -1.25), False),
        ((0.5 + 0.875j, 0.5 - 0.875j, 0.0, 0.0, 0.0), False),  # |z|² = 1 + 2⁻⁶
        ((2.0, 0.125), False),  # their product is small: the second step shows it
        ((1 - 2.0**-50, 1 - 2.0**-49), True),
        ((1 + 2.0**-50, 0.5), False),
        ((1.0, 0.5), None),  # on the circle: nobody can tell
        ((0.5, 0.5, 0.5), True),
        ((), True),
    ],
)
def test_schur_and_cohn_tell_where_the_roots_are(roots: tuple[complex, ...], inside: bool | None) -> None:
    with precision(256):
        assert schur_cohn(_polynomial(*roots)) is inside


def test_random_polynomials_are_decided_as_their_roots_say() -> None:
    generator = np.random.default_rng(3)
    with precision(256):
        for _ in range(300):
            sizes = generator.uniform(0.8, 1.02, 3)
            angles = generator.uniform(0, np.pi, 3)
            pairs = [complex(r * np.cos(a), r * np.sin(a)) for r, a in zip(sizes, angles, strict=True)]
            roots = [*pairs, *(root.conjugate() for root in pairs), float(generator.uniform(-1.01, 1.01))]
            assert schur_cohn(_polynomial(*roots)) is (max(abs(root) for root in roots) < 1)


def _found(roots: list[complex], guesses: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the discs made from guesses, after asserting that every root is in one."""
    with precision(bits):
        polynomial = flint.arb_poly(_polynomial(*roots))
        centres, radii = root_discs(polynomial, approach_roots(polynomial, guesses, bits), bits)
    assert all(np.min(np.abs(centres - root) - radii) <= 0 for root in roots)
    return centres, radii


@pytest.mark.parametrize("count", [2, 3, 4, 6])
def test_a_multiple_root_is_found_from_scattered_guesses(count: int) -> None:
    roots: list[complex] = [0.875] * count + [0.5, -0.25]
    scattered = np.array(roots) + 1e-4 * np.exp(1j * np.arange(len(roots)))
    centres, radii = _found(roots, scattered, 512)
    assert (np.abs(np.abs(centres[:count]) - 0.875) + radii[:count]).max() < 2.0**-40


def _bounded(zeros: Sequence[complex]) -> Bounded:
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
    assert wind(_bounded(ZEROS), 0.0, radius) == count
    assert wind(_bounded(ZEROS), 0.0, radius, close=np.array(ZEROS)) == count


def test_a_zero_on_the_circle_is_no_count() -> None:
    assert wind(_bounded(ZEROS), 0.0, 0.5) is None


def test_a_small_circle_about_a_complex_zero_holds_it() -> None:
    assert wind(_bounded(ZEROS), 0.6 + 0.8j, 1e-9) == 1
    assert wind(_bounded(ZEROS), 0.6 + 0.8001j, 1e-9) == 0


def test_too_few_evaluations_are_no_count() -> None:
    assert wind(_bounded(ZEROS), 0.0, 1 - 1e-7, most=40) is None
