"""Root locus: the eigenvalues of a model in the z-plane along one of its parameters.

Takes: a `Model` and a `Critical` of it. Gives: `Locus`, `root_locus`; `eigenvalues_at`.
Guarantees: every point is an eigenvalue of the frame with that value, without modes that are rigid at every
value, with every packet on time; invalid values are left out.
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
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, find
from apc.parameter_studies.evaluator import evaluator_of_many, reaches_count, reaches_time
from apc.parameter_studies.parameter_path import matrix_sample
from apc.threads import single_threaded

if TYPE_CHECKING:
    from apc.parameter_studies.critical_values import Critical

POINTS = 100  # number of samples
BEYOND = 2.0  # end of the range, relative to the largest of the present and critical values


@dataclass(frozen=True, slots=True, eq=False)
class Locus:
    """Eigenvalues by value: `eigenvalues[k]` (n_k,) at `values[k]`, in SI; `now` the present ones.

    `critical` names the parameter and its critical values.
    """

    critical: Critical
    frame_s: float
    values: NDArray[np.float64]
    eigenvalues: tuple[NDArray[np.complex128], ...]
    now: NDArray[np.complex128]


@part("locus")
def root_locus(system: Model, critical: Critical) -> Locus:
    """Return the eigenvalues of a model over the range of a search for critical values.

    Parameters
    ----------
    system
        The compiled model, with all other parameters fixed.
    critical
        The critical values of the parameter that is varied.
    """
    free = find(system, critical.parameter, counts=True)
    low, high = critical.searched_to
    most = max(
        [
            abs(critical.current),
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
    indices, eigenvalues = eigenvalues_at(system, free, values.tolist(), prepared=prepared)
    return Locus(critical, analysis.frame_s, values[indices], eigenvalues, now)


def eigenvalues_at(
    system: Model, free: ParameterRef, values: Sequence[Fraction | float], *, prepared: Prepared
) -> tuple[list[int], tuple[NDArray[np.complex128], ...]]:
    """Return the values of a parameter that have eigenvalues, by index, and the eigenvalues of each.

    Parameters
    ----------
    system
        The compiled model, with all other parameters fixed.
    free
        The parameter; for a time or a number of peers, which change the frame itself, each value is analysed
        separately.
    values
        Its values, SI.
    prepared
        From `numeric_model.prepare`, of this model with any values.
    """
    start = prepare_at_start(system, prepared, [free])
    if start is None or reaches_count(system, free) or reaches_time(system, free):
        return _pointwise(system, free, values, prepared)
    with single_threaded(), np.errstate(all="ignore"):
        family = evaluator_of_many(system, [free], SourceLocation(free.label), prepared=start)
        every, _ = matrix_sample(family, np.array(values, np.float64)[:, None], 0)
    indices = np.flatnonzero(np.isfinite(every).all(axis=1)).tolist()
    return indices, tuple(every[indices])


def _pointwise(
    system: Model, free: ParameterRef, values: Sequence[Fraction | float], prepared: Prepared
) -> tuple[list[int], tuple[NDArray[np.complex128], ...]]:
    """Return the same by one analysis per value."""
    indices, eigenvalues = [], []
    for index, value in enumerate(values):
        try:
            modes = analyze(apply(system, [Override(free, Fraction(value))]), prepared=prepared).modes
        except ApcError:
            continue  # for example a delay that an order of events excludes
        indices.append(index)
        eigenvalues.append(np.array([mode.eigenvalue for mode in modes], np.complex128))
    return indices, tuple(eigenvalues)
