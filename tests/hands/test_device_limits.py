"""Limits of devices: told by a simulation when they are broken, and kept by equations when asked."""

from __future__ import annotations

import math
from pathlib import Path

import pytest
import scipy.optimize

from apc.simulation.trajectory import parse_duration, simulate
from tests.topologies import compiled, library, messages_of, replaced

FALCON = """
topology: pushed
peers: {user: {count: 1}}
masses: {device: {type: Falcon}}
hands: {push: {type: ConstantForce, flange: device, force: 2 N}}
experiment: {duration: 1 s}
"""
PRESSED = """
topology: pressed
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {type: PhantomOmni, mass: 50 g, damping: 10 N*s/m, limits: on}}
couplers: {wall: {type: SampledSpringDamper, a: device, b: ground, stiffness: 400 N/m, clock: haptic}}
hands: {push: {type: ConstantForce, flange: device, force: 5 N}}
experiment: {duration: 1 s}
"""


def test_a_falcon_runs_as_it_is_and_leaves_its_reach_when_the_closed_form_does() -> None:
    """0.1 kg pushed by 2 N against 5 N·s/m: x = F/b (t − τ (1 − e^(−t/τ))), τ = m/b; its reach is 40 mm."""
    tau = 0.1 / 5

    def x(t: float) -> float:
        return 2 / 5 * (t + tau * math.expm1(-t / tau))

    leaves = scipy.optimize.brentq(lambda t: x(t) - 0.04, 0.01, 1)
    (found,) = simulate(compiled(FALCON)).summary.broken
    assert (found.signal, found.limit) == ("user[1].device.x", "device.position_limit")
    assert (found.value, found.unit) == (0.04, "m")
    assert found.first_s == pytest.approx(math.ceil(leaves * 1000) / 1000, abs=1e-9)  # a row every ms
    assert (found.most, found.at_s) == (pytest.approx(x(1.0), rel=1e-9), 1.0)


def test_motors_give_no_more_than_their_limit_and_stops_hold_the_rest() -> None:
    """Pushed by 5 N, motors at 3.3 N, the stop takes 1.7 N: at 0.1 m + 1.7 N/(10 kN/m)."""
    found = simulate(compiled(PRESSED), duration=parse_duration("3 s"))
    assert found["user[1].device.x"][-1] == pytest.approx(0.1 + 1.7 / 1e4, abs=1e-9)
    assert found["user[1].device.asked"][-1] == pytest.approx(-400 * (0.1 + 1.7 / 1e4), abs=1e-6)
    assert [one.limit for one in found.summary.broken] == ["device.force_limit", "device.position_limit"]


def test_limits_that_are_off_change_no_motion_and_are_told() -> None:
    off = replaced(PRESSED, (", limits: on", ""))
    mass = replaced(off, ("type: PhantomOmni, ", ""))
    one, other = simulate(compiled(off)), simulate(compiled(mass))
    assert one["user[1].device.x"] == pytest.approx(other["user[1].device.x"], abs=1e-14)
    assert other.summary.broken == ()
    (force,) = one.summary.broken  # at rest 5 N / 400 N/m = 12.5 mm deep, well within its reach
    assert (force.limit, force.value) == ("device.force_limit", 3.3)
    assert force.most == pytest.approx(float(abs(one["user[1].device.asked"]).max()))
    assert force.first_s == one.time[abs(one["user[1].device.asked"]) > 3.3][0]


def test_each_peer_has_limits_of_its_own() -> None:
    text = replaced(FALCON, ("count: 1", "set: {device.position_limit: [30 mm, 1 m, 50 mm]}"))
    found = simulate(compiled(text)).summary.broken
    assert [(one.signal, one.value) for one in found] == [
        ("user[1].device.x", 0.03),
        ("user[3].device.x", 0.05),
    ]


def test_only_hands_are_joined_to_the_grip_and_ask_nothing_of_the_motors() -> None:
    text = replaced(PRESSED, ("limits: on", "limits: off"), ("stiffness: 400 N/m", "stiffness: 0 N/m"))
    assert simulate(compiled(text))["user[1].device.asked"] == pytest.approx(0.0, abs=0.0)
    text = replaced(text, ("flange: device, force", "flange: device.flange, force"))
    assert simulate(compiled(text))["user[1].device.asked"] == pytest.approx(5.0, abs=1e-12)


SHOWN = """
component: Shown
connectors: {flange: PlanarFlange}
parameters: {most: {unit: m, default: 1 mm}}
variables: {seen: {unit: m, size: 2, limit: most}}
equations:
  - seen = flange.x
  - flange.f = {0, 0}
"""
PLANAR = """
topology: planar
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {type: PlanarMass, mass: 1 kg, damping: 1 N*s/m, x: [0 m, 2 mm]}}
couplers: {eye: {type: Shown, flange: device}}
experiment: {duration: 10 ms}
"""


def test_a_vector_stays_within_a_limit_entry_by_entry(tmp_path: Path) -> None:
    (found,) = simulate(compiled(PLANAR, library(tmp_path, SHOWN))).summary.broken
    assert (found.signal, found.limit, found.most) == ("user[1].eye.seen[2]", "eye.most", 0.002)


def test_what_a_clock_computes_can_have_no_limit(tmp_path: Path) -> None:
    part = replaced(SHOWN, ("= flange.x", "= sample(flange.x)"), ("{most:", "{clock: clock, most:"))
    text = replaced(PLANAR, ("flange: device}", "flange: device, clock: tick}"))
    [line] = messages_of(compiled, text, library(tmp_path, part))
    assert line.partition("yaml:")[2] == (
        "5:13: E513 limit of eye.seen[1]: expected a continuous variable, got one computed at ticks. "
        "Add acting = hold(seen) and declare the limit of acting."
    )
