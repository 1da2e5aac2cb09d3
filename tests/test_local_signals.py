"""Claims about `apc.simulation.signals`."""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction
from typing import Any

import casadi

from apc.compiler.compiled import Kind
from apc.simulation.signals import local_signals, sent_states, ticking_partitions
from tests.scheduled import schedules
from tests.sites import MS, paper


def _listed(**values: Fraction) -> list[tuple[str, str, str]]:
    system = paper(**values)
    [schedule] = schedules(system)
    assert ticking_partitions(schedule) == [0]
    return [(one.name, one.unit, one.role) for one in local_signals(system.kinds[0], schedule)]


STATES = [("device.x", "m"), ("device.v", "m/s"), ("cube.x", "m"), ("cube.v", "m/s")]
FORCES = ["contact.f", "coordination.f"]


def test_a_force_that_acts_as_soon_as_it_is_computed_is_one_signal() -> None:
    assert _listed(comp=Fraction(0)) == [
        *((name, unit, "state") for name, unit in STATES),
        *((name, "N", "output") for name in FORCES),
    ]


def test_a_force_that_acts_later_is_two_signals_though_later_be_the_next_tick() -> None:
    for delay in (MS / 2, MS, 3 * MS):
        late = [(f"{name} acting", "N", "hold") for name in FORCES]
        assert _listed(comp=delay)[4:] == [*((name, "N", "output") for name in FORCES), *late]


def test_a_state_that_is_sent_as_it_is_is_told_once_and_a_multiple_of_one_is_not() -> None:
    [kind] = paper().kinds
    [sending] = kind.sends
    inputs = sending.send.sx_in()
    x = inputs[0]
    assert [kind.states[place].name for place in sent_states(kind)] == ["cube.x", "cube.v"]

    def sends(*channels: Any) -> Kind:
        function = casadi.Function("send", inputs, [casadi.vertcat(*channels)])
        return replace(kind, sends=(replace(sending, send=function),))

    assert sent_states(sends(2 * x[0], x[3], x[1], x[3])) == (3, 1)
    assert sent_states(sends(2 * x[0])) == ()
