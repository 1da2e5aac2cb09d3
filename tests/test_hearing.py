"""Claims about `apc.frame.hearing`."""

from __future__ import annotations

from dataclasses import replace

import pytest

from apc.compiler.errors import ApcError
from apc.frame.exchange import build_exchange
from apc.frame.hearing import hearing_of
from apc.frame.jacobians import jacobians
from apc.frame.liveness import live_outputs, live_receives
from apc.frame.parameters import resolve
from apc.frame.schedule import Way
from tests.scheduled import schedules
from tests.sites import MS, edged, grouped, linked, paper


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
