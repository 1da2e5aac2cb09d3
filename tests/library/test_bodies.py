"""Bodies that turn, in a plane and in space, against their closed forms."""

from __future__ import annotations

import math

import numpy as np
import pytest
from numpy.typing import NDArray

import apc
from apc.present.still import draw_actors
from tests.topologies import SCENES, compiled

Floats = NDArray[np.float64]
ALONE = "topology: body\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\nmasses:\n"


def frequencies(text: str) -> list[float]:
    """Return in Hz what a scene swings at, rising."""
    found = apc.analyze(compiled(text))
    return sorted(one.frequency_hz for one in found.modes if one.eigenvalue.imag > 0)


@pytest.mark.parametrize("tip", [0.0, 0.7])
def test_a_bar_held_at_a_point_by_a_spring_swings_as_a_compound_body_does(tip: float) -> None:
    """ω² = K(1/m + l²/J) across the bar and K/m along it, J about the centre of all (parallel axes)."""
    mass, inertia, reach, spring = 2.0, 0.3, 0.4, 500.0
    text = (
        f"{ALONE}  body: {{type: PlanarBody, mass: {mass} kg, inertia: {inertia} kg*m^2}}\n"
        f"  wall: {{type: PlanarMass, mass: 1000000000 kg, x: [{reach} m, 0 m]}}\n"
        + (f"  tips: {{type: PlanarMass, mass: {tip} kg, flange: far.point}}\n" if tip else "")
        + "couplers:\n"
        f"  near: {{type: PlanarGraspPoint, frame: body, r: [{reach} m, 0 m]}}\n"
        + (f"  far: {{type: PlanarGraspPoint, frame: body, r: [-{reach} m, 0 m]}}\n" if tip else "")
        + f"  tie: {{type: PlanarSpringDamper, a: wall, b: near.point, stiffness: {spring} N/m}}\n"
    )
    whole = mass + tip
    back = tip * reach / whole  # how far the centre of all lies behind that of the bar
    about = inertia + mass * back**2 + tip * (reach - back) ** 2
    squares = spring / whole, spring * (1 / whole + (reach + back) ** 2 / about)
    assert frequencies(text) == pytest.approx([math.sqrt(one) / (2 * math.pi) for one in squares], rel=1e-8)


def test_copies_turn_together_as_they_move_together() -> None:
    """With a moment of inertia, damping and stiffness of the same numbers an angle is a third coordinate."""
    scene = (
        "topology: two\nclocks: {haptic: 1 ms, network: 8 ms}\npeers: {user: {count: 3}}\n"
        "masses: {cube: {type: TYPE, mass: 0.6 kg, damping: 5 N*s/m, shared: trueMORE}}\n"
        "couplers: {pull: {type: PULL, object: cube, clock: haptic, link: lan, delay: 1 ms, "
        "stiffness: 500 N/m, damping: 2 N*s/mALSO}}\nlinks: {lan: {clock: network, delay: 8 ms}}\n"
    )

    def radius(body: str, more: str, pull: str, also: str) -> float:
        text = scene.replace("TYPE", body).replace("MORE", more).replace("PULL", pull).replace("ALSO", also)
        return apc.analyze(compiled(text)).spectral_radius

    line = radius("Mass", "", "AveragePosition", "")
    for axes, inertia in (("Planar", "0.6 kg*m^2"), ("Spatial", "[0.6 kg*m^2, 0.6 kg*m^2, 0.6 kg*m^2]")):
        turning = f", inertia: {inertia}, turning_damping: 5 N*m*s/rad"
        also = ", turning_stiffness: 500 N*m/rad, turning_damping: 2 N*m*s/rad"
        found = radius(f"{axes}Body", turning, f"{axes}AverageFrame", also)
        assert found == pytest.approx(line, rel=1e-10)


def spun(rotation: list[float], spin: list[float], inertia: str = "[2 kg*m^2, 2 kg*m^2, 3 kg*m^2]") -> Floats:
    """Return t, σ and ω (rows, 7) of a body that turns freely for 2 s."""
    listed = ", ".join(f"{w} rad/s" for w in spin)
    text = (
        f"{ALONE}  body: {{type: SpatialBody, mass: 1 kg, inertia: {inertia}, rotation: {rotation}, "
        f"w: [{listed}]}}\n"
    )
    found = apc.simulate(compiled(text), duration="2 s", method="cvodes:1e-12")
    columns = [found[f"user[1].body.{name}[{k}]"] for name in ("rotation", "w") for k in (1, 2, 3)]
    return np.column_stack([found.time, *columns])


def test_the_carried_beam_swings_and_turns_as_a_program_of_its_own_says() -> None:
    """The largest of what moves across it and turns, tick by tick with expm of each peer's six states."""
    found = apc.analyze(apc.compile(SCENES / "carried-beam.yaml"))
    sizes = [abs(one.eigenvalue) for one in found.modes if one.eigenvalue.imag > 0]
    assert sorted(sizes)[-4:] == pytest.approx([0.96580532, 0.9681205, 0.97181542, 0.98129976], abs=1e-8)
    assert (found.translations, found.rotations) == (2, 1)


def test_a_top_left_to_itself_precesses_about_its_axis() -> None:
    """ω₁ = a cos(Ωt), ω₂ = a sin(Ωt), Ω = (I₃ − I₁)/I₁ ω₃ (Euler, of two equal moments)."""
    time, *_, w1, w2, w3 = spun([0, 0, 0], [0.2, 0, 3]).T
    rate = (3 - 2) / 2 * 3
    assert w1 == pytest.approx(0.2 * np.cos(rate * time), abs=1e-9)
    assert w2 == pytest.approx(0.2 * np.sin(rate * time), abs=1e-9)
    assert w3 == pytest.approx(3.0, rel=1e-12)


def turn(sigma: Floats) -> Floats:
    """Return the matrix (3, 3) from a body's axes to those that don't turn, by Rodrigues' formula."""
    size = float(np.linalg.norm(sigma))
    x, y, z = sigma / (size or 1.0)
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    angle = 4 * math.atan(size)
    return np.eye(3) + math.sin(angle) * cross + (1 - math.cos(angle)) * cross @ cross


def test_a_picture_shows_which_way_a_body_points() -> None:
    bar = "{type: PlanarBody, mass: 1 kg, inertia: 1 kg*m^2, x: [1 m, 2 m], angle: 30 deg}"
    text = f"{ALONE}  bar: {bar}\n"
    _, (actor,) = draw_actors(compiled(text))
    assert (actor.states, actor.angle) == (("user[1].bar.x[1]", "user[1].bar.x[2]"), "user[1].bar.angle")
    assert actor.shift.transform((1, 0)) - (1000, 2000) == pytest.approx([math.sqrt(0.75), 0.5])


def test_what_turns_freely_in_space_keeps_its_angular_momentum() -> None:
    rows = spun([0.1, -0.2, 0.15], [0.7, 0.9, -0.4], "[1 kg*m^2, 2 kg*m^2, 4 kg*m^2]")
    momenta = np.array([turn(row[1:4]) @ (np.array([1, 2, 4]) * row[4:]) for row in rows])
    assert np.ptp(rows[:, 1]) > 0.2, "it turns"
    assert momenta == pytest.approx(np.tile(momenta[0], (len(rows), 1)), abs=1e-7)


def test_a_force_at_a_point_turns_a_body_in_space_by_its_lever() -> None:
    """At rest, dω/dt = I⁻¹ Rᵀ((R r) × f) and the point is at x + R r."""
    sigma, reach, push = np.array([0.2, -0.1, 0.3]), np.array([0.3, 0.1, -0.2]), np.array([2.0, -1.0, 0.5])
    listed = ", ".join(f"{one} m" for one in reach)
    start = ", ".join(map(str, sigma))
    text = (
        f"{ALONE}  body: {{type: SpatialBody, mass: 1 kg, inertia: [1 kg*m^2, 2 kg*m^2, 4 kg*m^2], "
        f"rotation: [{start}]}}\n  wall: {{type: SpatialMass, mass: 1000000000 kg}}\n"
        f"couplers:\n  grasp: {{type: SpatialGraspPoint, frame: body, r: [{listed}]}}\n"
        "  tie: {type: SpatialSpringDamper, a: wall, b: grasp.point, stiffness: 1 N/m}\n"
    )
    arm = turn(sigma) @ reach
    (kind,) = (system := compiled(text)).kinds
    known = {one.name: one.value for one in system.parameters}
    wall = dict(zip((f"wall.x[{k}]" for k in (1, 2, 3)), arm + push, strict=True))
    states = [wall.get(one.name, known[one.start]) for one in kind.states]
    found = kind.derivative(states, [], [known[name] for name in kind.parameters], 0.0)
    rates = dict(zip((one.name for one in kind.states), np.asarray(found).ravel(), strict=True))
    due = turn(sigma).T @ np.cross(arm, push) / np.array([1, 2, 4])
    assert [rates[f"body.w[{k}]"] for k in (1, 2, 3)] == pytest.approx(due, rel=1e-12)
    assert [rates[f"body.v[{k}]"] for k in (1, 2, 3)] == pytest.approx(push, rel=1e-12)
