"""A topology that is linearized where it starts, and is not at rest there, says what moves it."""

from __future__ import annotations

import pytest

import apc
from tests.topologies import AVERAGE, compiled

# A device 0.2 m in a cube of 600 N/m: 120 N. `push` is what balances it, `held` that on the cube.
PRESSED = """\
topology: pressed
clocks: {{haptic: 1 ms}}
peers:
  left: {{count: 1}}
  right: {{count: 1, set: {{device.x: 21 mm}}}}
masses:
  device: {{mass: 0.1 kg, damping: 5 N*s/m}}
  cube: {{mass: 0.3 kg, damping: 5 N*s/m}}
couplers:
  contact: {{type: OneSidedContact, a: device, b: cube, side: right, half_width: 20 mm, stiffness: 600 N/m,
            clock: haptic, delay: 1 ms}}
hands:
  push: {{type: ConstantForce, flange: device, force: {push}}}
  held: {{type: ConstantForce, flange: cube, force: {held}}}
"""


def _pressed(push: str = "0 N", held: str = "0 N", left: str = "device.x: -180 mm") -> str:
    text = PRESSED.format(push=push, held=held)
    return text.replace("left: {count: 1}", f"left: {{count: 1, set: {{{left}}}}}")


def test_the_largest_force_that_nothing_balances_is_told_first_of_all() -> None:
    model = compiled(_pressed())
    first, second = apc.analyze(model).limitations
    assert first.startswith("the initial state is not at rest: 120 N acts on left.")
    assert "nonlinear topology" in second
    assert (
        str(apc.analyze(model)).splitlines()[1].strip().startswith("the initial state is not at rest: 120 N")
    )
    assert apc.analyze(model).to_dict()["limitations"] == [first, second]


def test_every_answer_that_holds_near_the_start_says_what_moves_there() -> None:
    model = compiled(_pressed())
    x, y = "contact.stiffness=500 N/m:700 N/m", "device.damping=4 N*s/m:6 N*s/m"
    found = (
        apc.critical(model, "contact.stiffness"),
        apc.transparency(model, [1.0], at="left[1].device", between="right[1].device"),
        apc.region(model, x=x, y=y),
        apc.analyze_many(model, {"contact.stiffness": [500.0]}),
    )
    for one in found:
        assert one.limitations[0].startswith("the initial state is not at rest: 120 N acts on left.")


@pytest.mark.parametrize("moved", ["-180 mm", "-17 cm"])
def test_of_forces_that_balance_nothing_is_said(moved: str) -> None:
    force = 600 * (0.02 - float(moved.split()[0]) * (0.001 if "mm" in moved else 0.01))
    balanced = f"device.x: {moved}, push.force: {-force} N, held.force: {force} N"
    [limitations] = apc.analyze(compiled(_pressed(left=balanced))).limitations
    assert "nonlinear topology" in limitations


def test_of_a_topology_whose_verdict_does_not_depend_on_the_start_nothing_is_said() -> None:
    pushed = AVERAGE.replace("device: {mass", "device: {x: 1 m, mass")
    assert apc.analyze(compiled(pushed)).limitations == ()
