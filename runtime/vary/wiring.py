"""Closing the loop of one system for many points at once, and taking its rigid motions out.

Takes: a `ClosedLoop` that stands for all points, and the one-frame maps of its sites at each.
Gives: `LoopStructure`, `wire`, `known_by_constants`, `closed_loop`, `reduced`, `relative_at`,
`are_rigid`, `site_key`.
Guarantees: the matrices are those of `closing.close_loop` in relative coordinates, to rounding; where the
directions are not those of a rigid motion they are NaN.
Does not: lift a site (see `batch`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.closing import ClosedLoop, InterconnectionMatrices, close, feedback_of
from apc.eigen.peers import PeerClass
from apc.eigen.relative import Relative, relative, relative_coordinates, relative_places
from apc.eigen.rigid import RigidModes, find_rigid_modes, rigid_modes_of
from apc.frame.lift import FrameMap

Floats = NDArray[np.float64]
Matrices = NDArray[Any]  # float64 or complex128

# M V = V is asked to hold to this, relative to |M| |V|: far above rounding, far below what a motion that is
# not rigid leaves.
RIGID = 1e-9

# An eigenvalue nearer to 1 than this, the rigid directions taken out, may be the second of a Jordan pair
# (rounding splits one by about the root of UNIT): then the exact search for drifts is worth its time.
NEAR_ONE = 1e-6


@dataclass(frozen=True, slots=True)
class LoopStructure:
    """How a closed system's sites hear each other, and which of its coordinates are left.

    `rigid` are the rigid motions, `relative` the coordinates that are left.
    """

    system: ClosedLoop
    feedback: tuple[InterconnectionMatrices, ...]  # one a site, with its radii
    rigid: RigidModes
    relative: Relative
    moving: bool  # the directions follow the free parameters, and W with them


def site_key(group: PeerClass) -> tuple[int, int]:
    """Return what sites of the same one-frame map have in common: whose site and whose schedule it is."""
    return id(group.site), id(group.schedule)


def wire(system: ClosedLoop) -> LoopStructure:
    """Take down who hears whom in a closed system, and its rigid motions."""
    feedback = tuple(feedback_of(system, system.layout))
    rigid = rigid_modes_of(system)
    wiring = _without(system, feedback, rigid)
    if rigid.names:
        within = reduced(wiring, system.matrix[None], 1)[0]
        if np.isfinite(within).all() and np.any(np.abs(np.linalg.eigvals(within) - 1) < NEAR_ONE):
            wiring = _without(system, feedback, find_rigid_modes(system))
    return wiring


def _without(
    system: ClosedLoop, feedback: tuple[InterconnectionMatrices, ...], rigid: RigidModes
) -> LoopStructure:
    return LoopStructure(system, feedback, rigid, relative_coordinates(rigid.basis), moving=False)


def known_by_constants(wiring: LoopStructure, there: RigidModes) -> LoopStructure:
    """Return the wiring of directions that follow the parameters, given up for them where they don't.

    A held force follows its stiffness, and tells nothing of the motion where that is next to nothing; how far
    a mass has moved is the same for every stiffness.

    Parameters
    ----------
    wiring
        A wiring, its rigid motions those of one point.
    there
        Those of another point.
    """
    basis = wiring.rigid.basis
    if len(there.names) != len(wiring.rigid.names):  # other motions are free there: none of these follows
        return wiring
    same = [
        all(item == other for item, other in zip(*pair, strict=True))
        for pair in zip(zip(*wiring.rigid.exact, strict=True), zip(*there.exact, strict=True), strict=True)
    ]
    constant = np.where(np.array(same)[:, None], basis, 0.0)
    if np.linalg.matrix_rank(constant) < basis.shape[1]:
        return replace(wiring, moving=True)
    return replace(wiring, relative=relative_coordinates(basis, relative_places(constant)), moving=True)


def closed_loop(wiring: LoopStructure, lifted: Mapping[tuple[int, int], FrameMap]) -> Matrices:
    """Close the loop of one system at all points: its matrices (k, n, n), see `closing.close`."""
    maps = [lifted[site_key(group)] for group in wiring.system.sites]
    return close(maps, [feedback.plain for feedback in wiring.feedback], wiring.system.layout).matrix


def reduced(wiring: LoopStructure, matrix: Matrices, count: int) -> Matrices:
    """Take the rigid motions out; NaN where the directions are not rigid."""
    at, sound = relative_at(wiring, matrix)
    within = relative(matrix, at)
    sound = sound & np.isfinite(within).all(axis=(1, 2))
    values = np.where(sound[:, None, None], within, np.nan)
    return np.broadcast_to(values, (count, *values.shape[1:])).copy() if len(values) < count else values


def relative_at(wiring: LoopStructure, matrix: Matrices) -> tuple[Relative, NDArray[np.bool_]]:
    """Return the relative coordinates at each point, and whether they are relative to rigid motions.

    Directions that follow the parameters, as where two forces hold each other, solve M V = V with V_p = 1:
    (1 − M_rr) W = M_rp, and M_pp + M_pr W = 1. How far W is off is not said then.
    """
    at = wiring.relative
    rest, held = at.rest, at.held
    if not len(held):
        return at, np.ones(len(matrix), dtype=np.bool_)
    if not wiring.moving:
        return at, are_rigid(wiring, matrix.real)
    unit = np.eye(len(rest))
    weights = np.full((len(matrix), len(rest), len(held)), np.nan, dtype=matrix.dtype)
    for k, item in enumerate(matrix):
        if np.isfinite(item).all():
            with contextlib.suppress(np.linalg.LinAlgError):
                weights[k] = np.linalg.solve(unit - item[np.ix_(rest, rest)], item[np.ix_(rest, held)])
    own = matrix[:, held[:, None], held] + matrix[:, held[:, None], rest] @ weights
    size = 1 + np.abs(matrix[:, held[:, None], rest].real) @ np.abs(weights.real)
    still = np.abs(own.real - np.eye(len(held))) <= RIGID * size
    nothing = np.full(weights.shape, np.nan)
    return Relative(held, rest, weights, nothing), np.asarray(still.all(axis=(1, 2)))


def are_rigid(wiring: LoopStructure, matrix: Floats) -> NDArray[np.bool_]:
    """Say of each matrix (k, n, n) whether the rigid motions V move by themselves, M V = V C, C_ii = 1."""
    basis = wiring.rigid.basis
    held = wiring.relative.held
    inverse = np.linalg.inv(basis[held])
    moved, size = matrix @ basis, np.abs(matrix) @ np.abs(basis)
    own = inverse @ moved[:, held]
    own_size = np.abs(inverse) @ size[:, held]
    span = np.abs(moved - basis @ own) <= RIGID * (1 + size + np.abs(basis) @ own_size)
    still = np.abs(np.diagonal(own, axis1=1, axis2=2) - 1) <= RIGID * (
        1 + np.diagonal(own_size, axis1=1, axis2=2)
    )
    return np.asarray(span.all(axis=(1, 2)) & still.all(axis=1))
