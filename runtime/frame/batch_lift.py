"""One frame of many sites of one kind as linear maps, all at once.

Takes: the Jacobians of a kind, a `Schedule`, and the matrices of many sites as rows (see `linearize_rows`).
Gives: `lift_rows`; `exponential_rows`.
Guarantees: the maps are those of `lift`, to rounding; every matrix comes with a bound on its error, entry by
entry, wider than that of `lift`, as no ball arithmetic is done.
Does not: decide which sites are alike (see `peers`), or close a loop (see `populations`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT, Step
from apc.frame.jacobians import SiteJacobians
from apc.frame.lift import (
    COEFFICIENT_ROUNDINGS,
    FrameMap,
    LiftedSite,
    bounded,
    check_packets,
    compose,
    named,
    roundings_of,
    step_durations,
)
from apc.frame.linearize import sites_of_rows
from apc.frame.schedule import Schedule
from apc.frame.site import LinearSite, every_matrix

Floats = NDArray[np.float64]
Matrix = NDArray[Any]  # float64 or complex128

# Sites composed together: their matrices then stay in the cache of a processor.
CHUNK = 2048

# A bound on a frame's rounding errors above this decides nothing: they are estimated then.
HOPELESS = 1e-6

# From so many frames of numbers moved at random by all roundings of a frame at once: SAFE times the largest
# change. A change is nearly a normal number, below 1/SAFE of its standard deviation in one frame of 10, so in
# all of 8 once in 10⁸. Of 46,656 entries (1,080 sites with copies of 10 mg to 1 g, against 80 digits) the
# error was at most a third of this estimate; of two frames, it was beyond it in 49, up to three times.
PERTURBED_FRAMES, SAFE = 8, 8.0

# With ‖X‖ ≤ 1/2 the Taylor series of φ₁ is right to 2^−60 after so many terms: (1/2)^16/17! < 2^−64.
TERMS = 16


def lift_rows(site: SiteJacobians, schedule: Schedule, rows: Floats) -> LiftedSite:
    """Compose the events of a frame for many sites of one kind and schedule.

    Parameters
    ----------
    site
        The kind's Jacobians.
    schedule
        What happens in a frame.
    rows
        The sites' matrices (k, …), from `linearize_rows`.

    Notes
    -----
    As in `lift`, errors multiply along the composition of magnitudes; a step of `exponential_rows` counts
    with the roundings it reports. Where stiffness and damping nearly cancel over many ticks that grows
    without measure, whatever the errors are: beyond `HOPELESS` they are estimated, see `_perturbed`.
    """
    check_packets(schedule)
    parts: list[tuple[FrameMap, FrameMap]] = []
    estimated = False
    for start in range(0, len(rows), CHUNK):
        many = sites_of_rows(site, rows[start : start + CHUNK])
        steps = {
            duration: exponential_rows(many.a, many.b, float(duration * schedule.quantum))
            for duration in step_durations(schedule)
        }
        frame, error = bounded(many, schedule, steps)
        if not (error.largest <= HOPELESS).all():
            error, estimated = _perturbed(many, schedule, steps, frame), True
        parts.append((frame, error))
    frames, errors = zip(*parts, strict=True)
    return named(site.kind, schedule, _joined(frames), _joined(errors), estimated=estimated)


def _joined(frames: Sequence[FrameMap]) -> FrameMap:
    """Return the maps of several chunks of sites as those of all."""
    return frames[0].mapped(lambda *blocks: np.concatenate(blocks), *frames[1:])


def _perturbed(site: LinearSite, schedule: Schedule, steps: Mapping[int, Step], frame: FrameMap) -> FrameMap:
    """Estimate a frame's rounding errors: how much it moves when every number it is made of moves a little.

    Each number is moved at random by all the frame's roundings, a step by what its exponential may be off by
    as well.

    Parameters
    ----------
    site, schedule, steps
        What the frame is composed of.
    frame
        The frame as it came out.
    """
    random = np.random.default_rng(len(schedule.events))
    size = roundings_of(site, schedule, steps) * UNIT

    def moved(matrix: Matrix, by: Matrix | float = 0.0) -> Matrix:
        most = size * np.abs(matrix) + by
        return np.asarray(matrix + most * random.uniform(-1, 1, matrix.shape))

    error = frame.mapped(lambda block: size * np.abs(block))
    for _ in range(PERTURBED_FRAMES):
        other = compose(
            every_matrix(site, moved),
            schedule,
            {
                duration: moved(step.matrix, step.roundings * UNIT * step.size)
                for duration, step in steps.items()
            },
        )
        error = error.mapped(lambda e, a, b: np.maximum(e, SAFE * np.abs(a - b)), frame, other)
    return error


def exponential_rows(a: Matrix, b: Matrix, seconds: float) -> Step:
    """Return exp of many generators by scaling and squaring, x(t + T) = F x(t) + G u.

    Parameters
    ----------
    a, b
        A (k, n_x, n_x) and B (k, n_x, n_u), float64 or complex128, each entry right to
        `COEFFICIENT_ROUNDINGS` roundings.
    seconds
        T.

    Returns
    -------
    The steps of all of them, [F G] (k, n_x, n_x + n_u).

    Notes
    -----
    With X = A T/2^s, ‖X‖ ≤ 1/2, and Y = φ₁(X) by Horner's rule, F = I + X Y and G = Y B T/2^s; then
    s times F ← F², G ← F G + G. A rounding at the j-th step of Horner's rule reaches Y through X^(j−1)/j!,
    so that all of them together stay below n + 3 roundings of φ₁ of the magnitudes twice as large.
    """
    n_x, n_u = b.shape[-2:]
    x = a * seconds
    norm = float(np.abs(x).sum(axis=-2).max(initial=0.0))
    squarings = max(0, int(np.ceil(np.log2(norm))) + 1) if 0 < norm < np.inf else 0
    x, g = x * 2.0**-squarings, b * (seconds * 2.0**-squarings)
    phi, large = _phi(x), _phi(2 * np.abs(x))
    step = np.concatenate([np.eye(n_x) + x @ phi, phi @ g], axis=-1)
    charge = float(n_x + 6 + 2 * COEFFICIENT_ROUNDINGS)
    doubled = np.concatenate([np.eye(n_x) + 2 * np.abs(x) @ large, large @ np.abs(g)], axis=-1)
    error = (charge * UNIT) * doubled
    below = np.broadcast_to(np.eye(n_x + n_u)[n_x:], (*b.shape[:-2], n_u, n_x + n_u))
    for _ in range(squarings):
        whole, off = np.concatenate([step, below], axis=-2), np.concatenate([error, 0 * below], axis=-2)
        size = np.abs(whole)
        error = (size[..., :n_x, :] + error) @ off + error @ size
        error += (n_x + 2) * UNIT * (size[..., :n_x, :] @ size)
        step = step @ whole
    return Step(step, np.maximum(np.abs(step), error / (charge * UNIT)), charge)


def _phi(x: Matrix) -> Matrix:
    """Return φ₁(X) = I + X/2! + X²/3! + … of many small matrices."""
    unit = np.eye(x.shape[-1])
    found = unit + 0 * x
    for term in range(TERMS, 0, -1):
        found = unit + (x / (term + 1)) @ found
    return np.asarray(found)
