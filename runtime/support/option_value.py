"""Quantities as values of command-line options and of arguments.

Takes: an option's name and its text. Gives: `option_value`, `option_values`, `with_last_unit`; `NamedValues`,
`named_values`, `text_of`.
Guarantees: errors are located at the option, with a fix.
Does not: define options.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation
from apc.compiler.wording import with_unit

# Values of a parameter: a text such as "0 N/m:100 N/m" or "0,8 ms", or texts and numbers in SI.
Values = str | Sequence[str | Fraction]
NamedValues = tuple[str, Values]


def named_values(given: str | NamedValues) -> NamedValues:
    """Return the name and the values of a text `NAME=VALUES`, or of such a pair."""
    if not isinstance(given, str):
        return given
    name, _, values = (part.strip() for part in given.partition("="))
    return name, values


def text_of(value: str | Fraction, unit: str) -> str:
    """Return a value as text, a number in SI with its unit."""
    return value.strip() if isinstance(value, str) else with_unit(f"{float(value):.15g}", unit)


def option_value(option: str, text: str | Fraction, *, subject: str, unit: str) -> Fraction:
    """Return the quantity given to an option, in SI units.

    Parameters
    ----------
    option
        The option as written, such as "--duration".
    text
        The given text, or a number in SI.
    subject
        The name of the quantity, for messages.
    unit
        A unit of the required dimension.

    Raises
    ------
    ApcError
        The errors of `units.quantity`.
    """
    if isinstance(text, Fraction):
        return text
    # Imported here: the language of quantities, which most commands do not need.
    from apc.compiler.language.units import quantity

    try:
        return Fraction(quantity(text, SourceLocation(option), subject=subject, unit=unit, before="").value)
    except ApcError as error:
        raise ApcError(
            replace(mistake, fix=f'{option} "{mistake.fix}"' if mistake.fix else "")
            for mistake in error.mistakes
        ) from None


_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)


def with_last_unit(texts: Sequence[str]) -> list[str]:
    """Return the texts of quantities; plain numbers get the unit of the last quantity: `0,8 ms`."""
    last = _NUMBER.sub("", texts[-1], count=1).strip()
    return [f"{text.strip()} {last}" if last and _NUMBER.fullmatch(text) else text.strip() for text in texts]


def option_values(
    label: str,
    unit: str,
    texts: Sequence[str | Fraction],
    location: SourceLocation,
    *,
    between: str = ":",
    rest: str = "",
) -> tuple[Fraction, ...]:
    """Return several quantities in SI units; a plain number has the unit of the last quantity.

    Parameters
    ----------
    label, unit
        The name of the quantity, and a valid unit.
    texts
        The texts of the quantities, or numbers in SI.
    location
        The location of the option.
    between, rest
        The separator of the quantities, and the text after the last quantity, for the fix.

    Raises
    ------
    ApcError
        The errors of `units.quantity`, with a fix for the entire value.
    """
    written = [text for text in texts if isinstance(text, str)]
    if not written:
        return tuple(Fraction(number) for number in texts)
    from apc.compiler.language.units import quantity

    if unit != "1" and all(_NUMBER.fullmatch(text) for text in written):
        fix = f"{label}={between.join(f'{text.strip()} {unit}' for text in written)}{rest}"
        got = f"{between.join(written)} (no unit)"
        raise ApcError(Diagnostic("E204", location, label, unit, got[:80], fix))
    values: list[Fraction] = []
    mistakes: list[Diagnostic] = []
    corrected: list[str] = []  # the corrected text of each quantity
    with_units = iter(with_last_unit(written))
    for item in texts:
        if isinstance(item, Fraction):
            values.append(item)
            corrected.append(text_of(item, unit))
            continue
        text = next(with_units)
        try:
            parsed = quantity(text, location, subject=label, unit=unit, before="", one_fix=True)
            values.append(Fraction(parsed.value))
            corrected.append(text)
        except ApcError as error:
            mistakes += error.mistakes
            corrected.append(error.mistakes[0].fix)
    if mistakes:
        if between == ":" and len(set(corrected)) < len(corrected):  # a range with two equal ends is refused
            corrected[-1] = corrected[-1].replace("1", "2", 1)
        fix = f"{label}={between.join(corrected)}{rest}" if all(corrected) else ""
        raise ApcError(replace(mistakes[0], fix=fix))
    return tuple(values)
