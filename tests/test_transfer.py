"""Claims about `transfer`: what sites answer, within its bounds."""

from __future__ import annotations

import math

import numpy as np
import pytest

from apc.frame.lift import BoundedMap, FrameMap
from apc.large.transfer import build_transfer, differentiate, respond


def _sites(seed: int, *, error: float = 0.0, chain: int = 2) -> BoundedMap:
    """Return sites with two slow pairs and a chain that runs empty, in units far apart."""
    random = np.random.default_rng(seed)
    k, n = 7, 4 + chain
    m = np.zeros((k, n, n))
    for site in m:
        for place, angle in ((0, 0.3), (2, 1.1)):
            size = 0.8 + 0.19 * random.random()
            turn = np.array([[np.cos(angle), np.sin(angle)], [-np.sin(angle), np.cos(angle)]])
            site[place : place + 2, place : place + 2] = size * turn
        site[4 + np.arange(1, chain), 4 + np.arange(chain - 1)] = 1.0
        mix = np.eye(n) + 0.2 * random.standard_normal((n, n))
        site[:] = np.linalg.inv(mix) @ site @ mix
    units = 10.0 ** random.integers(-3, 4, n)
    m = m / units[:, None] * units
    b, s = random.standard_normal((k, n, 2)) / units[:, None], random.standard_normal((k, 2, n)) * units
    d = random.standard_normal((k, 2, 2))
    maps = FrameMap(m, b, s, d)
    return BoundedMap(*maps.blocks, maps.mapped(lambda block: error * np.abs(block)))


def _answer(maps: FrameMap, counts: np.ndarray, point: complex) -> np.ndarray:
    n = maps.p.shape[-1]
    one = maps.d + maps.s @ np.linalg.solve(point * np.eye(n) - maps.p, maps.q.astype(complex))
    return np.tensordot(counts, one, 1)


POINTS = np.array([1.02, 0.9 + 0.5j, -1.1j, 3.0, 0.995 * np.exp(0.31j)])
COUNTS = np.array([1.0, 2.0, 1.0, 5.0, 1.0, 1.0, 3.0])


@pytest.mark.parametrize("seed", range(5))
@pytest.mark.parametrize("reach", [0.0, 1e-4, 1e-3])
def test_the_answer_is_within_its_bound_anywhere_in_the_disc(seed: int, reach: float) -> None:
    maps = _sites(seed)
    random = np.random.default_rng(seed)
    transfer = build_transfer(maps, COUNTS)
    found = respond([transfer], POINTS, np.full(len(POINTS), reach))
    value, doubt = found.value, found.doubt
    for point, centre, slope, bound in zip(POINTS, value, found.slope, doubt, strict=True):
        for _ in range(6):
            inside = point + reach * np.sqrt(random.random()) * np.exp(2j * np.pi * random.random())
            # The truth itself is computed in floats, far better than the bound but for reach 0.
            straight = centre + (inside - point) * slope
            assert np.all(np.abs(_answer(maps, COUNTS, inside) - straight) <= bound + 1e-12 * np.abs(centre))
    assert np.all(doubt <= 1e-7 * np.abs(value).max()) or reach


def test_the_bound_covers_what_the_matrices_may_be_off_by() -> None:
    maps = _sites(3, error=1e-9)
    random = np.random.default_rng(1)
    found = respond([build_transfer(maps, COUNTS)], POINTS, np.zeros(len(POINTS)))
    for _ in range(20):
        moved = maps.mapped(
            lambda block, error: block + random.choice([-1, 1], block.shape) * error, maps.error
        )
        for point, centre, bound in zip(POINTS, found.value, found.doubt, strict=True):
            assert np.all(np.abs(_answer(moved, COUNTS, point) - centre) <= bound)


def test_the_derivative_is_the_derivative() -> None:
    transfer = build_transfer(_sites(2), COUNTS)
    _, slope = differentiate([transfer], POINTS)
    h = 1e-6
    ahead, _ = differentiate([transfer], POINTS + h)
    behind, _ = differentiate([transfer], POINTS - h)
    np.testing.assert_allclose((ahead - behind) / (2 * h), slope, rtol=1e-5, atol=1e-5 * np.abs(slope).max())


@pytest.mark.parametrize("chain", [0, 1, 5])
def test_a_queue_of_any_length_does_not_spoil_the_bound(chain: int) -> None:
    transfer = build_transfer(_sites(4, chain=chain), COUNTS)
    found = respond([transfer], POINTS, np.zeros(len(POINTS)))
    assert np.all(found.doubt <= 1e-7 * np.abs(found.value).max())


def test_a_residue_that_should_be_nothing_does_not_spoil_the_others() -> None:
    """A mass that tells its velocity and a force of its place: nothing of the velocity has the pole 1."""
    decay, rise = math.exp(-5 * 8e-3 / 0.6), 0.6 / 5 * (1 - math.exp(-5 * 8e-3 / 0.6))
    p = np.array([[1, rise, 0, 1e-5], [0, decay, 0, 2e-3], [300, 3.9, 0, 6e-3], [0, 0, 0, 0]])
    q = np.array([[2e-5, 2e-5, 0], [8e-3, 3e-3, 0], [2e-2, 1e-2, -300], [-1, 0, 0]])
    s = np.array([[0, 0, 1, 0], [0, 1, 0, 0], [1, 0, 0, 0]])
    maps = FrameMap(*(block[None].astype(float) for block in (p, q, s, np.zeros((3, 3)))))
    bounded = BoundedMap(*maps.blocks, maps.mapped(lambda block: 1e-15 * np.abs(block)))
    found = respond([build_transfer(bounded, np.ones(1))], POINTS, np.zeros(len(POINTS)))
    for point, value, bound in zip(POINTS, found.value, found.doubt, strict=True):
        assert np.all(np.abs(_answer(maps, np.ones(1), point) - value) <= bound + 1e-12 * np.abs(value).max())
    assert np.all(found.doubt <= 1e-7 * np.abs(found.value).max())
