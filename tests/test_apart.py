"""Claims about `apc.eigen.apart`."""

from __future__ import annotations

import flint
import numpy as np
import pytest

from apc.eigen.apart import SMALL, Apart, padded, pairs_apart, pairs_by_discs
from apc.eigen.eigenpairs import Eigenpairs


def _drawn(seed: int, n: int, queue: int) -> tuple[np.ndarray, np.ndarray]:
    """Return matrices of states in units far apart, in whose middle a queue runs nearly empty."""
    random = np.random.default_rng(seed)
    matrix = random.normal(size=(6, n, n)) / np.sqrt(n)
    matrix[:, n - queue :, : n - queue] *= 1e-3
    matrix[:, n - queue :, n - queue :] = 1e-3 * np.eye(queue, k=-1)
    units = 2.0 ** random.integers(-12, 12, n)
    matrix *= units[:, None] / units
    return matrix, 1e-10 * np.abs(matrix)


def _fifty_digits(matrix: np.ndarray) -> np.ndarray:
    before, flint.ctx.prec = flint.ctx.prec, 400
    try:
        found = flint.acb_mat([[flint.acb(float(one)) for one in row] for row in matrix]).eig(multiple=True)
        return np.array([complex(float(one.real.mid()), float(one.imag.mid())) for one in found])
    finally:
        flint.ctx.prec = before


@pytest.mark.parametrize(("n", "queue"), [(3, 0), (6, 1), (8, 2), (12, 4), (20, 3)])
def test_every_matrix_within_the_error_has_its_eigenvalues_within_the_bounds(n: int, queue: int) -> None:
    """Of the middle and of others at the edge of what is known, at 50 digits."""
    random = np.random.default_rng(n)
    told = 0
    for seed in range(4):
        matrix, error = _drawn(100 * n + seed, n, queue)
        pairs, bounds = pairs_apart(matrix, error)
        for row, one in enumerate(bounds):
            if one is None:
                continue
            told += 1
            values, close = pairs.values[row], one.sharpened()
            assert (np.diff(np.abs(values)) <= 1e-12).all()
            assert (close <= one.near).all()
            for sign in (0.0, random.choice([-1.0, 1.0], size=(n, n))):
                true = _fifty_digits(matrix[row] + sign * error[row])
                assert one.low <= np.abs(true).max() <= one.high
                large = np.abs(values) >= SMALL
                assert (np.abs(true) >= SMALL / 2).sum() >= large.sum()
                away = np.abs(values[:, None] - true)
                for bound in (one.near, close):
                    assert ((away <= bound[:, None]).sum(axis=1)[large] == 1).all()
                    assert (away.min(axis=1) <= bound).all()
    assert told >= 12


def test_vectors_are_those_of_the_matrix_in_its_own_units() -> None:
    matrix, error = _drawn(1, 7, 2)
    pairs, _ = pairs_apart(matrix, error)
    for row in range(len(matrix)):
        large = np.abs(pairs.values[row]) >= SMALL
        right, left, values = pairs.right[row][:, large], pairs.left[row][large], pairs.values[row][large]
        scale = np.abs(matrix[row]) @ np.abs(right) + np.abs(right)
        assert (np.abs(matrix[row] @ right - right * values) <= 1e-12 * scale).all()
        scale = np.abs(left) @ np.abs(matrix[row]) + np.abs(left)
        assert (np.abs(left @ matrix[row] - values[:, None] * left) <= 1e-12 * scale).all()


def test_nothing_is_said_of_two_that_the_error_mixes_or_of_queues_alone() -> None:
    pair = np.diag([0.9, 0.9 + 1e-9, 0.5])
    error = np.full((3, 3), 1e-9)
    queue = 1e-4 * np.eye(3, k=1) + 1e-5
    _, bounds = pairs_apart(np.stack([pair, queue]), np.stack([error, error]))
    assert bounds == [None, None]


def test_one_of_many_is_told_as_it_is_alone() -> None:
    """Whatever stands beside it, even where nothing can be said of that."""
    matrix, error = _drawn(3, 6, 1)
    matrix[2] = np.eye(6)
    pairs, bounds = pairs_apart(matrix, error)
    for row in range(len(matrix)):
        own, (bound,) = pairs_apart(matrix[row : row + 1], error[row : row + 1])
        assert own.values[0] == pytest.approx(pairs.values[row], rel=1e-12, abs=1e-12)
        other = bounds[row]
        assert (bound is None) == (other is None)
        if bound is not None and other is not None:
            assert bound.high - bound.low == pytest.approx(other.high - other.low, rel=1e-3)
    assert bounds[2] is None
    assert sum(one is not None for one in bounds) >= 4


def _by_discs(matrix: np.ndarray, error: np.ndarray) -> list[tuple[Eigenpairs, Apart | None]]:
    return pairs_by_discs(list(zip(matrix, error, strict=True)))


@pytest.mark.parametrize(("n", "queue"), [(3, 0), (6, 1), (7, 2), (12, 1)])
def test_discs_of_one_solve_hold_what_is_true_at_50_digits(n: int, queue: int) -> None:
    """Of the middle and of matrices at the edge of what is known; near eigenvalues are among those drawn."""
    random = np.random.default_rng(n)
    told = 0
    for seed, tiny in enumerate((1e-10, 1e-13, 0.0, 0.0)):
        matrix, error = _drawn(100 * n + seed, n, queue)
        matrix[0, 0, 1:] = matrix[0, 1:, 0] = 0.0
        matrix[0, 0, 0] = np.abs(np.linalg.eigvals(matrix[0, 1:, 1:])).max() * (1 + 1e-7)
        error *= tiny * 1e10
        for row, (pairs, one) in enumerate(_by_discs(matrix, error)):
            if one is None:
                continue
            told += 1
            for sign in (0.0, random.choice([-1.0, 1.0], size=(n, n))):
                true = _fifty_digits(matrix[row] + sign * error[row])
                assert one.low <= np.abs(true).max() <= one.high
                away = np.abs(pairs.values[:, None] - true)
                assert (away.min(axis=1) <= one.near + 1e-25).all()  # of equal ones 50 digits leave half
    assert told >= 8


def test_an_eigenvalue_at_zero_by_structure_has_a_disc_of_its_own() -> None:
    """A column that is a multiple of another."""
    random = np.random.default_rng(2)
    matrix = random.normal(size=(7, 7)) / 4
    matrix[:, 6] = matrix[:, 1] / 4
    error = 1e-15 * np.abs(matrix)
    ((pairs, bound),) = pairs_by_discs([(matrix, error)])
    assert bound is not None
    small = np.abs(pairs.values) < 1e-12
    assert small.sum() == 1
    assert bound.near[small].max() < 1e-13
    _, (other,) = pairs_apart(matrix[None], error[None])
    assert other is None or bound.near[~small].max() <= 2 * other.near[~small].max()


def test_discs_say_nothing_of_vectors_that_are_too_alike() -> None:
    chain = np.eye(4, k=1) + np.diag([0.9, 0.5, 0.0, 0.0])
    pair = np.diag([0.9, 0.9 + 1e-9, 0.5, 0.1]) + 0.1 * np.eye(4, k=1)
    found = _by_discs(np.stack([chain, pair]), np.full((2, 4, 4), 1e-9))
    assert [bound for _, bound in found] == [None, None]


def test_discs_of_a_matrix_hang_on_nothing_beside_it() -> None:
    """Bit for bit, of other sizes too."""
    matrix, error = _drawn(5, 7, 0)
    smaller = [(matrix[row, :5, :5], error[row, :5, :5]) for row in range(3)]
    together = pairs_by_discs([*smaller, *zip(matrix, error, strict=True)])
    assert padded(5) == padded(7)
    for (pairs, bound), block in zip(together, [*smaller, *zip(matrix, error, strict=True)], strict=True):
        ((own, alone),) = pairs_by_discs([block])
        assert (own.values == pairs.values).all()
        assert (own.right == pairs.right).all()
        assert (alone is None) == (bound is None)
        if alone is not None and bound is not None:
            assert (alone.low, alone.high) == (bound.low, bound.high)
            assert (alone.near == bound.near).all()
