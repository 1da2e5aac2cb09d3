"""Dimensions and SI values as text.

Takes: a `Dimension`, and a number in SI. Gives: `format_dimension`, `format_si`.
Guarantees: `parse_unit` reads what `format_dimension` writes; no registry of units is loaded.
Does not: choose prefixes: values are shown in SI.
"""

from __future__ import annotations

from fractions import Fraction
from functools import lru_cache

from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.si_forms import FORMS, TURNING
from apc.compiler.language.unit_grammar import parse_factor
from apc.compiler.language.units import Unit


def format_dimension(dimension: Dimension) -> str:
    """Return the dimension as an SI unit `parse_unit` reads: `N*s/m`, `1`, or a product of base units.

    What counts cycles is in Hz, what counts radians in rad, rad/s or rad/s^2.
    """
    known = _forms().get(dimension)
    text = known if known is not None else _product(dimension)
    return TURNING[dimension.turning].get(text, text) if dimension.turning else text


@lru_cache(maxsize=1)
def _forms() -> dict[Dimension, str]:
    """Return the usual form of each dimension of `FORMS`, read without a registry."""
    return {parse_factor(text, _derived)[1]: text for text in reversed(FORMS)}


def _product(dimension: Dimension) -> str:
    above = [_powered(base, power) for base, power in dimension.exponents if power > 0]
    below = [_powered(base, -power) for base, power in dimension.exponents if power < 0]
    text = "*".join(above) or "1"
    if not below:
        return text
    return f"{text}/{below[0]}" if len(below) == 1 else f"{text}/({'*'.join(below)})"


def _powered(base: str, power: Fraction | int) -> str:
    if power == 1:
        return base
    return f"{base}^{power}" if Fraction(power).denominator == 1 else f"{base}^({power})"


def format_si(value: float, unit: Dimension | Unit) -> str:
    """Return an SI value with its SI unit: `500 N/m`; six digits, and no unit for a plain number."""
    text = format_dimension(unit.dimension if isinstance(unit, Unit) else unit)
    return f"{value:.6g}" if text == "1" else f"{value:.6g} {text}"


# The derived units of `FORMS` in base units, so that formatting needs no registry.
_DERIVED = {
    "N": Dimension((("kg", 1), ("m", 1), ("s", -2))),
    "W": Dimension((("kg", 1), ("m", 2), ("s", -3))),
    "V": Dimension((("A", -1), ("kg", 1), ("m", 2), ("s", -3))),
}


def _derived(name: str, offset: int) -> tuple[Fraction, Dimension]:
    """Look a name of `FORMS` up."""
    return Fraction(1), _DERIVED.get(name, Dimension(((name, 1),)))
