"""Claims about `apc.eigen.bordered`: it has the zeros of the closed matrix, packets and all."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.eigen.balls import precision
from apc.eigen.bordered import (
    Logarithm,
    beyond_circle,
    bordered,
    logarithm,
    map_balls,
    proved_zero,
    side_by_side,
    wire_balls,
    wires_of,
)
from apc.eigen.closing import Loop, close_loop
from apc.eigen.modes import arrange
from tests.topologies import AVERAGE, compiled, replaced

LATE = replaced(AVERAGE, ("delay: 8 ms}", "delay: 40 ms}"))
DIFFERENT = replaced(
    LATE, ("{count: 3}", "{count: 2}\n  other: {count: 1, set: {contact.stiffness: 700 N/m}}")
)


def _loops(text: str) -> tuple[Loop, ...]:
    return arrange(*lifted_groups(compiled(text))).loops


@pytest.mark.parametrize("text", [AVERAGE, LATE, DIFFERENT])
def test_it_is_the_characteristic_polynomial_over_the_packets(text: str) -> None:
    for loop in _loops(text):
        _check_logarithm(loop)


def _check_logarithm(loop: Loop) -> None:
    wires = wires_of(loop.sites, loop.coupling, loop.doubts)
    maps = side_by_side([group.lifted for group in loop.sites]).mapped(lambda block: block[None])
    slopes = maps.mapped(lambda block: np.cos(np.arange(block.size)).reshape(block.shape))
    points = np.exp(1j * np.array([0.3, 1.1, 2.9])) * np.array([1.0, 1.1, 0.9])

    def at(place: np.ndarray, step: float = 0.0) -> Logarithm:
        moved = maps.mapped(lambda one, slope: one + step * slope, slopes)
        loops, change = bordered(moved, wires.weights), bordered(slopes, wires.weights, unit=0.0)
        return logarithm(loops, change, np.array(wires.lags), np.zeros(3, dtype=np.intp), place, rigid=1)

    found, matrix = at(points), close_loop(loop).matrix
    for value, point in zip(found.value, points, strict=True):
        whole = np.linalg.det(point * np.eye(len(matrix)) - matrix) * point ** -len(loop.packets)
        assert np.exp(value) == pytest.approx(whole / (1 - 1 / point), rel=1e-9)
    h = 1e-6
    turned = (at(points * np.exp(1j * h)).value - at(points * np.exp(-1j * h)).value) / (2 * h)
    assert found.turning == pytest.approx(turned, rel=1e-6)
    h = 1e-9  # the slopes are large, and a difference off by the third power of step times slope
    moved = (at(points, h).value - at(points, -h).value) / (2 * h)
    assert found.moving == pytest.approx(moved, rel=1e-5)


@pytest.mark.parametrize("text", [AVERAGE, LATE, DIFFERENT])
@pytest.mark.parametrize("radius", [0.7, 0.9, 0.99, 1 - 1e-6, 1 + 1e-6])
def test_the_zeros_beyond_a_circle_are_counted(text: str, radius: float) -> None:
    for loop in _loops(text):
        wires = wires_of(loop.sites, loop.coupling, loop.doubts)
        maps, errors = (
            side_by_side(blocks)
            for blocks in zip(*((one.lifted, one.lifted.error) for one in loop.sites), strict=True)
        )
        values = np.linalg.eigvals(close_loop(loop).matrix)
        found = beyond_circle(maps, errors, wires, radius, np.array([1.0]))
        assert found == int((np.abs(values) > radius).sum())


@pytest.mark.parametrize("text", [AVERAGE, LATE, DIFFERENT])
def test_every_simple_eigenvalue_is_held_in_a_ball(text: str) -> None:
    for loop in _loops(text):
        values = np.linalg.eigvals(close_loop(loop).matrix)
        for value in values[np.abs(values) > 0.5].tolist():
            with precision(128):
                ball = proved_zero(map_balls(loop), wire_balls(loop), value)
                assert ball is not None and ball.rel_accuracy_bits() > 80
            assert complex(ball) == pytest.approx(value, abs=1e-11)


def test_no_ball_is_had_where_there_is_no_simple_zero() -> None:
    """Without any site's motion heard, two equal sites have each eigenvalue twice."""
    (loop,) = (one for one in _loops(DIFFERENT) if len(one.sites) == 2)
    silent = {way: tuple((0 * a, 0 * b) for a, b in rows) for way, rows in loop.coupling.items()}
    twice = replace(loop, sites=(loop.sites[0], loop.sites[0]), coupling=silent)
    value = complex(np.linalg.eigvals(close_loop(twice).matrix)[0])
    with precision(128):
        assert proved_zero(map_balls(twice), wire_balls(twice), value) is None
