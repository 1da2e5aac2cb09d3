"""Ranges of parameters as text, such as `contact.stiffness=±1%`.

Takes: a `Model` and the text of a range. Gives: `parse_range`, `pasted`.
Guarantees: a range is within the bounds of its parameter.
Does not: use the range.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

from apc.compiler.compiled import Model, Parameter
from apc.compiler.errors import ApcError, Diagnostic, Mistakes, SourceLocation
from apc.compiler.number_parsing import plain_float
from apc.compiler.wording import with_unit
from apc.parameter_values.display_units import DisplayUnit
from apc.parameter_values.overrides import check_bounds
from apc.parameter_values.parameter_names import (
    ParameterRef,
    Range,
    find,
    proposed_range,
    proposed_range_of,
    refuse_choices,
    times_of,
)
from apc.parameter_values.parameters import scope_of
from apc.studies.representative_delays import LOCATION
from apc.support.option_value import NamedValues, named_values, option_values, text_of


def parse_range(model: Model, given: str | NamedValues, location: SourceLocation = LOCATION) -> Range:
    """Return the range that a text `NAME=±P%` or `NAME=LOW UNIT:HIGH UNIT` gives to a parameter.

    Parameters
    ----------
    model
        The compiled model.
    given
        The text, or the name and the two ends; the name as in `parameter_names.find`.
    location
        The location of the text, for errors: an option such as `--box`, which is a part of their fixes.

    Raises
    ------
    ApcError
        E830 another form of text, E831 a parameter without a range, E833 invalid limits; the
        errors of `parameter_names.find` and `units.quantity`.
    """
    name, values = named_values(given)
    value = values if isinstance(values, str) else " to ".join(text_of(end, "1") for end in values)
    if not name:
        raise _malformed("range", value, proposed_range(model), location)
    parameter_ref = find(model, name, location)
    parameter = _parameter(model, parameter_ref, location)
    proposed = proposed_range_of(model, parameter_ref)
    malformed = _malformed(f"range of {name}", value, proposed, location)
    if not value or (not isinstance(values, str) and len(values) != 2):
        raise malformed
    if not isinstance(values, str):
        low, high = option_values(name, parameter.unit, values, location)
    elif value.startswith(("±", "+-")):
        share = _percentage(value.removeprefix("±").removeprefix("+-"))
        if share is None:
            raise malformed
        if share <= 0:
            got, fix = value[:80], pasted(location, proposed)
            raise ApcError(Diagnostic("E833", location, f"range of {name}", "more than ±0 %", got, fix))
        middle = parameter.number
        spread = abs(middle) * share
        if not spread:
            message = f"{name} is 0, so a relative range is empty"
            raise ApcError(Diagnostic("E833", location, message, fix=pasted(location, proposed)))
        low, high = middle - spread, middle + spread
    else:
        first, colon, last = (part.strip() for part in value.partition(":"))
        if not (colon and first and last):
            raise malformed
        low, high = option_values(name, parameter.unit, (first, last), location)
    _check_limits(parameter, low, high, name, location)
    return Range(parameter_ref, DisplayUnit.of(parameter), low, high)


def pasted(location: SourceLocation, text: str) -> str:
    """Return a value as it is pasted: behind its option and in quotation marks if it is that of an option."""
    return f'{location} "{text}"' if location.file.startswith("--") else text


def _malformed(subject: str, got: str, proposed: str, location: SourceLocation) -> ApcError:
    """Return the error E830 for a range that is not of one of the two forms."""
    form, fix = "LOW:HIGH or ±PERCENT%", pasted(location, proposed)
    return ApcError(Diagnostic("E830", location, subject, form, got[:80] or "nothing", fix))


def _percentage(text: str) -> Fraction | None:
    """Return a percentage as a fraction of 1; None for another text."""
    number = text.strip()
    if not number.endswith("%"):
        return None
    try:
        plain_float(number[:-1])  # Fraction accepts more than plain numbers
        return Fraction(number[:-1].strip()) / 100
    except (ValueError, ZeroDivisionError):
        return None


def _parameter(model: Model, parameter_ref: ParameterRef, location: SourceLocation) -> Parameter:
    """Return the parameter that varies in a box.

    Raises E831 for times other than delays, and for values that differ from peer to peer.
    """
    name, group = parameter_ref.name, parameter_ref.group
    common = {parameter.name: parameter for parameter in model.parameters}
    times = {timing.name: timing.value for timing in model.timings}
    delays = {text for link in model.links for text in link.delays}
    if name in delays:  # analysed segment by segment
        return Parameter(name, "s", float(times[name]), minimum=0.0, exact=times[name])
    if times_of(model, name) or name in scope_of(model).needed([*times]) or name not in common:
        message = (
            f"{name} is a time or sets one; timing parameters have no range, as the event order is "
            "discontinuous in them"
        )
        is_clock_timing = any(name in (clock.period, clock.phase) for clock in model.clocks)
        raise ApcError(
            Diagnostic("E831", location, message, fix="" if is_clock_timing else f"apc critical {name}")
        )
    refuse_choices(model, parameter_ref, location)
    for item in model.groups:
        own_values = {value.name: value for value in item.values}
        columns = {column.name for column in item.columns}
        if group == item.name:
            if name in columns:
                raise ApcError(Diagnostic("E831", location, f"{name} differs between the peers of {group}"))
            return own_values.get(name, common[name])
        if group is None and (name in own_values or name in columns):
            message = f"{name} differs between groups: {item.name} has a separate value"
            raise ApcError(Diagnostic("E831", location, message, fix=f"{item.name}.{name}=±1%"))
    return common[name]


def _check_limits(
    parameter: Parameter, low: Fraction, high: Fraction, name: str, location: SourceLocation
) -> None:
    """Raise ApcError E833 for an empty range, or one beyond the parameter's bounds, with a valid range as a
    fix.

    `low` and `high` are the ends of the range in SI, `name` is the parameter as given.
    """
    message, mistakes = f"range of {name}", Mistakes()

    def end_texts(*ends: Fraction | float) -> list[str]:
        """Return the ends of a range as texts with the parameter's unit."""
        return [with_unit(f"{float(end):.9g}", parameter.unit).removesuffix(" 1") for end in ends]

    if not low < high:
        swapped = f"{name}={':'.join(end_texts(high, low))}" if high < low else ""
        mistakes.add(
            "E833",
            location,
            message,
            expected="a lower limit below the upper",
            got=" to ".join(end_texts(low, high)),
            fix=pasted(location, swapped) if swapped else "",
        )
    for side, end in (("lower", low), ("upper", high)):
        text = f"{side} end of the {message}"
        check_bounds(replace(parameter, value=float(end), exact=None), text, mistakes, "E833", location)
    if mistakes and low < high:
        # A value within the bounds; at an excluded bound, a hundredth of the range away from it.
        least, most = float(parameter.minimum or 0.0), parameter.maximum
        top = float(high) if most is None else min(float(high), most)
        if parameter.minimum is not None and float(low) <= least:
            low = Fraction(least + (top - least) / 100 if parameter.exclusive_minimum else least)
        fix = pasted(location, f"{name}={':'.join(end_texts(low, top))}") if low < top else ""
        raise ApcError(replace(mistake, fix=fix) for mistake in mistakes.result)
    mistakes.raise_if_any()
