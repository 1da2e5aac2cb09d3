"""Masses, springs, contacts, hands and devices of the library, each against its closed form.

Hands whose force depends on time are integrated in `tests/time/test_forces.py`.
"""

from __future__ import annotations

import cmath
import math
from collections.abc import Callable
from pathlib import Path

import pytest

import apc
from tests.library.parts import CLOCK, TWO, coupled, held, pushes, rates, ticked, values
from tests.topologies import ONE_MASS, compiled, library, messages_of, replaced

EXACT = 1e-13  # a few roundings

# ---- mechanics ----


@pytest.mark.parametrize(
    ("count", "more", "radius"), [(1, "", math.exp(-3 / 2)), (4, ", shared: true", math.exp(-3 / (2 / 4)))]
)
def test_mass_coasts_to_rest_as_an_exponential(count: int, more: str, radius: float) -> None:
    """v falls to exp(−b T/m) in T = 1 s; a shared mass is divided among its copies, its damping is not."""
    text = replaced(ONE_MASS, ("count: 1", f"count: {count}"), ("3 N*s/m", f"3 N*s/m{more}"))
    found = apc.analyze(compiled(text))
    assert (found.frame_s, found.spectral_radius) == (1.0, pytest.approx(radius, rel=1e-14))
    assert found.rigid_modes == count
    assert apc.analyze(compiled(text.replace("damping: 3", "damping: 0"))).verdict == "drifts"


def friction(x: float, v: float) -> float:
    return 2 * math.tanh(v / 0.001) + 0.5 * v


def limited(x: float, v: float) -> float:
    return max(-9.0, min(9.0, 300 * x + 2 * v))


# The words of what ties two masses, and its force over how far a is from b and how fast it moves away.
TIES: dict[str, tuple[str, Callable[[float, float], float]]] = {
    "SpringDamper": ("stiffness: 70 N/m, damping: 4 N*s/m", lambda x, v: 70 * x + 4 * v),
    "Damper": ("damping: 4 N*s/m", lambda x, v: 4 * v),
    "CoulombViscousFriction": ("coulomb: 2 N, viscous: 0.5 N*s/m, threshold: 1 mm/s", friction),
    "SampledSpringDamper": ("stiffness: 70 N/m, damping: 4 N*s/m, clock: tick", lambda x, v: 70 * x + 4 * v),
    "ForceSaturation": ("stiffness: 300 N/m, damping: 2 N*s/m, limit: 9 N, clock: tick", limited),
    "ScaledSpringDamper": (
        "stiffness: 70 N/m, damping: 4 N*s/m, position_scale: 1, force_scale: 1, clock: tick",
        lambda x, v: 70 * x + 4 * v,
    ),
}


@pytest.mark.parametrize(("x", "v"), [(0.3, -4.0), (0.01, 0.1), (-0.5, 0.002), (0.0, -30.0), (0.01, 0.0)])
@pytest.mark.parametrize("name", TIES)
def test_what_ties_two_masses_pulls_both_by_its_law(name: str, x: float, v: float) -> None:
    words, law = TIES[name]
    model = coupled(f"type: {name}, a: device, b: load, {words}")
    moving = {"device.x": 0.2 + x, "device.v": 3.0 + v, "load.x": 0.2, "load.v": 3.0}
    force = law(x, v)
    if "clock" in words:
        assert ticked(model, moving) == {"it.f": pytest.approx(force, rel=1e-11, abs=1e-12)}
        assert pushes(model, {}, [6.0]) == pytest.approx([-6, 6], rel=EXACT)
    else:
        assert pushes(model, moving) == pytest.approx([-force, force], rel=1e-11, abs=1e-12)


def test_a_rigid_bar_halves_the_force_on_its_middle() -> None:
    text = TWO + "couplers:\n  bar: {type: RigidBar, a: device, b: load}\n"
    text += "hands:\n  hand: {type: ConstantForce, flange: bar.middle, force: 7 N}\n"
    assert pushes(compiled(text), {}) == pytest.approx([3.5, 3.5], rel=EXACT)


def test_a_gear_multiplies_displacement_and_divides_force() -> None:
    """x_a = 4 x_b: seen at a, the load is 16 times lighter, (2 + 5/16) a'' + (3 + 1/16) a' = F."""
    text = TWO + "couplers:\n  gear: {type: Gear, a: device, b: load, ratio: 4}\n"
    model = compiled(text + "hands:\n  hand: {type: ConstantForce, flange: device, force: 7 N}\n")
    speed = next(one.name for one in model.peer_types[0].states if one.name.endswith(".v"))
    factor = 1.0 if speed == "device.v" else 0.25
    found = rates(model, {speed: 0.6 * factor})
    assert len(found) == 2
    expected = (7 - (3 + 1 / 16) * 0.6) / (2 + 5 / 16)
    assert found[speed] == pytest.approx(expected * factor, rel=EXACT)


def test_a_finger_is_two_masses_of_which_one_moves_with_the_device() -> None:
    words = "tip_mass: 6 g, bone_mass: 30 g, stiffness: 500 N/m, damping: 2 N*s/m"
    model = coupled(f"type: Finger, flange: device, {words}", base=ONE_MASS)
    found = rates(model, {"device.x": 0.001, "device.v": 0.2, "it.bone.x": 0.004, "it.bone.v": -0.1})
    force = 500 * (0.001 - 0.004) + 2 * (0.2 + 0.1)
    assert (found["device.v"], found["it.bone.v"]) == (
        pytest.approx((-force - 3 * 0.2) / (2 + 0.006), rel=EXACT),
        pytest.approx(force / 0.03, rel=EXACT),
    )


# ---- contacts ----


def one_sided_peer_type(depth: float, rate: float) -> float:
    return max(0.0, 3900 * depth + 0.5 * rate) if depth > 0 else 0.0


def hunt_crossley(depth: float, rate: float) -> float:
    return max(0.0, depth) ** 1.5 * max(0.0, 5e4 + 1000 * rate)


CONTACTS: dict[str, tuple[str, Callable[[float, float], float]]] = {
    "OneSidedContact": ("stiffness: 3900 N/m, damping: 0.5 N*s/m, clock: tick", one_sided_peer_type),
    "HuntCrossleyContact": ("stiffness: 5e4 N/m^(3/2), damping: 1000 N*s/m^(5/2)", hunt_crossley),
    "SampledHuntCrossleyContact": (
        "stiffness: 5e4 N/m^(3/2), damping: 1000 N*s/m^(5/2), clock: tick",
        hunt_crossley,
    ),
}


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize("name", CONTACTS)
def test_a_contact_pushes_by_its_law_and_never_pulls(name: str, side: str) -> None:
    """Over depth = half width ± (x − x_object) and its rate, which are the same on both sides."""
    words, law = CONTACTS[name]
    model = coupled(f"type: {name}, side: {side}, a: device, b: load, half_width: 20 mm, {words}")
    sign = 1 if side == "left" else -1
    for depth, rate in ((0.004, 0.1), (0.004, -0.1), (0.004, -90.0), (-0.001, 5.0), (0.0, 1.0)):
        x = {"device.x": 0.05 + sign * (depth - 0.02), "load.x": 0.05}
        x |= {"device.v": 0.5 + sign * rate, "load.v": 0.5}
        push = pytest.approx(law(depth, rate), rel=1e-11, abs=1e-11)
        if "clock" in words:
            assert ticked(model, x) == {"it.push": push}
            assert pushes(model, {}, [6.0]) == pytest.approx([-6 * sign, 6 * sign], rel=EXACT)
        else:
            assert [-sign * pushes(model, x)[0], sign * pushes(model, x)[1]] == [push, push]


WALL = "type: VirtualWall, flange: device, stiffness: 900 N/m, clock: tick"


@pytest.mark.parametrize("side", ["left", "right"])
@pytest.mark.parametrize(("x", "before"), [(0.06, 0.059), (0.06, 0.07), (0.04, 0.041), (0.04, 0.05)])
def test_a_virtual_wall_pushes_by_depth_and_backward_difference(side: str, x: float, before: float) -> None:
    model = coupled(f"{WALL}, damping: 20 N*s/m, position: 50 mm, side: {side}", base=ONE_MASS)
    sign = 1 if side == "left" else -1
    depth, rate = sign * (x - 0.05), sign * (x - before) / 0.001
    expected = max(0.0, 900 * depth + 20 * rate) if depth > 0 else 0.0
    found = ticked(model, {"device.x": x, "device.v": 77.0}, [before])
    assert found == {"it.push": pytest.approx(expected, rel=1e-11), "it.x": x}
    assert pushes(model, {}, [6.0]) == pytest.approx([-sign * 6], rel=EXACT)


def test_enclosure_walls_push_inwards_from_both_ends() -> None:
    words = "low: -30 mm, high: 30 mm, stiffness: 900 N/m, damping: 2 N*s/m, clock: tick"
    model = coupled(f"type: EnclosureWalls, flange: device, {words}", base=ONE_MASS)
    for x in (-0.05, -0.03, -0.02, 0.0, 0.029, 0.035):
        found = ticked(model, {"device.x": x}, [x - 0.0001 * math.copysign(1, x)] * 2)
        left, right = ((900 * depth + 2 * 0.1) * (depth > 0) for depth in (-0.03 - x, x - 0.03))
        assert found["it.left.push"] == pytest.approx(left, rel=1e-11)
        assert found["it.right.push"] == pytest.approx(right, rel=1e-11)
        acting = [found[hold.name] for hold in model.peer_types[0].holds]
        assert pushes(model, {}, acting) == pytest.approx([left - right], rel=1e-11)


@pytest.mark.parametrize("x", [0.0, 0.00213, -0.00213, 0.0999])
def test_encoder_quantization_rounds_down_to_whole_steps_and_passes_forces(x: float) -> None:
    wall = WALL.replace("device", "encoder.measured")
    model = compiled(
        f"{ONE_MASS}{CLOCK}couplers:\n"
        "  encoder: {type: EncoderQuantization, flange: device, resolution: 0.5 mm}\n"
        f"  wall: {{{wall}, position: -1 m}}\n"
    )
    observed = math.floor(x / 0.0005) * 0.0005
    found = ticked(model, {"device.x": x}, [observed])
    assert found == pytest.approx({"wall.x": observed, "wall.push": 900 * (observed + 1)}, rel=EXACT)
    assert pushes(model, {}, [6.0]) == pytest.approx([-6], rel=EXACT)
    assert apc.analyze(model).linearized


# ---- hands ----


def test_a_spring_damper_arm_holds_its_point() -> None:
    words = "stiffness: 70 N/m, damping: 4 N*s/m, position: 20 mm"
    model = held(f"type: SpringDamperArm, flange: device, {words}")
    found = pushes(model, {"device.x": 0.05, "device.v": 0.3})
    assert found == pytest.approx([-70 * (0.05 - 0.02) - 4 * 0.3], rel=EXACT)
    assert apc.analyze(model).spectral_radius == pytest.approx(math.exp(-7 / 4), rel=1e-12)


# Least, nominal and largest mass in kg, damping in N·s/m and stiffness in N/m of Fu and Cavusoglu's tables II
# and III, M, b2 and k2.
STYLUS_ARMS = {
    "StylusArmSideways": ((0.14, 0.218, 0.57), (3.68, 4.645, 10.29), (63, 78.75, 151)),
    "StylusArmForward": ((0.016, 0.204, 0.43), (13.1, 18.06, 27.6), (214, 271.7, 533)),
}


def swings(mass: float, damping: float, stiffness: float) -> list[complex]:
    """Return exp(s 1 s) of both roots s of mass s² + damping s + stiffness."""
    root = cmath.sqrt(damping**2 - 4 * mass * stiffness)
    found = [cmath.exp((sign * root - damping) / (2 * mass)) for sign in (1, -1)]
    return sorted(found, key=lambda z: (z.imag, z.real))


def in_a_second(model: apc.Model) -> list[complex]:
    """Return the eigenvalues of a frame of a second, which is what a topology without clocks has."""
    return sorted((mode.eigenvalue for mode in apc.analyze(model).modes), key=lambda z: (z.imag, z.real))


@pytest.mark.parametrize("stiffness", [70.0, 3.0])  # swings, creeps
def test_a_mass_spring_damper_arm_moves_with_a_device_as_one_mass(stiffness: float) -> None:
    words = f"mass: 500 g, damping: 4 N*s/m, stiffness: {stiffness} N/m, position: 20 mm"
    model = held(f"type: MassSpringDamperArm, flange: device, {words}")
    assert in_a_second(model) == pytest.approx(swings(2 + 0.5, 3 + 4, stiffness), rel=1e-12)
    assert rates(model, {"device.x": 0.02}) == {"device.x": 0, "device.v": 0}


@pytest.mark.parametrize("name", STYLUS_ARMS)
def test_stylus_arms_have_the_published_values_and_keep_to_their_limits(name: str) -> None:
    part = f"type: {name}, flange: device"
    model = held(part)
    units = {"mass": "kg", "damping": "N*s/m", "stiffness": "N/m"}
    for (word, unit), (low, nominal, high) in zip(units.items(), STYLUS_ARMS[name], strict=True):
        assert values(model)[f"it.{word}"] == nominal
        for limit, beyond in ((low, 0.999 * low), (high, 1.001 * high)):
            assert values(held(f"{part}, {word}: {limit} {unit}"))[f"it.{word}"] == limit
            (line,) = messages_of(held, f"{part}, {word}: {beyond} {unit}")
            assert f" E207 {word}: expected {limit:g} {unit} or " in line
    (_, m, _), (_, b, _), (_, k, _) = STYLUS_ARMS[name]
    assert in_a_second(model) == pytest.approx(swings(2 + m, 3 + b, k), rel=1e-12)


# ---- devices ----

# Force in N, stiffness in N/m, damping in N·s/m, radius of the workspace in m as chai3d 7c76b1f has them, in
# src/devices/CDeltaDevices.cpp and CPhantomDevices.cpp; the first one's are given where it stands.
GIVEN = ", force_limit: 1 N, stiffness_limit: 2 N/m, damping_limit: 3 N*s/m, position_limit: 4 m"
DEVICES = {
    f"HapticDevice{GIVEN}": (1.0, 2.0, 3.0, 4.0),
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
def test_devices_have_the_published_limits_and_move_as_a_mass(name: str) -> None:
    model = compiled(replaced(ONE_MASS, ("{mass", f"{{type: {name}, mass")))
    known = values(model)
    limits = [known[f"device.{one}_limit"] for one in ("force", "stiffness", "damping", "position")]
    assert tuple(limits) == DEVICES[name]
    assert pushes(model, {"device.v": 0.3}) == pytest.approx([0], abs=1e-15)
    if name == "Falcon":
        assert known["device.resolution"] == pytest.approx(0.0254 / 400, rel=1e-15)  # 400 steps an inch


def test_a_table_is_handed_on_to_a_part_inside(tmp_path: Path) -> None:
    tabled = (
        "component: Tabled\nconnectors: {flange: Flange}\nparameters: {push: {table: UNIT}}\n"
        "parts: {hand: {type: TableForce, flange: flange, force: push}}\n"
    )
    (tmp_path / "force.csv").write_text("time [s],force [N]\n0,2\n1,2\n", encoding="utf-8")
    library(tmp_path, tabled.replace("UNIT", "N"))
    path = tmp_path / "topology.yaml"
    hands = "library: ./\nhands:\n  it: {type: Tabled, flange: device, push: force.csv}\n"
    path.write_text(ONE_MASS + hands, encoding="utf-8")
    assert pushes(apc.compile(path), {}) == pytest.approx([2.0], rel=1e-14)
    library(tmp_path, tabled.replace("UNIT", "mm"))
    [line] = messages_of(apc.compile, path)
    assert "E204 force: expected N, got mm." in line
