"""Claims about `apc.eigen.roots`."""

from __future__ import annotations

import flint
import numpy as np
import pytest

from apc.eigen.balls import precision
from apc.eigen.roots import approach_roots, root_discs


def _polynomial(roots: list[complex]) -> flint.arb_poly:
    exact = flint.acb_poly.from_roots([flint.acb(root.real, root.imag) for root in map(complex, roots)])
    return flint.arb_poly([coefficient.real for coefficient in exact.coeffs()])


def _found(roots: list[complex], guesses: np.ndarray, bits: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the discs made from guesses, after asserting that every root is in one."""
    with precision(bits):
        polynomial = _polynomial(roots)
        centres, radii = root_discs(polynomial, approach_roots(polynomial, guesses, bits), bits)
    assert all(np.min(np.abs(centres - root) - radii) <= 0 for root in roots)
    return centres, radii


def test_simple_roots_come_out_from_rough_guesses() -> None:
    """Up to 64 dyadic roots, each exact, from guesses wrong by a tenth."""
    generator = np.random.default_rng(5)
    for pairs in (1, 4, 16, 32):
        upper = generator.integers(-250, 250, pairs) / 256 + 1j * generator.integers(1, 250, pairs) / 256
        upper = np.unique(upper)
        roots = [*upper.tolist(), *upper.conj().tolist()]
        rough = np.array(roots) * (1 + 0.1 * generator.normal(size=len(roots)))
        _, radii = _found(roots, rough, 512)
        assert radii.max() < 1e-14


@pytest.mark.parametrize("guess", [0.0, np.nan, np.inf, 1.0])
def test_guesses_that_know_nothing_only_cost_rounds(guess: float) -> None:
    _, radii = _found([0.5, -0.75, 0.25 + 0.5j, 0.25 - 0.5j], np.full(4, guess, dtype=complex), 256)
    assert radii.max() < 1e-15


def test_roots_of_all_sizes_are_found() -> None:
    """From 2⁻⁹⁹ to 2¹⁰⁰, which floats cannot hold in one matrix."""
    roots: list[complex] = [2.0**power for power in (-99, -60, -20, -1, 3, 40, 100)]
    centres, radii = _found(roots, np.full(7, 2.0**100, dtype=complex), 512)
    assert np.sort(centres.real) == pytest.approx(roots, rel=1e-14)
    assert (radii <= 1e-14 * np.abs(centres)).all()


@pytest.mark.parametrize("count", [2, 3, 4, 6])
def test_a_multiple_root_is_found_from_scattered_guesses(count: int) -> None:
    roots: list[complex] = [0.875] * count + [0.5, -0.25]
    scattered = np.array(roots) + 1e-4 * np.exp(1j * np.arange(len(roots)))
    centres, radii = _found(roots, scattered, 512)
    assert (np.abs(np.abs(centres[:count]) - 0.875) + radii[:count]).max() < 2.0**-40


def test_coefficients_that_may_be_zero_are_roots_about_zero() -> None:
    """z⁶ (z − 3/4), each lower coefficient known to 2⁻²⁰⁰ only: roots up to the sixth root of that."""
    with precision(256):
        low = flint.arb(0, 2.0**-200)
        polynomial = flint.arb_poly([low] * 6 + [flint.arb(-0.75), flint.arb(1)])
        centres, radii = root_discs(
            polynomial, approach_roots(polynomial, np.zeros(7, dtype=complex), 256), 256
        )
    small = np.abs(centres) < 0.1
    assert small.sum() == 6
    reach = (np.abs(centres[small]) + radii[small]).max()
    assert 2.0 ** (-200 / 6) <= reach < 100 * 2.0 ** (-200 / 6)
    assert radii[~small][0] < 1e-15


def test_discs_hold_multiple_and_nearly_equal_roots() -> None:
    """Triple 0.5, double 0.5 + 2⁻³⁰, and 0.25 once; what is found of them is off by 1e-40 and more."""
    roots = [0.5, 0.5, 0.5, 0.5 + 2.0**-30, 0.5 + 2.0**-30, 0.25]
    with precision(512):
        polynomial = _polynomial([*roots])
        found = [flint.acb(root) + flint.acb(0, 1e-40 * place) for place, root in enumerate(roots)]
        centres, radii = root_discs(polynomial, found, 512)
    assert all(np.min(np.abs(centres - root) - radii) <= 0 for root in roots)
    assert radii.max() < 1e-15


def test_discs_keep_a_root_that_vanishes_many_times() -> None:
    with precision(256):
        polynomial = _polynomial([*[0.0] * 9, 0.75])
        centres, radii = root_discs(polynomial, [flint.acb(0)] * 9 + [flint.acb(0.75)], 256)
    zeros = np.abs(centres) < 0.1
    assert zeros.sum() == 9
    assert (np.abs(centres[zeros]) + radii[zeros]).max() < 1e-3
    assert abs(centres[~zeros][0] - 0.75) <= radii[~zeros][0] < 1e-15
