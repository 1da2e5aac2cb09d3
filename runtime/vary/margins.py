"""How much each coupler's stiffness and damping, and each delay, may grow before the boundary.

Takes: a `CompiledSystem`.
Gives: `Margin`, `Margins`, `margins`; `not_looked`; `coupler_parameters`; `STIFFNESSES`.
Guarantees: a margin is the next crossing above the present value, with its error; none is said together with
how far was looked.
Does not: look below the present value (see `critical`), or vary two at once (see `box`).

What counts is told by structure: a stiffness or damping by its unit, in a part that has no motion of its own;
a delay by a hold or link that waits for it.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, prepare, prepare_at_start
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.eigen.spectrum import finite
from apc.finite_equations import finite_equations
from apc.frame.names import Free, named_times, parameter_of, unit_of, value_now
from apc.result import Result
from apc.threads import single_threaded
from apc.vary.batch import BatchEvaluator
from apc.vary.crossings import scan_lines
from apc.vary.delays import delay_now
from apc.vary.effort import Effort, affordable, effort_of
from apc.vary.evaluator import (
    PointEvaluator,
    evaluator,
    free_parameters,
    keeps_size,
    long_loops,
)
from apc.vary.search import (
    ESTIMATE,
    Crossing,
    Line,
    courses_of,
    delay_reach,
    proved_crossing,
    reach,
    search_delay,
)

Floats = NDArray[np.float64]

# Units of a stiffness and of a damping, as components write them.
STIFFNESSES = ("N/m", "kg/s^2")
UNITS = (*STIFFNESSES, "N*s/m", "kg/s")

# How many times the present value is looked at (or the change that would move an eigenvalue by 1).
GROWTH = 1e3

# How far a delay is looked at: over so many pieces, each from one coincidence of events to the next, mostly
# a tick, and up to so many times its present value; over more pieces than the most it takes too long.
PIECES, FURTHER, MOST_PIECES = 4, 1.5, 64

# Balls of larger systems take minutes, bounds of floats do.
FEW_STATES = 60

# In passing so many seconds are spent, as `effort` estimates them; of the rest it is said how to ask for it.
MOST_IN_PASSING = 2.5
IN_PASSING = "takes long (--margins)"
ASKED = "apc analyze --margins looks for what takes long"

# Of larger systems a stiffness or damping is not looked at value by value, which takes half a minute of 400
# states, nor a delay, which takes a minute or two of 800.
MOST_SCANNED, MOST_DELAYED = 300, 1000

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

    shown_by = "vary:margins"

    rows: tuple[Margin, ...]
    note: str


@part("margins")
def margins(system: CompiledSystem, *, prepared: Prepared | None = None, quick: bool = False) -> Margins:
    """Find how much each stiffness, damping and delay may grow, all else as it is.

    Parameters
    ----------
    system
        The compiled scene. One that isn't stable has no margins.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    quick
        Spend no more than `MOST_IN_PASSING`, and say of which parameters nothing was looked for.
    """
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        prepared = prepared or prepare(system)
        start = prepare_at_start(system, prepared)
        free, at = coupler_parameters(system), start or prepared
        most = MOST_IN_PASSING if quick else math.inf
        long = long_loops(system, free, at) is not None
        effort = effort_of(system, at, long=long, most=most)
        largest = max(effort.states, default=0)
        fitting = long or largest <= MOST_SCANNED
        borne = affordable([effort.of_parameter()] * len(free), most if fitting else -1.0)
        chosen = [one for one, within in zip(free, borne, strict=True) if within]
        why = IN_PASSING if fitting else f"{largest:,} states"
        rest = [not_looked(system, one, why) for one in free if one not in chosen]
        delays = _delays(system) if start is not None else []
        if quick and rest and not chosen:  # and whether the scene is stable is not known
            return Margins((*rest, *(not_looked(system, one, why) for one in delays)), _notes(rest, start))
        found = _parameter_margins(system, chosen, at)
        if isinstance(found, str):
            return Margins((), found)
        found += rest
        most -= effort.of_parameter() * len(chosen)
        for one in delays:
            assert start is not None, "else there are no delays"
            cost, row = _delay_margin(system, one, start, effort, most)
            most -= cost
            found.append(row)
        return Margins(tuple(found), _notes(found, start))


def _notes(rows: Sequence[Margin], start: Prepared | None) -> str:
    """Return what is to be said of all margins together."""
    estimated = [one.parameter for one in rows if one.estimated]
    notes = ["delays were not varied: how the scene moves hangs on what is heard at the start"] * (
        start is None
    )
    notes += [f"{ESTIMATE}: {', '.join(estimated)}"] * bool(estimated)
    notes += [ASKED] * any(one.note == IN_PASSING for one in rows)
    notes += ["none: there is nothing to vary"] * (not rows)
    return "; ".join(notes)


def coupler_parameters(system: CompiledSystem) -> list[Free]:
    """Return the stiffnesses and dampings of parts without motion of their own, and the named ones."""
    moving = {state.name.rpartition(".")[0] for kind in system.kinds for state in kind.states}
    return [
        one
        for one in free_parameters(system)
        if parameter_of(system, one).unit in UNITS and one.name.rpartition(".")[0] not in moving
    ]


def _delays(system: CompiledSystem) -> list[Free]:
    """Return the timings that a hold or link waits for, or the named time they all follow from."""
    waited = [hold.delay for kind in system.kinds for hold in kind.holds]
    for link in system.links:
        waited += [link.delay, *(pair.delay for pair in link.delays)]
    free = {timing.name for timing in named_times(system) if timing.formula is None}
    return [Free(name) for name in dict.fromkeys(waited) if name in free]


def _parameter_margins(
    system: CompiledSystem, free: Sequence[Free], prepared: Prepared
) -> list[Margin] | str:
    """Return the margins of the parameters that matter, or why there are none."""
    if long_loops(system, free, prepared):
        return _loop_margins(system, free, prepared)
    family = evaluator(system, free, prepared=prepared)
    base = np.array([parameter_of(system, one).value for one in free])
    here = family.matrices(base[None])
    largest = max((one.shape[1] for one in here), default=0)
    if not all(np.isfinite(one).all() for one in here):
        return "not looked for: the present values have no frame matrix of their own"
    lines = [Line(family, base, column) for column in range(len(free))]
    if keeps_size(here) and not base.all():
        family, lines = _apart(system, free, base, prepared)
        here = family.matrices(base[None, base != 0])
    if not _radius(here) < 1:
        return NOT_STABLE.format("stable")
    found: list[Margin | None] = [None] * len(free)
    for which in dict.fromkeys(id(line.family) for line in lines):
        own = [place for place, line in enumerate(lines) if id(line.family) == which]
        ways = [(free[i], lines[i]) for i in own]
        rows = _along(system, ways, in_balls=largest <= FEW_STATES)
        for place, one in zip(own, rows, strict=True):
            found[place] = one
    return [one for one in found if one]


def _loop_margins(system: CompiledSystem, free: Sequence[Free], prepared: Prepared) -> list[Margin] | str:
    """Return the margins of the parameters that matter of loops with long delays, or why there are none.

    What is 0 varies by itself, see `_apart`.
    """
    base = np.array([parameter_of(system, one).value for one in free])
    some = [one for one, value in zip(free, base, strict=True) if value]
    together = long_loops(system, some, prepared)
    found: list[Margin] = []
    for one, start in zip(free, base.tolist(), strict=True):
        family = together if start else long_loops(system, [one], prepared)
        assert family is not None, "a delay is as long whatever a stiffness is"
        own, column = (base[base != 0], some.index(one)) if start else (np.zeros(1), 0)
        line = Line(family, own, column)
        here = line.course(own[[column]])
        if all(not slope.any() for _, slope in here):
            continue
        scale = abs(start) or reach(here)
        limit = parameter_of(system, one).maximum
        top = min(GROWTH * scale, np.inf if limit is None else limit)
        if not top > start:
            continue
        points, _ = line.samples(start, float(top), scale)
        scanned = family.scan(points, scale / GROWTH, own, column, first=True)
        if not scanned.stable[:1].all():
            return NOT_STABLE.format("stable")
        roots = [root for root in scanned.roots if root.rising]
        crossing = proved_crossing(roots[0], line, scanned) if roots else None
        unit, reached = parameter_of(system, one).unit, float(scanned.points[-1])
        found.append(_margin(one.label, unit, start, crossing, reached))
    return found


def _along(
    system: CompiledSystem, ways: Sequence[tuple[Free, Line]], *, in_balls: bool
) -> list[Margin | None]:
    """Return the margins of parameters of one evaluator, None where nothing can grow or depends on it.

    Their lines are looked at in step; `in_balls` is as for `proved_crossing`.
    """
    courses = courses_of([line for _, line in ways])
    present = np.array([line.base[line.column] for _, line in ways])
    here = courses(np.arange(len(ways)), present)
    scales = [0.0] * len(ways)
    points: list[Floats] = []
    for place, (free, _) in enumerate(ways):
        own = [(matrix[[place]], slope[[place]]) for matrix, slope in here]
        points.append(np.empty(0))
        if all(not slope.any() for _, slope in own):
            continue
        scales[place] = abs(present[place]) or reach(own)
        limit = parameter_of(system, free).maximum
        top = min(GROWTH * scales[place], np.inf if limit is None else limit)
        if top > present[place]:
            start, end = float(present[place]), float(top)
            points[place], _ = ways[place][1].samples(start, end, float(scales[place]))
    scans = scan_lines(courses, points, [scale / GROWTH for scale in scales], first=True)
    found: list[Margin | None] = []
    for (free, line), start, some, scanned in zip(ways, present.tolist(), points, scans, strict=True):
        roots = [root for root in scanned.roots if root.rising and root.value > start]
        crossing = proved_crossing(roots[0], line, scanned, in_balls=in_balls) if roots else None
        reached = float(scanned.points[-1]) if len(scanned.points) else start
        unit = parameter_of(system, free).unit
        found.append(_margin(free.label, unit, start, crossing, reached) if len(some) else None)
    return found


def _apart(
    system: CompiledSystem, free: Sequence[Free], base: Floats, prepared: Prepared
) -> tuple[BatchEvaluator | PointEvaluator, list[Line]]:
    """Return the evaluator of the parameters that aren't 0, and lines on which each that is varies alone.

    What a stiffness of 0 leaves free is no relative motion of the scene as it is, but one of every scene in
    which it varies.
    """
    some = [one for one, value in zip(free, base, strict=True) if value]
    family = evaluator(system, some, prepared=prepared)
    lines = []
    for column, one in enumerate(free):
        if base[column]:
            lines.append(Line(family, base[base != 0], some.index(one)))
        else:
            lines.append(Line(evaluator(system, [one], prepared=prepared), np.zeros(1), 0))
    return family, lines


def _radius(matrices: Sequence[Floats]) -> float:
    return max((float(np.abs(np.linalg.eigvals(one)).max(initial=0.0)) for one in matrices), default=0.0)


def _delay_margin(
    system: CompiledSystem, free: Free, prepared: Prepared, effort: Effort, most: float
) -> tuple[float, Margin]:
    """Return what the margin of a delay takes, nothing where that is more than the most, and the margin."""
    now = delay_now(system, free)
    end, count = delay_reach(system, free, now, pieces=PIECES, further=FURTHER)
    if count > MOST_PIECES:
        why = f"{count} orders of events up to {float(end):.4g} s"
        return 0.0, not_looked(system, free, why)
    late = all(free.name != hold.delay for kind in system.kinds for hold in kind.holds)
    states = max(effort.states, default=0)
    if states > MOST_DELAYED and not late:
        return 0.0, not_looked(system, free, f"{states:,} states in each order of events")
    cost = effort.of_delay(count, late=late)
    if cost > most:
        return 0.0, not_looked(system, free, IN_PASSING)
    try:
        found = search_delay(
            system, free, now, end, prepared, from_stable=True, in_balls=states <= FEW_STATES
        )
    except ApcError as error:
        return cost, not_looked(system, free, error.mistakes[0].what)
    crossing = found.edges[0] if found.edges else None
    return cost, _margin(free.name, "s", float(now), crossing, found.scanned[1])


def not_looked(system: CompiledSystem, free: Free, why: str) -> Margin:
    """Return the row of a parameter of which nothing was looked for, and why."""
    present = value_now(system, free)
    unit = unit_of(system, free.name)
    return Margin(free.label, unit, present, None, None, None, None, "", present, why)


def _margin(name: str, unit: str, present: float, crossing: Crossing | None, scanned: float) -> Margin:
    if crossing is None:
        return Margin(name, unit, present, None, None, None, None, "", scanned)
    factor = crossing.value / present if present else None
    return Margin(
        name,
        unit,
        present,
        crossing.value,
        crossing.error,
        factor,
        finite(crossing.frequency_hz),
        crossing.kind,
        scanned,
        estimated=crossing.proof == ESTIMATE,
    )
