"""Claims about `apc.frame.scheduling`: section by section, what an instant means."""

from __future__ import annotations

import itertools
from fractions import Fraction
from typing import Any

import pytest

from apc.frame.schedule import ORDER, Act, Heard, Propagate, Schedule, Send, Tick, Value
from tests.scheduled import schedules
from tests.sites import MS, paper


def _schedule(order: tuple[str, ...] = ORDER, **values: Any) -> Schedule:
    [schedule] = schedules(paper(**values), order)
    return schedule


def _lags(schedule: Schedule, tick: Tick) -> set[int]:
    return {schedule.heard[row].lag for rows in tick.heard for row in rows}


def _kinds(schedule: Schedule) -> list[str]:
    return [type(event).__name__ for event in schedule.events]


def test_an_instant_sends_then_computes_then_acts() -> None:
    schedule = _schedule(comp=Fraction(0), comm=Fraction(0))
    assert _kinds(schedule)[:5] == ["Send", "Tick", "Act", "Act", "Propagate"]
    # A packet without delay is heard by the tick at its own instant, and by the rest of the frame.
    assert {one.lag for one in schedule.heard} == {0}
    # A force without delay acts at once.
    assert schedule.events[2] == Act(0, Value(0, 0, 0))


def test_a_tick_at_exactly_the_arrival_sees_the_packet() -> None:
    schedule = _schedule(comm=3 * MS)
    ticks = [event for event in schedule.events if isinstance(event, Tick)]
    lags = [_lags(schedule, tick) for tick in ticks]
    assert lags == [{1}, {1}, {1}, {0}, {0}, {0}, {0}, {0}]


@pytest.mark.parametrize(
    ("comp", "comm", "carried", "depths"),
    [
        (Fraction(0), Fraction(0), 0, (0, 0)),
        (MS, Fraction(0), 2, (0, 0)),
        (MS, 8 * MS, 2, (1, 1)),
        (MS * 2 / 5, 8 * MS, 2, (1, 1)),
        (MS * 5 / 2, 8 * MS, 6, (1, 1)),
        (3 * MS, 24 * MS, 6, (3, 3)),
        (MS, 11 * MS, 2, (2, 2)),
        (MS, 4 * MS, 2, (1, 1)),
        (10 * MS, 8 * MS, 20, (1, 1)),
    ],
)
def test_the_state_is_what_is_demanded_and_no_more(
    comp: Fraction, comm: Fraction, carried: int, depths: tuple[int, ...]
) -> None:
    schedule = _schedule(comp=comp, comm=comm)
    assert len(schedule.carried) == carried
    assert schedule.depths == depths


def test_only_the_delayed_part_of_a_force_is_remembered() -> None:
    schedule = _schedule(own_delay=True)
    assert schedule.value_names == ("contact.f(-1 ms)", "coordination.own(-1 ms)")


def test_a_delay_inside_an_interval_splits_it() -> None:
    schedule = _schedule(comp=MS * 2 / 5)
    durations = [
        event.duration * schedule.quantum for event in schedule.events if isinstance(event, Propagate)
    ]
    assert durations == [MS * 2 / 5, MS * 3 / 5] * 8


def test_time_adds_up_to_the_frame_exactly() -> None:
    for comp, comm, phase in itertools.product((0, 400, 2500), (0, 4000, 11000), (0, 300)):
        schedule = _schedule(
            comp=Fraction(comp, 10**6), comm=Fraction(comm, 10**6), haptic_phase=Fraction(phase, 10**6)
        )
        durations = (event.duration for event in schedule.events if isinstance(event, Propagate))
        assert sum(durations) == schedule.frame


def test_a_phase_delays_the_ticks_and_keeps_the_value_acting_before() -> None:
    schedule = _schedule(comp=Fraction(0), comm=Fraction(0), haptic_phase=MS / 2)
    assert _kinds(schedule)[:3] == ["Send", "Propagate", "Tick"]
    assert schedule.acting == (Value(0, 0, -1), Value(0, 1, -1))
    assert schedule.value_names == ("contact.f(-0.5 ms)", "coordination.f(-0.5 ms)")


def test_two_packets_a_frame_are_two_slots() -> None:
    schedule = _schedule(haptic=2 * MS, network=MS, comm=Fraction(0))
    assert [event for event in schedule.events if isinstance(event, Send)] != []
    # The tick at the frame's start sees slot 0; nobody hears slot 1, so nobody sends it.
    assert {one.sent.slot for one in schedule.heard} == {0}
    late = _schedule(haptic=2 * MS, network=MS, comm=MS / 2)
    assert {(one.sent.slot, one.lag) for one in late.heard} == {(1, 1)}


def test_another_order_of_coincident_events_changes_what_a_tie_means() -> None:
    stale_packet = _schedule(("send", "tick", "deliver", "act"), comm=3 * MS)
    ticks = [event for event in stale_packet.events if isinstance(event, Tick)]
    assert [_lags(stale_packet, tick) for tick in ticks][3] == {1}
    stale_force = _schedule(("send", "deliver", "act", "tick"), comp=Fraction(0))
    assert len(stale_force.carried) == 2
    early = _schedule(("deliver", "send", "tick", "act"), comm=Fraction(0))
    assert {one.lag for one in early.heard} == {1}


def test_every_order_keeps_packets_causal() -> None:
    for order in itertools.permutations(ORDER):
        schedule = _schedule(order, comp=Fraction(0), comm=Fraction(0))
        sent_at: set[int] = set()
        for event in schedule.events:
            if isinstance(event, Send):
                sent_at |= {row for _, row in event.rows}
            if isinstance(event, Tick):
                for place in (row for rows in event.heard for row in rows):
                    one: Heard = schedule.heard[place]
                    assert one.lag > 0 or schedule.sent.index(one.sent) in sent_at
