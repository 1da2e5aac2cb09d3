"""Claims about `apc.analysis.selfcheck`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest

from apc.analysis import selfcheck
from apc.analysis.selfcheck import check_frame, skipped
from apc.compiler.components.library import Library
from apc.frame.lift import LiftedSite, lift
from tests.bench.growing import equations
from tests.sites import MS, columned, edged, grouped, linked, paper
from tests.topologies import compiled


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"operator": "sum", "own_delay": True},
        {"comp": MS * 5 / 2, "comm": 11 * MS},
        {"haptic": 3 * MS, "network": 2 * MS, "comm": Fraction(0), "haptic_phase": MS / 3},
    ],
)
def test_a_frame_stepped_and_lifted_agrees_to_rounding(values: dict[str, Any]) -> None:
    system = grouped(
        paper(kt=800.0, bt=2.0, kc=1500.0, bc=2.0, **values),
        ("right", 1, {"hand.force": -4.0, "device.x.start": 0.03}),
        ("left", 2, {"hand.force": 2.0, "device.mass": 0.2}),
    )
    assert check_frame(system) < 1e-13


def test_forces_of_1e17_newtons_leave_the_slow_rates_their_digits() -> None:
    """A contact of 1e8 N/m at 1 kHz throws a device about by its own rounding, and nothing else."""
    assert check_frame(paper(kc=1e8)) < 1e-13


def test_a_wrong_lift_is_found(monkeypatch: pytest.MonkeyPatch) -> None:
    def spoiled(*arguments: Any, **options: Any) -> LiftedSite:
        lifted = lift(*arguments, **options)
        return replace(lifted, p=lifted.p * (1 + 1e-9))

    monkeypatch.setattr(selfcheck, "lift", spoiled)
    with pytest.raises(AssertionError, match="one frame of user, stepped and lifted, differ by"):
        check_frame(paper())


STIFF = {
    "a frame of 1 s without clocks": """
topology: no-clock
peers: {left: {count: 1}}
masses:
  device: {mass: 0.0345 kg, damping: 5.05 N*s/m}
  cube: {mass: 0.0533 kg}
couplers:
  pad: {type: SpringDamper, a: device, b: cube, stiffness: 87.8 N/m, damping: 0.84 N*s/m}
""",
    "what dies out 10^5 times faster than the frame": """
topology: stiff
clocks: {haptic: 8 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.0009 kg, damping: 0.08 N*s/m}
  cube: {mass: 0.0086 kg, damping: 100 N*s/m}
couplers:
  pad: {type: SpringDamper, a: device, b: cube, stiffness: 5000 N/m, damping: 5 N*s/m}
  wall: {type: SampledSpringDamper, a: cube, b: ground, stiffness: 10 N/m, clock: haptic}
""",
    "10^4 periods of a swing in a frame, pushed with 1e8 N": """
topology: swing
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 g}, cube: {mass: 0.2 g}}
couplers: {pad: {type: SpringDamper, a: device, b: cube, stiffness: 100000 N/m}}
hands: {hand: {type: ConstantForce, flange: device, force: 1e8 N}}
""",
}


@pytest.mark.parametrize("text", STIFF.values(), ids=STIFF)
def test_what_moves_fast_within_a_frame_agrees_and_a_wrong_lift_of_it_is_found(
    text: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    system = compiled(text)
    assert check_frame(system) < 1e-15

    def spoiled(*arguments: Any, **options: Any) -> LiftedSite:
        lifted = lift(*arguments, **options)
        return replace(lifted, p=lifted.p * (1 + 1e-12))

    monkeypatch.setattr(selfcheck, "lift", spoiled)
    with pytest.raises(AssertionError, match="stepped and lifted, differ by"):
        check_frame(system)


def test_many_masses_in_a_row_agree_and_a_wrong_lift_of_them_is_found(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Their steps are sums of a series, ball by ball, and of no matrix."""
    text = equations(150, tmp_path)
    monkeypatch.setattr(selfcheck, "_step", small := Mock(side_effect=selfcheck._step))
    system = compiled(text, Library((tmp_path / "parts",)))
    assert check_frame(system) < 1e-15
    assert {call.args[0].nrows() for call in small.call_args_list} == {2}  # the cube's

    def spoiled(*arguments: Any, **options: Any) -> LiftedSite:
        lifted = lift(*arguments, **options)
        return replace(lifted, p=lifted.p * (1 + 1e-11))

    monkeypatch.setattr(selfcheck, "lift", spoiled)
    with pytest.raises(AssertionError, match="stepped and lifted, differ by"):
        check_frame(system)


def test_pairs_with_other_delays_and_different_peers_are_checked_too() -> None:
    base = grouped(paper(kt=800.0, bt=2.0), ("left", 2, {}), ("right", 2, {}))
    assert check_frame(linked(base, delays={("left", "right"): 3 * MS})) < 1e-13
    assert check_frame(columned(paper(), device__mass=[0.1, 0.2, 0.3])) < 1e-13
    assert skipped(base) == ()
    assert skipped(edged(base)) == ("user",)
