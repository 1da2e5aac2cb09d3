"""Sector nonlinearities: the variable that a switching part's force follows, and its sector.

Takes: a `SwitchedPeerType`, a `SwitchingPart` of it, a parameter vector.
Gives: `SectorNonlinearity`, `push_of`.
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
from apc.frame.branch_conditions import SwitchedPeerType
from apc.frame.jacobians import SubsystemJacobians
from apc.frame.linearize import start_values
from apc.not_supported import NotSupportedError

Floats = NDArray[np.float64]

# The rounding of a slope or value that is computed from a few others, relatively.
ROUNDED = 1e-9

# The range beyond its breaks in which a force is sampled, relative to the size of its terms.
FAR = 3.0
NEAR_AND_FAR = (-FAR, -1.0, -0.5, -0.1, 0.1, 0.5, 1.0, FAR)


@dataclass(frozen=True, slots=True, eq=False)
class SectorNonlinearity:
    """A part's force: output `output` of clock partition `partition`, y where it is on.

    y = `slopes` · (x, u, m) + `offset`; the first `states` slopes are those of x. `sector` is "" where the
    force is φ(y) in a sector, else the reason why not. `shares` states that each of its pieces is a share of
    y, and `unilateral` that, along its slopes, it is max(0, y).
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


def push_of(
    switched: SwitchedPeerType, part: SwitchingPart, subsystem: SubsystemJacobians, parameters: Floats
) -> SectorNonlinearity | None:
    """Return a part's force where it is on; None where it is identically 0, as without stiffness.

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
        The reason why it is not a linear force computed at ticks.
    """
    symbols = [switched.decisions[index].symbol for index in part.decisions]
    touched = [
        (function, row)
        for function in switched.functions
        for row in range(function.output.numel())
        if any(casadi.depends_on(function.output[row], symbol) for symbol in symbols)
    ]
    if any(item.where[0] == "derivative" for item, _ in touched):
        raise NotSupportedError(f"{part.name} acts at every moment, not from tick to tick")
    if any(item.where[0] != "tick" for item, _ in touched):
        raise NotSupportedError(f"{part.name} depends on each of the others by itself")
    if len(touched) > 1:
        raise NotSupportedError(f"{part.name} is more than one force")
    (opened, row), partition = touched[0], touched[0][0].where[1]
    *inputs, received, p, t = opened.inputs
    moving = casadi.vertcat(*inputs)
    guards = [switched.decisions[index].guard for index in part.decisions]
    everything = casadi.vertcat(opened.output[row], *guards)
    if casadi.depends_on(everything, received) or casadi.depends_on(everything, t):
        raise NotSupportedError(f"{part.name} depends on what is heard or on time")
    slopes = jacobian(everything, moving)
    if casadi.depends_on(slopes, moving):
        raise NotSupportedError(f"{part.name} is not linear where it pushes")
    others = [
        decision.symbol for index, decision in enumerate(switched.decisions) if index not in part.decisions
    ]
    if any(casadi.depends_on(everything, other) for other in others):
        raise NotSupportedError(f"{part.name} depends on what another part decides")
    decided = casadi.vertcat(*symbols)
    pieces = casadi.Function("pieces", [moving, p, decided], [everything, casadi.densify(slopes)])
    x, u, m = start_values(subsystem, parameters.tolist())
    start = np.array([*x, *u, *m[partition]], dtype=np.float64)

    def piece(setting: Sequence[bool]) -> tuple[Floats, Floats]:
        """Return force and guards at the start with these decisions, and their slopes."""
        values, slopes = pieces(start, parameters, [float(flag) for flag in setting])
        return np.asarray(values).ravel(), np.asarray(slopes).reshape(-1, len(start))

    values, steepest = piece(part.on)
    line, square = steepest[0], float(steepest[0] @ steepest[0])
    if not square:
        return None
    offset = float(values[0] - line @ start)
    tick, sizes = switched.peer_type.clocks[partition].tick, [item.numel() for item in inputs]

    def force_at(y: float) -> float:
        """Return the force at a value of y, by a motion along its slopes."""
        at = np.split(start + (y - offset - line @ start) / square * line, np.cumsum(sizes)[:-1])
        return float(np.asarray(tick(*at, [0.0] * received.numel(), parameters, 0.0)).ravel()[row])

    breaks, alone, shares = [], True, True
    for setting in itertools.product((False, True), repeat=len(symbols)):
        values, slopes = piece(setting)
        along = slopes @ line / square
        aside = np.abs(slopes - along[:, None] * line).max(axis=1)
        alone = alone and not (aside > ROUNDED * np.abs(slopes).max(axis=1)).any()
        scale = np.abs(line) @ np.abs(start) + abs(offset)
        shares = (
            shares
            and -ROUNDED <= along[0] <= 1 + ROUNDED
            and bool(aside[0] <= ROUNDED * np.abs(line).max())
            and abs(values[0] - along[0] * (line @ start + offset)) <= ROUNDED * scale
        )
        at = values - along * (line @ start + offset)
        breaks += [-float(at[k] / along[k]) for k in range(1, len(along)) if along[k]]
    size = max(float(np.abs(line) @ np.abs(start)), *map(abs, (*breaks, offset))) or 1.0
    sector = "depends on more than one number, such as a depth and its rate"
    if alone and breaks:
        sector = _sector(force_at, sorted(breaks), size)
    error_bound = [abs(force_at(by * size) - max(by, 0) * size) for by in NEAR_AND_FAR]
    return SectorNonlinearity(
        *(part.name, partition, row, line, offset, sizes[0]),
        sector=sector and f"{part.name} {sector}",
        shares=shares,
        unilateral=max(error_bound) <= ROUNDED * size,
    )


def _sector(force_at: Callable[[float], float], breaks: Sequence[float], size: float) -> str:
    """Return why a piecewise linear force is in no sector, "" if it is.

    `size` is that of the terms of y.
    """
    ends = [value for k, value in enumerate(breaks) if not k or value - breaks[k - 1] > ROUNDED * size]
    knots = np.array([ends[0] - FAR * size, *ends, ends[-1] + FAR * size])
    at_knots = np.array([force_at(y) for y in knots])
    amid = np.array([force_at(y) for y in (knots[1:] + knots[:-1]) / 2])
    if np.abs(amid - (at_knots[1:] + at_knots[:-1]) / 2).max() > ROUNDED * size:
        return "jumps"
    slopes = np.diff(at_knots) / np.diff(knots)
    if slopes.min() < -ROUNDED or slopes.max() > 1 + ROUNDED:
        return "falls, or grows faster in some piece than where it is on"
    return ""
