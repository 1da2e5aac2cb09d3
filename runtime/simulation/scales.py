"""How large the states of a kind are in a scene, for tolerances that mean the same in every unit.

Takes: a `CompiledSystem`, one of its kinds, the parameter vectors of its peers. Gives: `state_scales`.
Guarantees: positive numbers in SI; the same for all peers of a kind.
Does not: look at a motion.

A state's scale is the largest magnitude of the scene's numbers in its unit (start values, widths, places). A
state that is another's rate of change is moreover at least √(2 a L), the speed reached over that one's
scale L at its first rate of change a, and at least L a second.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import CompiledSystem, Kind
from apc.frame.jacobians import SiteJacobians
from apc.frame.start import start_values

Floats = NDArray[np.float64]

# Where the scene has no number in a state's unit: a thousandth of it, as the millimetres of a hand's work.
UNKNOWN = 1e-3


def integrals(rate: Any) -> tuple[tuple[int, int], ...]:
    """Return (i, j) where the rate of state i is state j itself, j before what builds on it.

    Parameters
    ----------
    rate
        (x, u, p, t) -> dx/dt, a CasADi function.
    """
    type_: Any = casadi.SX if rate.is_a("SXFunction") else casadi.MX
    arguments = [type_.sym(f"a{i}", rate.numel_in(i)) for i in range(4)]
    speed = rate(*arguments)
    blocks = [casadi.jacobian(speed, one) for one in arguments]
    rows, columns = blocks[0].sparsity().get_triplet()
    others = {row for block in blocks[1:] for row in block.sparsity().get_triplet()[0]}
    found = {i: j for i, j in zip(rows, columns, strict=True) if rows.count(i) == 1 and i not in others}
    found = {i: j for i, j in found.items() if blocks[0][i, j].is_constant() and float(blocks[0][i, j]) == 1}
    ordered: list[tuple[int, int]] = []
    while found:
        ready = [i for i, j in found.items() if j not in found]
        if not ready:  # states that are each other's rates: none comes first
            break
        ordered += [(i, found.pop(i)) for i in ready]
    return tuple(ordered)


def state_scales(
    system: CompiledSystem, kind: Kind, site: SiteJacobians, vectors: Sequence[Floats]
) -> Floats:
    """Return the scale of every state (n_x,), in SI.

    Parameters
    ----------
    system
        The compiled scene.
    kind
        One of its kinds.
    site
        Its Jacobians, which know where it starts.
    vectors
        The parameters of its different peers (n_p,).
    """
    units = {one.name: one.unit for one in system.parameters}
    units |= {one.name: one.unit for group in system.groups for one in group.values}
    largest: dict[str, float] = {}
    for place, name in enumerate(kind.parameters):
        size = max((abs(float(vector[place])) for vector in vectors), default=0.0)
        unit = units.get(name, "1")
        largest[unit] = max(largest.get(unit, 0.0), size)
    scale = np.array([largest.get(state.unit, 0.0) for state in kind.states])
    first = np.zeros(len(scale))
    for vector in vectors:
        x, u, _ = start_values(site, [float(one) for one in vector])
        speed = np.abs(np.asarray(kind.derivative(x, u, vector, 0.0), dtype=np.float64).ravel())
        first = np.maximum(first, np.nan_to_num(speed, posinf=0.0))
    rates = integrals(kind.derivative)
    derived = {j for _, j in rates}
    scale = np.where((scale == 0) & ~np.isin(np.arange(len(scale)), list(derived)), UNKNOWN, scale)
    for i, j in reversed(rates):  # from positions to velocities
        scale[i] = scale[i] or UNKNOWN
        scale[j] = max(scale[j], np.sqrt(2 * first[j] * scale[i]), scale[i])
    return scale
