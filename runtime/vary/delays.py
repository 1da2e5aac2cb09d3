"""A system's frame matrices as a delay varies: piece by piece, as far as the order of events stays the same.

Takes: a `Model` and a parameter or timing that reaches its delays.
Gives: `DelaySegment`, `delay_pieces`, `pace`, `borders`; `reaches_parameters`.
Guarantees: pieces join on without a gap; events coincide at the values between them and nowhere else.
Does not: vary periods or phases: another period is another frame.

Within a piece the schedule stays and its steps' durations are linear in the delay. (Over a link nothing
changes within a piece at all, as a packet is read at ticks only.)
"""

from __future__ import annotations

import itertools
import math
import time
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial

import numpy as np

from apc.analysis.analysis import lifted_groups
from apc.compiler.compiled import Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.multiples import common_divisor
from apc.compiler.words import no_more, time_left
from apc.eigen.peers import states_of
from apc.frame.instance import Prepared, prepared_at
from apc.frame.names import ParameterRef
from apc.frame.parameters import resolve
from apc.frame.schedule import HoldUpdate, Propagate, Schedule
from apc.vary.batch import BatchEvaluator, batch_evaluator
from apc.vary.evaluator import EvaluatorKey
from apc.vary.timing_values import STEP, delay_now, system_with_delay, timing_slopes

# Pieces of one search: each is some schedules and matrices, a hundredth of a second and more.
MOST_PIECES = 1_000

# Where in a piece its schedule is looked at: anywhere inside will do, but no two of its steps should be equal
# there by accident. No time of a scene is a multiple of one part in this prime number.
INSIDE = Fraction(28_571, 104_729)


# Delays of which it is kept where events coincide: a search asks again and again; pieces of each that are,
# and of how many states at most: a piece of these takes half a megabyte.
KEPT, KEPT_PIECES, FEW_STATES = 16, 16, 120


@dataclass(frozen=True, slots=True)
class DelaySegment:
    """Delays between `low` and `high` seconds; the ends are limits from within.

    Where nothing depends on the delay within the piece it has no `evaluator`: `inside`, the scene at one of
    its delays, stands for all.
    """

    low: Fraction
    high: Fraction
    evaluator: BatchEvaluator | None
    inside: Model


def delay_pieces(
    system: Model,
    free: ParameterRef,
    low: Fraction,
    prepared: Prepared,
    *,
    place: SourceLocation,
    high: Fraction,
) -> Iterator[DelaySegment]:
    """Yield the pieces from a value on upwards.

    Parameters
    ----------
    system
        The compiled scene.
    free
        The timing, or the parameter that reaches timings.
    low
        Where to begin.
    prepared
        From `instance.prepare`.
    place
        Where the name was given, for messages.
    high
        The last piece is the one this lies in, or ends with.

    Raises
    ------
    ApcError
        E844 a period or phase, or what is not linear in the parameter; E846 too many pieces up to `high`.
    """
    following = borders(system, free, place=place)
    _count(free, low, high, following, place)
    piece = _pieces(EvaluatorKey.of(system, [free], prepared))
    while low < high:
        end = following(low)
        yield piece(low, end)
        low = end


@lru_cache(maxsize=KEPT)
def _pieces(of: EvaluatorKey) -> Callable[[Fraction, Fraction], DelaySegment]:
    """Return what builds the piece between two values, and of few states keeps it for the next question."""
    (free,) = of.free
    slopes, follows = timing_slopes(of.system, free), reaches_parameters(of.system, free)
    build = partial(_piece, of.system, free, prepared=of.prepared, slopes=slopes, follows=follows)
    used = zip(of.prepared.schedules, of.system.groups, strict=True)
    states = sum(states_of(schedule, of.prepared.jacobians[group.kind]) for schedule, group in used)
    return lru_cache(maxsize=KEPT_PIECES)(build) if states <= FEW_STATES else build


def pace(
    system: Model,
    free: ParameterRef,
    low: Fraction,
    high: Fraction,
    *,
    place: SourceLocation,
    progress: Callable[[str], None] | None,
) -> Callable[[Fraction], None]:
    """Return what tells, as each piece begins and is given its end, how far a search over a delay is.

    Parameters
    ----------
    system, free, low, high, place
        As for `delay_pieces`, which raises the same.
    progress
        Is told, in words, with the time that is left if the other pieces take as long as those before.
    """
    pieces = _count(free, low, high, borders(system, free, place=place), place)
    begun, done = time.monotonic(), 0

    def tell(value: Fraction) -> None:
        nonlocal done
        if progress:
            left = time_left(time.monotonic() - begun, done, pieces)
            progress(f"looking at {free.label} up to {float(value):.6g} s of {float(high):.6g} s{left}")
        done += 1

    return tell


def _count(
    free: ParameterRef,
    low: Fraction,
    high: Fraction,
    following: Callable[[Fraction], Fraction],
    place: SourceLocation,
) -> int:
    """Return how many pieces a range has; refuse one of which nobody will see the end."""
    at = low
    for count in range(1, MOST_PIECES + 1):
        at = following(at)
        if at >= high:
            return count
    what = (
        f"from {float(low):.6g} to {float(high):.6g} (SI) events coincide at more than {MOST_PIECES:,} "
        f"values of {free.label}, the most that are searched"
    )
    raise ApcError(Diagnostic("E846", place, what, hint=f"a range up to {no_more(at)} s"))


@lru_cache(maxsize=KEPT)
def borders(system: Model, free: ParameterRef, *, place: SourceLocation) -> Callable[[Fraction], Fraction]:
    """Return what gives the next value at which events coincide that don't at the values before it.

    What is held acts a delay after each tick of its clock: it may coincide with a tick of any clock, or with
    what another delay lets act. A packet is read at ticks. Two rhythms of periods P and Q meet at every
    multiple of their common divisor.

    Raises
    ------
    ApcError
        E844 a period or phase, or what is not linear in the parameter.
    """
    fixed = {time for clock in system.clocks for time in (clock.period, clock.phase)}
    if free.name in fixed:
        raise _rhythm(free, place)
    now = delay_now(system, free)
    at = [resolve(system_with_delay(system, free, now + share * STEP)).timings for share in (0, 1, 2)]
    slopes = timing_slopes(system, free)
    if any(slopes[name] for name in fixed):
        raise _rhythm(free, place)
    for name, slope in slopes.items():
        if at[2][name] != at[0][name] + 2 * slope * STEP:
            what = f"{name} is not linear in {free.name}: its critical value can't be searched"
            raise ApcError(Diagnostic("E844", place, what))
    clocks = {clock.name: clock for clock in system.clocks}
    holds = dict.fromkeys((hold.clock, hold.delay) for kind in system.kinds for hold in kind.holds)
    packets = dict.fromkeys(
        (link.clock, delay)
        for link in system.links
        for delay in (link.delay, *(pair.delay for pair in link.delays))
    )
    ticks = [(name, "") for name in clocks]
    meetings = [
        *itertools.product(holds, [*ticks, *holds]),
        *itertools.product(packets, ticks),
    ]
    result = set()
    for item, other in meetings:
        first, second = (
            (clocks[clock], at[0].get(delay, Fraction(0)), slopes.get(delay, Fraction(0)))
            for clock, delay in (item, other)
        )
        slope = first[2] - second[2]
        if slope:
            apart = at[0][first[0].phase] + first[1] - at[0][second[0].phase] - second[1]
            divisor = common_divisor([at[0][first[0].period], at[0][second[0].period]])
            result.add((apart - slope * now, slope, divisor))

    def following(value: Fraction) -> Fraction:
        """Return the least larger value at which some constant + slope·value is a multiple of its divisor."""
        nearest = []
        for constant, slope, divisor in result:
            count = (constant + slope * value) / divisor
            number = math.floor(count) + 1 if slope > 0 else math.ceil(count) - 1
            nearest.append((number * divisor - constant) / slope)
        return min(nearest, default=value + (now or 1))

    return following


def reaches_parameters(system: Model, free: ParameterRef) -> bool:
    """Say whether what reaches the delays is, or changes, a parameter of the equations as well."""
    here, there = (
        resolve(system_with_delay(system, free, value)).parameters for value in (Fraction(1), Fraction(2))
    )
    return not all(np.array_equal(*pair) for pair in zip(here, there, strict=True))


def _rhythm(free: ParameterRef, place: SourceLocation) -> ApcError:
    what = f"{free.name} sets the rhythm of a clock, and with it the frame: it can't be varied continuously"
    return ApcError(Diagnostic("E844", place, what, hint="apc analyze with --set, one value at a time"))


def _piece(
    system: Model,
    free: ParameterRef,
    low: Fraction,
    high: Fraction,
    *,
    prepared: Prepared,
    slopes: Mapping[str, Fraction],
    follows: bool,
) -> DelaySegment:
    """Build the evaluator of one piece from its schedules at a value inside."""
    value = low + INSIDE * (high - low)
    inside = system_with_delay(system, free, value)
    shared = prepared_at(system, prepared, resolve(inside).timings)
    durations: dict[int, tuple[float, float]] = {}
    for schedule, group in zip(shared.schedules, system.groups, strict=True):
        for quanta, slope in _steps(schedule, system.kinds[group.kind], slopes).items():
            durations[quanta] = (float(quanta * schedule.quantum - slope * value), float(slope))
    if not follows and not any(slope for _, slope in durations.values()):
        return DelaySegment(low, high, None, inside)
    groups, exchange = lifted_groups(inside, prepared=shared)
    evaluator = batch_evaluator(inside, (free,), groups, exchange, durations=durations, follows=follows)
    return DelaySegment(low, high, evaluator, inside)


def _steps(schedule: Schedule, kind: PeerType, slopes: Mapping[str, Fraction]) -> Mapping[int, Fraction]:
    """Return how fast each step grows, by its quanta: only what is held moves, all else is at its ticks."""
    result: dict[int, Fraction] = {}
    step, start, moving = 0, Fraction(0), set[Fraction]()
    for event in (*schedule.events, Propagate(0)):
        if not isinstance(event, Propagate):
            moving.add(slopes[kind.holds[event.hold].delay] if isinstance(event, HoldUpdate) else Fraction(0))
            continue
        (end,) = moving or {Fraction(0)}
        if step:
            assert result.setdefault(step, end - start) == end - start, "two steps are equal by accident"
        step, start, moving = event.duration, end, set()
    return result
