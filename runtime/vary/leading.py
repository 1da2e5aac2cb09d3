"""The largest eigenvalue of a whole scene at many points, with its bound, and how its mode moves.

Takes: a `BatchEvaluator`, and what its systems are at some points (`BatchEvaluator.bounded`).
Gives: `DrivingPart`, `parts_of`; `Leading`, `leading`.
Guarantees: what is said to be certain is proved, as in `eigen.enclosure`: which eigenvalue is the largest of
all systems, how far it may be off, on which side of 1 it is, and that no other one is 1.
Does not: say anything of the points where that is not clear.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.eigen.eigenpairs import driving_parts
from apc.eigen.enclosure import SMALL, enclose_stack
from apc.eigen.relative import relative_bounded
from apc.eigen.spectrum import LEAST_SHARE, STRAIGHT
from apc.frame.course import turns
from apc.frame.radius import UNIT
from apc.vary.batch import BatchEvaluator, Bounded
from apc.vary.wiring import LoopStructure

Floats = NDArray[np.float64]
Complexes = NDArray[np.complex128]
Places = NDArray[np.intp]
Truths = NDArray[np.bool_]

# A radius less certain than this, or than this part of it where it is above 1, an analysis often knows
# better: its exponentials are balls.
SHARP = 1e-11

# The largest has to be larger than all others by this share of it.
APART = 1e-6


@dataclass(frozen=True, slots=True, eq=False)
class DrivingPart:
    """States of a system that drive each other: its eigenvalues are those of its parts.

    `states` are their places among the relative coordinates.
    """

    system: int
    states: Places


@dataclass(frozen=True, slots=True, eq=False)
class Leading:
    """The largest eigenvalue at k points, of a pair the one above; its bound, and its mode's motion.

    `certain` says where all of it is so; the rest means nothing elsewhere.
    """

    radius: Floats
    error: Floats
    frequency_hz: Floats
    damping_ratio: Floats
    certain: Truths


def parts_of(evaluator: BatchEvaluator) -> tuple[tuple[DrivingPart, ...], tuple[Truths, ...]]:
    """Return the parts of all systems, and which entries (n, n) of each one's matrix may be other than 0."""
    patterns, parts = [], []
    for place, wiring in enumerate(evaluator.wirings):
        matrix, error = relative_bounded(wiring.system.matrix, wiring.system.error, wiring.relative)
        size = np.abs(matrix) + error
        patterns.append(size != 0)
        parts += [DrivingPart(place, states) for states in driving_parts(size != 0)]
    return tuple(parts), tuple(patterns)


def leading(
    evaluator: BatchEvaluator, parts: Sequence[DrivingPart], systems: Sequence[Bounded], count: int
) -> Leading:
    """Find the largest eigenvalue of the whole.

    Parameters
    ----------
    evaluator, parts
        Whose systems these are, and their parts.
    systems
        The systems at k points; what is the same at all of them may be there once.
    count
        k.
    """
    with np.errstate(all="ignore"):
        return _leading(evaluator, parts, systems, count)


def _leading(
    evaluator: BatchEvaluator, parts: Sequence[DrivingPart], systems: Sequence[Bounded], count: int
) -> Leading:
    enclosed = []
    for part in parts:
        system = systems[part.system]
        # What is the same at all points is there once.
        block, off = (_block(whole, part.states) for whole in (system.matrix, system.error))
        enclosed.append(enclose_stack(*np.broadcast_arrays(block, off)))
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
    # A mode that is over in a frame is another matter.
    certain = (error <= SHARP * np.maximum(radius, 1.0)) & (radius > SMALL) & (others < radius * (1 - APART))
    # Where it grows, an eigenvalue of 1 may be another rigid motion.
    certain &= (radius + error < 1 - 4 * UNIT) | ((radius - error > 1 + 4 * UNIT) & clear.all(axis=0))
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
    return Leading(
        radius=radius,
        error=error * (1 + 4 * UNIT) + 4 * UNIT * radius,
        frequency_hz=np.abs(rate.imag) / (2 * np.pi),
        damping_ratio=-rate.real / np.abs(rate),
        certain=certain & ~np.isnan(angle),
    )


def _block(matrix: Floats, states: Places) -> Floats:
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
    """Return by how much modes turn in a frame (k,), see `spectrum.angles_in_frame`; NaN if it isn't clear.

    Parameters
    ----------
    wiring, bounded, part
        A system at k points, and the part of it whose modes these are.
    values, right, left
        The eigenvalues (k,) and their vectors (k, m) over the part.
    """
    system, at = wiring.system, wiring.relative
    count = len(values)
    vectors, covectors = np.zeros((2, count, len(system.names)), dtype=np.complex128)
    vectors[:, at.rest[part.states]], covectors[:, at.rest[part.states]] = right, left
    if len(at.held):
        whole = np.broadcast_to(bounded.whole, (count, *bounded.whole.shape[1:]))
        coupled = whole[:, at.held[:, None], at.rest]
        corner = whole[:, at.held[:, None], at.held] + coupled @ at.weights
        shifted = values[:, None, None] * np.eye(len(at.held)) - corner
        driven = coupled @ vectors[:, at.rest, None]
        try:
            vectors[:, at.held] = np.linalg.solve(shifted, driven)[:, :, 0]
        except np.linalg.LinAlgError:
            return np.full(count, np.nan)
        vectors[:, at.rest] += vectors[:, at.held] @ at.weights.T
        covectors[:, at.held] = -covectors[:, at.rest] @ at.weights
    shares = np.abs(vectors * covectors)
    motion = np.array(system.motion, dtype=np.intp)
    result = np.full(count, np.nan)
    if not len(motion):
        return result
    leads = motion[shares[:, motion].argmax(axis=1)]
    moving = shares[np.arange(count), leads] > LEAST_SHARE * shares.sum(axis=1)
    site_of = np.searchsorted(system.offsets, leads, side="right") - 1
    for g, (group, offset) in enumerate(zip(system.sites, system.offsets, strict=True)):
        own = np.flatnonzero(moving & (site_of == g))
        if not len(own):
            continue
        here = bounded.at(own)
        start = vectors[own, offset : offset + len(group.z_names)]
        received = (here.heard[g] @ vectors[own, :, None])[:, :, 0]
        states = leads[own] - offset
        result[own] = turns(here.sites[g], group.schedule, start, received, states, values[own])
    return result
