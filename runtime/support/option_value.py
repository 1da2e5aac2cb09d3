"""Quantities as values of command-line options.

Takes: an option's name and its text. Gives: `option_value`, `option_values`, `with_last_unit`.
Guarantees: errors are located at the option, with a fix.
Does not: define options.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation


def option_value(option: str, text: str, *, subject: str, unit: str) -> Fraction:
    """Return the quantity given to an option, in SI units.

    Parameters
    ----------
    option
        The option as written, such as "--duration".
    text
        The given text.
    subject
        The name of the quantity, for messages.
    unit
        A unit of the required dimension.

    Raises
    ------
    ApcError
        The errors of `units.quantity`.
    """
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
    texts: Sequence[str],
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
        The texts of the quantities.
    location
        The location of the option.
    between, rest
        The separator of the quantities, and the text after the last quantity, for the fix.

    Raises
    ------
    ApcError
        The errors of `units.quantity`, with a fix for the entire value.
    """
    from apc.compiler.language.units import quantity

    if unit != "1" and all(_NUMBER.fullmatch(text) for text in texts):
        fix = f"{label}={between.join(f'{text.strip()} {unit}' for text in texts)}{rest}"
        got = f"{between.join(texts)} (no unit)"
        raise ApcError(Diagnostic("E204", location, label, unit, got[:80], fix))
    values: list[Fraction] = []
    mistakes: list[Diagnostic] = []
    corrected: list[str] = []  # the corrected text of each quantity
    for text in with_last_unit(texts):
        try:
            parsed = quantity(text, location, subject=label, unit=unit, before="", one_fix=True)
            values.append(Fraction(parsed.value))
            corrected.append(text)
        except ApcError as error:
            mistakes += error.mistakes
            corrected.append(error.mistakes[0].fix)
    if mistakes:
        fix = f"{label}={between.join(corrected)}{rest}" if all(corrected) else ""
        raise ApcError(replace(mistakes[0], fix=fix))
    return tuple(values)
