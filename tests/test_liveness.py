"""Claims about `apc.frame.liveness`."""

from __future__ import annotations

from dataclasses import replace

import casadi

from apc.frame.jacobians import jacobians
from apc.frame.liveness import live_holds, live_outputs, live_receives
from apc.frame.site import LinearSite
from tests.sites import NAMES, user


def _pattern(*, coordination: bool = True, sends: bool = True) -> LinearSite:
    """Return the paper's user; perhaps its coordination force moves nothing, perhaps it sends nothing."""
    kind = user("mean")
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)
    p, t = casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    if not coordination:
        unmoved = kind.derivative(x, casadi.vertcat(u[0], 0), p, t)
        kind = replace(
            kind, derivative=casadi.Function("derivative", [x, u, p, t], [casadi.simplify(unmoved)])
        )
    return jacobians(kind if sends else replace(kind, sends=())).pattern


def test_all_of_the_papers_user_is_live() -> None:
    pattern = _pattern()
    live = live_outputs(pattern)
    assert live == {(0, 0), (0, 1)}
    assert live_holds(pattern, live) == (True, True)
    assert live_receives(pattern, live) == {(0, 0), (0, 1)}


def test_a_force_that_moves_nothing_is_dead_and_what_only_it_hears_is_not_heard() -> None:
    pattern = _pattern(coordination=False)
    live = live_outputs(pattern)
    assert live == {(0, 0)}
    assert live_holds(pattern, live) == (True, False)
    assert live_receives(pattern, live) == frozenset()


def test_a_force_that_is_only_sent_is_live() -> None:
    kind = user("mean")
    x, u = casadi.SX.sym("x", 4), casadi.SX.sym("u", 2)
    p, t = casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    [sending] = kind.sends
    still = casadi.Function("derivative", [x, u, p, t], [casadi.vertcat(x[1], 0, x[3], 0)])
    loud = replace(sending, send=casadi.Function("send", [x, u, p, t], [casadi.vertcat(x[2], u[1])]))
    pattern = jacobians(replace(kind, derivative=still, sends=(loud,))).pattern
    assert live_outputs(pattern) == {(0, 1)}


def test_a_memory_keeps_alive_what_it_remembers() -> None:
    kind = user("mean")
    [clock] = kind.clocks
    x, u, m, r = (casadi.SX.sym(name, size) for name, size in (("x", 4), ("u", 2), ("m", 1), ("r", 2)))
    p, t = casadi.SX.sym("p", len(NAMES)), casadi.SX.sym("t")
    # Output 1 acts and reads what output 2 was at the tick before; nothing else reads output 2.
    outputs = casadi.vertcat(x[0], m[0], r[0])
    tick = casadi.Function("tick", [x, u, m, r, p, t], [outputs])
    clock = replace(
        clock,
        outputs=("a", "b", "c"),
        units=("N",) * 3,
        memories=(2,),
        starts=("zero",),
        tick=tick,
    )
    pattern = jacobians(replace(kind, clocks=(clock,))).pattern
    live = live_outputs(pattern)
    assert live == {(0, 0), (0, 1), (0, 2)}
    assert live_receives(pattern, live) == {(0, 0)}
