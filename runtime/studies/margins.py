"""Margins: the largest stable increase of each coupler's stiffness and damping, and of each delay.

Takes: a `NumericModel`.
Gives: `Margin`, `Margins`, `margins`, `network_margins`; `not_evaluated`; `coupler_parameters`;
`STIFFNESSES`.
Guarantees: a margin is the next crossing above the present value, with its error; the scanned range is part
of the result.
Does not: search below the present value (see `critical_values`), or vary two parameters together (see
`parametric_frames`).

The parameters are selected by structure: a stiffness or damping by its unit, in a part without states; a
delay by a hold or link that uses it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Analysis, analyze, lifted_classes
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.lifting.numeric_model import NumericModel
from apc.linearization.evaluation_errors import evaluating
from apc.network.nominal_criterion import channel_numbers
from apc.parameter_values.parameter_names import (
    ParameterRef,
    named_times,
    parameter_of,
    times_of,
    unit_of,
    value_now,
)
from apc.result import Result
from apc.spectrum.modes import decompose
from apc.spectrum.peer_classes import states_of
from apc.spectrum.spectrum import finite
from apc.studies.crossing import ESTIMATE, CrossingReport, search, stable_in_all
from apc.studies.evaluator import evaluator, free_parameters, many_packets
from apc.studies.evaluator_choice import evaluator_for, radius_evaluator
from apc.studies.parameter_path import DelayPath, MatrixPath, delay_reach, verdict_of
from apc.studies.sensitivity import channel_parameters, not_varied
from apc.studies.stability_criteria import (
    BOUNDED,
    MEAN_SQUARE,
    NOMINAL,
    PointwisePath,
    RadiusEvaluator,
    allowed,
    line_points,
    scale_of,
)
from apc.studies.timing_values import delay_now
from apc.verdict import StabilityVerdict

Floats = NDArray[np.float64]

LOCATION = SourceLocation("margins")

# Units of a stiffness and of a damping, along an axis or about one, and of the contact of Hunt and Crossley.
STIFFNESSES = ("N/m", "kg/s^2")
UNITS = (*STIFFNESSES, "N*s/m", "kg/s", "N*m/rad", "N*m*s/rad", "kg/(m^(1/2)*s^2)", "kg/(m^(3/2)*s)")

# The end of the search, as a multiple of the present value (for 0, of the change that would move an
# eigenvalue by 1).
GROWTH = 1e3

# The range of a delay search: at least this number of segments between coincidences of events (mostly ticks),
# and at most this multiple of the present value; a search over more than MOST_PIECES segments is skipped.
PIECES, FURTHER, MOST_PIECES = 4, 1.5, 64

# An analysis computes margins by default if the squares of the loops' states, plus a cost for each event of a
# frame, are below this: about a second. Otherwise a note names the option that requests them.
MOST_IN_PASSING, OF_EVENT = 3000, 8
TAKES_LONG = "not computed by default for a topology of this size (apc analyze --margins)"

# The limits of states beyond which a stiffness or damping (half a minute for 400 states) and a delay (a
# minute or two for 800) are not searched.
MOST_SCANNED, MOST_DELAYED = 300, 1000

# Samples of a probability or jitter, from the present value to the maximum. Above this limit of parameters
# times states, mean-square margins are computed on request only: twenty values of each parameter, at some
# milliseconds each and one more for every two states, take half a minute.
SHARES, MOST_GROWN_IN_PASSING = 16, 500

# The note for a model that is not stable.
NOT_STABLE = "none: the topology is not {} at its present values"


@dataclass(frozen=True, slots=True)
class Margin:
    """The margin of a parameter: the boundary `value` with `error`, both in SI, and its ratio to `current`.

    `value`, `error` and `gain_margin` are None if no boundary was found up to `searched_to`; `gain_margin` is
    None also for a present value of 0. `note` is the reason if the parameter was not searched; `estimated`
    states that the error is an estimate and no bound.
    """

    parameter: str
    unit: str
    current: float
    value: float | None
    error: float | None
    gain_margin: float | None
    frequency_hz: float | None
    kind: str
    searched_to: float
    note: str = ""
    estimated: bool = False


@dataclass(frozen=True, slots=True)
class Margins(Result):
    """The margins of a model; `note` holds the reason if there are none, and remarks, one in a line."""

    shown_by = "margins_output:margins"

    rows: tuple[Margin, ...]
    note: str


@part("margins")
def margins(numeric: NumericModel, *, quick: bool = False, analysis: Analysis | None = None) -> Margins:
    """Return the stability margin of each stiffness, damping and delay, with all other parameters fixed.

    Parameters
    ----------
    numeric
        The model with its parameter values. A model that is not stable has no margins.
    quick
        Whether to skip the search in a model beyond `MOST_IN_PASSING`, with a note.
    analysis
        The analysis at the present values, if already computed.
    """
    model = numeric.model
    with evaluating(model):
        parameter_refs, delays = coupler_parameters(model), _delays(model)
        linearized = evaluator_for(numeric, [*parameter_refs, *delays]).linearized
        # Times do not move an equilibrium, at which a delay then finds one linearization.
        for_delays = linearized or evaluator_for(numeric, delays).linearized
        first_side = (linearized or for_delays or (sides(numeric)[0].numeric,))[0]  # all have the same states
        states = _loop_sizes(first_side, most=MOST_IN_PASSING if quick else math.inf)
        if not states:
            return Margins((), TAKES_LONG)
        largest = max(states)
        slow = largest > MOST_SCANNED and many_packets(first_side)
        searched = parameter_refs if slow or largest <= MOST_SCANNED else []
        skipped = [
            not_evaluated(model, parameter_ref, f"{largest:,} states")
            for parameter_ref in parameter_refs
            if parameter_ref not in searched
        ]
        now = analysis or analyze(numeric)
        if not now.stable and now.verdict is not StabilityVerdict.DRIFTS:
            return Margins((), NOT_STABLE.format("stable" if now.stable is False else "proved stable"))
        if not any(states):
            return Margins((), "none: the topology has no motion")
        paths = _margin_paths(numeric, () if slow else linearized, searched)
        rows = [
            _margin(
                model,
                parameter_ref,
                stable_in_all([search(path, first=True) for path in of_parameter]),
                pointwise=slow or not linearized,
            )
            for parameter_ref, of_parameter in zip(searched, paths, strict=True)
            if of_parameter
        ]
        rows += skipped
        if for_delays:
            rows += [_delay_margin(for_delays, delay, largest, now) for delay in delays]
        result, notes = tuple(filter(None, rows)), list[str]()
        if delays and not for_delays:
            notes.append("delays were not varied, as the linearization depends on the initial packets")
        if estimated := [row.parameter for row in result if row.estimated]:
            notes.append(f"{ESTIMATE}: {', '.join(estimated)}")
        if not (parameter_refs or delays):
            notes.append("none: there is no parameter to vary")
        elif not result and not notes:
            notes.append("none: no varied parameter affects stability")
        return Margins(result, "\n".join(notes))


def _loop_sizes(numeric: NumericModel, *, most: float) -> list[int]:
    """Return the number of states of each loop; empty if the search would exceed the limit `most`."""
    schedules = numeric.schedules
    events = OF_EVENT * max(len(schedule.events) for schedule in schedules)
    # A bound by the states of one peer, without building loops.
    if events + max(map(states_of, schedules, numeric.subsystems)) ** 2 > most:
        return []
    states = [modal_system.states for modal_system in decompose(*lifted_classes(numeric)).loops]
    return states if events + sum(state**2 for state in states) <= most else []


def coupler_parameters(model: Model) -> list[ParameterRef]:
    """Return the stiffnesses and dampings of parts without states, and the named ones."""
    moving = {state.name.rpartition(".")[0] for peer_type in model.peer_types for state in peer_type.states}
    return [
        parameter_ref
        for parameter_ref in free_parameters(model)
        if parameter_of(model, parameter_ref).unit in UNITS
        and parameter_ref.name.rpartition(".")[0] not in moving
    ]


def _delays(model: Model) -> list[ParameterRef]:
    """Return the delays of holds and links, or the named time on which all of them depend.

    A link's own delay is left out if every pair of groups has a separate delay.
    """
    independent = {timing.name for timing in named_times(model) if timing.formula is None}
    delay_names = [hold.delay for peer_type in model.peer_types for hold in peer_type.holds]
    directions = {
        (sender.name, receiver.name)
        for sender in model.groups
        for receiver in model.groups
        if sender is not receiver or sender.count > 1
    }
    for link in model.links:
        separate = {(pair.sender, pair.receiver) for pair in link.pairs if pair.delay in independent}
        delay_names += link.delays if directions - separate else link.delays[1:]
    return [ParameterRef(name) for name in dict.fromkeys(delay_names) if name in independent]


def _margin_paths(
    numeric: NumericModel, linearized: Sequence[NumericModel], parameter_refs: Sequence[ParameterRef]
) -> Iterator[Sequence[MatrixPath | PointwisePath]]:
    """Yield the paths of each parameter from its present value upwards, none if it is at its maximum.

    There is one path for each of the linearized models, the sides of a kink; without linearized models, one
    path whose values are analyzed separately. A parameter of 0 has a separate evaluator: a mode that is rigid
    at a stiffness of 0 is not rigid at other values.
    """
    model = numeric.model
    base = np.array([parameter_of(model, parameter_ref).value for parameter_ref in parameter_refs])
    nonzero = [parameter_ref for parameter_ref, value in zip(parameter_refs, base, strict=True) if value]
    for parameter_ref, present in zip(parameter_refs, base.tolist(), strict=True):
        most = allowed(model, parameter_ref)[1]
        if not linearized:
            source = RadiusEvaluator(numeric, (parameter_ref,), LOCATION, NOMINAL)
            points, least = _margin_points(model, parameter_ref, abs(scale_of(model, parameter_ref)))
            yield [PointwisePath(source, points, least)] if points[-1] > present else []
            continue
        varied = nonzero if present else [parameter_ref]
        values = base[base != 0] if present else np.zeros(1)
        paths = [
            MatrixPath(evaluator(side, varied), side, values, varied.index(parameter_ref), present)
            for side in linearized
        ]
        tops = [min(GROWTH * path.scale, most) for path in paths]
        yield [replace(path, top=top) for path, top in zip(paths, tops, strict=True) if top > present]


def _delay_margin(
    linearized: Sequence[NumericModel], parameter_ref: ParameterRef, largest: int, analysis: Analysis
) -> Margin | None:
    """Return the margin of a delay, without a value if the search would take too long.

    `linearized` are the sides of a kink, or the model; `largest` is the number of states of its largest loop;
    `analysis` is that at the present values.
    """
    model = linearized[0].model
    if len(times_of(model, parameter_ref.name)) > 1:
        return not_evaluated(model, parameter_ref, "the value differs between groups")
    now = delay_now(model, parameter_ref)
    end, count = delay_reach(model, parameter_ref, now, pieces=PIECES, further=FURTHER)
    if count > MOST_PIECES:
        return not_evaluated(model, parameter_ref, f"{count} orders of events up to {float(end):.4g} s")
    is_link_delay = all(
        parameter_ref.name != hold.delay for peer_type in model.peer_types for hold in peer_type.holds
    )
    if largest > MOST_DELAYED and not is_link_delay:
        return not_evaluated(model, parameter_ref, f"{largest:,} states in each order of events")
    try:
        known = {now: verdict_of(analysis)} if len(linearized) == 1 else {}
        paths = [DelayPath(parameter_ref, side, now, end, known=dict(known)) for side in linearized]
        return _margin(model, parameter_ref, stable_in_all([search(path, first=True) for path in paths]))
    except ApcError as error:
        return not_evaluated(model, parameter_ref, error.mistakes[0].message)


def not_evaluated(model: Model, parameter_ref: ParameterRef, why: str) -> Margin:
    """Return the entry of a parameter that was not searched, with the reason."""
    present = value_now(model, parameter_ref)
    unit = unit_of(model, parameter_ref.name)
    return Margin(parameter_ref.label, unit, present, None, None, None, None, "", present, why)


def _margin(
    model: Model, parameter_ref: ParameterRef, search: CrossingReport, *, pointwise: bool = False
) -> Margin | None:
    """Return the margin from a search, None if no eigenvalue depends on the parameter.

    A search that is `pointwise` knows the radius only, which may be that of another mode.
    """
    if not search.has_effect and not pointwise:
        return None
    present = value_now(model, parameter_ref)
    row = replace(not_evaluated(model, parameter_ref, ""), searched_to=search.searched_to[1])
    crossing = next((item for item in search.crossings if item.stable_side == "below"), None)
    if crossing is None and search.stable[:1] == (False,):
        # Stable at the present value, and unstable at every larger value.
        return replace(row, value=present, error=0.0, gain_margin=1.0 if present else None, kind="jump")
    if crossing is None:
        return row
    return replace(
        row,
        value=crossing.value,
        error=crossing.error,
        gain_margin=crossing.value / present if present else None,
        frequency_hz=finite(crossing.frequency_hz),
        kind=crossing.kind,
        estimated=crossing.proof == ESTIMATE,
    )


def network_margins(numeric: NumericModel, nominal: Margins, *, quick: bool = False) -> Margins:
    """Return the mean-square stability margin of each stiffness, damping, probability and jitter.

    On both sides of a margin, at its error, bounds on the second-moment growth prove the verdicts, or the
    note names the unproved side. No delay or period is varied.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    nominal
        The margins over the nominal network, which give the search range of a parameter of 0.
    quick
        Whether expensive margins are left out.
    """
    model = numeric.model
    with part("margins"), evaluating(model):
        parameter_refs = [*coupler_parameters(model), *channel_parameters(model)]
        states = max(len(peer_type.states) for peer_type in model.peer_types)
        if quick and len(parameter_refs) * states > MOST_GROWN_IN_PASSING:
            count = f"{len(parameter_refs)} parameters and {states} states"
            return Margins((), f"not computed by default: {count} (apc analyze --margins)")
        from apc.mean_square.mean_square_stability import (
            mean_square_growth,  # most models have an ideal network
        )

        now = mean_square_growth(numeric)
        why = not_varied(len(parameter_refs), now)
        if why and now.stable is not False:
            return Margins((), f"not computed: {why}")
        if not now.stable:
            known = "stable" if now.stable is False else "proved stable"
            return Margins((), NOT_STABLE.format(f"{known} in mean square"))
        scales = {row.parameter: row.value or row.searched_to / GROWTH for row in nominal.rows}
        open_rows = {row.parameter for row in nominal.rows if row.note}
        rows: list[Margin | None] = []
        open_sides, evaluations = [], 0
        ended_early: dict[str, list[str]] = {}
        for item in parameter_refs:
            scale = abs(value_now(model, item)) or scales.get(item.label, 0.0)
            points, least = _margin_points(model, item, scale)
            unscaled = not nominal.rows or item.label in open_rows
            if unscaled and len(points) == 1:
                rows.append(not_evaluated(model, item, "no search range follows from the present value 0"))
                continue
            source = radius_evaluator(numeric, (item,), LOCATION)
            result = search(PointwisePath(source, points, least), first=True)
            evaluations += result.evaluations
            rows.append(_margin(model, item, result, pointwise=True))
            if rows[-1] and result.why:
                ended_early.setdefault(result.why, []).append(item.label)
            if rows[-1] and result.crossings and result.crossings[0].proof != BOUNDED[MEAN_SQUARE]:
                open_sides.append(f"{item.label} ({result.crossings[0].proof})")
    notes = [f"{', '.join(labels)}: search ended, {why}" for why, labels in ended_early.items()]
    if open_sides:
        notes.append(f"without bounds on both sides: {', '.join(open_sides)}")
    notes.append(
        f"{counted(evaluations, 'value')} evaluated (verdict changes between adjacent values could be missed)"
    )
    notes.append("delays and periods were not varied, as they change the order of events")
    return Margins(tuple(filter(None, rows)), "\n".join(notes))


def _margin_points(model: Model, parameter_ref: ParameterRef, scale: float) -> tuple[Floats, float]:
    """Return the sampled values of a parameter, analyzed one by one, and the value below which cells no
    longer become narrower.
    """
    present, most = value_now(model, parameter_ref), allowed(model, parameter_ref)[1]
    if parameter_ref.name in channel_numbers(model):
        delays = [
            value_now(model, ParameterRef(delay))
            for link in model.links
            for delay in link.delays
            if (channel := link.channel_at(delay)) and channel.jitter == parameter_ref.name
        ]
        most = min([most, *delays])
        if not np.isfinite(most):  # a named number that a loss or a jitter depends on
            most = 1.0 if unit_of(model, parameter_ref.name) == "1" else GROWTH * abs(scale)
        points = np.linspace(present, most, SHARES + 1)
        return points, float(points[1])
    if not scale:
        return np.array([present]), 1.0
    return line_points(model, parameter_ref, present, min(GROWTH * scale, most), scale)
