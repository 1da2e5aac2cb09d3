"""Claims about `apc.simulation.population`."""

from __future__ import annotations

from fractions import Fraction

import numpy as np
import pytest

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import CompiledSystem
from apc.eigen.modes import dense
from apc.simulation.population import exchanges_within
from apc.simulation.settings import Settings
from apc.simulation.simulation import prepare
from tests.scheduled import schedules
from tests.sites import MS, columned, grouped, linked, paper


def test_peers_meet_within_a_frame_only_where_something_is_heard_in_the_frame_it_is_sent_in() -> None:
    assert exchanges_within(schedules(paper(comm=8 * MS))) == ()
    assert exchanges_within(schedules(paper(comm=3 * MS))) == (0,)
    assert exchanges_within(schedules(paper(comm=Fraction(0), network_phase=2 * MS))) == (2,)


def _frames(system: CompiledSystem, count: int) -> np.ndarray:
    """Return the continuous states of all peers after each frame, peer by peer."""
    player = prepare(system, Settings(Fraction(1), jit=False)).player()
    rows = []
    for number in range(count):
        player.play(number, 1, [None] * 2)
        rows.append(np.concatenate([one[:4].T.ravel() for one in player.carries]))
    return np.array(rows)


STARTS = [0.01, -0.02, 0.03, 0.0]


@pytest.mark.parametrize("operator", ["mean", "sum"])
@pytest.mark.parametrize("graph", ["complete", "ring", "star"])
@pytest.mark.parametrize("comm", [Fraction(0), 3 * MS, 8 * MS, 24 * MS])
def test_the_frame_of_all_peers_is_the_map_of_the_analysis(operator: str, graph: str, comm: Fraction) -> None:
    """Packets on their way hold the senders' start values; forces before the first tick are zero."""
    base = linked(paper(operator, peers=4, kt=200.0, bt=1.0, comm=comm), graph)
    system = columned(base, cube__x__start=STARTS, device__x__start=STARTS)
    closed = dense(*lifted_groups(system))
    state = np.zeros(len(closed.names))
    for place, name in enumerate(closed.names):
        peer = int(name[len("user[")]) - 1
        if ".device.x" in name or ".cube.x" in name or "coordination.x sent" in name:
            state[place] = STARTS[peer]
    found = _frames(system, 5)
    for row in found:
        state = closed.matrix @ state
        np.testing.assert_allclose(row, state[list(closed.motion)], rtol=0, atol=1e-14)


def test_members_of_several_groups_hear_each_other() -> None:
    groups = (("left", 2, {"cube.x.start": 0.02}), ("right", 1, {"device.mass": 0.2}))
    system = grouped(paper("sum", kt=150.0), *groups)
    closed = dense(*lifted_groups(system))
    state = np.array(
        [0.02 if "left" in n and ("cube.x" in n or "n.x sent" in n) else 0.0 for n in closed.names]
    )
    for row in _frames(system, 4):
        state = closed.matrix @ state
        np.testing.assert_allclose(row, state[list(closed.motion)], rtol=0, atol=1e-14)
