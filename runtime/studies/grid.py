"""The grid of a sweep: its parameters, and every combination of their values.

Takes: a `Model`, names of parameters, and texts such as `0 N/m:3000 N/m:11` or `0, 8 ms`.
Gives: `GridAxis`, `Grid`, `parse_axis`, `build_grid`, `check_size`.
Guarantees: values are exact rationals in SI; points are in the order of the axes, the last axis varying
fastest; values that are out of bounds on their own raise an error before any computation.
Does not: compute points.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import with_unit
from apc.parameter_values.overrides import Override, apply
from apc.parameter_values.parameter_names import ParameterRef, choices_of, find, unit_of
from apc.studies.count_range import whole_range
from apc.studies.evaluator import reaches_count
from apc.support.option_value import Values, option_values, text_of, with_last_unit

LOCATION = SourceLocation("sweep")

# The default number of values of a range: ten steps, for round numbers at the ends and the middle.
DEFAULT_COUNT = 11
# The limit of rows: a gigabyte of memory, and weeks on one core.
MOST_POINTS = 10_000_000
MOST_DIGITS = 20  # of a count that are parsed: larger counts are above any limit

_FORM = "--over contact.stiffness='100 N/m:3000 N/m:30'"


@dataclass(frozen=True, slots=True)
class GridAxis:
    """One swept parameter with its `values` in SI, in order."""

    free: ParameterRef
    unit: str
    values: tuple[Fraction, ...]

    @property
    def heading(self) -> str:
        """The heading of its column: name and SI unit, if it has one."""
        return self.free.label if self.unit == "1" else f"{self.free.label} [{self.unit}]"


@dataclass(frozen=True, slots=True)
class Grid:
    """Every combination of the axes' values; points are counted from 0, the last axis varies fastest."""

    axes: tuple[GridAxis, ...]

    @property
    def points(self) -> int:
        """The number of points."""
        return math.prod(len(axis.values) for axis in self.axes)

    def values(self, point: int) -> tuple[Fraction, ...]:
        """Return the value of each axis at a point."""
        numbers = []
        for axis in reversed(self.axes):
            point, index = divmod(point, len(axis.values))
            numbers.append(axis.values[index])
        return tuple(reversed(numbers))

    def indices(self, points: Sequence[int]) -> NDArray[np.int64]:
        """Return the indices of the axes' values at some points (k, axes)."""
        sizes = [len(axis.values) for axis in self.axes]
        return np.stack(np.unravel_index(np.asarray(points, dtype=np.int64), sizes), axis=1)

    def overrides(self, point: int) -> tuple[Override, ...]:
        """Return the overrides of a point."""
        pairs = zip(self.axes, self.values(point), strict=True)
        return tuple(Override(axis.free, value) for axis, value in pairs)


def build_grid(axes: Sequence[GridAxis]) -> Grid:
    """Return the grid of some axes; ApcError E883 without axes, for a repeated axis, or a grid too large."""
    if not axes:
        raise ApcError(Diagnostic("E883", LOCATION, "no parameter is swept", fix=_FORM))
    labels = [axis.free.label for axis in axes]
    for index, label in enumerate(labels):
        if label in labels[:index]:
            raise ApcError(Diagnostic("E883", LOCATION, f"{label} is swept twice"))
    _refuse_many([len(axis.values) for axis in axes])
    return Grid(tuple(axes))


def check_size(given: Iterable[Values]) -> None:
    """Raise E883 for a grid that is too large by the values of its axes, before any value is built."""
    counts = []
    for text in given:
        if not isinstance(text, str):
            counts.append(len(text))
            continue
        parts = [part.strip() for part in text.split(":")]
        count_texts = [part for part in parts[2:3] if part.isascii() and part.isdecimal()]
        if len(parts) == 1:
            counts.append(text.count(",") + 1)
        else:
            # An invalid count is reported when it is read.
            counts.append(int(count_texts[0][:MOST_DIGITS]) if count_texts else DEFAULT_COUNT)
    _refuse_many(counts)


def _refuse_many(counts: Sequence[int]) -> None:
    """Raise E883 for a grid of more than MOST_POINTS points."""
    points = math.prod(counts)
    if points > MOST_POINTS:
        sizes = " × ".join(f"{count:,}" for count in counts)
        got = f"{sizes} = {points:,}" if len(counts) > 1 else sizes
        raise ApcError(Diagnostic("E883", LOCATION, "sweep", f"at most {MOST_POINTS:,} points", got))


def parse_axis(model: Model, name: str, given: Values, *, ends: bool = False) -> GridAxis:
    """Return the axis of a swept parameter from its values.

    Parameters
    ----------
    model
        The compiled model.
    name
        A parameter or timing, as in `--set`.
    given
        A text `LOW:HIGH`, `LOW:HIGH:COUNT`, `LOW:HIGH:COUNT:log` (equal ratios instead of equal steps) or
        `V1, V2, V3`, or a list of texts and numbers in SI. A text without a unit takes the unit of the last
        one: `0,8 ms`.
    ends
        Whether the values are only the two ends of a range.

    Raises
    ------
    ApcError
        E881 an invalid range or list; E622, E623 an unknown parameter; E204 and other errors of a quantity;
        E624 or E625 a value out of the parameter's bounds.
    """
    parameter_ref = find(model, name.strip(), LOCATION, counts=True)
    unit = unit_of(model, parameter_ref.name)
    is_count = reaches_count(model, parameter_ref)
    default = 2 if ends else DEFAULT_COUNT
    in_range = given if isinstance(given, str) and ":" in given else ""
    if ends or in_range:
        parts = in_range.split(":") if in_range else given
        values = _values_of_range(parameter_ref.label, unit, parts[:2], in_range.split(":")[2:], default)
    else:
        items = given.split(",") if isinstance(given, str) else given
        choices = choices_of(model, parameter_ref)
        named = [item.strip() if isinstance(item, str) else "" for item in items]
        items = [
            Fraction(choices[name]) if name in choices else item
            for name, item in zip(named, items, strict=True)
        ]
        values = _values_of_list(parameter_ref.label, unit, items)
    if is_count and (ends or in_range):
        values = _whole_numbers(parameter_ref.label, values, every=in_range.count(":") == 1 and not ends)
    axis = GridAxis(parameter_ref, unit, values)
    for value in (min(values), max(values)):
        _check_bounds(model, axis, value)
    return axis


def _whole_numbers(label: str, values: Sequence[Fraction], *, every: bool) -> tuple[Fraction, ...]:
    """Return the integers of a range of counts: every integer, or those nearest to the given values."""
    low, high = values[0], values[-1]
    if low.denominator != 1 or high.denominator != 1:
        got, fix = f"{float(low):g} to {float(high):g}", whole_range(label, low, high)
        raise ApcError(Diagnostic("E881", LOCATION, f"range of {label}", "whole numbers", got, fix))
    if every:
        _refuse_many([int(high - low) + 1])
        return tuple(Fraction(count) for count in range(int(low), int(high) + 1))
    return tuple(dict.fromkeys(Fraction(round(value)) for value in values))


def _values_of_list(label: str, unit: str, items: Sequence[str | Fraction]) -> tuple[Fraction, ...]:
    """Return the values of a list in SI; an error E881 for a repeated value."""
    if not items:
        raise ApcError(Diagnostic("E881", LOCATION, f"list of {label}", "1 value or more", "nothing", _FORM))
    values = option_values(label, unit, items, LOCATION, between=",")
    once = dict.fromkeys(values)
    if len(once) < len(values):
        repeated = next(value for place, value in enumerate(values) if value in values[:place])
        got = with_unit(f"{float(repeated):g}", unit) + " twice"
        texts = [text_of(items[values.index(value)], unit) for value in once]
        fix = f"{label}={', '.join(with_last_unit(texts))}"
        raise ApcError(Diagnostic("E881", LOCATION, f"list of {label}", "different values", got, fix))
    return values


def _values_of_range(
    label: str, unit: str, ends: Sequence[str | Fraction], given_options: Sequence[str], default: int
) -> tuple[Fraction, ...]:
    """Return the values of a range LOW:HIGH (with the default count), LOW:HIGH:COUNT or
    LOW:HIGH:COUNT:log.

    Parameters
    ----------
    label, unit
        The parameter, and a valid unit.
    ends, given_options
        The two ends, and the texts after them.
    default
        The default number of values.
    """
    message, options = f"range of {label}", list(given_options)
    logarithmic = bool(options) and options[-1].strip() == "log"
    if logarithmic:
        options = options[:-1]
    if len(options) > 1:
        raise ApcError(
            Diagnostic(
                "E881",
                LOCATION,
                message,
                "LOW:HIGH:COUNT or LOW:HIGH:COUNT:log",
                ":".join([*(text_of(end, unit) for end in ends), *given_options])[:80],
                _FORM,
            )
        )
    count = _count(message, options[0].strip()) if options else default
    rest = "".join(f":{part.strip()}" for part in given_options)
    low, high = option_values(label, unit, ends, LOCATION, rest=rest)
    low_text, high_text = (text_of(end, unit) for end in ends)
    if low >= high:
        got = f"{low_text} to {high_text}"
        expected = "the lower end first"
        swapped = ":".join(reversed(with_last_unit([low_text, high_text])))
        swapped = f"{label}={swapped}{rest}" if low > high else ""
        raise ApcError(Diagnostic("E881", LOCATION, message, expected, got, swapped))
    if not logarithmic:
        return tuple(low + (high - low) * step / (count - 1) for step in range(count))
    if low <= 0:
        got, expected = with_unit(f"{float(low):g}", unit), "a lower end above 0 for a logarithmic range"
        above_zero = with_unit(f"{float(high) / 100:g}", unit)
        fix = f"{label}={above_zero}:{high_text}:{count}:log" if high > 0 else ""
        raise ApcError(Diagnostic("E881", LOCATION, message, expected, got, fix))
    ratio = float(high / low)
    # Inner values are shortest decimals of floats, for exact tables; the ends are the given values.
    inner = (Fraction(repr(float(low) * ratio ** (step / (count - 1)))) for step in range(1, count - 1))
    return (low, *inner, high)


def _count(subject: str, text: str) -> int:
    """Return the number of values of a range; an error E881 below 2."""
    if not (text.isascii() and text.isdecimal() and len(text) <= MOST_DIGITS and int(text) >= 2):
        raise ApcError(
            Diagnostic("E881", LOCATION, subject, "2 values or more", text[:40] or "nothing", _FORM)
        )
    return int(text)


def _check_bounds(model: Model, axis: GridAxis, value: Fraction) -> None:
    """Raise the error of `apply` for a value that is out of its own bounds.

    Errors that also depend on other values (a phase beyond its clock's period, a dependent parameter) belong
    to single points.
    """
    try:
        apply(model, [Override(axis.free, value)])
    except ApcError as error:
        mistakes = [
            mistake
            for mistake in error.mistakes
            if mistake.code in ("E624", "E625") and mistake.subject in (axis.free.label, axis.free.name)
        ]
        if mistakes:
            raise ApcError(replace(mistakes[0], location=LOCATION)) from None
