"""Claims about `apc.runtime.frame.linearize`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi
import numpy as np
import pytest

from apc.compiler.compiled import Kind
from apc.runtime.frame.jacobians import jacobians
from apc.runtime.frame.linearize import linearize, linearize_exact
from apc.runtime.frame.parameters import resolve
from tests.sites import NAMES, edged, paper, user


def _vector(**values: float) -> np.ndarray:
    return resolve(paper(**values)).parameters[0][0]


def test_the_paper_site_has_the_matrices_derived_by_hand() -> None:
    site = linearize(jacobians(user("mean")), _vector(kt=800.0, bt=2.0, kc=1500.0, bc=3.0, cube=0.25))
    np.testing.assert_array_equal(site.a, [[0, 1, 0, 0], [0, -50.0, 0, 0], [0, 0, 0, 1], [0, 0, 0, -20.0]])
    np.testing.assert_array_equal(site.b, [[0, 0], [-10.0, 0], [0, 0], [4.0, -4.0]])
    [tick], [send] = site.ticks, site.sends
    np.testing.assert_array_equal(tick.x, [[1500.0, 3.0, -1500.0, -3.0], [0, 0, 800.0, 2.0]])
    np.testing.assert_array_equal(tick.r, [[0, 0], [-800.0, -2.0]])
    np.testing.assert_array_equal(tick.u, np.zeros((2, 2)))
    assert tick.m.shape == (2, 0)
    np.testing.assert_array_equal(send.x, [[0, 0, 1, 0], [0, 0, 0, 1]])
    assert site.affine


def test_full_mesh_pulls_with_the_number_of_others() -> None:
    site = linearize(jacobians(user("sum")), _vector(kt=100.0, bt=2.0, peers=5))
    np.testing.assert_array_equal(site.ticks[0].x[1], [0, 0, 400.0, 8.0])
    np.testing.assert_array_equal(site.ticks[0].r[1], [-100.0, -2.0])


def test_exact_matrices_are_the_floats_without_their_rounding() -> None:
    built, parameters = jacobians(user("sum")), _vector(kt=0.1, peers=4)
    exact, rounded = linearize_exact(built, parameters), linearize(built, parameters)
    assert exact.ticks[0].x[1, 2] == 3 * Fraction(0.1)
    assert exact.b[1, 0] == -1 / Fraction(0.1)
    np.testing.assert_allclose(exact.a.astype(float), rounded.a, rtol=1e-15)


def test_a_pattern_is_structure_whatever_the_numbers() -> None:
    built = jacobians(user("mean"))
    assert built.pattern.ticks[0].r[1].all()
    assert not linearize(built, _vector(kt=0.0, bt=0.0)).ticks[0].r.any()


def test_a_site_that_is_not_affine_is_linearized_at_its_start_values() -> None:
    kind = user("mean")
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)
    p, t = casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    cubic = casadi.vertcat(x[1], u[0] - x[0] ** 3, x[3], u[1])
    built = jacobians(replace(kind, derivative=casadi.Function("derivative", [x, u, p, t], [cubic])))
    parameters = _vector()
    parameters[NAMES.index("device.x.start")] = 2.0
    assert not built.affine
    assert linearize(built, parameters).a[1, 0] == -12.0
    assert linearize_exact(built, parameters).a[1, 0] == -12


@pytest.mark.parametrize(
    "force",
    [
        lambda x, t: casadi.sign(x),
        lambda x, t: casadi.floor(x / 0.001),
        lambda x, t: casadi.if_else(x > 0, 1.0, 0.0),
        lambda x, t: casadi.if_else(x == 0, 1.0, 0.0),
    ],
)
@pytest.mark.parametrize("where", ["moving", "ticking", "heard", "sent", "each other"])
def test_a_force_that_jumps_is_not_affine_though_its_slopes_are_the_same_everywhere(
    force: Callable[[Any, Any], Any], where: str
) -> None:
    assert jacobians(jumping(lambda x, t: 0 * x, where)).affine
    assert not jacobians(jumping(force, where)).affine


@pytest.mark.parametrize("where", ["moving", "ticking", "sent"])
def test_a_force_that_jumps_at_a_time_is_affine(where: str) -> None:
    assert jacobians(jumping(lambda x, t: casadi.if_else(t > 1, 1.0, 0.0), where)).affine


def jumping(force: Callable[[Any, Any], Any], where: str) -> Kind:
    """Return the paper's user with a force added to what moves, is computed, heard or sent."""
    [kind] = edged(paper()).kinds if where == "each other" else [user("mean")]
    [partition], [sending] = kind.clocks, kind.sends
    if where == "moving":
        x, u, p, t = (casadi.SX.sym("a", *kind.derivative.size_in(i)) for i in range(4))
        changed = kind.derivative(x, u, p, t) + casadi.vertcat(0, force(x[0], t), 0, 0)
        return replace(kind, derivative=casadi.Function("derivative", [x, u, p, t], [changed]))
    if where == "sent":
        x, u, p, t = (casadi.SX.sym("a", *sending.send.size_in(i)) for i in range(4))
        send = casadi.Function("send", [x, u, p, t], [sending.send(x, u, p, t) + force(x[0], t)])
        return replace(kind, sends=(replace(sending, send=send),))
    if where == "each other":
        [receive] = partition.receives
        assert receive.edge is not None
        x, u, m, s, p, t = (casadi.SX.sym("a", *receive.edge.size_in(i)) for i in range(6))
        edge = casadi.Function("edge", [x, u, m, s, p, t], [receive.edge(x, u, m, s, p, t) + force(s[0], t)])
        return replace(kind, clocks=(replace(partition, receives=(replace(receive, edge=edge),)),))
    x, u, m, r, p, t = (casadi.SX.sym("a", *partition.tick.size_in(i)) for i in range(6))
    outputs = partition.tick(x, u, m, r, p, t) + force(r[0] if where == "heard" else x[0], t)
    tick = casadi.Function("tick", [x, u, m, r, p, t], [outputs])
    return replace(kind, clocks=(replace(partition, tick=tick),))
