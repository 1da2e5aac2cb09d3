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
from contextlib import suppress
from dataclasses import dataclass, replace
from fractions import Fraction
from math import ceil, floor, lcm, log10
from typing import Any

from apc.compiler.compiled import Model, group_count
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import with_unit
from apc.lifting.numeric_model import numeric_model
from apc.linearization.linearize import start_names
from apc.parameter_values.display_units import as_shown
from apc.parameter_values.overrides import Override, apply, parse_override
from apc.parameter_values.parameter_names import (
    ParameterRef,
    Range,
    named_times,
    parameter_of,
    times_of,
    unit_of,
)
from apc.studies.evaluator import free_parameters
from apc.studies.margins import STIFFNESSES, coupler_parameters, margins

# The largest number of values of a slider, about one per pixel of its length.
STEPS = 200
# The range of a positive parameter, in decades on both sides of its value; the number of values per decade.
DECADES, PER_DECADE = 2, 48
# Digits of a value on a logarithmic slider.
DIGITS = 3
# The largest number of ticks in a frame: longer frames are too slow for a slider.
MOST_TICKS = 200
# The periods of a clock are multiples and fractions of the other clocks' periods, up to this factor.
RATIOS = 16
# The smallest upper end of a range, relative to the present value.
ROOM = Fraction(3)
# The largest number of peers of a group, relative to the present count.
COUNTS = 4

PARAMETERS, TIMES, PEER_COUNTS = "parameters", "delays and periods", "users"


@dataclass(frozen=True, slots=True)
class Slider:
    """A parameter with its ascending SI values and their texts; `start` is the index of the model's value.

    `kind` is one of `PARAMETERS`, `TIMES` and `PEER_COUNTS`; `span` is the range on an axis of a region, None
    if the parameter cannot be on an axis.
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
        """The name of the parameter for `--set`."""
        return self.free.label


def sliders_of(model: Model) -> tuple[Slider, ...]:
    """Return the sliders of a model: independent parameters, and each group's number of peers.

    Parameters
    ----------
    model
        The model, with the initial values of the sliders. The parameters of its studies come first, then
        the stiffnesses and dampings of couplers: the first two are the axes of the region.
    """
    starts = start_names(model)
    limits: dict[str, float] | None = None  # of stability, computed only for parameters without bounds
    studied = {axis.parameter: (axis.low, axis.high) for axis in model.region}
    sliders = []
    for parameter_ref in free_parameters(model):
        parameter = parameter_of(model, parameter_ref)
        if parameter.choices or (parameter_ref.name in starts and parameter.value == 0):
            continue  # named values and start values of zero have no slider
        low, high = _bounds(model, parameter_ref)
        if low is None and high is None:
            low = _inherited_minimum(model, parameter_ref)
            limits = _stability_limits(model) if limits is None else limits
            if parameter_ref.label in limits and parameter_ref.label not in studied:
                studied[parameter_ref.label] = (
                    low or Fraction(0),
                    _rounded_up(2 * Fraction(limits[parameter_ref.label])),
                )
        span = studied.get(parameter_ref.label) or _default_range(
            model, parameter_ref, parameter.number, low, high
        )
        if parameter.value > 0 and parameter.unit != "1" and parameter_ref.label not in studied:
            values = _logarithmic_values(parameter.number, low, high)
        else:
            values = _linear_values(parameter.number, *_extended(span, parameter.number), low, high)
        sliders.append(
            _slider(model, parameter_ref, PARAMETERS, parameter.description, values, parameter.number, span)
        )
    couplers = coupler_parameters(model)
    couplers.sort(key=lambda coupler: unit_of(model, coupler.name) not in STIFFNESSES)
    first_labels = [*studied, *(coupler.label for coupler in couplers)]
    sliders.sort(
        key=lambda slider: (
            first_labels.index(slider.label) if slider.label in first_labels else len(first_labels)
        )
    )
    return (*sliders, *_time_sliders(model, studied), *_peer_count_sliders(model))


def _slider(
    model: Model,
    parameter_ref: ParameterRef,
    kind: str,
    description: str,
    values: Iterable[Fraction],
    now: Fraction,
    span: tuple[Fraction, Fraction] | None,
) -> Slider:
    """Return the slider of a parameter with some values and its present value `now`."""
    unit = unit_of(model, parameter_ref.name)
    ascending = tuple(sorted({*values, now}))
    texts = tuple(text_of(number, unit) for number in ascending)
    return Slider(parameter_ref, unit, kind, description, ascending, texts, ascending.index(now), span)


def text_of(value: Fraction, unit: str) -> str:
    """Return the text of an SI value for `--set`, in the display unit."""
    factor, display_unit = as_shown(float(value), unit)
    return with_unit(_exact_text(value * factor), display_unit)


def _exact_text(value: Fraction) -> str:
    """Return the text of a number that represents exactly this number."""
    rounded = f"{float(value):.12g}"
    return rounded if Fraction(rounded) == value else repr(float(value)) if _is_float(value) else str(value)


def _is_float(value: Fraction) -> bool:
    """Return whether a number is the shortest decimal of a float."""
    return Fraction(repr(float(value))) == value


def _bounds(model: Model, parameter_ref: ParameterRef) -> tuple[Fraction | None, Fraction | None]:
    """Return the smallest and the largest valid value of a parameter, None if unbounded.

    At an open bound, the value is slightly above the bound.
    """
    parameter = parameter_of(model, parameter_ref)
    low = None if parameter.minimum is None else Fraction(repr(parameter.minimum))
    if low is not None and parameter.exclusive_minimum:
        low += abs(parameter.number - low) / 10**DECADES
    return low, None if parameter.maximum is None else Fraction(repr(parameter.maximum))


def _inherited_minimum(model: Model, parameter_ref: ParameterRef) -> Fraction | None:
    """Return the smallest value of a parameter that the bounds of its dependent parameters permit.

    It is None without such a bound, 0, or slightly above 0 where 0 is not permitted.
    """
    size = abs(parameter_of(model, parameter_ref).number) or Fraction(1)
    for value in (-size, Fraction(0), size / 10**DECADES):
        with suppress(ApcError):
            apply(model, [Override(parameter_ref, value)])
            return None if value < 0 else value
    return None


def _stability_limits(model: Model) -> dict[str, float]:
    """Return the parameters whose upper stability limit is found quickly, with the limit."""
    with suppress(ApcError):
        rows = margins(numeric_model(model), quick=True).rows
        return {row.parameter: row.value for row in rows if row.value is not None and row.value > row.current}
    return {}


def _default_range(
    model: Model, parameter_ref: ParameterRef, now: Fraction, low: Fraction | None, high: Fraction | None
) -> tuple[Fraction, Fraction]:
    """Return a range around a value: between the bounds, or up to `ROOM` times the value, and below 0
    if valid.
    """
    if low is not None and high is not None:
        return low, high
    same_unit = [
        abs(parameter.number)
        for parameter in model.parameters
        if parameter.unit == unit_of(model, parameter_ref.name)
    ]
    size = abs(now) or max(same_unit, default=Fraction(0)) or Fraction(1)
    least = -ROOM * size if low is None else low
    most = _rounded_up(ROOM * size)
    return least, min(most, high) if high is not None else most


def _extended(span: tuple[Fraction, Fraction], value: Fraction) -> tuple[Fraction, Fraction]:
    """Return a range, extended if necessary to contain a value."""
    return min(span[0], value), max(span[1], value)


def _rounded_up(value: Fraction) -> Fraction:
    """Return a positive number rounded up to two digits."""
    unit = Fraction(10) ** (floor(log10(float(value))) - 1)
    return ceil(value / unit) * unit


def _linear_values(
    now: Fraction, least: Fraction, most: Fraction, low: Fraction | None, high: Fraction | None
) -> list[Fraction]:
    """Return values from `least` to `most` in equal steps of a round size, within the bounds, and the
    present value.
    """
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


def _logarithmic_values(now: Fraction, low: Fraction | None, high: Fraction | None) -> list[Fraction]:
    """Return values of few digits with equal steps on a logarithmic scale, within the bounds."""
    middle = log10(float(now))
    count = DECADES * PER_DECADE
    values = [Fraction(f"{10 ** (middle + k / PER_DECADE):.{DIGITS}g}") for k in range(-count, count + 1)]
    return [
        number for number in values if (low is None or number >= low) and (high is None or number <= high)
    ]


def _time_sliders(model: Model, studied: dict[str, tuple[Fraction, Fraction]]) -> list[Slider]:
    """Return the sliders of delays, phases and periods without formula."""
    periods = {clock.period: clock for clock in model.clocks}
    phases = {clock.phase: clock for clock in model.clocks}
    now = {timing.name: timing.value for timing in model.timings}
    longest = max((now[name] for name in periods), default=Fraction(1))
    sliders = []
    for timing in named_times(model):
        parameter_ref, value = ParameterRef(timing.name), timing.value
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
            description = _time_description(model, timing.name)
            span = studied.get(timing.name, (Fraction(0), _rounded_up(max(ROOM * value, 4 * longest))))
            values = _linear_values(value, *_extended(span, value), Fraction(0), None)
        sliders.append(_slider(model, parameter_ref, TIMES, description, values, value, span))
    return sorted(sliders, key=lambda slider: (slider.span is None, slider.free.name in phases))


def _time_description(model: Model, name: str) -> str:
    """Return the description of a time."""
    description = next(
        (parameter.description for parameter in model.parameters if parameter.name == name), ""
    )
    return f"{description}, of all groups" if len(times_of(model, name)) > 1 else description


def _periods(now: Fraction, others: Sequence[Fraction]) -> list[Fraction]:
    """Return periods of a clock with short frames: multiples and fractions of the other clocks' periods."""
    if not others:
        return _logarithmic_values(now, None, None)
    candidates = {other * k for other in others for k in range(1, RATIOS + 1)}
    candidates |= {other / k for other in others for k in range(1, RATIOS + 1)}
    return [
        number
        for number in candidates
        if now / 10 <= number <= now * 10 and _frame([number, *others]) / min(number, *others) <= MOST_TICKS
    ]


def _frame(periods: Sequence[Fraction]) -> Fraction:
    """Return the least common multiple of periods."""
    denominator = lcm(*(period.denominator for period in periods))
    return Fraction(lcm(*(int(period * denominator) for period in periods)), denominator)


def _peer_count_sliders(model: Model) -> list[Slider]:
    """Return the sliders of the numbers of peers, of groups without individual values for each peer."""
    sliders = []
    for group in model.groups:
        parameter_ref = ParameterRef(group_count(group.name))
        parameter = parameter_of(model, parameter_ref)
        if group.columns or parameter.formula is not None:
            continue
        least = 2 if len(model.groups) == 1 else 1
        most = COUNTS * max(group.count, 3)
        values = [Fraction(k) for k in range(least, most + 1)]
        span = (Fraction(least), Fraction(most))
        description = f"how many peers {group.name} has"
        sliders.append(
            _slider(model, parameter_ref, PEER_COUNTS, description, values, Fraction(group.count), span)
        )
    return sliders


def is_number(value: Any) -> bool:
    """Return whether a value from the browser is a finite number."""
    is_real = isinstance(value, int | float) and not isinstance(value, bool)
    return is_real and abs(value) <= sys.float_info.max  # an int may exceed the range of floats


def is_position(slider: Slider, value: Any) -> bool:
    """Return whether a value from the browser is a valid slider index."""
    return is_number(value) and 0 <= round(value) < len(slider.values)


def is_member_of(names: Iterable[str], value: Any) -> bool:
    """Return whether a value from the browser is one of several names."""
    return isinstance(value, str) and value in names


def position_of(slider: Slider, value: Fraction | float) -> int:
    """Return the index of the nearest value of a slider."""
    after = bisect_left(slider.values, value)
    indices = [number for number in (after - 1, after) if 0 <= number < len(slider.values)]
    return min(indices, key=lambda index: abs(slider.values[index] - Fraction(value)))


def set_to(model: Model, sliders: Sequence[Slider], text: str) -> tuple[int, Fraction]:
    """Return the index of the slider for a setting `NAME=QUANTITY`, and the value.

    Raises
    ------
    ApcError
        E980 the parameter has no slider; and the errors of `overrides.parse_override`.
    """
    override = parse_override(model, text)
    for index, slider in enumerate(sliders):
        if slider.free == override.free:
            return index, override.value
    message = (
        f"{override.free.label} has no slider: it follows from other numbers, or differs from peer to peer"
    )
    raise ApcError(Diagnostic("E980", SourceLocation("explore"), message))


def with_value(slider: Slider, value: Fraction) -> tuple[Slider, int]:
    """Return a slider with an additional value, and the index of the value; the start value is the same."""
    values = tuple(sorted({*slider.values, value}))
    texts = tuple(text_of(number, slider.unit) for number in values)
    start = values.index(slider.values[slider.start])
    return replace(slider, values=values, texts=texts, start=start), values.index(value)


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
    """Return the axes of a region over two sliders: their ranges, extended to contain their values."""
    intervals = []
    for number in chosen:
        slider, value = sliders[number], sliders[number].values[indices[number]]
        assert slider.span is not None
        low, high = slider.span
        margin = (high - low) / 10
        low = low if value >= low else value - margin
        high = high if value <= high else _rounded_up(value + margin)
        intervals.append(Range(slider.free, slider.unit, low, high))
    return intervals[0], intervals[1]
