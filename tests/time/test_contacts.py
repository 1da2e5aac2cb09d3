"""What is not linear moves as it should, to the tolerance or by the steps asked for; what is, stays exact."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.integrate import solve_ivp
from scipy.optimize import brentq

from apc.compiler.errors import ApcError
from apc.simulation.output_blocks import blocks
from apc.simulation.settings import Method, Settings, parse_method
from apc.simulation.simulation import prepare
from apc.simulation.trajectory import Trajectory, simulate
from tests.schemes import coast
from tests.sites import alone
from tests.topologies import AVERAGE, ONE_MASS, compiled, library, replaced

MS = Fraction(1, 1000)


CROSSLEY = """\
topology: impact
peers: {user: {count: 1, set: {device.x: -5 mm, device.v: 0.5 m/s}}}
masses: {device: {mass: 0.1 kg}}
couplers:
  contact:
    {type: HuntCrossleyContact, a: device, b: ground, stiffness: 2e5 N/m^(3/2), damping: 1e5 N*s/m^(5/2)}
hands: {hand: {type: ConstantForce, flange: device, force: 2 N}}
experiment: {duration: 0.3 s}
"""
STOP = """\
component: Stop
description: A wall that acts at every moment.
source: none
connectors: {flange: Flange}
parameters:
  stiffness: {unit: N/m, min: 0, description: force per depth}
  damping:   {unit: N*s/m, min: 0, default: 0 N*s/m, description: force per rate of depth}
  place:     {unit: m, default: 0 m, description: of the wall}
equations:
  - flange.f = if flange.x > place then stiffness*(flange.x - place) + damping*der(flange.x) else 0
"""
IMPACT = """\
topology: stop
peers: {user: {count: 1, set: {device.x: -5.3 mm, device.v: 0.5 m/s}}}
masses: {device: {mass: 0.1 kg}}
couplers: {stop: {type: Stop, flange: device, stiffness: 3000 N/m}}
experiment: {duration: 40 ms}
"""


def dense_output(
    laws: Callable[[bool], Callable[[float, Any], Any]], start: list[float], times: np.ndarray
) -> np.ndarray:
    """Integrate piece by piece: `laws(inside)` is a right-hand side, pieces end where x changes sign."""

    def surface(t: float, x: np.ndarray) -> float:
        return float(x[0])

    surface.terminal = True  # type: ignore[attr-defined] # solve_ivp looks for it on the function
    rows, x, t, inside = [start], np.array(start), times[0], start[0] > 0
    for end in times[1:]:
        while t < end:
            law = laws(inside)
            found = solve_ivp(law, (t, end), x, "DOP853", rtol=3e-14, atol=1e-17, events=surface)
            t, x = found.t[-1], found.y[:, -1]
            if found.status == 1:
                inside = not inside
                h = min(1e-12, end - t)
                x, t = x + h * np.array(laws(inside)(t, x)), t + h
        rows.append(x.tolist())
    return np.array(rows)


@pytest.mark.whole
def test_hunt_and_crossleys_impact_is_that_of_an_independent_integration() -> None:
    def laws(inside: bool) -> object:
        def law(t: float, x: np.ndarray) -> list[float]:
            push = max(x[0], 0) ** 1.5 * max(2e5 + 1e5 * x[1], 0) if inside else 0.0
            return [x[1], (2 - push) / 0.1]

        return law

    model = compiled(CROSSLEY)
    found = simulate(model, jit=False)
    true = dense_output(laws, [-0.005, 0.5], found.time)
    assert np.abs(found.values - true).max(axis=0) == pytest.approx([0, 0], abs=3e-7)
    assert np.abs(found.values[:, 0] - true[:, 0]).max() < 2e-9
    loose, tight = (
        np.abs(simulate(model, method=Method("cvodes", tolerance=one), jit=False).values - true).max()
        for one in (1e-6, 1e-12)
    )
    assert 1e-5 < loose < 1e-2
    assert tight < 3e-8


def test_tolerances_follow_the_topologies_scales_and_are_reported() -> None:
    found = simulate(compiled(CROSSLEY), duration=MS, jit=False)
    assert found.provenance.method == "exact where linear, cvodes:1e-10 elsewhere"
    absolute = {one.state: one.absolute for one in found.provenance.tolerances}
    assert absolute == pytest.approx({"device.x": 5e-13, "device.v": 5e-11})
    assert "absolute tolerances from 5e-13 m, 5e-11 m/s" in " ".join(str(found).split())


def test_a_wall_without_damping_is_left_after_half_a_sine(tmp_path: Path) -> None:
    found = simulate(compiled(IMPACT, library(tmp_path, STOP)), jit=False)
    t, x, v = found.time, found["user[1].device.x"], found["user[1].device.v"]
    begin, omega = 0.0053 / 0.5, np.sqrt(3000 / 0.1)
    end = begin + np.pi / omega
    inside, after = (t > begin) & (t < end), t > end
    assert inside.sum() > 10
    assert x[inside] == pytest.approx(0.5 / omega * np.sin(omega * (t[inside] - begin)), abs=1e-10)
    assert x[after] == pytest.approx(-0.5 * (t[after] - end), abs=2e-10)
    assert v[after] == pytest.approx(-0.5, abs=2e-8)


def test_a_force_that_jumps_is_met_at_the_jump(tmp_path: Path) -> None:
    text = IMPACT.replace("3000 N/m", "2000 N/m, damping: 2 N*s/m").replace("40 ms", "200 ms")
    text += "hands: {hand: {type: ConstantForce, flange: device, force: 2 N}}\n"

    def laws(inside: bool) -> object:
        return lambda t, x: [x[1], (2 - (2000 * x[0] + 2 * x[1] if inside else 0)) / 0.1]

    found = simulate(compiled(text, library(tmp_path, STOP)), jit=False)
    true = dense_output(laws, [-0.0053, 0.5], found.time)
    assert np.abs(found.values - true).max() < 3e-7


F = ", f: {unit: 1, start: 0}"


def test_a_motion_that_is_not_linear_feels_held_forces_from_when_they_act() -> None:
    # With y = x - 1: y' = f - y^2, f = 1 from half a tick on. Until then 1/y grows by t, then y is a coth.
    model = alone("hold(f, delay) - (x - 1)^2", "f = 0*sample(x) + 1", variables=F, delay="0.5 ms")
    found = simulate(model, duration=Fraction(1, 100), jit=False)
    expected = 1 + 1 / np.tanh(found.time[1:] - 5e-4 + np.arctanh(-1 + 5e-4))
    assert found["peer[1].it.x"][1:] == pytest.approx(expected, rel=1e-8)


@pytest.mark.parametrize(("method", "error"), [("rk4:1ms", 1e-12), ("cvodes:1e-10", 1e-8)])
def test_every_method_reaches_the_closed_form(method: str, error: float) -> None:
    """dy/dt = −y³ from −1, y = x − 1: −1/√(1 + 2t)."""
    found = simulate(alone("-(x - 1)^3"), duration=Fraction(1, 2), method=parse_method(method), jit=False)
    assert found["peer[1].it.x"] == pytest.approx(1 - 1 / np.sqrt(1 + 2 * found.time), abs=error)


MIXED = """\
topology: mixed
clocks: {haptic: 1 ms}
peers:
  hard: {count: 1, set: {device.x: -1 mm, device.v: 0.5 m/s}}
  free: {count: 2, set: {device.x: [5 mm, 3 mm]}}
masses:
  device: {mass: 0.1 kg, damping: 1 N*s/m}
  tool:   {mass: 0.2 kg, damping: 2 N*s/m}
couplers:
  contact: {type: HuntCrossleyContact, at: [hard], a: device, b: ground, stiffness: 2e5 N/m^(3/2)}
  spring:  {type: SampledSpringDamper, a: device, b: tool, stiffness: 300 N/m, clock: haptic}
experiment: {duration: 50 ms}
"""


def columns(trajectory: Trajectory, start: str) -> np.ndarray:
    stored = [i for i, one in enumerate(trajectory.signals) if one.name.startswith(start)]
    return trajectory.values[:, stored]


def test_linear_peers_and_parts_keep_their_exact_motion() -> None:
    model = compiled(MIXED)
    found = simulate(model, jit=False)
    assert [one.state for one in found.provenance.tolerances] == ["device.x", "device.v"]
    linear = MIXED.replace("  hard: {count: 1, set: {device.x: -1 mm, device.v: 0.5 m/s}}\n", "")
    linear = "".join(line for line in linear.splitlines(True) if "contact" not in line)
    assert (columns(found, "free") == columns(simulate(compiled(linear), jit=False), "free")).all()


@pytest.mark.parametrize(
    ("law", "rows", "last"),
    [  # the rows of whole frames: here a frame is a millisecond
        ("50*(x + 1)^2", 19, 9.0),  # 1/(1 - 50 t) - 1: a pole at 20 ms; 18 ms is the last row
        ("-20*sqrt(x + 0.01) - 1", 4, None),  # the root has no value after 4.2 ms
        ("1 - 2*sign(x - 5e-3)", 1, None),  # pushed to and fro at 5 mm, after 1.7 ms
    ],
)
def test_what_cant_be_integrated_on_is_kept_until_there(
    law: str, rows: int, last: float | None, capfd: pytest.CaptureFixture[str]
) -> None:
    played = blocks(prepare(alone(law), Settings(MS * 100, jit=False)))
    block = next(played)
    assert len(block.time) == rows
    if last is not None:
        assert block.values[-1, 0] == pytest.approx(last, rel=1e-6)
    with pytest.raises(
        ApcError, match=r"E871 the motion of it.x can't be integrated after 0\.0\d+ s: it diverges"
    ):
        next(played)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize(("method", "order"), [("rk4", 4), ("semi-implicit", 1)])
def test_a_linear_topology_converges_to_the_exact_one_with_the_order_of_the_method(
    method: str, order: int
) -> None:
    moved = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}"))
    model = compiled(moved.replace("delay: 1 ms", "delay: 0.3 ms"))  # steps end at 0.3 ms of each tick

    def error(step: str) -> float:
        found = simulate(
            model, duration=MS * 20, signals=["*.x"], method=parse_method(f"{method}:{step}"), jit=False
        )
        return float(np.abs(found.values - exact.values).max())

    exact = simulate(model, duration=MS * 20, signals=["*.x"], jit=False)
    assert exact.provenance.method == "exact"
    assert np.log2(error("100us") / error("25us")) / 2 == pytest.approx(order, abs=0.15)


SWING = ONE_MASS.replace("count: 1", "count: 1, set: {device.x: 1 m}") + (
    "couplers: {tie: {type: SpringDamper, a: device, b: ground, stiffness: 900 N/m}}\n"
)


def test_semi_implicit_takes_the_new_velocity_for_the_position() -> None:
    """A step of 0.4 ms ends with the millisecond: two of 0.4 ms, one of 0.2 ms."""
    method = parse_method("semi-implicit:0.4ms")
    found = simulate(compiled(SWING), duration=MS * 50, method=method, jit=False)
    x, v = 1.0, 0.0
    for row in found.values:
        assert row == pytest.approx([x, v], rel=1e-12)
        for h in (0.4e-3, 0.4e-3, 0.2e-3):
            v += h * (-900 * x - 3 * v) / 2
            x += h * v


SOFT = """\
component: SoftSpring
description: A spring that gives way more the harder it is pulled.
connectors: {flange: Flange}
parameters: {stiffness: {unit: N/m}, soft: {unit: 1/N^2}CLOCK}
variables: {f: {unit: N}}
equations:
  - f + soft*f^3 = stiffness*PLACE
  - flange.f = FORCE
"""
SOFT_TOPOLOGY = """\
topology: soft
clocks: {tick: 1 ms}
peers: {user: {count: 1, set: {device.x: 20 mm}}}
masses: {device: {mass: 0.1 kg, damping: 1 N*s/m}}
couplers: {it: {type: SoftSpring, flange: device, stiffness: 500 N/m, soft: 1 1/N^2}}
"""


def soft(x: float) -> float:
    return float(brentq(lambda f: f + f**3 - 500 * x, -20, 20, xtol=1e-15))


@pytest.mark.parametrize("sampled", [False, True])
def test_a_loop_that_newtons_method_solves_is_played(tmp_path: Path, sampled: bool) -> None:
    """f + f³ = 500 x, at every moment, or at each tick and held from there."""
    words = (", clock: clock", "sample(flange.x)", "hold(f)") if sampled else ("", "flange.x", "f")
    text = SOFT
    for name, word in zip(("CLOCK", "PLACE", "FORCE"), words, strict=True):
        text = text.replace(name, word)
    topology = (
        SOFT_TOPOLOGY.replace("soft: 1 1/N^2", "soft: 1 1/N^2, clock: tick") if sampled else SOFT_TOPOLOGY
    )
    found = simulate(compiled(topology, library(tmp_path, text)), duration=MS * 50, jit=False)
    if sampled:
        x, v = 0.02, 0.0
        for row in range(50):
            x, v = coast(x, v, -soft(x), 0.1, 1.0, 0.0, 1e-3)
            assert found.values[row + 1, :2] == pytest.approx([x, v], rel=1e-9)
    else:
        true = solve_ivp(
            lambda t, x: [x[1], (-x[1] - soft(x[0])) / 0.1],
            *((0, 0.05), [0.02, 0.0], "DOP853", found.time),
            rtol=1e-12,
            atol=1e-14,
        )
        assert np.abs(found.values[:, :2] - true.y.T).max() < 1e-7
