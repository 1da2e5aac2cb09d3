"""A component may ask for the period of its clock, which then follows what is set of the clock."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.components.library import Library
from apc.frame.overrides import apply, parse_override
from apc.simulation.trajectory import simulate
from apc.vary.critical import critical
from tests.library.parts import ticked
from tests.topologies import SCENES, compiled, library, replaced, scene, told

# What computes with the period of its clock, of the library and of a component of one's own.
PERIODS = {
    "finger": ("haptic: tick", "haptic: 2 ms"),
    "limited-motor": ("haptic: 1 ms", "haptic: 2 ms"),
    "stiff-wall-passivity": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-dead-reckoning": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-filtered-waves": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-passivity": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-reported": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-set-position": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-waves": ("haptic: 1 ms", "haptic: 2 ms"),
}


FILTER = """\
component: Filtered
connectors: {a: Flange}
parameters: {stiffness: {unit: N/m}, corner: {unit: rad/s}, clock: clock}
variables: {y: {unit: m, start: 0}}
equations:
  - y = previous(y) + corner*interval(clock)*(sample(a.x) - previous(y))
  - a.f = hold(stiffness*y, interval(clock)/2)
"""
FILTERED = """\
topology: filtered
clocks: {haptic: 1 ms, slow: 5 ms}
peers: {one: {count: 1}, two: {count: 1, set: {wall.clock: slow}}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 mm}}
couplers: {wall: {type: Filtered, a: device, stiffness: 500 N/m, corner: 100 rad/s, clock: haptic}}
"""


def _set(system: CompiledSystem, setting: str) -> CompiledSystem:
    return apply(system, [parse_override(system, setting)])


def _motion(system: CompiledSystem) -> tuple[float, list[list[float]]]:
    """Return the spectral radius of a scene, and the rows of its first moments."""
    return analyze(system).spectral_radius, simulate(
        system, duration=Fraction(6, 100), jit=False
    ).values.tolist()


@pytest.mark.parametrize(("name", "period"), PERIODS.items())
def test_a_period_that_is_set_reaches_what_computes_with_it(name: str, period: tuple[str, str]) -> None:
    """Set without compiling again it is as written in the file: motion and spectral radius."""
    text = (SCENES / f"{name}.yaml").read_text(encoding="utf-8")
    set_, written = _set(compiled(text), "haptic.period=2 ms"), compiled(replaced(text, period))
    assert _motion(set_) == _motion(written)
    assert _motion(written)[1] != _motion(compiled(text))[1]


def test_a_filter_of_ones_own_has_the_period_of_the_clock_each_group_names(tmp_path: Path) -> None:
    own = library(tmp_path, FILTER)
    system = compiled(FILTERED, own)
    for setting, period in (("haptic.period=2 ms", ("haptic: 1 ms", "haptic: 2 ms")),
                            ("slow.period=4 ms", ("slow: 5 ms", "slow: 4 ms"))):  # fmt: skip
        written = compiled(replaced(FILTERED, period), own)
        assert _motion(_set(system, setting)) == _motion(written)
    stiffest = [critical(one, "wall.stiffness").value for one in (_set(system, setting), written)]
    assert stiffest[0] == stiffest[1]
    assert {one.name: one.exact for one in system.parameters if one.name.endswith(".period")} == {
        "haptic.period": Fraction(1, 1000),
        "slow.period": Fraction(1, 200),
    }
    # By hand, of the first group: y' = y + ω T (x - y) at each tick, acting half a tick later.
    ticked_ = ticked(compiled(FILTERED.replace(", two: {count: 1, set: {wall.clock: slow}}", ""), own),
                     {"device.x": 1e-3}, [4e-4])  # fmt: skip
    assert ticked_["wall.y"] == pytest.approx(4e-4 + 100 * 1e-3 * (1e-3 - 4e-4), rel=1e-15)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("interval(cloc)", "E303 Filtered has no interval(cloc); the nearest is interval(clock)."),
        ("interval(2*corner)", "E325 interval wants the name of a clock, got 2*corner."),
        ("interval()", "E325 interval wants 1 argument, got 0."),
        ("stiffness*interval(clock)/stiffness^2", "E401 "),
    ],
)
def test_what_is_no_clock_has_no_interval(written: str, said: str, tmp_path: Path) -> None:
    own = library(tmp_path, FILTER.replace("corner*interval(clock)", f"corner*{written}"))
    assert said in told(lambda: scene(FILTERED, own))[0]


def test_no_component_of_the_library_asks_for_a_copy_of_a_period() -> None:
    found = Library()
    for name in found.component_names:
        component = found.component(name)
        assert component is not None
        assert component.parameter("period") is None
