"""Claims about `apc.simulation.propagate`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

import casadi
import numpy as np
import pytest

from apc.compiler.compiled import Kind
from apc.frame.parameters import resolve
from apc.simulation.propagate import (
    CLOSE,
    MOST_EXACT,
    nonlinear_rows,
    perturbed,
    rates,
    transition_rows,
    transitions,
)
from tests.sites import NAMES, alone, columned, paper

mpmath = pytest.importorskip("mpmath")
PARAMETERS = resolve(paper()).parameters[0][0]


def _user(force: float = 0.0) -> tuple[Kind, np.ndarray]:
    parameters = PARAMETERS.copy()
    parameters[NAMES.index("hand.force")] = force
    return paper().kinds[0], parameters


def test_a_damped_mass_pushed_by_held_and_constant_forces_is_its_closed_form_to_the_last_digits() -> None:
    """x(T) of m v' = f − b v from rest: f/b (T − (1 − e^(−bT/m)) m/b), at 40 digits."""
    kind, parameters = _user(force=4.0)
    found = transitions(rates(kind), parameters, [Fraction(1, 1000), Fraction(7, 3)])
    for (p, q), matrix in zip(((1, 1000), (7, 3)), found.matrices, strict=True):
        with mpmath.workdps(40):
            m, b, duration = mpmath.mpf(0.1), mpmath.mpf(5), mpmath.mpf(p) / q
            decay = mpmath.exp(-b * duration / m)
            push = (duration - (1 - decay) * m / b) / b
            expected = {(0, 1): (1 - decay) * m / b, (1, 1): decay, (0, 4): -push, (0, 6): 4 * push}
            for place, value in expected.items():
                assert abs(mpmath.mpf(matrix[place]) - value) <= 2**-52 * abs(value)


def test_where_a_transition_may_differ_from_zero_is_structure() -> None:
    pattern = rates(paper().kinds[0])
    assert pattern.e.tolist() == [[1, 1, 0, 0], [0, 1, 0, 0], [0, 0, 1, 1], [0, 0, 0, 1]]
    assert pattern.f.tolist() == [[1, 0], [1, 0], [1, 1], [1, 1]]
    assert pattern.g.tolist() == [True, True, False, False]  # the hand pushes the device
    assert not pattern.timed


def test_what_a_nonlinear_equation_is_tied_to_is_not_linear_either() -> None:
    kind = paper().kinds[0]
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)
    p, t = casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    bent = kind.derivative(x, u, p, t) - casadi.vertcat(0, x[0] ** 3, 0, 0)
    assert nonlinear_rows(kind) == ()
    assert nonlinear_rows(replace(kind, derivative=casadi.Function("f", [x, u, p, t], [bent]))) == (0, 1)


def test_perturbed_transitions_are_off_by_one_rounding_and_zeros_stay() -> None:
    system = alone(lambda x, u: -3 * x)
    exact = transitions(rates(system.kinds[0]), resolve(system).parameters[0][0], [Fraction(1, 10)])
    [one], [other] = exact.matrices, perturbed(exact, 1).matrices
    assert abs(other[0, 0] - one[0, 0]) == np.spacing(one[0, 0])
    assert other[0, 1] == one[0, 1] == 0.0
    assert perturbed(exact, 1).matrices[0].tolist() == other.tolist()


def test_many_different_sites_move_as_each_by_itself() -> None:
    """Masses over nine decades: where a motion dies out at once, floats are not enough, and are not used."""
    count = 3 * MOST_EXACT
    system = columned(paper(peers=count), device__mass=np.geomspace(1e-6, 1e3, count))
    linear, vectors = rates(system.kinds[0]), resolve(system).parameters[0]
    lengths = [Fraction(1, 1000), Fraction(1, 3)]
    found = transition_rows(linear, vectors, lengths)
    for place in range(0, count, 7):
        own = transitions(linear, vectors[place], lengths)
        for many, one in zip(found.matrices, own.matrices, strict=True):
            assert np.abs(many[place] - one).max() <= CLOSE * np.abs(one).max()
