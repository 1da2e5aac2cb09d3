"""Claims about `apc.analysis.contact_modes`."""

from __future__ import annotations

import json
from dataclasses import replace
from fractions import Fraction

import casadi
import numpy as np
import pytest

from apc.analysis.analysis import analyze, prepare
from apc.analysis.contact_modes import ContactMode, ContactModes, contact_modes
from tests import bruteforce
from tests.sites import alone
from tests.topologies import AVERAGE, MESH, SCENES, compiled, replaced

EXPERIMENTS = {
    name: (SCENES / f"experiment-{name}.yaml").read_text(encoding="utf-8") for name in ("average", "mesh")
}
MODES = ("on at every peer", "on at no peer", "on at right alone", "on at left alone")
ONE_SIDED = "{type: OneSidedContact, a: device, b: cube, half_width: 20 mm, stiffness: 3900 N/m"
SPRING = "{type: SampledSpringDamper, a: device, b: cube, stiffness: 3900 N/m"


def spring(text: str, *, right: bool, left: bool) -> str:
    """Return the experiment with a spring that never lets go for each contact, or none."""
    nothing = "contact.stiffness: 0 N/m, contact.damping: 0 N*s/m"
    return replaced(
        text,
        (ONE_SIDED, SPRING),
        ("contact.side: right, ", "" if right else f"{nothing}, "),
        ("contact.side: left, ", "" if left else f"{nothing}, "),
    )


def mode(found: ContactModes, name: str) -> ContactMode:
    [one] = [one for one in found.modes if one.name == name]
    return one


@pytest.mark.parametrize("scene", ["average", "mesh"])
def test_each_mode_of_the_experiment_is_the_scene_of_springs_it_stands_for(scene: str) -> None:
    found = contact_modes(compiled(EXPERIMENTS[scene]))
    assert tuple(one.name for one in found.modes) == MODES
    assert found.parts == ("contact.push",)
    touching = ((True, True), (False, False), (True, False), (False, True))
    for one, (right, left) in zip(found.modes, touching, strict=True):
        truth = analyze(compiled(spring(EXPERIMENTS[scene], right=right, left=left)), method="dense")
        assert one.spectral_radius == pytest.approx(truth.spectral_radius, abs=1e-12)
        assert one.verdict == truth.verdict
        assert not one.linearized
        assert dict(one.on) == {
            "right": ("contact.push",) if right else (),
            "left": ("contact.push",) if left else (),
        }


@pytest.mark.parametrize("scene", ["average", "mesh"])
def test_each_mode_of_the_experiment_agrees_with_brute_force(scene: str) -> None:
    found = contact_modes(compiled(EXPERIMENTS[scene]))
    common = bruteforce.Scene(
        operator="mean" if scene == "average" else "sum",
        kt=2000.0,
        bt=1.0,
        kc=3900.0,
        bc=0.05,
        cube=0.1,
        comp=Fraction(0),
    )
    for one in found.modes:
        users = tuple(
            {} if parts else {"kc": 0.0, "bc": 0.0}
            for group, parts in one.on
            for _ in range(1 if group == "right" else 2)
        )
        values = np.linalg.eigvals(np.array(bruteforce.frame_matrix(replace(common, users=users))))
        # A device that touches nothing stays where it is: as many translations as there are bodies apart.
        rigid = 1 + sum(1 for user in users if user)
        others = np.delete(values, np.argsort(np.abs(values - 1.0))[:rigid])
        assert one.spectral_radius == pytest.approx(float(np.abs(others).max()), abs=1e-9)


def test_the_experiment_with_the_mean_is_stable_in_contact_and_with_the_mesh_it_is_not() -> None:
    average, mesh = (contact_modes(compiled(EXPERIMENTS[name])) for name in ("average", "mesh"))
    assert average.unstable == ("on at no peer", "on at right alone")
    assert mode(average, "on at every peer").stable
    assert not mode(mesh, "on at every peer").stable
    assert average.summary == "contact.push: unstable when on at no peer or on at right alone"
    assert mesh.summary == "contact.push: unstable in every mode"
    assert 40 < mode(average, "on at every peer").frequency_hz < 60


def test_the_plain_analysis_is_that_of_the_mode_the_scene_starts_in() -> None:
    system = compiled(EXPERIMENTS["average"])
    assert mode(contact_modes(system), "on at no peer").spectral_radius == pytest.approx(
        analyze(system).spectral_radius, abs=1e-12
    )


@pytest.mark.parametrize("text", [AVERAGE, MESH])
def test_a_limited_force_is_on_while_it_is_not_at_its_limit(text: str) -> None:
    limited = text.replace(
        "{type: SampledSpringDamper, a: device", "{type: ForceSaturation, limit: 5 N, a: device"
    )
    found = contact_modes(compiled(limited))
    assert found.parts == ("contact.f",)
    assert tuple(one.name for one in found.modes) == MODES[:2]
    free = replaced(text, ("stiffness: 1000 N/m", "stiffness: 0 N/m"))
    for one, truth in zip(found.modes, (text, free), strict=True):
        expected = analyze(compiled(truth))
        assert one.spectral_radius == pytest.approx(expected.spectral_radius, abs=1e-12)
        assert (one.verdict, one.linearized) == (expected.verdict, False)


def test_a_limit_on_what_is_heard_of_each_other_one_switches_too() -> None:
    limited = replaced(MESH, ("type: FullMesh", "type: SaturatedMesh, limit: 5 N"))
    found = contact_modes(compiled(limited))
    assert found.parts == ("coordination.f",)
    apart = replaced(MESH, ("stiffness: 500 N/m", "stiffness: 0 N/m"))
    for one, truth in zip(found.modes, (MESH, apart), strict=True):
        expected = analyze(compiled(truth)).spectral_radius
        assert one.spectral_radius == pytest.approx(expected, abs=1e-12)


def test_walls_and_contacts_are_switched_together_and_one_by_one() -> None:
    walled = replaced(
        EXPERIMENTS["average"],
        (
            "  coordination:",
            "  wall: {type: EnclosureWalls, flange: cube, low: -100 mm, high: 100 mm,"
            " stiffness: 500 N/m, clock: haptic}\n  coordination:",
        ),
    )
    found = contact_modes(compiled(walled))
    assert found.parts == ("contact.push", "wall.left.push", "wall.right.push")
    names = tuple(one.name for one in found.modes)
    assert names == (*MODES, *(f"{part} on alone" for part in found.parts))
    plain = contact_modes(compiled(EXPERIMENTS["average"]))
    for walls, same in (("contact.push on alone", MODES[0]), (MODES[1], MODES[1])):
        expected = mode(plain, same).spectral_radius
        assert mode(found, walls).spectral_radius == pytest.approx(expected, abs=1e-12)
    # Either wall is a spring of 500 N/m from the cube to the ground.
    assert mode(found, "wall.left.push on alone").spectral_radius == pytest.approx(
        mode(found, "wall.right.push on alone").spectral_radius, abs=1e-12
    )


def test_a_piece_that_is_not_linear_is_taken_at_the_start_or_refused_there() -> None:
    pressed = (
        EXPERIMENTS["average"]
        .replace("OneSidedContact", "SampledHuntCrossleyContact")
        .replace(
            "stiffness: 3900 N/m, damping: 0.05 N*s/m",
            "stiffness: 3900 N/m^(3/2), damping: 0.05 N*s/m^(5/2)",
        )
    )
    apart = contact_modes(compiled(pressed))
    assert mode(apart, MODES[1]).stable is False
    assert "right is not linear and has no slope at the start values" in mode(apart, MODES[0]).refusal
    assert mode(apart, MODES[0]).stable is None
    assert "not decided when on at every peer" in apart.summary
    # Ten millimetres deep, the slope of 3900 d^1.5 is 5850 · 0.1 N/m.
    deep = pressed.replace("30 mm", "10 mm")
    found = mode(contact_modes(compiled(deep)), MODES[0])
    assert found.linearized
    alike = replaced(
        EXPERIMENTS["average"], ("stiffness: 3900 N/m, damping: 0.05", "stiffness: 585 N/m, damping: 5e-5")
    )
    expected = mode(contact_modes(compiled(alike)), MODES[0]).spectral_radius
    assert found.spectral_radius == pytest.approx(expected, abs=1e-12)
    assert found.spectral_radius == pytest.approx(analyze(compiled(deep)).spectral_radius, abs=1e-12)


def test_where_nothing_switches_there_are_no_modes() -> None:
    found = contact_modes(compiled(AVERAGE))
    assert (found.parts, found.modes, found.summary, found.unstable) == ((), (), "", ())
    assert str(found) == "three-users-average: no part switches"


def test_work_done_before_is_used_again() -> None:
    system = compiled(EXPERIMENTS["average"])
    assert contact_modes(system, prepared=prepare(system)) == contact_modes(system)


def test_a_kind_whose_loop_hides_its_decisions_is_named() -> None:
    """An MX function is what a kind with a Newton solver inside has."""
    system = alone(lambda x, u: -x + u, lambda x, u, m: -casadi.fmax(0, x))
    [kind] = system.kinds
    x, u, p, t = (casadi.MX.sym(name) for name in "xupt")
    hidden = replace(
        kind, derivative=casadi.Function("derivative", [x, u, p, t], [-casadi.fmax(x, 2 * x) + u])
    )
    found = contact_modes(replace(system, kinds=(hidden,)))
    assert found.modes == ()
    assert found.notes == ("not looked into: alone, which has a nonlinear loop",)


def test_the_result_is_plain_data_and_fits_80_columns() -> None:
    pressed = EXPERIMENTS["mesh"].replace("left:", "everybody_on_the_left_hand_side:")
    for text in (*EXPERIMENTS.values(), AVERAGE, pressed):
        found = contact_modes(compiled(text))
        data = json.loads(json.dumps(found.to_dict(), allow_nan=False))
        assert list(data) == ["topology", "parts", "unstable", "modes", "notes"]
        assert len(data["modes"]) == len(found.modes)
        assert max(len(line) for line in str(found).splitlines()) <= 80
        assert found.summary in str(found).replace("\n", " ")
