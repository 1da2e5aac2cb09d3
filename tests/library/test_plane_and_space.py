"""Parts that move in a plane and in space against their closed forms; vectors in groups, tables, arrays."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import apc
from tests.library.parts import rates, ticked
from tests.topologies import AVERAGE, ONE_MASS, SCENES, compiled, library, replaced

PLANAR = (SCENES / "planar-users.yaml").read_text(encoding="utf-8").partition("\n")[2]
EXACT = 1e-13  # a few roundings
POINT = "topology: point\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\nmasses:\n"
PLANE = f"{POINT}  device: {{type: PlanarMass, mass: 2 kg, damping: 3 N*s/m}}\n"
SPACE = f"{POINT}  device: {{type: SpatialMass, mass: 2 kg, damping: 3 N*s/m}}\n"


def sizes(text: str) -> np.ndarray:
    """Return the magnitudes of all eigenvalues of a scene, each as often as it comes, largest first."""
    found = apc.analyze(compiled(text))
    each = [abs(one.eigenvalue) for one in found.modes for _ in range(one.multiplicity)]
    return np.sort(each)[::-1]


def state(place: np.ndarray, speed: np.ndarray) -> dict[str, float]:
    found = {f"device.x[{k + 1}]": float(one) for k, one in enumerate(place)}
    return found | {f"device.v[{k + 1}]": float(one) for k, one in enumerate(speed)}


def pushed(system: apc.CompiledSystem, *held: float) -> list[float]:
    """Return the force on the mass of 2 kg at rest, when these are held."""
    return [2 * value for name, value in rates(system, {}, held).items() if name.startswith("device.v")]


# ---- what a plane has twice ----


def test_the_scene_in_a_plane_has_each_eigenvalue_of_the_scene_on_a_line_twice() -> None:
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
    tie = "stiffness: 70 N/m, damping: 4 N*s/m"
    line = f"{ONE_MASS}couplers: {{tie: {{type: SpringDamper, a: device, b: ground, {tie}}}}}\n"
    base = PLANE if size == 2 else SPACE
    more = f"{base}couplers: {{tie: {{type: {spring}SpringDamper, a: device, b: ground, {tie}}}}}\n"
    found = apc.analyze(compiled(more))
    assert found.spectral_radius == pytest.approx(math.exp(-7 / 4), rel=1e-12)
    one, other = sizes(line), sizes(more)
    assert other == pytest.approx(np.repeat(one, size), rel=1e-12)


def test_sampled_planar_spring_damper_pulls_along_the_line_between_its_ends() -> None:
    system = compiled(
        f"{PLANE}couplers:\n  it: {{type: SampledPlanarSpringDamper, a: device, b: ground, clock: tick, "
        "stiffness: 70 N/m, damping: 4 N*s/m}\n"
    )
    at = {"device.x[1]": 0.3, "device.x[2]": -0.4, "device.v[1]": 0.5, "device.v[2]": 2.0}
    assert ticked(system, at) == pytest.approx(
        {"it.f[1]": 70 * 0.3 + 4 * 0.5, "it.f[2]": -70 * 0.4 + 4 * 2.0}, rel=EXACT
    )


def test_planar_constant_force_pushes_in_its_direction() -> None:
    system = compiled(
        f"{PLANE}hands: {{push: {{type: PlanarConstantForce, flange: device, force: [3 N, -4 N]}}}}\n"
    )
    assert pushed(system) == pytest.approx([3.0, -4.0], rel=EXACT)


# ---- contacts ----


def radial(size: int) -> str:
    name, base = ("DiscContact", PLANE) if size == 2 else ("SphereContact", SPACE)
    part = f"type: {name}, a: device, b: ground, radius: 50 mm, stiffness: 900 N/m, damping: 2 N*s/m"
    return f"{base}couplers:\n  ball: {{{part}, clock: tick}}\n"


@pytest.mark.parametrize("size", [2, 3])
def test_disc_contact_and_sphere_contact_push_along_the_line_of_centres_and_never_pull(size: int) -> None:
    """f = −(K depth − B rate of distance) d/|d| into the device's side, where that is a push."""
    system = compiled(radial(size))
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
        found = ticked(system, at)
        assert [found[f"ball.f[{k + 1}]"] for k in range(size)] == pytest.approx(-push * away, rel=EXACT)
    assert pushed(system, *inside) == pytest.approx(-inside, rel=EXACT)


def test_coinciding_centres_have_no_direction_and_no_verdict() -> None:
    """norm has no slope at zero, as sqrt has none: the start is refused, not guessed."""
    with pytest.raises(apc.ApcError, match=r"E808 .*at the start values"):
        apc.analyze(compiled(radial(2)))


@pytest.mark.parametrize("size", [2, 3])
def test_line_contact_and_plane_contact_push_along_their_normal_and_never_pull(size: int) -> None:
    name, base = ("LineContact", PLANE) if size == 2 else ("PlaneContact", SPACE)
    normal, point = np.array([3.0, -4.0, 12.0][:size]), np.array([0.1, 0.2, -0.1][:size])
    shown = f"normal: {normal.tolist()}, point: [{', '.join(f'{v} m' for v in point)}]"
    system = compiled(
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
        assert ticked(system, at)["wall.push"] == pytest.approx(push, rel=1e-11)
    assert pushed(system, 5.0) == pytest.approx(5 * unit, rel=EXACT)


# ---- numbers of vectors ----


def starts(text: str, folder: Path | None = None) -> list[list[float]]:
    """Return where the device of each peer starts."""
    if folder is None:
        system = compiled(text)
    else:
        (folder / "scene.yaml").write_text(text, encoding="utf-8")
        system = apc.compile(folder / "scene.yaml")
    run = apc.simulate(system, duration="1 ms", jit=False)
    names = [one.name for one in run.signals]
    return [
        [run.values[0, names.index(f"{g.name}[{peer + 1}].device.x[{k}]")] for k in (1, 2)]
        for g in system.groups
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


# ---- several pairs at a connector; arrays inside a component ----

SLAB = (
    """\
connector: Pose
about: A body of a plane that turns as well.
potentials: {x: {unit: m, size: 2}, angle: {unit: rad}}
flows: {f: {unit: N, size: 2}, torque: {unit: N*m}}
""",
    """\
component: Slab
about: A body that moves and turns in a plane.
connectors: {centre: Pose}
parameters: {mass: {unit: kg, above: 0}, inertia: {unit: kg*m^2, above: 0}}
variables:
  x: {unit: m, size: 2, start: [0 m, 0 m]}
  v: {unit: m/s, size: 2, start: [0 m/s, 0 m/s]}
  angle: {unit: rad, start: 0 rad}
  rate: {unit: rad/s, start: 0 rad/s}
equations:
  - der(x) = v
  - mass*der(v) = centre.f
  - der(angle) = rate
  - inertia*der(rate) = centre.torque
  - centre.x = x
  - centre.angle = angle
""",
    """\
component: Mount
about: Holds a body, sampled, along and about its axes.
connectors: {a: Pose, b: Pose}
parameters: {stiffness: {unit: N/m}, twist: {unit: N*m}, clock: clock}
variables: {f: {unit: N, size: 2}, torque: {unit: N*m}}
equations:
  - f = stiffness*sample(a.x - b.x)
  - torque = twist*sample(a.angle - b.angle)
  - a.f = hold(f)
  - b.f = -a.f
  - a.torque = hold(torque)
  - b.torque = -a.torque
""",
)


def test_a_connector_may_have_several_pairs_vectors_among_them(tmp_path: Path) -> None:
    """Two bodies on springs: what one pair does, no other feels, and each does the work of its own."""
    text = (
        "topology: slab\nclocks: {tick: 1 ms}\npeers: {user: {count: 1}}\nmasses:\n"
        "  one: {type: Slab, mass: 2 kg, inertia: 0.1 kg*m^2, x: [1 mm, 0 m], angle: 0.2 rad}\n"
        "  two: {type: Slab, mass: 5 kg, inertia: 0.3 kg*m^2}\n"
        "couplers: {tie: {type: Mount, a: one, b: two, stiffness: 70 N/m, twist: 9 N*m, clock: tick}}\n"
    )
    system = compiled(text, library(tmp_path, *SLAB))
    found = ticked(system, {"one.x[1]": 0.5, "two.x[2]": 0.25, "one.angle": 0.125})
    assert found == pytest.approx({"tie.f[1]": 35.0, "tie.f[2]": -17.5, "tie.torque": 1.125}, rel=EXACT)
    run = apc.simulate(system, duration="20 ms", jit=False)
    work = dict(run.summary.work)["tie"]
    names = [signal.name for signal in run.signals]
    kinetic = 0.0
    for body, mass, inertia in (("one", 2.0, 0.1), ("two", 5.0, 0.3)):
        v = {n: run.values[-1, names.index(f"user[1].{body}.{n}")] for n in ("v[1]", "v[2]", "rate")}
        kinetic += mass * (v["v[1]"] ** 2 + v["v[2]"] ** 2) / 2 + inertia * v["rate"] ** 2 / 2
    assert work == pytest.approx(kinetic, rel=1e-9)  # nothing else takes work up


CHAIN = """\
component: Chain
about: Masses in a row with springs between them.
connectors: {first: Flange, last: Flange}
parameters: {mass: {unit: kg, above: 0}, stiffness: {unit: N/m, min: 0}}
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
    names = [state.name for state in found.kinds[0].states]
    assert sorted(names) == sorted(f"chain.link[{k}].{n}" for k in (1, 2, 3) for n in "xv")
    k = 50 * np.array([[1.0, -1, 0], [-1, 2, -1], [0, -1, 1]])
    k[2, 2] += 9
    a = np.block([[np.zeros((3, 3)), np.eye(3)], [-k / 2, -np.diag([0, 0, 1]) / 2]])
    known = np.exp(np.linalg.eigvals(a).real).max()
    assert apc.analyze(found).spectral_radius == pytest.approx(known, rel=1e-9)
