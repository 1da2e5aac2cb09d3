"""Which parameters a sweep varies, and every combination of their values.

Takes: a `Model`, names of parameters, and texts such as `0 N/m:3000 N/m:11` or `0, 8 ms`.
Gives: `GridAxis`, `Grid`, `parse_axis`, `build_grid`, `check_size`.
Guarantees: values are exact rationals in SI; the order of points is that of the axes as given, the last one
turning fastest; what can be known to be out of bounds is told before any point is computed.
Does not: compute points.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from fractions import Fraction

import numpy as np
from numpy.typing import NDArray

from apc.compiler.compiled import Model
from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.frame.overrides import Override, apply
from apc.frame.parameter_names import ParameterRef, find, unit_of
from apc.option_value import option_values
from apc.parameter_studies.evaluator import reaches_count

LOCATION = SourceLocation("sweep")

# Of a range that does not say how many: ten steps, so that the ends and the middle are round numbers.
DEFAULT_COUNT = 11
# A result of so many rows takes a gigabyte of memory, and weeks on one core.
MOST_POINTS = 10_000_000
MOST_DIGITS = 20  # of a count that are read: it is too large anyway

_FORM = "--over contact.stiffness='100 N/m:3000 N/m:30'"


@dataclass(frozen=True, slots=True)
class GridAxis:
    """One swept parameter; `values` in SI, in the order swept."""

    free: ParameterRef
    unit: str
    values: tuple[Fraction, ...]

    @property
    def heading(self) -> str:
        """The heading of its column: name and SI unit, if it has one."""
        return self.free.label if self.unit == "1" else f"{self.free.label} [{self.unit}]"


@dataclass(frozen=True, slots=True)
class Grid:
    """Every combination of the axes' values; point numbers count from 0, the last axis turns fastest."""

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
        """Return which of each axis's values some points have (k, axes)."""
        sizes = [len(axis.values) for axis in self.axes]
        return np.stack(np.unravel_index(np.asarray(points, dtype=np.int64), sizes), axis=1)

    def overrides(self, point: int) -> tuple[Override, ...]:
        """Return the overrides of a point."""
        pairs = zip(self.axes, self.values(point), strict=True)
        return tuple(Override(axis.free, value) for axis, value in pairs)


def build_grid(axes: Sequence[GridAxis]) -> Grid:
    """Return the grid of some axes. Raises ApcError E883 when they make none, or one too large."""
    if not axes:
        raise ApcError(Diagnostic("E883", LOCATION, "nothing is swept", hint=_FORM))
    labels = [axis.free.label for axis in axes]
    for index, label in enumerate(labels):
        if label in labels[:index]:
            raise ApcError(Diagnostic("E883", LOCATION, f"{label} is swept twice"))
    _refuse_many([len(axis.values) for axis in axes])
    return Grid(tuple(axes))


def check_size(texts: Sequence[str]) -> None:
    """Refuse a grid that is too large by the texts of its axes, before any value of them is built (E883)."""
    counts = []
    for text in texts:
        parts = [part.strip() for part in text.split(":")]
        given = [part for part in parts[2:3] if part.isascii() and part.isdecimal()]
        if len(parts) == 1:
            counts.append(text.count(",") + 1)
        else:
            # An invalid count is reported when it is read.
            counts.append(int(given[0][:MOST_DIGITS]) if given else DEFAULT_COUNT)
    _refuse_many(counts)


def _refuse_many(counts: Sequence[int]) -> None:
    points = math.prod(counts)
    if points > MOST_POINTS:
        sizes = " × ".join(f"{count:,}" for count in counts)
        got = f"{sizes} = {points:,}" if len(counts) > 1 else sizes
        raise ApcError(Diagnostic("E883", LOCATION, "a sweep", f"at most {MOST_POINTS:,} points", got))


def parse_axis(system: Model, name: str, text: str, *, ends: bool = False) -> GridAxis:
    """Read the values of a swept parameter.

    Parameters
    ----------
    system
        The topology.
    name
        A parameter or timing, as in `--set`.
    text
        `LOW:HIGH`, `LOW:HIGH:COUNT`, `LOW:HIGH:COUNT:log` (equal ratios instead of equal steps), or a list
        `V1, V2, V3`. A number without a unit takes the unit of the last one: `0,8 ms`.
    ends
        Whether the values are the two ends of `LOW:HIGH` alone.

    Raises
    ------
    ApcError
        E881 a range or list at fault; E622, E623 no such parameter; E204 and others of a
        quantity; E624 or E625 a value out of the parameter's bounds.
    """
    free = find(system, name.strip(), LOCATION, counts=True)
    unit = unit_of(system, free.name)
    whole = reaches_count(system, free)
    default = 2 if ends else DEFAULT_COUNT
    values = _range(free.label, unit, text, default) if ":" in text else _list(free.label, unit, text)
    if whole and ":" in text:
        values = _whole_numbers(free.label, values, every=text.count(":") == 1 and not ends)
    axis = GridAxis(free, unit, values)
    for value in (min(values), max(values)):
        _check_bounds(system, axis, value)
    return axis


def _whole_numbers(label: str, values: Sequence[Fraction], *, every: bool) -> tuple[Fraction, ...]:
    """Return the whole numbers of a range of counts: every one, or those nearest to the values asked for."""
    low, high = values[0], values[-1]
    if low.denominator != 1 or high.denominator != 1:
        got = f"{float(low):g} to {float(high):g}"
        raise ApcError(Diagnostic("E881", LOCATION, f"the range of {label}", "whole numbers", got))
    if every:
        _refuse_many([int(high - low) + 1])
        return tuple(Fraction(count) for count in range(int(low), int(high) + 1))
    return tuple(dict.fromkeys(Fraction(round(value)) for value in values))


def _list(label: str, unit: str, text: str) -> tuple[Fraction, ...]:
    values = option_values(label, unit, text.split(","), LOCATION, between=",")
    for index, value in enumerate(values):
        if value in values[:index]:
            got = f"{float(value):g} {unit} twice"
            raise ApcError(Diagnostic("E881", LOCATION, f"the list of {label}", "different values", got))
    return values


def _range(label: str, unit: str, text: str, default: int) -> tuple[Fraction, ...]:
    """Return the values of LOW:HIGH, so many by default, of LOW:HIGH:COUNT or LOW:HIGH:COUNT:log."""
    message = f"the range of {label}"
    ends, rest = text.split(":")[:2], text.split(":")[2:]
    logarithmic = bool(rest) and rest[-1].strip() == "log"
    if logarithmic:
        rest = rest[:-1]
    if len(rest) > 1:
        raise ApcError(
            Diagnostic("E881", LOCATION, message, "LOW:HIGH:COUNT or LOW:HIGH:COUNT:log", text[:80], _FORM)
        )
    count = _count(message, rest[0].strip()) if rest else default
    low, high = option_values(
        label, unit, ends, LOCATION, rest="".join(f":{part}" for part in text.split(":")[2:])
    )
    if low >= high:
        got = f"{ends[0].strip()} to {ends[1].strip()}"
        expected = "its lower end first, and the upper above it"
        raise ApcError(Diagnostic("E881", LOCATION, message, expected, got))
    if not logarithmic:
        return tuple(low + (high - low) * step / (count - 1) for step in range(count))
    if low <= 0:
        got = f"{float(low):g} {unit}"
        raise ApcError(Diagnostic("E881", LOCATION, message, "a lower end above 0 for equal ratios", got))
    ratio = float(high / low)
    # The shortest decimal of the float, so that a table shows it whole; the ends are those given.
    inner = (Fraction(repr(float(low) * ratio ** (step / (count - 1)))) for step in range(1, count - 1))
    return (low, *inner, high)


def _count(subject: str, text: str) -> int:
    """Read the number of values: a single value is written as a value, not as a range."""
    if not (text.isascii() and text.isdecimal() and len(text) <= MOST_DIGITS and int(text) >= 2):
        raise ApcError(
            Diagnostic("E881", LOCATION, subject, "2 values or more", text[:40] or "nothing", _FORM)
        )
    return int(text)


def _check_bounds(system: Model, axis: GridAxis, value: Fraction) -> None:
    """Raise what `apply` says of this value itself, whatever the other axes are.

    What it says of the value together with others (a phase beyond its clock's period, something that depends
    on it by an expression) is the affair of each point, where they may fit.
    """
    try:
        apply(system, [Override(axis.free, value)])
    except ApcError as error:
        mistakes = [
            mistake
            for mistake in error.mistakes
            if mistake.code in ("E624", "E625") and mistake.subject in (axis.free.label, axis.free.name)
        ]
        if mistakes:
            raise ApcError(replace(mistakes[0], location=LOCATION)) from None
