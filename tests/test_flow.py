"""Claims about `apc.simulation.flow`."""

from __future__ import annotations

import math
from fractions import Fraction

import casadi
import numpy as np
import pytest

from apc.simulation.flow import flow_of, rows_to_move
from apc.simulation.settings import DEFAULT, parse_method
from tests.sites import alone, paper

CUBIC = alone(lambda x, u: -(x**3)).kinds[0]


@pytest.mark.parametrize(("method", "linear", "cubic"), [("exact", (), ()), ("rk4:1ms", (0, 1, 2, 3), (0,))])
def test_a_fixed_step_moves_everything_and_the_exact_method_nothing(
    method: str, linear: tuple[int, ...], cubic: tuple[int, ...]
) -> None:
    found = parse_method(method)
    assert (rows_to_move(paper().kinds[0], found), rows_to_move(CUBIC, found)) == (linear, cubic)


def test_by_default_only_what_is_not_linear_is_integrated() -> None:
    assert rows_to_move(paper().kinds[0], DEFAULT) == ()
    assert flow_of(paper().kinds[0], DEFAULT, (), np.ones(4)) is None
    assert rows_to_move(CUBIC, DEFAULT) == (0,)


@pytest.mark.parametrize(("method", "error"), [("rk4:1ms", 1e-12), ("cvodes:1e-10", 1e-8)])
def test_a_flow_reaches_the_closed_form(method: str, error: float) -> None:
    """dx/dt = −x³ from 1: 1/√(1 + 2t)."""
    flow = flow_of(CUBIC, parse_method(method), (0,), np.ones(1))
    assert flow is not None
    found = float(flow.over(Fraction(1, 2))(1.0, casadi.DM(0, 1), [0.0], 0.0))
    assert found == pytest.approx(1 / math.sqrt(2), rel=error)


def test_only_an_adaptive_step_has_tolerances_and_they_are_of_each_states_size() -> None:
    scale = np.array([0.25])
    stepped = flow_of(CUBIC, parse_method("rk4:1ms"), (0,), scale)
    adaptive = flow_of(CUBIC, parse_method("cvodes:1e-6"), (0,), scale)
    assert stepped is not None and adaptive is not None
    assert stepped.tolerances(CUBIC) == ()
    [tolerance] = adaptive.tolerances(CUBIC)
    assert (tolerance.state, tolerance.relative, tolerance.absolute) == ("x", 1e-6, 0.25e-6)
