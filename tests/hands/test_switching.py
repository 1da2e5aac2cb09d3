"""Contacts that open and close at will: a closed form, and patterns multiplied by hand."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.linalg import expm

import apc
from apc.compiler.compiled import Model
from apc.extensions.switching.arbitrary_switching import SwitchingVerdict
from tests.topologies import TOPOLOGIES, compiled, replaced, wall

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


def topology(count: int, tie: float, contact: float, damping: float = 0.0) -> Model:
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


def frame(peers: Floats, count: int, closed: Floats, tie: float, contact: float, damping: float) -> Floats:
    """Return what a frame makes of (x, v, x_O, v_O), both forces and the packet before (7, count, many).

    `closed` says of each tick which contacts push and pull.
    """
    moved, received, peers = step(), peers[6].copy(), peers.copy()
    peers[6] = peers[2]
    for tick in range(8):
        depth = peers[0] - peers[2]
        push = (contact * depth + damping * (peers[1] - peers[3])) * closed[tick][:, None]
        pull = tie * (peers[2] - (received.sum(axis=0) - received) / (count - 1))
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


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("mass", "damping", "delay"), [(0.1, 5.0, 0.0), (0.1, 5.0, 1e-3), (0.3, 2.0, 2.5e-3), (1.0, 20.0, 1e-3)]
)
def test_a_wall_may_be_switched_as_far_as_its_closed_form_says(
    mass: float, damping: float, delay: float
) -> None:
    # Position over force is 1/(s (m s + b)) behind a hold and a delay: with the drift taken out its real part
    # is least at 0 Hz, −(m/b² + (T/2 + delay)/b); times the stiffness that must stay above −1.
    most = 1 / (mass / damping**2 + (TICK / 2 + delay) / damping)
    below, above = (
        apc.arbitrary_switching(wall(mass, damping, delay, part * most)) for part in (0.999, 1.001)
    )
    assert below.verdict is SwitchingVerdict.STABLE and below.stable
    assert below.reach == pytest.approx(1 / 0.999, rel=1e-9)
    assert above.reach == pytest.approx(1 / 1.001, rel=1e-9)
    assert (
        above.verdict is SwitchingVerdict.OPEN
        and above.stable is None
        and "circle criterion fails" in above.reason
    )


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("count", "tie", "damping"),
    [(2, 200.0, 0.0), (3, 200.0, 0.5), (3, 60.0, 0.0), (3, 400.0, 0.0), (2, 25.0, 0.5)],
)
def test_what_is_proved_never_grows_whatever_switches(count: int, tie: float, damping: float) -> None:
    reach = apc.arbitrary_switching(topology(count, tie, 100.0, damping)).reach
    assert reach is not None
    stiffness = 0.99 * reach * 100 if not damping else 100.0
    found = apc.arbitrary_switching(topology(count, tie, stiffness, damping))
    assert found.stable and found.verdict is SwitchingVerdict.STABLE
    random = np.random.default_rng(1)
    patterns = [
        *(
            (random.random((random.integers(1, 6), 8, count)) < random.random()).astype(float)
            for _ in range(20)
        ),
        *(by_turns(*turns, count) for turns in ((3, 5), (16, 25), (20, 20), (1, 7))),
    ]
    assert max(growth(count, one, tie, stiffness, damping) for one in patterns) <= 1 + 1e-9


@pytest.mark.few(1)
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
def test_another_way_to_write_a_topology_is_judged_alike(change: tuple[str, str], stiffness: float) -> None:
    one, other = (
        apc.arbitrary_switching(compiled(text), params={"contact.stiffness": f"{stiffness} N/m"})
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
        ((ARM, ""), "with all contacts open, free rigid-body motions belong to several modes"),
        (
            ("delay: 8 ms}", "delay: 8 ms, loss: 1 %}"),
            "the criterion is available for the nominal network only",
        ),
    ],
)
def test_what_is_not_decided_says_so(change: tuple[str, str], reason: str) -> None:
    found = apc.arbitrary_switching(compiled(replaced(HELD, change)), params={})
    assert (found.verdict, found.stable) == (SwitchingVerdict.OPEN, None) or "drift" in reason
    assert found.stable is not True and reason in found.reason


def test_an_unstable_mode_of_contact_rules_it_out() -> None:
    for name, reason in (
        ("average", "it is not stable when on at no peer or on at right alone"),
        ("mesh", "it is not stable in any mode"),
    ):
        found = apc.arbitrary_switching(TOPOLOGIES / f"experiment-{name}.yaml")
        assert (found.stable, found.reason) == (False, reason)
