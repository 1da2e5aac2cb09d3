"""How much each coupler's stiffness and damping, and each delay, may grow before the boundary.

Takes: a `Model`.
Gives: `Margin`, `Margins`, `margins`, `network_margins`; `not_looked`; `coupler_parameters`; `STIFFNESSES`.
Guarantees: a margin is the next crossing above the present value, with its error; none is said together with
how far was looked.
Does not: look below the present value (see `critical`), or vary two at once (see `box`).

What counts is told by structure: a stiffness or damping by its unit, in a part that has no motion of its own;
a delay by a hold or link that waits for it.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import analyze, lifted_groups, prepare_at_start
from apc.analysis.sides import sides
from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, SourceLocation
from apc.compiler.timings import part
from apc.compiler.words import counted
from apc.eigen.modes import arrange
from apc.eigen.peers import states_of
from apc.eigen.spectrum import finite
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.names import ParameterRef, named_times, parameter_of, times_of, unit_of, value_now
from apc.network.nominal import channel_numbers
from apc.result import Result
from apc.threads import single_threaded
from apc.vary.crossing import ESTIMATE, CrossingReport, search
from apc.vary.evaluator import evaluator, free_parameters, many_packets, parameters_suffice
from apc.vary.growth import (
    BOUNDED,
    MEAN_SQUARE,
    NOMINAL,
    PointwisePath,
    RadiusEvaluator,
    allowed,
    line_points,
)
from apc.vary.line import DelayPath, MatrixPath, delay_reach
from apc.vary.sensitivity import not_varied, of_channels
from apc.vary.timing_values import delay_now
from apc.verdict import StabilityVerdict

Floats = NDArray[np.float64]

PLACE = SourceLocation("margins")

# Units of a stiffness and of a damping, along an axis or about one, as components write them.
STIFFNESSES = ("N/m", "kg/s^2")
UNITS = (*STIFFNESSES, "N*s/m", "kg/s", "N*m/rad", "N*m*s/rad")

# How many times the present value is looked at (or the change that would move an eigenvalue by 1).
GROWTH = 1e3

# How far a delay is looked at: over so many pieces, each from one coincidence of events to the next, mostly
# a tick, and up to so many times its present value; over more pieces than the most it takes too long.
PIECES, FURTHER, MOST_PIECES = 4, 1.5, 64

# In passing they are looked for where the squares of the loops' states, and so much for each event of a
# frame, come to no more: within a second, mostly. Of the rest it is said how to ask for it.
MOST_IN_PASSING, OF_EVENT = 3000, 8
TAKES_LONG = "not looked for in passing in so large a scene (apc analyze --margins does)"

# Of larger systems a stiffness or damping is not looked at value by value, which takes half a minute of 400
# states, nor a delay, which takes a minute or two of 800.
MOST_SCANNED, MOST_DELAYED = 300, 1000

# Values of a probability or jitter to look at, from the present one to the largest. More numbers times states
# than this are looked at in mean square only if asked: a score of values of each number, of some milliseconds
# and one more for every two states, are half a minute.
SHARES, MOST_GROWN_IN_PASSING = 16, 500

# What is said of a scene that is not stable.
NOT_STABLE = "none: the scene is not {} as it is"


@dataclass(frozen=True, slots=True)
class Margin:
    """How far a parameter may grow: to `value`, right to `error`, both in SI, `factor` times its present one.

    `value` and `error` are None when no boundary was found up to `scanned`; `factor` is None then, and for a
    present value of 0. `note` says why it was not looked for, where it was not; `estimated` that the error is
    an estimate and no bound.
    """

    parameter: str
    unit: str
    present: float
    value: float | None
    error: float | None
    factor: float | None
    frequency_hz: float | None
    kind: str
    scanned: float
    note: str = ""
    estimated: bool = False


@dataclass(frozen=True, slots=True)
class Margins(Result):
    """The margins that were found; `note` says why there are none."""

    shown_by = "vary_output:margins"

    rows: tuple[Margin, ...]
    note: str


@part("margins")
def margins(system: Model, *, prepared: Prepared | None = None, quick: bool = False) -> Margins:
    """Find how much each stiffness, damping and delay may grow, all else as it is.

    Parameters
    ----------
    system
        The compiled scene. One that isn't stable has no margins.
    prepared
        From `instance.prepare`, of this system with any numbers.
    quick
        Look for none in a scene beyond `MOST_IN_PASSING`, and say so.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        prepared = prepared or prepare(system)
        free = coupler_parameters(system)
        delays = _delays(system)
        start = prepare_at_start(system, prepared, [*free, *delays])
        at = start or prepared
        delays = delays if start is not None else []
        first = sides(system, at)[0]  # every side has the same states
        states = _loops(first.system, first.prepared, most=MOST_IN_PASSING if quick else math.inf)
        if not states:
            return Margins((), TAKES_LONG)
        largest = max(states)
        slow = largest > MOST_SCANNED and many_packets(system, at)
        chosen = free if slow or largest <= MOST_SCANNED else []
        rest = [not_looked(system, item, f"{largest:,} states") for item in free if item not in chosen]
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
    """Return how many states each loop has, none where what they would take is beyond the most."""
    schedules = prepared.schedules
    events = OF_EVENT * max(len(schedule.events) for schedule in schedules)
    kinds = [prepared.jacobians[group.kind] for group in system.groups]
    # Of one peer alone it is known without a matrix.
    if events + max(map(states_of, schedules, kinds)) ** 2 > most:
        return []
    states = [loop.states for loop in arrange(*lifted_groups(system, prepared=prepared)).loops]
    return states if events + sum(state**2 for state in states) <= most else []


def _notes(rows: Sequence[Margin], start: Prepared | None) -> str:
    """Return what is to be said of all margins together."""
    estimated = [row.parameter for row in rows if row.estimated]
    notes = ["delays were not varied: the linearization depends on the start values"] * (start is None)
    notes += [f"{ESTIMATE}: {', '.join(estimated)}"] * bool(estimated)
    notes += ["none: there is nothing to vary"] * (not rows)
    return "; ".join(notes)


def coupler_parameters(system: Model) -> list[ParameterRef]:
    """Return the stiffnesses and dampings of parts without motion of their own, and the named ones."""
    moving = {state.name.rpartition(".")[0] for kind in system.kinds for state in kind.states}
    return [
        free
        for free in free_parameters(system)
        if parameter_of(system, free).unit in UNITS and free.name.rpartition(".")[0] not in moving
    ]


def _delays(system: Model) -> list[ParameterRef]:
    """Return the timings that a hold or link waits for, or the named time they all follow from.

    A link's own delay is not among them where every two groups have one of theirs.
    """
    waited = [hold.delay for kind in system.kinds for hold in kind.holds]
    ways = {
        (sender.name, receiver.name)
        for sender in system.groups
        for receiver in system.groups
        if sender is not receiver or sender.count > 1
    }
    for link in system.links:
        if ways - {(pair.sender, pair.receiver) for pair in link.delays}:
            waited.append(link.delay)
        waited += [pair.delay for pair in link.delays]
    free = {timing.name for timing in named_times(system) if timing.formula is None}
    return [ParameterRef(name) for name in dict.fromkeys(waited) if name in free]


def _lines(
    system: Model, free: Sequence[ParameterRef], prepared: Prepared, *, singly: bool
) -> Iterator[MatrixPath | PointwisePath | None]:
    """Yield the line of each parameter from its present value on, None where it can't grow.

    What a stiffness of 0 leaves free is no relative motion of the scene as it is, but one of every scene in
    which it varies: a parameter of 0 varies by itself. `singly`: each value is analysed by itself.
    """
    base = np.array([parameter_of(system, item).value for item in free])
    frees = [item for item, value in zip(free, base, strict=True) if value]
    together = evaluator(system, frees, prepared=prepared) if frees and not singly else None
    for item, present in zip(free, base.tolist(), strict=True):
        most = allowed(system, item)[1]
        if singly:
            source = RadiusEvaluator(system, (item,), prepared, PLACE, NOMINAL)
            scale = abs(present) or 1.0
            points, least = line_points(system, item, present, min(GROWTH * scale, most), scale)
            yield PointwisePath(source, points, least) if points[-1] > present else None
            continue
        if present:
            assert together is not None, "it is among those that are not 0"
            whole = MatrixPath(together, prepared, base[base != 0], frees.index(item), present)
        else:
            whole = MatrixPath(
                evaluator(system, [item], prepared=prepared), prepared, np.zeros(1), 0, present
            )
        top = min(GROWTH * whole.scale, most)
        yield replace(whole, top=top) if top > present else None


def _delay_margin(system: Model, free: ParameterRef, prepared: Prepared, largest: int) -> Margin | None:
    """Return the margin of a delay, in a scene whose largest loop has so many states."""
    if len(times_of(system, free.name)) > 1:
        return not_looked(system, free, "groups set their own")
    now = delay_now(system, free)
    end, count = delay_reach(system, free, now, pieces=PIECES, further=FURTHER)
    if count > MOST_PIECES:
        return not_looked(system, free, f"{count} orders of events up to {float(end):.4g} s")
    late = all(free.name != hold.delay for kind in system.kinds for hold in kind.holds)
    if largest > MOST_DELAYED and not late:
        return not_looked(system, free, f"{largest:,} states in each order of events")
    try:
        return _margin(system, free, search(DelayPath(system, free, prepared, now, end), first=True))
    except ApcError as error:
        return not_looked(system, free, error.mistakes[0].what)


def not_looked(system: Model, free: ParameterRef, why: str) -> Margin:
    """Return the row of a parameter of which nothing was looked for, and why."""
    present = value_now(system, free)
    unit = unit_of(system, free.name)
    return Margin(free.label, unit, present, None, None, None, None, "", present, why)


def _margin(system: Model, free: ParameterRef, search: CrossingReport) -> Margin | None:
    """Return how far a parameter may grow by a search, None where nothing depends on it."""
    if not search.enters:
        return None
    present = value_now(system, free)
    row = replace(not_looked(system, free, ""), scanned=search.scanned[1])
    crossing = next((edge for edge in search.edges if edge.stable_side == "below"), None)
    if crossing is None and search.stable[:1] == (False,):
        # Stable as it is, and unstable at every larger value.
        return replace(row, value=present, error=0.0, factor=1.0 if present else None, kind="jump")
    if crossing is None:
        return row
    return replace(
        row,
        value=crossing.value,
        error=crossing.error,
        factor=crossing.value / present if present else None,
        frequency_hz=finite(crossing.frequency_hz),
        kind=crossing.kind,
        estimated=crossing.proof == ESTIMATE,
    )


def network_margins(system: Model, prepared: Prepared, nominal: Margins, *, quick: bool = False) -> Margins:
    """Find how much each stiffness, damping, probability and jitter may grow, stable in mean square.

    On either side of a margin, by its error, bounds on the growth of second moments decide, or the note says
    of which they don't. No delay or period is varied.

    Parameters
    ----------
    system, prepared
        The compiled scene, and what `instance.prepare` made of it.
    nominal
        The margins over the nominal network: how far to look from a value of 0.
    quick
        Whether margins that take long are left out.
    """
    with (
        part("margins"),
        single_threaded(),
        finite_equations(system.origin.topology),
        np.errstate(all="ignore"),
    ):
        free = [*coupler_parameters(system), *of_channels(system)]
        states = max(len(kind.states) for kind in system.kinds)
        if quick and len(free) * states > MOST_GROWN_IN_PASSING:
            count = f"{len(free)} numbers of {states} states"
            return Margins((), f"not looked for in passing: {count} (apc analyze --margins does)")
        from apc.moments.network_verdict import growth  # most scenes have an ideal network

        now = growth(system, prepared)
        why = not_varied(len(free), now)
        if why and now.stable is not False:
            return Margins((), f"not looked for: {why}")
        if not now.stable:
            known = "stable" if now.stable is False else "proved stable"
            return Margins((), NOT_STABLE.format(f"{known} in mean square"))
        scales = {row.parameter: row.value or row.scanned / GROWTH for row in nominal.rows}
        open_rows = {row.parameter for row in nominal.rows if row.note}
        rows: list[Margin | None] = []
        open_sides, looked = [], 0
        beyond: dict[str, list[str]] = {}
        for item in free:
            scale = abs(value_now(system, item)) or scales.get(item.label, 0.0)
            points, least = _grown(system, item, scale)
            unscaled = not nominal.rows or item.label in open_rows
            if unscaled and len(points) == 1:
                rows.append(not_looked(system, item, "from 0 nothing says how far"))
                continue
            source = RadiusEvaluator(system, (item,), prepared, PLACE)
            result = search(PointwisePath(source, points, least), first=True)
            looked += result.looked
            rows.append(_margin(system, item, result))
            if rows[-1] and result.why:
                beyond.setdefault(result.why, []).append(item.label)
            if rows[-1] and result.edges and result.edges[0].proof != BOUNDED[MEAN_SQUARE]:
                open_sides.append(f"{item.label} ({result.edges[0].proof})")
    notes = [f"beyond these values of {', '.join(labels)}, {why}" for why, labels in beyond.items()]
    if open_sides:
        notes.append(f"not bounded on either side: {', '.join(open_sides)}")
    notes.append(
        f"{counted(looked, 'value')} were looked at: a narrow change of the verdict could hide between two"
    )
    notes.append("delays and periods were not varied: they change the order of events")
    return Margins(tuple(filter(None, rows)), "; ".join(notes))


def _grown(system: Model, free: ParameterRef, scale: float) -> tuple[Floats, float]:
    """Return the values over which a number is looked at in mean square, and the least size of a cell."""
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
