"""Claims about `apc.eigen.dominant`: its bounds hold, and what it can't tell it leaves open."""

from __future__ import annotations

from typing import Any

import flint
import numpy as np
import pytest
from numpy.typing import NDArray

from apc.eigen.balls import precision
from apc.eigen.dominant import Dominant, all_within, enclosed, largest_pairs, misses_one

Floats = NDArray[np.float64]

BITS = 250
CERTAIN = 1e-40  # what the truth itself may be off by


def true_values(matrix: Floats) -> list[Any]:
    """Return the eigenvalues in 75 digits, the largest first."""
    with precision(BITS):
        rows = flint.acb_mat([[flint.acb(float(one)) for one in row] for row in matrix])
        return sorted(rows.eig(algorithm="approx"), key=lambda value: -float(abs(value).mid()))


def find(matrix: Floats, error: Floats) -> Dominant:
    return enclosed(matrix, error, *largest_pairs(matrix))


def with_spectrum(random: np.random.Generator, values: list[complex], alike: float) -> Floats:
    """Return a real matrix of such eigenvalues (conjugates are added), the more `alike` its vectors."""
    blocks: list[Floats] = []
    for value in values:
        a, b = value.real, value.imag
        blocks.append(np.array([[a, b], [-b, a]]) if b else np.array([[a]]))
    size = sum(len(block) for block in blocks)
    form, start = np.triu(random.normal(size=(size, size)), 1) * alike, 0
    for block in blocks:
        rows = slice(start, start + len(block))
        form[rows, rows] = block
        start = rows.stop
    turn = np.linalg.qr(random.normal(size=(size, size)))[0]
    return np.asarray(turn @ form @ turn.T)


SPECTRA: list[list[complex]] = [
    [0.97 + 0.1j, 0.9, 0.3 + 0.2j, 0.0, 0.0, 0.0],
    [1.02, 0.99 + 0.1j, -0.5, 0.1, 1e-3],
    [-1.3, 0.7 + 0.7j, 0.2, 0.0],
    [0.999999 + 1e-3j, 0.99, 0.98, 0.0, 0.0],
    [0.5, 0.4995, 0.3j],
    [30 + 40j, 1.0, 1e-6],
]


@pytest.mark.parametrize("values", SPECTRA, ids=range(len(SPECTRA)))
@pytest.mark.parametrize("alike", [0.0, 1.0, 30.0])
def test_the_truth_of_every_matrix_within_the_error_is_within_the_bound(
    values: list[complex], alike: float
) -> None:
    random = np.random.default_rng(int(100 * abs(values[0])) + int(alike))
    count = 12
    exact = np.stack([with_spectrum(random, values, alike) for _ in range(count)])
    size = 10.0 ** random.uniform(-15, -9, (count, 1, 1)) * np.abs(exact)
    given = exact + size * random.uniform(-1, 1, exact.shape)
    error = size + 2e-16 * np.abs(exact)
    found = find(given, error)
    told = ~np.isnan(found.error)
    assert told.any() or alike > 1 or min(abs(values[0]) - abs(value) for value in values[1:]) < 0.05
    for k in np.flatnonzero(told):
        largest, *rest = true_values(exact[k])
        if float(largest.imag.mid()) < 0:
            largest = largest.conjugate()
        off = abs(largest - flint.acb(complex(found.value[k])))
        assert float(off.mid()) <= found.error[k] + CERTAIN
        pair = 1 if abs(float(largest.imag.mid())) > CERTAIN else 0
        assert all(float(abs(one).mid()) < found.others[k] for one in rest[pair:])
        assert not found.alone[k] or all(float(abs(one).mid()) < 1 for one in rest[pair:])
    # A second one that grows is never overlooked, and where there is none it mostly shows.
    assert not found.alone.any() or sum(abs(value) >= 1 for value in values) <= 1
    assert found.alone.any() or alike > 0 or values[1] == 1.0 or not told.any()


@pytest.mark.parametrize("values", SPECTRA, ids=range(len(SPECTRA)))
def test_what_is_shown_to_be_small_or_not_to_be_one_is_so(values: list[complex]) -> None:
    random = np.random.default_rng(7)
    matrix = np.stack([with_spectrum(random, values, alike) for alike in (0.0, 0.3) for _ in range(6)])
    error = 1e-12 * np.abs(matrix)
    radius = max(abs(value) for value in values)
    for share in (0.9, 0.999, 0.9999999, 1.0):
        assert not all_within(matrix, error, np.full(len(matrix), share * radius)).any()
    assert all_within(matrix, error, np.full(len(matrix), 1.5 * radius)).all()
    away = min(abs(value - 1) for value in values)
    assert misses_one(matrix, error).all() == (away > 0)
    assert (
        not misses_one(matrix + (1 - values[0].real) * np.eye(matrix.shape[1]), error).any() or values[0].imag
    )


def test_a_matrix_as_far_from_the_rest_as_its_error_allows_is_within_the_bound() -> None:
    """The error moves the eigenvalue as far as it can: along its own vectors."""
    random = np.random.default_rng(3)
    matrix = with_spectrum(random, [0.95, 0.5 + 0.3j, 0.1], 2.0)
    values, right = np.linalg.eig(matrix)
    left = np.linalg.inv(right)
    first = int(np.argmax(np.abs(values)))
    away = np.sign(np.outer(left[first].real, right[:, first].real))
    for size in (1e-13, 1e-11, 1e-9):
        found = find(matrix[None], np.full((1, *matrix.shape), size))
        largest = true_values(matrix + size * (1 - 1e-3) * away)[0]
        off = float(abs(largest - flint.acb(complex(found.value[0]))).mid())
        assert 0.5 * found.error[0] < off <= found.error[0]


def test_many_that_are_nearly_as_large_are_told_apart() -> None:
    """What a high power of the matrix still holds several of: LAPACK gives the largest of them."""
    random = np.random.default_rng(8)
    for values in ([0.9, 0.89995 * np.exp(1j), 0.2], [0.97 + 0.1j, -0.9751, 0.975, 0.3], [1.2, -1.1999, 0.1]):
        matrix = with_spectrum(random, values, 0.1)[None]
        found = find(matrix, 1e-14 * np.abs(matrix))
        largest = true_values(matrix[0])[0]
        sign = 1 if float(largest.imag.mid()) >= 0 else -1
        value = complex(largest).conjugate() if sign < 0 else complex(largest)
        assert abs(value - found.value[0]) <= found.error[0] < 1e-11


def test_two_that_are_as_large_and_one_that_is_double_are_left_open() -> None:
    random = np.random.default_rng(5)
    for values in ([0.9, -0.9, 0.1], [0.8, 0.8, 0.3], [0.9, 0.9 * np.exp(1j), 0.2]):
        matrix = with_spectrum(random, values, 1.0)[None]
        assert np.isnan(find(matrix, 1e-13 * np.abs(matrix)).error).all()


def test_nothing_is_found_in_a_matrix_of_zeros_or_of_no_numbers() -> None:
    for entry in (0.0, np.nan, np.inf):
        matrix = np.full((2, 3, 3), entry)
        assert np.isnan(find(matrix, np.zeros((2, 3, 3))).error).all()
        assert not all_within(matrix, np.zeros((2, 3, 3)), np.ones(2)).any() or entry == 0
    assert len(find(np.zeros((0, 3, 3)), np.zeros((0, 3, 3))).error) == 0
