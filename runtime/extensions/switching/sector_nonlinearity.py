"""Sector nonlinearities: the variable that a switching part's force follows, and its sector.

Takes: a `SwitchedPeerType`, a `SwitchingPart` of it, a parameter vector.
Gives: `SectorNonlinearity`, `contact_force`.
Guarantees: a sector is incremental, between any two points: f = φ(y) with 0 ≤ Δφ ≤ Δy, y a linear combination
of states, holds and memories at a tick; determined from the equations, for parts of any name. With shares, f
= g y in each of its pieces, 0 ≤ g ≤ 1, for any selection of pieces.
Does not: cover forces that act continuously.

y is scaled as the part's own force: φ has slope 1 where it is on. A one-sided spring f = K max(0, d) has y =
K d and φ(y) = max(0, y).
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import casadi
import numpy as np
from numpy.typing import NDArray

from apc.analysis.switches import SwitchingPart
from apc.compiler.interpolation import jacobian
from apc.linearization.branch_conditions import SwitchedPeerType
from apc.linearization.jacobians import SubsystemJacobians
from apc.linearization.linearize import start_values
from apc.support.not_supported import NotSupportedError

Floats = NDArray[np.float64]

# The rounding of a slope or value that is computed from a few others, relatively.
ROUNDED = 1e-9

# The range beyond its breaks in which a force is sampled, relative to the size of its terms.
FAR = 3.0
NEAR_AND_FAR = (-FAR, -1.0, -0.5, -0.1, 0.1, 0.5, 1.0, FAR)


@dataclass(frozen=True, slots=True, eq=False)
class SectorNonlinearity:
    """The force of a switching part: output `output` of clock partition `partition`, a function of one
    variable y.

    y = `slopes` · (x, u, m) + `offset` is the force where the part is on; the first `states` slopes are those
    of x. `sector` is "" if the force is φ(y) with φ in a sector, else the reason. `shares` states that in
    each piece the force is g y with 0 ≤ g ≤ 1; `unilateral` that, along its slopes, it is max(0, y).
    """

    part: str
    partition: int
    output: int
    slopes: Floats  # (n_x + n_u + n_m,)
    offset: float
    states: int
    sector: str
    shares: bool
    unilateral: bool


def contact_force(
    switched: SwitchedPeerType, part: SwitchingPart, subsystem: SubsystemJacobians, parameters: Floats
) -> SectorNonlinearity | None:
    """Return the force of a switching part as a sector nonlinearity, None without stiffness (force 0).

    Parameters
    ----------
    switched, part
        The peer type with its decisions, and one of its parts.
    subsystem
        The peer type's Jacobians.
    parameters
        The vector (n_p,) of a peer.

    Raises
    ------
    NotSupportedError
        The reason why the force is not a linear one that is computed at ticks.
    """
    symbols = [switched.decisions[index].symbol for index in part.decisions]
    dependent_rows = [
        (function, row)
        for function in switched.functions
        for row in range(function.output.numel())
        if any(casadi.depends_on(function.output[row], symbol) for symbol in symbols)
    ]
    if any(item.where[0] == "derivative" for item, _ in dependent_rows):
        raise NotSupportedError(f"{part.name} acts in continuous time, not at ticks")
    if any(item.where[0] != "tick" for item, _ in dependent_rows):
        raise NotSupportedError(f"{part.name} depends on individual senders")
    if len(dependent_rows) > 1:
        raise NotSupportedError(f"{part.name} has more than one force")
    (function_of_force, row), partition = dependent_rows[0], dependent_rows[0][0].where[1]
    *inputs, received, p, t = function_of_force.inputs
    variables = casadi.vertcat(*inputs)
    guards = [switched.decisions[index].guard for index in part.decisions]
    force_and_guards = casadi.vertcat(function_of_force.output[row], *guards)
    if casadi.depends_on(force_and_guards, received) or casadi.depends_on(force_and_guards, t):
        raise NotSupportedError(f"{part.name} depends on received data or on time")
    slopes = jacobian(force_and_guards, variables)
    if casadi.depends_on(slopes, variables):
        raise NotSupportedError(f"{part.name} is not linear in contact")
    symbols_of_others = [
        decision.symbol for index, decision in enumerate(switched.decisions) if index not in part.decisions
    ]
    if any(casadi.depends_on(force_and_guards, symbol_of_other) for symbol_of_other in symbols_of_others):
        raise NotSupportedError(f"{part.name} depends on a condition of another part")
    decision_symbols = casadi.vertcat(*symbols)
    pieces = casadi.Function(
        "pieces", [variables, p, decision_symbols], [force_and_guards, casadi.densify(slopes)]
    )
    x, u, m = start_values(subsystem, parameters.tolist())
    start = np.array([*x, *u, *m[partition]], dtype=np.float64)

    def piece(setting: Sequence[bool]) -> tuple[Floats, Floats]:
        """Return the force and the guards at the start with these decisions (1 + g,), and their slopes."""
        values, slopes = pieces(start, parameters, [float(flag) for flag in setting])
        return np.asarray(values).ravel(), np.asarray(slopes).reshape(-1, len(start))

    values, steepest = piece(part.on)
    line, square = steepest[0], float(steepest[0] @ steepest[0])
    if not square:
        return None
    offset = float(values[0] - line @ start)
    tick, sizes = switched.peer_type.clocks[partition].tick, [item.numel() for item in inputs]

    def force_at(y: float) -> float:
        """Return the force at a value of y, reached by a motion from the start along its slopes."""
        at = np.split(start + (y - offset - line @ start) / square * line, np.cumsum(sizes)[:-1])
        return float(np.asarray(tick(*at, [0.0] * received.numel(), parameters, 0.0)).ravel()[row])

    breaks, single_variable, shares = [], True, True
    for setting in itertools.product((False, True), repeat=len(symbols)):
        values, slopes = piece(setting)
        gains = slopes @ line / square
        residuals = np.abs(slopes - gains[:, None] * line).max(axis=1)
        single_variable = single_variable and not (residuals > ROUNDED * np.abs(slopes).max(axis=1)).any()
        scale = np.abs(line) @ np.abs(start) + abs(offset)
        shares = (
            shares
            and -ROUNDED <= gains[0] <= 1 + ROUNDED
            and bool(residuals[0] <= ROUNDED * np.abs(line).max())
            and abs(values[0] - gains[0] * (line @ start + offset)) <= ROUNDED * scale
        )
        at = values - gains * (line @ start + offset)
        breaks += [-float(at[k] / gains[k]) for k in range(1, len(gains)) if gains[k]]
    size = max(float(np.abs(line) @ np.abs(start)), *map(abs, (*breaks, offset))) or 1.0
    sector = "depends on more than one variable, such as a depth and its rate"
    if single_variable and breaks:
        sector = _sector(force_at, sorted(breaks), size)
    error_bound = [abs(force_at(multiple * size) - max(multiple, 0) * size) for multiple in NEAR_AND_FAR]
    return SectorNonlinearity(
        *(part.name, partition, row, line, offset, sizes[0]),
        sector=sector and f"{part.name} {sector}",
        shares=shares,
        unilateral=max(error_bound) <= ROUNDED * size,
    )


def _sector(force_at: Callable[[float], float], breaks: Sequence[float], size: float) -> str:
    """Return the reason why a piecewise linear force is in no sector [0, 1], "" if it is in one.

    Parameters
    ----------
    force_at
        The force as a function of y.
    breaks
        The values of y at which the slope changes, in ascending order.
    size
        The magnitude of the terms of y, for tolerances.
    """
    ends = [value for k, value in enumerate(breaks) if not k or value - breaks[k - 1] > ROUNDED * size]
    knots = np.array([ends[0] - FAR * size, *ends, ends[-1] + FAR * size])
    at_knots = np.array([force_at(y) for y in knots])
    at_midpoints = np.array([force_at(y) for y in (knots[1:] + knots[:-1]) / 2])
    if np.abs(at_midpoints - (at_knots[1:] + at_knots[:-1]) / 2).max() > ROUNDED * size:
        return "jumps"
    slopes = np.diff(at_knots) / np.diff(knots)
    if slopes.min() < -ROUNDED or slopes.max() > 1 + ROUNDED:
        return "has a slope that is negative or exceeds the contact stiffness"
    return ""
