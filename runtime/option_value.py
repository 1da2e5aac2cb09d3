"""Quantities given to an option of the command line.

Takes: an option's name and its text. Gives: `option_value`, `option_values`, `with_last_unit`.
Guarantees: errors are located at the option, with a valid text.
Does not: define options.
"""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from fractions import Fraction

from apc.compiler.errors import ApcError, Diagnostic, SourceLocation


def option_value(option: str, text: str, *, subject: str, unit: str) -> Fraction:
    """Read the quantity given to an option, in SI.

    Parameters
    ----------
    option
        The option as written, such as "--duration".
    text
        The given text.
    subject
        The name of the quantity, for messages.
    unit
        A unit that fits.

    Raises
    ------
    ApcError
        Those of `units.quantity`.
    """
    # Imported here: the language of quantities, which most commands do not need.
    from apc.compiler.language.units import quantity

    try:
        return Fraction(quantity(text, SourceLocation(option), subject=subject, unit=unit, before="").value)
    except ApcError as error:
        raise ApcError(
            replace(mistake, hint=f'{option} "{mistake.hint}"' if mistake.hint else "")
            for mistake in error.mistakes
        ) from None


_NUMBER = re.compile(r"\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*", re.ASCII)


def with_last_unit(texts: Sequence[str]) -> list[str]:
    """Return the texts of quantities, those of numbers alone with the unit of the last: `0,8 ms`."""
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
    """Read quantities in SI; one without a unit takes that of the last.

    Parameters
    ----------
    label, unit
        The name of the quantity, and a valid unit.
    texts
        The given texts.
    location
        The location.
    between, rest
        The separator, and the text after the last, for the suggested fix.

    Raises
    ------
    ApcError
        Those of `units.quantity`, with a suggested replacement of all.
    """
    from apc.compiler.language.units import quantity

    if unit != "1" and all(_NUMBER.fullmatch(text) for text in texts):
        hint = f"{label}={between.join(f'{text.strip()} {unit}' for text in texts)}{rest}"
        got = f"{between.join(texts)} (no unit)"
        raise ApcError(Diagnostic("E204", location, label, unit, got[:80], hint))
    values: list[Fraction] = []
    mistakes: list[Diagnostic] = []
    right: list[str] = []  # what is to be written of each
    for text in with_last_unit(texts):
        try:
            read = quantity(text, location, subject=label, unit=unit, before="", one_fix=True)
            values.append(Fraction(read.value))
            right.append(text)
        except ApcError as error:
            mistakes += error.mistakes
            right.append(error.mistakes[0].hint)
    if mistakes:
        hint = f"{label}={between.join(right)}{rest}" if all(right) else ""
        raise ApcError(replace(mistakes[0], hint=hint))
    return tuple(values)
