"""What moves the spectral radius most: derivatives against 320 bits, and what is not told and why."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import apc
from apc.compiler.compiled import Model
from apc.studies.sensitivity import Sensitivities
from tests.bench.sensitivity_truth import check_sensitivities, run
from tests.topologies import AVERAGE, MESH, ONE_MASS, TOPOLOGIES, compiled, library, replaced

NAMES = sorted(path.stem for path in TOPOLOGIES.glob("*.yaml") if path.stem != "template")
GRAPH = ("delay: 8 ms}", "delay: 8 ms, graph: {edges: [[1, 2, 0.3], [1, 3, 0.3], [2, 3, 0.5]]}}")
OWN = ("link: lan}", "link: lan, delays: own}")
GROUPS = replaced(
    AVERAGE, ("  user: {count: 3}", "  one: {count: 1, set: {device.mass: 0.14 kg}}\n  two: {count: 2}")
)
EQUAL = replaced(
    AVERAGE,
    ("  user: {count: 3}", "  one: {count: 1, set: {contact.stiffness: 1000 N/m}}\n  two: {count: 2}"),
)
UNCLOCKED = """\
topology: unclocked
peers: {{user: {{count: 2}}}}
masses:
  device: {{mass: {} kg, damping: {} N*s/m}}
  cube: {{mass: {} kg, damping: {} N*s/m, shared: true}}
couplers:
  spring: {{type: SpringDamper, a: device, b: cube, stiffness: {} N/m, damping: {} N*s/m}}
"""

# A frame of 1 s, in which masses on a stiff damper settle 10³ to 10⁴ times over.
SETTLING = [
    ("0.012024990784370273", "0.0021282909", "2.024910856889678", "0.040052959", "88.04437", "63.6466"),
    ("0.017405540793130555", "3.17138972e-6", "0.0118822421", "2.86345e-5", "0.74912642", "1.096408"),
    ("0.0012563506546329", "0.0011384141", "0.01866965", "0.0101767", "0", "11.29332081"),
]

TOPOLOGY = {
    "average": AVERAGE,
    "mesh": MESH,
    "a damped contact": replaced(AVERAGE, ("contact:      {", "contact:      {damping: 1 N*s/m, ")),
    "groups": GROUPS,
    "equal groups": EQUAL,
    # With `delays: own` what is free follows the stiffnesses; without one of them there is more of it.
    "held": replaced(MESH, GRAPH, OWN),
    "held without contact": replaced(MESH, GRAPH, OWN, ("1000 N/m", "0 N/m")),
    "held apart": replaced(MESH, GRAPH, OWN, ("500 N/m", "0 N/m")),
    # Two of its modes are 4e-9 of themselves apart, and follow the coordination differently.
    "modes close together": replaced(
        MESH, GRAPH, ("500 N/m", "0.1 N/m"), ("0.1 kg", "0.01 kg"), ("1000 N/m", "60000 N/m")
    ),
    **{f"settling {place}": UNCLOCKED.format(*numbers) for place, numbers in enumerate(SETTLING)},
}


def rates(found: Sensitivities) -> dict[str, float | None]:
    return {row.parameter: row.derivative for row in found.rows}


@pytest.mark.few(5)
@pytest.mark.parametrize("name", TOPOLOGY)
def test_every_derivative_is_that_of_the_topology_in_320_bits(name: str) -> None:
    found = apc.sensitivities(compiled(TOPOLOGY[name]))
    assert found.rows or found.note
    assert check_sensitivities(compiled(TOPOLOGY[name]), found) == ""


@pytest.mark.parametrize("seed", [3, pytest.param(5, marks=pytest.mark.whole)])
def test_every_derivative_and_frequency_of_random_topologies_is_right(seed: int) -> None:
    assert run(3, seed=seed) == []


def test_where_the_groups_differ_each_has_a_derivative_of_its_own() -> None:
    own = replaced(GROUPS, ("two: {count: 2}", "two: {count: 2, set: {device.mass: 0.1 kg}}"))
    found, other = (rates(apc.sensitivities(compiled(text))) for text in (GROUPS, own))
    assert "device.mass" not in found.keys() | other.keys() and "cube.mass" in found
    for name in ("one.device.mass", "two.device.mass"):
        assert found[name] == pytest.approx(other[name], rel=1e-9)


def changed(model: Model, every: int) -> str:
    """Set the number of every so many rows 1 ‰ off, as `--set` does; compare the radius with its row."""
    found = apc.sensitivities(model)
    radius = apc.analyze(model).spectral_radius
    for name in [*dict.fromkeys(row.parameter for row in found.rows)][::every]:
        rows = [row for row in found.rows if row.parameter == name]
        if not rows[0].value:
            continue
        unit = "" if rows[0].unit == "1" else f" {rows[0].unit}"
        low, high = (
            apc.analyze(model, params={name: f"{rows[0].value * (1 + side)!r}{unit}"}).spectral_radius
            for side in (-1e-3, 1e-3)
        )
        up, down, printed = (high - radius) / 1e-3, (radius - low) / 1e-3, [row.relative for row in rows]
        # The largest of those that share the radius decides on either side.
        off = abs((up + down) / 2 - printed[0])
        if len(found.active) > 1:
            off = max(abs(up - max(printed)), abs(down - min(printed)))
        if not off <= 2e-3 * max(map(abs, printed)) + 2e-6 + abs(up - down):
            return f"{name}: {printed}, but {down} and {up}"
    return ""


@pytest.mark.few(1)
@pytest.mark.parametrize("every", [3, 1])
@pytest.mark.parametrize("name", NAMES)
def test_a_row_says_what_setting_its_name_does(name: str, every: int) -> None:
    assert changed(apc.compile(TOPOLOGIES / f"{name}.yaml"), every) == ""


def test_where_the_radius_is_large_it_is_differentiated_all_the_same() -> None:
    """A full mesh of 1,000: radius 6e7, of which a distance of 1e-10 is no float."""
    model = compiled(replaced(MESH, ("count: 3", "count: 1000")))
    assert apc.sensitivities(model).radius > 1e7 and changed(model, 2) == ""


@pytest.mark.whole
def test_a_topology_linearized_within_its_limits_is_the_linear_one() -> None:
    """Inside of its limits a saturated mesh is a mesh."""
    text = replaced(GROUPS, ("AveragePosition", "FullMesh"))
    bent = replaced(text, ("FullMesh,", "SaturatedMesh, limit: 2 N,"))
    found, same = (apc.sensitivities(compiled(one)) for one in (bent, text))
    for row in same.rows:
        assert rates(found)[row.parameter] == pytest.approx(row.derivative, rel=1e-6, abs=1e-9)


def test_equal_groups_have_an_active_set_and_no_single_gradient() -> None:
    """The difference modes of three equal users are two; changing one user alone moves them apart."""
    found = apc.sensitivities(compiled(EQUAL))
    assert len(found.active) == 2 and "have the largest magnitude" in found.note
    reported = sorted(row.derivative for row in found.rows if row.parameter == "one.contact.stiffness")
    low, here, high = (
        apc.analyze(compiled(EQUAL), params={"one.contact.stiffness": f"{1000 + side} N/m"}).spectral_radius
        for side in (-1e-3, 0, 1e-3)
    )
    assert [(here - low) / 1e-3, (high - here) / 1e-3] == pytest.approx(reported, rel=1e-4, abs=1e-9)


def test_a_damping_of_nothing_has_the_derivative_of_what_it_adds_up_with() -> None:
    """A finger's tip and the device it holds move as one: their dampings act as their sum, at 0 too."""
    found = {row.parameter: row for row in apc.sensitivities(apc.compile(TOPOLOGIES / "finger.yaml")).rows}
    nothing, whole = found["finger.tip.damping"], found["device.damping"]
    assert nothing.value == 0 and nothing.derivative == pytest.approx(whole.derivative, rel=1e-7)


# ---- what is said ----


def test_the_table_names_what_moves_most_in_80_columns_and_no_time_start_or_count() -> None:
    found = apc.sensitivities(compiled(AVERAGE))
    text = str(found)
    assert "device.damping" in text.splitlines()[3] and max(map(len, text.splitlines())) <= 80
    relative = [abs(row.relative) for row in found.rows]
    assert relative == sorted(relative, reverse=True) and not np.isnan(relative).any()
    assert rates(found).keys() == {
        *("device.mass", "device.damping", "cube.mass", "cube.damping"),
        *("contact.stiffness", "contact.damping", "coordination.stiffness", "coordination.damping"),
    }


def test_a_radius_below_every_float_has_no_derivative() -> None:
    """Rates of 10⁶/s over a frame of 1 s: e^(−10⁶) is no float."""
    text = UNCLOCKED.format("1e-4", "100", "1e-4", "100", "1e6", "1")
    arm = "hands: {arm: {type: SpringDamperArm, flange: device, stiffness: 1 N/um, damping: 100 N*s/m}}\n"
    found = apc.sensitivities(compiled(replaced(text + arm, ("count: 2", "count: 1"))))
    assert (found.radius, found.rows) == (0.0, ())
    assert (
        str(found).splitlines()[-1] == "  no parameter has an effect: all motions decay to 0 within a frame"
    )


def test_what_would_move_a_motion_left_out_is_named_and_not_differentiated(tmp_path: Path) -> None:
    """An integrator nobody reads stands still where its leak is 1, and nowhere else."""
    part = """\
component: Integrator
description: Adds up where it is.
connectors: {a: Flange}
parameters: {kp: {unit: N/m}, ki: {unit: N/m}, leak: {unit: 1}, clock: clock}
variables: {s: {unit: m, start: 0 m}, f: {unit: N}}
equations:
  - s = leak*previous(s) + sample(a.x)
  - f = kp*sample(a.x) + ki*s
  - a.f = hold(f)
"""
    text = """\
topology: unread
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses:
  device: {mass: 0.1 kg, damping: 5 N*s/m}
couplers:
  p: {type: Integrator, a: device, kp: 100 N/m, ki: 0 N/m, leak: 1, clock: haptic}
"""
    model = compiled(text, library(tmp_path, part))
    found = apc.sensitivities(model)
    assert found.note == "the excluded modes depend on p.ki, p.leak, so their sensitivities are not computed"
    assert rates(found).keys() == {"device.mass", "device.damping", "p.kp"}
    assert check_sensitivities(model, found) == ""
    analysis = apc.analyze(model)
    assert (analysis.verdict, analysis.rigid_modes, analysis.translations) == ("stable", 1, 0)
    assert analysis.unobservable == ("p.s",) and "Nothing ties" not in str(analysis)
    # Without the spring the device translates, and the integrator adds up where to: no drift.
    loose = apc.analyze(model, params={"p.kp": "0 N/m"})
    assert (loose.verdict, loose.stable, loose.translations) == ("stable up to a common translation", True, 1)
    used = apc.analyze(model, params={"p.ki": "1 N/m"})
    assert (used.rigid_modes, used.unobservable) == (0, ())


def test_a_side_is_no_number_that_varies() -> None:
    """A named value, such as the side of a wall, has no derivative."""
    wall = "type: VirtualWall, flange: device, side: right, position: 1 mm, stiffness: 100 N/m, clock: tick"
    text = f"{ONE_MASS}clocks: {{tick: 1 ms}}\ncouplers: {{wall: {{{wall}}}}}\n"
    names = [row.parameter for row in apc.sensitivities(compiled(text)).rows]
    assert "wall.stiffness" in names and "wall.side" not in names
