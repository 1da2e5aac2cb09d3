"""Claims about `apc.frame.jacobians`."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import casadi
import numpy as np
import pytest

from apc.compiler.compiled import Kind
from apc.frame.jacobians import edge_name, guards_of, jacobians
from apc.frame.linearize import linearize
from apc.frame.parameters import resolve
from tests.sites import edged, paper, user

X, T = casadi.SX.sym("x"), casadi.SX.sym("t")


def values(expression: casadi.SX, moving: casadi.SX, x: float, t: float) -> list[float]:
    found = casadi.vertcat(*guards_of(expression, moving))
    return [float(one) for one in casadi.Function("guards", [X, T], [found])(x, t).nonzeros()]


def test_each_kind_of_decision_is_found_with_what_decides() -> None:
    assert values(casadi.fmax(0, X - 2), X, 5, 0) == [-3]
    assert values(casadi.if_else(X > 2, X, 0), X, 5, 0) == [-3]
    assert values(casadi.fabs(X - 2) + casadi.sign(X + 1), X, 5, 0) == [6, 3]
    assert values(casadi.fmin(X, 1) * casadi.sin(X), X, 5, 0) == [4]


def test_what_does_not_move_decides_nothing() -> None:
    expression = casadi.fmax(0, T) * X + casadi.fmax(X, 1)
    assert values(expression, X, 5, 7) == [4]
    assert values(expression, casadi.vertcat(X, T), 5, 7) == [4, -7]
    assert guards_of(casadi.exp(X), X) == []


def test_a_floor_decides_at_every_whole_number() -> None:
    low, high = (values(casadi.floor(X / 3), X, x, 0)[0] for x in (5.9, 6.1))
    assert low * high < 0


def test_a_pattern_is_structure_whatever_the_numbers() -> None:
    built = jacobians(user("mean"))
    assert built.pattern.ticks[0].r[1].all()
    assert not linearize(built, resolve(paper(kt=0.0, bt=0.0)).parameters[0][0]).ticks[0].r.any()


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


@pytest.mark.parametrize("operator", ["sum", "mean", "max", "min"])
def test_parameters_suffice_unless_a_receive_looks_at_each_sender_or_a_force_bends(operator: str) -> None:
    assert jacobians(user("sum")).parameters_suffice
    assert not jacobians(jumping(lambda x, t: x**2, "moving")).parameters_suffice
    [kind] = edged(paper(), operator).kinds
    assert not jacobians(kind).parameters_suffice
    assert jacobians(kind).affine == (operator in ("sum", "mean"))


def test_a_plain_sum_has_no_edge_and_a_maximum_has_one_though_no_function_is_given() -> None:
    [clock] = user("sum").clocks
    [position, _] = clock.receives
    assert edge_name(clock, position) == ""
    assert edge_name(clock, replace(position, operator="max")) == "haptic: coordination.others.x"


def test_an_edge_is_a_value_and_its_slopes() -> None:
    """For e = K (x_O − s_0) + B (v_O − s_1) + c (x_O − s_0)³, at x_O − s_0 = 0.5."""
    [kind] = edged(paper(), cubic=8.0).kinds
    edge = jacobians(kind).edges[0, 0]
    parameters = resolve(paper(kt=100.0, bt=3.0)).parameters[0][0]
    found = np.asarray(edge.function([0, 0, 0.75, 2], [0, 0], [], [0.25, 1], parameters, 0)).ravel()
    slope = 100 + 3 * 8 * 0.25
    assert found.tolist() == [50 + 3 + 1, 0, 0, slope, 3, 0, 0, -slope, -3]
    assert not edge.affine
