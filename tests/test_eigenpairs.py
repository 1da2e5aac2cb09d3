"""Claims about `apc.eigen.eigenpairs`."""

from __future__ import annotations

import numpy as np
import pytest

from apc.eigen.eigenpairs import Eigenpairs, eigenpairs, eigenvalues, left_vectors, refined

# Eigenvalues 1/2, −1/4 and 0.3 ± 0.4i with vectors that are far from orthogonal.
BASIS = np.array([[1.0, 2, 0, 1], [0, 1, 1, 0], [1, 0, 1, 3], [2, 1, 0, 1]])
FORM = np.zeros((4, 4))
FORM[0, 0], FORM[1, 1] = 0.5, -0.25
FORM[2:, 2:] = [[0.3, -0.4], [0.4, 0.3]]
MATRIX = BASIS @ FORM @ np.linalg.inv(BASIS)


def test_vectors_belong_to_their_values_of_one_matrix_and_of_many() -> None:
    for matrix in (MATRIX, np.stack([MATRIX, 2 * MATRIX.T])):
        pairs = eigenpairs(matrix)
        diagonal = pairs.values[..., None] * np.eye(4)
        np.testing.assert_allclose(matrix @ pairs.right, pairs.right @ diagonal, atol=1e-13)
        np.testing.assert_allclose(pairs.left @ matrix, diagonal @ pairs.left, atol=1e-13)
    normal = eigenpairs(np.diag([3.0, 2.0, 1.0]))
    np.testing.assert_allclose(normal.condition, 1.0, rtol=1e-14)


def test_equal_values_have_left_vectors_of_their_own() -> None:
    """W V has full rank only if no left vector stands for two."""
    matrix = np.diag([0.5, 0.5, 0.2])
    rows = left_vectors(matrix, np.array([0.5, 0.2, 0.5], dtype=complex))
    np.testing.assert_allclose(np.abs(np.linalg.det(rows)), 1.0)


def test_slopes_are_those_of_a_motion_known_in_closed_form() -> None:
    """M(x) = B diag(λ + x μ) B⁻¹ moves each eigenvalue by its μ; an error E moves it by no more than told."""
    rates = np.diag([1.0, -2.0, 0.5, 0.5])
    pairs = eigenpairs(MATRIX)
    order = [int(np.argmin(np.abs(pairs.values - value))) for value in (0.5, -0.25, 0.3 + 0.4j, 0.3 - 0.4j)]
    slopes = pairs.at(np.array(order)).slopes(BASIS @ rates @ np.linalg.inv(BASIS))
    np.testing.assert_allclose(slopes, [1.0, -2.0, 0.5, 0.5], atol=1e-12)
    error = np.abs(np.random.default_rng(0).standard_normal((4, 4)))
    moved = pairs.slopes(error * np.random.default_rng(1).choice([-1, 1], (4, 4)))
    assert (np.abs(moved) <= pairs.errors(error)).all()


def test_a_rough_guess_is_refined_to_the_nearest_value() -> None:
    start = np.ones((1, 4, 1), dtype=complex)
    guess = Eigenpairs(np.array([[0.3 + 0.39j]]), start, start.swapaxes(1, 2))
    found = refined(MATRIX[None], guess)
    assert found.values[0, 0] == pytest.approx(0.3 + 0.4j, abs=1e-5)
    assert refined(MATRIX[None], found).values[0, 0] == pytest.approx(0.3 + 0.4j, abs=1e-13)


def test_slopes_of_eigenvalues_survive_a_defective_cluster() -> None:
    matrix = np.zeros((1, 5, 5))
    matrix[0, 0, 1] = matrix[0, 1, 2] = 1.0  # a Jordan block at zero
    matrix[0, 3:, 3:] = [[0.6, -0.8], [0.8, 0.6]]
    slope = np.zeros_like(matrix)
    slope[0, 3:, 3:] = np.eye(2)
    values, rates = eigenvalues(matrix, slope)
    upper = int(np.argmax(values[0].imag))
    assert values[0, upper] == pytest.approx(0.6 + 0.8j)
    assert rates[0, upper] == pytest.approx(1.0)
    assert np.isfinite(rates).all()


def test_states_that_drive_each_other_have_eigenvalues_of_their_own() -> None:
    """Two equal parts one behind the other, a queue that runs empty, and a state alone that has no rate."""
    matrix, slope = np.zeros((2, 12, 12)), np.zeros((2, 12, 12))
    for part in (slice(0, 4), slice(4, 8)):
        matrix[:, part, part], slope[:, part, part] = (
            MATRIX,
            BASIS @ np.diag([3.0, 2, 1, 1]) @ np.linalg.inv(BASIS),
        )
    matrix[:, 4:8, :4] = 100.0  # makes one Jordan block of each pair of equal ones
    matrix[:, [8, 9, 10], [0, 8, 9]] = 1.0
    matrix[:, 11, 11], slope[:, 11, 11] = 0.9, np.nan
    values, rates = eigenvalues(matrix, slope)
    for found, own in zip(values, rates, strict=True):
        for value, rate, times in ((0.5, 3, 2), (-0.25, 2, 2), (0.3 + 0.4j, 1, 2), (0.0, 0, 3), (0.9, 0, 1)):
            near = np.abs(found - value) < 1e-12
            assert near.sum() == times
            np.testing.assert_allclose(own[near], rate, atol=1e-11)
