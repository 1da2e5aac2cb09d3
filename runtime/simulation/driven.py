"""The last instant at which the equations of a simulation change with time alone.

Takes: a `Simulation`. Gives: `driven_until`.
Guarantees: equal simulations have the same instant. A change that is shorter than a `GRID`-th of the duration
may be missed, unless the time at which it begins or ends is written in a continuous equation.
Does not: determine the forces that change.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PeerType
from apc.simulation.simulation import Simulation

Floats = NDArray[np.float64]

GRID = 1024  # instants at which equations are evaluated
MOST_SUBSYSTEMS = 16  # different parameter vectors of a group that are evaluated
STATES = (0.005, 0.01)  # range of the random states, in SI
CHANGED = 1e-12  # relative difference above which a value counts as changed


def driven_until(simulation: Simulation) -> float:
    """Return the last instant in s at which an equation changes with time alone, 0 if no equation does."""
    end = float(simulation.settings.duration)
    until = 0.0
    functions: dict[PeerType, list[Any]] = {}
    for member, forces in zip(simulation.population.members, simulation.forces, strict=True):
        peer_type = simulation.topology.peer_types[simulation.topology.groups[member.group].peer_type]
        if peer_type not in functions:
            functions[peer_type] = [
                function for function in _functions(peer_type) if _depends_on_time(function)
            ]
        breaks = [force.breaks[(force.breaks > 0) & (force.breaks < end)] for force in forces]
        instants = np.unique(np.concatenate([np.linspace(0, end, GRID + 1), *breaks]))
        for function in functions[peer_type]:
            for parameters in member.parameters[:MOST_SUBSYSTEMS]:
                until = max(until, _last_change(function, parameters, instants))
    return until


def _functions(peer_type: PeerType) -> Iterator[Any]:
    """Yield the functions of a peer type whose last arguments are the parameters p and the time t."""
    yield peer_type.derivative
    for clock in peer_type.clocks:
        yield clock.tick
        yield from (receive.edge for receive in clock.receives if receive.edge is not None)
    yield from (send.send for send in peer_type.sends)


def _depends_on_time(function: Any) -> bool:
    """Return whether some output of a function depends on its last argument, the time."""
    return any(function.jac_sparsity(out, function.n_in() - 1).nnz() for out in range(function.n_out()))


def _last_change(function: Any, parameters: Floats, instants: Floats) -> float:
    """Return the last instant at which a function's value differs from that at the instant before, 0
    if none; the last of all if Newton's method solves an equation of the function.

    At arbitrary states such an equation may have no solution, and CasADi prints each failure.
    """
    if function.find_functions(0):
        return float(instants[-1])
    generator, time_index = np.random.default_rng(0), function.n_in() - 1
    arguments = [casadi.DM(generator.uniform(*STATES, function.size_in(i))) for i in range(time_index - 1)]
    arguments += [casadi.DM(parameters), casadi.DM(instants).T]
    inputs = [casadi.repmat(argument, 1, len(instants)) for argument in arguments[:-1]]
    rows = [
        np.asarray(out, np.float64) for out in _outputs(function.map(len(instants))(*inputs, arguments[-1]))
    ]
    values = np.concatenate([row.reshape(-1, len(instants), order="F") for row in rows])
    magnitude = np.abs(np.nan_to_num(values)).max(axis=1, initial=0.0)[:, None]
    with np.errstate(invalid="ignore"):
        changed = (np.abs(np.diff(values, axis=1)) > CHANGED * magnitude).any(axis=0)
    return float(instants[1:][changed].max(initial=0.0))


def _outputs(result: Any) -> tuple[Any, ...]:
    """Return the outputs of a CasADi function as a tuple, also if it has a single output."""
    return result if isinstance(result, tuple) else (result,)
