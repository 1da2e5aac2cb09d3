"""Claims about `apc.analysis.cells` and `apc.frame.taylor`: many cells of a box at once."""

from __future__ import annotations

import itertools
from fractions import Fraction

import numpy as np
import pytest

from apc.analysis import box_proof, cells
from apc.analysis.box import open_box, parse_range
from apc.analysis.cells import Cell, OpenSystem, look
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import precision, rational_ball
from apc.eigen.rigid import find_rigid_modes
from apc.frame.discretize import step_balls
from apc.frame.radius import radius_of, value_of
from apc.frame.taylor import reciprocal, step_over, taylor
from tests.sites import columned, paper
from tests.topologies import AVERAGE, MESH, compiled

BOXES = [
    (AVERAGE, ["contact.stiffness=±20%", "coordination.stiffness=±20%"]),
    (MESH, ["coordination.stiffness=100 N/m:600 N/m"]),
    (AVERAGE, ["device.mass=±20%", "cube.mass=±5%", "cube.damping=±50%", "contact.stiffness=±1%"]),
    (AVERAGE, ["couplers.contact.damping=0 N*s/m:0.5 N*s/m", "device.mass=±0.001%"]),
]


def _opened(system: CompiledSystem, texts: list[str]) -> tuple[Cell, list[OpenSystem]]:
    ranges = [parse_range(system, text) for text in texts]
    box = open_box(system, ranges)
    found = [
        cells.open_system(one, sites, find_rigid_modes(one))
        for one, sites in zip(box.systems, box.sites, strict=True)
    ]
    return tuple((one.low, one.high) for one in ranges), found


def _parts(whole: Cell, generator: np.random.Generator) -> list[Cell]:
    """Return the box, and some cells of it, each a hundredth as wide or a millionth."""
    found = [whole]
    for share in (Fraction(1, 100), Fraction(1, 10**6), Fraction(1, 10**6)):
        starts = [Fraction(float(one)) * (1 - share) for one in generator.random(len(whole))]
        found.append(
            tuple(
                (low + start * (high - low), low + (start + share) * (high - low))
                for (low, high), start in zip(whole, starts, strict=True)
            )
        )
    return found


@pytest.mark.parametrize(("text", "ranges"), BOXES)
def test_the_matrix_at_every_corner_and_inside_a_cell_is_within_its_radius(
    text: str, ranges: list[str]
) -> None:
    """Against balls of 256 bits at the points themselves."""
    generator = np.random.default_rng(3)
    whole, systems = _opened(compiled(text), ranges)
    some = _parts(whole, generator)
    inside = [tuple(one) for one in generator.uniform(-1, 1, (3, len(whole)))]
    with precision(box_proof.BITS):
        for system in systems:
            found = cells._matrices(system, some)
            for cell, matrix in zip(some, found, strict=True):
                for sides in (*itertools.product((-1.0, 1.0), repeat=len(whole)), *inside):
                    point = [
                        (low + high) / 2 + Fraction(side) * (high - low) / 2
                        for (low, high), side in zip(cell, sides, strict=True)
                    ]
                    balls = box_proof._matrix(system, [rational_ball(value) for value in point], None)
                    slopes = np.tensordot(np.array(sides), matrix[2:], axes=1)
                    n = matrix.shape[-1]
                    for row, column in itertools.product(range(n), repeat=2):
                        truth = balls[row, column]
                        held = matrix[0, row, column] + slopes[row, column]
                        size = np.abs(matrix[[0, *range(2, len(matrix))], row, column]).sum()
                        off = float(abs(truth - float(held)))
                        assert off <= matrix[1, row, column] + 4e-16 * size, (cell, sides, row, column)


def test_the_radius_shrinks_with_the_square_of_the_cell() -> None:
    whole, [*_, system] = _opened(compiled(AVERAGE), ["contact.stiffness=±10%", "device.mass=±10%"])
    radii = []
    for share in (Fraction(1), Fraction(1, 10), Fraction(1, 100)):
        cell = tuple(
            ((low + high) / 2 - share * (high - low) / 2, (low + high) / 2 + share * (high - low) / 2)
            for low, high in whole
        )
        radii.append(float(radius_of(cells._matrices(system, [cell]))[0].max()))
    assert 50 < radii[0] / radii[1] < 200
    assert 90 < radii[1] / radii[2] < 110


def test_no_cell_with_an_unstable_point_is_proved_and_small_ones_below_the_limit_are() -> None:
    """The limit of K_T at K_C = 1000 is 1096.411 N/m (see `test_box`)."""
    _, systems = _opened(compiled(AVERAGE), ["coordination.stiffness=1000 N/m:1200 N/m"])

    def proved(low: str, high: str) -> bool:
        cell = ((Fraction(low), Fraction(high)),)
        return all(look(system, [cell]).proved[0] for system in systems)

    assert proved("1096.40", "1096.4003")
    assert proved("1096.4", "1096.4")  # a point
    for high in ("1096.42", "1097", "1150"):
        assert not proved("1096.40", high)
        assert not proved(high, high)


def test_peers_that_differ_are_looked_at_together() -> None:
    system = columned(paper(), device__mass=[0.1, 0.2, 0.15])
    whole, systems = _opened(system, ["contact.stiffness=±0.1%"])
    assert all(look(one, [whole]).proved.all() for one in systems)


def _over(middle: np.ndarray, *sides: np.ndarray) -> np.ndarray:
    return np.stack([middle, np.zeros_like(middle), *sides])[None]


def test_a_step_over_a_cell_holds_the_exponential_at_its_corners() -> None:
    """Of a mass on a damper, B the force; against balls."""
    for seconds in (Fraction(1, 1000), Fraction(1, 2)):
        a = _over(np.array([[0.0, 1.0], [-30.0, -4.0]]), np.array([[0.0, 0.0], [-3.0, 0.25]]))
        b = _over(np.array([[0.0], [10.0]]), np.array([[0.0], [-1.0]]))
        found = step_over(a, b, float(seconds))[0]
        for side in (-1, 0, 1):
            own = (a[0, 0] + side * a[0, 2]).astype(object)
            pushed = (b[0, 0] + side * b[0, 2]).astype(object)
            with precision(200):
                truth = step_balls(own, pushed, seconds)
                held = found[0] + side * found[2]
                for place in np.ndindex(held.shape):
                    assert float(abs(truth[place] - float(held[place]))) <= found[1][place]
        assert found[1].max() < 0.1 * np.abs(found[0]).max()


def test_products_and_quotients_hold_those_of_every_point() -> None:
    generator = np.random.default_rng(11)
    numbers = taylor(2)
    for _ in range(50):
        left, right = generator.normal(size=(2, 3, 4, 4, 4))
        left[:, 1], right[:, 1] = np.abs(left[:, 1]), np.abs(right[:, 1])
        left[:, 2:] *= 0.1
        found = numbers.multiply(left, right)
        one, two = generator.uniform(-1, 1, 2)

        def at(matrix: np.ndarray, share: float, one: float = one, two: float = two) -> np.ndarray:
            whole = value_of(matrix) + one * matrix[:, 2] + two * matrix[:, 3]
            return np.asarray(whole + share * radius_of(matrix))

        for shares in itertools.product((-1.0, 0.3, 1.0), repeat=2):
            product = at(left, shares[0]) @ at(right, shares[1])
            assert (np.abs(product - at(found, 0.0)) <= radius_of(found)).all()
        number = np.array([4.0, 0.5, 1.0, -0.75]).reshape(1, 4, 1, 1)
        inverse = reciprocal(number)
        for share in (-1.0, 1.0):
            assert np.abs(1 / at(number, share) - at(inverse, 0.0)) <= radius_of(inverse)
    assert not np.isfinite(reciprocal(np.array([1.0, 0.0, 1.0, 0.5]).reshape(1, 4, 1, 1))[0, 1, 0, 0])
