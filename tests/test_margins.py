"""Claims about `apc.vary.margins`."""

from __future__ import annotations

import re
from fractions import Fraction
from pathlib import Path

import pytest

from apc.analysis.analysis import analyze, lifted_groups
from apc.answer import answer
from apc.compiler.compiled import CompiledSystem
from apc.compiler.pipeline import compile_topology
from apc.eigen.modes import split
from apc.eigen.spectrum import solve_spectrum
from apc.frame.names import Free
from apc.frame.overrides import Override, apply
from apc.vary.margins import Margin, margins
from tests.bench.growing import row
from tests.topologies import AVERAGE, compiled, replaced

DEAD_RECKONING = """
topology: dead-reckoning
clocks: {haptic: 1 ms, network: 8 ms}
peers: {user: {count: 2}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
  cube:   {mass: 0.6 kg, damping: 5 N*s/m, shared: true}
couplers:
  contact:      {type: SampledSpringDamper, a: device, b: cube, stiffness: 1000 N/m, clock: haptic,
                 delay: 1 ms}
  coordination: {type: DeadReckoning, object: cube, stiffness: 200 N/m, damping: 5 N*s/m,
                 threshold: 0.1 mm, clock: haptic, delay: 1 ms, link: lan}
links: {lan: {clock: network, delay: 8 ms, loss: 0 %}}
hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 100 N/m, damping: 2 N*s/m}}
"""


def test_every_stiffness_damping_and_delay_of_a_coupler_has_a_margin_that_holds() -> None:
    system = compiled(AVERAGE)
    found = {one.parameter: one for one in margins(system).rows}
    assert list(found) == [
        *("contact.stiffness", "contact.damping", "coordination.stiffness", "coordination.damping"),
        *("contact.delay", "coordination.delay", "lan.delay"),
    ]
    for name, one in found.items():
        if one.value is None or one.error is None:
            assert one.scanned > one.present
            continue
        assert one.value > one.present
        assert one.error <= 1e-12 * one.value
        for side, stable in ((-1e-9, True), (1e-9, False)):
            value = Fraction(one.value * (1 + side))
            assert analyze(apply(system, [Override(Free(name), value)])).stable is stable
        assert one.factor == (one.value / one.present if one.present else None)


def test_a_delay_moves_where_a_kind_starts_if_its_equations_ask_how_old_packets_are() -> None:
    system = compiled(DEAD_RECKONING)
    found = {one.parameter: one for one in margins(system).rows}
    contact, link = found["contact.delay"], found["coordination.delay"]
    assert contact.value is not None
    assert link.value is None
    for name, value, stable in [
        ("contact.delay", contact.value * (1 - 1e-9), True),
        ("contact.delay", contact.value * (1 + 1e-9), False),
        *(("coordination.delay", share * link.scanned, True) for share in (0.3, 0.6, 0.9)),
    ]:
        assert analyze(apply(system, [Override(Free(name), Fraction(value))])).stable is stable


def test_a_scene_that_is_not_stable_has_no_margins_and_says_so() -> None:
    found = margins(compiled(replaced(AVERAGE, ("stiffness: 500 N/m", "stiffness: 2000 N/m"))))
    assert found.rows == ()
    assert "not stable" in str(found)


def test_the_table_fits_80_columns() -> None:
    text = str(margins(compiled(AVERAGE)))
    assert max(map(len, text.splitlines())) <= 80
    assert "none found up to" in text


def test_a_delay_that_is_scanned_is_scanned_far_enough_or_said_not_to_be() -> None:
    text = replaced(
        AVERAGE,
        (
            "stiffness: 1000 N/m, clock: haptic, delay: 1 ms",
            "stiffness: 1000 N/m, clock: haptic, delay: 0.13 ms",
        ),
    )
    for one in margins(compiled(text)).rows:
        assert one.value is not None or one.scanned >= 1.5 * one.present
        assert one.note == ""
    # 0.95 ms and 1 ms meet at every twentieth of a millisecond.
    slow = replaced(text, ("network: 8 ms", "network: 0.95 ms"))
    found = margins(compiled(slow))
    row = next(one for one in found.rows if one.parameter == "lan.delay")
    assert row.value is None
    assert re.fullmatch(r"\d+ orders of events up to 0\.012\d* s", row.note)
    assert f"not looked for: {row.note}" in str(found)


def test_a_delay_beside_packets_that_are_late_by_many_frames_is_proved_without_them() -> None:
    """A loop of 250 states, 200 of them packets on their way; checked by analyses of both sides."""
    text = replaced(
        AVERAGE,
        ("count: 3", "count: 2"),
        ("network: 8 ms", "network: 1 ms"),
        ("delay: 8 ms", "delay: 50 ms"),
        ("stiffness: 500 N/m", "stiffness: 60 N/m"),
    )
    system = compiled(text)
    found = {one.parameter: one for one in margins(system).rows}
    one = found["contact.delay"]
    assert one.value is not None
    assert one.error is not None
    assert one.error <= 1e-12 * one.value
    for side, stable in ((-1e-9, True), (1e-9, False)):
        value = Fraction(one.value * (1 + side))
        assert analyze(apply(system, [Override(Free("contact.delay"), value)])).stable is stable


def _late(delay: str) -> str:
    """Return two users in some haste: each frame is a tick, so that many packets are on their way."""
    return replaced(
        AVERAGE,
        ("count: 3", "count: 2"),
        ("network: 8 ms", "network: 1 ms"),
        ("delay: 8 ms", f"delay: {delay}"),
        ("stiffness: 500 N/m", "stiffness: 60 N/m"),
    )


def _holds(system: CompiledSystem, one: Margin) -> None:
    """Check that bounds of floats decide otherwise on both sides of a margin, a few of its errors away."""
    assert one.value is not None
    assert one.error is not None
    for side, stable in ((-1, True), (1, False)):
        value = Fraction(one.value + side * max(10 * one.error, 1e-7 * one.value))
        groups = lifted_groups(apply(system, [Override(Free(one.parameter), value)]))
        assert solve_spectrum(split(*groups).systems, in_balls=False).stable is stable


@pytest.mark.parametrize("delay", ["12 ms", "30 ms"])
def test_two_users_some_frames_apart_have_margins(delay: str) -> None:
    system = compiled(_late(delay))
    found = margins(system)
    assert found.note == ""
    rows = {one.parameter: one for one in found.rows}
    assert {"contact.stiffness", "coordination.stiffness", "contact.delay"} <= set(rows)
    assert not any(one.note for one in rows.values())
    for name in ("contact.stiffness", "coordination.stiffness", "contact.delay"):
        _holds(system, rows[name])


@pytest.mark.parametrize("masses", [30, 60])
def test_a_row_of_masses_has_margins_that_bounds_on_both_sides_confirm(masses: int, tmp_path: Path) -> None:
    """Systems of 70 and 130 states: gains by response and bound, delays value by value."""
    (tmp_path / "scene.yaml").write_text(row(masses, tmp_path), encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    found = margins(system)
    assert found.note == ""
    rows = {one.parameter: one for one in found.rows}
    for name in ("contact.stiffness", "coordination.stiffness", "contact.delay"):
        assert not rows[name].estimated
        _holds(system, rows[name])


def test_of_very_large_systems_margins_are_estimated_or_said_not_to_be_looked_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The same as of what is not too large, whose bounds hold them; 40 masses stand for 500."""
    text = row(40, tmp_path).replace(
        "couplers:", "couplers:\n  seat: {type: SpringDamper, a: device, b: ground, stiffness: 3 N/m}"
    )
    (tmp_path / "scene.yaml").write_text(text, encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    monkeypatch.setattr("apc.vary.margins.MOST_SCANNED", 80)
    found = margins(system)
    rows = {one.parameter: one for one in found.rows}
    gains = ("contact.stiffness", "contact.damping", "coordination.stiffness", "coordination.damping")
    assert found.note == f"estimated, as a bound takes long: {', '.join(gains)}"
    for name in gains:
        assert rows[name].estimated
    for name in gains[::2]:
        _holds(system, rows[name])
    assert re.fullmatch(r"\d\d states in each order of events", rows["contact.delay"].note)
    assert rows["seat.stiffness"].value is None
    assert re.fullmatch(r"no gain at ticks, and \d\d states", rows["seat.stiffness"].note)


def test_in_passing_large_systems_have_no_margins_and_the_line_that_asks_for_them_is_told(
    tmp_path: Path,
) -> None:
    (tmp_path / "scene.yaml").write_text(row(30, tmp_path), encoding="utf-8")
    system = compile_topology(tmp_path / "scene.yaml")
    passing = answer(system)
    assert passing.margins.rows == ()
    assert re.fullmatch(
        r"not looked for in passing: \d\d states \(apc analyze --margins does\)", passing.margins.note
    )
    assert answer(system, every_margin=True).margins == margins(system)
