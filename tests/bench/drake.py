"""The three-user scene in Drake's simulator.

Drake (drake.mit.edu, `pip install drake`) is given the scene as a diagram of its own C++ systems: one linear
plant of 12 states, gains, delays and holds; nothing of it is Python while it runs. The forces' delay is a
DiscreteTimeDelay of one tick. A packet is taken by a hold at its network tick and handed on by a second one
half a millisecond before it is due: in Drake what is read at a coincident tick is what was before, so that a
hold that switched at the very tick would be read a tick late.
"""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.benchmark.timing import timed
from tests.bench.paper_scene import FRAME, K_C, K_T, START, TICK, USERS, user_plant


def matrices() -> tuple[NDArray[np.float64], ...]:
    """Return A (12, 12), B (12, 6), the forces' gain on the states (6, 12) and on what is heard (6, 3)."""
    one, push = user_plant()
    own = np.array([[K_C, 0, -K_C, 0], [0, 0, K_T, 0]])
    others = np.zeros((2 * USERS, USERS))
    others[1::2] = -K_T * (np.ones((USERS, USERS)) - np.eye(USERS)) / (USERS - 1)
    users = np.eye(USERS)
    return np.kron(users, one), np.kron(users, push), np.kron(users, own), others


def diagram() -> tuple[Any, Any, Any]:
    """Return the scene as a diagram, its plant and its log."""
    from pydrake.systems.framework import DiagramBuilder
    from pydrake.systems.primitives import (
        Adder,
        DiscreteTimeDelay,
        LinearSystem,
        LogVectorOutput,
        MatrixGain,
        ZeroOrderHold,
    )

    a, b, own, others = matrices()
    builder = DiagramBuilder()
    add, connect = builder.AddSystem, builder.Connect
    plant = add(LinearSystem(a, b, np.eye(12), np.zeros((12, 6))))
    of_states, of_heard, total = add(MatrixGain(own)), add(MatrixGain(others)), add(Adder(2, 6))
    delay = add(DiscreteTimeDelay(TICK, 1, 6))
    cubes = add(MatrixGain(np.kron(np.eye(USERS), [[0.0, 0, 1, 0]])))
    taken = add(ZeroOrderHold(period_sec=FRAME, vector_size=USERS))
    due = add(ZeroOrderHold(period_sec=FRAME, vector_size=USERS, offset_sec=FRAME - TICK / 2))
    connect(plant.get_output_port(), of_states.get_input_port())
    connect(plant.get_output_port(), cubes.get_input_port())
    connect(cubes.get_output_port(), taken.get_input_port())
    connect(taken.get_output_port(), due.get_input_port())
    connect(due.get_output_port(), of_heard.get_input_port())
    connect(of_states.get_output_port(), total.get_input_port(0))
    connect(of_heard.get_output_port(), total.get_input_port(1))
    connect(total.get_output_port(), delay.get_input_port())
    connect(delay.get_output_port(), plant.get_input_port())
    log = LogVectorOutput(plant.get_output_port(), builder, publish_period=TICK)
    return builder.Build(), plant, log


def played_by_drake(seconds: float, accuracy: float | None) -> tuple[NDArray[np.float64], float]:
    """Return the states at every tick (ticks, 12) and the seconds that the run took."""
    from pydrake.systems.analysis import Simulator

    built, plant, log = diagram()
    simulator = Simulator(built)
    context = simulator.get_mutable_context()
    start = np.zeros(12)
    start[0] = START
    plant.GetMyMutableContextFromRoot(context).SetContinuousState(start)
    if accuracy is not None:
        simulator.get_mutable_integrator().set_target_accuracy(accuracy)
    simulator.Initialize()
    taken, _ = timed(partial(simulator.AdvanceTo, seconds))
    return log.FindLog(context).data().T.copy(), taken
