"""The evaluator of a system's matrices over some of its parameters, whatever kind of scene it is.

Takes: a `CompiledSystem` and the parameters that vary.
Gives: `evaluator`, `PointEvaluator`; `free_parameters`, `reaches_time`.
Guarantees: peers that are alike at some values only are kept apart.
Does not: vary times (see `delays`).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import PEERS, CompiledSystem, Parameter
from apc.compiler.errors import ApcError
from apc.runtime.analysis.analysis import Prepared, lifted_groups, prepare
from apc.runtime.eigen.closing import ClosedSystem
from apc.runtime.eigen.modes import split
from apc.runtime.eigen.rigid import RigidModes, find_rigid_modes, relative_coordinates
from apc.runtime.frame.names import Free, parameter_of
from apc.runtime.frame.overrides import Override, apply
from apc.runtime.vary.batch import BatchEvaluator, batch_evaluator

Floats = NDArray[np.float64]

# What each free parameter is moved by, relatively, where peers are told apart: no other number of a scene
# agrees with such a value by accident. The next one is moved by a little more.
GENERIC = Fraction(1, 1024) + Fraction(1, 65537)

# The step of a central difference, relative to the value: the cube root of the unit roundoff, which balances
# what is cut off against rounding (both near 1e-10).
DIFFERENCE = 2.0**-17

# An eigenvalue left this near to 1 asks for the exact search for drifts: a pair at 1 is scattered by rounding
# to the square root of 1e-15, and ten times that.
DRIFT = 1e-6

# The blocks of a point that has no matrix.
NOTHING = [np.full((1, 1), np.nan)]


@dataclass(frozen=True, slots=True, eq=False)
class PointEvaluator:
    """An `Evaluator` of a scene that is linearized at its start: every point goes the ordinary way.

    All closed systems are blocks of one matrix, filled up with zeros where a point has fewer states than
    another. Derivatives are central differences, right to about 1e-10.
    """

    system: CompiledSystem
    free: tuple[Free, ...]
    prepared: Prepared

    def matrices(self, values: Floats) -> tuple[Floats, ...]:
        """Return the reduced frame matrices of all systems as blocks (k, n, n) at values (k, m).

        All of a matrix is NaN where there is none: below a parameter's minimum, say.
        """
        return (_filled_up([self._blocks(value) for value in values]),)

    def slopes(self, values: Floats, along: Floats) -> tuple[tuple[Floats, Floats], ...]:
        """Return the matrices (k, n, n) and their derivatives along directions (k, m).

        At the end of what a parameter may be, or of where the same motions are free, the derivative is that
        of the parabola through two points further inside; NaN where there is none.
        """
        scale = np.where(values == 0, 1.0, np.maximum(np.abs(values), 1e-6))  # 0 has none: its unit's
        step = DIFFERENCE * np.where(along != 0, scale, np.inf).min(axis=1) / np.abs(along).max(axis=1)
        moved = step[:, None] * along
        points = np.concatenate([values, values - moved, values + moved])
        blocks = [self._blocks(value) for value in points]
        here, before, after = np.split(_filled_up(blocks), 3)
        slope = (after - before) / (2 * step[:, None, None])
        shapes = [[len(one) for one in listed] for listed in blocks]
        count = len(values)
        for row in range(count):
            if shapes[row] == shapes[count + row] == shapes[2 * count + row]:
                continue
            slope[row] = np.nan
            way = 1.0 if shapes[row] == shapes[2 * count + row] else -1.0
            inside = [self._blocks(value) for value in values[row] + way * np.outer([1.0, 2.0], moved[row])]
            if all([len(one) for one in listed] == shapes[row] for listed in inside):
                _, second, third = _filled_up([blocks[row], *inside])
                size = len(second)
                slope[row] = 0.0
                slope[row, :size, :size] = (
                    way * (4 * second - 3 * here[row, :size, :size] - third) / (2 * step[row])
                )
        return ((here, slope),)

    def closed_at(self, value: Sequence[float]) -> tuple[ClosedSystem, ...]:
        """Return the closed systems at one point (m,), as an analysis has them."""
        overrides = [
            Override(one.name, one.group, Fraction(float(number)))
            for one, number in zip(self.free, value, strict=True)
        ]
        return split(*lifted_groups(apply(self.system, overrides), prepared=self.prepared)).systems

    def _blocks(self, value: Floats) -> list[Floats]:
        """Return each system's matrix in relative coordinates at a point (m,); NaN where there is none."""
        try:
            systems = self.closed_at(value.tolist())
        except ApcError:
            return NOTHING
        found = []
        for system in systems:
            free = find_rigid_modes(system, with_drifts=False)
            reduced = _reduced(system, free)
            if not np.isfinite(reduced).all():
                return NOTHING
            if free.names and np.abs(np.linalg.eigvals(reduced) - 1).min(initial=np.inf) < DRIFT:
                reduced = _reduced(system, find_rigid_modes(system))
            found.append(reduced)
        return found


def keeps_size(matrices: Sequence[Floats]) -> bool:
    """Say whether the largest relative motion keeps its size, to rounding: it may be free here only."""
    radius = max((float(np.abs(np.linalg.eigvals(one)).max(initial=0.0)) for one in matrices), default=0.0)
    return abs(radius - 1) < DRIFT


def _filled_up(blocks: Sequence[Sequence[Floats]]) -> Floats:
    """Return the blocks of each point as one matrix (k, n, n), all of it NaN where a block is."""
    size = max((sum(len(one) for one in listed) for listed in blocks), default=0)
    found = np.zeros((len(blocks), size, size))
    for matrix, listed in zip(found, blocks, strict=True):
        if not all(np.isfinite(one).all() for one in listed):
            matrix[:] = np.nan
            continue
        start = 0
        for one in listed:
            rows = slice(start, start + len(one))
            matrix[rows, rows] = one
            start = rows.stop
    return found


def _reduced(system: ClosedSystem, free: RigidModes) -> Floats:
    """Return the frame matrix of the coordinates relative to the rigid motions, see `spectrum`."""
    held, rest, weights = relative_coordinates(free.basis)
    return system.matrix[np.ix_(rest, rest)] - weights @ system.matrix[np.ix_(held, rest)]


def evaluator(
    system: CompiledSystem, free: Sequence[Free], *, prepared: Prepared | None = None
) -> BatchEvaluator | PointEvaluator:
    """Prepare a system for many values of some of its parameters.

    Parameters
    ----------
    system
        The compiled scene; all other parameters keep its numbers.
    free
        The parameters that vary; none of them may reach a time (see `reaches_time`).
    prepared
        From `analysis.prepare`, of this system with any numbers.

    Raises
    ------
    ApcError
        As `analysis.lifted_groups`.
    """
    prepared = prepared or prepare(system)
    used = [prepared.jacobians[group.kind] for group in system.groups]
    if not all(site.parameters_suffice for site in used):
        return PointEvaluator(system, tuple(free), prepared)
    groups, exchange = lifted_groups(generic(system, free), prepared=prepared)
    return batch_evaluator(system, free, groups, exchange)


def generic(system: CompiledSystem, free: Sequence[Free]) -> CompiledSystem:
    """Return the system with meaningless values for what is free: peers alike there are so everywhere."""
    overrides = []
    for place, one in enumerate(free):
        value = Fraction(parameter_of(system, one).value)
        share = GENERIC * Fraction(place + 3, 3)
        overrides.append(Override(one.name, one.group, value * (1 + share) if value else share))
    unbounded = replace(
        system,
        parameters=tuple(_unbounded(parameter) for parameter in system.parameters),
        groups=tuple(
            replace(group, values=tuple(_unbounded(parameter) for parameter in group.values))
            for group in system.groups
        ),
    )
    return apply(unbounded, overrides)


def _unbounded(parameter: Parameter) -> Parameter:
    return replace(parameter, minimum=None, open_minimum=False, maximum=None)


def free_parameters(system: CompiledSystem) -> list[Free]:
    """Return the parameters that follow from no other and set no time: everybody's, then the groups' own.

    Everybody's value reaches the groups that have none of their own. What is given peer by peer, or to a
    group as an expression, has no one value and is left out.
    """
    several = {column.name for group in system.groups for column in group.columns}
    several |= {one.name for group in system.groups for one in group.values if one.expression}
    listed = [Free(one.name) for one in system.parameters if one.expression is None and one.name != PEERS]
    listed += [Free(one.name, group.name) for group in system.groups for one in group.values]
    return [one for one in listed if one.name not in several and not reaches_time(system, one)]


def reaches_time(system: CompiledSystem, free: Free) -> bool:
    """Say whether a period, phase or delay is, or depends on, this parameter."""
    if any(timing.name == free.name for timing in system.timings):
        return True
    if not any(timing.expression for timing in system.timings):
        return False
    return generic(system, (free,)).timings != system.timings
