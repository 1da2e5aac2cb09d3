"""Schemes of the library that no frame stands for: played, against their laws by hand and against energy.

Energy is weighed from outside: what hands put in, less what moves, whatever the scheme says of itself.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from tests.schemes import ByHand, everybody, magnitudes, mean, played
from tests.topologies import TOPOLOGIES, compiled, replaced

Floats = NDArray[np.float64]
Packets = dict[int, Sequence[Any]]

TICK = 1e-3
# Of positions of some millimetres after hundreds of ticks in floats.
SAME = 1e-10


def topology(name: str) -> str:
    return (TOPOLOGIES / f"{name}.yaml").read_text(encoding="utf-8")


def run_of(text: str, duration: str, *signals: str) -> apc.Trajectory:
    return apc.simulate(compiled(text), duration=duration, signals=signals or ["*.x", "*.v"], jit=False)


def of_all(run: apc.Trajectory, name: str) -> list[Floats]:
    """Return a signal of every peer, in their order."""
    return [run[one.name] for one in run.signals if one.name.endswith(f".{name}")]


def same(run: apc.Trajectory, expected: Floats, *bodies: str) -> None:
    """Compare the positions of all peers' bodies with those played by hand, and see that they move."""
    by_body = [of_all(run, f"{body}.x") for body in bodies]
    found = np.array([one for own in zip(*by_body, strict=True) for one in own]).T
    assert np.ptp(expected, axis=0).min() > 1e-4
    assert found[: len(expected)] == pytest.approx(expected, abs=SAME)


def paid(debt: float, step: float, largest: float) -> float:
    """Return the damping that takes an energy within a tick, if the next step is as long as the last."""
    if debt * TICK > largest * step**2:
        return largest
    return debt * TICK / step**2 if debt > 0 else 0.0


# ---- one port ----

WALL = topology("stiff-wall-passivity")


@pytest.mark.parametrize("largest", [0.0, 2.0, 30.0])
def test_passivity_controller_is_its_law(largest: float) -> None:
    """A device on a spring bounces in and out of the wall; at 2 N·s/m the limit is met again and again."""

    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        before, energy, force = memory
        step = x[0][0] - before
        energy += force * step
        force = max(0.0, 8000 * x[0][0]) + paid(-energy, step, largest) * step / TICK
        return [-force], [x[0][0], energy, force], []

    text = replaced(
        WALL,
        ("largest: 30", f"largest: {largest}"),
        (
            "type: ConstantForce, flange: device, force: 2 N",
            "type: SpringDamperArm, flange: device, stiffness: 100 N/m",
        ),
    )
    hand = ByHand([[(0.1, 0.2, 100.0)]], [[]], law, first_sent=0, memory=3, comp=0)
    same(run_of(text, "500 ms"), played(hand, [[(-0.01, 0.0)]], [[-0.01, 0.0, 0.0]], 500), "device")


# ---- two ports ----

TWO = topology("two-users-passivity")
COPIES = """\
topology: two-copies
clocks: {haptic: 1 ms, network: 8 ms}
peers: {left: {count: 1, set: {push.force: 1 N}}, right: {count: 1}}
masses: {cube: {mass: 1 kg}}
couplers:
  it: {type: TYPE, object: cube, stiffness: 500 N/m, clock: haptic, link: lan}
links: {lan: {clock: network, delay: 50 ms}}
hands: {push: {type: ConstantForce, flange: cube, force: 0 N}}
"""


def contact(x: Sequence[tuple[Any, Any]]) -> Any:
    return 1000 * (x[0][0] - x[1][0])


@pytest.mark.few(2)
@pytest.mark.parametrize(("delay", "largest"), [(0, 30.0), (50, 30.0), (50, 3.0), (200, 30.0)])
def test_passivity_controlled_average_is_its_law(delay: int, largest: float) -> None:
    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        before, used, given, saved, pull, brake, *acting = memory
        step = x[1][0] - before
        used += max(0.0, acting[0] * step)
        given += max(0.0, -acting[0] * step)
        saved += acting[1] * step
        extra = paid(given - saved - mean(received, 2), step, largest)
        now = 500 * (x[1][0] - mean(received, 0))
        damped = extra * step / TICK
        push = contact(x)
        # What was computed at the tick before acts from now on.
        stored = [x[1][0], used, given, saved, now, damped, pull, brake]
        return [-push, push - now - damped], stored, [used]

    text = replaced(
        TWO,
        ("largest: 30", f"largest: {largest}"),
        ("delay: 50 ms", f"delay: {delay} ms"),
        ("push.force: 2 N", "push.force: 0 N, device.x: 20 mm"),
    )
    body = [(0.1, 5.0 + 2.0, 100.0), (0.3, 1.0, 0.0)]
    hand = ByHand([body] * 2, everybody(2), law, first_sent=1, memory=8, out=1, late=delay)
    starts = [[(0.02, 0.0), (0.0, 0.0)], [(0.0, 0.0)] * 2]
    same(run_of(text, "600 ms"), played(hand, starts, [[0.0] * 8] * 2, 600), "device", "cube")


# ---- set positions ----


@pytest.mark.few(1)
@pytest.mark.parametrize("delay", [0, 50, 200])
@pytest.mark.parametrize("energy", [1e-5, 10.0])
def test_set_position_modulation_gives_no_energy(delay: int, energy: float) -> None:
    """Σ m v²/2 + K (x − goal)²/2 + kept + on its way never grows, whatever the delay, packets lost or not.

    It begins as what the copies are apart and what is kept. Between ticks the damper takes at least what is
    harvested, by Cauchy and Schwarz; at ticks nothing is made.
    """
    text = replaced(
        COPIES.replace("haptic, link", "haptic, damping: 2 N*s/m, link"),
        ("TYPE", "SetPositionModulation, ceiling: 0.02 J"),
        ("push.force: 1 N", "push.force: 0 N, cube.x: 10 mm, it.x: 10 mm, it.goal: 10 mm"),
        ("delay: 50 ms", f"delay: {delay} ms, loss: 20 %"),
        ("link: lan}", f"link: lan, energy: {energy} J}}"),
    )
    run = run_of(text, "3 s", "*")
    x, v = np.array(of_all(run, "cube.x")), np.array(of_all(run, "cube.v"))
    goal, stored, spare, received = (
        np.array(of_all(run, f"it.{one}")) for one in ("goal", "energy", "surplus", "received")
    )
    # What is told at a row is that of the tick before: as it stands there, after that tick.
    x, v = x[:, :-1], v[:, :-1]
    goal, stored, spare, received = goal[:, 1:], stored[:, 1:], spare[:, 1:], received[:, 1:]
    total = (v**2 / 2 + 250 * (x - goal) ** 2 + stored + spare - received[::-1]).sum(axis=0)
    assert total[0] <= 2 * energy + 1e-12
    assert np.diff(total).max() <= 1e-15 + 1e-13 * total[0]
    assert np.ptp(x) > 1e-3
    assert (stored >= 0).all()
    assert (np.diff(spare) >= 0).all()


def test_set_position_modulation_with_energy_enough_is_a_spring_and_damper() -> None:
    """A million joules are never used up: then the goal is what is heard, and the law is linear."""

    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        return [500 * mean(received, 0)], memory, []

    text = replaced(
        COPIES.replace("haptic, link", "haptic, damping: 6 N*s/m, link"),
        ("TYPE", "SetPositionModulation, energy: 1e6 J, ceiling: 1e7 J"),
    )
    hand = ByHand([[(1.0, 6.0, 500.0)]] * 2, everybody(2), law, first_sent=0, late=50, comp=0)
    found = apc.analyze(compiled(text))
    assert found.spectral_radius == pytest.approx(magnitudes(hand)[1], abs=1e-10)
    assert found.linearized


# ---- send on change ----

RECKONED = topology("two-users-dead-reckoning")


@pytest.mark.few(3)
@pytest.mark.parametrize("threshold", [0.0, 1e-4])
@pytest.mark.parametrize("delay", [0, 8, 48])
def test_dead_reckoning_is_its_law(delay: int, threshold: float) -> None:
    """The hearer knows when a packet was sent: it goes on from there by its age at each tick."""

    def law(_: int, x: Sequence[tuple[Any, Any]], received: Packets, memory: Sequence[Any]) -> Any:
        course, reported, packets = memory
        by_then = course + TICK * reported
        if packets and abs(x[1][0] - by_then) < threshold:
            course = by_then
        else:
            course, reported, packets = *x[1], packets + 1
        ((_, _, line, speed, age),) = received.values()
        ahead = line + age * speed
        pull = 200 * (x[1][0] - ahead) + 5 * (x[1][1] - speed)
        push = contact(x)
        return [-push, push - pull], [course, reported, packets], [course + TICK * reported, reported]

    text = replaced(
        RECKONED,
        ("late: 8 ms", f"late: {delay} ms"),
        ("threshold: 0.1 mm", f"threshold: {threshold} m"),
        ("push.force: 2 N", "push.force: 0 N, device.x: 20 mm"),
    )
    body = [(0.1, 5.0 + 2.0, 100.0), (0.3, 5.0, 0.0)]
    hand = ByHand([body] * 2, everybody(2), law, first_sent=1, memory=3, out=2, late=delay)
    starts = [[(0.02, 0.0), (0.0, 0.0)], [(0.0, 0.0)] * 2]
    same(run_of(text, "500 ms"), played(hand, starts, [[0.0] * 3] * 2, 500), "device", "cube")


# ---- god-object ----

ROUGH, LOCATION = topology("god-object"), "table.god_object"


@pytest.mark.parametrize("sideways", [0.0, 0.8, -0.99, 1.3, -2.0])
def test_a_god_object_sticks_within_its_cone_and_slides_beyond(sideways: float) -> None:
    """|F_t| < μ |F_n|: the device rests F_t/K from where the god-object sticks, F_n/K deep.

    Beyond it slides in the end at (|F_t| − μ |F_n|)/b, the god-object μ times the depth behind.
    """
    text = replaced(ROUGH, ("force: [0.8 N, -2 N]", f"force: [{sideways} N, -2 N]"))
    run = run_of(text, "2 s", "*")
    x, y, v, stuck = (
        run[f"user[1].{one}"] for one in ("device.x[1]", "device.x[2]", "device.v[1]", LOCATION)
    )
    assert y[-1] == pytest.approx(-2 / 1000, abs=1e-9)
    if abs(sideways) < 0.5 * 2:
        assert x[-1] - stuck[-1] == pytest.approx(sideways / 1000, abs=1e-9)
        assert stuck[-1] == stuck[-200]
    else:
        assert v[-1] == pytest.approx(math.copysign((abs(sideways) - 0.5 * 2) / 5, sideways), abs=1e-9)
        assert x[-2] - stuck[-1] == pytest.approx(math.copysign(0.5 * 2 / 1000, sideways), abs=1e-9)


# ---- a motor's limit ----

LIMITED = replaced(topology("limited-motor"), ("type: RampForce", "type: ConstantForce"), (", rise: 1 s", ""))


@pytest.mark.whole
def test_limited_motor_holds_up_to_its_limit_and_gives_way_beyond() -> None:
    """3 N rest 3/500 m deep; of 5 N the motor takes 3.3 N, and the damper the rest: (5 − 3.3)/b."""
    held = run_of(replaced(LIMITED, ("force: 5 N", "force: 3 N")), "2 s")
    assert held["user[1].device.x"][-1] == pytest.approx(3 / 500, abs=1e-9)
    beyond = run_of(LIMITED, "2 s")
    assert beyond["user[1].device.v"][-1] == pytest.approx((5 - 3.3) / 1, abs=1e-8)
