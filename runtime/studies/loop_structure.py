"""Interconnection of one system for many points together, with rigid modes removed.

Takes: a `ClosedLoop` at a generic point, and the frame maps of its subsystems at each point.
Gives: `LoopStructure`, `loop_structure`, `with_constant_pivots`, `closed_loop`, `reduced`, `relative_at`,
`are_rigid`.
Guarantees: the matrices are those of `interconnection.close_loop` in relative coordinates, to rounding; at
points where the directions are not those of a rigid mode they are NaN.
Does not: lift a subsystem (see `frame_matrices`).
"""

from __future__ import annotations

import contextlib
from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.lifting.lift import FrameMap
from apc.spectrum.interconnection import ClosedLoop, InterconnectionMatrices, feedback_of, interconnect
from apc.spectrum.relative_coordinates import Relative, relative, relative_coordinates, relative_indices
from apc.spectrum.rigid_modes import RigidModes, find_rigid_modes, rigid_modes_of

Floats = NDArray[np.float64]
Matrices = NDArray[Any]  # float64 or complex128

# The tolerance of M V = V, relative to |M| |V|: far above rounding, far below the residual of other modes.
RIGID = 1e-9

# An eigenvalue nearer to 1 than this, after removal of rigid directions, may be the second of a Jordan pair
# (rounding splits a pair by about the root of UNIT): the exact search for drifts then follows.
NEAR_UNITY = 1e-6


@dataclass(frozen=True, slots=True)
class LoopStructure:
    """The interconnection of a closed system's subsystems, and its relative coordinates.

    `rigid` are the removed rigid modes, `relative` the remaining coordinates.
    """

    closed_loop: ClosedLoop
    feedback: tuple[InterconnectionMatrices, ...]  # one per subsystem, with its radii
    rigid: RigidModes
    relative: Relative
    modes_vary: bool  # the directions, and W, depend on free parameters


def loop_structure(closed_loop: ClosedLoop) -> LoopStructure:
    """Return the interconnection of a closed system, with its rigid modes removed."""
    feedback = tuple(feedback_of(closed_loop, closed_loop.layout))
    rigid = rigid_modes_of(closed_loop)
    structure = _structure_without(closed_loop, feedback, rigid)
    if rigid.names:
        relative_matrix = reduced(structure, closed_loop.matrix[None], 1)[0]
        if np.isfinite(relative_matrix).all() and np.any(
            np.abs(np.linalg.eigvals(relative_matrix) - 1) < NEAR_UNITY
        ):
            structure = _structure_without(closed_loop, feedback, find_rigid_modes(closed_loop))
    return structure


def _structure_without(
    closed_loop: ClosedLoop, feedback: tuple[InterconnectionMatrices, ...], rigid: RigidModes
) -> LoopStructure:
    """Return the loop structure of a closed system with these rigid modes removed."""
    return LoopStructure(closed_loop, feedback, rigid, relative_coordinates(rigid.basis), modes_vary=False)


def with_constant_pivots(wiring: LoopStructure, rigid_elsewhere: RigidModes) -> LoopStructure:
    """Return the structure with eliminated coordinates that are valid where rigid modes depend on parameters.

    One coordinate is eliminated for each rigid mode, and its entries in the modes must not vanish. Only
    coordinates with equal entries at both points are chosen: the displacement of a mass is constant, while a
    held force vanishes with its stiffness. The structure is unchanged if the number of rigid modes differs;
    it keeps its coordinates if too few are constant.

    Parameters
    ----------
    wiring
        A loop structure, with the rigid modes of one point.
    rigid_elsewhere
        The rigid modes of another point.
    """
    basis = wiring.rigid.basis
    if len(rigid_elsewhere.names) != len(
        wiring.rigid.names
    ):  # other rigid modes: not continuous in the parameters
        return wiring
    is_constant = [
        all(first == second for first, second in zip(*pair, strict=True))
        for pair in zip(
            zip(*wiring.rigid.exact, strict=True), zip(*rigid_elsewhere.exact, strict=True), strict=True
        )
    ]
    constant = np.where(np.array(is_constant)[:, None], basis, 0.0)
    if np.linalg.matrix_rank(constant) < basis.shape[1]:
        return replace(wiring, modes_vary=True)
    return replace(wiring, relative=relative_coordinates(basis, relative_indices(constant)), modes_vary=True)


def closed_loop(wiring: LoopStructure, lifted: Mapping[int, FrameMap]) -> Matrices:
    """Return the closed-loop matrices (k, n, n) of one system at all points."""
    maps = [lifted[peer_class.index] for peer_class in wiring.closed_loop.peer_classes]
    return interconnect(
        maps, [feedback.plain for feedback in wiring.feedback], wiring.closed_loop.layout
    ).matrix


def reduced(wiring: LoopStructure, matrix: Matrices, count: int) -> Matrices:
    """Return the matrices (count, m, m) without rigid modes.

    Matrices are NaN at points where the directions are not rigid.
    """
    coordinates, is_rigid = relative_at(wiring, matrix)
    relative_matrix = relative(matrix, coordinates)
    is_rigid = is_rigid & np.isfinite(relative_matrix).all(axis=(1, 2))
    values = np.where(is_rigid[:, None, None], relative_matrix, np.nan)
    return np.broadcast_to(values, (count, *values.shape[1:])).copy() if len(values) < count else values


def relative_at(wiring: LoopStructure, matrix: Matrices) -> tuple[Relative, NDArray[np.bool_]]:
    """Return the relative coordinates at each point, and the mask of points with these rigid modes.

    Directions that depend on parameters, for example where two forces balance, solve M V = V with V_p = 1: (1
    − M_rr) W = M_rp, and M_pp + M_pr W = 1. The error of W is then not bounded.
    """
    coordinates = wiring.relative
    remaining, eliminated = coordinates.rest, coordinates.eliminated
    if not len(eliminated):
        return coordinates, np.ones(len(matrix), dtype=np.bool_)
    if not wiring.modes_vary:
        return coordinates, are_rigid(wiring, matrix.real)
    unit = np.eye(len(remaining))
    weights = np.full((len(matrix), len(remaining), len(eliminated)), np.nan, dtype=matrix.dtype)
    for k, point_matrix in enumerate(matrix):
        if np.isfinite(point_matrix).all():
            with contextlib.suppress(np.linalg.LinAlgError):
                weights[k] = np.linalg.solve(
                    unit - point_matrix[np.ix_(remaining, remaining)],
                    point_matrix[np.ix_(remaining, eliminated)],
                )
    corner = matrix[:, eliminated[:, None], eliminated] + matrix[:, eliminated[:, None], remaining] @ weights
    size = 1 + np.abs(matrix[:, eliminated[:, None], remaining].real) @ np.abs(weights.real)
    is_unit = np.abs(corner.real - np.eye(len(eliminated))) <= RIGID * size
    unknown_errors = np.full(weights.shape, np.nan)
    return Relative(eliminated, remaining, weights, unknown_errors), np.asarray(is_unit.all(axis=(1, 2)))


def are_rigid(wiring: LoopStructure, matrix: Floats) -> NDArray[np.bool_]:
    """Return for each matrix (k, n, n) whether span V is invariant, M V = V C, with C_ii = 1."""
    basis = wiring.rigid.basis
    eliminated = wiring.relative.eliminated
    inverse = np.linalg.inv(basis[eliminated])
    product, size = matrix @ basis, np.abs(matrix) @ np.abs(basis)
    c = inverse @ product[:, eliminated]
    c_size = np.abs(inverse) @ size[:, eliminated]
    is_invariant = np.abs(product - basis @ c) <= RIGID * (1 + size + np.abs(basis) @ c_size)
    unit_diagonal = np.abs(np.diagonal(c, axis1=1, axis2=2) - 1) <= RIGID * (
        1 + np.diagonal(c_size, axis1=1, axis2=2)
    )
    return np.asarray(is_invariant.all(axis=(1, 2)) & unit_diagonal.all(axis=1))
