"""What a loop gives back: proved up to its closed form, or the largest of a dense grid, and no further."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.eigen.dissipation import is_positive, least_real, proves_positive
from apc.frame.radius import RADII, with_radius

Floats = NDArray[np.float64]


def loop(generator: np.random.Generator, n: int, m: int) -> tuple[Floats, Floats, Floats, Floats]:
    """Return a random stable loop, some of its eigenvalues near the circle."""
    a = generator.standard_normal((n, n))
    a *= generator.uniform(0.3, 0.999) / np.abs(np.linalg.eigvals(a)).max()
    return (
        *(a, generator.standard_normal((n, m)), generator.standard_normal((m, n))),
        generator.standard_normal((m, m)),
    )


def symmetric(generator: np.random.Generator, m: int) -> Floats:
    half = generator.standard_normal((m, m))
    return half + half.T


def real_part(system: tuple[Floats, Floats, Floats, Floats], weight: Floats, angle: float) -> float:
    a, b, c, d = system
    found = c @ np.linalg.solve(np.exp(1j * angle) * np.eye(len(a)) - a, b) + d
    return float(np.linalg.eigvalsh((found + found.conj().T) / 2 + weight)[0])


def is_proved(system: tuple[Floats, Floats, Floats, Floats], weight: Floats) -> bool:
    a, b, c, d, w = (RADII.exact(one) for one in (*system, weight))
    return proves_positive(a, b, c, d, w)


@pytest.mark.parametrize("pole", [0.9, 0.2, 0.0, -0.5, -0.99])
def test_a_loop_of_one_state_has_its_least_real_part_where_its_closed_form_says(pole: float) -> None:
    # Re 1/(e^{jθ} − a) = (cos θ − a)/(1 − 2a cos θ + a²) is least at θ = π: −1/(1 + a).
    system = (np.array([[pole]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.25]]))
    least, angle = least_real(*system, np.array([[0.5]]))
    assert least == pytest.approx(0.75 - 1 / (1 + pole), rel=1e-12, abs=1e-12)
    assert angle == pytest.approx(math.pi)
    near = 1e-9 / (1 - abs(pole)) ** 2
    assert is_proved(system, np.array([[0.5 - least + near]]))
    assert not is_proved(system, np.array([[0.5 - least - near]]))


@pytest.mark.few(1)
@pytest.mark.parametrize("draws", [8, 60])
def test_the_least_real_part_is_that_of_a_dense_grid_and_proved_up_to_there_only(draws: int) -> None:
    generator = np.random.default_rng(4)
    for _ in range(draws):
        n, m = int(generator.integers(1, 7)), int(generator.integers(1, 4))
        system, weight = loop(generator, n, m), symmetric(generator, m)
        least, angle = least_real(*system, weight)
        scale = abs(least) + 1
        assert real_part(system, weight, angle) == pytest.approx(least, abs=1e-9 * scale)
        grid = np.concatenate([np.linspace(0, np.pi, 2000), np.abs(np.angle(np.linalg.eigvals(system[0])))])
        assert min(real_part(system, weight, one) for one in grid.tolist()) >= least - 1e-9 * scale
        enough = weight + (1e-6 * scale - least) * np.eye(m)
        assert is_proved(system, enough)
        assert not is_proved(system, enough - 2e-6 * scale * np.eye(m))


def test_a_radius_larger_than_what_is_left_is_no_proof() -> None:
    system = (np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]]))
    a, b, c, d = (RADII.exact(one) for one in system)
    weight = np.array([[2 / 3 + 1e-4]])
    assert proves_positive(a, b, c, d, with_radius(weight, np.array([[1e-6]])))
    assert not proves_positive(a, b, c, d, with_radius(weight, np.array([[1e-3]])))
    assert not proves_positive(with_radius(a[0], np.array([[1e-3]])), b, c, d, RADII.exact(weight))


def test_what_is_proved_positive_is_so_for_all_matrices_within_the_radii() -> None:
    hilbert = np.array([[1 / (i + j + 1) for j in range(5)] for i in range(5)])
    smallest = float(np.linalg.eigvalsh(hilbert)[0])
    assert is_positive(with_radius(hilbert, np.full((5, 5), smallest / 50)))
    assert not is_positive(with_radius(hilbert, np.full((5, 5), smallest)))
    assert not is_positive(RADII.exact(hilbert - 1.001 * smallest * np.eye(5)))
