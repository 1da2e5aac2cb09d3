"""What a loop gives back, beside closed forms, dense grids of frequencies, and inputs played in time."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.eigen.dissipation import is_positive, least_real, peak_gain, proves_gain, proves_positive
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
    # −1/(z − a) is least at θ = 0: −1/(1 − a).
    turned = (system[0], -system[1], system[2], np.array([[0.0]]))
    least, angle = least_real(*turned, np.zeros((1, 1)))
    assert least == pytest.approx(-1 / (1 - pole), rel=1e-12)
    assert angle == pytest.approx(0.0)


@pytest.mark.few(1)
@pytest.mark.parametrize("draws", [15, 60])
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


def test_a_loop_that_is_proved_positive_never_gives_back_more_than_it_took() -> None:
    generator = np.random.default_rng(5)
    for _ in range(20):
        n, m = int(generator.integers(1, 5)), int(generator.integers(1, 3))
        a, b, c, d = loop(generator, n, m)
        least, _ = least_real(a, b, c, d, np.zeros((m, m)))
        weight = (1e-6 - least) * np.eye(m)
        assert is_proved((a, b, c, d), weight)
        x, taken, size = np.zeros(n), 0.0, 0.0
        for _ in range(200):
            r = generator.standard_normal(m)
            taken += float(r @ (c @ x + d @ r + weight @ r))
            size += float(r @ r)
            x = a @ x + b @ r
            assert taken >= -1e-9 * size


def test_nothing_is_proved_of_a_loop_that_is_not_stable() -> None:
    unstable = (np.array([[1.1]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]]))
    assert least_real(*unstable, np.eye(1))[0] == -math.inf
    assert not is_proved(unstable, 100 * np.eye(1))
    assert not proves_gain(*(RADII.exact(one) for one in unstable), level=100.0)
    nothing = (np.array([[0.5]]), np.zeros((1, 0)), np.zeros((0, 1)), np.zeros((0, 0)))
    assert least_real(*nothing, np.zeros((0, 0)))[0] == math.inf


def test_a_radius_larger_than_what_is_left_is_no_proof() -> None:
    system = (np.array([[0.5]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]]))
    a, b, c, d = (RADII.exact(one) for one in system)
    weight = np.array([[2 / 3 + 1e-4]])
    assert proves_positive(a, b, c, d, with_radius(weight, np.array([[1e-6]])))
    assert not proves_positive(a, b, c, d, with_radius(weight, np.array([[1e-3]])))
    assert not proves_positive(with_radius(a[0], np.array([[1e-3]])), b, c, d, RADII.exact(weight))


def test_a_gain_is_that_of_a_closed_form_and_proved_just_above_it_only() -> None:
    # 1/(z − a) is largest at z = 1; with a resonance r e^{±jφ} the peak is found where a grid says.
    one = (np.array([[0.9]]), np.array([[1.0]]), np.array([[1.0]]), np.array([[0.0]]))
    assert peak_gain(*one)[0] == pytest.approx(10.0, rel=1e-13)
    r, turn = 0.999, 0.7
    a = r * np.array([[math.cos(turn), -math.sin(turn)], [math.sin(turn), math.cos(turn)]])
    two = (a, np.array([[1.0], [0.3]]), np.array([[0.2, 1.0]]), np.array([[0.5]]))
    z = np.exp(1j * np.linspace(turn - 1e-2, turn + 1e-2, 20001))

    def response(at: complex) -> float:
        found = two[2] @ np.linalg.solve(at * np.eye(2) - a, two[1]) + two[3]
        return abs(complex(found[0, 0]))

    known = max(map(response, z.tolist()))
    assert peak_gain(*two)[0] == pytest.approx(known, rel=1e-6)
    for system in (one, two):
        peak, exact = peak_gain(*system)[0], [RADII.exact(matrix) for matrix in system]
        assert proves_gain(exact[0], exact[1], exact[2], exact[3], peak * (1 + 1e-6))
        assert not proves_gain(exact[0], exact[1], exact[2], exact[3], peak * (1 - 1e-9))
    unstable = [RADII.exact(matrix) for matrix in (np.array([[1.1]]), *one[1:])]
    assert not proves_gain(unstable[0], unstable[1], unstable[2], unstable[3], 100.0)
    assert peak_gain(np.array([[1.1]]), *one[1:])[0] == math.inf


def test_what_is_proved_positive_is_so_for_all_matrices_within_the_radii() -> None:
    hilbert = np.array([[1 / (i + j + 1) for j in range(5)] for i in range(5)])
    smallest = float(np.linalg.eigvalsh(hilbert)[0])
    assert is_positive(with_radius(hilbert, np.full((5, 5), smallest / 50)))
    assert not is_positive(with_radius(hilbert, np.full((5, 5), smallest)))
    assert not is_positive(RADII.exact(hilbert - 1.001 * smallest * np.eye(5)))
