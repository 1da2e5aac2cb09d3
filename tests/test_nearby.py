"""Claims about `apc.frame.nearby`, and about the bounds that many points share."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.frame.discretize import UNIT
from apc.frame.nearby import NEARBY, alike, nearby
from apc.frame.radius import FLOATS, RADII, Arithmetic, radius_of, rounded, with_radius
from apc.vary import many
from apc.vary.many import Analyses, analyze_many
from tests.topologies import AVERAGE, compiled

STARTS = np.array([0, 5, 6])
SIZES = np.diff(STARTS, append=12)


def _chain(numbers: Arithmetic, a: np.ndarray, b: np.ndarray, once: np.ndarray) -> np.ndarray:
    """Return sums and products of many kinds of matrices, with much that cancels."""
    found = numbers.subtract(numbers.multiply(a, b), numbers.multiply(once, a))
    for _ in range(3):
        found = numbers.add(numbers.multiply(found, b), found)
    return np.asarray(numbers.subtract(found, b))


def _exactly(matrix: np.ndarray) -> np.ndarray:
    return np.array([Fraction(one) for one in matrix.ravel().tolist()], dtype=object).reshape(matrix.shape)


def test_what_floats_give_at_each_point_is_off_by_less_than_its_group_says() -> None:
    """Of numbers that are off by a rounding each, against rationals; and little more than each one's own."""
    generator = np.random.default_rng(8)
    true = Arithmetic(np.matmul, np.add, np.subtract, lambda value: value)
    for _ in range(20):
        middles = generator.normal(size=(2, len(STARTS), 4, 4)) * 10.0 ** generator.integers(-3, 3, (4, 1))
        a, b = np.repeat(middles, SIZES, axis=1) * generator.uniform(1, 1.25, (2, 12, 4, 4))
        once = generator.normal(size=(1, 4, 4))
        shared = alike(with_radius(once, np.zeros_like(once)))
        groups = [nearby(one, UNIT, STARTS) for one in (a, b)]
        bound = np.repeat(radius_of(_chain(NEARBY, *groups, shared)), SIZES, axis=0)
        moved = [
            _exactly(one) * (1 + generator.choice([-1, 1], one.shape) * Fraction(UNIT)) for one in (a, b)
        ]
        truth = _chain(true, *moved, _exactly(once))
        off = np.abs(_exactly(_chain(FLOATS, a, b, once)) - truth).astype(np.float64)
        assert (off <= bound).all()
        own = radius_of(_chain(RADII, rounded(a), rounded(b), with_radius(once, np.zeros_like(once))))
        assert (own <= bound * (1 + 1e-9)).all()
        assert np.median(bound / own) < 2


def test_groups_of_equal_points_have_the_bound_of_each() -> None:
    generator = np.random.default_rng(9)
    a, b = np.repeat(generator.normal(size=(2, 3, 5, 5)), SIZES, axis=1)
    bound = radius_of(NEARBY.multiply(nearby(a, UNIT, STARTS), nearby(b, UNIT, STARTS)))
    own = radius_of(RADII.multiply(rounded(a), rounded(b)))[STARTS]
    assert (own <= bound * (1 + 1e-9)).all()
    assert (bound <= 1.1 * own).all()


def _grid() -> Analyses:
    contact, coordination = np.meshgrid(np.linspace(10, 3000, 30), np.linspace(10, 3000, 30))
    given = {"contact.stiffness": contact, "coordination.stiffness": coordination}
    return analyze_many(compiled(AVERAGE), given)


def test_points_that_share_a_bound_say_what_each_says_and_hardly_less_sharply(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    shared = _grid()
    monkeypatch.setattr(many, "WORTH", 10**6)
    alone = _grid()
    assert (shared.verdict == alone.verdict).all()
    off = np.abs(shared.spectral_radius - alone.spectral_radius)
    assert (off <= shared.spectral_radius_error + alone.spectral_radius_error).all()
    assert (shared.spectral_radius_error <= 1.5 * alone.spectral_radius_error).all()
    assert (shared.spectral_radius_error != alone.spectral_radius_error).any()
