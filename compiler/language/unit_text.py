"""Dimensions and SI values as text.

Takes: a `Dimension`, and a number in SI. Gives: `format_dimension`, `format_si`.
Guarantees: `parse_unit` reads what `format_dimension` writes.
Does not: choose prefixes: values are shown in SI.
"""

from __future__ import annotations

from fractions import Fraction
from functools import cache

from apc.compiler.errors import SourceLocation
from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.units import Unit, parse_unit

# Usual forms of units, found by dimension; the first form of a dimension is used.
FORMS = (
    *("1", "kg", "m", "s", "A", "K", "mol", "cd"),
    *("N", "N/m", "N*s/m", "N*s", "N*m", "N/m^2", "N*s^2/m^2", "N*s/m^2", "N*m*s", "N/s", "m/N"),
    *("m/s", "m/s^2", "m/s^3", "m^2", "m^3", "1/s", "1/s^2", "1/m", "W", "V", "N*m/A", "kg*m^2"),
)
# The forms of units for quantities that count cycles (Hz) or radians (rad), by their form without.
TURNING = {
    "Hz": {"1/s": "Hz"},
    "rad": {"1": "rad", "1/s": "rad/s", "1/s^2": "rad/s^2", "N*m": "N*m/rad", "N*m*s": "N*m*s/rad"},
}


def format_dimension(dimension: Dimension) -> str:
    """Return the text of a dimension as an SI unit: `N*s/m`, `1`, or a product of base units.

    A quantity that counts cycles is in Hz, one that counts radians in rad, rad/s or rad/s^2; a torque per
    radian is in N*m/rad or N*m*s/rad.
    """
    text = _forms().get(dimension)
    if text is None:
        above = "*".join(_powered(base, power) for base, power in dimension.exponents if power > 0)
        below = [_powered(base, -power) for base, power in dimension.exponents if power < 0]
        divisor = "*".join(below) if len(below) < 2 else f"({'*'.join(below)})"
        text = f"{above or 1}/{divisor}" if below else above
    return TURNING[dimension.turning].get(text, text) if dimension.turning else text


@cache
def _forms() -> dict[Dimension, str]:
    """Return the usual form of each dimension of `FORMS`."""
    return {parse_unit(text, SourceLocation("")).dimension: text for text in reversed(FORMS)}


def _powered(base: str, power: Fraction | int) -> str:
    """Return the text of a power of a base unit."""
    if power == 1:
        return base
    return f"{base}^{power}" if Fraction(power).denominator == 1 else f"{base}^({power})"


def format_si(value: float, unit: Dimension | Unit) -> str:
    """Return the text of an SI value with its unit, such as `500 N/m`: six digits, no unit if
    dimensionless.
    """
    text = format_dimension(unit.dimension if isinstance(unit, Unit) else unit)
    return f"{value:.6g}" if text == "1" else f"{value:.6g} {text}"
