"""Claims about `apc.simulation.program`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np

from apc.frame.parameters import resolve
from apc.frame.schedule import Value
from apc.simulation.program import Layout, seconds_at
from apc.simulation.propagate import rates, transitions
from apc.simulation.writing import build_program
from tests.scheduled import schedules
from tests.sites import MS, alone, paper


def test_the_carry_is_states_then_outputs_then_what_acts_later_then_work() -> None:
    layout = Layout(4, ((0, 0), (0, 1)), (Value(0, 0, -1),), ("contact", "coordination"))
    assert layout.size == 9
    assert layout.work == slice(7, 9)


def test_at_time_0_nothing_is_computed_and_memories_hold_their_start_values() -> None:
    system = alone(lambda x, u: u, lambda x, u, m: m, memories=(0,))
    [schedule] = schedules(system)
    program = build_program(rates(system.kinds[0]), schedule, (), ())
    # x, the output as remembered, and what its hold puts out until the first tick.
    assert program.start([2.5], [[7.0]]).tolist() == [[2.5, 7.0, 0.0]]


def test_a_sites_constants_are_its_parameters_and_what_each_duration_does() -> None:
    system = paper(comp=MS * 2 / 5)
    [schedule] = schedules(system)
    program = build_program(rates(system.kinds[0]), schedule, (), ())
    parameters = resolve(system).parameters[0][0]
    durations = [length * schedule.quantum for length in program.durations]
    found = program.constants(parameters, transitions(program.rates, parameters, durations))
    of_step = int(program.rates.e.sum() + program.rates.f.sum() + program.rates.g.sum())
    assert durations == [MS * 2 / 5, MS * 3 / 5]
    assert len(found) == len(parameters) + 2 * of_step
    np.testing.assert_array_equal(found[: len(parameters)], parameters)


def test_time_is_counted_and_rounded_once() -> None:
    [schedule] = schedules(paper(haptic=Fraction(1, 90), network=Fraction(1, 60)))
    for frame in (0, 1, 10**9 + 7):
        exact = (frame * schedule.frame + 3) * schedule.quantum
        assert seconds_at(schedule, frame, 3) == float(exact)
