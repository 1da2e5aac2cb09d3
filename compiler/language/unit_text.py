"""Dimensions and SI values as text.

Takes: a `Dimension`, and a number in SI. Gives: `format_dimension`, `format_si`;
`is_si`, whether a text is that of an SI unit.
Guarantees: `parse_unit` reads what `format_dimension` writes; no registry of units is loaded.
Does not: choose prefixes: values are shown in SI.
"""

from __future__ import annotations

import re
from fractions import Fraction
from functools import lru_cache

from apc.compiler.language.dimensions import Dimension
from apc.compiler.language.unit_grammar import parse_factor
from apc.compiler.language.units import Unit

# Units with a name or a usual form, looked up by dimension; the first form of a dimension wins.
_FORMS = (
    *("1", "kg", "m", "s", "A", "K", "mol", "cd"),
    *("N", "N/m", "N*s/m", "N*s", "N*m", "N/m^2", "N*s^2/m^2", "N*s/m^2", "N*m*s", "N/s", "m/N"),
    *("m/s", "m/s^2", "m/s^3", "m^2", "m^3", "1/s", "1/s^2", "1/m", "W", "V", "N*m/A", "kg*m^2"),
)
_POWER = r"(?:A|K|cd|kg|m|mol|s)(?:\^(?:[0-9]{1,9}|\([0-9]{1,9}/[0-9]{1,9}\)))?"
_PRODUCT = re.compile(rf"(?:1|{_POWER}(?:\*{_POWER})*)(?:/(?:{_POWER}|\({_POWER}(?:\*{_POWER})+\)))?")


def format_dimension(dimension: Dimension) -> str:
    """Return the dimension as an SI unit `parse_unit` reads: `N*s/m`, `1`, or a product of base units."""
    known = _forms().get(dimension)
    return known if known is not None else _product(dimension)


@lru_cache(maxsize=1)
def _forms() -> dict[Dimension, str]:
    """Return the usual form of each dimension of `_FORMS`, read without a registry."""
    return {parse_factor(text, _derived)[1]: text for text in reversed(_FORMS)}


def is_si(text: str) -> bool:
    """Return whether a text is a unit in the form that `format_dimension` writes: a value in it is in SI."""
    return text in _FORMS or _PRODUCT.fullmatch(text) is not None


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


# The derived units of `_FORMS` in base units, so that formatting needs no registry.
_DERIVED = {
    "N": Dimension((("kg", 1), ("m", 1), ("s", -2))),
    "W": Dimension((("kg", 1), ("m", 2), ("s", -3))),
    "V": Dimension((("A", -1), ("kg", 1), ("m", 2), ("s", -3))),
}


def _derived(name: str, offset: int) -> tuple[Fraction, Dimension]:
    """Look a name of `_FORMS` up."""
    return Fraction(1), _DERIVED.get(name, Dimension(((name, 1),)))
