"""Margins: the largest stable increase of each coupler's stiffness and damping, and of each delay.

Takes: a `Model`.
Gives: `Margin`, `Margins`, `margins`, `network_margins`; `not_evaluated`; `coupler_parameters`;
`STIFFNESSES`.
Guarantees: a margin is the next crossing above the present value, with its error; the scanned range is part
of the result.
Does not: search below the present value (see `critical_values`), or vary two parameters together (see
`parametric_frames`).

Structure selects the parameters: a stiffness or damping by its unit, in a part without motion of its own; a
delay by a hold or link that uses it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze, lifted_groups, prepare_at_start
from apc.analysis.one_sided_slopes import sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.compiler.wording import counted
from apc.eigen.modes import decompose
from apc.eigen.peer_classes import states_of
from apc.eigen.spectrum import finite
from apc.frame.evaluation_errors import finite_equations
from apc.frame.numeric_model import Prepared, prepare
from apc.frame.parameter_names import ParameterRef, named_times, parameter_of, times_of, unit_of, value_now
from apc.network.nominal_criterion import channel_numbers
from apc.parameter_studies.crossing import ESTIMATE, CrossingReport, search
from apc.parameter_studies.evaluator import evaluator, free_parameters, many_packets, parameters_suffice
from apc.parameter_studies.parameter_path import DelayPath, MatrixPath, delay_reach
from apc.parameter_studies.sensitivity import not_varied, of_channels
from apc.parameter_studies.stability_criteria import (
    BOUNDED,
    MEAN_SQUARE,
    NOMINAL,
    PointwisePath,
    RadiusEvaluator,
    allowed,
    line_points,
)
from apc.parameter_studies.timing_values import delay_now
from apc.result import Result
from apc.threads import single_threaded
from apc.verdict import StabilityVerdict

Floats = NDArray[np.float64]

LOCATION = SourceLocation("margins")

# Units of a stiffness and of a damping, along an axis or about one, as components write them.
STIFFNESSES = ("N/m", "kg/s^2")
UNITS = (*STIFFNESSES, "N*s/m", "kg/s", "N*m/rad", "N*m*s/rad")

# The end of the search, as a multiple of the present value (or of the change that would move an eigenvalue by
# 1).
GROWTH = 1e3

# The range of a delay search: at least this number of segments, each from one coincidence of events to the
# next, mostly a tick, and at most this multiple of the present value; a search over more segments takes too
# long.
PIECES, FURTHER, MOST_PIECES = 4, 1.5, 64

# An analysis computes margins by default where the squares of the loops' states, plus a cost for each event
# of a frame, are below this: about a second. Otherwise a note names the option that requests them.
MOST_IN_PASSING, OF_EVENT = 3000, 8
TAKES_LONG = "not looked for in passing in so large a topology (apc analyze --margins does)"

# The limit of larger systems: a stiffness or damping is not evaluated value by value, which takes half a
# minute for 400 states, nor a delay, which takes a minute or two for 800.
MOST_SCANNED, MOST_DELAYED = 300, 1000

# Samples of a probability or jitter, from the present value to the maximum. More parameters times states than
# the limit are evaluated in mean square on request only: twenty values of each parameter, of some
# milliseconds and one more for every two states, take half a minute.
SHARES, MOST_GROWN_IN_PASSING = 16, 500

# The note for a model that is not stable.
NOT_STABLE = "none: the topology is not {} as it is"


@dataclass(frozen=True, slots=True)
class Margin:
    """The margin of a parameter: `value` with `error`, both in SI; `gain_margin` is `value` by `current`.

    `value` and `error` are None when no boundary was found up to `searched_to`; `gain_margin` is None then,
    and for a present value of 0. `note` is the reason why the parameter was not searched, if so; `estimated`
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
    """The margins of a model; `note` is the reason if there are none."""

    shown_by = "parameter_studies_output:margins"

    rows: tuple[Margin, ...]
    note: str


@part("margins")
def margins(system: Model, *, prepared: Prepared | None = None, quick: bool = False) -> Margins:
    """Return the margin of each stiffness, damping and delay, with all other parameters fixed.

    Parameters
    ----------
    system
        The compiled model. One that is not stable has no margins.
    prepared
        From `numeric_model.prepare`, of this model with any parameter values.
    quick
        Skip the search in a model beyond `MOST_IN_PASSING`, with a note.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        prepared = prepared or prepare(system)
        free = coupler_parameters(system)
        delays = _delays(system)
        start = prepare_at_start(system, prepared, [*free, *delays])
        at = start or prepared
        delays = delays if start is not None else []
        first = sides(system, at)[0]  # all sides have the same states
        states = _loops(first.system, first.prepared, most=MOST_IN_PASSING if quick else math.inf)
        if not states:
            return Margins((), TAKES_LONG)
        largest = max(states)
        slow = largest > MOST_SCANNED and many_packets(system, at)
        chosen = free if slow or largest <= MOST_SCANNED else []
        rest = [not_evaluated(system, item, f"{largest:,} states") for item in free if item not in chosen]
        singly = slow or not parameters_suffice(system, at)
        now = analyze(system, prepared=prepared)
        if not now.stable and now.verdict is not StabilityVerdict.DRIFTS:
            return Margins((), NOT_STABLE.format("stable" if now.stable is False else "proved stable"))
        if not any(states):
            return Margins((), "none: nothing moves")
        lines = zip(chosen, _lines(system, chosen, at, singly=singly), strict=True)
        rows = [_margin(system, item, search(line, first=True)) for item, line in lines if line]
        rows += [*rest, *(_delay_margin(system, delay, at, largest) for delay in delays)]
        result = tuple(filter(None, rows))
        return Margins(result, _notes(result, start))


def _loops(system: Model, prepared: Prepared, *, most: float) -> list[int]:
    """Return the number of states of each loop, empty where the search would exceed the limit."""
    schedules = prepared.schedules
    events = OF_EVENT * max(len(schedule.events) for schedule in schedules)
    peer_types = [prepared.jacobians[group.peer_type] for group in system.groups]
    # For a single peer it is known without a matrix.
    if events + max(map(states_of, schedules, peer_types)) ** 2 > most:
        return []
    states = [loop.states for loop in decompose(*lifted_groups(system, prepared=prepared)).loops]
    return states if events + sum(state**2 for state in states) <= most else []


def _notes(rows: Sequence[Margin], start: Prepared | None) -> str:
    """Return the note on all margins together."""
    estimated = [row.parameter for row in rows if row.estimated]
    notes = ["delays were not varied: the linearization depends on the start values"] * (start is None)
    notes += [f"{ESTIMATE}: {', '.join(estimated)}"] * bool(estimated)
    notes += ["none: there is nothing to vary"] * (not rows)
    return "; ".join(notes)


def coupler_parameters(system: Model) -> list[ParameterRef]:
    """Return the stiffnesses and dampings of parts without motion of their own, and the named ones."""
    moving = {state.name.rpartition(".")[0] for peer_type in system.peer_types for state in peer_type.states}
    return [
        free
        for free in free_parameters(system)
        if parameter_of(system, free).unit in UNITS and free.name.rpartition(".")[0] not in moving
    ]


def _delays(system: Model) -> list[ParameterRef]:
    """Return the timings of holds and links, or the named time on which they all depend.

    A link's own delay is left out where every two groups have a delay of their own.
    """
    waited = [hold.delay for peer_type in system.peer_types for hold in peer_type.holds]
    directions = {
        (sender.name, receiver.name)
        for sender in system.groups
        for receiver in system.groups
        if sender is not receiver or sender.count > 1
    }
    for link in system.links:
        if directions - {(pair.sender, pair.receiver) for pair in link.delays}:
            waited.append(link.delay)
        waited += [pair.delay for pair in link.delays]
    free = {timing.name for timing in named_times(system) if timing.formula is None}
    return [ParameterRef(name) for name in dict.fromkeys(waited) if name in free]


def _lines(
    system: Model, free: Sequence[ParameterRef], prepared: Prepared, *, singly: bool
) -> Iterator[MatrixPath | PointwisePath | None]:
    """Yield the path of each parameter from its present value upwards, None at its maximum.

    A parameter of 0 has an evaluator of its own: a rigid mode at stiffness 0 is none at other values.
    With `singly` each value is analysed separately.
    """
    base = np.array([parameter_of(system, item).value for item in free])
    parameter_refs = [item for item, value in zip(free, base, strict=True) if value]
    together = evaluator(system, parameter_refs, prepared=prepared) if parameter_refs and not singly else None
    for item, present in zip(free, base.tolist(), strict=True):
        most = allowed(system, item)[1]
        if singly:
            source = RadiusEvaluator(system, (item,), prepared, LOCATION, NOMINAL)
            scale = abs(present) or 1.0
            points, least = line_points(system, item, present, min(GROWTH * scale, most), scale)
            yield PointwisePath(source, points, least) if points[-1] > present else None
            continue
        if present:
            assert together is not None, "it is among those that are not 0"
            whole = MatrixPath(together, prepared, base[base != 0], parameter_refs.index(item), present)
        else:
            whole = MatrixPath(
                evaluator(system, [item], prepared=prepared), prepared, np.zeros(1), 0, present
            )
        top = min(GROWTH * whole.scale, most)
        yield replace(whole, top=top) if top > present else None


def _delay_margin(system: Model, free: ParameterRef, prepared: Prepared, largest: int) -> Margin | None:
    """Return the margin of a delay, in a model whose largest loop has `states` states."""
    if len(times_of(system, free.name)) > 1:
        return not_evaluated(system, free, "groups set their own")
    now = delay_now(system, free)
    end, count = delay_reach(system, free, now, pieces=PIECES, further=FURTHER)
    if count > MOST_PIECES:
        return not_evaluated(system, free, f"{count} orders of events up to {float(end):.4g} s")
    late = all(free.name != hold.delay for peer_type in system.peer_types for hold in peer_type.holds)
    if largest > MOST_DELAYED and not late:
        return not_evaluated(system, free, f"{largest:,} states in each order of events")
    try:
        return _margin(system, free, search(DelayPath(system, free, prepared, now, end), first=True))
    except ApcError as error:
        return not_evaluated(system, free, error.mistakes[0].message)


def not_evaluated(system: Model, free: ParameterRef, why: str) -> Margin:
    """Return the entry of a parameter that was not searched, with the reason."""
    present = value_now(system, free)
    unit = unit_of(system, free.name)
    return Margin(free.label, unit, present, None, None, None, None, "", present, why)


def _margin(system: Model, free: ParameterRef, search: CrossingReport) -> Margin | None:
    """Return the margin found by a search, None where the radius does not depend on the parameter."""
    if not search.has_effect:
        return None
    present = value_now(system, free)
    row = replace(not_evaluated(system, free, ""), searched_to=search.searched_to[1])
    crossing = next((edge for edge in search.edges if edge.stable_side == "below"), None)
    if crossing is None and search.stable[:1] == (False,):
        # Stable as it is, and unstable at every larger value.
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


def network_margins(system: Model, prepared: Prepared, nominal: Margins, *, quick: bool = False) -> Margins:
    """Return the margin of each stiffness, damping, probability and jitter for mean-square stability.

    On both sides of a margin, at its error, bounds on the second-moment growth prove the verdicts, or the
    note names the unproved side. No delay or period is varied.

    Parameters
    ----------
    system, prepared
        The compiled model, and the result of `numeric_model.prepare` for it.
    nominal
        The margins over the nominal network: the search range from a value of 0.
    quick
        Whether expensive margins are left out.
    """
    with (
        part("margins"),
        single_threaded(),
        finite_equations(system.origin.topology),
        np.errstate(all="ignore"),
    ):
        free = [*coupler_parameters(system), *of_channels(system)]
        states = max(len(peer_type.states) for peer_type in system.peer_types)
        if quick and len(free) * states > MOST_GROWN_IN_PASSING:
            count = f"{len(free)} numbers of {states} states"
            return Margins((), f"not looked for in passing: {count} (apc analyze --margins does)")
        from apc.mean_square.mean_square_stability import (
            mean_square_growth,  # most models have an ideal network
        )

        now = mean_square_growth(system, prepared)
        why = not_varied(len(free), now)
        if why and now.stable is not False:
            return Margins((), f"not looked for: {why}")
        if not now.stable:
            known = "stable" if now.stable is False else "proved stable"
            return Margins((), NOT_STABLE.format(f"{known} in mean square"))
        scales = {row.parameter: row.value or row.searched_to / GROWTH for row in nominal.rows}
        open_rows = {row.parameter for row in nominal.rows if row.note}
        rows: list[Margin | None] = []
        open_sides, evaluations = [], 0
        beyond: dict[str, list[str]] = {}
        for item in free:
            scale = abs(value_now(system, item)) or scales.get(item.label, 0.0)
            points, least = _grown(system, item, scale)
            unscaled = not nominal.rows or item.label in open_rows
            if unscaled and len(points) == 1:
                rows.append(not_evaluated(system, item, "from 0 nothing says how far"))
                continue
            source = RadiusEvaluator(system, (item,), prepared, LOCATION)
            result = search(PointwisePath(source, points, least), first=True)
            evaluations += result.evaluations
            rows.append(_margin(system, item, result))
            if rows[-1] and result.why:
                beyond.setdefault(result.why, []).append(item.label)
            if rows[-1] and result.edges and result.edges[0].proof != BOUNDED[MEAN_SQUARE]:
                open_sides.append(f"{item.label} ({result.edges[0].proof})")
    notes = [f"beyond these values of {', '.join(labels)}, {why}" for why, labels in beyond.items()]
    if open_sides:
        notes.append(f"not bounded on either side: {', '.join(open_sides)}")
    notes.append(
        f"{counted(evaluations, 'value')} were looked at: a narrow change of the verdict could hide "
        "between two"
    )
    notes.append("delays and periods were not varied: they change the order of events")
    return Margins(tuple(filter(None, rows)), "; ".join(notes))


def _grown(system: Model, free: ParameterRef, scale: float) -> tuple[Floats, float]:
    """Return the sampled values of a parameter in mean square, and the smallest cell width."""
    present, most = value_now(system, free), allowed(system, free)[1]
    if free.name in channel_numbers(system):
        delays = [
            value_now(system, ParameterRef(link.delay))
            for link in system.links
            if link.channel is not None and link.channel.jitter == free.name
        ]
        points = np.linspace(present, min([most, *delays]), SHARES + 1)
        return points, float(points[1])
    if not scale:
        return np.array([present]), 1.0
    return line_points(system, free, present, min(GROWTH * scale, most), scale)
