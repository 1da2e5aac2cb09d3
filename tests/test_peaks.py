"""What scatters at a damper: peaks, their slopes and what they say, against a fine grid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.eigen.dissipation import least_real
from apc.regions.peaks import Peaks

Floats = NDArray[np.float64]

STATES, PORTS, DAMPING = 5, 3, 2.0


@dataclass(frozen=True)
class Maps:
    """Maps [[A, B], [C, E]] that change evenly over the square, from three random ones."""

    seed: int
    sizes: tuple[int, ...] = (STATES + PORTS,)

    def drawn(self) -> Floats:
        random = np.random.default_rng(self.seed)
        found = random.standard_normal((3, STATES + PORTS, STATES + PORTS))
        largest = np.abs(np.linalg.eigvals(found[0, :STATES, :STATES])).max()
        found[0, :STATES, :STATES] *= random.uniform(0.5, 0.999) / largest
        found[0, STATES:, STATES:] += random.uniform(0, 8) * np.eye(PORTS)
        found[1:] *= 0.01
        return found

    @property
    def errors(self) -> tuple[Floats, ...]:
        return (np.zeros((STATES + PORTS,) * 2),)

    def matrices(self, points: Floats) -> tuple[Floats, ...]:
        base, x, y = self.drawn()
        return (base + points[:, :1, None] * x + points[:, 1:, None] * y,)

    def slopes(self, system: int, points: Floats) -> tuple[Floats, Floats]:
        found = np.broadcast_to(self.drawn()[1:, None], (2, len(points), *(STATES + PORTS,) * 2))
        return self.matrices(points)[system], found.copy()


def scattering(matrix: Floats, angle: float) -> NDArray[np.complex128]:
    """Return (b − G)(b + G)⁻¹, as it is defined."""
    a, b = matrix[:STATES, :STATES], matrix[:STATES, STATES:]
    c, e = matrix[STATES:, :STATES], matrix[STATES:, STATES:]
    g = c @ np.linalg.solve(np.exp(1j * angle) * np.eye(STATES) - a, b + 0j) + e
    held = DAMPING * np.eye(PORTS)
    return np.asarray((held - g) @ np.linalg.inv(held + g))


@pytest.mark.parametrize("seed", range(20))
def test_the_highest_peak_is_that_of_a_fine_grid_and_tells_who_gives_back_what_it_got(seed: int) -> None:
    peaks, point = Peaks(Maps(seed), (PORTS,), DAMPING), np.array([[0.3, 0.6]])
    (matrix,) = peaks.family.matrices(point)[0]
    height = float(np.exp(peaks.log_magnitudes(peaks.family.matrices(point), 1)[0, 0]))
    a, b = matrix[:STATES, :STATES], matrix[:STATES, STATES:]
    c, e = matrix[STATES:, :STATES], matrix[STATES:, STATES:]
    passive = least_real(a, b, c, e, np.zeros((PORTS, PORTS)))[0] > 0
    assert passive is (height < 1)
    held = a - b @ np.linalg.inv(e + DAMPING * np.eye(PORTS)) @ c
    grid = max(np.linalg.norm(scattering(matrix, angle), 2) for angle in np.linspace(0, np.pi, 500))
    if np.abs(np.linalg.eigvals(held)).max() < 1 and height < 1.05:  # elsewhere the sign alone is meant
        assert grid <= height * (1 + 1e-12)
        assert grid == pytest.approx(height, rel=0.02)


def test_a_peak_is_seen_where_one_end_of_the_circle_is_nearly_as_high() -> None:
    """The level just above one end must not be looked for from that end."""
    seen = 0
    for seed in range(100):
        peaks, point = Peaks(Maps(seed), (PORTS,), DAMPING), np.array([[0.1, 0.2]])
        matrices = peaks.family.matrices(point)
        ends = max(np.linalg.norm(scattering(matrices[0][0], angle), 2) for angle in (0.0, np.pi))
        around = np.stack([scattering(matrices[0][0], angle) for angle in np.linspace(0, np.pi, 300)])
        grid = np.linalg.norm(around, 2, axis=(1, 2)).max()
        height = float(np.exp(peaks.log_magnitudes(matrices, 1)[0, 0]))
        seen += ends < grid < 1
        assert height >= grid * (1 - 1e-12) or height > 1
    assert seen >= 3


@pytest.mark.parametrize("seed", range(8))
def test_slopes_are_those_of_a_difference(seed: int) -> None:
    peaks, point, step = Peaks(Maps(seed), (PORTS,), DAMPING), np.array([[0.3, 0.6]]), 1e-5
    here = peaks.leading(point)
    for place in range(2):
        moved = np.zeros((1, 2))
        moved[0, place] = step
        after, before = (peaks.follow(point + sign * moved, here).value for sign in (1, -1))
        assert here.slope[:, place] == pytest.approx((after - before) / (2 * step), rel=1e-5, abs=1e-8)
