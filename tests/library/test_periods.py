"""A component may ask for the period of its clock, which then follows what is set of the clock."""

from __future__ import annotations

from fractions import Fraction
from pathlib import Path

import pytest

import apc
from tests.library.parts import ticked
from tests.topologies import TOPOLOGIES, compiled, library, replaced

# What computes with the period of its clock, of the library.
PERIODS = [
    *(
        "finger",
        "limited-motor",
        "stiff-wall-passivity",
        "two-users-dead-reckoning",
        "two-users-filtered-waves",
    ),
    *("two-users-passivity", "two-users-reported", "two-users-set-position", "two-users-waves"),
]
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


def _set(model: apc.Model, clock: str, period: str) -> apc.Model:
    return apc.set_parameters(model, {f"{clock}.period": period})


def _motion(model: apc.Model) -> tuple[float, list[list[float]]]:
    """Return the spectral radius of a topology, and the rows of its first moments."""
    run = apc.simulate(model, duration="60 ms", jit=False)
    return apc.analyze(model).spectral_radius, run.values.tolist()


@pytest.mark.few(2)
@pytest.mark.parametrize("name", PERIODS)
def test_a_period_that_is_set_reaches_what_computes_with_it(name: str) -> None:
    """Set without compiling again it is as written in the file: motion and spectral radius."""
    text = (TOPOLOGIES / f"{name}.yaml").read_text(encoding="utf-8")
    period = "haptic: tick" if name == "finger" else "haptic: 1 ms"
    written = _motion(compiled(replaced(text, (period, "haptic: 2 ms"))))
    assert _motion(_set(compiled(text), "haptic", "2 ms")) == written
    assert written[1] != _motion(compiled(text))[1]


def test_a_filter_of_ones_own_has_the_period_of_the_clock_each_group_names(tmp_path: Path) -> None:
    own = library(tmp_path, FILTER)
    model = compiled(FILTERED, own)
    for clock, period, change in (
        ("haptic", "2 ms", ("haptic: 1 ms", "haptic: 2 ms")),
        ("slow", "4 ms", ("slow: 5 ms", "slow: 4 ms")),
    ):
        changed, written = _set(model, clock, period), compiled(replaced(FILTERED, change), own)
        assert _motion(changed) == _motion(written)
        stiffest = [apc.critical(one, "wall.stiffness").value for one in (changed, written)]
        assert stiffest[0] == stiffest[1]
    assert {one.name: one.exact for one in model.parameters if one.name.endswith(".period")} == {
        "haptic.period": Fraction(1, 1000),
        "slow.period": Fraction(1, 200),
    }
    # By hand, of the first group: y' = y + ω T (x - y) at each tick, acting half a tick later.
    alone = compiled(replaced(FILTERED, (", two: {count: 1, set: {wall.clock: slow}}", "")), own)
    found = ticked(alone, {"device.x": 1e-3}, [4e-4])
    assert found["wall.y"] == pytest.approx(4e-4 + 100 * 1e-3 * (1e-3 - 4e-4), rel=1e-15)
