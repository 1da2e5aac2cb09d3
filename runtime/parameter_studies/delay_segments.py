"""Delay segments: frame matrices along a delay, one segment for each order of events.

Takes: a `Model` and a parameter or timing that affects its delays.
Gives: `DelaySegment`, `delay_segments`, `delay_progress`, `borders`; `reaches_parameters`.
Guarantees: segments are contiguous; events coincide at the values between them and nowhere else.
Does not: vary periods or phases: another period changes the frame.

Within a segment the schedule is constant and its steps' durations are linear in the delay. (A link's delay
has no effect within a segment, as packets are read at ticks only.)
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
from apc.compiler.wording import no_more, time_left
from apc.eigen.peer_classes import states_of
from apc.frame.numeric_model import Prepared, prepared_at
from apc.frame.parameter_names import ParameterRef
from apc.frame.parameters import resolve
from apc.frame.schedule import HoldUpdate, Propagate, Schedule
from apc.parameter_studies.evaluator import EvaluatorKey
from apc.parameter_studies.frame_matrices import BatchEvaluator, batch_evaluator
from apc.parameter_studies.timing_values import STEP, delay_now, system_with_delay, timing_slopes

# The limit of segments in one search: each has schedules and matrices, a hundredth of a second and more.
MOST_PIECES = 1_000

# The relative position in a segment at which its schedule is built: any interior point will do, but no two
# steps should be equal there by accident. No time of a model is a multiple of one part in this prime number.
INSIDE = Fraction(28_571, 104_729)


# Cached coincidences by delay, as a search repeats calls; cached segments of each, and the largest number of
# states: a segment of that size takes half a megabyte.
CACHE_SIZE, CACHED_SEGMENTS, FEW_STATES = 16, 16, 120


@dataclass(frozen=True, slots=True)
class DelaySegment:
    """Delays between `low` and `high` seconds; the ends are one-sided limits.

    A segment in which nothing depends on the delay has no `evaluator`: `inside`, the model at one of its
    delays, represents all.
    """

    low: Fraction
    high: Fraction
    evaluator: BatchEvaluator | None
    inside: Model


def delay_segments(
    system: Model,
    free: ParameterRef,
    low: Fraction,
    prepared: Prepared,
    *,
    location: SourceLocation,
    high: Fraction,
) -> Iterator[DelaySegment]:
    """Yield the segments from a value upwards.

    Parameters
    ----------
    system
        The compiled model.
    free
        The timing, or the parameter that affects timings.
    low
        The start of the range.
    prepared
        From `numeric_model.prepare`.
    location
        The location of the name, for messages.
    high
        The last segment contains this value, or ends with it.

    Raises
    ------
    ApcError
        E844 a period or phase, or a timing that is not linear in the parameter; E846 too many segments up to
        `high`.
    """
    following = borders(system, free, location=location)
    _count(free, low, high, following, location)
    piece = _segments(EvaluatorKey.of(system, [free], prepared))
    while low < high:
        end = following(low)
        yield piece(low, end)
        low = end


@lru_cache(maxsize=CACHE_SIZE)
def _segments(of: EvaluatorKey) -> Callable[[Fraction, Fraction], DelaySegment]:
    """Return the function that builds the segment between two values, with a cache for few states."""
    (free,) = of.free
    slopes, follows = timing_slopes(of.system, free), reaches_parameters(of.system, free)
    build = partial(_segment, of.system, free, prepared=of.prepared, slopes=slopes, follows=follows)
    used = zip(of.prepared.schedules, of.system.groups, strict=True)
    states = sum(states_of(schedule, of.prepared.jacobians[group.peer_type]) for schedule, group in used)
    return lru_cache(maxsize=CACHED_SEGMENTS)(build) if states <= FEW_STATES else build


def delay_progress(
    system: Model,
    free: ParameterRef,
    low: Fraction,
    high: Fraction,
    *,
    location: SourceLocation,
    progress: Callable[[str], None] | None,
) -> Callable[[Fraction], None]:
    """Return the progress function of a search over a delay, called as each segment begins with its end.

    Parameters
    ----------
    system, free, low, high, location
        As for `delay_segments`, which raises the same.
    progress
        Receives a text with the remaining time, estimated from the segments so far.
    """
    pieces = _count(free, low, high, borders(system, free, location=location), location)
    begun, done = time.monotonic(), 0

    def report_progress(value: Fraction) -> None:
        nonlocal done
        if progress:
            left = time_left(time.monotonic() - begun, done, pieces)
            progress(f"looking at {free.label} up to {float(value):.6g} s of {float(high):.6g} s{left}")
        done += 1

    return report_progress


def _count(
    free: ParameterRef,
    low: Fraction,
    high: Fraction,
    following: Callable[[Fraction], Fraction],
    location: SourceLocation,
) -> int:
    """Return the number of segments in a range; raise an error beyond the limit."""
    at = low
    for count in range(1, MOST_PIECES + 1):
        at = following(at)
        if at >= high:
            return count
    message = (
        f"from {float(low):.6g} to {float(high):.6g} (SI) events coincide at more than {MOST_PIECES:,} "
        f"values of {free.label}, the most that are searched"
    )
    raise ApcError(Diagnostic("E846", location, message, hint=f"a range up to {no_more(at)} s"))


@lru_cache(maxsize=CACHE_SIZE)
def borders(system: Model, free: ParameterRef, *, location: SourceLocation) -> Callable[[Fraction], Fraction]:
    """Return the function for the next value at which events coincide that do not at lower values.

    A held value acts a delay after each tick of its clock: it may coincide with a tick of any clock, or with
    the action of another delay. A packet is read at ticks. Two rhythms of periods P and Q meet at every
    multiple of their common divisor.

    Raises
    ------
    ApcError
        E844 a period or phase, or a timing that is not linear in the parameter.
    """
    fixed = {time for clock in system.clocks for time in (clock.period, clock.phase)}
    if free.name in fixed:
        raise _rhythm(free, location)
    now = delay_now(system, free)
    at = [resolve(system_with_delay(system, free, now + share * STEP)).timings for share in (0, 1, 2)]
    slopes = timing_slopes(system, free)
    if any(slopes[name] for name in fixed):
        raise _rhythm(free, location)
    for name, slope in slopes.items():
        if at[2][name] != at[0][name] + 2 * slope * STEP:
            message = f"{name} is not linear in {free.name}: its critical value can't be searched"
            raise ApcError(Diagnostic("E844", location, message))
    clocks = {clock.name: clock for clock in system.clocks}
    holds = dict.fromkeys(
        (hold.clock, hold.delay) for peer_type in system.peer_types for hold in peer_type.holds
    )
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
            separation = at[0][first[0].phase] + first[1] - at[0][second[0].phase] - second[1]
            divisor = common_divisor([at[0][first[0].period], at[0][second[0].period]])
            result.add((separation - slope * now, slope, divisor))

    def following(value: Fraction) -> Fraction:
        """Return the smallest larger value at which some constant + slope·value is a multiple of its step."""
        nearest = []
        for constant, slope, divisor in result:
            count = (constant + slope * value) / divisor
            number = math.floor(count) + 1 if slope > 0 else math.ceil(count) - 1
            nearest.append((number * divisor - constant) / slope)
        return min(nearest, default=value + (now or 1))

    return following


def reaches_parameters(system: Model, free: ParameterRef) -> bool:
    """Return whether a number that affects the delays is, or changes, an equation parameter as well."""
    here, there = (
        resolve(system_with_delay(system, free, value)).parameters for value in (Fraction(1), Fraction(2))
    )
    return not all(np.array_equal(*pair) for pair in zip(here, there, strict=True))


def _rhythm(free: ParameterRef, location: SourceLocation) -> ApcError:
    message = (
        f"{free.name} sets the rhythm of a clock, and with it the frame: it can't be varied continuously"
    )
    return ApcError(Diagnostic("E844", location, message, hint="apc analyze with --set, one value at a time"))


def _segment(
    system: Model,
    free: ParameterRef,
    low: Fraction,
    high: Fraction,
    *,
    prepared: Prepared,
    slopes: Mapping[str, Fraction],
    follows: bool,
) -> DelaySegment:
    """Return the evaluator of one segment from its schedules at an interior value."""
    value = low + INSIDE * (high - low)
    inside = system_with_delay(system, free, value)
    shared = prepared_at(system, prepared, resolve(inside).timings)
    durations: dict[int, tuple[float, float]] = {}
    for schedule, group in zip(shared.schedules, system.groups, strict=True):
        for quanta, slope in _steps(schedule, system.peer_types[group.peer_type], slopes).items():
            durations[quanta] = (float(quanta * schedule.quantum - slope * value), float(slope))
    if not follows and not any(slope for _, slope in durations.values()):
        return DelaySegment(low, high, None, inside)
    groups, exchange = lifted_groups(inside, prepared=shared)
    evaluator = batch_evaluator(inside, (free,), groups, exchange, durations=durations, follows=follows)
    return DelaySegment(low, high, evaluator, inside)


def _steps(schedule: Schedule, peer_type: PeerType, slopes: Mapping[str, Fraction]) -> Mapping[int, Fraction]:
    """Return the slope of each step's duration, by its quanta: only actions of holds move."""
    result: dict[int, Fraction] = {}
    step, start, moving = 0, Fraction(0), set[Fraction]()
    for event in (*schedule.events, Propagate(0)):
        if not isinstance(event, Propagate):
            moving.add(
                slopes[peer_type.holds[event.hold].delay] if isinstance(event, HoldUpdate) else Fraction(0)
            )
            continue
        (end,) = moving or {Fraction(0)}
        if step:
            assert result.setdefault(step, end - start) == end - start, "two steps are equal by accident"
        step, start, moving = event.duration, end, set()
    return result
