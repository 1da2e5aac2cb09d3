"""Contacts that open and close at will or by their depth: closed forms, and scenes played by hand."""

from __future__ import annotations

import math
import re

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

import apc
from apc.analysis.switching import CANNOT, OPEN, STABLE
from apc.compiler.compiled import CompiledSystem
from tests.topologies import SCENES, compiled, replaced, wall

Floats = NDArray[np.float64]

TICK = 1e-3
CONTACT = "type: OneSidedContact, a: device, b: cube, half_width: 20 mm, stiffness: 100 N/m"
HELD = f"""\
topology: held
clocks: {{haptic: 1 ms, network: 8 ms}}
peers:
  user: {{count: 3}}
masses:
  device: {{mass: 0.1 kg, damping: 5 N*s/m}}
  cube: {{mass: 0.6 kg, damping: 5 N*s/m, shared: true}}
couplers:
  contact: {{{CONTACT}, clock: haptic, delay: 1 ms}}
  tie: {{type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, delay: 1 ms, link: lan}}
links:
  lan: {{clock: network, delay: 8 ms}}
hands:
  arm: {{type: SpringDamperArm, flange: device, stiffness: 100 N/m, damping: 3 N*s/m}}
"""


ARM = HELD[HELD.index("hands:") :]


def scene(count: int, tie: float, contact: float, damping: float = 0.0) -> CompiledSystem:
    """Return users who hold their devices and may touch copies of 0.2 kg."""
    return compiled(
        replaced(
            HELD,
            ("count: 3", f"count: {count}"),
            ("0.6 kg", f"{0.2 * count} kg"),
            ("500 N/m", f"{tie!r} N/m"),
            ("stiffness: 100 N/m", f"stiffness: {contact!r} N/m, damping: {damping} N*s/m"),
        )
    )


def step() -> Floats:
    """Return what a tick makes of (x, v, x_O, v_O) under a held contact force and a held tie."""
    rates = np.zeros((6, 6))
    rates[0, 1] = rates[2, 3] = 1.0
    rates[1, [0, 1, 4]] = -1000, -80, -10
    rates[3, [3, 4, 5]] = -25, 5, -5
    return np.asarray(expm(rates * TICK)[:4])


def frame(peers: Floats, count: int, closed: Floats | None, tie: float, contact: float, damping: float = 0.0) -> Floats:  # noqa: E501 # fmt: skip
    """Return what a frame makes of (x, v, x_O, v_O), both forces and the packet before (7, count, many).

    `closed` says of each tick which contacts push and pull; without it those do that are deep, by 20 mm at 0.
    """
    moved, heard, peers = step(), peers[6].copy(), peers.copy()
    peers[6] = peers[2]
    for tick in range(8):
        depth = peers[0] - peers[2]
        if closed is None:
            push = contact * np.maximum(0.02 + depth, 0)
        else:
            push = (contact * depth + damping * (peers[1] - peers[3])) * closed[tick][:, None]
        pull = tie * (peers[2] - (heard.sum(axis=0) - heard) / (count - 1))
        peers[:4] = np.einsum("ij,jpm->ipm", moved, peers[:6])
        peers[4], peers[5] = push, pull  # a tick later they act
    return peers


def growth(count: int, patterns: Floats, tie: float, contact: float, damping: float = 0.0) -> float:
    """Return what patterns of contacts (frames, 8, count) that repeat make a motion grow by a frame."""
    moved = np.eye(7 * count).reshape(7, count, -1)
    for closed in patterns:
        moved = frame(moved, count, closed, tie, contact, damping)
    return float(np.abs(np.linalg.eigvals(moved.reshape(7 * count, -1))).max()) ** (1 / len(patterns))


def by_turns(closed: int, opened: int, count: int) -> Floats:
    """Return the frames of a period in which all contacts are closed for some ticks and open for some."""
    length = closed + opened
    ticks = np.arange(8 * length // math.gcd(length, 8)) % length < closed
    return np.repeat(ticks.reshape(-1, 8, 1), count, axis=2).astype(float)


@pytest.mark.parametrize(
    ("mass", "damping", "delay"), [(0.1, 5.0, 0.0), (0.1, 5.0, 1e-3), (0.3, 2.0, 2.5e-3), (1.0, 20.0, 1e-3)]
)
def test_a_wall_may_be_switched_as_far_as_its_closed_form_says(
    mass: float, damping: float, delay: float
) -> None:
    # Position over force is 1/(s (m s + b)) behind a hold and a delay: with the drift taken out its real part
    # is least at 0 Hz, −(m/b² + (T/2 + delay)/b); times the stiffness that must stay above −1.
    most = 1 / (mass / damping**2 + (TICK / 2 + delay) / damping)
    below, above = (apc.switching(wall(mass, damping, delay, part * most)) for part in (0.999, 1.001))
    assert below.verdict == STABLE and below.stable
    assert below.reach == pytest.approx(1 / 0.999, rel=1e-9)
    assert above.reach == pytest.approx(1 / 1.001, rel=1e-9)
    assert above.verdict == OPEN and above.stable is None and "circle criterion fails" in above.reason


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("count", "tie", "damping"),
    [(2, 200.0, 0.0), (3, 200.0, 0.5), (3, 60.0, 0.0), (3, 400.0, 0.0), (2, 25.0, 0.5)],
)
def test_what_is_proved_never_grows_whatever_switches(count: int, tie: float, damping: float) -> None:
    reach = apc.switching(scene(count, tie, 100.0, damping)).reach
    assert reach is not None
    stiffness = 0.99 * reach * 100 if not damping else 100.0
    found = apc.switching(scene(count, tie, stiffness, damping))
    assert found.stable and found.verdict == STABLE
    # What a damped contact pushes by jumps as it opens, and need not come to rest.
    assert found.settles is (not damping) and (found.jumps == "contact.push") is bool(damping)
    random = np.random.default_rng(1)
    patterns = [
        *(
            (random.random((random.integers(1, 6), 8, count)) < random.random()).astype(float)
            for _ in range(20)
        ),
        *(by_turns(*turns, count) for turns in ((3, 5), (16, 25), (20, 20), (1, 7))),
    ]
    assert max(growth(count, one, tie, stiffness, damping) for one in patterns) <= 1 + 1e-9


@pytest.mark.parametrize("damping", [0.0, 0.5])
def test_a_pattern_that_is_told_to_grow_does_so_by_as_much(damping: float) -> None:
    found = apc.switching(scene(3, 500.0, 1000.0, damping))
    assert found.verdict == CANNOT and found.stable is False
    told = re.search(
        r"closed for (\d+) ticks and open for (\d+) ticks by turns it grows by ([\d.]+)", found.reason
    )
    assert told
    truth = growth(3, by_turns(int(told[1]), int(told[2]), 3), 500.0, 1000.0, damping)
    assert float(told[3]) == pytest.approx(truth, rel=1e-5) and truth > 1.01


@pytest.mark.few(2)
@pytest.mark.parametrize(("count", "stiffness"), [(3, 200.0), (2, 1000.0), (3, 1000.0), (3, 2200.0)])
def test_what_is_proved_to_settle_comes_to_rest_though_a_pattern_at_will_may_grow(
    count: int, stiffness: float
) -> None:
    tie = {2: 200.0, 3: 500.0}[count]
    found = apc.switching(scene(count, tie, stiffness))
    assert found.settles and found.stable is (False if stiffness > 300 else None)
    assert "it is proved to come to rest" in " ".join(str(found).split())
    sizes = np.array([0.05, 0.5, 0.05, 0.5, 0, 0, 0])[:, None, None]
    peers = sizes * np.random.default_rng(2).normal(size=(7, count, 8))
    for _ in range(3000):
        before, peers = peers, frame(peers, count, None, tie, stiffness)
    assert np.abs(peers - before)[:4].max() < 1e-9


@pytest.mark.parametrize("part", [0.5, 0.98, 1.01])
def test_a_wall_settles_nearly_as_far_as_it_is_stable_when_always_touched(part: float) -> None:
    # Closed for ever: x⁺ of a device under a held force, which is K times the sample of a tick before.
    most = apc.critical(compiled(replaced(
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        "masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}\ncouplers: {it: {type: SampledSpringDamper, "
        "a: device, b: ground, clock: tick, stiffness: 100 N/m, delay: 1 ms}}\n"
    )), "it.stiffness", upper="9 kN/m").value  # fmt: skip
    found = apc.switching(wall(0.1, 5.0, TICK, part * (most or 0.0)))
    assert found.settles is (part < 1) and found.stable is not True


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("change", "stiffness"),
    [
        (("  user: {count: 3}", "  one: {count: 1}\n  two: {count: 2}"), 125.0),
        (("  user: {count: 3}", "  one: {count: 1}\n  two: {count: 2, set: {contact.side: right}}"), 2000.0),
        (
            (
                "OneSidedContact, a: device, b: cube, half_width: 20 mm",
                "ForceSaturation, a: device, b: cube, limit: 2 N",
            ),
            100.0,
        ),
        (("delay: 8 ms}", "delay: 8 ms, graph: ring}"), 100.0),
        (("delay: 8 ms}", "delay: 8 ms, graph: {edges: [[1, 2], [2, 3], [3, 1]]}}"), 100.0),
    ],
)
def test_another_way_to_write_a_scene_is_judged_alike(change: tuple[str, str], stiffness: float) -> None:
    one, other = (
        apc.switching(compiled(text), set={"contact.stiffness": f"{stiffness} N/m"})
        for text in (HELD, replaced(HELD, change))
    )
    assert one.verdict == other.verdict
    assert one.reach == pytest.approx(other.reach, rel=1e-9)


@pytest.mark.parametrize(
    ("change", "reason"),
    [
        (
            (
                CONTACT,
                CONTACT[6:]
                .replace("OneSided", "type: SampledHuntCrossley")
                .replace("half_width: 20 mm, ", "")
                .replace("N/m", "N/m^(3/2)"),
            ),
            "not known when",
        ),
        ((ARM, ""), "with all contacts open, what may drift is of several modes"),
        (
            ("delay: 8 ms}", "delay: 8 ms, loss: 1 %}"),
            "packets may be lost or late, and it is looked for on time only",
        ),
    ],
)
def test_what_is_not_decided_says_so(change: tuple[str, str], reason: str) -> None:
    found = apc.switching(compiled(replaced(HELD, change)), set={})
    assert (found.verdict, found.stable) == (OPEN, None) or "drift" in reason
    assert found.stable is not True and reason in found.reason


def test_an_unstable_mode_of_contact_rules_it_out() -> None:
    for name, reason in (
        ("average", "it is not stable when on at no peer or on at right alone"),
        ("mesh", "it is not stable in any mode"),
    ):
        found = apc.switching(SCENES / f"experiment-{name}.yaml")
        assert (found.stable, found.reason) == (False, reason)
