"""Claims about `apc.vary.plane`: all crossings of a loop with a delay of any length, against closed forms."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.eigen.bordered import Logarithm
from apc.vary.plane import MOST_OPEN, count_beyond, cross, over_all

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]


@pytest.fixture(autouse=True)
def _as_searches_do() -> Iterator[None]:
    with np.errstate(all="ignore"):
        yield


@dataclass(frozen=True)
class Pull:
    """x⁺ = pole x − p x(d frames ago): F(ζ) = ζ − pole + p ζ^(−d), `times` over."""

    delay: int
    pole: float = 1.0
    times: int = 1

    @property
    def states(self) -> int:
        """How many zeros F has, less its poles at 0."""
        return self.times

    @property
    def longest(self) -> int:
        """The delay."""
        return self.delay

    def at(self, values: Floats, rows: NDArray[np.intp], points: Complexes) -> Logarithm:
        """Return log F and its derivatives."""
        late = values[rows] * points**-self.delay
        f = points - self.pole + late
        turning = 1j * (points - self.delay * late)
        moving = points**-self.delay / f
        return Logarithm(self.times * np.log(f), self.times * turning / f, self.times * moving)

    def over(self, values: Floats, points: Complexes) -> Logarithm:
        """Return the same at all values and points."""
        return over_all(self, values, points)

    def alone(self, values: Floats) -> Complexes:
        """Return the pole."""
        return np.full((len(values), 2), self.pole, dtype=np.complex128)


@pytest.mark.parametrize("delay", [0, 1, 2, 7, 30, 100, 300, 1000])
def test_an_integrator_pulled_back_late_is_stable_up_to_its_closed_form(delay: int) -> None:
    """|p| < 2 sin(π/(2(2d + 1))): Levin and May, Theoretical Population Biology 9, 1976."""
    limit = 2 * np.sin(np.pi / (2 * (2 * delay + 1)))
    points = np.concatenate([[0.0], np.geomspace(1e-3 * limit, 1e3 * limit, 40)])
    found = cross([Pull(delay)], points, 1e-3 * limit)
    assert found.whole
    (root,) = found.roots
    assert root.value == pytest.approx(limit, rel=1e-12) and root.rising
    assert abs(np.angle(root.eigenvalue)) == pytest.approx(np.pi / (2 * delay + 1), rel=1e-10)
    assert np.array_equal(found.stable, points < limit) or found.stable[0]


@pytest.mark.parametrize("delay", [1, 8, 64])
def test_a_fast_pole_is_held_between_two_values(delay: int) -> None:
    """With a pole outside, a pull too weak or too strong leaves it unstable: at ζ = 1, and further on."""
    pole = 1 + 0.5 / (delay + 1)
    points = np.geomspace(1e-3, 10.0, 60) * (pole - 1)
    found = cross([Pull(delay, pole)], points, 1e-3)
    grid = np.geomspace(points[0], points[-1], 1000)
    brute = [float(np.abs(np.roots([1.0, -pole, *np.zeros(delay - 1), p])).max()) < 1 for p in grid]
    changes = np.flatnonzero(np.diff(brute))
    assert [one.rising for one in found.roots] == [bool(brute[place]) for place in changes]
    for root, place in zip(found.roots, changes, strict=True):
        assert grid[place] <= root.value <= grid[place + 1]
    assert found.whole
    assert found.roots[0].value == pytest.approx(pole - 1, rel=1e-9)  # at ζ = 1


def test_loops_that_cross_at_the_same_value_cross_once() -> None:
    limit = 2 * np.sin(np.pi / 82)
    points = np.linspace(limit / 3, 3 * limit, 12)
    found = cross([Pull(20), Pull(20)], points, limit)
    assert found.whole and [root.rising for root in found.roots] == [True]


def test_what_is_unstable_all_along_has_no_crossing() -> None:
    found = cross([Pull(50, pole=2.0)], np.geomspace(1e-3, 0.9, 20), 1e-3)
    assert found.whole and not found.roots and not found.stable.any()


def test_what_is_stable_all_along_has_no_crossing() -> None:
    found = cross([Pull(300, pole=0.5)], np.geomspace(1e-3, 0.49, 20), 1e-3)
    assert found.whole and not found.roots and found.stable.all()


@dataclass(frozen=True)
class Noise(Pull):
    """A loop of which rounding leaves nothing at the first value: its F there is drawn anew each time."""

    def at(self, values: Floats, rows: NDArray[np.intp], points: Complexes) -> Logarithm:
        """Return log F and its derivatives, those of the first value by chance."""
        assert len(points) <= 2 * MOST_OPEN, "arcs of noise are divided for ever"
        found = super().at(values, rows, points)
        chance = np.random.default_rng(len(points)).uniform(-3, 3, len(points)) * (1 + 1j)
        return Logarithm(np.where(rows == 0, chance, found.value), found.turning, found.moving)


def test_a_count_among_noise_is_given_up_and_others_are_not() -> None:
    found = count_beyond(Noise(3), np.array([0.1, 0.1]))
    assert np.isnan(found[0]) and found[1] == 0
