"""`guards`: what changes sign where an equation is not smooth."""

from __future__ import annotations

import casadi

from apc.frame.guards import guards_of

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
