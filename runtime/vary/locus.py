"""Where the eigenvalues of a scene go as one of its numbers grows: the root locus, in the plane of z.

Takes: a `Model` and a `Critical` of it. Gives: `Locus`, `root_locus`; `eigenvalues_at`.
Guarantees: every point is an eigenvalue of the frame with that value, what is rigid at every value left out,
every packet on time; a value that the scene can't have is left out.
Does not: prove anything; the crossings are those of `critical`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from fractions import Fraction
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze, prepare_at_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.frame.instance import Prepared, prepare
from apc.frame.names import ParameterRef, find
from apc.frame.overrides import Override, apply
from apc.threads import single_threaded
from apc.vary.evaluator import evaluator_of_many, reaches_count, reaches_time
from apc.vary.line import matrix_look

if TYPE_CHECKING:
    from apc.vary.critical_values import Critical

POINTS = 100  # values looked at
BEYOND = 2.0  # times what matters most is looked up to: the present value, and where stability changes


@dataclass(frozen=True, slots=True, eq=False)
class Locus:
    """Eigenvalues by value: `eigenvalues[k]` (n_k,) are those at `values[k]`, in SI; `now` the present ones.

    `critical` says which parameter it is, and where stability changes.
    """

    critical: Critical
    frame_s: float
    values: NDArray[np.float64]
    eigenvalues: tuple[NDArray[np.complex128], ...]
    now: NDArray[np.complex128]


@part("locus")
def root_locus(system: Model, critical: Critical) -> Locus:
    """Follow the eigenvalues of a scene over the values at which its stability was looked at.

    Parameters
    ----------
    system
        The compiled scene, all other numbers as they are.
    critical
        What `critical` says of one of its parameters: that one is varied.
    """
    free = find(system, critical.parameter, counts=True)
    low, high = critical.scanned
    most = max(
        [
            abs(critical.present),
            *(crossing.value for crossing in critical.crossings[:1]),
            critical.value or 0.0,
        ]
    )
    high = min(high, BEYOND * most) if most > low else high
    values = np.linspace(low, high, POINTS)
    if critical.counted:
        values = np.unique(np.round(values))
    prepared = prepare(system)
    analysis = analyze(system, prepared=prepared)
    now = np.array([mode.eigenvalue for mode in analysis.modes])
    places, eigenvalues = eigenvalues_at(system, free, values.tolist(), prepared=prepared)
    return Locus(critical, analysis.frame_s, values[places], eigenvalues, now)


def eigenvalues_at(
    system: Model, free: ParameterRef, values: Sequence[Fraction | float], *, prepared: Prepared
) -> tuple[list[int], tuple[NDArray[np.complex128], ...]]:
    """Return which values of a parameter have eigenvalues, by their places, and the eigenvalues of each.

    Parameters
    ----------
    system
        The compiled scene, all other numbers as they are.
    free
        The parameter; of a time or a number of peers, with which the frame itself is another, each value is
        analysed by itself.
    values
        Its values, SI.
    prepared
        From `instance.prepare`, of this system with any numbers.
    """
    start = prepare_at_start(system, prepared, [free])
    if start is None or reaches_count(system, free) or reaches_time(system, free):
        return _one_by_one(system, free, values, prepared)
    with single_threaded(), np.errstate(all="ignore"):
        family = evaluator_of_many(system, [free], SourceLocation(free.label), prepared=start)
        every, _ = matrix_look(family, np.array(values, np.float64)[:, None], 0)
    places = np.flatnonzero(np.isfinite(every).all(axis=1)).tolist()
    return places, tuple(every[places])


def _one_by_one(
    system: Model, free: ParameterRef, values: Sequence[Fraction | float], prepared: Prepared
) -> tuple[list[int], tuple[NDArray[np.complex128], ...]]:
    """Return the same by an analysis each."""
    places, eigenvalues = [], []
    for place, value in enumerate(values):
        try:
            modes = analyze(apply(system, [Override(free, Fraction(value))]), prepared=prepared).modes
        except ApcError:
            continue  # a delay, for one, that an order of events allows no more
        places.append(place)
        eigenvalues.append(np.array([mode.eigenvalue for mode in modes], np.complex128))
    return places, tuple(eigenvalues)
