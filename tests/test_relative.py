"""Claims about `apc.eigen.relative`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from apc.eigen.relative import Relative, relative, relative_bounded, relative_coordinates


def test_relative_coordinates_are_bounded_against_exact_rationals() -> None:
    """V = [1 0; 1 1; 1/3 2; 0 1/7]: W = V_r V_p⁻¹ by hand in fractions."""
    exact = [[Fraction(1), Fraction(0)], [Fraction(1), Fraction(1)], [Fraction(1, 3), Fraction(2)]]
    exact.append([Fraction(0), Fraction(1, 7)])
    basis = np.array([[float(entry) for entry in row] for row in exact])
    at = relative_coordinates(basis)
    weights, error = at.weights, at.doubt
    (a, b), (c, d) = (exact[place] for place in at.held)
    for line, place in enumerate(at.rest):
        x, y = exact[place]
        true = ((x * d - y * c) / (a * d - b * c), (y * a - x * b) / (a * d - b * c))
        for column in range(2):
            off = abs(Fraction(float(weights[line, column])) - true[column])
            assert off <= Fraction(float(error[line, column]))
    assert np.abs(weights).max() <= 2
    assert error.max() < 1e-13


def test_what_is_left_has_all_other_eigenvalues_of_one_matrix_of_many_and_of_fractions() -> None:
    """M V = V C with V = (1, 1, 2) and C = 1: M = V uᵀ + N with uᵀV = 1 and N V = 0."""
    v, u = np.array([1, 1, 2]), np.array([1, -2, 1])
    n = np.array([[1, 1, -1], [2, 0, -1], [0, 2, -1]])
    matrix = (4 * np.outer(v, u) + n).astype(float) / 4
    at = relative_coordinates(v[:, None].astype(float))
    left = relative(matrix, at)
    others = np.sort_complex(np.linalg.eigvals(matrix))[:-1]
    np.testing.assert_allclose(np.sort_complex(np.linalg.eigvals(left)), others, atol=1e-14)
    many = relative(np.stack([matrix, matrix * 1j]), at)
    np.testing.assert_array_equal(many, np.stack([left, left * 1j]))
    fractions = np.array([[Fraction(x) for x in row] for row in matrix.tolist()], dtype=object)
    weights = np.array([[Fraction(x) for x in row] for row in at.weights.tolist()], dtype=object)
    exact = relative(fractions, Relative(at.held, at.rest, weights, at.doubt))
    np.testing.assert_allclose(exact.astype(float), left, rtol=1e-15)
    _, error = relative_bounded(matrix, np.zeros((3, 3)), at)
    assert (np.abs(exact.astype(float) - left) <= error).all() and error.max() < 1e-13


def test_without_states_there_is_nothing_to_take_out() -> None:
    at = relative_coordinates(np.zeros((0, 0)))
    assert not len(at.held) and not len(at.rest)
