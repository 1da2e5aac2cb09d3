"""Delay segments: frame matrices along a delay, one segment for each order of events.

Takes: a `NumericModel` and a parameter or timing that affects its delays.
Gives: `DelaySegment`, `delay_segments`, `delay_progress`, `borders`; `reaches_parameters`.
Guarantees: segments are contiguous; events coincide at the values between them and nowhere else.
Does not: vary periods or phases: another period changes the frame.

Within a segment the schedule is constant and its steps' durations are linear in the delay. (A link's delay
has no effect within a segment, as packets are read at ticks only.)
"""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from fractions import Fraction
from functools import lru_cache, partial

import numpy as np

from apc.analysis.analysis import lifted_classes
from apc.compiler.compiled import Model, PeerType
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.multiples import common_divisor
from apc.compiler.wording import no_more
from apc.lifting.numeric_model import NumericModel
from apc.parameter_values.parameter_names import ParameterRef
from apc.parameter_values.parameters import resolve
from apc.spectrum.peer_classes import states_of
from apc.studies.frame_matrices import BatchEvaluator, batch_evaluator
from apc.studies.timing_values import STEP, delay_now, model_with_time, timing_slopes
from apc.support.remaining_time import RemainingTime
from apc.timing.schedule import HoldUpdate, Propagate, Schedule

# The limit of segments in one search: each has schedules and matrices, a hundredth of a second and more.
MOST_PIECES = 1_000

# The relative position in a segment at which its schedule is built: an interior point at which no two steps
# are equal by accident, as no time of a model is a multiple of one part in this prime number.
INSIDE = Fraction(28_571, 104_729)


# Cached coincidences by delay, as searches repeat calls; cached segments of each delay, and the largest
# number of states of a cached segment: it takes half a megabyte.
CACHE_SIZE, CACHED_SEGMENTS, FEW_STATES = 16, 16, 120


@dataclass(frozen=True, slots=True)
class DelaySegment:
    """A range of delays, from `low` to `high` seconds, with one order of events.

    The ends are one-sided limits.

    If the model is constant in the segment, `evaluator` is None: `inside`, the model at an interior delay,
    represents the segment.
    """

    low: Fraction
    high: Fraction
    evaluator: BatchEvaluator | None
    inside: Model


def delay_segments(
    numeric: NumericModel,
    parameter_ref: ParameterRef,
    low: Fraction,
    *,
    location: SourceLocation,
    high: Fraction,
) -> Iterator[DelaySegment]:
    """Yield the segments of a delay from a value upwards.

    Parameters
    ----------
    numeric
        The model with its parameter values.
    parameter_ref
        The timing, or the parameter that affects timings.
    low
        The start of the range.
    location
        The location of the name, for messages.
    high
        The end of the range, which the last segment contains.

    Raises
    ------
    ApcError
        E844 a period or phase, or a timing that is not linear in the parameter; E846 too many segments up to
        `high`.
    """
    following = borders(numeric.model, parameter_ref, location=location)
    _segment_count(parameter_ref, low, high, following, location)
    segment_between = _segments(numeric, parameter_ref)
    while low < high:
        end = following(low)
        yield segment_between(low, end)
        low = end


@lru_cache(maxsize=CACHE_SIZE)
def _segments(
    numeric: NumericModel, parameter_ref: ParameterRef
) -> Callable[[Fraction, Fraction], DelaySegment]:
    """Return the function that builds the segment between two values, cached for models of few states."""
    model = numeric.model
    slopes, follows = timing_slopes(model, parameter_ref), reaches_parameters(model, parameter_ref)
    build = partial(_segment, numeric, parameter_ref, slopes=slopes, follows=follows)
    states = sum(map(states_of, numeric.schedules, numeric.subsystems))
    return lru_cache(maxsize=CACHED_SEGMENTS)(build) if states <= FEW_STATES else build


def delay_progress(
    model: Model,
    parameter_ref: ParameterRef,
    low: Fraction,
    high: Fraction,
    *,
    location: SourceLocation,
    progress: Callable[[str], None] | None,
) -> Callable[[Fraction], None]:
    """Return the function that reports the progress of a search over a delay, called with each segment's end.

    Parameters
    ----------
    model, parameter_ref, low, high, location
        As for `delay_segments`, with the same errors.
    progress
        The receiver of texts with the elapsed time, and with the remaining time if it can be estimated.
    """
    pieces = _segment_count(
        parameter_ref, low, high, borders(model, parameter_ref, location=location), location
    )
    remaining, done = RemainingTime(), 0

    def report_progress(value: Fraction) -> None:
        """Report the progress up to this value, with the elapsed time."""
        nonlocal done
        if progress:
            times = remaining.text(done, pieces)
            progress(f"{parameter_ref.label} up to {float(value):.6g} s of {float(high):.6g} s: {times}")
        done += 1

    return report_progress


def _segment_count(
    parameter_ref: ParameterRef,
    low: Fraction,
    high: Fraction,
    next_border: Callable[[Fraction], Fraction],
    location: SourceLocation,
) -> int:
    """Return the number of segments in a range of delays.

    Parameters
    ----------
    parameter_ref, location
        The delay, and the location for errors.
    low, high
        The range in seconds.
    next_border
        Returns the next larger delay at which events coincide (see `borders`).

    Raises
    ------
    ApcError
        E846 more segments than the limit.
    """
    border = low
    for count in range(1, MOST_PIECES + 1):
        border = next_border(border)
        if border >= high:
            return count
    message = (
        f"from {float(low):.6g} s to {float(high):.6g} s events coincide at more than {MOST_PIECES:,} "
        f"values of {parameter_ref.label}, the limit of the search"
    )
    raise ApcError(Diagnostic("E846", location, message, advice=f"use a range up to {no_more(border)} s"))


@lru_cache(maxsize=CACHE_SIZE)
def borders(
    model: Model, parameter_ref: ParameterRef, *, location: SourceLocation
) -> Callable[[Fraction], Fraction]:
    """Return the function from a delay to the next larger delay at which events coincide.

    A held value acts a delay after each tick of its clock: it may coincide with a tick of any clock, or with
    the action of another delay. A packet is read at ticks. Two clocks of periods P and Q coincide at every
    multiple of their common divisor.

    Raises
    ------
    ApcError
        E844 a period or phase, or a timing that is not linear in the parameter.
    """
    fixed = {time for clock in model.clocks for time in (clock.period, clock.phase)}
    if parameter_ref.name in fixed:
        raise _clock_time_error(parameter_ref, location)
    now = delay_now(model, parameter_ref)
    timings_at = [
        resolve(model_with_time(model, parameter_ref, now + share * STEP)).timings for share in (0, 1, 2)
    ]
    slopes = timing_slopes(model, parameter_ref)
    if any(slopes[name] for name in fixed):
        raise _clock_time_error(parameter_ref, location)
    for name, slope in slopes.items():
        if timings_at[2][name] != timings_at[0][name] + 2 * slope * STEP:
            message = f"{name} is not linear in {parameter_ref.name}, so its critical value can't be searched"
            raise ApcError(Diagnostic("E844", location, message))
    clocks = {clock.name: clock for clock in model.clocks}
    holds = dict.fromkeys(
        (hold.clock, hold.delay) for peer_type in model.peer_types for hold in peer_type.holds
    )
    packets = dict.fromkeys((link.clock_at(delay), delay) for link in model.links for delay in link.delays)
    ticks = [(name, "") for name in clocks]
    event_pairs = [
        *itertools.product(holds, [*ticks, *holds]),
        *itertools.product(packets, ticks),
    ]
    conditions = set()
    for first_event, second_event in event_pairs:
        # Of each event: its clock, its delay, and the slope of the delay.
        first, second = (
            (clocks[clock], timings_at[0].get(delay, Fraction(0)), slopes.get(delay, Fraction(0)))
            for clock, delay in (first_event, second_event)
        )
        slope = first[2] - second[2]
        if slope:
            separation = timings_at[0][first[0].phase] + first[1] - timings_at[0][second[0].phase] - second[1]
            divisor = common_divisor([timings_at[0][first[0].period], timings_at[0][second[0].period]])
            conditions.add((separation - slope * now, slope, divisor))

    def following(value: Fraction) -> Fraction:
        """Return the smallest larger value at which some constant + slope · value is a multiple of its
        divisor.
        """
        candidates = []
        for constant, slope, divisor in conditions:
            count = (constant + slope * value) / divisor
            number = math.floor(count) + 1 if slope > 0 else math.ceil(count) - 1
            candidates.append((number * divisor - constant) / slope)
        return min(candidates, default=value + (now or 1))

    return following


def reaches_parameters(model: Model, parameter_ref: ParameterRef) -> bool:
    """Return whether a number that affects delays is also an equation parameter, or affects one."""
    first, second = (
        resolve(model_with_time(model, parameter_ref, value)).parameters
        for value in (Fraction(1), Fraction(2))
    )
    return not all(np.array_equal(*pair) for pair in zip(first, second, strict=True))


def _clock_time_error(parameter_ref: ParameterRef, location: SourceLocation) -> ApcError:
    """Return the error E844 for a number that affects the period or phase of a clock."""
    message = f"{parameter_ref.name} changes a clock period and the frame, so it can't be varied continuously"
    return ApcError(
        Diagnostic("E844", location, message, advice="analyze single values with apc analyze --set")
    )


def _segment(
    numeric: NumericModel,
    parameter_ref: ParameterRef,
    low: Fraction,
    high: Fraction,
    *,
    slopes: Mapping[str, Fraction],
    follows: bool,
) -> DelaySegment:
    """Return one segment of a delay, with its evaluator from the schedules at an interior value.

    Parameters
    ----------
    numeric, parameter_ref
        The model with its parameter values, and the delay.
    low, high
        The ends of the segment in seconds.
    slopes
        The slope of each timing with respect to the delay.
    follows
        Whether any coefficient may depend on the delay, not only the time between events.
    """
    model = numeric.model
    delay = low + INSIDE * (high - low)
    inside = numeric.at(model_with_time(model, parameter_ref, delay))
    durations: dict[int, tuple[float, float]] = {}
    for schedule, group in zip(inside.schedules, model.groups, strict=True):
        for quanta, slope in _duration_slopes(schedule, model.peer_types[group.peer_type], slopes).items():
            durations[quanta] = (float(quanta * schedule.quantum - slope * delay), float(slope))
    if not follows and not any(slope for _, slope in durations.values()):
        return DelaySegment(low, high, None, inside.model)
    peer_classes, comm_graph = lifted_classes(inside)
    evaluator = batch_evaluator(
        inside.model, (parameter_ref,), peer_classes, comm_graph, durations=durations, follows=follows
    )
    return DelaySegment(low, high, evaluator, inside.model)


def _duration_slopes(
    schedule: Schedule, peer_type: PeerType, slopes: Mapping[str, Fraction]
) -> Mapping[int, Fraction]:
    """Return the slope of each step's duration with respect to a delay, by the step's quanta.

    Only the updates of holds move with the delay. `slopes` are those of the timings.
    """
    slope_of_step: dict[int, Fraction] = {}
    quanta, start_slope, slopes_of_events = 0, Fraction(0), set[Fraction]()
    for event in (*schedule.events, Propagate(0)):
        if not isinstance(event, Propagate):
            slopes_of_events.add(
                slopes[peer_type.holds[event.hold].delay] if isinstance(event, HoldUpdate) else Fraction(0)
            )
            continue
        (end_slope,) = slopes_of_events or {Fraction(0)}
        if quanta:
            assert slope_of_step.setdefault(quanta, end_slope - start_slope) == end_slope - start_slope, (
                "two steps are equal by accident"
            )
        quanta, start_slope, slopes_of_events = event.duration, end_slope, set()
    return slope_of_step
