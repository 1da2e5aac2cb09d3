"""Claims about `apc.moments.errors` and `apc.moments.hands`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import Prepared, prepare
from apc.compiler.compiled import CompiledSystem
from apc.moments.errors import DRIFTING, Told, crowd_error, pattern_error, standing_error, tagged_error
from apc.moments.network import judge_network
from tests.pushed import Table, User
from tests.topologies import compiled, replaced

CONTACT = "type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic, delay: 1 ms"
COORDINATION = (
    "type: AveragePosition, object: cube, stiffness: 500 N/m, clock: haptic, delay: 1 ms, link: lan"
)
SCENE = f"""\
topology: pushed
clocks: {{haptic: 1 ms, network: 8 ms}}
peers:
  user: {{count: 3}}
masses:
  device: {{mass: 0.1 kg, damping: 5 N*s/m}}
  cube:   {{mass: 0.6 kg, damping: 5 N*s/m, shared: true}}
couplers:
  contact:      {{{CONTACT}}}
  coordination: {{{COORDINATION}}}
links:
  lan: {{clock: network, delay: 8 ms}}
"""
USER = "  user: {count: 3}\n"
GROUPS = """\
  left: {count: 2}
  right: {count: 1, set: {device.mass: 0.25 kg, coordination.stiffness: 700 N/m, contact.stiffness: 800 N/m}}
"""
NOW = Fraction(0)

BARE = [
    ("  device: {mass: 0.1 kg, damping: 5 N*s/m}\n", ""),
    (CONTACT, "type: SpringDamper, a: cube, b: ground, stiffness: 100 N/m, damping: 1 N*s/m"),
]

# Measured by independent programs: 1 N² a tick of 1 ms at each of N devices, K_T in N/m, no loss.
REFERENCES = (
    (3, 500, 0.00045741120952581685),
    (3, 900, 0.00050968295673221),
    (5, 900, 0.0004630448071397932),
    (2, 900, 0.0006146994924749179),
)


def pushed(
    link: str = "loss: 10 %", *changes: tuple[str, str], count: int = 3, stiffness: int = 500
) -> tuple[CompiledSystem, Prepared]:
    """Return the scene with a link that says more, and what analyses of it have in common."""
    own = [("delay: 8 ms}", f"delay: 8 ms, {link}}}")]
    own += [("500 N/m", f"{stiffness} N/m")] if stiffness != 500 else []
    own += [("count: 3", f"count: {count}")] if count != 3 else []
    system = compiled(replaced(SCENE, *own, *changes))
    return system, prepare(system)


def users(count: int, stiffness: float) -> tuple[User, ...]:
    return (User(0.6 / count, stiffness),) * count


def replace_in(system: CompiledSystem, **changes: Any) -> CompiledSystem:
    """Return the scene with another channel of its link."""
    (link,) = system.links
    assert link.channel is not None
    return replace(system, links=(replace(link, channel=replace(link.channel, **changes)),))


def metres(told: Told) -> float:
    assert told.metres is not None, told.why
    return told.metres


@pytest.mark.parametrize(("count", "stiffness", "expected"), REFERENCES)
@pytest.mark.parametrize("link", ["loss: 0 %", "jitter: 0 ms", "loss: 0 %, on_loss: zero"])
def test_with_no_loss_the_error_is_that_of_an_ideal_network(
    count: int, stiffness: int, expected: float, link: str
) -> None:
    found = crowd_error(*pushed(link, count=count, stiffness=stiffness))
    assert metres(found) == pytest.approx(expected, rel=1e-9)


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("count", "stiffness", "loss"), [(2, 900, 0.1), (2, 500, 0.4), (3, 500, 0.1), (3, 900, 0.4)]
)
@pytest.mark.parametrize("zero", [False, True])
def test_under_independent_loss_it_is_that_of_all_patterns_one_by_one(
    count: int, stiffness: int, loss: float, zero: bool
) -> None:
    text = f"loss: {loss}, on_loss: {'zero' if zero else 'hold'}"
    system, prepared = pushed(text, count=count, stiffness=stiffness)
    found = standing_error(system, prepared, NOW) if zero else crowd_error(system, prepared)
    expected = Table(users(count, stiffness), loss, 1 - loss, zero).rms()
    assert metres(found) == pytest.approx(expected[0], rel=1e-10)


@pytest.mark.parametrize(("count", "zero"), [(2, False), (2, True), (3, True)])
def test_under_bursts_it_is_that_of_all_patterns_one_by_one(count: int, zero: bool) -> None:
    text = f"loss: {{p: 0.03, r: 0.3}}, on_loss: {'zero' if zero else 'hold'}"
    found = pattern_error(*pushed(text, count=count), NOW)
    expected = Table(users(count, 500), 0.03, 0.3, zero).rms()
    assert metres(found) == pytest.approx(expected[0], rel=1e-10)


@pytest.mark.parametrize("count", [2, 3])
def test_under_bursts_between_equal_peers_all_tags_tell_the_same(count: int) -> None:
    system, prepared = pushed("loss: {p: 0.03, r: 0.3}", count=count)
    expected = Table(users(count, 500), 0.03, 0.3).rms()
    found = tagged_error(system, prepared, NOW, (count * (count - 1),))
    assert found.why == ""
    assert metres(found) == pytest.approx(expected[0], rel=1e-10)


def test_fewer_tags_than_channels_tell_an_estimate_that_is_called_one() -> None:
    system, prepared = pushed("loss: {p: 0.03, r: 0.3}")
    exact = metres(tagged_error(system, prepared, NOW, (6,)))
    rough, near = (metres(tagged_error(system, prepared, NOW, (order,))) for order in (1, 2))
    assert 1e-4 * exact > abs(rough - exact) > 10 * abs(near - exact)
    both = tagged_error(system, prepared, NOW, (1, 2))
    assert both.metres == near
    assert both.why == (
        f"an estimate: moments of at most 2 channels' states together; with 1 it is {rough:.9g} m"
    )


@pytest.mark.parametrize("zero", [False, True])
def test_of_different_peers_it_is_the_largest(zero: bool) -> None:
    text = f"loss: 10 %, on_loss: {'zero' if zero else 'hold'}"
    system, prepared = pushed(text, (USER, GROUPS))
    found = standing_error(system, prepared, NOW) if zero else crowd_error(system, prepared)
    peers = (User(0.2, 500), User(0.2, 500), User(0.2, 700, 0.25, 800))
    expected = Table(peers, 0.1, 0.9, zero).rms()
    assert expected[2] < expected[0] == pytest.approx(expected[1], rel=1e-9)
    assert metres(found) == pytest.approx(expected[0], rel=1e-10)


def test_on_a_line_it_is_that_of_all_patterns_one_by_one() -> None:
    edges = "graph: {edges: [[1, 2], [2, 3]]}"
    found = crowd_error(*pushed(f"loss: 20 %, {edges}"))
    expected = Table(users(3, 500), 0.2, 0.8, ways=((0, 1), (1, 0), (1, 2), (2, 1))).rms()
    assert metres(found) == pytest.approx(max(expected), rel=1e-10)


@pytest.mark.parametrize("delay", ["5 ms", "4.5 ms", "13 ms"])
def test_it_does_not_hang_on_when_frames_are_said_to_begin(delay: str) -> None:
    # Packets are due within a frame: patterns begin theirs there, in the middle of a push or not.
    system, prepared = pushed(
        "loss: 20 %", ("lan: {clock: network, delay: 8 ms", f"lan: {{clock: network, delay: {delay}"), count=2
    )
    first = Fraction(delay.split()[0]) / 1000 % Fraction(8, 1000)
    found = pattern_error(system, prepared, first)
    assert metres(found) == pytest.approx(metres(crowd_error(system, prepared)), rel=1e-10)
    zero = replace_in(system, on_loss="zero")
    found = standing_error(zero, prepare(zero), first)
    assert metres(found) == pytest.approx(metres(pattern_error(zero, prepare(zero), first)), rel=1e-10)


def test_by_chance_it_is_as_it_is_on_the_mean() -> None:
    found = metres(crowd_error(*pushed("loss: 30 %", count=2)))
    squares = Table(users(2, 500), 0.3, 0.7).played(frames=400, runs=400, seed=1)
    assert abs(squares.mean() - found**2) < 4 * squares.std() / np.sqrt(len(squares))


def test_under_jitter_it_is_what_a_play_of_late_packets_finds() -> None:
    found = metres(crowd_error(*pushed("jitter: 6 ms", count=3, stiffness=700)))
    standing = crowd_error(*pushed("loss: 0 %, jitter: 6 ms, on_loss: zero", count=3, stiffness=700))
    assert metres(standing) == pytest.approx(found, rel=1e-12)  # nothing is missed
    squares = Table(users(3, 700), 0.0, 1.0).played_late(0.006, frames=200, runs=400, seed=1)
    assert abs(squares.mean() - found**2) < 4 * squares.std() / np.sqrt(len(squares))


@pytest.mark.parametrize("zero", [False, True])
def test_a_million_users_cost_what_three_do(zero: bool) -> None:
    """Each then follows a mean that the others hardly move: the error is that of a user held by a spring."""

    def error(count: int) -> float:
        change = ("mass: 0.6 kg", f"mass: {0.2 * count:.1f} kg")
        system, prepared = pushed(f"loss: 10 %, on_loss: {'zero' if zero else 'hold'}", change, count=count)
        return metres(standing_error(system, prepared, NOW) if zero else crowd_error(system, prepared))

    near, far = error(10**3), error(10**6)
    assert near == pytest.approx(far, rel=1e-3)
    assert near != far


def test_a_force_moves_all_that_is_rigidly_connected_with_a_device() -> None:
    geared = ("couplers:\n", "couplers:\n  gear: {type: Gear, a: device, b: motor, ratio: RATIO}\n")
    motor = ("  cube:", "  motor: {mass: 80 g}\n  cube:")
    heavier = metres(crowd_error(*pushed("loss: 10 %", ("mass: 0.1 kg", "mass: 0.18 kg"))))
    both = crowd_error(*pushed("loss: 10 %", motor, (geared[0], geared[1].replace("RATIO", "1"))))
    assert metres(both) == pytest.approx(heavier, rel=1e-12)
    found = crowd_error(*pushed("loss: 10 %", motor, (geared[0], geared[1].replace("RATIO", "2"))))
    assert found.metres is None
    assert found.why == "device moves with masses that move otherwise, and a hand may hold any of them (user)"


@pytest.mark.parametrize(
    ("changes", "why"),
    [
        (BARE, "no peer holds anything but what it tells others about"),
        (
            [("  cube:", "  glove: {mass: 0.1 kg, damping: 1 N*s/m}\n  cube:")],
            "a hand may hold any of device, glove (user)",
        ),
    ],
)
def test_where_it_is_open_what_a_hand_holds_none_is_told(changes: list[tuple[str, str]], why: str) -> None:
    assert crowd_error(*pushed("loss: 10 %", *changes)) == Told(None, why)


def test_copies_that_nothing_holds_together_have_no_error() -> None:
    assert crowd_error(*pushed("loss: 10 %", ("500 N/m", "0 N/m"))) == Told(None, DRIFTING)


def test_a_verdict_tells_the_error_or_why_there_is_none() -> None:
    stable = judge_network(pushed("loss: 10 %")[0])
    assert stable is not None
    assert stable.rms_error_m == metres(crowd_error(*pushed("loss: 10 %")))
    shaking = judge_network(pushed("loss: 10 %", stiffness=2000)[0])
    assert shaking is not None
    assert shaking.rms_error_m is None
    assert "root mean square error of copies: only where second moments die out" in shaking.notes
    delays = np.array([0.008, 0.009])
    played = judge_network(replace_in(pushed("loss: 10 %")[0], loss=None, trace=delays))
    assert played is not None
    assert played.stable
    assert played.rms_error_m is None
    assert "root mean square error of copies: it is not worked out over recorded delays" in played.notes
