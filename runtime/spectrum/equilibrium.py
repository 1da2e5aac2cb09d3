"""Test of the equilibrium at the start of a model that is linearized there.

Takes: peer classes with their receptions at the start.
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
from apc.linearization.linearize import start_values
from apc.spectrum.peer_classes import PeerClass

# The tolerance of a balanced rate, relative to its terms.
ROUNDED = 1e-12

FORCES = ("N", "N*m")


def equilibrium_residual(peer_classes: Sequence[PeerClass]) -> str:
    """Return the largest unbalanced force at the start, as a text; "" at an equilibrium.

    Without an unbalanced force the text names the largest torque, and else a rate that is not 0.

    Parameters
    ----------
    peer_classes
        All peers of the topology; a class that is linear on its side of a kink is left out.
    """
    linearized_classes = [
        peer_class for peer_class in peer_classes if peer_class.initial_reception is not None
    ]
    quantities = [
        quantity
        for peer_class in linearized_classes
        for quantity in _unbalanced_quantities(peer_class, named=len(peer_classes) > 1)
    ]
    for unit in FORCES:
        candidates = [
            (magnitude, subject) for magnitude, quantity_unit, subject in quantities if quantity_unit == unit
        ]
        if candidates:
            magnitude, subject = max(candidates, key=lambda pair: pair[0])
            return f"the initial state is not at rest: {magnitude:.4g} {unit} acts on {subject}"
    for magnitude, unit, subject in quantities:
        rate = with_unit(f"{magnitude:.4g}", unit)
        return f"the initial state is not at rest: {subject} changes by {rate} per second"
    return ""


def _unbalanced_quantities(peer_class: PeerClass, *, named: bool) -> list[tuple[float, str, str]]:
    """Return the unbalanced quantities of a class at the start: magnitude, unit, and part or state.

    A quantity is a force on a part: the output of a hold that changes the state at the same rate. Without
    such a hold it is the rate of the state. `named` states that names begin with that of the class.
    """
    assert peer_class.initial_reception is not None, "linearized where it starts"
    peer_type, subsystem, p = (
        peer_class.jacobians.peer_type,
        peer_class.subsystem,
        [float(value) for value in peer_class.parameters],
    )
    x, u, m = start_values(peer_class.jacobians, p)
    received = iter([float(value) for value in peer_class.initial_reception.values])
    hold_outputs, hold_sizes = np.zeros(len(u)), np.zeros(len(u))  # outputs of holds, and their terms
    units = [""] * len(u)
    for clock, slopes, memories in zip(peer_type.clocks, subsystem.ticks, m, strict=True):
        r = [next(received) for _ in clock.receives]
        start = len(clock.outputs) * clock.variants[0] if clock.variants else 0
        rows = slice(start, start + len(clock.outputs))
        computed = _column(clock.tick(x, u, memories, r, p, 0.0))[rows]
        term_sizes = np.abs(computed)
        for matrix, vector in ((slopes.x, x), (slopes.m, memories), (slopes.r, r)):
            term_sizes += np.abs(matrix[rows]) @ np.abs(np.array(vector, dtype=np.float64))
        for index, hold in enumerate(peer_type.holds):
            if hold.clock == clock.clock:
                hold_outputs[index], hold_sizes[index] = computed[hold.output], term_sizes[hold.output]
                units[index] = clock.units[hold.output]
    rates = _column(peer_type.derivative(x, hold_outputs, p, 0.0))
    term_sizes = np.abs(_column(peer_type.derivative(x, u, p, 0.0))) + np.abs(subsystem.b) @ hold_sizes
    term_sizes += np.abs(subsystem.a) @ np.abs(np.array(x, dtype=np.float64))
    prefix = f"{peer_class.name}." if named else ""
    result = []
    for index in np.flatnonzero(np.abs(rates) > ROUNDED * term_sizes).tolist():
        name, rate = prefix + peer_type.states[index].name, abs(float(rates[index]))
        inverse, unit = max(
            (
                (abs(float(gain)), hold_unit)
                for gain, hold_unit in zip(subsystem.b[index], units, strict=True)
                if hold_unit in FORCES
            ),
            default=(0.0, ""),
        )
        if inverse:
            result.append((rate / inverse, unit, name.rpartition(".")[0]))
        else:
            result.append((rate, peer_type.states[index].unit, name))
    return result


def _column(result: Any) -> NDArray[np.float64]:
    """Return a CasADi matrix as a row of floats."""
    return np.asarray(result, dtype=np.float64).ravel()
