"""How much each coupler's stiffness and damping, and each delay, may grow before the boundary.

Takes: a `CompiledSystem`.
Gives: `Margin`, `Margins`, `margins`; `coupler_parameters`; `STIFFNESSES`.
Guarantees: a margin is the next crossing above the present value, with its error; none is said together with
how far was looked.
Does not: look below the present value (see `critical`), or vary two at once (see `box`).

What counts is told by structure: a stiffness or damping by its unit, in a part that has no motion of its own;
a delay by a hold or link that waits for it.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from apc.analysis.analysis import Prepared, lifted_groups, prepare, prepare_at_start
from apc.compiler.compiled import CompiledSystem
from apc.compiler.frozen import dataclass
from apc.compiler.timings import part
from apc.eigen.closing import close_loop
from apc.eigen.eigenpairs import pair_near
from apc.eigen.modes import arrange
from apc.eigen.relative import relative_bounded
from apc.eigen.spectrum import finite
from apc.finite_equations import finite_equations
from apc.frame.names import Free, named_times, parameter_of
from apc.result import Result
from apc.threads import single_threaded
from apc.vary.batch import BatchEvaluator, lifted_here
from apc.vary.crossings import Root, Scan, scan_lines
from apc.vary.delays import delay_now
from apc.vary.evaluator import (
    Asked,
    PointEvaluator,
    evaluator,
    free_parameters,
    keeps_size,
    long_loops,
    mostly_packets,
)
from apc.vary.marginal import marginal_motion
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

if TYPE_CHECKING:  # few scenes are so large
    from apc.vary.one_gain import Gain, Response

Floats = NDArray[np.float64]

# Units of a stiffness and of a damping, as components write them.
STIFFNESSES = ("N/m", "kg/s^2")
UNITS = (*STIFFNESSES, "N*s/m", "kg/s")

# How many times the present value is looked at (or the change that would move an eigenvalue by 1).
GROWTH = 1e3

# How far a delay is looked at: over so many pieces, each from one coincidence of events to the next, mostly
# a tick, and up to so many times its present value; over more pieces than the most it takes too long.
PIECES, FURTHER, MOST_PIECES = 4, 1.5, 64

# The eigenvalues of larger systems are not looked at value by value: where a parameter is a gain, the loop's
# response to it tells the first crossing (see `one_gain`). Balls of these take minutes, bounds of floats do.
FEW_STATES = 60
IN_PASSING = "not looked for in passing: {} states (apc analyze --margins does)"

# Of a larger one nothing is looked at value by value, which takes a minute or two for a delay of 800 states;
# and what the response tells of it is estimated, as a bound takes longer still.
MOST_SCANNED = 1000

# How far beyond a crossing, relative to the way there, an analysis says whether it is one.
BESIDE = 1e-3

# An estimated error is so many times what those of a matrix make of it to first order.
ESTIMATED = 2.0


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
def margins(
    system: CompiledSystem,
    *,
    prepared: Prepared | None = None,
    quick: bool = False,
    rigid: int | None = None,
) -> Margins:
    """Find how much each stiffness, damping and delay may grow, all else as it is.

    Parameters
    ----------
    system
        The compiled scene. One that isn't stable has no margins.
    prepared
        From `analysis.prepare`, of this system with any numbers.
    quick
        Give up, and say so, where the matrices are so large that it would take seconds.
    rigid
        How many rigid motions an analysis found, if there was one: what must be too large without them is
        told before any matrix is made.
    """
    states = max(len(kind.states) for kind in system.kinds)
    if quick and states > FEW_STATES:  # as many in a loop, or nearly: no matrix is made to say so
        return Margins((), IN_PASSING.format(states))
    with single_threaded(), finite_equations(system.origin.topology), np.errstate(all="ignore"):
        prepared = prepared or prepare(system)
        start = prepare_at_start(system, prepared)
        free, at = coupler_parameters(system), start or prepared
        why = _too_large(system, free, at, rigid) if quick and rigid is not None else None
        found = why or _parameter_margins(system, free, at, quick)
        if isinstance(found, str):
            return Margins((), found)
        if start is None:
            why = "how the scene moves hangs on what is heard at the start"
            told = [f"delays were not varied: {why}", *filter(None, [_estimated_in_words(found)])]
            return Margins(tuple(found), "; ".join(told))
        delays = [_delay_margin(system, one, start) for one in _delays(system)]
        return Margins((*found, *delays), _estimated_in_words(found))


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


def _too_large(system: CompiledSystem, free: Sequence[Free], prepared: Prepared, rigid: int) -> str | None:
    """Return that the matrices are too large to do in passing, where their loops tell it; else None."""
    asked = Asked.of(system, free, prepared)
    if not asked.parameters_suffice or long_loops(system, free, prepared):
        return None
    largest = max((loop.states for loop in arrange(*asked.lifted_anywhere()).loops), default=0)
    return IN_PASSING.format(largest) if largest - rigid > FEW_STATES else None


def _parameter_margins(
    system: CompiledSystem, free: Sequence[Free], prepared: Prepared, quick: bool
) -> list[Margin] | str:
    """Return the margins of the parameters that matter, or why there are none."""
    if long_loops(system, free, prepared):
        return _loop_margins(system, free, prepared)
    family = evaluator(system, free, prepared=prepared)
    base = np.array([parameter_of(system, one).value for one in free])
    here = family.matrices(base[None])
    largest = max((one.shape[1] for one in here), default=0)
    if quick and largest > FEW_STATES:
        return IN_PASSING.format(largest)
    if not all(np.isfinite(one).all() for one in here):
        return "not looked for: the present values have no frame matrix of their own"
    lines = [Line(family, base, column) for column in range(len(free))]
    if keeps_size(here) and not base.all():
        family, lines = _apart(system, free, base, prepared)
        here = family.matrices(base[None, base != 0])
    if not _radius(here) < 1:
        return "none: the scene is not stable as it is"
    found: list[Margin | None] = [None] * len(free)
    for which in dict.fromkeys(id(line.family) for line in lines):
        own = [place for place, line in enumerate(lines) if id(line.family) == which]
        ways = [(free[i], lines[i]) for i in own]
        rows = _by_responses(system, ways) if largest > FEW_STATES else _along(system, ways)
        for place, one in zip(own, rows, strict=True):
            found[place] = one
    return [one for one in found if one]


def _by_responses(system: CompiledSystem, ways: Sequence[tuple[Free, Line]]) -> list[Margin | None]:
    """Return the margins of parameters of one evaluator of large systems, None where nothing can grow."""
    from apc.vary.one_gain import NotTold, gains_of, response_of  # few scenes are so large

    line = ways[0][1]
    if not isinstance(line.family, BatchEvaluator):
        return _in_matrices(system, ways, "no gain at ticks")
    matrices = [one[0] for one in line.family.matrices(line.base[None])]
    responses = [response_of(one) for one in matrices]
    found: list[Margin | None] = []
    for free, line in ways:
        assert isinstance(line.family, BatchEvaluator), "all are of one evaluator"
        gains = gains_of(line.family, line.base, line.column)
        known = [(gain, one) for gain, one in zip(gains or (), responses, strict=False) if one is not None]
        if len(known) == len(matrices):
            try:
                found.append(_gain_margin(system, free, line, known))
            except NotTold:
                found += _in_matrices(system, [(free, line)], "no first crossing told by the response")
        else:
            found += _in_matrices(system, [(free, line)], "no gain at ticks")
    return found


def _in_matrices(system: CompiledSystem, ways: Sequence[tuple[Free, Line]], why: str) -> list[Margin | None]:
    """Return the margins of parameters looked at value by value, or rows that say why they are not."""
    line = ways[0][1]
    states = max(len(one[0]) for one, _ in line.course(line.base[[line.column]]))
    if states <= MOST_SCANNED:
        return _along(system, ways)
    why = f"{why}, and {states} states"
    return [
        _not_looked(free.label, parameter_of(system, free).unit, float(line.base[line.column]), why)
        for free, line in ways
    ]


def _gain_margin(
    system: CompiledSystem, free: Free, line: Line, gains: Sequence[tuple[Gain, Response]]
) -> Margin | None:
    """Return the margin of a parameter that acts as a gain, None where nothing can grow or depends on it."""
    from apc.vary.one_gain import first_crossing

    parameter, start = parameter_of(system, free), float(line.base[line.column])
    fastest = max(float(np.abs(response.rates(gain)).max(initial=0.0)) for gain, response in gains)
    if not fastest:
        return None
    scale = abs(start) or 1 / fastest
    top = GROWTH * scale if parameter.maximum is None else min(GROWTH * scale, parameter.maximum)
    if not top > start:
        return None
    root = first_crossing(gains, start, float(top))
    if root is None:
        return _margin(free.label, parameter.unit, start, None, float(top))
    if len(gains[root.system][0].a) > MOST_SCANNED:
        crossing: Crossing | None = _estimated(root, line)
    else:
        beyond = root.value + BESIDE * (root.value - start)
        sides = Scan(np.array([start, beyond]), np.array([True, False]), (root,), whole=True)
        crossing = proved_crossing(root, line, sides, in_balls=False)
    return _margin(free.label, parameter.unit, start, crossing, root.value)


def _estimated(root: Root, line: Line) -> Crossing:
    """Describe a crossing without a bound: by how much errors of the matrix move it, to first order."""
    assert isinstance(line.family, BatchEvaluator), "what acts as a gain has equations"
    wiring = line.family.wirings[root.system]
    point = line.points(np.array([root.value]))[0].tolist()
    closed = close_loop(lifted_here(line.family.with_sites([wiring.system], point))[0])
    matrix, error = relative_bounded(closed.matrix, closed.error, wiring.relative)
    pair = pair_near(matrix, root.eigenvalue)
    doubt = ESTIMATED * float(pair.errors(error)[0]) + abs(abs(complex(pair.values[0])) - 1)
    frequency = marginal_motion([(closed, wiring.rigid)], root.eigenvalue).frequency_hz
    return Crossing(root.value, doubt / root.slope, "below", frequency, "crossing", ESTIMATE)


def _estimated_in_words(rows: Sequence[Margin]) -> str:
    """Return which margins have an estimated error."""
    labels = [one.parameter for one in rows if one.estimated]
    return f"estimated, as a bound takes long: {', '.join(labels)}" if labels else ""


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
            return "none: the scene is not stable as it is"
        roots = [root for root in scanned.roots if root.rising]
        crossing = proved_crossing(roots[0], line, scanned) if roots else None
        unit, reached = parameter_of(system, one).unit, float(scanned.points[-1])
        found.append(_margin(one.label, unit, start, crossing, reached))
    return found


def _along(system: CompiledSystem, ways: Sequence[tuple[Free, Line]]) -> list[Margin | None]:
    """Return the margins of parameters of one evaluator, None where nothing can grow or depends on it.

    Their lines are looked at in step.
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
        crossing = proved_crossing(roots[0], line, scanned) if roots else None
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


def _delay_margin(system: CompiledSystem, free: Free, prepared: Prepared) -> Margin:
    """Return the margin of a delay."""
    now = delay_now(system, free)
    end, count = delay_reach(system, free, now, pieces=PIECES, further=FURTHER)
    present = float(now)
    if count > MOST_PIECES:
        return _not_looked(free.name, "s", present, f"{count} orders of events up to {float(end):.4g} s")
    loops = arrange(*lifted_groups(system, prepared=prepared)).loops
    states = max((loop.states for loop in loops if not mostly_packets(loop)), default=0)
    if states > MOST_SCANNED:
        return _not_looked(free.name, "s", present, f"{states} states in each order of events")
    few = states <= FEW_STATES
    found = search_delay(system, free, now, end, prepared, from_stable=True, in_balls=few)
    return _margin(free.name, "s", present, found.edges[0] if found.edges else None, found.scanned[1])


def _not_looked(name: str, unit: str, present: float, why: str) -> Margin:
    return Margin(name, unit, present, None, None, None, None, "", present, why)


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
