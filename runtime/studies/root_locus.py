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

from apc.analysis.analysis import analyze
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.lifting.numeric_model import NumericModel, numeric_model
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, find
from apc.studies.evaluator import evaluator_of_many
from apc.studies.evaluator_choice import EvaluatorKind, evaluator_for
from apc.studies.parameter_path import matrix_sample
from apc.support.threads import single_threaded

if TYPE_CHECKING:
    from apc.studies.critical_values import Critical

POINTS = 100  # number of samples
BEYOND = 2.0  # end of the range, relative to the largest of the present and critical values


@dataclass(frozen=True, slots=True, eq=False)
class Locus:
    """The eigenvalues along a parameter: `eigenvalues[k]` (n_k,) at the value `values[k]` in SI.

    `now` are the eigenvalues at the present value; `critical` contains the parameter and its critical values.
    """

    critical: Critical
    frame_s: float
    values: NDArray[np.float64]
    eigenvalues: tuple[NDArray[np.complex128], ...]
    now: NDArray[np.complex128]


@part("locus")
def root_locus(model: Model, critical: Critical) -> Locus:
    """Return the eigenvalues of a model over the range of a search for critical values.

    Parameters
    ----------
    model
        The compiled model, with all other parameters fixed.
    critical
        The critical values of the parameter that is varied.
    """
    parameter_ref = find(model, critical.parameter, counts=True)
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
    numeric = numeric_model(model)
    analysis = analyze(numeric)
    now = np.array([mode.eigenvalue for mode in analysis.modes])
    indices, eigenvalues = eigenvalues_at(numeric, parameter_ref, values.tolist())
    return Locus(critical, analysis.frame_s, values[indices], eigenvalues, now)


def eigenvalues_at(
    numeric: NumericModel, parameter_ref: ParameterRef, values: Sequence[Fraction | float]
) -> tuple[list[int], tuple[NDArray[np.complex128], ...]]:
    """Return the indices of the values at which eigenvalues exist, and the eigenvalues at each of them.

    Parameters
    ----------
    numeric
        The model with its parameter values; all other parameters keep them.
    parameter_ref
        The parameter; each value of a time or a number of peers is analysed separately, as it changes the
        frame.
    values
        The values of the parameter in SI.
    """
    choice = evaluator_for(numeric, [parameter_ref])
    if choice.kind is not EvaluatorKind.MATRICES or choice.smooth is None:
        return _by_analyses(numeric, parameter_ref, values)
    with single_threaded(), np.errstate(all="ignore"):
        evaluator = evaluator_of_many(choice.smooth, [parameter_ref], SourceLocation(parameter_ref.label))
        all_values, _ = matrix_sample(evaluator, np.array(values, np.float64)[:, None], 0)
    indices = np.flatnonzero(np.isfinite(all_values).all(axis=1)).tolist()
    return indices, tuple(all_values[indices])


def _by_analyses(
    numeric: NumericModel, parameter_ref: ParameterRef, values: Sequence[Fraction | float]
) -> tuple[list[int], tuple[NDArray[np.complex128], ...]]:
    """Return the same results as `eigenvalues_at`, by one analysis per value."""
    indices, eigenvalues = [], []
    for index, value in enumerate(values):
        try:
            modes = analyze(
                numeric.at(apply(numeric.model, [Override(parameter_ref, Fraction(value))]))
            ).modes
        except ApcError:
            continue  # for example a delay that an order of events excludes
        indices.append(index)
        eigenvalues.append(np.array([mode.eigenvalue for mode in modes], np.complex128))
    return indices, tuple(eigenvalues)
