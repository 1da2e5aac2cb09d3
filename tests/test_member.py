"""Claims about `apc.simulation.program`."""

from __future__ import annotations

import numpy as np

from apc.frame.jacobians import jacobians
from apc.frame.parameters import resolve
from apc.simulation.program import build_member
from apc.simulation.propagate import rates, transition_rows
from apc.simulation.writing import build_program
from tests.scheduled import schedules
from tests.sites import columned, paper


def test_what_equal_peers_have_in_common_is_kept_once_and_given_to_each() -> None:
    system = columned(paper(peers=5), cube__x__start=[0.0, 0.02, 0.0, 0.03, 0.02])
    numbers, kind = resolve(system), system.kinds[0]
    [schedule] = schedules(system)
    program = build_program(rates(kind), schedule, (), ())
    durations = [length * schedule.quantum for length in program.durations]
    moves = transition_rows(program.rates, numbers.parameters[0], durations)
    peers = np.array([1, 3, 4])
    member = build_member(
        0, peers, jacobians(kind), numbers.rows[0][peers], numbers.parameters[0], program, moves
    )
    assert member.count == 3
    assert len(member.parameters) == len(member.constants) == 2
    cube = [state.name for state in kind.states].index("cube.x")
    assert member.each(member.carry)[:, cube].tolist() == [0.02, 0.03, 0.02]
    assert member.sends["lan"].tolist() == [[0.02, 0.0], [0.03, 0.0]]
