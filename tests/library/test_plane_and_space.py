"""Parts that move in a plane and in space against their closed forms; vectors in groups, tables, arrays."""

from __future__ import annotations

import math
import re
from pathlib import Path

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import apc
from tests.library.parts import rates, ticked
from tests.topologies import AVERAGE, TOPOLOGIES, compiled, library, replaced

PLANAR = (TOPOLOGIES / "planar-users.yaml").read_text(encoding="utf-8").partition("\n")[2]
EXACT = 1e-13  # a few roundings
POINT = "topology: point\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\nmasses:\n"
PLANE = f"{POINT}  device: {{type: PlanarMass, mass: 2 kg, damping: 3 N*s/m}}\n"
SPACE = f"{POINT}  device: {{type: SpatialMass, mass: 2 kg, damping: 3 N*s/m}}\n"


def sizes(text: str) -> np.ndarray:
    """Return the magnitudes of all eigenvalues of a topology, each as often as it comes, largest first."""
    found = apc.analyze(compiled(text))
    each = [abs(one.eigenvalue) for one in found.modes for _ in range(one.multiplicity)]
    return np.sort(each)[::-1]


def state(place: np.ndarray, speed: np.ndarray) -> dict[str, float]:
    found = {f"device.x[{k + 1}]": float(one) for k, one in enumerate(place)}
    return found | {f"device.v[{k + 1}]": float(one) for k, one in enumerate(speed)}


def pushed(model: apc.Model, *held: float) -> list[float]:
    """Return the force on the mass of 2 kg at rest, when these are held."""
    return [2 * value for name, value in rates(model, {}, held).items() if name.startswith("device.v")]


# ---- what a plane has twice ----


def test_the_topology_in_a_plane_has_each_eigenvalue_of_the_topology_on_a_line_twice() -> None:
    line, plane = sizes(AVERAGE), sizes(PLANAR)
    several = line > 1e-6  # smaller ones are of multiple eigenvalues at zero, whose errors are large
    assert several.sum() >= 10
    assert plane[: 2 * several.sum()] == pytest.approx(np.repeat(line[several], 2), rel=1e-9)
    one, two = apc.analyze(compiled(AVERAGE)), apc.analyze(compiled(PLANAR))
    assert two.spectral_radius == pytest.approx(one.spectral_radius, rel=1e-12)
    assert two.rigid_modes == 2 * one.rigid_modes


@pytest.mark.parametrize(("mass", "spring", "size"), [("Planar", "Planar", 2), ("Spatial", "Spatial", 3)])
def test_planar_mass_and_spatial_mass_swing_along_each_axis_as_a_mass_does(
    mass: str, spring: str, size: int
) -> None:
    """PlanarSpringDamper, SpatialSpringDamper: m s² + (b + B) s + K = 0, each root once for each axis."""
    tie = f"type: {spring}SpringDamper, a: device, b: ground, stiffness: 70 N/m, damping: 4 N*s/m"
    found = sizes(f"{PLANE if size == 2 else SPACE}couplers: {{tie: {{{tie}}}}}\n")
    assert found == pytest.approx(np.full(2 * size, math.exp(-7 / 4)), rel=1e-12)


# ---- contacts ----


def radial(size: int) -> str:
    name, base = ("DiscContact", PLANE) if size == 2 else ("SphereContact", SPACE)
    part = f"type: {name}, a: device, b: ground, radius: 50 mm, stiffness: 900 N/m, damping: 2 N*s/m"
    return f"{base}couplers:\n  ball: {{{part}, clock: tick}}\n"


@pytest.mark.parametrize("size", [2, 3])
def test_disc_contact_and_sphere_contact_push_along_the_line_of_centres_and_never_pull(size: int) -> None:
    """f = −(K depth − B rate of distance) d/|d| into the device's side, where that is a push."""
    model = compiled(radial(size))
    inside = np.array([0.012, -0.016, 0.015][:size])
    moving = np.array([-0.3, 0.1, 0.2][:size])
    for place, speed in (
        (inside, 0 * moving),
        (inside, moving),
        (inside, 1e3 * inside),
        (4 * inside, moving),
    ):
        at = state(place, speed)
        away = place / np.linalg.norm(place)
        depth = 0.05 - np.linalg.norm(place)
        push = max(0.0, 900 * depth - 2 * float(away @ speed)) if depth > 0 else 0.0
        found = ticked(model, at)
        assert [found[f"ball.f[{k + 1}]"] for k in range(size)] == pytest.approx(-push * away, rel=EXACT)
    assert pushed(model, *inside) == pytest.approx(-inside, rel=EXACT)


def test_coinciding_centres_have_no_direction_and_no_verdict() -> None:
    """norm has no slope at zero, as sqrt has none: the start is refused, not guessed."""
    with pytest.raises(apc.ApcError, match=r"E808 .*at the initial state"):
        apc.analyze(compiled(radial(2)))


@pytest.mark.parametrize("size", [2, 3])
def test_line_contact_and_plane_contact_push_along_their_normal_and_never_pull(size: int) -> None:
    name, base = ("LineContact", PLANE) if size == 2 else ("PlaneContact", SPACE)
    normal, point = np.array([3.0, -4.0, 12.0][:size]), np.array([0.1, 0.2, -0.1][:size])
    shown = f"normal: {normal.tolist()}, point: [{', '.join(f'{v} m' for v in point)}]"
    model = compiled(
        f"{base}couplers:\n  wall: {{type: {name}, flange: device, {shown}, stiffness: 900 N/m, "
        "damping: 2 N*s/m, clock: tick}\n"
    )
    unit = normal / np.linalg.norm(normal)
    for away, along, speed in ((-0.01, 0.7, 0.0), (-0.01, 0.7, -2.0), (-0.01, 0.7, 9.0), (0.01, 0.7, -2.0)):
        across = np.zeros(size)
        across[:2] = [normal[1], -normal[0]]
        place, moving = point + away * unit + along * across, speed * unit
        at = state(place, moving)
        push = max(0.0, 900 * -away - 2 * speed) if away < 0 else 0.0
        assert ticked(model, at)["wall.push"] == pytest.approx(push, rel=1e-11)
    assert pushed(model, 5.0) == pytest.approx(5 * unit, rel=EXACT)


# ---- numbers of vectors ----


def starts(text: str, folder: Path | None = None) -> list[list[float]]:
    """Return where the device of each peer starts."""
    if folder is None:
        model = compiled(text)
    else:
        (folder / "topology.yaml").write_text(text, encoding="utf-8")
        model = apc.compile(folder / "topology.yaml")
    run = apc.simulate(model, duration="1 ms", jit=False)
    names = [one.name for one in run.signals]
    return [
        [run.values[0, names.index(f"{g.name}[{peer + 1}].device.x[{k}]")] for k in (1, 2)]
        for g in model.groups
        for peer in range(g.count)
    ]


TIED = f"{PLANE}couplers: {{tie: {{type: PlanarSpringDamper, a: device, b: ground, stiffness: 9 N/m}}}}\n"


def test_a_group_gives_a_vector_one_value_for_all_or_a_list_of_lists_one_a_peer(tmp_path: Path) -> None:
    def groups(body: str) -> str:
        return replaced(TIED, ("{user: {count: 1}}", f"{{user: {{{body}}}}}"))

    both = [[0.001, 0.002]] * 2
    assert starts(groups("count: 2, set: {device.x: [1 mm, 2 mm]}")) == both
    assert starts(groups('count: 2, set: {"device.x[1]": 1 mm, "device.x[2]": 2 mm}')) == both
    each = [[0.001, 0.002], [0.003, 0.004]]
    assert starts(groups("set: {device.x: [[1 mm, 2 mm], [3 mm, 4 mm]]}")) == each
    assert starts(groups('set: {"device.x[1]": [1 mm, 3 mm], "device.x[2]": [2 mm, 4 mm]}')) == each
    (tmp_path / "users.csv").write_text("device.x[1] [mm],device.x[2] [mm]\n1,2\n3,4\n", encoding="utf-8")
    assert starts(groups("table: users.csv"), tmp_path) == each


# ---- bodies that turn ----

BAR = """\
topology: bar
peers: {user: {count: 1}}
masses:
  bar: {type: PlanarBody, mass: 2 kg, inertia: 0.05 kg*m^2, x: [0 m, -0.3 m]}
  bob: {type: PlanarMass, mass: 0.5 kg}
couplers:
  hinge: {type: PlanarGraspPoint, frame: bar, offset: [0 m, 0.3 m], point: ground}
  centre: {type: PlanarGraspPoint, frame: bar, offset: [0 m, 0 m]}
  end: {type: PlanarGraspPoint, frame: bar, offset: [0 m, -0.2 m], point: bob}
hands:
  weight: {type: PlanarConstantForce, flange: centre.point, force: [0 N, -20 N]}
"""
TOP = """\
topology: top
peers: {user: {count: 1}}
masses:
  top:
    {type: SpatialBody, mass: 2 kg, inertia: [0.05 kg*m^2, 0.05 kg*m^2, 0.02 kg*m^2], x: [0 m, 0 m, 0.3 m],
     momentum: [0 N*m*s, 0 N*m*s, 5 N*m*s]}
couplers:
  foot: {type: SpatialGraspPoint, frame: top, offset: [0 m, 0 m, -0.3 m], point: ground}
  centre: {type: SpatialGraspPoint, frame: top, offset: [0 m, 0 m, 0 m]}
hands: {weight: {type: SpatialConstantForce, flange: centre.point, force: [0 N, 0 N, -20 N]}}
"""


def hertz(text: str) -> list[float]:
    """Return the frequencies of a topology's motions that swing."""
    return sorted(one.frequency_hz for one in apc.analyze(compiled(text)).modes if one.eigenvalue.imag > 0)


def test_what_is_held_does_the_work_that_copies_move_by() -> None:
    """Each pair of a connector does its own: ∫ f·dx + torque·dφ is the kinetic energy, without damping."""
    text = (TOPOLOGIES / "carried-beam.yaml").read_text(encoding="utf-8").partition("hands:")[0]
    start = "mass: 2 kg, v: [0.1 m/s, 0 m/s], rate: 0.3 rad/s"
    text = re.sub("damping: (5|0.15)", "damping: 0", re.sub(", carry.force: .*?]", "", text))
    text = replaced(
        text, ("mass: 2 kg", start), ("set: {grasp.offset: [-", "set: {beam.angle: 0.1 rad, grasp.offset: [-")
    )
    run = apc.simulate(compiled(text), duration="0.096 s", jit=False)

    masses = {"device.v[1]": 0.1, "device.v[2]": 0.1, "beam.v[1]": 1.0, "beam.v[2]": 1.0, "beam.rate": 0.03}
    kinetic = sum(
        m * run[f"{it}[1].{name}"] ** 2 / 2 for it in ("left", "right") for name, m in masses.items()
    )
    work = dict(run.summary.work)
    assert abs(work["coordination"]) > 1e-4 and abs(work["contact"]) > 1e-4
    assert sum(work.values()) == pytest.approx(kinetic[-1] - kinetic[0], rel=1e-6)


def test_a_compound_pendulum_swings_and_an_upright_top_nods_and_goes_round() -> None:
    """Steiner: w² = F l/(J + m l² + M (l + a)²), M weightless; of the top J λ² − i h λ − F l = 0."""
    bar, top = 0.05 + 2 * 0.3**2 + 0.5 * 0.5**2, 0.05 + 2 * 0.3**2
    assert hertz(BAR) == pytest.approx([math.sqrt(20 * 0.3 / bar) / (2 * math.pi)], rel=1e-9)
    apart = math.sqrt(5**2 - 4 * top * 20 * 0.3)
    both = [(5 - apart) / (2 * top), (5 + apart) / (2 * top)]
    assert hertz(TOP) == pytest.approx([rate / (2 * math.pi) for rate in both], rel=1e-9)


FREE = """\
topology: free
peers: {user: {count: 1}}
masses:
  body:
    {type: SpatialBody, mass: 2 kg, inertia: [0.2 kg*m^2, 0.2 kg*m^2, 0.3 kg*m^2],
     rotation: [0.3 rad, 0 rad, -1 rad], rate: [0.4 rad/s, 0 rad/s, 2 rad/s]}
"""


def over_time(run: apc.Trajectory, name: str) -> np.ndarray:
    """Return a vector of the only peer (rows, 3)."""
    return np.column_stack([run[f"user[1].{name}[{k}]"] for k in (1, 2, 3)])


def axes(rotation: np.ndarray) -> np.ndarray:
    """Return the axes of a body as columns, by its quaternion: (cos φ/2, n sin φ/2) of n 2 tan φ/2."""
    quaternion = np.array([1.0, *rotation / 2]) / math.hypot(1.0, *rotation / 2)
    return np.array(Rotation.from_quat([*quaternion[1:], quaternion[0]]).as_matrix())


def test_a_free_symmetric_body_wobbles_at_its_rate_and_keeps_its_angular_momentum() -> None:
    """Euler: w turns at w₃ (I₃ − I₁)/I₁ along the body's axes, R I w stands still in space."""
    run = apc.simulate(compiled(FREE), duration="1 s", method="cvodes:1e-11", jit=False)
    rate, turned = over_time(run, "body.rate"), over_time(run, "body.rotation")
    wobble = 2 * (0.3 - 0.2) / 0.2 * np.asarray(run.time)
    known = np.column_stack([0.4 * np.cos(wobble), 0.4 * np.sin(wobble), np.full(len(wobble), 2.0)])
    assert rate == pytest.approx(known, abs=1e-6)
    stored = [axes(one) @ ([0.2, 0.2, 0.3] * w) for one, w in zip(turned, rate, strict=True)]
    assert np.ptp(stored, axis=0).max() < 1e-6


def test_what_pulls_at_a_point_of_a_turned_body_does_its_work_there() -> None:
    """A point moves by axes·offset, and a force does on the body what it does at the point: dE/dt = 0."""
    text = FREE.replace(
        "body:\n", "mass: {type: SpatialMass, mass: 0.5 kg, x: [0.1 m, 0.5 m, 0 m]}\n  body:\n"
    ) + (
        "couplers:\n  grasp: {type: SpatialGraspPoint, frame: body, offset: [0.3 m, 0 m, 0.2 m]}\n"
        "  tie: {type: SpatialSpringDamper, a: mass, b: grasp.point, stiffness: 40 N/m}\n"
    )
    run = apc.simulate(compiled(text), duration="0.5 s", method="cvodes:1e-11", jit=False)
    turned = over_time(run, "body.rotation")
    point = over_time(run, "body.x") + [axes(one) @ [0.3, 0, 0.2] for one in turned]
    energy = 40 * (point - over_time(run, "mass.x")) ** 2 + 0.5 * over_time(run, "mass.v") ** 2
    energy += 2 * over_time(run, "body.v") ** 2 + [0.2, 0.2, 0.3] * over_time(run, "body.rate") ** 2
    whole = energy.sum(axis=1)
    assert whole == pytest.approx(np.full(len(whole), whole[0]), rel=1e-6)


@pytest.mark.parametrize("space", [False, True])
def test_copies_are_turned_to_their_mean_as_they_are_pulled(space: bool) -> None:
    """With J for m, and N*m/rad for N/m, each eigenvalue is that of a mass on a line, and so is the limit."""
    lines = AVERAGE.partition("studies:")[0].splitlines(keepends=True)
    alone = "".join(one for one in lines if not one.startswith(("  device:", "  contact:")))
    count, peer_type = (6, "Spatial") if space else (3, "Planar")
    inertia = "[0.6 kg*m^2, 0.6 kg*m^2, 0.6 kg*m^2]" if space else "0.6 kg*m^2"
    body = f"type: {peer_type}Body, inertia: {inertia}, turn_damping: 5 N*m*s/rad, mass"
    turned = replaced(
        alone,
        ("cube:   {mass", f"cube:   {{{body}"),
        ("AveragePosition", f"{peer_type}AveragePose"),
        ("stiffness: 500 N/m,", "stiffness: 500 N/m, turn_stiffness: 500 N*m/rad,"),
    )
    one, many = sizes(alone), sizes(turned)
    several = one[one > 1e-6]
    assert len(several) >= 4
    assert many[: count * len(several)] == pytest.approx(np.repeat(several, count), rel=1e-9)
    limits = [
        apc.critical(compiled(text), name).value
        for text, name in ((alone, "coordination.stiffness"), (turned, "coordination.turn_stiffness"))
    ]
    assert limits[1] == pytest.approx(limits[0], rel=1e-8)


CHAIN = """\
component: Chain
description: Masses in a row with springs between them.
connectors: {first: Flange, last: Flange}
parameters: {mass: {unit: kg, exclusive_min: 0}, stiffness: {unit: N/m, min: 0}}
parts:
  link: {type: Mass, count: 3, mass: mass}
  pad: {type: SpringDamper, count: 2, a: "link[1:2]", b: "link[2:3]", stiffness: stiffness}
connect: {first: "link[1].flange", last: "link[3].flange"}
"""
ROW = """\
topology: row
peers: {user: {count: 1}}
masses: {chain: {type: Chain, mass: 2 kg, stiffness: 50 N/m}}
couplers: {tie: {type: SpringDamper, a: chain.last, b: ground, stiffness: 9 N/m, damping: 1 N*s/m}}
"""


def test_an_array_inside_a_component_is_the_row_that_a_topology_writes_out(tmp_path: Path) -> None:
    found = compiled(ROW, library(tmp_path, CHAIN))
    names = [state.name for state in found.peer_types[0].states]
    assert sorted(names) == sorted(f"chain.link[{k}].{n}" for k in (1, 2, 3) for n in "xv")
    k = 50 * np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    k[2, 2] += 9
    a = np.block([[np.zeros((3, 3)), np.eye(3)], [-k / 2, -np.diag([0, 0, 1]) / 2]])
    known = np.exp(np.linalg.eigvals(a).real).max()
    assert apc.analyze(found).spectral_radius == pytest.approx(known, rel=1e-9)
