"""Dominant eigenvalue of a complete model at many points, with its bound and the motion of its mode.

Takes: a `BatchEvaluator`, and its systems at some points (`BatchEvaluator.bounded`).
Gives: `DrivingPart`, `parts_of`; `DominantPair`, `dominant`, `dominant_at`.
Guarantees: results marked as certain are proved, as in `spectrum.enclosure`: the largest eigenvalue of all
systems, its error, its side of 1, and that no other eigenvalue is 1.
Does not: give results at undecided points.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.lifting.interval_arithmetic import UNIT_ROUNDOFF
from apc.lifting.phase_unwrapping import phase_advance
from apc.spectrum.eigenpairs import driving_parts
from apc.spectrum.enclosure import SMALL, enclose_stack
from apc.spectrum.peer_classes import PeerClass
from apc.spectrum.relative_coordinates import relative_bounded
from apc.spectrum.spectrum import LEAST_SHARE, STRAIGHT
from apc.studies.frame_matrices import BatchEvaluator, Bounded
from apc.studies.loop_structure import LoopStructure

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Indices = NDArray[np.intp]
Truths = NDArray[np.bool_]

# The error of a radius (relative above 1) beyond which an analysis is often more accurate: it uses balls.
SHARP = 1e-11

# The required relative gap between the largest eigenvalue and all others.
SEPARATE = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class DrivingPart:
    """A strongly connected part of a system; the eigenvalues of a system are those of its parts.

    `states` are the indices of the part's states among the relative coordinates.
    """

    system: int
    states: Indices


@dataclass(frozen=True, slots=True, eq=False)
class DominantPair:
    """The largest eigenvalue at k points (of a pair the upper one), its error bound, and its mode's motion.

    `certain` marks the points with valid results; results at other points have no meaning.
    """

    radius: Floats
    error: Floats
    frequency_hz: Floats
    damping_ratio: Floats
    certain: Truths


def parts_of(evaluator: BatchEvaluator) -> tuple[tuple[DrivingPart, ...], tuple[Truths, ...]]:
    """Return the strongly connected parts of all systems, and the possible nonzeros (n, n) of each matrix."""
    patterns, parts = [], []
    for index, wiring in enumerate(evaluator.wirings):
        matrix, error = relative_bounded(wiring.closed_loop.matrix, wiring.closed_loop.error, wiring.relative)
        size = np.abs(matrix) + error
        patterns.append(size != 0)
        parts += [DrivingPart(index, states) for states in driving_parts(size != 0)]
    return tuple(parts), tuple(patterns)


def dominant_at(
    evaluator: BatchEvaluator,
    parts: Sequence[DrivingPart],
    patterns: Sequence[Truths],
    vectors: Callable[[PeerClass], Floats],
    allowed: Truths,
) -> tuple[Indices, DominantPair]:
    """Return the points whose matrices have the structure of the evaluator, and `dominant` at these points.

    Parameters
    ----------
    evaluator, parts, patterns
        The evaluator, and its `parts_of`.
    vectors
        The function from a class to its parameters at each point (k, n_p), or (1, n_p) if constant.
    allowed
        The mask (k,) of the points with valid parameter values.
    """
    systems = evaluator.bounded(vectors)
    for system, pattern in zip(systems, patterns, strict=True):
        # A zero at meaningless values is structural; NaN and infinite entries give no matrices.
        magnitude = np.abs(system.matrix) + system.error
        allowed = allowed & np.isfinite(magnitude.sum(axis=(1, 2)))
        if not pattern.all():
            allowed = allowed & ~magnitude[:, ~pattern].any(axis=1)
    valid = np.flatnonzero(allowed)
    return valid, dominant(evaluator, parts, [system.at(valid) for system in systems], len(valid))


def dominant(
    evaluator: BatchEvaluator, parts: Sequence[DrivingPart], systems: Sequence[Bounded], count: int
) -> DominantPair:
    """Return the largest eigenvalue of the complete model at k points, with its bound.

    Parameters
    ----------
    evaluator, parts
        The evaluator of these systems, and their parts.
    systems
        The systems at k points; constant systems may be present once.
    count
        The number k of points.
    """
    with np.errstate(all="ignore"):
        return _dominant(evaluator, parts, systems, count)


def _dominant(
    evaluator: BatchEvaluator, parts: Sequence[DrivingPart], systems: Sequence[Bounded], count: int
) -> DominantPair:
    """Return the largest eigenvalue of the complete model at `count` points (see `dominant`).

    Parameters
    ----------
    evaluator, parts
        The evaluator of the model, and the strongly connected parts of its matrices.
    systems, count
        The matrices with error bounds at the points, and the number of points.
    """
    enclosed = []
    for part in parts:
        system = systems[part.system]
        # Constant matrices are present once.
        block, error_bound = (
            _block(system_matrix, part.states) for system_matrix in (system.matrix, system.error)
        )
        enclosed.append(enclose_stack(*np.broadcast_arrays(block, error_bound)))
    value = np.zeros((len(parts), count), dtype=np.complex128)
    low, high, runner_up, no_other_unit = np.zeros((4, len(parts), count))
    for part_index, (pairs, bounds) in enumerate(enclosed):
        value[part_index], low[part_index], high[part_index] = pairs.values[:, 0], bounds.low, bounds.high
        no_other_unit[part_index] = (np.abs(pairs.values - 1) > bounds.errors).all(axis=1)
        outer_bound = np.abs(pairs.values) + bounds.errors
        outer_bound[:, 0] = 0.0
        outer_bound[pairs.values[:, 0].imag != 0, 1:2] = 0.0  # the conjugate
        runner_up[part_index] = outer_bound.max(axis=1)
    leading_part = np.abs(value).argmax(axis=0)
    is_first = leading_part == np.arange(len(parts))[:, None]
    others = np.where(is_first, runner_up, high).max(axis=0, initial=0.0)
    largest = value[leading_part, np.arange(count)]
    radius = np.abs(largest)
    error = np.maximum(high.max(axis=0) - radius, radius - low.max(axis=0))
    # A deadbeat mode is treated separately.
    certain = (
        (error <= SHARP * np.maximum(radius, 1.0)) & (radius > SMALL) & (others < radius * (1 - SEPARATE))
    )
    # For an unstable mode, an eigenvalue of 1 may be another rigid mode.
    certain &= (radius + error < 1 - 4 * UNIT_ROUNDOFF) | (
        (radius - error > 1 + 4 * UNIT_ROUNDOFF) & no_other_unit.all(axis=0)
    )
    angle = np.full(count, np.nan)
    frame_s = evaluator.wirings[0].closed_loop.frame_s
    for part_index, (part, (pairs, _)) in enumerate(zip(parts, enclosed, strict=True)):
        points_of_part = np.flatnonzero(certain & (leading_part == part_index))
        if len(points_of_part):
            wiring, system = evaluator.wirings[part.system], systems[part.system].at(points_of_part)
            right, left = (
                np.broadcast_to(vectors, (count, len(part.states)))[points_of_part]
                for vectors in (pairs.right[:, :, 0], pairs.left[:, 0])
            )
            angle[points_of_part] = _angles(wiring, system, part, largest[points_of_part], right, left)
    rate = (np.log(radius) + 1j * np.where(np.abs(angle) > STRAIGHT, angle, 0.0)) / frame_s
    return DominantPair(
        radius=radius,
        error=error * (1 + 4 * UNIT_ROUNDOFF) + 4 * UNIT_ROUNDOFF * radius,
        frequency_hz=np.abs(rate.imag) / (2 * np.pi),
        damping_ratio=-rate.real / np.abs(rate),
        certain=certain & ~np.isnan(angle),
    )


def _block(matrix: Floats, states: Indices) -> Floats:
    """Return the rows and columns of some states of matrices (k, n, n)."""
    return matrix if len(states) == matrix.shape[-1] else matrix[:, states[:, None], states]


def _angles(
    wiring: LoopStructure,
    bounded: Bounded,
    part: DrivingPart,
    values: Complexes,
    right: Complexes,
    left: Complexes,
) -> Floats:
    """Return the phase advance of modes over a frame (k,), see `spectrum.angles_in_frame`.

    The phase advance is NaN if undetermined.

    Parameters
    ----------
    wiring, bounded, part
        A system at k points, and its part with these modes.
    values, right, left
        The eigenvalues (k,) and their vectors (k, m) over the part.
    """
    closed_loop, coordinates = wiring.closed_loop, wiring.relative
    count = len(values)
    vectors, covectors = np.zeros((2, count, len(closed_loop.names)), dtype=np.complex128)
    vectors[:, coordinates.rest[part.states]], covectors[:, coordinates.rest[part.states]] = right, left
    if len(coordinates.eliminated):
        frame_matrix = np.broadcast_to(bounded.frame_map, (count, *bounded.frame_map.shape[1:]))
        coupled = frame_matrix[:, coordinates.eliminated[:, None], coordinates.rest]
        corner = (
            frame_matrix[:, coordinates.eliminated[:, None], coordinates.eliminated]
            + coupled @ coordinates.weights
        )
        shifted = values[:, None, None] * np.eye(len(coordinates.eliminated)) - corner
        driven = coupled @ vectors[:, coordinates.rest, None]
        try:
            vectors[:, coordinates.eliminated] = np.linalg.solve(shifted, driven)[:, :, 0]
        except np.linalg.LinAlgError:
            return np.full(count, np.nan)
        vectors[:, coordinates.rest] += vectors[:, coordinates.eliminated] @ coordinates.weights.T
        covectors[:, coordinates.eliminated] = -covectors[:, coordinates.rest] @ coordinates.weights
    participations = np.abs(vectors * covectors)
    motion = np.array(closed_loop.motion, dtype=np.intp)
    result = np.full(count, np.nan)
    if not len(motion):
        return result
    largest_state = motion[participations[:, motion].argmax(axis=1)]
    moves = participations[np.arange(count), largest_state] > LEAST_SHARE * participations.sum(axis=1)
    subsystem_of = np.searchsorted(closed_loop.offsets, largest_state, side="right") - 1
    for g, (peer_class, offset) in enumerate(zip(closed_loop.peer_classes, closed_loop.offsets, strict=True)):
        indices = np.flatnonzero(moves & (subsystem_of == g))
        if not len(indices):
            continue
        system_at_points = bounded.at(indices)
        start = vectors[indices, offset : offset + len(peer_class.z_names)]
        received = (system_at_points.received[g] @ vectors[indices, :, None])[:, :, 0]
        states = largest_state[indices] - offset
        result[indices] = phase_advance(
            system_at_points.subsystems[g], peer_class.schedule, start, received, states, values[indices]
        )
    return result
