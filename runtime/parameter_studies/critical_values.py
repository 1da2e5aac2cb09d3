"""Critical values: the values of one parameter at which a model becomes stable or unstable.

Takes: a `Model` and the name of a parameter or delay.
Gives: `Critical`, `critical`.
Guarantees: every crossing comes with a bound on its error, from analyses on both sides; the result includes
the scanned range and its resolution.
Does not: prove that there are no others, or find two closer together than the cell width (see
`crossing.CELL`).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from fractions import Fraction
from typing import Any, Unpack

import numpy as np

from apc.analysis.analysis import analyze, near_start, prepare_at_start
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.timings import part
from apc.compiler.wording import with_unit
from apc.frame.devices import replaced_hands
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Prepared, delay_search_refused, prepare
from apc.frame.parameter_names import ParameterRef, find, parameter_of, unit_of, value_now, values_by_group
from apc.haptics.absolute_stability import absolute_stability
from apc.network.nominal_criterion import limitations, refuse_channel_number
from apc.option_value import option_value
from apc.parameter_studies.clock_periods import PeriodPath
from apc.parameter_studies.count_range import count_range
from apc.parameter_studies.crossing import (
    CELL,
    Crossing,
    CrossingReport,
    ParameterPath,
    Progress,
    Verdict,
    search,
    stable_in_all,
)
from apc.parameter_studies.delay_segments import delay_progress
from apc.parameter_studies.evaluator import (
    evaluator_of_many,
    many_packets,
    parameters_suffice,
    reaches_count,
    reaches_time,
)
from apc.parameter_studies.parameter_path import (
    OPEN,
    SPAN,
    DelayPath,
    MatrixPath,
    PeerCountPath,
    analyzed,
    delay_reach,
)
from apc.parameter_studies.stability_criteria import (
    MEAN_SQUARE,
    NOMINAL,
    NOWHERE,
    PASSIVE,
    SCALAR_CRITERIA,
    PointwisePath,
    RadiusEvaluator,
    criterion_of,
    line_points,
    refuse_time,
    verdict_with,
)
from apc.parameter_studies.timing_values import delay_now, is_scaled, reaches_period, refuse_phase
from apc.result import PlotStyle, Result
from apc.threads import single_threaded
from apc.verdict import Sentence, Term

_LOCATION = SourceLocation("critical value")

# Errors of a frame of too many ticks, states or intervals.
TOO_LONG = ("E804", "E805", "E933")

# The limits of a search in SI, None where not given.
Ends = tuple[float | None, float | None]

# Without a limit, a delay is searched over at least this number of segments, each from one coincidence of
# events to the next, and up to this multiple of its present value.
PIECES, FURTHER = 64, 2


class ConstantReason(Term):
    """Why no value was found at which the verdict changes."""

    SCANNED = "at every value scanned"
    NO_DAMPING = "whatever its value: apc analyze --hands passive says why"
    NO_EFFECT_AT_START = (
        "where the topology starts: there nothing depends on this number (--set may start it elsewhere)"
    )
    NO_EFFECT = "whatever its value: nothing that decides stability depends on it"


@dataclass(frozen=True, slots=True)
class ConstantVerdict(Sentence):
    """The one verdict of all values scanned, undecided if `stable` is None."""

    stable: bool | None
    reason: ConstantReason

    @property
    def word(self) -> str:
        """The verdict in a word."""
        return {True: "stable", False: "unstable", None: "undecided"}[self.stable]

    def __str__(self) -> str:
        """Return the verdict with its reason."""
        return f"{self.word} {self.reason}"


@dataclass(frozen=True, slots=True)
class Critical(Result):
    """The critical values of one parameter, with all others fixed.

    `crossings` are all that were found from `searched_to[0]` to `searched_to[1]`, in order. `value` is the
    relevant one: with the present value stable, the first crossing above it or else the first below it; with
    the present value unstable, the lowest crossing at which stability is lost or else the lowest. It is None
    when there is no crossing; `verdict` is then that of the complete range. `evaluations` is the number of
    evaluations; cells with a possible further crossing were divided down to the relative width `cell`.
    `has_effect` states whether the verdict can depend on the parameter: a start value of a linear model has
    no effect. `undecided` and `isolated` are those of `crossing.CrossingReport`. `counted` states that it is
    a number of peers: a crossing's value is then the number on its stable side. `limitations` are the
    limitations of the result. `groups` are the groups' present values (None where their peers differ) of a
    parameter that is set for all groups although they differ. `system` is the model.
    """

    shown_by = "parameter_studies_output:critical"
    pictured = False  # which takes a hundred analyses

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
    system: Model = field(compare=False, repr=False)
    limitations: tuple[str, ...] = ()
    criterion: str = NOMINAL
    groups: tuple[tuple[str, float | None], ...] = ()
    counted: bool = False
    undecided: tuple[tuple[float, float], ...] = ()
    isolated: tuple[float, ...] = ()

    def plot(self, ax: Any = None, **style: Unpack[PlotStyle]) -> Any:
        """Draw the root locus over the parameter, in style `sample_at`; return the matplotlib Axes.

        Raises
        ------
        ApcError
            E930 the criterion is every passive hand; E875 matplotlib is not installed.
        """
        if self.criterion == PASSIVE:
            message = "what every passive hand can draw has no eigenvalues: there is no root locus of it"
            raise ApcError(Diagnostic("E930", SourceLocation(self.topology), message))
        return self._plotted(ax, style=style)


@part("critical")
def critical(
    system: Model,
    name: str,
    *,
    lower: str | None = None,
    upper: str | None = None,
    criterion: str | None = None,
    progress: Progress | None = None,
) -> Critical:
    """Return the values of a parameter at which a model becomes stable or unstable.

    Parameters
    ----------
    system
        The compiled model; all other parameters keep its values.
    name
        The parameter or delay, of one group or of all (see `parameter_names.find`).
    lower, upper
        The limits of the search as quantities, such as "5000 N/m". The default of `lower` is the minimum of
        the parameter, or 0 (for a negative value, `SPAN` times it); that of `upper` is `SPAN` times the
        present value (for a delay, the end by `parameter_path.delay_reach`).
    criterion
        "mean-square": convergence of second moments over the network as given; "nominal": every packet on
        time; "passive": with every passive hand at every device. None: mean square where a link is
        unreliable.
    progress
        Receives the progress of the search.

    Raises
    ------
    ApcError
        E622 no such parameter, E623 the number of peers, E842 an empty range, E843 a limit out of the
        parameter's bounds, E844 a phase, or periods that all make too long a frame, E845 a delay of a model
        that is not linear, E896 a number of an unreliable link; and those of `units.quantity`.
    """
    free = find(system, name.strip(), _LOCATION, counts=True)
    chosen_criterion = criterion_of(system, criterion, _LOCATION, [free])
    by_growth = chosen_criterion in SCALAR_CRITERIA
    if not by_growth:
        refuse_channel_number(system, free, _LOCATION, instead=f"--criterion {MEAN_SQUARE}")
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        timed, counted = reaches_time(system, free), reaches_count(system, free)
        unit = unit_of(system, free.name)
        present = float(delay_now(system, free)) if timed else parameter_of(system, free).value
        limits = [_limit(*pair, free, unit) for pair in (("--lower", lower), ("--upper", upper))]
        _check_limits(system, free, limits, timed=timed)
        prepared = prepare(system)

        def stable_of(changed: Model) -> bool | None:
            if by_growth:
                return verdict_with(changed, prepared, [], _LOCATION, criterion=chosen_criterion).stable
            return analyze(changed, prepared=prepared).stable

        result = _searched(system, free, prepared, chosen_criterion, limits, stable_of, progress)

        def stable_now() -> bool | None:
            return stable_of(system)

        chosen = _chosen(result, present, stable_now)
        near = near_start(system, prepared)
        verdict = None if chosen else _everywhere(result, present, stable_now, chosen_criterion, near)
    return Critical(
        topology=system.name,
        parameter=free.label,
        unit=unit,
        current=present,
        value=chosen.value if chosen else None,
        error=chosen.error if chosen else None,
        stable_side=chosen.stable_side if chosen else None,
        crossings=result.edges,
        searched_to=result.searched_to,
        cell=CELL,
        complete=result.complete,
        evaluations=result.evaluations,
        has_effect=result.has_effect,
        verdict=verdict,
        system=system,
        limitations=(
            *near,
            *limitations(system, network=chosen_criterion != MEAN_SQUARE, varied=[free]),
            *(replaced_hands(system) if chosen_criterion == PASSIVE else ()),
        ),
        criterion=chosen_criterion,
        groups=values_by_group(system, free),
        counted=counted,
        undecided=result.undecided,
        isolated=result.isolated,
    )


def _searched(
    system: Model,
    free: ParameterRef,
    prepared: Prepared,
    criterion: str,
    limits: Sequence[Fraction | None],
    stable_of: Callable[[Model], bool | None],
    progress: Progress | None,
) -> CrossingReport:
    """Return the search along a parameter, by the evaluator that covers it.

    Parameters
    ----------
    system, free, prepared
        The compiled model, what varies, and the result of `numeric_model.prepare`.
    criterion
        One of `NOMINAL`, `MEAN_SQUARE` and `PASSIVE`.
    limits
        The ends in SI, None where not given.
    stable_of
        Returns the verdict of a topology.
    progress
        Receives reports.
    """
    present = (
        float(delay_now(system, free)) if reaches_time(system, free) else parameter_of(system, free).value
    )
    timed, counted = reaches_time(system, free), reaches_count(system, free)
    low, high = (None if limit is None else float(limit) for limit in limits)
    ends = low, high

    if counted:
        result = search(
            PeerCountPath(system, free, stable_of, *count_range(system, free, limits, present, _LOCATION)),
            progress=progress,
        )
    elif timed and reaches_period(system, free):
        if criterion == MEAN_SQUARE and not is_scaled(system, free):
            refuse_time(system, free, _LOCATION, criterion)

        def decide(changed: Model) -> Verdict:
            if criterion not in SCALAR_CRITERIA:
                return analyzed(changed, prepared)
            try:
                return verdict_with(changed, prepared, [], _LOCATION, criterion=criterion)
            except ApcError as error:
                # A frame may be too long, or overflow; an error at every value is raised.
                if changed is system or error.mistakes[0].code not in (*NOWHERE, *TOO_LONG):
                    raise
                return OPEN

        decide(system)
        result = search(PeriodPath(system, free, decide, limits[0], limits[1], _LOCATION), progress=progress)
    elif criterion in SCALAR_CRITERIA:
        refuse_time(system, free, _LOCATION, criterion)
        result = search(_singly(system, free, ends, prepared, criterion), progress=progress)
        if (
            criterion == PASSIVE
            and result.stable == (False,)
            and not absolute_stability(system, prepared).why
        ):
            result = replace(result, has_effect=True)  # where clamped devices shake all values are one
    elif timed:
        refuse_phase(system, free, _LOCATION)
        starts = [prepare_at_start(side.system, side.prepared, [free]) for side in sides(system, prepared)]
        if None in starts:
            raise delay_search_refused(system)
        begin = limits[0] or Fraction(0)
        end = limits[1] or delay_reach(system, free, begin, pieces=PIECES, further=FURTHER)[0]
        report_progress = delay_progress(system, free, begin, end, location=_LOCATION, progress=progress)
        result = stable_in_all(
            [
                search(DelayPath(side.system, free, start, begin, end, report_progress))
                for side, start in zip(sides(system, prepared), starts, strict=True)
                if start is not None
            ]
        )
    else:
        each = []
        at_start = None
        for side in sides(system, prepared):
            at_start = prepare_at_start(side.system, side.prepared, [free])
            line = _line(side.system, free, ends, at_start or side.prepared)
            each.append(search(line, progress=progress))
        result = stable_in_all(each)
        if at_start and not (result.classified or parameters_suffice(system, prepared)):
            # Contacts close or open within the range, and a contact mode is left out of the verdict.
            result = search(_singly(system, free, ends, prepared, NOMINAL), progress=progress)
    return result


def _everywhere(
    search: CrossingReport,
    present: float,
    stable_now: Callable[[], bool | None],
    criterion: str,
    near: Sequence[str],
) -> ConstantVerdict:
    """Return the common verdict of all values, if no change was found."""
    side = search.stable[0] if search.stable else None
    if search.searched_to[0] <= present <= search.searched_to[1] and present not in search.isolated:
        # Floats decide the side of all samples; the analysis bounds the error.
        side = side if stable_now() == side else None
    if search.has_effect:
        reason = ConstantReason.SCANNED
    elif criterion == PASSIVE and side is False:
        reason = ConstantReason.NO_DAMPING
    else:
        reason = ConstantReason.NO_EFFECT_AT_START if near else ConstantReason.NO_EFFECT
    return ConstantVerdict(side, reason)


def _line(system: Model, free: ParameterRef, ends: Ends, prepared: Prepared) -> ParameterPath:
    """Return a model along a parameter that affects no time: by its matrices, or value by value."""
    if not parameters_suffice(system, prepared):
        return _singly(system, free, ends, prepared, NOMINAL)
    parameter = parameter_of(system, free)
    low, high = ends
    try:
        family = evaluator_of_many(system, [free], _LOCATION, prepared=prepared)
    except ApcError:
        if not many_packets(system, prepared):
            raise
        return _singly(system, free, ends, prepared, NOMINAL)
    low = parameter.minimum if low is None else low
    line = MatrixPath(family, prepared, np.array([parameter.value]), 0, low, high)
    if high is None and parameter.maximum is not None:
        return replace(line, top=min(SPAN * line.scale, parameter.maximum))
    return line


def _singly(
    system: Model, free: ParameterRef, ends: Ends, prepared: Prepared, criterion: str
) -> PointwisePath:
    """Return a model along a parameter, analysed value by value."""
    points, least = line_points(system, free, *ends, value_now(system, free) or 1.0)
    return PointwisePath(RadiusEvaluator(system, (free,), prepared, _LOCATION, criterion), points, least)


def _limit(option: str, text: str | None, free: ParameterRef, unit: str) -> Fraction | None:
    """Read a limit, None if there is none."""
    return None if text is None else option_value(option, text, subject=free.name, unit=unit)


def _check_limits(
    system: Model, free: ParameterRef, limits: Sequence[Fraction | None], *, timed: bool
) -> None:
    """Raise an error for limits with an empty range."""
    low, high = limits
    least = 0.0 if timed else parameter_of(system, free).minimum
    most = None if timed else parameter_of(system, free).maximum
    unit = "s" if timed else parameter_of(system, free).unit
    for value in (low, high):
        if value is not None and timed and not value and reaches_period(system, free):
            message = f"a limit of {free.name}"
            raise ApcError(Diagnostic("E843", _LOCATION, message, "more than 0 s", "0 s"))
        if value is not None and (
            (least is not None and value < least) or (most is not None and value > most)
        ):
            expected = f"at least {least:g}" if least is not None and value < least else f"at most {most:g}"
            message, got = f"a limit of {free.name}", with_unit(f"{float(value):g}", unit)
            raise ApcError(Diagnostic("E843", _LOCATION, message, with_unit(expected, unit), got))
    bottom = low if low is not None else (least or 0.0)
    if high is not None and not high > bottom:
        message, got = f"the range of {free.name}", with_unit(f"{float(bottom):g} to {float(high):g}", unit)
        raise ApcError(Diagnostic("E842", _LOCATION, message, "an upper limit above the lower", got))


def _chosen(search: CrossingReport, present: float, stable_now: Callable[[], bool | None]) -> Crossing | None:
    """Return the relevant crossing, see `Critical`; at a jump, the verdict there gives its side."""
    if not search.edges:
        return None
    below = sum(edge.boundary < present for edge in search.edges)
    upto = sum(edge.boundary <= present for edge in search.edges)
    if upto > below and search.stable[below] != stable_now():
        below = upto
    if search.stable[below]:
        return search.edges[below] if below < len(search.edges) else search.edges[below - 1]
    lost = [edge for edge in search.edges if edge.stable_side == "below"]
    return lost[0] if lost else search.edges[0]
