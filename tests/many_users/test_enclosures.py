"""Eigenvalues of matrices known up to an error lie within the bounds that every method computes."""

from __future__ import annotations

import functools
from typing import Any

import flint
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from apc.spectrum.ball_arithmetic import precision
from apc.spectrum.certification import root_discs
from apc.spectrum.enclosure import enclose_eigenvalues, enclose_stack, least_radius

Floats = NDArray[Any]

# The result of a method: the eigenvalues, a bound of each, the least and largest radius; or nothing.
Enclosure = tuple[Floats, Floats, float, float] | None


def _enclosed(matrix: Floats, error: Floats) -> Enclosure:
    pairs, found = enclose_eigenvalues(matrix, error)
    assert np.isfinite([*found.errors, found.high]).all()
    return pairs.values, found.errors, found.low, found.high


def _stacked(matrix: Floats, error: Floats) -> Enclosure:
    n = len(matrix)
    alongside = np.stack([matrix, np.diag(np.arange(n, dtype=np.float64))])
    pairs, found = enclose_stack(alongside, np.stack([error, np.zeros((n, n))]))
    return pairs.values[0], found.errors[0], float(found.low[0]), float(found.high[0])


METHODS = {"by parts": _enclosed, "stacked": _stacked}


def _drawn(generator: np.random.Generator) -> dict[str, Floats]:
    """Return random, graded, repeated, triangular and defective matrices, queues and unlike units."""
    n = int(generator.integers(2, 10))
    plain = generator.normal(size=(n, n)) / np.sqrt(n)
    grades = 10.0 ** generator.integers(-5, 6, size=n)
    queue = np.eye(n, k=-1)
    queue[0] = generator.normal(size=n) * 10.0 ** generator.integers(-6, 1, size=n)
    units = 2.0 ** generator.integers(-12, 12, n + 2)
    nearly_empty = np.zeros((n + 2, n + 2))
    nearly_empty[:n, :n], nearly_empty[n:, n:] = plain, 1e-3 * np.eye(2, k=-1)
    near = np.zeros((n + 1, n + 1))
    near[1:, 1:], near[0, 0] = plain, np.abs(np.linalg.eigvals(plain)).max() * (1 + 1e-7)
    return {
        "plain": plain,
        "graded": plain * grades[:, None] / grades,
        "queue": queue,
        "twin": np.kron(np.eye(2), generator.normal(size=(2, 2))),
        "triangular": np.triu(plain),
        "defective": plain @ (0.9 * np.eye(n) + np.eye(n, k=1)) @ np.linalg.inv(plain),
        "nearly empty": nearly_empty * units[:, None] / units,
        "nearly double": near,
        "chain of masses": _chain(4, 3),
        "block": np.eye(n, k=1),
    }


def _chain(n: int, count: int) -> Floats:
    """Return the frame of so many masses in a row, and a ring of queues that nearly stand still."""
    spring = 2 * np.eye(n) - np.eye(n, k=1) - np.eye(n, k=-1)
    still = np.zeros((n, n))
    whole = np.zeros((2 * n + count, 2 * n + count))
    whole[: 2 * n, : 2 * n] = np.eye(2 * n) + 0.05 * np.block(
        [[still, np.eye(n)], [-spring, -0.3 * np.eye(n) - 0.5 * spring]]
    )
    whole[2 * n :, 2 * n :] = 1e-3 * np.eye(count, k=-1)
    whole[2 * n :, 0] = whole[1, 2 * n :] = 1e-6
    return whole


def _true(matrix: Floats) -> Floats:
    """Return the eigenvalues, of which 120 digits leave those of a block of ten a dozen."""
    with precision(400):
        rows = [[flint.acb(float(one)) for one in row] for row in matrix]
        return np.array([complex(one) for one in flint.acb_mat(rows).eig(algorithm="approx")])


@functools.cache
def _matrices(seed: int) -> list[tuple[str, Floats, Floats, list[Floats]]]:
    """Return matrices with errors, and the true eigenvalues of some that lie within these."""
    generator = np.random.default_rng(seed)
    found = []
    for name, matrix in _drawn(generator).items():
        error = np.abs(matrix) * 10.0 ** generator.integers(-16, -7)
        if name == "block":
            error[-1, 0] = 1e-12  # moves its eigenvalues to the n-th roots of that
        signs = generator.choice([-1, 1], size=matrix.shape)
        along = np.ones(matrix.shape)
        values, right = np.linalg.eig(matrix)
        if np.linalg.cond(right) < 1e12:
            # Along its own vectors an error moves an eigenvalue as far as it can.
            first = int(np.argmax(np.abs(values)))
            along = np.sign(np.outer(np.linalg.inv(right)[first].real, right[:, first].real))
        moved = [matrix + share * one * error for share, one in ((0, signs), (0.999, signs), (0.999, along))]
        found.append((name, matrix, error, [_true(one) for one in moved]))
    return found


@pytest.mark.parametrize(
    "seed", [*range(3), *(pytest.param(k, marks=pytest.mark.whole) for k in range(3, 15))]
)
@pytest.mark.parametrize("method", METHODS)
def test_every_matrix_within_the_error_has_its_eigenvalues_within_the_bounds(method: str, seed: int) -> None:
    reported = 0
    for name, matrix, error, truths in _matrices(seed):
        printed = METHODS[method](matrix, error)
        if printed is None:
            continue
        reported += 1
        values, errors, low, high = printed
        for true in truths:
            size = np.abs(true).max()
            assert low * (1 - 1e-15) <= size + 1e-11 * (name == "block"), name
            assert size <= high * (1 + 1e-15), name
            for value, bound in zip(values, errors, strict=True):
                assert np.abs(true - value).min() <= bound + 1e-15 * abs(value) + 1e-25, name
    assert reported >= 3


@pytest.mark.parametrize("seed", range(4))
def test_wherever_slopes_lead_the_radius_is_above_the_bound(seed: int) -> None:
    generator, near = np.random.default_rng(seed), 0
    for name, matrix in _drawn(generator).items():
        slopes = (
            10.0 ** generator.integers(-6, -1) * np.abs(matrix) * generator.normal(size=(2, *matrix.shape))
        )
        low = least_radius(matrix, slopes, 1e-9 * np.abs(matrix))
        sizes = [np.abs(np.linalg.eigvals(matrix)).max()]
        for share in [[1, 1], [-1, -1], [1, -1], [-1, 1], *generator.uniform(-1, 1, (4, 2))]:
            sizes.append(np.abs(_true(matrix + np.tensordot(share, slopes, 1))).max())
            assert low <= sizes[-1], name
        near += min(sizes) - low < 3 * np.ptp(sizes)
    assert near >= 3


def _rational(n: int) -> st.SearchStrategy[list[list[int]]]:
    row = st.lists(st.integers(-64, 64), min_size=n, max_size=n)
    return st.lists(row, min_size=n, max_size=n)


@settings(max_examples=40, derandomize=True)
@given(st.integers(1, 4).flatmap(_rational))
def test_the_exact_eigenvalues_of_small_rational_matrices_are_within_every_bound(
    rows: list[list[int]],
) -> None:
    """Entries are 64ths, exact in floats; the truth are the roots of the exact characteristic polynomial."""
    polynomial = flint.fmpz_mat(rows).charpoly()
    roots = np.array([complex(root) / 64 for root, times in polynomial.complex_roots() for _ in range(times)])
    matrix = np.array(rows) / 64
    radius = np.abs(roots).max()
    for name, method in METHODS.items():
        printed = method(matrix, np.zeros_like(matrix))
        if printed is None:
            continue
        values, errors, low, high = printed
        assert low * (1 - 1e-14) - 1e-20 <= radius <= high * (1 + 1e-14) + 1e-20, name
        for value, bound in zip(values, errors, strict=True):
            assert np.abs(roots - value).min() <= bound + 1e-14 * abs(value) + 1e-20, name
    with precision(256):
        scaled = flint.fmpq_poly(polynomial)(flint.fmpq_poly([0, 64]))
        inside = root_discs(flint.arb_poly(scaled / scaled.leading_coefficient())).inside
        assert inside is None or inside is bool(radius < 1)
        assert inside is not None or np.abs(np.abs(roots) - 1).min() < 1e-12


@pytest.mark.parametrize(("n", "error"), [(2, 1e-12), (6, 1e-12), (60, 1e-13)])
def test_a_jordan_block_s_bound_is_within_reach_of_its_root(n: int, error: float) -> None:
    """An entry ε in the corner moves the eigenvalues to the n-th roots of ε."""
    _, found = enclose_eigenvalues(np.eye(n, k=1), np.full((n, n), error))
    assert error ** (1 / n) <= found.high < 3 * error ** (1 / n)


@pytest.mark.parametrize(("masses", "count"), [(20, 6), (60, 3)])
def test_what_stands_alone_is_as_sure_as_first_order_has_it(masses: int, count: int) -> None:
    """An eigenvalue far from others is off by little more than its own vectors say, however many states."""
    matrix = _chain(masses, count)
    error = 1e-9 * np.abs(matrix)
    pairs, found = enclose_eigenvalues(matrix, error)
    assert found.high - found.low < 4 * pairs.errors(error)[0] + 1e-12
    generator = np.random.default_rng(5)
    moved = np.linalg.eigvals(matrix + error * generator.choice([-1.0, 1.0], size=matrix.shape))
    assert found.low <= np.abs(moved).max() <= found.high


def test_two_that_hardly_differ_keep_their_common_disc() -> None:
    """Nothing tells a pair apart that the error mixes: each may be anywhere the pair may."""
    pair, mixed = np.diag([0.9, 0.9 + 1e-9, 0.5]), np.full((3, 3), 1e-9)
    printed = _enclosed(pair, mixed)
    assert printed is not None and printed[1][:2].min() >= 1e-9


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
def test_discs_tell_where_the_roots_are(roots: tuple[complex, ...], inside: bool | None) -> None:
    with precision(256):
        exact = flint.acb_poly.from_roots([flint.acb(root.real, root.imag) for root in map(complex, roots)])
        assert (
            root_discs(flint.arb_poly([coefficient.real for coefficient in exact.coeffs()])).inside is inside
        )
