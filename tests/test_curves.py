"""Interpolation of plane curves."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from apc.regions.curves import area_beside, between, fill, off_an_arc, stencils, through_four

Floats = NDArray[np.float64]


def circle(angles: Floats, radius: float = 2.0) -> tuple[Floats, Floats]:
    points = radius * np.stack([np.cos(angles), np.sin(angles)], axis=1)
    return points, np.stack([-np.sin(angles), np.cos(angles)], axis=1)


def test_between_meets_an_arc_to_sixth_order_and_no_worse_than_is_said() -> None:
    offs = []
    for turn in (0.8, 0.4):
        points, tangents = circle(np.array([0.3, 0.3 + turn]))
        shares = np.linspace(0, 1, 101)
        inside = [between(points[:1], points[1:], tangents[:1], tangents[1:], share)[0] for share in shares]
        off = np.abs(np.linalg.norm(inside, axis=1) - 2.0).max()
        chord = np.linalg.norm(points[1:] - points[:1], axis=1)
        assert off == pytest.approx(float(off_an_arc(tangents[:1], tangents[1:], chord)[0]), rel=0.02)
        offs.append(off)
    assert offs[0] / offs[1] == pytest.approx(64, rel=0.1)


def test_through_four_is_exact_for_a_graph_of_degree_seven() -> None:
    x = np.array([0.0, 0.7, 1.2, 2.0])
    polynomial = np.polynomial.Polynomial([0.1, -0.2, 0.3, 0.05, -0.04, 0.03, 0.01, -0.006])
    points = np.stack([x, polynomial(x)], axis=1)
    tangents = np.stack([np.ones(4), polynomial.deriv()(x)], axis=1)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    # Over a chord along the x axis the frame is the graph's own.
    a, b = np.array([[0.7, 0.0]]), np.array([[1.2, 0.0]])
    shares = np.array([0.25, 0.5])
    place, direction = through_four(points[None], tangents[None], a, b, shares)
    at = 0.7 + 0.5 * shares
    np.testing.assert_allclose(place[0], np.stack([at, polynomial(at)], axis=1), atol=1e-14)
    np.testing.assert_allclose(direction[0, :, 1] / direction[0, :, 0], polynomial.deriv()(at), atol=1e-13)


def test_stencils_stay_on_their_own_curve() -> None:
    run = np.array([0, 0, 0, 0, 0, 1, 1, 2, 2, 2, 2])
    assert stencils(run).tolist() == [0, 0, 1, 1, -1, -1, -1, 7, 7, 7]


def test_a_filled_curve_is_as_near_as_it_says() -> None:
    x = np.linspace(0, 3, 64)
    points = np.stack([x, np.sin(x) + 0.3 * np.cos(3 * x)], axis=1)
    slopes = np.cos(x) - 0.9 * np.sin(3 * x)
    tangents = np.stack([np.ones(64), slopes], axis=1) / np.sqrt(1 + slopes**2)[:, None]
    filled, directions, errors = fill(points, tangents, np.full(63, 2e-8), np.full(63, 1e-6))
    assert len(filled) > 64
    for share in (0.25, 0.5, 0.7):
        place = between(filled[:-1], filled[1:], directions[:-1], directions[1:], share)
        off = np.abs(place[:, 1] - np.sin(place[:, 0]) - 0.3 * np.cos(3 * place[:, 0]))
        assert np.all(off <= errors.max())
    assert errors.max() <= 1.1e-6


def test_the_area_beside_a_circle_is_its_disc() -> None:
    points, tangents = circle(np.linspace(0, 2 * np.pi, 65))
    assert area_beside(points, tangents) == pytest.approx(4 * np.pi, rel=1e-8)
