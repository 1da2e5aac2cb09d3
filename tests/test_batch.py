"""Claims about `apc.vary.batch` and `evaluator`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import analyze, lifted_groups, prepare
from apc.compiler.compiled import CompiledSystem
from apc.eigen.balls import frame_balls, precision
from apc.eigen.modes import split
from apc.eigen.relative import relative
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.frame.schedule import ORDER
from apc.vary.batch import BatchEvaluator
from apc.vary.evaluator import evaluator, reaches_time
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

NAMES = ("contact.stiffness", "coordination.stiffness", "coordination.damping", "device.mass", "cube.damping")


def scene(name: str) -> CompiledSystem:
    return compiled((SCENES / f"{name}.yaml").read_text(encoding="utf-8").partition("\n")[2])


def points(system: CompiledSystem, names: tuple[str, ...], count: int = 4) -> np.ndarray:
    base = np.array([next(p.value for p in system.parameters if p.name == name) or 1.0 for name in names])
    return base * np.random.default_rng(5).uniform(0.3, 1.6, (count, len(names)))


@pytest.mark.parametrize("text", [AVERAGE, MESH, replaced(AVERAGE, ("delay: 8 ms", "delay: 0 ms"))])
def test_a_batch_has_the_radii_of_single_analyses(text: str) -> None:
    system = compiled(text)
    family = evaluator(system, [Free(name) for name in NAMES])
    values = points(system, NAMES)
    found = family.matrices(values)
    for k, row in enumerate(values):
        overrides = [Override(Free(n), Fraction(float(v))) for n, v in zip(NAMES, row, strict=True)]
        alone = analyze(apply(system, overrides))
        radius = max(float(np.abs(np.linalg.eigvals(one[k])).max()) for one in found)
        assert abs(radius - alone.spectral_radius) <= 1e-11 * max(1, radius)


@pytest.mark.parametrize("name", ["ring-of-eight", "mixed-clocks", "star-lecture"])
def test_other_graphs_clocks_and_groups_are_batched_alike(name: str) -> None:
    system = scene(name)
    family = evaluator(system, [Free("contact.stiffness")])
    values = np.array([[400.0], [900.0]])
    found = family.matrices(values)
    for k, value in enumerate(values[:, 0]):
        alone = analyze(apply(system, [Override(Free("contact.stiffness"), Fraction(value))]))
        radius = max(float(np.abs(np.linalg.eigvals(one[k])).max()) for one in found)
        assert abs(radius - alone.spectral_radius) <= 1e-9


@pytest.mark.parametrize("name", ["cube.mass", "contact.delay", "lan.delay"])
def test_what_is_prepared_once_serves_no_other_numbers_and_no_other_order(name: str) -> None:
    """Another value has the matrices of a scene written with it, whatever was asked before."""
    free = [Free("contact.stiffness")]
    system, value = compiled(AVERAGE), np.array([[700.0]])
    first = evaluator(system, free)
    assert evaluator(system, free, prepared=prepare(system)) is first
    other = apply(system, [Override(Free(name), Fraction(3, 1000))])
    alone = analyze(apply(other, [Override(free[0], Fraction(700))]))
    found = evaluator(other, free).matrices(value)
    assert abs(max(np.abs(np.linalg.eigvals(one)).max() for one in found) - alone.spectral_radius) <= 1e-11
    assert evaluator(system, free, prepared=prepare(system, order=ORDER[::-1])) is not first


def test_derivatives_are_those_of_the_exact_matrices() -> None:
    """Against central differences of matrices in ball arithmetic, which cut off about 1e-11."""
    system = compiled(AVERAGE)
    for name in NAMES:
        value = next(p.value for p in system.parameters if p.name == name) or 1.5
        family = evaluator(system, [Free(name)])
        assert isinstance(family, BatchEvaluator)
        pairs = family.slopes(np.array([[value]]), np.ones((1, 1)))
        ends = value * (1 - 2.0**-20), value * (1 + 2.0**-20)
        for place, wiring in enumerate(family.wirings):
            with precision(300):
                one, other = (frame_balls(family.exact_at([end])[place]) for end in ends)
                rate = np.array([[float(e.mid()) if hasattr(e, 'mid') else float(e) for e in row]
                                 for row in other - one]) / (ends[1] - ends[0])  # fmt: skip
            exact = relative(rate, wiring.relative)
            slope = pairs[place][1][0]
            assert np.abs(slope - exact).max() <= 1e-9 * np.abs(exact).max()


def test_error_bounds_hold_the_true_matrices() -> None:
    system = compiled(AVERAGE)
    family = evaluator(system, [Free(name) for name in NAMES])
    assert isinstance(family, BatchEvaluator)
    values = points(system, NAMES)
    bounds = family.errors(values)
    found = family.matrices(values)
    for k, row in enumerate(values):
        for place, wiring in enumerate(family.wirings):
            with precision(200):
                balls = frame_balls(family.exact_at(row.tolist())[place])
                at = wiring.relative
                reduced = relative(balls, replace(at, weights=at.weights.astype(object)))
                off = np.array([[abs(float((e - float(f)).mid()) if not isinstance(e, int) else e - f)
                                 for e, f in zip(a, b, strict=True)]
                                for a, b in zip(reduced, found[place][k], strict=True)])  # fmt: skip
            assert (off <= bounds[place][k]).all()


def test_closed_systems_at_a_point_are_those_of_an_analysis() -> None:
    system = compiled(AVERAGE)
    family = evaluator(system, [Free("contact.stiffness")])
    there = apply(system, [Override(Free("contact.stiffness"), Fraction(700))])
    for mine, other in zip(family.closed_at([700.0]), split(*lifted_groups(there)).systems, strict=True):
        assert np.array_equal(mine.matrix, other.matrix)
        assert np.array_equal(mine.error, other.error)


def test_a_mass_of_zero_spoils_no_other_point() -> None:
    family = evaluator(compiled(AVERAGE), [Free("device.mass")])
    alone = family.matrices(np.array([[0.1]]))
    beside = family.matrices(np.array([[0.0], [0.1], [1e-300]]))
    for one, many in zip(alone, beside, strict=True):
        assert np.isnan(many[0]).all()
        assert np.array_equal(one[0], many[1])


def test_a_translation_that_is_none_at_a_point_gives_no_number() -> None:
    """An arm of stiffness 0 frees all; the directions found for a stiff one hold for every stiffness."""
    family = evaluator(scene("star-lecture"), [Free("arm.stiffness")])
    found = family.matrices(np.array([[0.0], [100.0]]))
    assert all(np.isfinite(one).all() for one in found)


def test_what_reaches_a_time_is_told_from_what_does_not() -> None:
    text = replaced(
        AVERAGE,
        ("masses:", "parameters: {wait: 1 ms, kt: 500 N/m}\nmasses:"),
        ("delay: 1 ms, link", "delay: wait, link"),
        ("stiffness: 500 N/m", "stiffness: kt"),
    )
    system = compiled(text)
    assert reaches_time(system, Free("wait"))
    assert reaches_time(system, Free("lan.delay"))
    assert not reaches_time(system, Free("kt"))


def test_what_enters_as_a_ratio_alone_is_moved_all_the_same() -> None:
    """Without clocks A has k/m and d/m and nothing else: moved all alike, these stay."""
    system = compiled(
        "topology: ratio\npeers: {user: {count: 1}}\nmasses:\n  device: {mass: 2 kg, damping: 3 N*s/m}\n"
        "couplers:\n  s: {type: SpringDamper, a: device, b: ground, stiffness: 50 N/m, damping: 1 N*s/m}\n"
    )
    names = ("device.mass", "device.damping", "s.stiffness", "s.damping")
    family = evaluator(system, [Free(name) for name in names])
    [matrix] = family.matrices(np.array([[2.0, 3.0, 50.0, 1.0], [4.0, 3.0, 70.0, 1.0]]))
    for found, (m, k) in zip(matrix, ((2.0, 50.0), (4.0, 70.0)), strict=True):
        roots = np.exp(np.roots([m, 4.0, k]))  # a frame of one second
        values = np.linalg.eigvals(found)
        assert all(np.abs(values - root).min() < 1e-12 for root in roots)
