"""SI units as this program writes them.

Takes: a text. Gives: `FORMS`, `TURNING`; `is_si`, whether the text is that of an SI unit.
Guarantees: nothing else of the language is loaded: a compiled model is read by this alone.
Does not: know what a unit is (see `units`), or write one (see `unit_text`).
"""

from __future__ import annotations

import re

# Units with a name or a usual form, looked up by dimension; the first form of a dimension wins.
FORMS = (
    *("1", "kg", "m", "s", "A", "K", "mol", "cd"),
    *("N", "N/m", "N*s/m", "N*s", "N*m", "N/m^2", "N*s^2/m^2", "N*s/m^2", "N*m*s", "N/s", "m/N"),
    *("m/s", "m/s^2", "m/s^3", "m^2", "m^3", "1/s", "1/s^2", "1/m", "W", "V", "N*m/A", "kg*m^2"),
)
# How the same units are written where a quantity counts cycles or radians: of each, by its other form.
TURNING = {"Hz": {"1/s": "Hz"}, "rad": {"1": "rad", "1/s": "rad/s", "1/s^2": "rad/s^2"}}
_POWER = r"(?:A|K|cd|kg|m|mol|s)(?:\^(?:[0-9]{1,9}|\([0-9]{1,9}/[0-9]{1,9}\)))?"
_PRODUCT = rf"(?:1|{_POWER}(?:\*{_POWER})*)(?:/(?:{_POWER}|\({_POWER}(?:\*{_POWER})+\)))?"


def is_si(text: str) -> bool:
    """Return whether a text is a unit in the form that `format_dimension` writes: a value in it is in SI."""
    turning = any(text in forms.values() for forms in TURNING.values())
    return text in FORMS or turning or re.fullmatch(_PRODUCT, text) is not None
