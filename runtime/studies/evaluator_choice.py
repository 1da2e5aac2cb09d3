"""The choice of the evaluator of a model's stability over some parameters.

Takes: a `NumericModel`, the parameters that vary, and a stability criterion.
Gives: `evaluator_for`, `radius_evaluator`, `EvaluatorChoice`, `EvaluatorKind`, `kind_for_parameter`.
Guarantees: one evaluator for each kind of parameters and criterion, the same in every study.
Does not: evaluate, or select the values of the parameters.
"""

from __future__ import annotations

import enum
from collections.abc import Sequence
from dataclasses import dataclass

from apc.analysis.analysis import prepare_at_start
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Model
from apc.compiler.errors import SourceLocation
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.parameter_names import ParameterRef
from apc.studies.evaluator import generic, reaches_count, reaches_time
from apc.studies.stability_criteria import MEAN_SQUARE, NOMINAL, SCALAR_CRITERIA, RadiusEvaluator
from apc.studies.timing_values import reaches_period


class EvaluatorKind(enum.Enum):
    """The kind of an evaluator."""

    MATRICES = "frame matrices of many values together, with slopes"
    POINTS = "one analysis, or one value of a scalar criterion, at each value"
    DELAYS = "segments between coincidences of events"
    PERIODS = "one frame length for each clock period"
    COUNTS = "one model for each number of peers"


@dataclass(frozen=True, slots=True)
class EvaluatorChoice:
    """The kind of evaluator of a model, and its linearized models.

    `linearized` are the models linearized at the start values, one for each side of a kink. It is empty for a
    scalar criterion, or if the linearization depends on more than the parameters. `smooth` is the linearized
    model of a start without kinks, None at a kink.
    """

    kind: EvaluatorKind
    linearized: tuple[NumericModel, ...]
    smooth: NumericModel | None


def kind_for_parameter(model: Model, parameter_ref: ParameterRef) -> EvaluatorKind:
    """Return the kind of evaluator that one parameter requires in an affine model."""
    if reaches_count(model, parameter_ref):
        return EvaluatorKind.COUNTS
    if not reaches_time(model, parameter_ref):
        return EvaluatorKind.MATRICES
    return EvaluatorKind.PERIODS if reaches_period(model, parameter_ref) else EvaluatorKind.DELAYS


def evaluator_for(
    numeric: NumericModel, parameter_refs: Sequence[ParameterRef], criterion: str = NOMINAL
) -> EvaluatorChoice:
    """Return the choice of the evaluator of a model's stability over some parameters.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    parameter_refs
        The parameters that vary. Numbers of peers determine the kind before periods, and periods before
        delays.
    criterion
        "nominal", "mean-square" or "passive".

    Raises
    ------
    ApcError
        As for `analysis.prepare_at_start`.
    """
    scalar = criterion in SCALAR_CRITERIA
    models = [] if scalar or _sides_change(numeric, parameter_refs) else [s.numeric for s in sides(numeric)]
    starts = [prepare_at_start(model, parameter_refs) for model in models]
    linearized = () if None in starts else tuple(start for start in starts if start is not None)
    smooth = linearized[0] if linearized and models[0] is numeric else None
    required = {kind_for_parameter(numeric.model, parameter_ref) for parameter_ref in parameter_refs}
    timed = [EvaluatorKind.COUNTS, EvaluatorKind.PERIODS, *([] if scalar else [EvaluatorKind.DELAYS])]
    untimed = EvaluatorKind.MATRICES if linearized else EvaluatorKind.POINTS
    return EvaluatorChoice(next((kind for kind in timed if kind in required), untimed), linearized, smooth)


def radius_evaluator(
    numeric: NumericModel,
    parameter_refs: Sequence[ParameterRef],
    location: SourceLocation,
    criterion: str = MEAN_SQUARE,
) -> RadiusEvaluator:
    """Return the evaluator of a criterion over some parameters, the arguments as its fields."""
    if criterion != MEAN_SQUARE:
        return RadiusEvaluator(numeric, tuple(parameter_refs), location, criterion)
    from apc.studies.moment_evaluator import moment_evaluator  # most models have an ideal network

    return moment_evaluator(numeric, parameter_refs, location)


def _sides_change(numeric: NumericModel, parameter_refs: Sequence[ParameterRef]) -> bool:
    """Return whether the start has more or fewer one-sided linear models at other values of the parameters.

    The sides of max(k x, l x) at x = 0 are one where k = l, and two at any other k.
    """
    model = numeric.model
    gains = [ref for ref in parameter_refs if kind_for_parameter(model, ref) is EvaluatorKind.MATRICES]
    return bool(gains) and len(sides(numeric.at(generic(model, gains)))) != len(sides(numeric))
