"""Claims about `apc.frame.liveness`."""

from __future__ import annotations

from dataclasses import replace

import casadi
import pytest

from apc.compiler.errors import ApcError
from apc.frame.exchange import build_exchange
from apc.frame.jacobians import jacobians
from apc.frame.liveness import hearing_of, live_holds, live_outputs, live_receives
from apc.frame.parameters import resolve
from apc.frame.schedule import Way
from apc.frame.site import LinearSite
from tests.scheduled import schedules
from tests.sites import MS, NAMES, edged, grouped, linked, paper, user


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


def test_a_group_hears_each_class_of_senders_as_late_as_it_is() -> None:
    base = grouped(paper(), ("left", 2, {}), ("right", 1, {}), ("far", 1, {}))
    system = linked(base, delays={("left", "right"): 16 * MS})
    left, right, far = schedules(system)
    assert left is far
    assert {one.lag for one in left.heard} == {1}
    assert {(one.way.delay, one.lag) for one in right.heard} == {
        ("lan.delay left right", 2),
        ("lan.delay", 1),
    }
    # Everyone keeps as many packets as anyone asks for.
    assert left.depths == right.depths == (2, 2)


def test_a_receive_over_an_edge_function_hears_each_channel_on_a_way_of_its_own() -> None:
    system = edged(paper(peers=3))
    pattern = jacobians(system.kinds[0]).pattern
    read = [live_receives(pattern, live_outputs(pattern))]
    exchange = build_exchange(system, resolve(system).timings)
    [[heard]] = hearing_of(system, [pattern], exchange, 0, read)
    assert heard == tuple(
        (Way("sum", "lan", "lan.delay", "haptic: pull", channel), channel)
        for channel in ("coordination.x", "coordination.v")
    )


def test_a_mean_over_nobody_is_refused_and_a_sum_over_nobody_is_silent() -> None:
    with pytest.raises(ApcError, match="E801"):
        schedules(paper("mean", peers=1))
    [schedule] = schedules(paper("sum", peers=1))
    assert schedule.heard == ()


def test_who_does_not_send_is_on_no_way() -> None:
    base = grouped(paper("sum"), ("left", 1, {}), ("right", 1, {}))
    mute = replace(base.kinds[0], sends=())
    system = replace(
        base, kinds=(*base.kinds, mute), groups=(base.groups[0], replace(base.groups[1], kind=1))
    )
    left, right = schedules(system)
    assert left.heard == ()
    assert {one.way.delay for one in right.heard} == {"lan.delay"}
    assert right.sent == ()
