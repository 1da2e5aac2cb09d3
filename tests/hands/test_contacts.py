"""Contacts on and off: each mode is the topology of springs it stands for, and the ticks of it brute
force.
"""

from __future__ import annotations

import json
import warnings
from fractions import Fraction
from pathlib import Path

import numpy as np
import pytest

import apc
from apc.analysis.contact_modes import ContactModes
from apc.compiler.errors import ApcError
from tests import bruteforce
from tests.topologies import AVERAGE, MESH, TOPOLOGIES, compiled, library, replaced, wall

EXPERIMENTS = {
    name: (TOPOLOGIES / f"experiment-{name}.yaml").read_text(encoding="utf-8") for name in ("average", "mesh")
}
TOUCHING = {
    "on at every peer": (True, True),
    "on at no peer": (False, False),
    "on at right alone": (True, False),
    "on at left alone": (False, True),
}
OPERATORS = {"average": "mean", "mesh": "sum"}
EVERY, NO_PEER = "on at every peer", "on at no peer"


def radii(found: ContactModes) -> dict[str, float | None]:
    return {one.name: one.spectral_radius for one in found.modes}


@pytest.mark.parametrize("topology", EXPERIMENTS)
def test_each_mode_agrees_with_brute_force(topology: str) -> None:
    found = apc.contact_modes(compiled(EXPERIMENTS[topology]))
    assert found.parts == ("contact.push",)
    assert [one.name for one in found.modes] == [*TOUCHING]
    numbers = {"kt": 2000.0, "bt": 1.0, "kc": 3900.0, "bc": 0.05, "cube": 0.1, "comp": Fraction(0)}
    for one, (right, left) in zip(found.modes, TOUCHING.values(), strict=True):
        free = tuple({} if on else {"kc": 0.0, "bc": 0.0} for on in (right, left, left))
        common = bruteforce.TopologySource(OPERATORS[topology], users=free, **numbers)
        values = np.linalg.eigvals(np.array(bruteforce.frame_matrix(common)))
        # A device that touches nothing stays where it is: as many translations as there are bodies apart.
        others = np.delete(values, np.argsort(np.abs(values - 1.0))[: 1 + sum(map(bool, free))])
        largest = float(np.abs(others).max())
        assert one.spectral_radius == pytest.approx(largest, abs=1e-9)
        assert (one.stable, one.linearized) == (largest < 1, False)


def test_the_experiment_with_the_mean_is_stable_in_contact_and_with_the_mesh_it_is_not() -> None:
    average, mesh = (apc.contact_modes(compiled(text)) for text in EXPERIMENTS.values())
    assert average.unstable == ("on at no peer", "on at right alone")
    assert average.summary == "contact.push: unstable when on at no peer or on at right alone"
    assert mesh.summary == "contact.push: unstable in every mode"
    plain = apc.analyze(compiled(EXPERIMENTS["average"])).spectral_radius  # from where it starts, apart
    assert radii(average)[NO_PEER] == pytest.approx(plain, abs=1e-12)
    for found in (average, mesh):
        assert len(json.loads(json.dumps(found.to_dict(), allow_nan=False))["modes"]) == 4
        assert max(map(len, str(found).splitlines())) <= 80
    none = apc.contact_modes(compiled(AVERAGE))
    assert (none.parts, str(none)) == ((), "three-users-average: no contact")
    with warnings.catch_warnings(action="error"):  # of what is beyond floats
        assert apc.contact_modes(wall(0.1, 1.0, 0.0, 1e200)).parts == ("it.push",)


@pytest.mark.parametrize(
    ("text", "plain", "limited", "off"),
    [
        (AVERAGE, "SampledSpringDamper", "ForceSaturation, limit: 5 N", ("contact", "1000 N/m")),
        (MESH, "FullMesh", "SaturatedMesh, limit: 5 N", ("coordination", "500 N/m")),
    ],
)
def test_a_limited_force_is_on_while_it_is_not_at_its_limit(
    text: str, plain: str, limited: str, off: tuple[str, str]
) -> None:
    found = apc.contact_modes(compiled(replaced(text, (plain, limited))))
    assert found.parts == (f"{off[0]}.f",)
    for one, truth in zip(found.modes, (text, replaced(text, (off[1], "0 N/m"))), strict=True):
        expected = apc.analyze(compiled(truth))
        assert one.spectral_radius == pytest.approx(expected.spectral_radius, abs=1e-12)
        assert (one.verdict, one.linearized) == (expected.verdict, False)


def test_walls_and_contacts_are_switched_together_and_one_by_one() -> None:
    wall = "  wall: {type: EnclosureWalls, flange: cube, low: -100 mm, high: 100 mm, stiffness: 500 N/m, clock: haptic}\n"  # noqa: E501
    text = replaced(EXPERIMENTS["average"], ("  coordination:", f"{wall}  coordination:"))
    found = apc.contact_modes(compiled(text))
    assert found.parts == ("contact.push", "wall.left.push", "wall.right.push")
    assert [*radii(found)] == [*TOUCHING, *(f"{part} on alone" for part in found.parts)]
    plain, walled = radii(apc.contact_modes(compiled(EXPERIMENTS["average"]))), radii(found)
    assert walled["contact.push on alone"] == pytest.approx(plain[EVERY], abs=1e-12)
    assert walled[NO_PEER] == pytest.approx(plain[NO_PEER], abs=1e-12)
    # Either wall is a spring of 500 N/m from the cube to the ground.
    assert walled["wall.left.push on alone"] == pytest.approx(walled["wall.right.push on alone"], abs=1e-12)


def test_a_piece_that_is_not_linear_is_taken_at_the_start_or_refused_there() -> None:
    pressed = EXPERIMENTS["average"].replace("OneSidedContact", "SampledHuntCrossleyContact")
    pressed = pressed.replace("3900 N/m, damping: 0.05 N*s/m", "3900 N/m^(3/2), damping: 0.05 N*s/m^(5/2)")
    every, apart, *_ = apc.contact_modes(compiled(pressed)).modes
    assert apart.stable is False and every.stable is None
    assert "right is not linear and has no slope at the initial values" in every.refusal
    # Ten millimetres deep, the slope of 3900 d^1.5 is 5850 · 0.1 N/m.
    deep = apc.contact_modes(compiled(pressed.replace("30 mm", "10 mm"))).modes[0]
    interchangeable = replaced(EXPERIMENTS["average"], ("3900 N/m, damping: 0.05", "585 N/m, damping: 5e-5"))
    assert deep.linearized
    expected = apc.contact_modes(compiled(interchangeable)).modes[0].spectral_radius
    assert deep.spectral_radius == pytest.approx(expected, abs=1e-12)


OWN = """\
component: Own
connectors: {{a: Flange}}
parameters: {{k: {{unit: N/m}}, most: {{unit: m, default: 1 mm}}, clock: clock}}
variables: {{d: {{unit: m}}, f: {{unit: N}}}}
equations:
  - d = sample(a.x)
  - f = {law}
  - a.f = hold(f)
"""
TOPOLOGY = """\
topology: one
clocks: {tick: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 2 N*s/m}}
couplers: {it: {type: Own, a: device, k: 700 N/m, clock: tick}}
"""


@pytest.mark.parametrize(
    ("law", "on", "off"),
    [
        ("k*max(0, d)", 700, 0),
        ("if d > 0 and not (d > most) then k*d else 0", 700, 0),
        ("if d > 0 then k*d/2 else k*d", 700, 350),  # on is the steeper of two slopes
        ("max(-k*most, min(k*most, k*d))", 700, 0),
        ("k*abs(d)", 700, -700),
        ("k*d + sign(d)*k*most", None, None),
    ],
)
def test_each_kind_of_decision_has_the_slopes_of_its_pieces(
    law: str, on: float | None, off: float | None, tmp_path: Path
) -> None:
    found = apc.contact_modes(compiled(TOPOLOGY, library(tmp_path, OWN.format(law=law))))
    if on is None or off is None:
        assert found.parts == ()
        return
    assert found.parts == ("it.f",)
    for mode, slope in zip(found.modes, (on, off), strict=True):
        spring = OWN.format(law="k*d") if slope >= 0 else OWN.format(law="-k*d")
        (tmp_path / f"{slope}").mkdir()
        truth = apc.analyze(
            compiled(TOPOLOGY, library(tmp_path / f"{slope}", spring)), params={"it.k": f"{abs(slope)} N/m"}
        )
        assert mode.spectral_radius == pytest.approx(truth.spectral_radius, abs=1e-12)


def test_a_part_that_decides_too_much_is_refused(tmp_path: Path) -> None:
    law = " + ".join(f"max(0, k*d - {step}*k*most)" for step in range(7))
    with pytest.raises(ApcError, match=r"E863 it.f of user has 7 conditions; at most 6"):
        apc.contact_modes(compiled(TOPOLOGY, library(tmp_path, OWN.format(law=law))))
