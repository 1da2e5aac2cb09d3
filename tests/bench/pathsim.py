"""The three-user scene in PathSim's simulator.

PathSim (pathsim.readthedocs.io, `pip install pathsim`) is given the scene as blocks: one linear plant of 12
states, a function of the forces, sample-and-holds. It runs what happens at one instant in the order in which
the blocks are listed, each seeing what those before it did; the hold that lets a force act is listed before
the one that computes it, so that it takes the force of the tick before. A packet is handed on half a
millisecond before it is due, as in Drake.
"""

from __future__ import annotations

from functools import partial

import numpy as np
from numpy.typing import NDArray

from apc.benchmark.timing import timed
from tests.bench.drake import matrices
from tests.bench.paper_scene import FRAME, START, TICK


def played_by_pathsim(seconds: float, tolerance: float | None) -> tuple[NDArray[np.float64], float]:
    """Return the states at every tick (ticks, 12) and the seconds that the run took."""
    from pathsim import Connection, Simulation
    from pathsim.blocks import Function, SampleHold, Scope, StateSpace
    from pathsim.solvers import RKDP54

    a, b, own, others = matrices()
    start = np.zeros(12)
    start[0] = START
    plant = StateSpace(a, b, np.eye(12), np.zeros((12, 6)), initial_value=start)
    forces = Function(lambda *heard: own @ np.array(heard[:12]) + others @ np.array(heard[12:]))
    computed, acting = SampleHold(TICK), SampleHold(TICK)
    taken, due = SampleHold(FRAME), SampleHold(FRAME, FRAME - TICK / 2)
    scope = Scope(sampling_period=TICK)
    wires = [
        Connection(plant[:12], forces[:12], scope[:12]),
        *(Connection(plant[4 * user + 2], taken[user]) for user in range(3)),
        Connection(taken[:3], due[:3]),
        Connection(due[:3], forces[12:15]),
        Connection(forces[:6], computed[:6]),
        Connection(computed[:6], acting[:6]),
        Connection(acting[:6], plant[:6]),
    ]
    blocks = [plant, forces, scope, acting, due, computed, taken]
    asked = {} if tolerance is None else {"tolerance_lte_abs": tolerance, "tolerance_lte_rel": tolerance}
    simulation = Simulation(blocks, wires, dt=TICK / 2, Solver=RKDP54, log=False, **asked)
    taken_s, _ = timed(partial(simulation.run, seconds + TICK / 4))  # past the last tick, however rounded
    _, rows = scope.read()
    return np.asarray(rows).T[: round(seconds / TICK) + 1], taken_s
