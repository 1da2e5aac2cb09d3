"""Interconnection of one system for many points together, with rigid modes removed.

Takes: a `ClosedLoop` at a generic point, and the frame maps of its subsystems at each point.
Gives: `LoopStructure`, `loop_structure`, `known_by_constants`, `closed_loop`, `reduced`, `relative_at`,
`are_rigid`, `subsystem_key`.
Guarantees: the matrices are those of `interconnection.close_loop` in relative coordinates, to rounding; where
the directions are not those of a rigid mode they are NaN.
Does not: lift a subsystem (see `frame_matrices`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.eigen.interconnection import ClosedLoop, InterconnectionMatrices, feedback_of, interconnect
from apc.eigen.peer_classes import PeerClass
from apc.eigen.relative_coordinates import Relative, relative, relative_coordinates, relative_indices
from apc.eigen.rigid_modes import RigidModes, find_rigid_modes, rigid_modes_of
from apc.frame.lift import FrameMap

Floats = NDArray[np.float64]
Matrices = NDArray[Any]  # float64 or complex128

# The tolerance of M V = V, relative to |M| |V|: far above rounding, far below the residual of a mode that is
# not rigid.
RIGID = 1e-9

# An eigenvalue nearer to 1 than this, after removal of rigid directions, may be the second of a Jordan pair
# (rounding splits a pair by about the root of UNIT): the exact search for drifts then follows.
NEAR_UNITY = 1e-6


@dataclass(frozen=True, slots=True)
class LoopStructure:
    """The interconnection of a closed system's subsystems, and its relative coordinates.

    `rigid` are the rigid modes, `relative` the remaining coordinates.
    """

    system: ClosedLoop
    feedback: tuple[InterconnectionMatrices, ...]  # one per subsystem, with its radii
    rigid: RigidModes
    relative: Relative
    moving: bool  # the directions, and W, depend on free parameters


def subsystem_key(group: PeerClass) -> tuple[int, int]:
    """Return the key of subsystems with one frame map: the identities of subsystem and schedule."""
    return id(group.subsystem), id(group.schedule)


def loop_structure(system: ClosedLoop) -> LoopStructure:
    """Return the loop structure of a closed system, with its rigid modes."""
    feedback = tuple(feedback_of(system, system.layout))
    rigid = rigid_modes_of(system)
    wiring = _without(system, feedback, rigid)
    if rigid.names:
        within = reduced(wiring, system.matrix[None], 1)[0]
        if np.isfinite(within).all() and np.any(np.abs(np.linalg.eigvals(within) - 1) < NEAR_UNITY):
            wiring = _without(system, feedback, find_rigid_modes(system))
    return wiring


def _without(
    system: ClosedLoop, feedback: tuple[InterconnectionMatrices, ...], rigid: RigidModes
) -> LoopStructure:
    return LoopStructure(system, feedback, rigid, relative_coordinates(rigid.basis), moving=False)


def known_by_constants(wiring: LoopStructure, there: RigidModes) -> LoopStructure:
    """Return the structure with parameter-independent rigid coordinates, where rigid modes vary.

    A held force is proportional to its stiffness, and carries no information where the stiffness is nearly 0;
    the displacement of a mass is independent of the stiffness.

    Parameters
    ----------
    wiring
        A loop structure, with the rigid modes of one point.
    there
        The rigid modes of another point.
    """
    basis = wiring.rigid.basis
    if len(there.names) != len(wiring.rigid.names):  # other modes are rigid there: not continuous
        return wiring
    same = [
        all(item == other for item, other in zip(*pair, strict=True))
        for pair in zip(zip(*wiring.rigid.exact, strict=True), zip(*there.exact, strict=True), strict=True)
    ]
    constant = np.where(np.array(same)[:, None], basis, 0.0)
    if np.linalg.matrix_rank(constant) < basis.shape[1]:
        return replace(wiring, moving=True)
    return replace(wiring, relative=relative_coordinates(basis, relative_indices(constant)), moving=True)


def closed_loop(wiring: LoopStructure, lifted: Mapping[tuple[int, int], FrameMap]) -> Matrices:
    """Return the matrices (k, n, n) of one system at all points, see `interconnection.interconnect`."""
    maps = [lifted[subsystem_key(group)] for group in wiring.system.subsystems]
    return interconnect(maps, [feedback.plain for feedback in wiring.feedback], wiring.system.layout).matrix


def reduced(wiring: LoopStructure, matrix: Matrices, count: int) -> Matrices:
    """Return the matrices without rigid modes; NaN where the directions are not rigid."""
    at, sound = relative_at(wiring, matrix)
    within = relative(matrix, at)
    sound = sound & np.isfinite(within).all(axis=(1, 2))
    values = np.where(sound[:, None, None], within, np.nan)
    return np.broadcast_to(values, (count, *values.shape[1:])).copy() if len(values) < count else values


def relative_at(wiring: LoopStructure, matrix: Matrices) -> tuple[Relative, NDArray[np.bool_]]:
    """Return the relative coordinates at each point, and whether their directions are rigid modes.

    Directions that depend on parameters, for example where two forces balance, solve M V = V with V_p = 1: (1
    − M_rr) W = M_rp, and M_pp + M_pr W = 1. The error of W is then not bounded.
    """
    at = wiring.relative
    rest, eliminated = at.rest, at.eliminated
    if not len(eliminated):
        return at, np.ones(len(matrix), dtype=np.bool_)
    if not wiring.moving:
        return at, are_rigid(wiring, matrix.real)
    unit = np.eye(len(rest))
    weights = np.full((len(matrix), len(rest), len(eliminated)), np.nan, dtype=matrix.dtype)
    for k, item in enumerate(matrix):
        if np.isfinite(item).all():
            with contextlib.suppress(np.linalg.LinAlgError):
                weights[k] = np.linalg.solve(unit - item[np.ix_(rest, rest)], item[np.ix_(rest, eliminated)])
    local = matrix[:, eliminated[:, None], eliminated] + matrix[:, eliminated[:, None], rest] @ weights
    size = 1 + np.abs(matrix[:, eliminated[:, None], rest].real) @ np.abs(weights.real)
    still = np.abs(local.real - np.eye(len(eliminated))) <= RIGID * size
    nothing = np.full(weights.shape, np.nan)
    return Relative(eliminated, rest, weights, nothing), np.asarray(still.all(axis=(1, 2)))


def are_rigid(wiring: LoopStructure, matrix: Floats) -> NDArray[np.bool_]:
    """Return for each matrix (k, n, n) whether span V is invariant, M V = V C, with C_ii = 1."""
    basis = wiring.rigid.basis
    eliminated = wiring.relative.eliminated
    inverse = np.linalg.inv(basis[eliminated])
    moved, size = matrix @ basis, np.abs(matrix) @ np.abs(basis)
    local = inverse @ moved[:, eliminated]
    local_size = np.abs(inverse) @ size[:, eliminated]
    span = np.abs(moved - basis @ local) <= RIGID * (1 + size + np.abs(basis) @ local_size)
    still = np.abs(np.diagonal(local, axis1=1, axis2=2) - 1) <= RIGID * (
        1 + np.diagonal(local_size, axis1=1, axis2=2)
    )
    return np.asarray(span.all(axis=(1, 2)) & still.all(axis=1))
