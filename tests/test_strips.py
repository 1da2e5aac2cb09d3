"""Claims about `apc.regions.strips`: over a delay the boundary is as right as over any parameter."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import analyze, prepare
from apc.compiler.compiled import CompiledSystem
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.present.region_picture import stable_outlines
from apc.regions.axes import parse_axes
from apc.regions.region import Region, region
from apc.vary.critical import critical
from tests.topologies import AVERAGE, compiled

CONTACT = "contact.stiffness=500 N/m:3000 N/m"
COMPUTING = "contact.delay=0.5 ms:1.5 ms"
LINK = "lan.delay=2 ms:5 ms"
COORDINATION = "coordination.stiffness=500 N/m:2000 N/m"


@pytest.fixture(scope="module")
def scene() -> CompiledSystem:
    return compiled(AVERAGE)


@pytest.fixture(scope="module")
def computing(scene: CompiledSystem) -> Region:
    return region(scene, parse_axes(scene, COMPUTING, CONTACT), cells=6)


def limit(scene: CompiledSystem, delay: str, value: Fraction, stiffness: str) -> float:
    found = critical(apply(scene, [Override(Free(delay), value)]), stiffness).value
    assert found is not None
    return found


def test_the_curves_of_a_computational_delay_meet_its_critical_values(
    scene: CompiledSystem, computing: Region
) -> None:
    assert all(curve.smooth and curve.error <= 1e-9 for curve in computing.curves)
    assert not computing.stepped
    assert "right to a cell only" not in str(computing)
    ends = np.concatenate([curve.points[[0, -1]] for curve in computing.curves])
    for delay in (Fraction(1, 2000), Fraction(1, 1000), Fraction(3, 2000)):
        [height] = {round(float(y), 6) for x, y in ends if x == float(delay)}
        assert height == pytest.approx(limit(scene, "contact.delay", delay, "contact.stiffness"), rel=2e-9)


def test_points_beside_the_curves_are_on_the_side_that_an_analysis_says(
    scene: CompiledSystem, computing: Region
) -> None:
    """Points a 1e-5th of the ranges from the curves' cubics, between their knots as well."""
    prepared, rng = prepare(scene), np.random.default_rng(3)
    width = computing.rectangle.width
    for curve in computing.curves:
        places = rng.integers(1, len(curve.points) - 1, 12)
        normal = np.stack([-curve.tangents[places, 1], curve.tangents[places, 0]], axis=1)
        for sign in (1, -1):  # the stable side is on the left
            points = curve.points[places] + sign * 1e-5 * normal * width
            for x, y in points.tolist():
                values = [Fraction(x), Fraction(y)]
                names = ("contact.delay", "contact.stiffness")
                moved = [Override(Free(name), value) for name, value in zip(names, values, strict=True)]
                assert analyze(apply(scene, moved), prepared=prepared).stable is (sign > 0)
                assert computing.contains(x, y) is (sign > 0)


def test_the_axes_may_change_places(scene: CompiledSystem, computing: Region) -> None:
    other = region(scene, parse_axes(scene, CONTACT, COMPUTING), cells=6)
    assert other.stable_area == pytest.approx(
        computing.stable_area, abs=other.stable_area_error + computing.stable_area_error
    )
    assert [one.mode for one in other.curves] == [one.mode for one in computing.curves]
    assert other.contains(900.0, 0.001) is computing.contains(0.001, 900.0) is True
    assert other.contains(2900.0, 0.001) is computing.contains(0.001, 2900.0) is False


def test_over_a_link_the_boundary_is_a_staircase_at_the_critical_values(scene: CompiledSystem) -> None:
    found = region(scene, parse_axes(scene, LINK, COORDINATION), cells=4)
    [curve] = found.curves
    assert not curve.smooth
    assert curve.error <= 1e-12
    heights = {float(y) for _, y in curve.points}
    area = 0.0
    for tick in (2, 3, 4):
        # A packet that arrives between two ticks is heard at the second.
        height = limit(scene, "lan.delay", Fraction(2 * tick + 1, 2000), "coordination.stiffness")
        assert min(abs(height - one) for one in heights) <= 1e-12 * height
        area += (height - 500) * 1e-3
    assert {round(1e3 * float(x), 12) for x, _ in curve.points} == {2.0, 3.0, 4.0, 5.0}
    assert found.stable_area == pytest.approx(area, rel=1e-12)
    [outline] = stable_outlines(found)
    x, y = outline.T
    assert abs(float(x @ np.roll(y, -1) - y @ np.roll(x, -1))) / 2 == pytest.approx(area, rel=1e-12)
    low, high = curve.frequency_hz
    leading = analyze(apply(scene, [Override(Free("coordination.stiffness"), Fraction(1100))])).modes[0]
    assert low <= leading.frequency_hz + 1
    assert high >= leading.frequency_hz - 1
    assert curve.mode == "difference"


def test_a_staircase_that_another_mode_takes_over_is_a_curve_a_mode(scene: CompiledSystem) -> None:
    link = "lan.delay=0 ms:40 ms"
    found = region(scene, parse_axes(scene, link, "coordination.stiffness=500 N/m:3000 N/m"), cells=4)
    assert {curve.mode for curve in found.curves} == {"difference", "common"}
    for curve in found.curves:
        low, high = curve.frequency_hz
        for delay, stiffness in curve.knots[::4]:
            beside = [
                Override(Free("lan.delay"), Fraction(float(delay))),
                Override(Free("coordination.stiffness"), Fraction(float(stiffness))),
            ]
            listed = analyze(apply(scene, beside)).modes
            near = min(listed, key=lambda mode: abs(mode.magnitude - 1) + (mode.shape != curve.mode))
            assert low - 0.01 <= near.frequency_hz <= high + 0.01
            assert near.shape == curve.mode


def test_over_two_times_the_boundary_is_known_to_a_cell(scene: CompiledSystem) -> None:
    system = apply(scene, [Override(Free("coordination.stiffness"), Fraction(900))])
    axes = parse_axes(system, "contact.delay=0.5 ms:3 ms", "coordination.delay=0 ms:2 ms")
    found = region(system, axes, cells=3)
    assert found.stepped
    assert found.curves
    assert "right to a cell only" in str(found)
    assert max(map(len, str(found).splitlines())) <= 80
    assert found.curves[0].mode == "difference"
    assert found.curves[0].frequency_hz[0] > 1
