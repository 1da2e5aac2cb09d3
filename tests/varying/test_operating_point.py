"""The equilibrium of a topology: closed forms, independent roots, a simulation, and analyses there."""

from __future__ import annotations

import doctest
import json
from pathlib import Path

import numpy as np
import pytest
from scipy.linalg import expm
from scipy.optimize import brentq

import apc
from apc.compiler.compiled import Model
from tests.commands import Cli, write
from tests.topologies import AVERAGE, ONE_MASS, TOPOLOGIES, compiled, library, messages_of, replaced

EXPERIMENT = compiled((TOPOLOGIES / "experiment-average.yaml").read_text(encoding="utf-8"))

PRESSED = """\
topology: pressed
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m, x: 5 mm}}
couplers:
  contact: {type: SampledHuntCrossleyContact, a: device, b: ground, stiffness: 20000 N/m^(3/2), side: right,
            clock: haptic, delay: 1 ms}
hands: {push: {type: ConstantForce, flange: device, force: -3 N}}
"""
# The same device on a linear spring: that of the pressed contact to first order.
SPRING = """\
topology: spring
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m}}
couplers:
  contact: {type: SampledSpringDamper, a: device, b: ground, stiffness: 1500 N/m, clock: haptic, delay: 1 ms}
"""
WALL = """\
topology: walled
clocks: {{haptic: 1 ms}}
peers: {{user: {{count: 1}}}}
masses: {{device: {{mass: 0.1 kg, damping: 5 N*s/m}}}}
couplers:
  wall: {{type: VirtualWall, flange: device, position: 4 mm, side: left, stiffness: 1000 N/m, clock: haptic}}
  first: {{type: SpringDamper, a: device, b: ground, stiffness: 100 N/m}}
  second: {{type: SampledSpringDamper, a: device, b: ground, stiffness: 150 N/m, clock: haptic}}
hands: {{push: {{type: ConstantForce, flange: device, force: {force} N}}}}
"""


AWAY = """\
topology: away
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.2 kg, damping: 2 N*s/m}}
couplers:
  wall: {type: VirtualWall, flange: device, position: 10 mm, stiffness: 1000 N/m, clock: haptic}
hands: {push: {type: ConstantForce, flange: device, force: 3 N}}
"""


def positions(point: apc.OperatingPoint) -> dict[str, float]:
    return {position.name: position.value for position in point.positions}


def hertz(force: float = 3.0, stiffness: float = 20000.0) -> float:
    """Return the slope of K d^1.5 where it balances a force."""
    return float(1.5 * stiffness ** (2 / 3) * force ** (1 / 3))


def test_a_mass_on_two_springs_rests_where_they_carry_the_force() -> None:
    point = apc.operating_point(compiled(WALL.format(force=0.5)))
    assert positions(point) == {"device.x": pytest.approx(0.5 / 250, rel=1e-14)}
    assert dict(point.active) == {"wall.push": False} and point.converged
    assert point.residual <= point.tolerance < 1e-8 and point.residual_unit == "N"


def test_a_wall_carries_the_force_beyond_its_surface() -> None:
    point = apc.operating_point(compiled(WALL.format(force=5)))
    assert positions(point) == {"device.x": pytest.approx((5 + 1000 * 0.004) / 1250, rel=1e-14)}
    assert dict(point.active) == {"wall.push": True}


@pytest.mark.parametrize("stiffness", [1e2, 5e3, 1e6])
@pytest.mark.parametrize("distance", [0.001, 0.01, 0.4])
def test_a_free_body_is_pushed_to_a_wall_at_any_distance(distance: float, stiffness: float) -> None:
    """At rest the wall carries the force: x = d + F/k, from a start in free space."""
    model = compiled(AWAY)
    for force, mass in ((0.5, 0.05), (3.0, 1.0), (20.0, 0.2)):
        values = {
            "wall.position": distance,
            "wall.stiffness": stiffness,
            "push.force": force,
            "device.mass": mass,
        }
        found = positions(apc.operating_point(apc.set_parameters(model, values)))["device.x"]
        assert found == pytest.approx(distance + force / stiffness, rel=1e-9)


def test_a_contact_that_is_pulled_open_is_off() -> None:
    model = compiled(WALL.format(force=-2).replace("5 N*s/m}", "5 N*s/m, x: 10 mm}"))
    point = apc.operating_point(model)
    assert positions(point) == {"device.x": pytest.approx(-2 / 250, rel=1e-14)}
    assert dict(point.active) == {"wall.push": False}


def test_a_nonlinear_spring_rests_at_the_root_of_an_independent_solver() -> None:
    text = replaced(
        PRESSED,
        ("hands:", "  soft: {type: SpringDamper, a: device, b: ground, stiffness: 300 N/m}\nhands:"),
    )
    depth = brentq(lambda d: 20000 * d**1.5 + 300 * d - 3, 0, 1, xtol=1e-15)
    point = apc.operating_point(compiled(text))
    assert positions(point)["device.x"] == pytest.approx(-depth, rel=1e-12)


def test_a_long_damped_simulation_ends_at_the_equilibrium() -> None:
    model = compiled(replaced(PRESSED, ("5 N*s/m", "30 N*s/m")))
    end = apc.simulate(model, duration="4 s")["user[1].device.x"][-1]
    assert positions(apc.operating_point(model))["device.x"] == pytest.approx(end, rel=1e-9)
    started = apc.operating_point(model, initial="simulation", duration="0.5 s")
    assert started.initial == "simulation"
    assert positions(started)["device.x"] == pytest.approx(end, rel=1e-9)


def test_the_experiment_rests_in_contact_with_the_sum_of_its_positions_kept() -> None:
    """4 N against 2 N and 2 N; each received position is the sender's at rest."""
    point = apc.operating_point(EXPERIMENT)
    x = positions(point)
    assert x["right.device.x"] - x["right.cube.x"] == pytest.approx(0.02 - 4 / 3900, abs=1e-15)
    assert x["left.cube.x"] - x["left.device.x"] == pytest.approx(0.02 - 2 / 3900, abs=1e-15)
    assert x["left.cube.x"] - x["right.cube.x"] == pytest.approx(4 / 2000, abs=1e-15)
    total = x["right.device.x"] + x["right.cube.x"] + 2 * (x["left.device.x"] + x["left.cube.x"])
    assert total == pytest.approx(-0.03, abs=1e-12)
    assert dict(point.active) == {"right.contact.push": True, "left.contact.push": True}


def test_a_model_that_starts_at_its_equilibrium_stays_there() -> None:
    run = apc.simulate(apc.operating_point(EXPERIMENT).model, duration="0.1 s")
    for signal, values in zip(run.signals, run.values.T, strict=True):
        if signal.name.endswith(".x"):
            assert np.ptp(values) < 1e-14, signal.name


def test_peers_on_a_graph_rest_at_positions_of_their_own() -> None:
    """A copy that is pushed by 1 N, coupled to the first of two copies that springs of 50 N/m hold."""
    text = """\
topology: chain
clocks: {haptic: 1 ms, network: 8 ms}
peers: {free: {count: 1, set: {push.force: 1 N, spring.stiffness: 0 N/m}}, kept: {count: 2}}
masses: {cube: {mass: 3 kg, damping: 5 N*s/m, shared: true}}
couplers:
  spring: {type: SpringDamper, a: cube, b: ground, stiffness: 50 N/m}
  mesh: {type: FullMesh, object: cube, stiffness: 200 N/m, clock: haptic, link: lan}
links: {lan: {clock: network, delay: 8 ms, graph: {edges: [["free[1]", "kept[1]"], ["kept[1]", "kept[2]"]]}}}
hands: {push: {type: ConstantForce, flange: cube, force: 0 N}}
"""
    springs = np.array([[200, -200, 0], [-200, 450, -200], [0, -200, 250]])
    found = positions(apc.operating_point(compiled(text)))
    assert [*found] == ["free.cube.x", "kept[1].cube.x", "kept[2].cube.x"]
    assert [*found.values()] == pytest.approx(np.linalg.solve(springs, [1, 0, 0]), rel=1e-12)


def test_the_linearization_contains_the_held_force_at_rest(tmp_path: Path) -> None:
    """m x″ = F − b x′ − K x hold(x)/l: at rest x² = F l/K, and the held value has a slope of its own."""
    part = """\
component: Progressive
description: A spring whose stiffness grows with a sampled displacement.
connectors: {flange: Flange}
parameters:
  stiffness: {unit: N/m, description: at the length}
  length: {unit: m, description: a length}
  clock: clock
variables:
  share: {unit: 1, description: sampled displacement by length}
equations:
  - share = sample(flange.x)/length
  - flange.f = stiffness*flange.x*hold(share)
"""
    text = """\
topology: progressive
clocks: {haptic: 1 ms}
peers: {user: {count: 1}}
masses: {device: {mass: 0.1 kg, damping: 5 N*s/m, x: 1 mm}}
couplers: {spring: {type: Progressive, flange: device, stiffness: 800 N/m, length: 0.1 m, clock: haptic}}
hands: {push: {type: ConstantForce, flange: device, force: 3 N}}
"""
    model = compiled(text, library(tmp_path, part))
    x = np.sqrt(3 * 0.1 / 800)
    assert positions(apc.operating_point(model))["device.x"] == pytest.approx(x, rel=1e-13)
    rates = np.array([[0, 1, 0], [-800 * x / 0.1 / 0.1, -50, -800 * x / 0.1], [0, 0, 0]])
    step = expm(0.001 * rates)
    frame = step[:2, :2] + step[:2, 2:] @ np.array([[1 / 0.1, 0]])
    radius = np.abs(np.linalg.eigvals(frame)).max()
    assert apc.analyze(model, operating_point="equilibrium").spectral_radius == pytest.approx(
        radius, rel=1e-12
    )


def test_a_nonlinear_loop_has_an_equilibrium(tmp_path: Path) -> None:
    """f + f³/N² = k x with f = 2 N at rest; there df/dx = k/(1 + 3 f²/N²)."""
    part = """\
component: SoftSpring
description: A spring that becomes softer with its force.
connectors: {flange: Flange}
parameters: {stiffness: {unit: N/m}, soft: {unit: 1/N^2}}
variables: {f: {unit: N}}
equations: [f + soft*f^3 = stiffness*flange.x, flange.f = f]
"""
    spring = "  soft: {type: SoftSpring, flange: device, stiffness: 500 N/m, soft: 1 1/N^2}\n"
    text = WALL.format(force=2).replace("stiffness: 100 N/m", "stiffness: 0 N/m")
    text = text.replace("150 N/m", "0 N/m").replace("hands:", f"{spring}hands:").replace("4 mm", "1 m")
    model = compiled(text, library(tmp_path, part))
    assert positions(apc.operating_point(model))["device.x"] == pytest.approx((2 + 2**3) / 500, rel=1e-12)
    linear = compiled(WALL.format(force=2).replace("4 mm", "1 m").replace("150 N/m", "0 N/m"))
    local = apc.analyze(linear, params={"first.stiffness": 500 / 13}).spectral_radius
    found = apc.analyze(model, operating_point="equilibrium").spectral_radius
    assert found == pytest.approx(local, rel=1e-12)


def test_an_analysis_at_the_equilibrium_is_that_of_the_local_stiffness() -> None:
    analysis = apc.analyze(compiled(PRESSED), operating_point="equilibrium")
    linear = apc.analyze(compiled(SPRING), params={"contact.stiffness": hertz()})
    assert analysis.spectral_radius == pytest.approx(linear.spectral_radius, abs=1e-13)
    assert analysis.linearized and analysis.equilibrium is not None
    assert "linearized at the equilibrium" in str(analysis) and "-2.82311 mm" in str(analysis)
    document = analysis.to_dict()["equilibrium"]
    assert document["positions"] == [
        {"name": "device.x", "value": pytest.approx(-((3 / 20000) ** (2 / 3))), "unit": "m"}
    ]
    assert json.dumps(document)


def test_a_critical_value_at_a_fixed_equilibrium_is_that_of_the_local_stiffness() -> None:
    local, name = {"contact.stiffness": hertz()}, "device.damping"
    found = apc.critical(compiled(PRESSED), name, operating_point="equilibrium")
    assert found.value == pytest.approx(apc.critical(compiled(SPRING), name, params=local).value, rel=1e-6)
    assert any(
        text.startswith("equilibrium at the present values: device.x = -2.82311 mm")
        for text in found.limitations
    )


def test_the_equilibrium_is_found_again_at_every_value_of_a_parameter() -> None:
    """The local stiffness 1.5 K^(2/3) F^(1/3) has the critical value of a linear spring."""
    limit = apc.critical(compiled(SPRING), "contact.stiffness").value
    assert limit is not None
    model, critical_stiffness = compiled(PRESSED), (limit / 1.5) ** 1.5 / 3**0.5
    found = apc.critical(model, "contact.stiffness", operating_point="equilibrium")
    assert found.value == pytest.approx(critical_stiffness, rel=1e-6)
    force = apc.critical(model, "push.force", lower=-200.0, upper=-1.0, operating_point="equilibrium").value
    assert force == pytest.approx(-((limit / 1.5) ** 3) / 20000**2, rel=1e-6)


@pytest.mark.whole
def test_a_region_at_the_equilibrium_has_the_boundary_of_the_local_stiffness() -> None:
    x, y = "contact.stiffness=1000 N/m^(3/2):300000 N/m^(3/2)", "device.damping=2 N*s/m:8 N*s/m"
    region = apc.region(compiled(PRESSED), x=x, y=y, operating_point="equilibrium")
    for damping in (3.0, 6.0):
        limit = apc.critical(compiled(SPRING), "contact.stiffness", params={"device.damping": damping}).value
        assert limit is not None
        value = (limit / 1.5) ** 1.5 / 3**0.5
        assert region.contains(0.98 * value, damping) and not region.contains(1.02 * value, damping)


def test_the_stiffness_of_a_hertz_contact_has_a_margin() -> None:
    """At a fixed depth d the slope 1.5 K d^0.5 reaches the critical stiffness of the linear spring."""
    point = apc.operating_point(compiled(PRESSED))
    model, depth = point.model, -positions(point)["device.x"]
    (row,) = (row for row in apc.margins(model).rows if row.parameter == "contact.stiffness")
    linear = apc.critical(compiled(SPRING), "contact.stiffness").value
    assert linear is not None and row.value is not None and row.error is not None
    assert 1.5 * row.value * depth**0.5 == pytest.approx(linear, rel=1e-6)


def test_delays_are_varied_at_one_equilibrium() -> None:
    found = apc.critical(compiled(PRESSED), "contact.delay", operating_point="equilibrium")
    linear = apc.critical(compiled(SPRING), "contact.delay", params={"contact.stiffness": hertz()})
    assert found.value == pytest.approx(linear.value, rel=1e-9)


def test_transparency_at_the_equilibrium_has_the_local_stiffness() -> None:
    model = compiled(PRESSED)
    felt = apc.transparency(model, [1.0], operating_point="equilibrium")
    linear = apc.transparency(compiled(SPRING), [1.0], params={"contact.stiffness": hertz()})
    assert felt.impedance == pytest.approx(linear.impedance, rel=1e-9)
    assert "linearized at the equilibrium" in " ".join(str(felt).split())
    assert felt.low_frequency is not None and felt.low_frequency.stiffness == pytest.approx(hertz(), rel=1e-6)


def test_tuning_at_the_equilibrium_ends_at_the_critical_value() -> None:
    limit = apc.critical(compiled(SPRING), "contact.stiffness").value
    assert limit is not None
    tuning = apc.tune(
        compiled(PRESSED),
        {"contact.stiffness": (1000.0, 1e6)},
        maximize="contact.stiffness",
        operating_point="equilibrium",
    )
    assert tuning.feasible
    assert float(tuning.gains[0].value) == pytest.approx((limit / 1.5) ** 1.5 / 3**0.5, rel=1e-2)


def test_sensitivities_contain_the_motion_of_the_equilibrium(cli: Cli, tmp_path: Path) -> None:
    """k = 1.5 K^(2/3) F^(1/3): p dρ/dp is 2/3 of that of k for K, and 1/3 for F."""
    write("topology.yaml", PRESSED)
    document = json.loads(cli("analyze topology.yaml --operating-point equilibrium --json").out)
    relative = {row["parameter"]: row["relative"] for row in document["sensitivities"]["derivatives"]}
    rows = apc.sensitivities(compiled(SPRING), params={"contact.stiffness": hertz()}).rows
    (linear,) = (row.relative for row in rows if row.parameter == "contact.stiffness")
    assert relative["contact.stiffness"] == pytest.approx(2 / 3 * linear, rel=1e-4)
    assert relative["push.force"] == pytest.approx(1 / 3 * linear, rel=1e-4)


def test_without_forces_the_equilibrium_is_the_start() -> None:
    model = compiled(AVERAGE)
    assert set(positions(apc.operating_point(model)).values()) == {0.0}
    started, resting = (apc.analyze(model, operating_point=point) for point in ("start", "equilibrium"))
    assert started.spectral_radius == resting.spectral_radius and not resting.linearized


def test_a_direction_without_stiffness_keeps_its_start() -> None:
    assert positions(apc.operating_point(compiled(ONE_MASS), params={"device.x": 0.3})) == {"device.x": 0.3}


def test_an_equilibrium_that_does_not_exist_is_refused() -> None:
    free = WALL.format(force=-2).replace("stiffness: 100 N/m", "stiffness: 0 N/m")
    (message,) = messages_of(apc.operating_point, compiled(free.replace("150 N/m", "0 N/m")))
    assert "E847 no equilibrium: 2 N remains unbalanced at device." in message
    moving = (
        WALL.format(force=1)
        .replace("ConstantForce", "SineForce")
        .replace("force: 1 N", "force: 1 N, frequency: 2 Hz")
    )
    (message,) = messages_of(apc.operating_point, compiled(moving))
    assert "E849 a force on device depends on time, so there is no equilibrium." in message


def test_a_force_that_changes_with_the_ages_of_packets_has_no_equilibrium(tmp_path: Path) -> None:
    part = """\
component: Aging
description: A spring that weakens with the age of the received position.
connectors: {object: Flange}
sends: {x: sample(object.x)}
parameters:
  stiffness: {unit: N/m, description: force per displacement}
  period: {unit: s, description: time until it is half as stiff}
  clock: clock
  link: link
variables:
  own: {unit: N, description: of the spring}
equations:
  - own = stiffness*sample(object.x)/(1 + mean(age(others.x))/period)
  - object.f = hold(own) - hold(stiffness*mean(others.x)/2)
"""
    text = """\
topology: aging
clocks: {haptic: 1 ms, network: 4 ms}
peers: {user: {count: 2}}
masses: {cube: {mass: 2 kg, damping: 5 N*s/m, shared: true}}
couplers: {aging: {type: Aging, object: cube, stiffness: 100 N/m, period: 0.1 s, clock: haptic, link: lan}}
links: {lan: {clock: network, delay: 4 ms}}
hands: {push: {type: ConstantForce, flange: cube, force: 1 N}}
"""
    (message,) = messages_of(apc.operating_point, compiled(text, library(tmp_path, part)))
    assert "E849 a force depends on the ages of packets, so there is no equilibrium." in message


@pytest.mark.parametrize("function", [apc.analyze, apc.operating_point])
def test_an_unknown_operating_point_is_refused(function: object) -> None:
    argument = "operating_point" if function is apc.analyze else "initial"
    with pytest.raises(apc.ApcError, match=r"E840 .*middle"):
        function(compiled(PRESSED), **{argument: "middle"})  # type: ignore[operator]


def test_the_command_line_refuses_an_unknown_operating_point(cli: Cli) -> None:
    ran = cli("analyze topology.yaml --operating-point middle")
    assert ran.code == 2 and "'middle' is not one of 'start', 'equilibrium'" in ran.err


def test_a_start_that_is_not_at_rest_proposes_the_equilibrium(cli: Cli) -> None:
    write("topology.yaml", PRESSED)
    said = " ".join(cli("analyze topology.yaml --no-margins").out.split())
    command = "apc analyze --operating-point equilibrium"
    assert "the initial state is not at rest: 3 N acts on device" in said
    assert f"for its equilibrium, run {command} " in said
    ran = cli(f"{command.removeprefix('apc ')} topology.yaml --no-margins")
    assert ran.code == 0 and "not at rest" not in ran.out


def test_a_saved_equilibrium_is_read_again(tmp_path: Path) -> None:
    write(str(tmp_path / "topology.yaml"), PRESSED)
    point = apc.operating_point(apc.compile(tmp_path / "topology.yaml"))
    apc.save(point.model, tmp_path / "topology.apc")
    again: Model = apc.load(tmp_path / "topology.apc")
    assert apc.analyze(again).spectral_radius == apc.analyze(point.model).spectral_radius
    assert "rest(" not in str(apc.parameters(again))


def test_the_example_of_the_reference_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(TOPOLOGIES)
    (example,) = doctest.DocTestFinder(recurse=False).find(apc.operating_point, globs={"apc": apc})
    assert example.examples and doctest.DocTestRunner().run(example).failed == 0
