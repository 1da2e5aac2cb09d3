"""`flow`: methods of a fixed step do what their tableau says, to the last, shorter step."""

from __future__ import annotations

from collections.abc import Callable
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
import pytest

from apc.simulation.flow import integrals, stepped
from apc.simulation.settings import Method, parse_method
from apc.simulation.trajectory import simulate
from tests.topologies import AVERAGE, compiled, replaced

S = Fraction(1)


def rate(expression: Callable[[Any, Any, Any, Any], Any], n: int = 1) -> casadi.Function:
    x, u, p, t = (casadi.SX.sym(name, size) for name, size in (("x", n), ("u", 1), ("p", 1), ("t", 1)))
    return casadi.Function("rate", [x, u, p, t], [casadi.densify(expression(x, u, p, t))])


def test_rk4_is_exact_for_a_cubic_in_time_whatever_the_last_step() -> None:
    function = rate(lambda x, u, p, t: 4 * t**3 + u - p)
    for step in (S, S / 3, Fraction(3, 10), Fraction(7, 1000)):
        move = stepped(function, Method("rk4", step=step), S, ())
        assert float(move(1.0, 5.0, 2.0, 1.0)) == pytest.approx(1 + 15 + 3, rel=1e-14)


@pytest.mark.parametrize(("name", "order"), [("rk4", 4), ("semi-implicit", 1)])
def test_halving_the_step_divides_the_error_by_two_to_the_order(name: str, order: int) -> None:
    function = rate(lambda x, u, p, t: casadi.vertcat(x[1], -x[0]), 2)
    ends = [
        np.asarray(stepped(function, Method(name, step=S / n), S, [(0, 1)])([1, 0.5], 0, 0, 0)).ravel()
        for n in (64, 128)
    ]
    true = np.array([np.cos(1) + 0.5 * np.sin(1), 0.5 * np.cos(1) - np.sin(1)])
    coarse, fine = (np.abs(end - true).max() for end in ends)
    assert np.log2(coarse / fine) == pytest.approx(order, abs=0.1)


def test_semi_implicit_takes_the_new_velocity_for_the_position() -> None:
    function = rate(lambda x, u, p, t: casadi.vertcat(x[1], -4 * x[0] - x[1] + u), 2)
    assert integrals(function) == ((0, 1),)
    move = stepped(function, Method("semi-implicit", step=S / 10), Fraction(1, 4), integrals(function))
    x, v = 1.0, 0.5
    for h in (0.1, 0.1, 0.05):
        v += h * (-4 * x - v + 3)
        x += h * v
    assert np.asarray(move([1, 0.5], 3, 0, 0)).ravel() == pytest.approx([x, v], rel=1e-14)


def test_an_undamped_motion_keeps_its_energy_by_semi_implicit_steps() -> None:
    function = rate(lambda x, u, p, t: casadi.vertcat(x[1], -x[0]), 2)
    move = stepped(function, Method("semi-implicit", step=S / 100), 1000 * S, integrals(function))
    x, v = np.asarray(move([1, 0], 0, 0, 0)).ravel()
    assert (x**2 + v**2) / 2 == pytest.approx(0.5, rel=0.01)


def test_states_that_are_each_others_rates_are_no_integrals() -> None:
    function = rate(lambda x, u, p, t: casadi.vertcat(x[1], x[0], x[1] + u), 3)
    assert integrals(function) == ()
    chain = rate(lambda x, u, p, t: casadi.vertcat(x[1], x[2], u), 3)
    assert integrals(chain) == ((1, 2), (0, 1))


@pytest.mark.parametrize(("method", "order"), [("rk4", 4), ("semi-implicit", 1)])
def test_a_linear_scene_converges_to_the_exact_one_with_the_order_of_the_method(
    method: str, order: int
) -> None:
    moved = replaced(AVERAGE, ("{count: 3}", "{count: 3, set: {device.x: [10 mm, 0 mm, -5 mm]}}"))
    system = compiled(moved.replace("delay: 1 ms", "delay: 0.3 ms"))  # steps end at 0.3 ms of each tick
    exact = simulate(system, duration=Fraction(1, 25), signals=["*.x"])
    assert exact.provenance.method == "exact"
    errors = []
    for step in ("100us", "50us", "25us"):
        found = simulate(
            system,
            duration=Fraction(1, 25),
            signals=["*.x"],
            method=parse_method(f"{method}:{step}"),
            jit=False,  # a C compiler takes many times as long as these steps
        )
        errors.append(np.abs(found.values - exact.values).max())
    assert np.log2(errors[0] / errors[2]) / 2 == pytest.approx(order, abs=0.15)
