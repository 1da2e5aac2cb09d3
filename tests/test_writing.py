"""Claims about `apc.simulation.writing`."""

from __future__ import annotations

from fractions import Fraction
from typing import Any

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.frame.parameters import resolve
from apc.simulation.program import Program
from apc.simulation.propagate import rates, transitions
from apc.simulation.signals import local_signals
from apc.simulation.writing import build_program
from tests.scheduled import schedules
from tests.sites import MS, paper


def _program(cuts: tuple[int, ...] = (), **values: Any) -> tuple[Program, np.ndarray]:
    """Return the paper's program and its site's constants."""
    system = paper(**values)
    [schedule] = schedules(system)
    kind = system.kinds[0]
    program = build_program(rates(kind), schedule, local_signals(kind, schedule), cuts)
    parameters = resolve(system).parameters[0][0]
    durations = [length * schedule.quantum for length in program.durations]
    return program, program.constants(parameters, transitions(program.rates, parameters, durations))


def _played(
    program: Program, constants: np.ndarray, carry: np.ndarray, heard: dict[int, float]
) -> np.ndarray:
    """Return the carry after one frame, segment by segment."""
    for segment in program.segments:
        inputs = [heard[row] for row in segment.heard]
        carry = np.asarray(segment.kernel(carry, inputs, constants, [], 0.0)[0]).ravel()
    return carry


@pytest.mark.parametrize(
    "values",
    [
        {},
        {"comp": Fraction(0)},
        {"comp": MS * 2 / 5},
        {"comp": 3 * MS, "comm": 24 * MS},
        {"haptic_phase": MS / 2},
    ],
)
def test_a_frame_of_a_linear_site_is_its_lifted_map(values: dict[str, Any]) -> None:
    program, constants = _program(**values)
    [group], _ = lifted_groups(paper(**values))
    random = np.random.default_rng(3)
    layout, schedule = program.layout, program.schedule
    start = {
        name: float(value)
        for name, value in zip(group.lifted.z_names, random.standard_normal(99), strict=False)
    }
    x = [start[state.name] for state in program.kind.states]
    carry = program.start(x, [[]])[0]
    first = layout.states + len(layout.outputs)
    for place, value in enumerate(layout.later):
        if value in schedule.carried:  # else it acts for no time at all
            carry[first + place] = start[schedule.value_names[schedule.carried.index(value)]]
    heard = dict(enumerate(random.standard_normal(len(schedule.heard)).tolist()))
    after = _played(program, constants, carry, heard)
    z = np.array([start[name] for name in group.lifted.z_names])
    expected = group.lifted.p @ z + group.lifted.q @ np.array([heard[row] for row in range(len(heard))])
    np.testing.assert_allclose(after[:4], expected[:4], rtol=1e-11, atol=1e-12)


def test_cut_into_segments_a_frame_is_the_same() -> None:
    whole, constants = _program(comm=Fraction(0))
    cut, _ = _program((0,), comm=Fraction(0))
    assert (len(whole.segments), len(cut.segments)) == (1, 2)
    carry = whole.start([0.01, 0.0, 0.02, 0.0], [[]])[0]
    heard = dict.fromkeys(range(len(whole.schedule.heard)), 0.5)
    one, other = (_played(program, constants, carry, heard) for program in (whole, cut))
    assert one.tolist() == other.tolist()


def test_a_row_is_recorded_at_every_mark_with_the_values_before_the_tick() -> None:
    program, constants = _program(comp=Fraction(0))
    carry = program.start([0.01, 0.0, 0.0, 0.0], [[]])[0]
    [segment] = program.segments
    rows = np.asarray(segment.kernel(carry, [0.0] * len(segment.heard), constants, [], 0.0)[2])
    table = rows.reshape(len(program.schedule.marks) - 1, len(program.recorded))
    names = [one.name for one in program.recorded]
    assert table[0, names.index("contact.f")] == 0.0  # nothing was computed before the first tick
    assert table[1, names.index("contact.f")] == pytest.approx(1000 * 0.01)
