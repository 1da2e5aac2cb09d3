"""Claims about `apc.vary.lags`: a link's delay over any range, by one lifting for each part of a frame."""

from __future__ import annotations

import tracemalloc
from fractions import Fraction
from pathlib import Path

import flint
import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups, prepare
from apc.compiler.errors import Place
from apc.compiler.pipeline import compile_topology
from apc.eigen.bordered import Bordered
from apc.eigen.modes import split
from apc.eigen.spectrum import solve_spectrum
from apc.frame.names import Free
from apc.threads import single_threaded
from apc.vary.critical import critical
from apc.vary.delays import borders, system_with_delay
from apc.vary.lags import LateStretch, _LateSheet, _of_powers, late_stretches, response_of
from tests.bench.growing import row
from tests.topologies import AVERAGE, MESH, compiled, replaced

PHASED = replaced(AVERAGE, ("network: 8 ms", "network: {period: 4 ms, phase: 1 ms}"))
DIFFERENT = replaced(
    MESH, ("{count: 3}", "{count: 2}\n  other: {count: 1, set: {coordination.stiffness: 150 N/m}}")
)
NAMED = replaced(AVERAGE, ("peers:", "parameters: {late: 8 ms}\npeers:"), ("delay: 8 ms}", "delay: late}"))


def _stretches(text: str, name: str, high: Fraction) -> list[LateStretch] | None:
    system, free = compiled(text), Free(name)
    with single_threaded(), np.errstate(all="ignore"):
        prepared = prepare(system)
        following = borders(system, free, place=Place("test"))
        return late_stretches(system, free, Fraction(0), high, prepared, following)


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("text", "name"),
    [(PHASED, "lan.delay"), (DIFFERENT, "lan.delay"), (NAMED, "late"), (AVERAGE, "lan.delay")],
)
def test_every_stretch_is_as_stable_as_its_matrix_says(text: str, name: str) -> None:
    system = compiled(text)
    found = _stretches(text, name, Fraction(160, 1000))
    assert found is not None and len(found) >= 40
    assert [one.high for one in found[:-1]] == [one.low for one in found[1:]]
    assert {one.stable for one in found} == {True, False}
    for one in found[::3]:
        middle = system_with_delay(system, Free(name), (one.low + one.high) / 2)
        assert one.stable == solve_spectrum(split(*lifted_groups(middle)).systems).stable


def test_a_delay_that_forces_wait_for_is_left_to_others() -> None:
    assert _stretches(AVERAGE, "coordination.delay", Fraction(3, 1000)) is None


def test_a_search_of_two_seconds_ends_where_a_short_one_does() -> None:
    system = compiled(AVERAGE)
    long, short = (critical(system, "lan.delay", upper=upper) for upper in ("2 s", "140 ms"))
    assert long.crossings == short.crossings and long.whole and long.looked == 2000
    (edge,) = long.crossings
    assert edge.kind == "jump" and edge.stable_side == "below"


@pytest.mark.parametrize("kind", ["any", "of very different size", "nilpotent", "of size one"])
def test_a_determinant_is_the_same_polynomial_at_every_age(kind: str) -> None:
    random = np.random.default_rng(5)
    matrices, turned = random.normal(size=(2, 4, 3, 3)) + 1j * random.normal(size=(2, 4, 3, 3))
    if kind == "of very different size":
        matrices *= np.array([1e9, 1.0, 1e-6])
    if kind == "nilpotent":
        matrices, turned = np.tril(matrices, -1), np.tril(turned, -1)
    points, ages = np.exp(1j * random.uniform(0, np.pi, 4)), np.array([[0], [7], [250]])
    if kind == "of size one":  # 1 ± G has no inverse, and there is no logarithm at age 0
        matrices[:], ages = np.diag([1.0, -1.0, 0.5]), ages[1:]
    value, turning = _of_powers(matrices, turned, points, ages)
    # Of the largest value on the circle a few roundings are lost, of its slope as many times the steepest.
    with flint.ctx.workprec(200):
        one = flint.acb_mat(3, 3, [int(i == j) for i in range(3) for j in range(3)])
        for place, point in enumerate(points):
            whole, slope = (
                flint.acb_mat(3, 3, [flint.acb(entry.real, entry.imag) for entry in each[place].ravel()])
                for each in (matrices, turned)
            )
            for row, (age,) in enumerate(ages.tolist()):
                power = 1 / flint.acb(point.real, point.imag) ** age
                here = one + whole * power
                change = here.inv() * (slope * power - whole * (power * flint.acb(0, age)))
                determinant = complex(here.det())
                off = abs(np.exp(value[row, place]) / determinant - 1)
                assert off < 1e-12 * max(1.0, 1 / abs(determinant))
                exact = complex(sum((change[i, i] for i in range(3)), flint.acb(0)))
                assert abs(turning[row, place] - exact) < 1e-10 * max(abs(exact), 1.0)


def _random_loops() -> Bordered:
    """Return two loops of 40 states, of which one hears packets of two ages."""
    random = np.random.default_rng(7)
    fixed, heard = random.normal(0, 0.1, (1, 44, 44)), random.normal(0, 0.1, (2, 2, 44, 4))
    fixed[:, :, 40:] = np.eye(44)[:, 40:]
    fixed = np.repeat(fixed, 2, axis=0)
    heard[1, 0] = 0
    return Bordered(fixed, heard, 40)


def test_a_circle_of_points_is_looked_at_part_by_part_each_as_if_alone() -> None:
    sheet = _LateSheet(_random_loops(), None, np.array([0, 1]), np.array([[1, 1], [3, 4]]), 0, 4)
    points = np.exp(1j * np.linspace(0.1, 3.0, 2000))
    tracemalloc.start()
    found = sheet.over(np.array([0.0, 1.0]), points)
    _, most = tracemalloc.get_traced_memory()
    tracemalloc.stop()
    assert most < 16 * len(points) * 44**2  # a matrix at every point, of which five are made
    alone = sheet.at(np.array([0.0, 1.0]), np.repeat([0, 1], len(points)), np.tile(points, 2))
    # Roundings of 44 steps, by the condition of what is far from singular.
    assert np.abs(np.exp(found.value.ravel() - alone.value) - 1).max() < 1e-11
    assert np.abs(found.turning.ravel() - alone.turning).max() < 1e-9


def test_a_loop_taken_apart_is_the_same_loop() -> None:
    """To the roundings of 44 states, by the condition of the vectors of 40: some hundred."""
    loops, ages = _random_loops(), np.array([[1, 1], [3, 4], [3, 7]])
    apart = response_of(-loops.fixed[0, :40, :40])
    assert apart is not None
    whole, parts = (_LateSheet(loops, one, np.array([0, 1, 1]), ages, 1, 7) for one in (None, apart))
    values, points = np.arange(3.0), np.exp(1j * np.linspace(0.1, 3.0, 500))
    for one, other in (
        (whole.over(values, points), parts.over(values, points)),
        *((sheet.at(values, np.repeat([0, 1, 2], 500), np.tile(points, 3)) for sheet in (whole, parts)),),
    ):
        assert np.abs(np.exp(one.value - other.value) - 1).max() < 1e-10
        assert np.abs(one.turning - other.turning).max() < 1e-9


def test_a_late_link_of_a_row_of_masses_is_as_stable_as_its_matrices_say(tmp_path: Path) -> None:
    """80 states, more than are inverted at each point; as matrices, value by value."""
    (tmp_path / "scene.yaml").write_text(row(34, tmp_path).replace("500 N/m", "900 N/m"), encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    found = critical(system, "lan.delay", upper="40 ms")
    assert found.crossings
    for one in found.crossings:
        for side in (-1, 1):
            changed = system_with_delay(system, Free("lan.delay"), Fraction(one.value + side * 1e-6))
            stable = solve_spectrum(split(*lifted_groups(changed)).systems).stable
            assert stable == ((one.stable_side == "below") == (side < 0))


def test_a_determinant_far_below_its_largest_value_keeps_its_digits() -> None:
    # Six equal loops z⁺ = a z + b z of m frames ago: F = (ζ − a − b ζ^(−m))⁶, at ζ ≈ 1 next to nothing.
    many, a, b = 6, 0.5, 0.499999
    unit, nothing = np.eye(many), np.zeros((many, many))
    fixed = np.block([[-a * unit, nothing], [-unit, unit]])[None]
    heard = np.vstack([-b * unit, nothing])[None, None]
    ages = np.array([[1], [40]])
    loops = Bordered(fixed, heard, many)
    sheet = _LateSheet(loops, None, np.zeros(2, dtype=np.intp), ages, 0, 40)
    points = np.exp(1j * np.array([1e-7, 1e-3, 1.0]))
    found = sheet.over(np.arange(2.0), points)
    one = points - a - b * points**-ages
    assert np.abs(np.exp(found.value - many * np.log(one)) - 1).max() < 1e-6
    slope = many * 1j * (points + ages * b * points**-ages) / one
    assert (np.abs(found.turning / slope - 1) < 1e-6).all()
