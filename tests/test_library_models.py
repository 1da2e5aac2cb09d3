"""The library: each component against its closed form (the first ones stand in `test_models`)."""

from __future__ import annotations

import cmath
import math
import re
from collections.abc import Mapping, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import casadi
import pytest

import apc
from apc.analysis.analysis import analyze
from apc.compiler.compiled import CompiledSystem
from apc.compiler.components.component import Reference
from apc.compiler.components.library import Library
from apc.compiler.pipeline import compile_topology
from apc.frame.overrides import apply, parse_override
from apc.simulation.trajectory import simulate
from apc.vary.critical import critical
from tests.topologies import MESH, ONE_MASS, SCENES, compiled, library, replaced, scene, told

ROOT = Path(__file__).resolve().parents[1]
CLOCK = "clocks: {tick: 1 ms}\n"
TWO = ONE_MASS.replace("3 N*s/m}", "3 N*s/m}\n  load: {mass: 5 kg, damping: 1 N*s/m}")
EXACT = 1e-14  # a few roundings


def numbers(result: Any) -> list[float]:
    return [float(value) for value in casadi.DM(result).full().ravel()]


def values(system: CompiledSystem) -> dict[str, float]:
    return {parameter.name: parameter.value for parameter in system.parameters}


def rates(
    system: CompiledSystem, x: Mapping[str, float], u: Sequence[float] = (), t: float = 0.0
) -> dict[str, float]:
    """Return dx/dt by state, at x by state; what isn't named is 0."""
    (kind,) = system.kinds
    states = [state.name for state in kind.states]
    assert set(x) <= set(states)
    p = [values(system)[name] for name in kind.parameters]
    found = numbers(kind.derivative([x.get(name, 0.0) for name in states], list(u), p, t))
    return dict(zip(states, found, strict=True))


def ticked(
    system: CompiledSystem, x: Mapping[str, float], m: Sequence[float] = (), r: Sequence[float] = ()
) -> dict[str, float]:
    """Return what the only clock computes, at x by state."""
    (kind,) = system.kinds
    (clock,) = kind.clocks
    states = [state.name for state in kind.states]
    assert set(x) <= set(states)
    p = [values(system)[name] for name in kind.parameters]
    u = [0.0] * len(kind.holds)
    y = clock.tick([x.get(name, 0.0) for name in states], u, list(m), list(r), p, 0)
    return dict(zip(clock.outputs, numbers(y), strict=True))


def coupled(part: str, *, base: str = TWO) -> CompiledSystem:
    return compiled(f"{base}{CLOCK}couplers:\n  it: {{{part}}}\n")


def held(part: str) -> CompiledSystem:
    return compiled(f"{ONE_MASS}hands:\n  it: {{{part}}}\n")


def push(system: CompiledSystem, t: float) -> float:
    """Return the force on the mass of 2 kg, at rest at 0."""
    return 2 * rates(system, {}, t=t)["device.v"]


# ---- the library as a whole ----


def test_every_component_loads() -> None:
    found = Library()
    for name in found.component_names:
        assert found.component(name) is not None, name


def test_every_component_is_tested() -> None:
    tests = ("models", "schemes", "schemes_in_time", "planar", "library_models")
    pages = [ROOT / "tests" / f"test_{name}.py" for name in tests]
    text = "\n".join(page.read_text(encoding="utf-8") for page in pages)
    for name in Library().component_names:
        words = "".join(f"_{letter.lower()}" if letter.isupper() else letter for letter in name)
        assert re.search(rf"\b{name}\b|def test{words}_", text), name


def test_every_component_says_what_it_is_where_it_comes_from_and_what_its_numbers_are() -> None:
    found = Library()
    for name in found.component_names:
        component = found.component(name)
        assert component is not None
        assert component.about.endswith("."), name
        assert component.source, name
        for parameter in component.parameters:
            assert parameter.about or isinstance(parameter, Reference), f"{name}.{parameter.name}"


# ---- mechanics ----


def test_spring_damper_pulls_both_ends() -> None:
    system = coupled("type: SpringDamper, a: device, b: load, stiffness: 70 N/m, damping: 4 N*s/m")
    found = rates(system, {"device.x": 0.5, "device.v": -1.0, "load.x": 0.2, "load.v": 3.0})
    force = 70 * (0.5 - 0.2) + 4 * (-1.0 - 3.0)
    assert found == pytest.approx(
        {"device.x": -1, "device.v": (-force + 3) / 2, "load.x": 3, "load.v": (force - 3) / 5}, rel=EXACT
    )


def test_spring_damper_to_the_ground_is_the_oscillator_of_the_textbook() -> None:
    """m s² + (b + B) s + K = 0: an underdamped motion shrinks by exp(−(b + B) T/(2m)) in T = 1 s."""
    system = coupled(
        "type: SpringDamper, a: device, b: ground, stiffness: 70 N/m, damping: 4 N*s/m", base=ONE_MASS
    )
    assert apc.analyze(system).spectral_radius == pytest.approx(math.exp(-7 / 4), rel=1e-12)


def test_damper_to_the_ground_adds_to_that_of_the_mass() -> None:
    system = coupled("type: Damper, a: device, b: ground, damping: 4 N*s/m", base=ONE_MASS)
    assert rates(system, {"device.v": 0.5})["device.v"] == pytest.approx(-7 * 0.5 / 2, rel=EXACT)
    assert apc.analyze(system).spectral_radius == pytest.approx(math.exp(-7 / 2), rel=1e-12)


BAR = replaced(TWO, ("masses:\n", "masses:\n  pin: {mass: 4 kg}\n")) + (
    "couplers:\n  bar: {type: RigidBar, a: device, b: load, middle: pin}\n"
)


def test_rigid_bar_halves_the_force_on_its_middle() -> None:
    """With y = (x + z)/2 and R what the bar carries: 4 y'' = 7 − R, 2 x'' = R/2 − 3 x', 5 z'' = R/2 − z'."""
    x, z = 0.5, -1.0
    carried = (7 + 2 * (3 * x / 2 + z / 5)) / (1 + 2 * (1 / 4 + 1 / 10))
    device, load = (carried / 2 - 3 * x) / 2, (carried / 2 - z) / 5
    speeds = {"device.v": x, "load.v": z, "pin.v": (x + z) / 2}
    expected = {"device.v": device, "load.v": load, "pin.v": (device + load) / 2}
    system = compiled(BAR + "hands:\n  hand: {type: ConstantForce, flange: pin, force: 7 N}\n")
    kept = [state.name for state in system.kinds[0].states if state.name in speeds]
    assert len(kept) == 2, "three velocities, one constraint"
    found = rates(system, {name: speeds[name] for name in kept})
    assert [found[name] for name in kept] == pytest.approx([expected[name] for name in kept], rel=1e-13)


def test_rigid_bar_may_have_a_middle_without_mass() -> None:
    """A hand joined to the middle alone: each end gets half of its force."""
    text = TWO + (
        "couplers:\n  bar: {type: RigidBar, a: device, b: load}\n"
        "hands:\n  hand: {type: ConstantForce, flange: bar.middle, force: 7 N}\n"
    )
    found = rates(compiled(text), {})
    assert (found["device.v"], found["load.v"]) == pytest.approx((3.5 / 2, 3.5 / 5), rel=1e-14)


def test_gear_multiplies_displacement_and_divides_force() -> None:
    """x_a = 4 x_b: seen at a, the load is 16 times lighter, (2 + 5/16) a'' + (3 + 1/16) a' = F."""
    text = TWO + (
        "couplers:\n  gear: {type: Gear, a: device, b: load, ratio: 4}\n"
        "hands:\n  hand: {type: ConstantForce, flange: device, force: 7 N}\n"
    )
    system = compiled(text)
    speed = next(s.name for s in system.kinds[0].states if s.name.endswith(".v"))
    factor = 1.0 if speed == "device.v" else 0.25
    found = rates(system, {speed: 0.6 * factor})
    assert len(found) == 2
    expected = (7 - (3 + 1 / 16) * 0.6) / (2 + 5 / 16)
    assert found[speed] == pytest.approx(expected * factor, rel=1e-13)


@pytest.mark.parametrize("speed", [-0.3, -0.001, 0.0, 0.002, 1.0])
def test_coulomb_viscous_friction_is_a_regularized_sign(speed: float) -> None:
    part = (
        "type: CoulombViscousFriction, a: device, b: ground, coulomb: 2 N, viscous: 0.5 N*s/m,"
        " threshold: 1 mm/s"
    )
    found = rates(coupled(part, base=ONE_MASS), {"device.v": speed})["device.v"]
    force = 2 * math.tanh(speed / 0.001) + 0.5 * speed
    assert found == pytest.approx((-force - 3 * speed) / 2, rel=EXACT)


def test_finger_is_two_masses_of_which_one_moves_with_the_device() -> None:
    part = (
        "type: Finger, flange: device, tip_mass: 6 g, bone_mass: 30 g, stiffness: 500 N/m, damping: 2 N*s/m"
    )
    system = coupled(part, base=ONE_MASS)
    x = {"device.x": 0.001, "device.v": 0.2, "it.bone.x": 0.004, "it.bone.v": -0.1}
    force = 500 * (0.001 - 0.004) + 2 * (0.2 + 0.1)
    assert rates(system, x) == pytest.approx(
        {
            "device.x": 0.2,
            "device.v": (-force - 3 * 0.2) / (2 + 0.006),
            "it.bone.x": -0.1,
            "it.bone.v": force / 0.03,
        },
        rel=1e-13,
    )


# ---- contacts ----

# Depth = half width ± (x − x_object); rate its derivative; for both sides the same depth and rate.
DEPTHS = [(0.004, 0.1), (0.004, -0.1), (0.004, -90.0), (-0.001, 5.0), (0.0, 1.0)]


def approached(side: str, depth: float, rate: float) -> dict[str, float]:
    """Return where a device stands that is this deep in an object of 20 mm half width at 50 mm."""
    sign = 1 if side == "left" else -1
    return {
        "device.x": 0.05 + sign * (depth - 0.02),
        "device.v": 0.5 + sign * rate,
        "load.x": 0.05,
        "load.v": 0.5,
    }


def acting(system: CompiledSystem, force: float) -> tuple[float, float]:
    """Return the forces on device and load when the only hold puts out `force`, both at rest."""
    found = rates(system, {}, [force])
    return 2 * found["device.v"], 5 * found["load.v"]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("depth", "rate"), DEPTHS)
def test_one_sided_contact_pushes_and_never_pulls(side: str, depth: float, rate: float) -> None:
    part = (
        f"type: OneSidedContact, side: {side}, a: device, b: load, half_width: 20 mm, stiffness: 3900 N/m,"
        " damping: 0.5 N*s/m, clock: tick"
    )
    system = coupled(part)
    expected = max(0.0, 3900 * depth + 0.5 * rate) if depth > 0 else 0.0
    found = ticked(system, approached(side, depth, rate))
    assert found == {"it.push": pytest.approx(expected, rel=1e-11, abs=1e-12)}
    outwards = -1 if side == "left" else 1
    assert acting(system, 6.0) == pytest.approx((6 * outwards, -6 * outwards), rel=EXACT)


def test_one_sided_contact_takes_the_side_its_group_says() -> None:
    text = replaced(
        TWO, ("peers: {user: {count: 1}}", "peers: {w: {count: 1}, e: {count: 1, set: {it.side: right}}}")
    )
    part = "type: OneSidedContact, a: device, b: load, stiffness: 100 N/m, clock: tick"
    system = compiled(f"{text}{CLOCK}couplers:\n  it: {{{part}}}\n")
    assert len(system.kinds) == 1, "they differ in a number only"
    assert values(system)["it.side"] == 1
    assert [[(p.name, p.value) for p in group.values] for group in system.groups] == [[], [("it.side", -1)]]


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("depth", "rate"), DEPTHS)
@pytest.mark.parametrize("name", ["HuntCrossleyContact", "SampledHuntCrossleyContact"])
def test_hunt_crossley_contact_grows_with_depth_to_the_power_one_and_a_half(
    name: str, side: str, depth: float, rate: float
) -> None:
    part = (
        f"type: {name}, side: {side}, a: device, b: load, half_width: 20 mm, stiffness: 5e4 N/m^(3/2),"
        " damping: 1000 N*s/m^(5/2)"
    )
    expected = max(0.0, depth) ** 1.5 * max(0.0, 5e4 + 1000 * rate)
    x = approached(side, depth, rate)
    if name.startswith("Sampled"):
        system = coupled(f"{part}, clock: tick")
        assert ticked(system, x) == {"it.push": pytest.approx(expected, rel=1e-11, abs=1e-12)}
        outwards = -1 if side == "left" else 1
        assert acting(system, 6.0) == pytest.approx((6 * outwards, -6 * outwards), rel=EXACT)
    else:
        found = rates(coupled(part), x)
        force = expected if side == "left" else -expected  # on the object
        assert 5 * found["load.v"] + 0.5 == pytest.approx(force, rel=1e-11, abs=1e-12)
        assert 2 * found["device.v"] + 3 * x["device.v"] == pytest.approx(-force, rel=1e-11, abs=1e-11)


WALL = "type: VirtualWall, flange: device, stiffness: 900 N/m, clock: tick"


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(
    ("x", "before"), [(0.06, 0.059), (0.06, 0.07), (0.04, 0.041), (0.04, 0.05), (0.06, 0.061)]
)
def test_virtual_wall_pushes_by_depth_and_backward_difference(side: str, x: float, before: float) -> None:
    system = coupled(f"{WALL}, damping: 20 N*s/m, position: 50 mm, side: {side}", base=ONE_MASS)
    sign = 1 if side == "left" else -1
    depth, rate = sign * (x - 0.05), sign * (x - before) / 0.001
    expected = max(0.0, 900 * depth + 20 * rate) if depth > 0 else 0.0
    found = ticked(system, {"device.x": x, "device.v": 77.0}, m=[before])
    assert found == {"it.push": pytest.approx(expected, rel=1e-11), "it.x": x}
    assert rates(system, {}, [6.0])["device.v"] == pytest.approx(-sign * 6 / 2, rel=EXACT)


@pytest.mark.parametrize(
    ("mass", "damping", "delay", "critical"), [(0.1, 5.0, 1, 3378.939), (0.04, 0.8, 0, 1605.351)]
)
def test_virtual_wall_is_stable_up_to_its_critical_stiffness(
    mass: float, damping: float, delay: int, critical: float
) -> None:
    """In contact, without wall damping; the exact step of the device over 1 ms, computed independently.

    The critical stiffness is printed to three decimals. The linear rule of Gil et al., K < b/(T/2 + delay),
    lies within 4 % of it.
    """
    text = (
        "topology: wall\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\n"
        f"masses: {{device: {{mass: {mass} kg, damping: {damping} N*s/m, x: 1 mm}}}}\n"
        f"couplers: {{it: {{{WALL.replace('900', '%r')}, delay: {delay} ms, x: 1 mm}}}}\n"
    )
    below = apc.analyze(compiled(text % (critical * (1 - 1e-6))))
    above = apc.analyze(compiled(text % (critical * (1 + 1e-6))))
    assert (below.verdict, above.verdict) == ("stable", "unstable")
    assert below.linearized
    assert critical == pytest.approx(damping / (0.0005 + 0.001 * delay), rel=0.04)


@pytest.mark.parametrize("x", [-0.05, -0.03, -0.02, 0.0, 0.029, 0.035])
def test_enclosure_walls_push_inwards_from_both_ends(x: float) -> None:
    part = "type: EnclosureWalls, flange: device, low: -30 mm, high: 30 mm, stiffness: 900 N/m, clock: tick"
    system = coupled(part, base=ONE_MASS)
    (kind,) = system.kinds
    found = ticked(system, {"device.x": x}, m=[x, x])
    left, right = 900 * max(0.0, -0.03 - x), 900 * max(0.0, x - 0.03)
    assert (found["it.left.push"], found["it.right.push"]) == pytest.approx((left, right), rel=1e-12)
    u = [found[hold.name] for hold in kind.holds]
    assert rates(system, {}, u)["device.v"] == pytest.approx((left - right) / 2, rel=1e-12)


@pytest.mark.parametrize(("x", "v"), [(0.01, 0.1), (0.5, 0.0), (-0.5, 0.2), (0.0, -30.0)])
def test_force_saturation_limits_a_spring_and_damper(x: float, v: float) -> None:
    limited = "stiffness: 300 N/m, damping: 2 N*s/m, limit: 9 N"
    part = f"type: ForceSaturation, a: device, b: load, {limited}, clock: tick"
    system = coupled(part)
    found = ticked(system, {"device.x": 0.3 + x, "device.v": v, "load.x": 0.3})
    assert found == {"it.f": pytest.approx(max(-9.0, min(9.0, 300 * x + 2 * v)), rel=1e-12)}
    assert acting(system, 6.0) == pytest.approx((-6, 6), rel=EXACT)


@pytest.mark.parametrize("x", [0.0, 0.00213, -0.00213, 0.0999])
def test_encoder_quantization_rounds_down_to_whole_steps_and_passes_forces(x: float) -> None:
    text = (
        ONE_MASS
        + CLOCK
        + (
            "couplers:\n  encoder: {type: EncoderQuantization, flange: device, resolution: 0.5 mm}\n"
            "  wall: {type: VirtualWall, flange: encoder.measured, position: -1 m, stiffness: 900 N/m,"
            " clock: tick}\n"
        )
    )
    system = compiled(text)
    seen = math.floor(x / 0.0005) * 0.0005
    found = ticked(system, {"device.x": x}, m=[seen])
    assert found == pytest.approx({"wall.x": seen, "wall.push": 900 * (seen + 1)}, rel=1e-13)
    assert rates(system, {}, [6.0])["device.v"] == pytest.approx(-6 / 2, rel=EXACT)


@pytest.mark.parametrize(
    "part",
    [
        "encoder: {type: EncoderQuantization, flange: device, resolution: 0.5 mm}\n"
        "  pull: {type: SampledSpringDamper, a: encoder.measured, b: ground, stiffness: 90 N/m, clock: tick}",
        "rub: {type: CoulombViscousFriction, a: device, b: ground, coulomb: 2 N, threshold: 1 mm/s}",
    ],
)
def test_what_jumps_or_bends_is_analysed_about_the_start(part: str) -> None:
    found = apc.analyze(compiled(f"{ONE_MASS}{CLOCK}couplers:\n  {part}\n"))
    assert found.linearized


# ---- coordination ----


def mesh(name: str, more: str = "") -> CompiledSystem:
    text = ONE_MASS.replace("count: 1", "count: 4")
    return compiled(
        f"{text}{CLOCK}links: {{lan: {{clock: tick}}}}\n"
        f"couplers: {{it: {{type: {name}, object: device, stiffness: 70 N/m, damping: 4 N*s/m, clock: tick,"
        f" link: lan{more}}}}}\n"
    )


def test_saturated_mesh_limits_each_coupling() -> None:
    system = mesh("SaturatedMesh", ", limit: 9 N")
    (kind,) = system.kinds
    ((receive,),) = [clock.receives for clock in kind.clocks]
    assert (receive.operator, receive.link) == ("sum", "lan")
    x, v = 0.5, -1.0
    others = [(0.45, -1.1), (-0.3, 1.0), (0.9, -5.0)]
    p = [values(system)[name] for name in kind.parameters]
    channels = kind.sends[0].channels
    assert receive.edge is not None
    heard = 0.0
    for x_j, v_j in others:
        sent = [{"it.x": x_j, "it.v": v_j}[channel] for channel in channels]
        (one,) = numbers(receive.edge([x, v], [0.0], [], sent, p, 0))
        assert one == pytest.approx(max(-9.0, min(9.0, 70 * (x - x_j) + 4 * (v - v_j))), rel=1e-13)
        heard += one
    assert ticked(system, {"device.x": x, "device.v": v}, r=[heard]) == {"it.f": pytest.approx(heard)}
    assert rates(system, {}, [6.0])["device.v"] == pytest.approx(-6 / 2, rel=EXACT)


def test_saturated_mesh_is_a_full_mesh_below_its_limit() -> None:
    """Linearized about a start at rest, the limit is far away: the same radius, by the road of N² pairs."""
    mesh_of_three = apc.analyze(compiled(MESH))
    limited = apc.analyze(compiled(replaced(MESH, ("type: FullMesh", "type: SaturatedMesh, limit: 5 N"))))
    assert limited.spectral_radius == pytest.approx(mesh_of_three.spectral_radius, rel=1e-13)
    assert (mesh_of_three.linearized, limited.linearized) == (False, True)


# ---- hands ----


@pytest.mark.parametrize(("t", "force"), [(0.0, 0.0), (0.199, 0.0), (0.2, 5.0), (3.0, 5.0)])
def test_step_force_begins_at_its_start(t: float, force: float) -> None:
    assert push(held("type: StepForce, flange: device, force: 5 N, start: 200 ms"), t) == force


@pytest.mark.parametrize(("t", "share"), [(0.0, 0.0), (0.2, 0.0), (0.3, 0.2), (0.7, 1.0), (9.0, 1.0)])
def test_ramp_force_grows_evenly(t: float, share: float) -> None:
    system = held("type: RampForce, flange: device, force: -5 N, start: 200 ms, rise: 500 ms")
    assert push(system, t) == pytest.approx(-5 * share, rel=1e-14, abs=1e-15)


@pytest.mark.parametrize("t", [0.0, 0.01, 0.125, 3.3])
def test_sine_force_has_its_frequency_and_phase(t: float) -> None:
    system = held("type: SineForce, flange: device, force: 5 N, frequency: 2 Hz, phase: 90 deg")
    assert push(system, t) == pytest.approx(5 * math.cos(2 * math.pi * 2 * t), rel=1e-12, abs=1e-12)


@pytest.mark.parametrize(
    ("t", "force"), [(0.0, 2.0), (0.1, 2.0), (0.15, 3.0), (0.2, 4.0), (0.3, 0.0), (9.0, -4.0)]
)
def test_table_force_joins_the_rows_of_its_file(tmp_path: Path, t: float, force: float) -> None:
    (tmp_path / "force.csv").write_text("time [ms],force [N]\n100,2\n200,4\n400,-4\n", encoding="utf-8")
    path = tmp_path / "scene.yaml"
    text = f"{ONE_MASS}hands:\n  it: {{type: TableForce, flange: device, force: force.csv}}\n"
    path.write_text(text, encoding="utf-8")
    assert push(compile_topology(path), t) == pytest.approx(force, rel=1e-14, abs=1e-14)


def test_spring_damper_arm_holds_its_point() -> None:
    system = held(
        "type: SpringDamperArm, flange: device, stiffness: 70 N/m, damping: 4 N*s/m, position: 20 mm"
    )
    found = rates(system, {"device.x": 0.05, "device.v": 0.3})["device.v"]
    assert found == pytest.approx((-70 * (0.05 - 0.02) - 7 * 0.3) / 2, rel=1e-14)
    assert rates(system, {"device.x": 0.02})["device.v"] == 0
    assert apc.analyze(system).spectral_radius == pytest.approx(math.exp(-7 / 4), rel=1e-12)


# Least, nominal and largest mass in kg, damping in N·s/m and stiffness in N/m of Fu and Cavusoglu's tables II
# and III, M, b2 and k2; and nominal stiffness and damping of the fingers, k1 and b1.
STYLUS_ARMS = {
    "StylusArmSideways": ((0.14, 0.218, 0.57), (3.68, 4.645, 10.29), (63, 78.75, 151), (379.5, 1.839)),
    "StylusArmForward": ((0.016, 0.204, 0.43), (13.1, 18.06, 27.6), (214, 271.7, 533), (769.9, 0.776)),
}


def in_a_second(system: CompiledSystem) -> list[complex]:
    """Return the eigenvalues of a frame of a second, which is what a scene without clocks has."""
    return sorted((mode.eigenvalue for mode in apc.analyze(system).modes), key=lambda z: (z.imag, z.real))


def swings(mass: float, damping: float, stiffness: float) -> list[complex]:
    """Return exp(s 1 s) of both roots s of mass s² + damping s + stiffness, in the order of `in_a_second`."""
    root = cmath.sqrt(damping**2 - 4 * mass * stiffness)
    found = [cmath.exp((sign * root - damping) / (2 * mass)) for sign in (1, -1)]
    return sorted(found, key=lambda z: (z.imag, z.real))


@pytest.mark.parametrize("stiffness", [70.0, 3.0])  # swings, creeps
def test_mass_spring_damper_arm_moves_with_a_device_as_one_mass(stiffness: float) -> None:
    system = held(
        "type: MassSpringDamperArm, flange: device, mass: 500 g, damping: 4 N*s/m,"
        f" stiffness: {stiffness} N/m, position: 20 mm"
    )
    assert in_a_second(system) == pytest.approx(swings(2 + 0.5, 3 + 4, stiffness), rel=1e-12)
    assert rates(system, {"device.x": 0.02}) == {"device.x": 0, "device.v": 0}


@pytest.mark.parametrize("name", STYLUS_ARMS)
def test_stylus_arms_have_the_published_values_and_keep_to_their_limits(name: str) -> None:
    part = f"type: {name}, flange: device"
    system = held(part)
    *ranges, _ = STYLUS_ARMS[name]
    units = {"mass": "kg", "damping": "N*s/m", "stiffness": "N/m"}
    for (word, unit), (low, nominal, high) in zip(units.items(), ranges, strict=True):
        assert values(system)[f"it.{word}"] == nominal
        for limit, beyond in ((low, 0.999 * low), (high, 1.001 * high)):
            assert values(held(f"{part}, {word}: {limit} {unit}"))[f"it.{word}"] == limit
            (line,) = told(held, f"{part}, {word}: {beyond} {unit}")
            assert f" E207 {word} wants {limit:g} {unit} or " in line
    (_, m, _), (_, b, _), (_, k, _) = ranges
    assert in_a_second(system) == pytest.approx(swings(2 + m, 3 + b, k), rel=1e-12)


@pytest.mark.parametrize("name", STYLUS_ARMS)
def test_stylus_arms_hold_a_device_through_fingers_that_give(name: str) -> None:
    (_, m, _), (_, b, _), (_, k, _), (stiffness, damping) = STYLUS_ARMS[name]
    system = compiled(
        f"{ONE_MASS}couplers:\n  fingers: {{type: SpringDamper, a: device, stiffness: {stiffness} N/m,"
        f" damping: {damping} N*s/m}}\nhands:\n  it: {{type: {name}, flange: fingers.b}}\n"
    )
    force = stiffness * (0.001 - 0.004) + damping * (0.2 + 0.1)
    assert rates(
        system, {"device.x": 0.001, "device.v": 0.2, "it.hand.x": 0.004, "it.hand.v": -0.1}
    ) == pytest.approx(
        {
            "device.x": 0.2,
            "device.v": (-force - 3 * 0.2) / 2,
            "it.hand.x": -0.1,
            "it.hand.v": (force - k * 0.004 + b * 0.1) / m,
        },
        rel=1e-13,
    )


# ---- devices ----

# Force in N, stiffness in N/m, damping in N·s/m, radius of the workspace in m as chai3d 7c76b1f has them, in
# src/devices/CDeltaDevices.cpp and CPhantomDevices.cpp.
LIMITS = ("force", "stiffness", "damping", "position")
DEVICES = {
    "Falcon": (8.0, 3000.0, 20.0, 0.04),
    "Omega3": (12.0, 5000.0, 30.0, 0.075),
    "Delta3": (20.0, 5000.0, 30.0, 0.15),
    "Sigma7": (12.0, 4000.0, 30.0, 0.075),
    "Lambda7": (12.0, 8000.0, 30.0, 0.1125),
    "Touch": (3.3, 400.0, 4.0, 0.075),
    "PhantomOmni": (3.3, 700.0, 5.0, 0.1),
    "PhantomDesktop": (7.9, 1000.0, 5.0, 0.1),
}


@pytest.mark.parametrize("name", DEVICES)
def test_device_presets_have_the_published_limits_and_move_as_a_mass(name: str) -> None:
    text = replaced(ONE_MASS, ("{mass", f"{{type: {name}, mass"))
    system = compiled(text)
    limits = [values(system)[f"device.{limit}_limit"] for limit in LIMITS]
    assert tuple(limits) == DEVICES[name]
    assert not {"device.force_limit", "device.stiffness_limit"} & set(system.kinds[0].parameters)
    assert rates(system, {"device.v": 0.3}) == rates(compiled(ONE_MASS), {"device.v": 0.3})


def test_device_presets_do_not_guess_mass_or_damping() -> None:
    text = replaced(ONE_MASS, ("{mass: 2 kg, damping: 3 N*s/m}", "{type: Touch}"))
    assert [line.partition(" ")[2] for line in told(scene, text)] == [
        "E201 device has no mass and damping. Write: mass: 1 kg, damping: 1 N*s/m",
    ]


def test_haptic_device_is_a_device_whose_limits_are_given() -> None:
    text = replaced(
        ONE_MASS,
        (
            "{mass",
            "{type: HapticDevice, force_limit: 1 N, stiffness_limit: 2 N/m, damping_limit: 3 N*s/m,"
            " position_limit: 1 m, mass",
        ),
    )
    assert rates(compiled(text), {"device.v": 0.3}) == rates(compiled(ONE_MASS), {"device.v": 0.3})


def test_the_falcon_has_four_hundred_steps_an_inch() -> None:
    text = replaced(ONE_MASS, ("{mass", "{type: Falcon, mass"))
    assert values(compiled(text))["device.resolution"] == pytest.approx(0.0254 / 400, rel=1e-15)


# ---- what components may say ----


@pytest.mark.parametrize("term", ["others.x", "max(others.x, sample(flange.x))"])
def test_a_value_of_each_other_peer_is_one_value_only_inside_a_reduction(tmp_path: Path, term: str) -> None:
    follower = (
        "component: Follower\nconnectors: {flange: Flange}\nsends: {x: sample(flange.x)}\n"
        "parameters: {clock: clock, link: link, k: {unit: N/m}}\n"
        f"equations:\n  - f = k*({term})\n  - flange.f = hold(f)\n"
    )
    text = (
        f"{ONE_MASS.replace('count: 1', 'count: 2')}{CLOCK}links: {{lan: {{clock: tick}}}}\n"
        "couplers: {it: {type: Follower, k: 1 N/m, flange: device, clock: tick, link: lan}}\n"
    )
    [line] = told(compiled, text, library(tmp_path, follower))
    assert line.partition(" ")[2] == (
        "E506 others.x of it is a value of each other peer, and one is due here."
        " Write: mean(others.x), or sum, max, min"
    )


TABLED = (
    "component: Tabled\nconnectors: {flange: Flange}\nparameters: {push: {table: N}}\n"
    "parts: {hand: {type: TableForce, flange: flange, force: push}}\n"
)


def test_a_table_is_handed_on_to_a_part_inside(tmp_path: Path) -> None:
    (tmp_path / "force.csv").write_text("time [s],force [N]\n0,2\n1,4\n", encoding="utf-8")
    (tmp_path / "parts").mkdir()
    (tmp_path / "parts" / "tabled.yaml").write_text(TABLED, encoding="utf-8")
    path = tmp_path / "scene.yaml"
    hands = "library: ./parts\nhands:\n  it: {type: Tabled, flange: device, push: force.csv}\n"
    path.write_text(ONE_MASS + hands, encoding="utf-8")
    assert push(compile_topology(path), 0.25) == pytest.approx(2.5, rel=1e-14)


@pytest.mark.parametrize(
    ("old", "new", "sentence"),
    [
        ("push: {table: N}", "push: {table: mm}", "E204 force wants N, got mm."),
        (
            "force: push",
            "force: pull",
            "E206 hand names table pull, which is no table of Tabled; there are: push.",
        ),
    ],
)
def test_a_table_handed_on_must_be_there_and_of_the_same_unit(
    tmp_path: Path, old: str, new: str, sentence: str
) -> None:
    own = library(tmp_path, replaced(TABLED, (old, new)))
    lines = told(own.component, "Tabled")
    assert [line.partition(" ")[2] for line in lines] == [sentence]


# What computes with the period of its clock, of the library and of a component of one's own.
PERIODS = {
    "finger": ("haptic: tick", "haptic: 2 ms"),
    "limited-motor": ("haptic: 1 ms", "haptic: 2 ms"),
    "stiff-wall-passivity": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-dead-reckoning": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-filtered-waves": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-passivity": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-reported": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-set-position": ("haptic: 1 ms", "haptic: 2 ms"),
    "two-users-waves": ("haptic: 1 ms", "haptic: 2 ms"),
}


FILTER = """\
component: Filtered
connectors: {a: Flange}
parameters: {stiffness: {unit: N/m}, corner: {unit: rad/s}, clock: clock}
variables: {y: {unit: m, start: 0}}
equations:
  - y = previous(y) + corner*interval(clock)*(sample(a.x) - previous(y))
  - a.f = hold(stiffness*y, interval(clock)/2)
"""
FILTERED = """\
topology: filtered
clocks: {haptic: 1 ms, slow: 5 ms}
peers: {one: {count: 1}, two: {count: 1, set: {wall.clock: slow}}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 mm}}
couplers: {wall: {type: Filtered, a: device, stiffness: 500 N/m, corner: 100 rad/s, clock: haptic}}
"""


def _set(system: CompiledSystem, setting: str) -> CompiledSystem:
    return apply(system, [parse_override(system, setting)])


def _motion(system: CompiledSystem) -> tuple[float, list[list[float]]]:
    """Return the spectral radius of a scene, and the rows of its first moments."""
    return analyze(system).spectral_radius, simulate(
        system, duration=Fraction(6, 100), jit=False
    ).values.tolist()


@pytest.mark.parametrize(("name", "period"), PERIODS.items())
def test_a_period_that_is_set_reaches_what_computes_with_it(name: str, period: tuple[str, str]) -> None:
    """Set without compiling again it is as written in the file: motion and spectral radius."""
    text = (SCENES / f"{name}.yaml").read_text(encoding="utf-8")
    set_, written = _set(compiled(text), "haptic.period=2 ms"), compiled(replaced(text, period))
    assert _motion(set_) == _motion(written)
    assert _motion(written)[1] != _motion(compiled(text))[1]


def test_a_filter_of_ones_own_has_the_period_of_the_clock_each_group_names(tmp_path: Path) -> None:
    own = library(tmp_path, FILTER)
    system = compiled(FILTERED, own)
    for setting, period in (("haptic.period=2 ms", ("haptic: 1 ms", "haptic: 2 ms")),
                            ("slow.period=4 ms", ("slow: 5 ms", "slow: 4 ms"))):  # fmt: skip
        written = compiled(replaced(FILTERED, period), own)
        assert _motion(_set(system, setting)) == _motion(written)
    stiffest = [critical(one, "wall.stiffness").value for one in (_set(system, setting), written)]
    assert stiffest[0] == stiffest[1]
    assert {one.name: one.exact for one in system.parameters if one.name.endswith(".period")} == {
        "haptic.period": Fraction(1, 1000),
        "slow.period": Fraction(1, 200),
    }
    # By hand, of the first group: y' = y + ω T (x - y) at each tick, acting half a tick later.
    ticked_ = ticked(compiled(FILTERED.replace(", two: {count: 1, set: {wall.clock: slow}}", ""), own),
                     {"device.x": 1e-3}, m=[4e-4])  # fmt: skip
    assert ticked_["wall.y"] == pytest.approx(4e-4 + 100 * 1e-3 * (1e-3 - 4e-4), rel=1e-15)


@pytest.mark.parametrize(
    ("written", "said"),
    [
        ("interval(cloc)", "E303 Filtered has no interval(cloc); the nearest is interval(clock)."),
        ("interval(2*corner)", "E325 interval wants the name of a clock, got 2*corner."),
        ("interval()", "E325 interval wants 1 argument, got 0."),
        ("stiffness*interval(clock)/stiffness^2", "E401 "),
    ],
)
def test_what_is_no_clock_has_no_interval(written: str, said: str, tmp_path: Path) -> None:
    own = library(tmp_path, FILTER.replace("corner*interval(clock)", f"corner*{written}"))
    assert said in told(lambda: scene(FILTERED, own))[0]


def test_no_component_of_the_library_asks_for_a_copy_of_a_period() -> None:
    found = Library()
    for name in found.component_names:
        component = found.component(name)
        assert component is not None
        assert component.parameter("period") is None
