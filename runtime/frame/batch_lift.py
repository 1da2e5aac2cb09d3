"""One frame of many sites of one kind as linear maps, all at once.

Takes: the Jacobians of a kind, a `Schedule`, and the matrices of many sites as rows (see `linearize_rows`);
or those of many sites as one `LinearSite`.
Gives: `lift_rows`, `lift_sites`.
Guarantees: the maps are those of `lift`, to rounding; every matrix comes with a bound on its error, entry by
entry, wider than that of `lift`, as no ball arithmetic is done.
Does not: decide which sites are alike (see `peers`), or close a loop (see `populations`).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from apc.frame.discretize import UNIT, Step, step_rows
from apc.frame.jacobians import SiteJacobians
from apc.frame.lift import (
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
    """
    check_packets(schedule)
    parts = [
        lift_sites(sites_of_rows(site, rows[start : start + CHUNK]), schedule)
        for start in range(0, len(rows), CHUNK)
    ]
    whole, error = (_joined(maps) for maps in (parts, [one.error for one in parts]))
    return named(site.kind, schedule, whole, error, estimated=any(one.estimated for one in parts))


def lift_sites(sites: LinearSite, schedule: Schedule) -> LiftedSite:
    """Compose the events of a frame for many sites, few enough for their maps to be at hand at once.

    Parameters
    ----------
    sites
        Their matrices (k, …).
    schedule
        What happens in a frame.

    Notes
    -----
    As in `lift`, errors multiply along the composition of magnitudes; a step of `step_rows` counts
    with the roundings it reports. Where stiffness and damping nearly cancel over many ticks that grows
    without measure, whatever the errors are: beyond `HOPELESS` they are estimated, see `_perturbed`.
    """
    steps = {
        duration: step_rows(sites.a, sites.b, float(duration * schedule.quantum))
        for duration in step_durations(schedule)
    }
    frame, error = bounded(sites, schedule, steps)
    if estimated := not (error.largest <= HOPELESS).all():
        error = _perturbed(sites, schedule, steps, frame)
    return named(sites.kind, schedule, frame, error, estimated=estimated)


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
