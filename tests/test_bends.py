"""Claims about `apc.vary.bends`: nothing of the equations hides between the points of a scan."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

from apc.analysis.analysis import analyze, prepare
from apc.compiler.compiled import CompiledSystem
from apc.frame.names import Free, value_now
from apc.frame.overrides import Override, apply
from apc.vary.batch import BatchEvaluator
from apc.vary.bends import STRAIGHT, Bends, bends
from apc.vary.critical import critical
from apc.vary.evaluator import evaluator
from tests.topologies import AVERAGE, compiled, library, replaced

SPRING = """\
component: Spring
about: A spring whose stiffness depends on a setting.
connectors: {a: Flange, b: Flange}
parameters:
  low: {unit: N/m, min: 0}
  high: {unit: N/m}
  u: {unit: 1}
  clock: clock
  delay: {unit: s, min: 0, default: 0}
equations:
  - k = low + high*(SHAPE)
  - f = k*(sample(a.x) - sample(b.x))
  - a.f = hold(f, delay)
  - b.f = -a.f
"""
SCENE = """\
topology: setting
parameters: {dial: 700}
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}
couplers:
  c:
    type: Spring
    a: device
    b: ground
    low: 500 N/m
    high: 8000 N/m
    u: 2*dial - dial
    clock: haptic
    delay: 1 ms
"""
BUMP = "1/(1 + ((u - 1237)/50)^4)"


def scene(folder: Path, shape: str) -> CompiledSystem:
    return compiled(SCENE, library(folder, SPRING.replace("SHAPE", shape)))


def bent(system: CompiledSystem, name: str) -> Bends:
    family = evaluator(system, [Free(name)], prepared=prepare(system))
    assert isinstance(family, BatchEvaluator)
    found = bends(family, (value_now(system, Free(name)),), 0)
    assert found is not None
    return found


@pytest.mark.parametrize("name", ["contact.stiffness", "coordination.stiffness", "contact.damping"])
def test_what_is_linear_asks_for_no_more_points(name: str) -> None:
    found = bent(compiled(AVERAGE), name)
    points = np.geomspace(1.0, 1e6, 7)
    assert found.functions == ()
    assert found.between(points, 1.0)[0] is points


def test_a_mass_is_a_cubic_between_the_points() -> None:
    """1/m between neighbours is the cubic of its ends, to the hundredth that is promised."""
    found = bent(compiled(AVERAGE), "device.mass")
    points, known = found.between(np.geomspace(1e-3, 1e2, 6), 1e-3)
    assert known
    t = np.linspace(0, 1, 33)[:, None]
    low, high = points[:-1], points[1:]
    width = high - low
    cubic = (
        (2 * t**3 - 3 * t**2 + 1) / low
        - (t**3 - 2 * t**2 + t) * width / low**2
        + (3 * t**2 - 2 * t**3) / high
        - (t**3 - t**2) * width / high**2
    )
    assert np.all(np.abs(cubic - 1 / (low + t * width)) <= STRAIGHT / low)
    assert len(points) < 60


def test_a_bump_between_two_samples_is_found_at_its_closed_form(tmp_path: Path) -> None:
    """k(u) crosses the spring's own limit K at u₀ ± w (h/(K − low) − 1)^¼."""
    system = scene(tmp_path, BUMP)
    plain = scene(tmp_path, "u")
    bound = critical(apply(plain, [Override(Free("c.high"), Fraction(1))]), "c.u").value
    assert bound is not None
    reach = 50 * (8000 / bound - 1) ** 0.25
    for name in ("c.u", "dial"):
        found = critical(system, name)
        assert [one.value for one in found.crossings] == pytest.approx([1237 - reach, 1237 + reach], rel=1e-9)
        assert [one.stable_side for one in found.crossings] == ["below", "above"]
        assert found.known


@pytest.mark.parametrize("width", ["5", "0.01", "0.0001"])
def test_no_bump_is_too_narrow(tmp_path: Path, width: str) -> None:
    found = critical(scene(tmp_path, BUMP.replace("50", width)), "c.u")
    assert len(found.crossings) == 2
    for one in found.crossings:
        assert abs(one.value - 1237) < 2 * float(width)


@pytest.mark.parametrize(
    ("shape", "place"),
    [
        ("if u > 1000 and u < 1002 then 1 else 0", 1000.0),
        ("max(0, 1 - abs(u - 1001)/2)", 999.4),
        ("exp(-(u - 1001)^2/4)", 998.0),
        ("tanh(u - 1001) - tanh(u - 1003)", 1000.5),
        ("atan2(4, 8*(u - 1003)) - atan2(4, 8*(u - 1001))", 999.0),
    ],
)
def test_steps_kinks_and_other_functions_hide_nothing_either(
    tmp_path: Path, shape: str, place: float
) -> None:
    system = scene(tmp_path, shape)
    found = critical(system, "dial")
    assert len(found.crossings) == 2
    assert found.crossings[0].value == pytest.approx(place, abs=2)
    middle = sum(one.value for one in found.crossings) / 2
    for value, stable in ((700.0, True), (middle, False), (1500.0, True)):
        assert analyze(apply(system, [Override(Free("dial"), Fraction(value))])).stable is stable
    assert found.known


def test_what_reaches_where_a_scene_is_linearized_says_how_often_it_was_looked_at() -> None:
    bent_scene = replaced(
        AVERAGE,
        ("SampledSpringDamper", "OneSidedContact"),
        ("b: cube,", "b: cube, half_width: 20 mm,"),
        ("stiffness: 1000", "stiffness: 3000"),
        ("count: 3", "count: 3, set: {device.x: -15 mm}"),
    )
    # The contact closes where its half width is how far the device begins from the cube: a free device less.
    found = critical(compiled(bent_scene), "contact.half_width", upper="40 mm")
    (edge,) = found.crossings
    assert abs(edge.value - 0.015) <= 1e-14 and edge.stable_side == "below" and found.scanned == (0.0, 0.04)
    assert not found.known
    assert f"{found.looked} values were looked at; what the equations do between two" in str(found)
    assert "the scene is not linear" in str(found)
