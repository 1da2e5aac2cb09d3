"""Critical values: the values of one parameter at which a model becomes stable or unstable.

Takes: a `Model` and the name of a parameter or delay.
Gives: `Critical`, `critical`.
Guarantees: every crossing comes with a bound on its error, from analyses on both sides; the result includes
the scanned range and its resolution.
Does not: prove that there are no further crossings, or separate two within one cell width (see
`crossing.CELL`).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Unpack

import numpy as np

from apc.analysis.analysis import analyze, near_start
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.compiler.wording import with_unit
from apc.haptics.absolute_stability import absolute_stability
from apc.lifting.devices import replaced_hands
from apc.lifting.numeric_model import NumericModel, delay_search_refused, numeric_model
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.parameter_values.display_units import as_shown
from apc.parameter_values.parameter_names import (
    ParameterRef,
    find,
    parameter_of,
    unit_of,
    value_now,
    values_by_group,
)
from apc.result import PlotStyle, Result
from apc.spectrum.peer_classes import states_of
from apc.studies.clock_periods import NominalPeriodPath, PeriodPath
from apc.studies.count_range import count_range
from apc.studies.crossing import (
    CELL,
    Crossing,
    CrossingReport,
    ParameterPath,
    Progress,
    Verdict,
    search,
    stable_in_all,
)
from apc.studies.delay_segments import delay_progress
from apc.studies.evaluator import (
    evaluator_of_many,
    many_packets,
    parameters_suffice,
    reaches_count,
    reaches_time,
)
from apc.studies.evaluator_choice import EvaluatorKind, evaluator_for, radius_evaluator
from apc.studies.parameter_path import (
    OPEN,
    SPAN,
    DelayPath,
    MatrixPath,
    PeerCountPath,
    delay_reach,
)
from apc.studies.stability_criteria import (
    MEAN_SQUARE,
    NOMINAL,
    NOWHERE,
    PASSIVE,
    SCALAR_CRITERIA,
    PointwisePath,
    criterion_of,
    line_points,
    refuse_timing_parameter,
    scale_of,
    verdict_with,
)
from apc.studies.timing_values import MOST_FRAME_TICKS, is_scaled, reaches_period, refuse_phase
from apc.support.option_value import option_value
from apc.support.state_limits import SEARCH_STATES
from apc.verdict import Sentence, Term

_LOCATION = SourceLocation("critical value")

# Errors of a frame of too many ticks, states or intervals.
TOO_LONG = ("E804", "E805", "E933")

# The limits of a search in SI, None where not given.
Ends = tuple[float | None, float | None]

# Without a limit, a delay is searched over at least this number of segments between coincidences of events,
# and up to this multiple of its present value.
PIECES, FURTHER = 64, 2


class ConstantReason(Term):
    """The reason why no value changes the verdict."""

    SCANNED = "at every evaluated value"
    NO_DAMPING = "at every value (reason: apc analyze --hands passive)"
    NO_EFFECT_AT_START = (
        "at the initial state, where this parameter has no effect (change the state by --set)"
    )
    NO_EFFECT = "at every value: the parameter does not affect stability"


@dataclass(frozen=True, slots=True)
class ConstantVerdict(Sentence):
    """The common verdict of all evaluated values, undecided if `stable` is None."""

    stable: bool | None
    reason: ConstantReason

    @property
    def word(self) -> str:
        """The verdict as one word."""
        return {True: "stable", False: "unstable", None: "undecided"}[self.stable]

    def __str__(self) -> str:
        """Return the verdict with its reason."""
        return f"{self.word} {self.reason}"


@dataclass(frozen=True, slots=True)
class Critical(Result):
    """The critical values of one parameter, with all others fixed.

    `crossings` are all crossings found from `searched_to[0]` to `searched_to[1]`, in order. `value` is the
    relevant crossing: for a stable present value, the first crossing above it, or else the first below it;
    for an unstable one, the lowest crossing at which stability is lost, or else the lowest. It is None
    without a crossing; `verdict` is then that of the complete range. `evaluations` is the number of
    evaluations; cells with a possible further crossing were divided down to the relative width `cell`.
    `has_effect` states whether the verdict can depend on the parameter: a start value of a linear model has
    no effect. `undecided` and `isolated` are those of `crossing.CrossingReport`. `counted` states that the
    parameter is a number of peers: the value of a crossing is then the number on its stable side.
    `limitations` are the limitations of the result. `groups` are the groups' present values (None if the
    values of a group differ) of a parameter that is set for all groups although they differ. `model` is the
    model.
    """

    shown_by = "parameter_studies_output:critical"
    pictured = False  # a figure takes a hundred analyses

    topology: str
    parameter: str
    unit: str
    current: float
    value: float | None
    error: float | None
    stable_side: str | None
    crossings: tuple[Crossing, ...]
    searched_to: tuple[float, float]
    cell: float
    complete: bool
    evaluations: int
    has_effect: bool
    verdict: ConstantVerdict | None
    model: Model = field(compare=False, repr=False)
    limitations: tuple[str, ...] = ()
    criterion: str = NOMINAL
    groups: tuple[tuple[str, float | None], ...] = ()
    counted: bool = False
    undecided: tuple[tuple[float, float], ...] = ()
    isolated: tuple[float, ...] = ()

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Draw the root locus over the parameter in the style `look`; return the matplotlib Axes.

        Raises
        ------
        ApcError
            E930 the criterion is every passive hand; E875 matplotlib is not installed.
        """
        if self.criterion == PASSIVE:
            message = "the criterion of passive hands has no eigenvalues, so there is no root locus"
            raise ApcError(Diagnostic("E930", SourceLocation(self.topology), message))
        return self._plotted(ax, style=style)


@part("critical")
def critical(
    model: Model,
    name: str,
    *,
    lower: str | Fraction | None = None,
    upper: str | Fraction | None = None,
    criterion: str | None = None,
    progress: Progress | None = None,
) -> Critical:
    """Return the values of a parameter at which a model becomes stable or unstable.

    Parameters
    ----------
    model
        The compiled model; all other parameters keep its values.
    name
        The parameter or delay, of one group or of all (see `parameter_names.find`).
    lower, upper
        The limits of the search, as quantities such as "5000 N/m" or in SI units. The default of `lower` is
        the minimum of the parameter, or 0 (for a negative value, `SPAN` times the value); the default of
        `upper` is `SPAN` times the present value (for a delay, the end by `parameter_path.delay_reach`).
    criterion
        "mean-square": convergence of second moments over the given network; "nominal": every packet on
        time; "passive": with any passive hand at every device. None: mean square if a link is unreliable,
        otherwise nominal.
    progress
        Receives the progress of the search.

    Raises
    ------
    ApcError
        E622 an unknown parameter, E623 the number of peers, E842 an empty range, E843 a limit out of the
        parameter's bounds, E844 a phase, or periods whose frames are all too long, E845 a delay of a
        nonlinear model, E896 a number of an unreliable link; and the errors of `units.quantity`.
    """
    parameter_ref = find(model, name.strip(), _LOCATION, counts=True)
    chosen_criterion = criterion_of(model, criterion, _LOCATION, [parameter_ref])
    by_growth = chosen_criterion in SCALAR_CRITERIA
    if not by_growth:
        refuse_channel_number(model, parameter_ref, _LOCATION, instead=f"--criterion {MEAN_SQUARE}")
    with evaluating(model):
        timed = reaches_time(model, parameter_ref)
        unit = unit_of(model, parameter_ref.name)
        current = value_now(model, parameter_ref)
        limits = [_limit(*pair, parameter_ref, unit) for pair in (("--lower", lower), ("--upper", upper))]
        _check_limits(model, parameter_ref, limits, timed=timed)
        numeric = numeric_model(model)

        def stable_of(changed: Model) -> bool | None:
            """Return whether a model is stable by the criterion, None if undecided."""
            if by_growth:
                return verdict_with(numeric.at(changed), [], _LOCATION, criterion=chosen_criterion).stable
            return analyze(numeric.at(changed)).stable

        result = _search_by_criterion(numeric, parameter_ref, chosen_criterion, limits, stable_of, progress)

        def stable_now() -> bool | None:
            """Return whether the model is stable with the present value."""
            return stable_of(model)

        relevant = _relevant_crossing(result, current, stable_now)
        start_limitations = near_start(numeric)
        verdict = (
            None
            if relevant
            else _constant_verdict(result, current, stable_now, chosen_criterion, start_limitations)
        )
    return Critical(
        topology=model.name,
        parameter=parameter_ref.label,
        unit=unit,
        current=current,
        value=relevant.value if relevant else None,
        error=relevant.error if relevant else None,
        stable_side=relevant.stable_side if relevant else None,
        crossings=result.crossings,
        searched_to=result.searched_to,
        cell=CELL,
        complete=result.complete,
        evaluations=result.evaluations,
        has_effect=result.has_effect,
        verdict=verdict,
        model=model,
        limitations=(
            *start_limitations,
            *_ranges_of_long_frames(model, parameter_ref, limits, result.searched_to),
            *limitations(model, network=chosen_criterion != MEAN_SQUARE, varied=[parameter_ref]),
            *(replaced_hands(model) if chosen_criterion == PASSIVE else ()),
        ),
        criterion=chosen_criterion,
        groups=values_by_group(model, parameter_ref),
        counted=reaches_count(model, parameter_ref),
        undecided=result.undecided,
        isolated=result.isolated,
    )


def _ranges_of_long_frames(
    model: Model,
    parameter_ref: ParameterRef,
    limits: Sequence[Fraction | None],
    searched_to: tuple[float, float],
) -> Iterator[str]:
    """Yield the ends of a requested range of periods that were not searched, as no frame there is short."""
    (low, high), (first, last) = limits, searched_to
    if not reaches_period(model, parameter_ref) or is_scaled(model, parameter_ref):
        return
    unit = str(unit_of(model, parameter_ref.name))
    for begin, end in ((low, first), (last, high)):
        if begin is not None and end is not None and float(begin) < float(end):
            factor, shown = as_shown(float(end), unit)
            span = with_unit(f"{float(begin) * factor:.6g} to {float(end) * factor:.6g}", shown)
            yield f"{span} not searched: no value tried there has a frame of at most {MOST_FRAME_TICKS} ticks"


def _search_by_criterion(
    numeric: NumericModel,
    parameter_ref: ParameterRef,
    criterion: str,
    limits: Sequence[Fraction | None],
    stable_of: Callable[[Model], bool | None],
    progress: Progress | None,
) -> CrossingReport:
    """Return the crossings along a parameter, by the path that suits the parameter and the criterion.

    Parameters
    ----------
    numeric, parameter_ref
        The model with its parameter values, and the parameter that varies.
    criterion
        One of `NOMINAL`, `MEAN_SQUARE` and `PASSIVE`.
    limits
        The ends in SI, None if not given.
    stable_of
        The function from a model to its stability by the criterion.
    progress
        The receiver of progress texts.
    """
    model = numeric.model
    choice = evaluator_for(numeric, [parameter_ref], criterion)
    low, high = (None if limit is None else float(limit) for limit in limits)
    ends = low, high
    paths: list[ParameterPath]
    reported = progress

    if choice.kind is EvaluatorKind.COUNTS:
        counts = count_range(model, parameter_ref, limits, value_now(model, parameter_ref), _LOCATION)
        paths = [PeerCountPath(parameter_ref, model, stable_of, *counts)]
    elif choice.kind is EvaluatorKind.PERIODS:
        if criterion == MEAN_SQUARE and not is_scaled(model, parameter_ref):
            refuse_timing_parameter(model, parameter_ref, _LOCATION, criterion)

        def decide(changed: Model) -> Verdict:
            """Return the verdict of a model by a scalar criterion.

            The verdict is undecided if the frame is too long or overflows.
            """
            try:
                return verdict_with(numeric.at(changed), [], _LOCATION, criterion=criterion)
            except ApcError as error:
                # A frame may be too long, or overflow; an error at every value is raised.
                if changed is model or error.mistakes[0].code not in (*NOWHERE, *TOO_LONG):
                    raise
                return OPEN

        arguments = parameter_ref, model, limits[0], limits[1], _LOCATION
        if criterion in SCALAR_CRITERIA:
            decide(model)
            paths = [PeriodPath(*arguments, decide)]
        else:
            paths = [NominalPeriodPath(*arguments, numeric)]
    elif criterion in SCALAR_CRITERIA:
        refuse_timing_parameter(model, parameter_ref, _LOCATION, criterion)
        paths = [_pointwise_path(numeric, parameter_ref, ends, criterion)]
    elif choice.kind is EvaluatorKind.DELAYS:
        refuse_phase(model, parameter_ref, _LOCATION)
        if not choice.linearized:
            raise delay_search_refused(model)
        begin = limits[0] or Fraction(0)
        end = limits[1] or delay_reach(model, parameter_ref, begin, pieces=PIECES, further=FURTHER)[0]
        ended = delay_progress(model, parameter_ref, begin, end, location=_LOCATION, progress=progress)
        paths = [DelayPath(parameter_ref, start, begin, end, ended) for start in choice.linearized]
        reported = None
    elif choice.kind is EvaluatorKind.POINTS:
        paths = [_pointwise_path(numeric, parameter_ref, ends, NOMINAL)]  # all sides at each value
    else:
        paths = [_path_without_times(start, parameter_ref, ends) for start in choice.linearized]
    result = stable_in_all([search(path, progress=reported) for path in paths])
    if choice.kind is EvaluatorKind.MATRICES and not (result.classified or parameters_suffice(numeric)):
        # Contacts close or open within the range, and a contact mode is left out of the verdict.
        return search(_pointwise_path(numeric, parameter_ref, ends, NOMINAL), progress=progress)
    # If clamped devices are unstable, the verdict is equal at all values.
    clamped_unstable = criterion == PASSIVE and result.stable == (False,)
    if clamped_unstable and choice.kind is EvaluatorKind.POINTS and not absolute_stability(numeric).why:
        return replace(result, has_effect=True)
    return result


def _constant_verdict(
    search: CrossingReport,
    current: float,
    stable_now: Callable[[], bool | None],
    criterion: str,
    start_limitations: Sequence[str],
) -> ConstantVerdict:
    """Return the common verdict of all values, if no change was found.

    Parameters
    ----------
    search
        The report of the search, without crossings.
    current, stable_now
        The present value, and the function that returns whether the model is stable there.
    criterion
        The stability criterion.
    start_limitations
        The limitations of an analysis at the start values, empty for a linear model.
    """
    stable = search.stable[0] if search.stable else None
    if search.searched_to[0] <= current <= search.searched_to[1] and current not in search.isolated:
        # All samples have this verdict in floats; the analysis bounds the error.
        stable = stable if stable_now() == stable else None
    if search.has_effect:
        reason = ConstantReason.SCANNED
    elif criterion == PASSIVE and stable is False:
        reason = ConstantReason.NO_DAMPING
    else:
        reason = ConstantReason.NO_EFFECT_AT_START if start_limitations else ConstantReason.NO_EFFECT
    return ConstantVerdict(stable, reason)


def _path_without_times(numeric: NumericModel, parameter_ref: ParameterRef, ends: Ends) -> ParameterPath:
    """Return the path by matrices along a parameter that affects no time.

    If most states are packets, and the matrices too large, it is the path by analyses value by value.
    """
    parameter = parameter_of(numeric.model, parameter_ref)
    low, high = ends
    if many_packets(numeric) and max(map(states_of, numeric.schedules, numeric.subsystems)) > SEARCH_STATES:
        return _pointwise_path(numeric, parameter_ref, ends, NOMINAL)
    try:
        evaluator = evaluator_of_many(numeric, [parameter_ref], _LOCATION)
    except ApcError:
        if not many_packets(numeric):
            raise
        return _pointwise_path(numeric, parameter_ref, ends, NOMINAL)
    low = parameter.minimum if low is None else low
    path = MatrixPath(evaluator, numeric, np.array([parameter.value]), 0, low, high)
    if high is None and parameter.maximum is not None:
        return replace(path, top=min(SPAN * path.scale, parameter.maximum))
    return path


def _pointwise_path(
    numeric: NumericModel, parameter_ref: ParameterRef, ends: Ends, criterion: str
) -> PointwisePath:
    """Return the path along a parameter by analyses, value by value."""
    model = numeric.model
    points, least = line_points(model, parameter_ref, *ends, scale_of(model, parameter_ref))
    return PointwisePath(radius_evaluator(numeric, (parameter_ref,), _LOCATION, criterion), points, least)


def _limit(
    option: str, limit: str | Fraction | None, parameter_ref: ParameterRef, unit: str
) -> Fraction | None:
    """Return a limit of the search in SI from a text or a number; None without a limit."""
    if not isinstance(limit, str):
        return limit
    return option_value(option, limit, subject=parameter_ref.name, unit=unit)


def _check_limits(
    model: Model, parameter_ref: ParameterRef, limits: Sequence[Fraction | None], *, timed: bool
) -> None:
    """Raise ApcError for a limit out of bounds (E843), and for an empty range (E842).

    `limits` are the lower and the upper limit of the search, None if not given; `timed` states that the
    parameter is a time.
    """
    low, high = limits
    minimum = 0.0 if timed else parameter_of(model, parameter_ref).minimum
    maximum = None if timed else parameter_of(model, parameter_ref).maximum
    unit = "s" if timed else parameter_of(model, parameter_ref).unit
    for value in (low, high):
        if value is not None and timed and not value and reaches_period(model, parameter_ref):
            message = f"limit of {parameter_ref.name}"
            raise ApcError(Diagnostic("E843", _LOCATION, message, "more than 0 s", "0 s"))
        if value is not None and (
            (minimum is not None and value < minimum) or (maximum is not None and value > maximum)
        ):
            expected = (
                f"at least {minimum:g}" if minimum is not None and value < minimum else f"at most {maximum:g}"
            )
            message, got = f"limit of {parameter_ref.name}", with_unit(f"{float(value):g}", unit)
            raise ApcError(Diagnostic("E843", _LOCATION, message, with_unit(expected, unit), got))
    bottom = low if low is not None else (minimum or 0.0)
    if high is not None and not high > bottom:
        message, got = (
            f"range of {parameter_ref.name}",
            with_unit(f"{float(bottom):g} to {float(high):g}", unit),
        )
        raise ApcError(Diagnostic("E842", _LOCATION, message, "an upper limit above the lower", got))


def _relevant_crossing(
    search: CrossingReport, current: float, stable_now: Callable[[], bool | None]
) -> Crossing | None:
    """Return the relevant crossing (see `Critical`).

    The verdict at a jump decides the side of a present value there.
    """
    if not search.crossings:
        return None
    below = sum(crossing.boundary < current for crossing in search.crossings)
    not_above = sum(crossing.boundary <= current for crossing in search.crossings)
    if not_above > below and search.stable[below] != stable_now():
        below = not_above
    if search.stable[below]:
        return search.crossings[below] if below < len(search.crossings) else search.crossings[below - 1]
    losses = [crossing for crossing in search.crossings if crossing.stable_side == "below"]
    return losses[0] if losses else search.crossings[0]
