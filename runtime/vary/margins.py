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
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from apc.analysis.analysis import analyze, lifted_groups, prepare_at_start
from apc.compiler.compiled import CompiledSystem
from apc.compiler.errors import ApcError
from apc.compiler.timings import part
from apc.eigen.modes import arrange
from apc.eigen.peers import states_of
from apc.eigen.spectrum import DRIFTS, finite
from apc.frame.display_units import Unit
from apc.frame.finite_equations import finite_equations
from apc.frame.instance import Prepared, prepare
from apc.frame.names import Free, named_times, parameter_of, unit_of, value_now
from apc.result import Result
from apc.threads import single_threaded
from apc.vary.crossing import ESTIMATE, Crossing, search
from apc.vary.delays import delay_now
from apc.vary.evaluator import evaluator, free_parameters, many_packets
from apc.vary.line import AnalysedLine, DelayLine, MatrixLine, delay_reach

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
def margins(system: CompiledSystem, *, prepared: Prepared | None = None, quick: bool = False) -> Margins:
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
        states = _loops(system, at, most=MOST_IN_PASSING if quick else math.inf)
        if not states:
            return Margins((), TAKES_LONG)
        largest = max(states)
        slow = largest > MOST_SCANNED and many_packets(system, at)
        chosen = free if slow or largest <= MOST_SCANNED else []
        rest = [not_looked(system, item, f"{largest:,} states") for item in free if item not in chosen]
        now = analyze(system, prepared=prepared)
        if not now.stable and now.verdict != DRIFTS:
            return Margins((), NOT_STABLE.format("stable" if now.stable is False else "proved stable"))
        if not any(states):
            return Margins((), "none: nothing moves")
        lines = _lines(system, chosen, at, slow=slow)
        result = [row for pair in zip(chosen, lines, strict=True) if (row := _along(system, *pair))]
        result += rest
        result += [_delay_margin(system, delay, at, largest) for delay in delays]
        return Margins(tuple(result), _notes(result, start))


def _loops(system: CompiledSystem, prepared: Prepared, *, most: float) -> list[int]:
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
    notes = ["delays were not varied: how the scene moves hangs on what is heard at the start"] * (
        start is None
    )
    notes += [f"{ESTIMATE}: {', '.join(estimated)}"] * bool(estimated)
    notes += ["none: there is nothing to vary"] * (not rows)
    return "; ".join(notes)


def coupler_parameters(system: CompiledSystem) -> list[Free]:
    """Return the stiffnesses and dampings of parts without motion of their own, and the named ones."""
    moving = {state.name.rpartition(".")[0] for kind in system.kinds for state in kind.states}
    return [
        free
        for free in free_parameters(system)
        if parameter_of(system, free).unit in UNITS and free.name.rpartition(".")[0] not in moving
    ]


def _delays(system: CompiledSystem) -> list[Free]:
    """Return the timings that a hold or link waits for, or the named time they all follow from."""
    waited = [hold.delay for kind in system.kinds for hold in kind.holds]
    for link in system.links:
        waited += [link.delay, *(pair.delay for pair in link.delays)]
    free = {timing.name for timing in named_times(system) if timing.formula is None}
    return [Free(name) for name in dict.fromkeys(waited) if name in free]


def _lines(
    system: CompiledSystem, free: Sequence[Free], prepared: Prepared, *, slow: bool
) -> Iterator[MatrixLine | AnalysedLine | None]:
    """Yield the line of each parameter from its present value on, None where it can't grow.

    What a stiffness of 0 leaves free is no relative motion of the scene as it is, but one of every scene in
    which it varies: a parameter of 0 varies by itself.
    """
    base = np.array([parameter_of(system, item).value for item in free])
    frees = [item for item, value in zip(free, base, strict=True) if value]
    together = evaluator(system, frees, prepared=prepared) if frees and not slow else None
    for item, present in zip(free, base.tolist(), strict=True):
        limit = parameter_of(system, item).maximum
        most = math.inf if limit is None else limit
        if slow:
            scale = abs(present) or 1.0
            top = min(GROWTH * scale, most)
            line = AnalysedLine(system, item, prepared, present, top, scale)
            yield line if top > present else None
            continue
        if present:
            assert together is not None, "it is among those that are not 0"
            whole = MatrixLine(together, base[base != 0], frees.index(item), present)
        else:
            whole = MatrixLine(evaluator(system, [item], prepared=prepared), np.zeros(1), 0, present)
        top = min(GROWTH * whole.scale, most)
        yield replace(whole, top=top) if top > present else None


def _along(system: CompiledSystem, free: Free, line: MatrixLine | AnalysedLine | None) -> Margin | None:
    """Return the margin of a parameter, None where it can't grow or nothing depends on it."""
    if line is None:
        return None
    result = search(line, first=True)
    if not result.enters:
        return None
    lost = [edge for edge in result.edges if edge.stable_side == "below"]
    present, unit = value_now(system, free), Unit.of(parameter_of(system, free))
    return _margin(free.label, unit, present, lost[0] if lost else None, result.scanned[1])


def _delay_margin(system: CompiledSystem, free: Free, prepared: Prepared, largest: int) -> Margin:
    """Return the margin of a delay, in a scene whose largest loop has so many states."""
    now = delay_now(system, free)
    end, count = delay_reach(system, free, now, pieces=PIECES, further=FURTHER)
    if count > MOST_PIECES:
        return not_looked(system, free, f"{count} orders of events up to {float(end):.4g} s")
    late = all(free.name != hold.delay for kind in system.kinds for hold in kind.holds)
    if largest > MOST_DELAYED and not late:
        return not_looked(system, free, f"{largest:,} states in each order of events")
    try:
        result = search(DelayLine(system, free, prepared, now, end), first=True)
    except ApcError as error:
        return not_looked(system, free, error.mistakes[0].what)
    crossing = result.edges[0] if result.edges else None
    return _margin(free.name, "s", float(now), crossing, result.scanned[1])


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
