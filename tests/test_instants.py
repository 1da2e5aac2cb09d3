"""Claims about `apc.simulation.forcing`: a function of time at many instants at once."""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np
import pytest

from apc.simulation.forcing import MOST_INSTANTS, at_instants

PARAMETERS = np.array([0.7, -1.3])
# Every way in which a force may hang on time.
FORCES = {
    "sine": lambda p, t: p[0] * casadi.sin(3 * t + p[1]) + casadi.cos(t) * casadi.tanh(t),
    "choice": lambda p, t: casadi.if_else(t < p[0], p[1], casadi.if_else(t <= 2, t, p[0] / t)),
    "logic": lambda p, t: casadi.logic_or(casadi.logic_and(t > p[0], t != 1), casadi.logic_not(t > 0)),
    "extremes": lambda p, t: (
        casadi.fmax(p[1], casadi.fmin(t, p[0])) + casadi.fabs(t - 1) + casadi.sign(t - 1)
    ),
    "steps": lambda p, t: casadi.floor(4 * t) - casadi.ceil(t / p[0]),
    "powers": lambda p, t: casadi.sqrt(t) + t**2.5 + casadi.exp(-t) + casadi.log(1 + t) + 1 / (1 + t) + t**2,
    "table": lambda p, t: casadi.pw_lin(casadi.fmin(t, 2.5), [0, 1, 2, 3], [0, 5, -1, 2]),
    "constant": lambda p, t: p[0] + p[1],
}


def function_of(force: Any) -> Any:
    p, t = casadi.SX.sym("p", 2), casadi.SX.sym("t")
    return casadi.Function("force", [p, t], [casadi.densify(casadi.vertcat(force(p, t), t))])


@pytest.mark.parametrize("name", FORCES)
def test_every_operation_gives_what_casadi_gives(name: str) -> None:
    function = function_of(FORCES[name])
    instants = np.concatenate([np.linspace(0, 3, 61), [0.7, 1.0, 2.0]])
    expected = [np.asarray(function(PARAMETERS, float(t))).ravel() for t in instants]
    found = at_instants(function, PARAMETERS, instants)
    np.testing.assert_allclose(found, np.transpose(expected), rtol=1e-15, atol=1e-16)


def test_instants_of_any_shape_and_number_are_taken() -> None:
    function = function_of(FORCES["sine"])
    instants = np.linspace(0, 1, 2 * MOST_INSTANTS + 6).reshape(2, MOST_INSTANTS + 3, 1)
    found = at_instants(function, PARAMETERS, instants)
    assert found.shape == (2, *instants.shape)
    assert (found[1] == instants).all()
    assert at_instants(function, PARAMETERS, np.empty((0, 26))).shape == (2, 0, 26)


def test_a_loop_that_only_casadi_solves_is_left_to_it() -> None:
    t, z = casadi.SX.sym("t"), casadi.SX.sym("z")
    solver = casadi.rootfinder("solver", "newton", {"x": z, "p": t, "g": z**3 + z - t})
    given, time = casadi.MX.sym("p", 2), casadi.MX.sym("t")
    function = casadi.Function("force", [given, time], [solver(x0=0, p=time)["x"]])
    instants = np.array([[0.0, 2.0], [10.0, 30.0]])
    np.testing.assert_allclose(at_instants(function, PARAMETERS, instants), [[[0, 1], [2, 3]]], atol=1e-12)
