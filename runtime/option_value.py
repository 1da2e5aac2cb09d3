"""Quantities given to an option of the command line.

Takes: an option's name and its text. Gives: `option_value`.
Guarantees: what is wrong is told at the option, with the words to write there.
Does not: know any option.
"""

from __future__ import annotations

from dataclasses import replace
from fractions import Fraction

from apc.compiler.errors import ApcError, Place


def option_value(option: str, text: str, *, what: str, unit: str) -> Fraction:
    """Read the quantity given to an option, in SI.

    Parameters
    ----------
    option
        The option as it is written, such as "--duration".
    text
        What was given.
    what
        What it is a quantity of, for messages.
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
        return Fraction(quantity(text, Place(option), what=what, unit=unit).value)
    except ApcError as error:
        hints = [one.hint.replace(f"{what}: ", "") for one in error.mistakes]
        raise ApcError(
            replace(one, hint=f'{option} "{hint}"' if hint else "")
            for one, hint in zip(error.mistakes, hints, strict=True)
        ) from None
