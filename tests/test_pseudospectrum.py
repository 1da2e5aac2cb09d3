"""Claims about `apc.eigen.pseudospectrum`."""

from __future__ import annotations

import numpy as np
import pytest

from apc.eigen.pseudospectrum import balance, norms, pseudospectral_radius


def _reach(matrix: np.ndarray, error: float, angles: int = 720) -> float:
    """Return the largest |z| with σ_min(z − M) ≤ error, over rays and by bisection: an independent search."""
    reach = 0.0
    for angle in np.linspace(0, 2 * np.pi, angles, endpoint=False):
        turn = np.exp(1j * angle)
        radii = np.linspace(0, np.linalg.norm(matrix, 2) + error, 200)
        stack = radii[:, None, None] * turn * np.eye(len(matrix)) - matrix
        inside = np.linalg.svd(stack, compute_uv=False)[:, -1] <= error
        reach = max(reach, float(radii[inside].max(initial=0.0)))
    return reach


def test_the_norm_is_bounded_from_above_and_exact_for_a_permutation() -> None:
    generator = np.random.default_rng(0)
    stack = generator.normal(size=(20, 5, 7)) + 1j * generator.normal(size=(20, 5, 7))
    assert np.all(norms(stack) >= np.linalg.norm(stack, 2, axis=(1, 2)))
    assert norms(np.eye(50)[::-1]) == pytest.approx(1.0, rel=1e-12)
    assert norms(np.zeros((0, 3))) == 0.0


@pytest.mark.parametrize("size", [1e-200, 1e-170, 1.0, 1e150])
def test_the_norm_of_tiny_entries_does_not_vanish(size: float) -> None:
    matrix = size * np.array([[0.6, -0.8], [0.8, 0.6]])
    assert size <= norms(matrix) <= 1.5 * size


def test_balancing_scales_by_powers_of_two_and_evens_rows_and_columns() -> None:
    grades = 2.0 ** np.array([0, 20, -30, 7])
    matrix = np.random.default_rng(1).normal(size=(4, 4)) * grades[:, None] / grades
    scale = balance(np.abs(matrix))
    assert np.array_equal(scale, 2.0 ** np.round(np.log2(scale)))
    assert np.linalg.norm(matrix / scale[:, None] * scale) < 1e-3 * np.linalg.norm(matrix)
    assert np.array_equal(balance(np.diag([1.0, 5.0])), [1.0, 1.0])


@pytest.mark.parametrize("error", [1e-12, 1e-6, 1e-2])
def test_the_radius_covers_the_pseudospectrum_found_by_search(error: float) -> None:
    generator = np.random.default_rng(2)
    for number in range(6):
        n = 2 + number
        matrix = generator.normal(size=(n, n)) / np.sqrt(n)
        if number % 2:
            matrix = matrix + 1j * generator.normal(size=(n, n)) / np.sqrt(n)
        if number % 3 == 0:
            matrix = np.triu(matrix)
        radius = pseudospectral_radius(matrix, error)
        assert radius >= np.abs(np.linalg.eigvals(matrix)).max()
        assert radius >= _reach(matrix, error, angles=90)


def test_a_jordan_block_s_radius_is_within_reach_of_its_root() -> None:
    """An entry ε in the corner moves the eigenvalues to the n-th roots of ε."""
    for n, error in ((2, 1e-12), (6, 1e-12), (60, 1e-13)):
        radius = pseudospectral_radius(np.eye(n, k=1), error)
        assert error ** (1 / n) <= radius < 3 * error ** (1 / n)


def test_a_long_queue_is_small_although_its_eigenvalues_come_out_scattered() -> None:
    """Rounding scatters the eigenvalues of the turned queue over a ring; its powers end all the same."""
    n = 12
    turn, _ = np.linalg.qr(np.random.default_rng(3).normal(size=(n, n)))
    assert pseudospectral_radius(turn @ np.eye(n, k=1) @ turn.T, 1e-14) < 0.5


def test_powers_that_leave_the_range_of_floats_prove_nothing_false() -> None:
    """Two equal symmetric blocks: ‖(z − M)⁻¹‖ = 1/(|z| − ρ), so that no R below ρ + ε will do."""
    block = np.array([[0.3, 0.55], [0.55, -0.1]])
    matrix = np.kron(np.eye(2), block)
    radius = float(np.abs(np.linalg.eigvalsh(block)).max())
    for error in (1e-12, 1e-8, 1e-4):
        assert radius + error <= pseudospectral_radius(matrix, error) < radius + 100 * error + 1e-7


def test_the_radius_is_finite_whatever_the_matrix() -> None:
    assert pseudospectral_radius(np.zeros((0, 0)), 1.0) == 0.0
    assert pseudospectral_radius(np.zeros((3, 3)), 0.0) == 0.0
    assert pseudospectral_radius(np.zeros((3, 3)), 2.0) == 2.0
    assert np.isfinite(pseudospectral_radius(1e100 * np.eye(4, k=1), 1e80))
