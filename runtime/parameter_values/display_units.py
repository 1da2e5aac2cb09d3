"""Display units of numbers that results hold in SI.

Takes: a `Parameter`; a number in SI and its unit. Gives: `DisplayUnit`, `as_shown`.
Guarantees: plain data stays in SI.
Does not: round.
"""

from __future__ import annotations

from fractions import Fraction
from typing import TYPE_CHECKING

from apc.compiler.errors import SourceLocation

if TYPE_CHECKING:
    from apc.compiler.compiled import Parameter


class DisplayUnit(str):
    """A unit in SI by its text, with the unit for display, which the topology uses.

    Results hold values in SI and this unit, so that plain data is in SI; texts convert by `as_shown`.
    """

    display: str

    def __new__(cls, text: str, display: str = "") -> DisplayUnit:
        """Return the unit; one without a unit for display is shown as it is."""
        unit = super().__new__(cls, text)
        unit.display = display
        return unit

    @classmethod
    def of(cls, parameter: Parameter) -> DisplayUnit:
        """Return the SI unit of a parameter, with its unit for display."""
        return cls(parameter.unit, parameter.display_unit)


def as_shown(value: float, unit: str) -> tuple[Fraction, str]:
    """Return the factor from SI to the unit for display of a number, and that unit.

    The unit for display is that of the topology; without one a time below 1 s is displayed in ms.
    """
    display = getattr(unit, "display", "")
    milliseconds = Fraction(1000), "ms"
    if unit == "s" and display == "ms":
        return milliseconds
    if display and display != unit:
        # Imported here: the language of quantities, which a topology in SI never needs.
        from apc.compiler.language.units import parse_unit

        return 1 / parse_unit(display, SourceLocation("")).scale, display
    return milliseconds if unit == "s" and 0 < abs(value) < 1 else (Fraction(1), unit)
