"""Equations become functions: constraints, loops and singular systems, against closed forms and NumPy."""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
import pytest

import apc
from tests.language.own import component, force, model, topology
from tests.library.parts import rates, ticked
from tests.topologies import ONE_MASS, compiled, library, messages_of

# ---- rigid connections ----

ROW = "  load: {mass: 5 kg, damping: 1 N*s/m"


def only(text: str, speed: float) -> tuple[list[str], dict[str, float]]:
    """Return the states of a topology and the rates where its only velocity is such."""
    model = compiled(text)
    states = [state.name for state in model.peer_types[0].states]
    velocity = {name: speed for name in states if name.endswith(".v")}
    return states, rates(model, velocity)


def test_masses_joined_the_other_way_round_have_opposite_velocities(tmp_path: Path) -> None:
    reversed_ = "component: Lever\nconnectors: {a: Flange, b: Flange}\nequations: [a.x = -b.x, a.f = b.f]\n"
    text = f"{ONE_MASS}{ROW}}}\ncouplers: {{lever: {{type: Lever, a: device, b: load}}}}\n"
    text += "hands: {push: {type: ConstantForce, flange: device, force: 4 N}}\n"
    model = compiled(text, library(tmp_path, reversed_))
    [position, velocity] = [state.name for state in model.peer_types[0].states]
    sign = 1 if velocity == "device.v" else -1
    found = rates(model, {velocity: 0.5})
    assert [found[position], found[velocity]] == pytest.approx([0.5, (sign * 4 - 4 * 0.5) / 7], rel=1e-14)


@pytest.mark.parametrize("position", ["0*L", "L", "L*sin(time/T)", "L*(time/T)^2"])
def test_what_is_told_where_to_be_has_no_state_and_plays(position: str, tmp_path: Path) -> None:
    compiled_model = model(tmp_path, f"flange.x = {position}")
    assert compiled_model.peer_types[0].states == ()
    found = apc.analyze(compiled_model)
    assert (found.verdict, found.spectral_radius) == ("stable", 0)
    assert apc.simulate(compiled_model, duration="20 ms", jit=False).time[-1] == pytest.approx(0.02)


def test_a_second_derivative_takes_the_velocity_that_is_named_as_its_state(tmp_path: Path) -> None:
    compiled_model = model(
        tmp_path, "K*T^2*der(der(y)) = F - K*T*der(y)", "der(y) = v", "flange.f = 0", variables="y: v=m/s:"
    )
    assert {one.name for one in compiled_model.peer_types[0].states} == {
        "device.x",
        "device.v",
        "own.y",
        "own.v",
    }
    assert rates(compiled_model, {"own.v": 1.0})["own.v"] == pytest.approx(0.01 - 1, rel=1e-14)


def test_the_derivative_of_a_sampled_algebraic_variable_follows_by_the_chain_rule(tmp_path: Path) -> None:
    equations = [
        "y = L*exp(2*flange.x/L)",
        "z = y + flange.x",
        "s = sample(der(z))",
        "flange.f = -hold(K*T*s)",
    ]
    compiled_model = model(tmp_path, *equations, variables="y z s=m/s")
    found = ticked(compiled_model, {"device.x": 0.3, "device.v": 0.25})
    assert list(found.values()) == pytest.approx([100 * 0.25 * (2 * math.exp(0.6) + 1)], rel=1e-14)


# ---- algebraic loops ----


def cardano(x: float) -> float:
    """Return the root of y + y³ = x."""
    root = math.sqrt(x * x / 4 + 1 / 27)
    first = math.copysign((abs(x) / 2 + root) ** (1 / 3), x)
    return first - 1 / (3 * first)


@pytest.mark.parametrize("x", [-20.0, -1.0, 0.0, 0.3, 2.0, 1e6])
def test_a_cubic_loop_has_cardanos_root(x: float, tmp_path: Path) -> None:
    compiled_model = model(tmp_path, "y + y^3/L^2 = flange.x", "flange.f = K*y", variables="y")
    assert -force(compiled_model, x) / 100 == pytest.approx(cardano(x), rel=1e-13, abs=1e-13)


def test_a_loop_of_several_unknowns_is_solved_and_what_follows_it_is_explicit(tmp_path: Path) -> None:
    equations = ["a = p*b", "b = c + L", "c = d - 2*L", "d + d^3/L^2 = 3*a + flange.x", "flange.f = 2*K*d"]
    d = -force(model(tmp_path, *equations, variables="a b c d"), 0.7) / 200
    assert d + d**3 == pytest.approx(3 * 0.25 * (d - 1) + 0.7, abs=1e-13)
    one, other = "x^3/L^2 + y = 3*L", "x + y^3/L^2 = 3*L + flange.x"
    x = -force(model(tmp_path, one, other, "flange.f = K*x", variables="x y"), 0.1) / 100
    assert x + (3 - x**3) ** 3 == pytest.approx(3.1, abs=1e-12)


def test_a_loop_that_needs_another_is_solved_after_it(tmp_path: Path) -> None:
    equations = ["y + y^3/L^2 = flange.x", "z + z^5/L^4 = 2*y", "flange.f = K*(z - y)"]
    z = -force(model(tmp_path, *equations, variables="y z"), 10.0) / 100 + 2
    assert z + z**5 == pytest.approx(4.0, abs=1e-12)


def test_a_topology_is_linearized_through_its_loops(tmp_path: Path) -> None:
    """At x = 10 is y = 2, and of its slope 1/(1 + 3·4): m s² + b s + K/13 = 0, over a second."""
    text = component("y + y^3/L^2 = flange.x", "flange.f = K*(y - 2*L)", variables="y")
    found = apc.analyze(compiled(topology(text, start="10 m"), library(tmp_path, text)))
    assert found.spectral_radius == pytest.approx(math.exp(-3 / 4), rel=1e-9)
    frequency = math.sqrt(100 / 13 / 2 - (3 / 4) ** 2)
    assert abs(np.angle(found.modes[0].eigenvalue)) == pytest.approx(frequency, rel=1e-9)


@pytest.mark.parametrize("size", [2, 3, 5, 6])
def test_linear_loops_have_the_solution_numpy_finds(size: int, tmp_path: Path) -> None:
    numbers = np.random.default_rng(size)
    matrix = numbers.integers(-3, 4, (size, size)) + 10 * np.eye(size, dtype=int)
    right = numbers.integers(1, 4, size)
    rows = [" + ".join(f"({v})*p*x{i}" for i, v in enumerate(row)) for row in matrix]
    equations = [f"{row} = {b}*p*flange.x" for row, b in zip(rows, right, strict=True)]
    summed = " + ".join(f"{3**i}*x{i}" for i in range(size))
    names = " ".join(f"x{i}" for i in range(size))
    compiled_model = model(tmp_path, *equations, f"flange.f = K*({summed})", variables=names)
    expected = 100 * 3.0 ** np.arange(size) @ np.linalg.solve(matrix, right)
    assert -force(compiled_model, 1.0) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize("p", [0, 0.5])
def test_a_pivot_is_a_number_where_there_is_one(p: float, tmp_path: Path) -> None:
    """p a + b = 1, a − p b = 2: a = (2 + p)/(1 + p²), b = (1 − 2 p)/(1 + p²), at p = 0 as well."""
    equations = ["p*a + b = flange.x", "a - p*b = 2*flange.x", "flange.f = K*(a + b)"]
    found = -force(model(tmp_path, *equations, variables="a b", more=f", p: {p}"), 1.0) / 100
    assert found == pytest.approx((2 + p + 1 - 2 * p) / (1 + p * p), rel=1e-14)


def test_a_loop_through_a_condition_that_is_known_stays_linear(tmp_path: Path) -> None:
    compiled_model = model(
        tmp_path, "y = if flange.x > 0 then p*(y - L) + flange.x else 0", "flange.f = K*y", variables="y"
    )
    assert [-force(compiled_model, x) / 100 for x in (2.0, -2.0)] == [
        pytest.approx(1.75 / 0.75, rel=1e-14),
        0,
    ]


ZERO = (Path(__file__).parent / "zero.txt").read_text(encoding="utf-8").splitlines()


@pytest.mark.parametrize("case", ZERO)
def test_a_factor_that_is_zero_whatever_the_motion_is_none(case: str, tmp_path: Path) -> None:
    text, _, zero = case.partition(" → ")
    equations = ["x = flange.x/L", "z = 2*x + 1", f"({text})*y = L", "flange.f = K*y"]
    own = component(*equations, variables="y")
    lines = messages_of(compiled, topology(own), library(tmp_path, own))
    assert bool(lines) == (zero == "zero")


# ---- what has no answer ----

SINGULAR = (Path(__file__).parent / "singular.txt").read_text(encoding="utf-8").split("\n\n")


@pytest.mark.parametrize("case", SINGULAR)
def test_equations_without_an_answer_are_told_by_name(case: str, tmp_path: Path) -> None:
    equations, variables, expected = map(str.strip, case.rstrip("\n").split("\n"))
    own = component(*equations.split("; "), variables=variables)
    lines = messages_of(compiled, topology(own), library(tmp_path, own))
    assert len(lines) == 1
    assert expected in lines[0]
