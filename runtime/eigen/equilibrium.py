"""Test of the equilibrium at the start of a model that is linearized there.

Takes: groups of peers with their receptions at the start.
Gives: `equilibrium_residual`.
Guarantees: rounding errors of balanced forces are not reported.
Does not: find an equilibrium, or simulate (see `simulation`).

At an equilibrium the forces computed at the start values are balanced: der(x) is 0. Outputs of holds have the
values of the first tick, which act after its delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.wording import with_unit
from apc.eigen.peer_classes import PeerClass
from apc.frame.linearize import start_values

# The tolerance of a balanced rate, relative to its terms.
ROUNDED = 1e-12

FORCES = ("N", "N*m")


def equilibrium_residual(groups: Sequence[PeerClass]) -> str:
    """Return the largest unbalanced force at the start, as text, "" at an equilibrium.

    Without such a force it is the largest torque, and else a rate that is not 0.

    Parameters
    ----------
    groups
        All peers of the topology; a group that is linear on its side of a kink is left out.
    """
    started = [group for group in groups if group.initial_reception is not None]
    result = [value for group in started for value in _moved(group, named=len(groups) > 1)]
    for unit in FORCES:
        pushed = [(size, subject) for size, of, subject in result if of == unit]
        if pushed:
            size, subject = max(pushed, key=lambda pair: pair[0])
            return f"the start is not at rest: {size:.4g} {unit} acts on {subject}"
    for size, unit, subject in result:
        return f"the start is not at rest: {subject} changes by {with_unit(f'{size:.4g}', unit)} in a second"
    return ""


def _moved(group: PeerClass, *, named: bool) -> list[tuple[float, str, str]]:
    """Return the unbalanced quantity: the force and its part, or the rate of a state.

    The force is that of a hold that changes the state as fast.
    """
    assert group.initial_reception is not None, "linearized where it starts"
    peer_type, subsystem, p = (
        group.jacobians.peer_type,
        group.subsystem,
        [float(value) for value in group.parameters],
    )
    x, u, m = start_values(group.jacobians, p)
    received = iter([float(value) for value in group.initial_reception.values])
    held, size = np.zeros(len(u)), np.zeros(len(u))  # outputs of holds, and their terms
    units = [""] * len(u)
    for clock, slopes, memories in zip(peer_type.clocks, subsystem.ticks, m, strict=True):
        r = [next(received) for _ in clock.receives]
        start = len(clock.outputs) * clock.variants[0] if clock.variants else 0
        first = slice(start, start + len(clock.outputs))
        computed = _column(clock.tick(x, u, memories, r, p, 0.0))[first]
        added = np.abs(computed)
        for matrix, of in ((slopes.x, x), (slopes.m, memories), (slopes.r, r)):
            added += np.abs(matrix[first]) @ np.abs(np.array(of, dtype=np.float64))
        for index, hold in enumerate(peer_type.holds):
            if hold.clock == clock.clock:
                held[index], size[index] = computed[hold.output], added[hold.output]
                units[index] = clock.units[hold.output]
    rates = _column(peer_type.derivative(x, held, p, 0.0))
    added = np.abs(_column(peer_type.derivative(x, u, p, 0.0))) + np.abs(subsystem.b) @ size
    added += np.abs(subsystem.a) @ np.abs(np.array(x, dtype=np.float64))
    prefix = f"{group.name}." if named else ""
    result = []
    for index in np.flatnonzero(np.abs(rates) > ROUNDED * added).tolist():
        name, rate = prefix + peer_type.states[index].name, abs(float(rates[index]))
        inverse, unit = max(
            (
                (abs(float(item)), unit)
                for item, unit in zip(subsystem.b[index], units, strict=True)
                if unit in FORCES
            ),
            default=(0.0, ""),
        )
        if inverse:
            result.append((rate / inverse, unit, name.rpartition(".")[0]))
        else:
            result.append((rate, peer_type.states[index].unit, name))
    return result


def _column(result: Any) -> NDArray[np.float64]:
    return np.asarray(result, dtype=np.float64).ravel()
