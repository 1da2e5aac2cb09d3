"""Whether a scene that is linearized where it starts is at rest there.

Takes: groups of peers, which know what they hear at the start.
Gives: `unrest`.
Guarantees: nothing is said of what rounding leaves of forces that balance.
Does not: find a place of rest, or play what happens (see `simulation`).

At rest the forces that are computed from where all stand at the start balance every other: der(x) is 0. Held
values are taken as those of the first tick, which acts after its delay.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.compiler.words import with_unit
from apc.eigen.peers import PeerClass
from apc.frame.linearize import start_values

# Of the size of what adds up to a rate, what may be left of it where all of it balances.
ROUNDED = 1e-12

FORCES = ("N", "N*m")


def unrest(groups: Sequence[PeerClass]) -> str:
    """Say what is not at rest at the start: the largest force that nothing balances, "" where all balances.

    Without one it is the largest torque, and else a rate that is not 0.

    Parameters
    ----------
    groups
        All peers of the topology; a group that is linear on its side of a kink is left out.
    """
    started = [group for group in groups if group.listening is not None]
    result = [value for group in started for value in _moved(group, named=len(groups) > 1)]
    for unit in FORCES:
        pushed = [(size, what) for size, of, what in result if of == unit]
        if pushed:
            size, what = max(pushed, key=lambda pair: pair[0])
            return f"the start is not at rest: {size:.4g} {unit} acts on {what}"
    for size, unit, what in result:
        return f"the start is not at rest: {what} changes by {with_unit(f'{size:.4g}', unit)} in a second"
    return ""


def _moved(group: PeerClass, *, named: bool) -> list[tuple[float, str, str]]:
    """Return what is not at rest: the force and its part, or by how much a state changes in a second.

    The force is that of a hold that changes the state as fast.
    """
    assert group.listening is not None, "linearized where it starts"
    kind, site, p = group.jacobians.kind, group.site, [float(value) for value in group.parameters]
    x, u, m = start_values(group.jacobians, p)
    heard = iter([float(value) for value in group.listening.values])
    held, size = np.zeros(len(u)), np.zeros(len(u))  # what holds put out, and what that is a sum of
    units = [""] * len(u)
    for clock, slopes, memories in zip(kind.clocks, site.ticks, m, strict=True):
        r = [next(heard) for _ in clock.receives]
        start = len(clock.outputs) * clock.variants[0] if clock.variants else 0
        first = slice(start, start + len(clock.outputs))
        computed = _column(clock.tick(x, u, memories, r, p, 0.0))[first]
        added = np.abs(computed)
        for matrix, of in ((slopes.x, x), (slopes.m, memories), (slopes.r, r)):
            added += np.abs(matrix[first]) @ np.abs(np.array(of, dtype=np.float64))
        for place, hold in enumerate(kind.holds):
            if hold.clock == clock.clock:
                held[place], size[place] = computed[hold.output], added[hold.output]
                units[place] = clock.units[hold.output]
    rates = _column(kind.derivative(x, held, p, 0.0))
    added = np.abs(_column(kind.derivative(x, u, p, 0.0))) + np.abs(site.b) @ size
    added += np.abs(site.a) @ np.abs(np.array(x, dtype=np.float64))
    prefix = f"{group.name}." if named else ""
    result = []
    for place in np.flatnonzero(np.abs(rates) > ROUNDED * added).tolist():
        name, rate = prefix + kind.states[place].name, abs(float(rates[place]))
        inverse, unit = max(
            (
                (abs(float(item)), unit)
                for item, unit in zip(site.b[place], units, strict=True)
                if unit in FORCES
            ),
            default=(0.0, ""),
        )
        if inverse:
            result.append((rate / inverse, unit, name.rpartition(".")[0]))
        else:
            result.append((rate, kind.states[place].unit, name))
    return result


def _column(result: Any) -> NDArray[np.float64]:
    return np.asarray(result, dtype=np.float64).ravel()
