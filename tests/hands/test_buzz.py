"""The buzz of one-sided contacts: the paper's experiment and a pressed wall, predicted and played."""

from __future__ import annotations

import math

import pytest

import apc
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, replaced

AT_ONCE = ("delay: 8 ms}            # negligible", "delay: 0 ms}            # negligible")
TEXT = {
    name: (TOPOLOGIES / f"experiment-{name}.yaml").read_text(encoding="utf-8") for name in ("average", "mesh")
}


def experiment(name: str, *pairs: tuple[str, str]) -> Model:
    return compiled(replaced(TEXT[name], *pairs))


@pytest.mark.whole
def test_the_buzz_of_the_experiment_is_predicted_and_played() -> None:
    """An independent program: predicted 47.10 Hz, 2.437 mm, 80.5 %; played 46.95 Hz, 2.545 mm, 79.3 %."""
    found = apc.limit_cycle(experiment("average", AT_ONCE))
    known = found.predicted
    assert known is not None and known.attracts
    assert known.frequency_hz == pytest.approx(47.10, abs=0.005)
    assert known.in_contact == pytest.approx(0.805, abs=5e-4)
    right, left, other = found.contacts
    assert right.name == "right[1].contact.push"
    assert right.predicted_depth_m == pytest.approx(2.437e-3, abs=5e-7)
    assert left.predicted_depth_m == pytest.approx(2.437e-3 / 2, abs=5e-7)
    # What hands push with, contacts bear on the mean.
    assert [one.load_n for one in found.contacts] == pytest.approx([4.0, 2.0, 2.0], rel=1e-6)
    # Three seconds hold 141 swings: they tell the frequency to some hundredths of 1 Hz, and it still grew
    # then by two parts in a thousand.
    assert len(found.lines) == 1 and found.steady and not found.notes
    assert found.lines[0].frequency_hz == pytest.approx(46.95, abs=0.05)
    assert right.depth_m == pytest.approx(2.545e-3, rel=2e-3)
    assert left.depth_m == other.depth_m == pytest.approx(1.273e-3, rel=2e-3)
    assert right.in_contact == pytest.approx(0.793, abs=5e-4)
    assert "right[1].contact.push: depth 2.437 mm 2.549 mm" in " ".join(str(found).split())
    # Contacts that never let go, weaker by the part of a swing in which these push, are marginal there.
    # Of a sinusoid it passes so much on: (θ − sin θ cos θ)/π with θ = π times that part.
    gain = known.in_contact - math.sin(2 * math.pi * known.in_contact) / (2 * math.pi)
    spring = (
        FORCE[:-6],
        f"SampledSpringDamper, a: device, b: cube, stiffness: {3900 * gain!r} N/m, damping: {0.05 * gain!r}",
    )
    sides = [(f"contact.side: {side}, ", "") for side in ("right", "left")]
    marginal = apc.analyze(experiment("average", AT_ONCE, spring, *sides))
    assert marginal.spectral_radius == pytest.approx(1.0, abs=1e-9)
    assert marginal.modes[0].frequency_hz == pytest.approx(known.frequency_hz, rel=1e-7)


@pytest.mark.whole
def test_what_is_not_one_cycle_that_motions_come_to_is_told() -> None:
    """Stable with contacts closed, unstable with weaker ones: from its start the topology settles."""
    leave = apc.limit_cycle(experiment("average"))
    assert leave.predicted is not None and not leave.predicted.attracts
    assert leave.lines == () and leave.steady and leave.bounded and leave.settles
    assert any("cycle is unstable" in text for text in leave.notes)
    mesh = apc.limit_cycle(experiment("mesh"))
    slow, fast = sorted(line.frequency_hz for line in mesh.lines)
    assert 37 < slow < 38 and 50 < fast < 51
    assert any("describing function does not apply" in text for text in mesh.notes)
    grows = apc.limit_cycle(experiment("mesh", AT_ONCE))
    assert grows.predicted is None and not grows.steady and grows.lines == ()
    assert grows.reason == "no limit cycle: unstable at every fraction of the contact stiffness"


WALL = """\
topology: pressed
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 2 N*s/m}}
couplers:
  it: {type: VirtualWall, flange: device, stiffness: 1500 N/m, clock: tick, delay: 1 ms}
hands: {hand: {type: ConstantForce, flange: device, force: 3 N}}
"""


@pytest.mark.whole
def test_a_wall_buzzes_under_the_hand_that_presses_it_and_a_hand_that_pulls_lets_go() -> None:
    found = apc.limit_cycle(compiled(WALL))
    assert found.predicted is not None and found.predicted.attracts
    # Alone: m s² + b s + g K e^{−s (T/2 + delay)} = 0 on the axis, but for what a hold is beside a delay.
    assert found.contacts[0].load_n == pytest.approx(3.0, rel=1e-6)
    assert found.lines[0].frequency_hz == pytest.approx(found.predicted.frequency_hz, rel=0.05)
    omega = 2 * math.pi * found.predicted.frequency_hz
    assert math.tan(omega * 1.5e-3) == pytest.approx(2 / (0.1 * omega), rel=0.02)
    away = apc.limit_cycle(compiled(WALL.replace("3 N}", "-1 N}").replace("N*s/m}", "N*s/m, x: 1 mm}")))
    assert (len(away.notes), away.lines, away.settles) == (1, (), False)


FORCE = "OneSidedContact, a: device, b: cube, half_width: 20 mm, stiffness: 3900 N/m, damping: 0.05 N*s/m"


@pytest.mark.needs_extension("switching")
@pytest.mark.parametrize(
    ("instead", "why"),
    [
        ("SampledHuntCrossleyContact, stiffness: 3900 N/m^(3/2), clock: haptic", "is not linear"),
        ("ForceSaturation, limit: 2 N, stiffness: 3900 N/m, clock: haptic", "also pulls"),
        ("HuntCrossleyContact, stiffness: 3900 N/m^(3/2)", "contact acts in continuous time"),
    ],
)
def test_what_is_no_one_sided_spring_from_tick_to_tick_is_refused_by_name(instead: str, why: str) -> None:
    sides = [(f"contact.side: {side}, ", "") for side in ("right", "left")]
    with pytest.raises(ApcError, match=r"E864 .*contact") as caught:
        apc.limit_cycle(
            experiment("average", *sides, (f"{FORCE}, clock: haptic", f"{instead}, a: device, b: cube"))
        )
    assert why in str(caught.value)


@pytest.mark.needs_extension("switching")
def test_what_cannot_be_played_is_refused_and_lost_packets_are_named() -> None:
    with pytest.raises(ApcError, match="no contact is closed"):
        apc.limit_cycle(compiled(AVERAGE))
    with pytest.raises(ApcError, match="1,000,000 peers are too many to simulate for 8 s"):
        apc.limit_cycle(compiled(replaced(WALL, ("count: 1", "count: 1000000"))))
