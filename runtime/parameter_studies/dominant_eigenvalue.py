"""Dominant eigenvalue of a complete model at many points, with its bound and the motion of its mode.

Takes: a `BatchEvaluator`, and its systems at some points (`BatchEvaluator.bounded`).
Gives: `DrivingPart`, `parts_of`; `DominantPair`, `dominant`.
Guarantees: results marked as certain are proved, as in `eigen.enclosure`: which eigenvalue is the largest of
all systems, its error, its side of 1, and that no other one is 1.
Does not: give results at undecided points.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.eigenpairs import driving_parts
from apc.eigen.enclosure import SMALL, enclose_stack
from apc.eigen.relative_coordinates import relative_bounded
from apc.eigen.spectrum import LEAST_SHARE, STRAIGHT
from apc.frame.interval_arithmetic import UNIT_ROUNDOFF
from apc.frame.phase_unwrapping import phase_advance
from apc.parameter_studies.frame_matrices import BatchEvaluator, Bounded
from apc.parameter_studies.loop_structure import LoopStructure

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Indices = NDArray[np.intp]
Truths = NDArray[np.bool_]

# The error of a radius, absolute or relative where it is above 1, beyond which an analysis is often more
# accurate: its exponentials are balls.
SHARP = 1e-11

# The required relative gap between the largest and all others.
SEPARATE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class DrivingPart:
    """Strongly connected states of a system: its eigenvalues are those of its parts.

    `states` are their indices among the relative coordinates.
    """

    system: int
    states: Indices


@dataclass(frozen=True, slots=True, eq=False)
class DominantPair:
    """The largest eigenvalue at k points, of a pair the upper one; its bound, and its mode's motion.

    `certain` marks the points with valid results; the others have no meaning.
    """

    radius: Floats
    error: Floats
    frequency_hz: Floats
    damping_ratio: Floats
    certain: Truths


def parts_of(evaluator: BatchEvaluator) -> tuple[tuple[DrivingPart, ...], tuple[Truths, ...]]:
    """Return the parts of all systems, and the possible nonzeros (n, n) of each one's matrix."""
    patterns, parts = [], []
    for index, wiring in enumerate(evaluator.wirings):
        matrix, error = relative_bounded(wiring.system.matrix, wiring.system.error, wiring.relative)
        size = np.abs(matrix) + error
        patterns.append(size != 0)
        parts += [DrivingPart(index, states) for states in driving_parts(size != 0)]
    return tuple(parts), tuple(patterns)


def dominant(
    evaluator: BatchEvaluator, parts: Sequence[DrivingPart], systems: Sequence[Bounded], count: int
) -> DominantPair:
    """Return the largest eigenvalue of the complete model.

    Parameters
    ----------
    evaluator, parts
        The evaluator of these systems, and their parts.
    systems
        The systems at k points; constant ones may be present once.
    count
        k.
    """
    with np.errstate(all="ignore"):
        return _dominant(evaluator, parts, systems, count)


def _dominant(
    evaluator: BatchEvaluator, parts: Sequence[DrivingPart], systems: Sequence[Bounded], count: int
) -> DominantPair:
    enclosed = []
    for part in parts:
        system = systems[part.system]
        # Constant matrices are present once.
        block, error_bound = (_block(whole, part.states) for whole in (system.matrix, system.error))
        enclosed.append(enclose_stack(*np.broadcast_arrays(block, error_bound)))
    value = np.zeros((len(parts), count), dtype=np.complex128)
    low, high, second, clear = np.zeros((4, len(parts), count))
    for number, (pairs, bounds) in enumerate(enclosed):
        value[number], low[number], high[number] = pairs.values[:, 0], bounds.low, bounds.high
        clear[number] = (np.abs(pairs.values - 1) > bounds.errors).all(axis=1)
        outer = np.abs(pairs.values) + bounds.errors
        outer[:, 0] = 0.0
        outer[pairs.values[:, 0].imag != 0, 1:2] = 0.0  # the conjugate
        second[number] = outer.max(axis=1)
    leads = np.abs(value).argmax(axis=0)
    is_first = leads == np.arange(len(parts))[:, None]
    others = np.where(is_first, second, high).max(axis=0, initial=0.0)
    largest = value[leads, np.arange(count)]
    radius = np.abs(largest)
    error = np.maximum(high.max(axis=0) - radius, radius - low.max(axis=0))
    # A deadbeat mode is treated separately.
    certain = (
        (error <= SHARP * np.maximum(radius, 1.0)) & (radius > SMALL) & (others < radius * (1 - SEPARATE))
    )
    # For an unstable mode, an eigenvalue of 1 may be another rigid mode.
    certain &= (radius + error < 1 - 4 * UNIT_ROUNDOFF) | (
        (radius - error > 1 + 4 * UNIT_ROUNDOFF) & clear.all(axis=0)
    )
    angle = np.full(count, np.nan)
    frame_s = evaluator.wirings[0].system.frame_s
    for number, (part, (pairs, _)) in enumerate(zip(parts, enclosed, strict=True)):
        mine = np.flatnonzero(certain & (leads == number))
        if len(mine):
            wiring, system = evaluator.wirings[part.system], systems[part.system].at(mine)
            right, left = (
                np.broadcast_to(vectors, (count, len(part.states)))[mine]
                for vectors in (pairs.right[:, :, 0], pairs.left[:, 0])
            )
            angle[mine] = _angles(wiring, system, part, largest[mine], right, left)
    rate = (np.log(radius) + 1j * np.where(np.abs(angle) > STRAIGHT, angle, 0.0)) / frame_s
    return DominantPair(
        radius=radius,
        error=error * (1 + 4 * UNIT_ROUNDOFF) + 4 * UNIT_ROUNDOFF * radius,
        frequency_hz=np.abs(rate.imag) / (2 * np.pi),
        damping_ratio=-rate.real / np.abs(rate),
        certain=certain & ~np.isnan(angle),
    )


def _block(matrix: Floats, states: Indices) -> Floats:
    """Return some rows and columns of matrices (k, n, n)."""
    return matrix if len(states) == matrix.shape[-1] else matrix[:, states[:, None], states]


def _angles(
    wiring: LoopStructure,
    bounded: Bounded,
    part: DrivingPart,
    values: Complexes,
    right: Complexes,
    left: Complexes,
) -> Floats:
    """Return the phase advance of modes in a frame (k,), see `spectrum.angles_in_frame`; NaN if undetermined.

    Parameters
    ----------
    wiring, bounded, part
        A system at k points, and the part of it with these modes.
    values, right, left
        The eigenvalues (k,) and their vectors (k, m) over the part.
    """
    system, at = wiring.system, wiring.relative
    count = len(values)
    vectors, covectors = np.zeros((2, count, len(system.names)), dtype=np.complex128)
    vectors[:, at.rest[part.states]], covectors[:, at.rest[part.states]] = right, left
    if len(at.eliminated):
        whole = np.broadcast_to(bounded.frame_map, (count, *bounded.frame_map.shape[1:]))
        coupled = whole[:, at.eliminated[:, None], at.rest]
        corner = whole[:, at.eliminated[:, None], at.eliminated] + coupled @ at.weights
        shifted = values[:, None, None] * np.eye(len(at.eliminated)) - corner
        driven = coupled @ vectors[:, at.rest, None]
        try:
            vectors[:, at.eliminated] = np.linalg.solve(shifted, driven)[:, :, 0]
        except np.linalg.LinAlgError:
            return np.full(count, np.nan)
        vectors[:, at.rest] += vectors[:, at.eliminated] @ at.weights.T
        covectors[:, at.eliminated] = -covectors[:, at.rest] @ at.weights
    shares = np.abs(vectors * covectors)
    motion = np.array(system.motion, dtype=np.intp)
    result = np.full(count, np.nan)
    if not len(motion):
        return result
    leads = motion[shares[:, motion].argmax(axis=1)]
    moving = shares[np.arange(count), leads] > LEAST_SHARE * shares.sum(axis=1)
    subsystem_of = np.searchsorted(system.offsets, leads, side="right") - 1
    for g, (group, offset) in enumerate(zip(system.subsystems, system.offsets, strict=True)):
        local = np.flatnonzero(moving & (subsystem_of == g))
        if not len(local):
            continue
        here = bounded.at(local)
        start = vectors[local, offset : offset + len(group.z_names)]
        received = (here.received[g] @ vectors[local, :, None])[:, :, 0]
        states = leads[local] - offset
        result[local] = phase_advance(
            here.subsystems[g], group.schedule, start, received, states, values[local]
        )
    return result
