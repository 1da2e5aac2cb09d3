"""The parameters with sliders, and the values that each can take.

Takes: a `Model`.
Gives: `Slider`, `sliders_of`, `set_to`, `with_value`; `text_of`, `position_of`, `overrides_of`, `axes_of`;
`is_number`, `is_position`, `is_member_of`.
Guarantees: every value is an exact rational within the parameter's bounds, including the model's value. The
value text of a slider is valid for `apc --set`.
Does not: draw, or analyze.
"""

from __future__ import annotations

import sys
from bisect import bisect_left
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, floor, lcm, log10
from typing import Any

from apc.compiler.compiled import Model, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import with_unit
from apc.frame.display_units import as_shown
from apc.frame.linearize import start_names
from apc.frame.overrides import Override, parse_override
from apc.frame.parameter_names import ParameterRef, Range, named_times, parameter_of, times_of, unit_of
from apc.parameter_studies.evaluator import free_parameters
from apc.parameter_studies.margins import STIFFNESSES, coupler_parameters

# Largest number of values of a slider: one per pixel of its length.
STEPS = 200
# The range of a positive parameter in decades to either side of its value; values per decade.
DECADES, A_DECADE = 2, 48
# Digits of a value on a logarithmic slider.
DIGITS = 3
# Frames of more ticks than this take longer than a slider may.
MOST_TICKS = 200
# A clock's periods are these multiples and shares of the other clocks' periods.
RATIOS = 16
# Beyond the present value, as a share of it, a range goes on at least so far.
ROOM = Fraction(3)
# Fewest and most peers of a group, beyond the present count.
COUNTS = 4

PARAMETERS, TIMES, PEOPLE = "parameters", "delays and periods", "users"


@dataclass(frozen=True, slots=True)
class Slider:
    """A parameter with its ascending SI values and their texts; `start` is the index of the model's value.

    `kind` is one of `PARAMETERS`, `TIMES` and `PEOPLE`; `span` is the range an axis of a region has, None
    where it can't be one.
    """

    free: ParameterRef
    unit: str
    kind: str
    description: str
    values: tuple[Fraction, ...]
    texts: tuple[str, ...]
    start: int
    span: tuple[Fraction, Fraction] | None

    @property
    def label(self) -> str:
        """The name as `--set` takes it."""
        return self.free.label


def sliders_of(system: Model) -> tuple[Slider, ...]:
    """Return the sliders of a model: independent parameters, and each group's number of peers.

    Parameters
    ----------
    system
        The model, with the numbers that the sliders begin with. What it studies comes first, then
        its couplers' stiffnesses and dampings: the first two are the axes of the region.
    """
    starts = start_names(system)
    studied = {axis.parameter: (axis.low, axis.high) for axis in system.region}
    sliders = []
    for free in free_parameters(system):
        parameter = parameter_of(system, free)
        if free.name in starts and parameter.value == 0:
            continue  # where nothing is said of a start, nobody looks for a slider of it
        low, high = _bounds(system, free)
        span = studied.get(free.label) or _span(system, free, parameter.number, low, high)
        if parameter.value > 0 and parameter.unit != "1" and free.label not in studied:
            values = _decades(parameter.number, low, high)
        else:
            values = _even(parameter.number, *_within(span, parameter.number), low, high)
        sliders.append(
            _slider(system, free, PARAMETERS, parameter.description, values, parameter.number, span)
        )
    couplers = coupler_parameters(system)
    couplers.sort(key=lambda coupler: unit_of(system, coupler.name) not in STIFFNESSES)
    listed = [*studied, *(coupler.label for coupler in couplers)]
    sliders.sort(key=lambda slider: listed.index(slider.label) if slider.label in listed else len(listed))
    return (*sliders, *_times(system, studied), *_people(system))


def _slider(
    system: Model,
    free: ParameterRef,
    kind: str,
    description: str,
    values: Iterable[Fraction],
    now: Fraction,
    span: tuple[Fraction, Fraction] | None,
) -> Slider:
    unit = unit_of(system, free.name)
    listed = tuple(sorted({*values, now}))
    texts = tuple(text_of(number, unit) for number in listed)
    return Slider(free, unit, kind, description, listed, texts, listed.index(now), span)


def text_of(value: Fraction, unit: str) -> str:
    """Return a value as `--set` takes it, in the unit in which people are shown it."""
    by, shown = as_shown(float(value), unit)
    return with_unit(_digits(value * by), shown)


def _digits(value: Fraction) -> str:
    """Return a number as the language reads it: the same rational again."""
    near = f"{float(value):.12g}"
    return near if Fraction(near) == value else repr(float(value)) if _is_float(value) else str(value)


def _is_float(value: Fraction) -> bool:
    return Fraction(repr(float(value))) == value


def _bounds(system: Model, free: ParameterRef) -> tuple[Fraction | None, Fraction | None]:
    """Return the least and the largest value a parameter may have; above an open bound, a little more."""
    parameter = parameter_of(system, free)
    low = None if parameter.minimum is None else Fraction(repr(parameter.minimum))
    if low is not None and parameter.exclusive_minimum:
        low += abs(parameter.number - low) / 10**DECADES
    return low, None if parameter.maximum is None else Fraction(repr(parameter.maximum))


def _span(
    system: Model, free: ParameterRef, now: Fraction, low: Fraction | None, high: Fraction | None
) -> tuple[Fraction, Fraction]:
    """Return a range around a value: all that it may be, or to `ROOM` times it, below 0 too if it may."""
    if low is not None and high is not None:
        return low, high
    interchangeable = [
        abs(parameter.number)
        for parameter in system.parameters
        if parameter.unit == unit_of(system, free.name)
    ]
    size = abs(now) or max(interchangeable, default=Fraction(0)) or Fraction(1)
    least = -ROOM * size if low is None else low
    most = _nice(ROOM * size)
    return least, min(most, high) if high is not None else most


def _within(span: tuple[Fraction, Fraction], value: Fraction) -> tuple[Fraction, Fraction]:
    return min(span[0], value), max(span[1], value)


def _nice(value: Fraction) -> Fraction:
    """Return a positive number rounded up to two digits."""
    unit = Fraction(10) ** (floor(log10(float(value))) - 1)
    return ceil(value / unit) * unit


def _even(
    now: Fraction, least: Fraction, most: Fraction, low: Fraction | None, high: Fraction | None
) -> list[Fraction]:
    """Return values in even steps of a round size."""
    exact = (most - least) / STEPS
    power = Fraction(10) ** floor(log10(float(exact)))
    step = next(power * number for number in (1, 2, 5, 10) if power * number >= exact)
    values = [step * k for k in range(ceil(least / step), floor(most / step) + 1)]
    ends = [
        number
        for number in (least, most)
        if (low is None or number >= low) and (high is None or number <= high)
    ]
    return [*values, *ends, now]


def _decades(now: Fraction, low: Fraction | None, high: Fraction | None) -> list[Fraction]:
    """Return values of few digits, even on a logarithmic scale."""
    middle = log10(float(now))
    count = DECADES * A_DECADE
    listed = [Fraction(f"{10 ** (middle + k / A_DECADE):.{DIGITS}g}") for k in range(-count, count + 1)]
    return [
        number for number in listed if (low is None or number >= low) and (high is None or number <= high)
    ]


def _times(system: Model, studied: dict[str, tuple[Fraction, Fraction]]) -> list[Slider]:
    """Return the sliders of delays, phases and periods that follow from nothing."""
    periods = {clock.period: clock for clock in system.clocks}
    phases = {clock.phase: clock for clock in system.clocks}
    now = {timing.name: timing.value for timing in system.timings}
    longest = max((now[name] for name in periods), default=Fraction(1))
    sliders = []
    for timing in named_times(system):
        free, value = ParameterRef(timing.name), timing.value
        if timing.formula is not None:
            continue
        span = None
        if timing.name in periods:
            description, values = (
                "from tick to tick",
                _periods(value, [now[p] for p in periods if p != timing.name]),
            )
        elif timing.name in phases:
            period = now[phases[timing.name].period]
            description, values = "of the first tick", [period * k / 20 for k in range(20)]
        else:
            description = _about(system, timing.name)
            span = studied.get(timing.name, (Fraction(0), _nice(max(ROOM * value, 4 * longest))))
            values = _even(value, *_within(span, value), Fraction(0), None)
        sliders.append(_slider(system, free, TIMES, description, values, value, span))
    return sorted(sliders, key=lambda slider: (slider.span is None, slider.free.name in phases))


def _about(system: Model, name: str) -> str:
    description = next(
        (parameter.description for parameter in system.parameters if parameter.name == name), ""
    )
    return f"{description}, of all groups" if len(times_of(system, name)) > 1 else description


def _periods(now: Fraction, others: Sequence[Fraction]) -> list[Fraction]:
    """Return periods with which frames stay short: multiples and shares of the other clocks'."""
    if not others:
        return _decades(now, None, None)
    listed = {other * k for other in others for k in range(1, RATIOS + 1)}
    listed |= {other / k for other in others for k in range(1, RATIOS + 1)}
    return [
        number
        for number in listed
        if now / 10 <= number <= now * 10 and _frame([number, *others]) / min(number, *others) <= MOST_TICKS
    ]


def _frame(periods: Sequence[Fraction]) -> Fraction:
    """Return the least common multiple of periods."""
    below = lcm(*(period.denominator for period in periods))
    return Fraction(lcm(*(int(period * below) for period in periods)), below)


def _people(system: Model) -> list[Slider]:
    """Return the sliders of the numbers of peers of groups without individual peer values."""
    sliders = []
    for group in system.groups:
        free = ParameterRef(group_count(group.name))
        parameter = parameter_of(system, free)
        if group.columns or parameter.formula is not None:
            continue
        least = 2 if len(system.groups) == 1 else 1
        most = COUNTS * max(group.count, 3)
        values = [Fraction(k) for k in range(least, most + 1)]
        span = (Fraction(least), Fraction(most))
        description = f"how many peers {group.name} has"
        sliders.append(_slider(system, free, PEOPLE, description, values, Fraction(group.count), span))
    return sliders


def is_number(value: Any) -> bool:
    """Return whether a value from the browser is a finite number."""
    whole = isinstance(value, int | float) and not isinstance(value, bool)
    return whole and abs(value) <= sys.float_info.max  # an int may be larger


def is_position(slider: Slider, value: Any) -> bool:
    """Return whether a value from the browser is a valid slider index."""
    return is_number(value) and 0 <= round(value) < len(slider.values)


def is_member_of(names: Iterable[str], value: Any) -> bool:
    """Return whether a value from the browser is one of several names."""
    return isinstance(value, str) and value in names


def position_of(slider: Slider, value: Fraction | float) -> int:
    """Return the place of the value of a slider that is nearest."""
    after = bisect_left(slider.values, value)
    indices = [number for number in (after - 1, after) if 0 <= number < len(slider.values)]
    return min(indices, key=lambda index: abs(slider.values[index] - Fraction(value)))


def set_to(system: Model, sliders: Sequence[Slider], text: str) -> tuple[int, Fraction]:
    """Return the slider that `NAME=QUANTITY` sets, and the value.

    Raises
    ------
    ApcError
        E980 what is set has no slider; and those of `overrides.parse_override`.
    """
    override = parse_override(system, text)
    for index, slider in enumerate(sliders):
        if slider.free == override.free:
            return index, override.value
    message = (
        f"{override.free.label} has no slider: it follows from other numbers, or differs from peer to peer"
    )
    raise ApcError(Diagnostic("E980", SourceLocation("explore"), message))


def with_value(slider: Slider, value: Fraction) -> tuple[Slider, int]:
    """Return a slider that has a value, and the value's place; it begins where it did."""
    listed = tuple(sorted({*slider.values, value}))
    texts = tuple(text_of(number, slider.unit) for number in listed)
    start = listed.index(slider.values[slider.start])
    return replace(slider, values=listed, texts=texts, start=start), listed.index(value)


def overrides_of(sliders: Sequence[Slider], indices: Sequence[int]) -> list[Override]:
    """Return the settings of the moved sliders."""
    return [
        Override(slider.free, slider.values[index])
        for slider, index in zip(sliders, indices, strict=True)
        if index != slider.start
    ]


def axes_of(
    sliders: Sequence[Slider], indices: Sequence[int], chosen: tuple[int, int]
) -> tuple[Range, Range]:
    """Return the axes of a region over two sliders: their spans, wide enough for their values."""
    intervals = []
    for number in chosen:
        slider, value = sliders[number], sliders[number].values[indices[number]]
        assert slider.span is not None
        low, high = slider.span
        room = (high - low) / 10
        low = low if value >= low else value - room
        high = high if value <= high else _nice(value + room)
        intervals.append(Range(slider.free, slider.unit, low, high))
    return intervals[0], intervals[1]
